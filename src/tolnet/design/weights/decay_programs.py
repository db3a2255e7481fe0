"""The semidefinite programs of the decay rate, built once with parameters: docs/mathematics.md, section 12.3."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.curvature import Columns
from tolnet.design.weights.programs import solve_program

_FEASIBLE = 1e-6
"""By how much, relative to 1, X may break its inequality and still be taken."""


class ColumnPrograms:
    """The W step of every node, one parametrised program for each number of neighbours."""

    def __init__(self, n: int) -> None:
        self.n = n
        self._programs: dict[int, Any] = {}

    def best(
        self, P: Float[ndarray, "d n n"], cost: Float[ndarray, " d"], lower: Float[ndarray, " d"]
    ) -> Float[ndarray, " d"] | None:
        """argmin cost'w over the simplex above `lower`, subject to sum_l w_l P_l <= I; None if that fails."""
        import cvxpy as cp

        d = len(cost)
        if d not in self._programs:
            w = cp.Variable(d)
            matrices = [cp.Parameter((self.n, self.n), symmetric=True) for _ in range(d)]
            prices, floor = cp.Parameter(d), cp.Parameter(d, nonneg=True)
            total: Any = sum((w[i] * matrix for i, matrix in enumerate(matrices)), np.zeros((self.n, self.n)))
            limits = [total << np.eye(self.n), w >= floor, cp.sum(w) == 1]
            self._programs[d] = cp.Problem(cp.Minimize(prices @ w), limits), w, matrices, prices, floor
        problem, w, matrices, prices, floor = self._programs[d]
        for matrix, value in zip(matrices, P, strict=True):
            matrix.value = (value + value.T) / 2
        prices.value, floor.value = cost / max(np.abs(cost).max(), np.finfo(float).tiny), lower
        return np.asarray(w.value) if solve_program(problem) else None


class CertificateProgram:
    """The X step: min sum_k tr X_k subject to X_k - sigma_k / s sum_l w_lk M_l X_l M_l' >= I for all k."""

    def __init__(self, columns: Columns, loops: Float[ndarray, "N n n"]) -> None:
        import cvxpy as cp

        N, n, _ = loops.shape
        self.columns, self.loops = columns, loops
        self._X = [cp.Variable((n, n), symmetric=True) for _ in range(N)]
        self._weights = cp.Parameter(len(columns.sender), nonneg=True)
        moved: list[Any] = [M @ X @ M.T for M, X in zip(loops, self._X, strict=True)]
        self._limits = []
        for k in range(N):
            here = range(columns.offsets[k], columns.offsets[k + 1])
            seen: Any = sum((self._weights[i] * moved[columns.sender[i]] for i in here), np.zeros((n, n)))
            self._limits.append(self._X[k] - seen >> np.eye(n))
        total: Any = sum((cp.trace(X) for X in self._X[1:]), cp.trace(self._X[0]))
        self._problem = cp.Problem(cp.Minimize(total), self._limits)

    def least(
        self, w: Float[ndarray, " L"], s: float
    ) -> tuple[Float[ndarray, "N n n"], Float[ndarray, "N n n"]] | None:
        """The least X, and the dual Y = I + T_W*(Y) / s; None where the solver's X breaks its inequality."""
        columns = self.columns
        scaled = np.abs(w) * columns.sums(np.abs(w))[columns.hearer] / s
        self._weights.value = scaled
        if not solve_program(self._problem):
            return None
        X = np.array([variable.value for variable in self._X])
        Y = np.array([limit.dual_value for limit in self._limits])
        seen = np.zeros_like(X)
        np.add.at(seen, columns.hearer, scaled[:, None, None] * (self.loops @ X @ self.loops.mT)[columns.sender])
        slack = np.linalg.eigvalsh(X - seen).min()
        return (X, (Y + Y.mT) / 2) if slack >= 1 - _FEASIBLE * np.abs(X).max() else None
