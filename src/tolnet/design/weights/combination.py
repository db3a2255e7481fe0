"""Each node's best combination for the present error covariances: a semidefinite program, used as a step.

At fixed errors before mixing, Psi, and fixed adjoint Y, J is quadratic in node k's column of W, with derivative g and
second derivative H = 2 [tr(Y_kk Psi_lm)]. With H = R R' the best column w, instead of the present one v, is that of

    min g'w + t   subject to   [I, R'(w - v); (w - v)'R, 2 t] >= 0,   w >= lower,   sum w = 1

    1. Psi, Y, g and H at the present W;   2. every node's program;   3. a step there, halved until J falls

Source: docs/mathematics.md, section 12.2; docs/decisions/0023-combination.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.design.weights.admissible import Admissible
from tolnet.design.weights.programs import solve_program
from tolnet.design.weights.quasi_newton import Objective

_ROUNDS = 5
_GAIN = 1e-3
"""A round that lowers J by less, relatively, is the last."""
_GAP = 1e-4
"""What a solver's column may promise still, relative to what weights can change: it is 1e-9 worse than the best
where its gap is 1e-6 to 3e-5."""
_LENGTHS = (1.0, 0.5, 0.25, 0.1)


class CombinationPrograms:
    """The best column of a node, one parametrised program for each number of neighbours."""

    def __init__(self) -> None:
        self._programs: dict[int, Any] = {}

    def best(
        self, H: Float[ndarray, "d d"], g: Float[ndarray, " d"], v: Float[ndarray, " d"], lower: Float[ndarray, " d"]
    ) -> Float[ndarray, " d"] | None:
        """argmin g'w + (w - v)'H(w - v) / 2 over the simplex above `lower`; None where the solver's answer is poor.

        Assumes H positive semidefinite, rounding apart. The answer is made feasible and its gap recomputed.
        """
        import cvxpy as cp

        d, scale = len(v), max(float(np.ptp(g)), float(np.abs(H).max()), np.finfo(float).tiny)
        if d not in self._programs:
            w, t = cp.Variable(d), cp.Variable()
            root, shift = cp.Parameter((d, d)), cp.Parameter(d)
            slope, floor = cp.Parameter(d), cp.Parameter(d, nonneg=True)
            step: Any = cp.reshape(root @ w - shift, (d, 1), order="F")
            size: Any = cp.reshape(2 * t, (1, 1), order="F")
            limits = [cp.bmat([[np.eye(d), step], [step.T, size]]) >> 0, w >= floor, cp.sum(w) == 1]
            self._programs[d] = cp.Problem(cp.Minimize(slope @ w + t), limits), w, root, shift, slope, floor
        problem, w, root, shift, slope, floor = self._programs[d]
        values, U = np.linalg.eigh(H / scale)
        root.value = (U * np.sqrt(np.maximum(values, 0.0))).T
        shift.value, slope.value, floor.value = root.value @ v, (g - g.mean()) / scale, lower
        if not solve_program(problem):
            return None
        found = lower + np.maximum(np.asarray(w.value) - lower, 0.0)
        found = lower + (found - lower) * (1 - lower.sum()) / max(float((found - lower).sum()), np.finfo(float).tiny)
        return found if combination_gap(H, g, v, lower, found) <= _GAP * scale else None


def combination_gap(
    H: Float[ndarray, "d d"],
    g: Float[ndarray, " d"],
    v: Float[ndarray, " d"],
    lower: Float[ndarray, " d"],
    w: Float[ndarray, " d"],
) -> float:
    """At most how much worse than the best column w is: what its own derivative still promises."""
    slope = g + H @ (w - v)
    return float(slope @ (w - lower) - (1 - lower.sum()) * slope.min())


def combine(objective: Objective, among: Admissible, w: Float[ndarray, " L"]) -> Float[ndarray, " L"]:
    """Weights after a few steps from the admissible w, each to the best combination of every node; never worse."""
    columns, programs = among.columns, CombinationPrograms()
    value, at = objective.value(w)
    if not np.isfinite(value):
        return w
    for _ in range(_ROUNDS):
        g, B = objective.gradient(at)
        target = w.copy()
        for k in range(columns.nodes):
            here = slice(columns.offsets[k], columns.offsets[k + 1])
            d = here.stop - here.start
            if d == 1:
                continue
            lower = np.where(columns.sender[here] == k, among.lower[k], 0.0)
            found = programs.best(B.weights[k, :d, :d], g[here], w[here], lower)
            if found is not None:
                target[here] = found
        before = value
        for length in _LENGTHS:
            trial = w + length * (target - w)
            tried, there = objective.value(trial)
            if tried < before:
                w, value, at = trial, tried, there
                break
        if not value < (1 - _GAIN) * before:
            break
    return w
