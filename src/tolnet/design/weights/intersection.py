"""Covariance intersection: the weights that are best where nobody knows how the errors of neighbours hang together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.curvature import Columns, Curvature
from tolnet.design.weights.admissible import Admissible, Constraints
from tolnet.design.weights.quasi_newton import minimise
from tolnet.model.worst_case import standard_deviations


@dataclass(frozen=True, eq=False)
class _Traces:
    """sum_k tr P_k, P_k = (sum_l w_lk V_l^-1)^-1: convex in W, its second derivative exact and column by column."""

    columns: Columns
    precision: Float[ndarray, "K n n"]
    unit: Float[ndarray, " n"]

    def value(self, z: Float[ndarray, " L"]) -> tuple[float, Float[ndarray, "K n n"]]:
        """The sum, and every P_k."""
        information = np.zeros_like(self.precision)
        np.add.at(information, self.columns.hearer, z[:, None, None] * self.precision[self.columns.sender])
        P = np.linalg.inv(information)
        return float(np.einsum("kii,i->", P, self.unit**2)), P

    def gradient(self, at: Float[ndarray, "K n n"]) -> tuple[Float[ndarray, " L"], Curvature]:
        """-tr(P V_l^-1 P), and tr(P V_l^-1 P V_m^-1 P); in the state's own units."""
        columns, P = self.columns, at
        PO = P[columns.hearer] @ self.precision[columns.sender]
        POP = PO @ P[columns.hearer]
        i, j = columns.pairs
        half = np.einsum("tij,tji,i->t", PO[i], POP[j], self.unit**2)
        return -np.einsum("lii,i->l", POP, self.unit**2), Curvature.of_pairs(columns, half)


def intersect_covariances(columns: Columns, V: Float[ndarray, "K n n"]) -> Float[ndarray, " L"]:
    """Weights w_lk >= 0 with sums of one that minimise tr (sum_l w_lk V_l^-1)^-1 at every node k, link by link.

    All nodes at once by Newton's method on their simplices, in units near the standard deviations of the errors.
    Assumes every V_l positive definite.
    Source: S. J. Julier, J. K. Uhlmann, Proc. American Control Conference, 1997; docs/mathematics.md, section 12.4.
    """
    unit = np.sqrt(np.exp(np.log(standard_deviations(V)[0] ** 2).mean(axis=0)))
    scaled = V / (unit * unit[:, None])
    among = Admissible.of(columns, Constraints())
    w = 1.0 / columns.degree[columns.hearer]
    traces = _Traces(columns, np.linalg.inv(scaled), unit)
    return minimise(traces, w, among.project, centre=among.centred, tolerance=1e-10).z
