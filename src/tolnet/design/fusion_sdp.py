"""Fusion weights as the semidefinite program of eq. (17), by CVXPY and by Clarabel directly: the slow, sure way.

    min <M, X>   subject to   [X I; I Omega(delta)] >= 0,   Omega(delta) >= I,   delta >= 0,   sum_j delta_j = 1

in the frame of the reference weights (analysis.fusion_weights), where their Omega is I. Both build the program once
for every number of pairs J and of states n, and only exchange its numbers.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

_ACCURACY = 1e-10
"""What the interior-point method is asked for; its own default of 1e-8 leaves errors above 1e-6 in degenerate cases."""
_STEPS = 200


class Answer(NamedTuple):
    """What a solver left, unchecked."""

    weights: Float[ndarray, " J"]
    Z: Float[ndarray, "n n"]
    """The multiplier of Omega(delta) >= I; zero without it."""
    iterations: int


class Program:
    """One program, built, waiting for numbers."""

    @abstractmethod
    def solve(self, Omega: Float[ndarray, "J n n"], M: Float[ndarray, "n n"]) -> Answer | None:
        """Solve it for one set of numbers; None where the solver gives no answer."""


@lru_cache(maxsize=32)
def solver_for(method: Literal["cvxpy", "clarabel"], J: int, n: int, constrained: bool) -> Program:
    """The program for J pairs and n states."""
    return (_Cvxpy if method == "cvxpy" else _Clarabel)(J, n, constrained)


class _Cvxpy(Program):
    """The program in CVXPY with parameters, so that it is compiled once; solved by Clarabel."""

    def __init__(self, J: int, n: int, constrained: bool) -> None:
        import cvxpy as cp

        self.delta, X = cp.Variable(J, nonneg=True), cp.Variable((n, n), symmetric=True)
        self.Omega = [cp.Parameter((n, n), symmetric=True) for _ in range(J)]
        self.M = cp.Parameter((n, n), symmetric=True)
        combined: Any = sum(self.delta[j] * self.Omega[j] for j in range(J))
        eye = np.eye(n)
        limits = [cp.sum(self.delta) == 1, cp.bmat([[X, eye], [eye, combined]]) >> 0]
        self.floor = combined - eye >> 0 if constrained else None
        self.problem = cp.Problem(
            cp.Minimize(cp.trace(self.M @ X)), limits + ([self.floor] if self.floor is not None else [])
        )

    def solve(self, Omega: Float[ndarray, "J n n"], M: Float[ndarray, "n n"]) -> Answer | None:
        import cvxpy as cp

        for parameter, value in zip(self.Omega, Omega, strict=True):
            parameter.value = value
        self.M.value = M
        accuracy = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), _ACCURACY)
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Solution may be inaccurate")  # whoever asked checks it
                self.problem.solve(solver=cp.CLARABEL, max_iter=_STEPS, **accuracy)
        except cp.SolverError:
            return None
        if self.delta.value is None:
            return None
        Z = np.zeros_like(M) if self.floor is None else np.asarray(self.floor.dual_value)
        return Answer(np.asarray(self.delta.value), Z, int(self.problem.solver_stats.num_iters or 0))


class _Clarabel(Program):
    """The same for Clarabel itself: b - A [delta; upper triangle of X] in a product of cones."""

    def __init__(self, J: int, n: int, constrained: bool) -> None:
        clarabel = _clarabel()
        self.J, self.n, self.constrained = J, n, constrained
        small, large = _triangle(n), _triangle(2 * n)
        self.small, X = small, len(small)
        row, column = large.T
        weight = _weight(large)
        position = {tuple(place): J + k for k, place in enumerate(small.tolist())}
        self.cones = [
            clarabel.ZeroConeT(1),
            clarabel.NonnegativeConeT(J),
            clarabel.PSDTriangleConeT(2 * n),
            *([clarabel.PSDTriangleConeT(n)] if constrained else []),
        ]
        block = np.zeros((len(large), J + X))
        in_X = np.flatnonzero(column < n)
        block[in_X, [position[i, j] for i, j in large[in_X].tolist()]] = -weight[in_X]
        self.in_Omega = np.flatnonzero(row >= n)
        self.places = large[self.in_Omega] - n
        self.weights = weight[self.in_Omega]
        self.fixed = np.vstack(
            [np.r_[np.ones(J), np.zeros(X)], np.hstack([-np.eye(J), np.zeros((J, X))]), block]
            + ([np.zeros((X, J + X))] if constrained else [])
        )
        identity = np.where((column - n == row) & (row < n), weight, 0.0)
        self.right = np.r_[1.0, np.zeros(J), identity]
        if constrained:
            self.right = np.r_[self.right, -np.where(small[:, 0] == small[:, 1], 1.0, 0.0)]
        self.cost = np.where(small[:, 0] == small[:, 1], 1.0, 2.0)
        self.settings = clarabel.DefaultSettings()
        self.settings.verbose = False
        self.settings.max_iter = _STEPS
        self.settings.tol_gap_abs = self.settings.tol_gap_rel = self.settings.tol_feas = _ACCURACY

    def solve(self, Omega: Float[ndarray, "J n n"], M: Float[ndarray, "n n"]) -> Answer | None:
        clarabel, J, n = _clarabel(), self.J, self.n
        A = self.fixed.copy()
        i, j = self.places.T
        A[1 + J + self.in_Omega, :J] = -self.weights[:, None] * Omega[:, i, j].T
        i, j = self.small.T
        if self.constrained:
            A[-len(self.small) :, :J] = -_weight(self.small)[:, None] * Omega[:, i, j].T
        q = np.r_[np.zeros(J), self.cost * M[i, j]]
        nothing = sparse.csc_array((len(q), len(q)))
        program = clarabel.DefaultSolver(nothing, q, sparse.csc_array(A), self.right, self.cones, self.settings)
        found = program.solve()
        if found.status not in (clarabel.SolverStatus.Solved, clarabel.SolverStatus.AlmostSolved):
            return None
        Z = np.zeros((n, n))
        if self.constrained:
            Z[i, j] = Z[j, i] = np.array(found.z[-len(self.small) :]) / _weight(self.small)
        return Answer(np.array(found.x[:J]), Z, int(found.iterations))


def _clarabel() -> Any:
    """The module, which has no types."""
    import clarabel

    return clarabel


def _triangle(n: int) -> Int[ndarray, "t 2"]:
    """Row and column of the entries of an upper triangle, column by column."""
    return np.array([(i, j) for j in range(n) for i in range(j + 1)])


def _weight(places: Int[ndarray, "t 2"]) -> Float[ndarray, " t"]:
    """What makes the inner product of triangles that of matrices."""
    return np.where(places[:, 0] == places[:, 1], 1.0, np.sqrt(2.0))
