"""The DAREX collection (Benner, Laub, Mehrmann 1995) at c = 0: residuals no worse than scipy's.

From SLICOT's generator, in control form 0 = A'XA - X - (A'XB + S)(R + B'XB)^-1 (B'XA + S') + Q. That is a filter with
A', information B R^-1 B' and process noise Q once R is invertible and the cross term is folded into A and Q.
"""

from __future__ import annotations

from typing import NamedTuple

import ctrlsys
import numpy as np
import pytest
from numpy import ndarray
from scipy.linalg import solve_discrete_are

from tolnet import analysis
from tolnet.model.covariances import SIX_DIGITS

GENERATED = [(1, 3), (1, 9), (2, 1), (2, 2), (2, 3), (2, 4), (2, 5), (4, 1)]
NOT_A_FILTER = {
    (1, 1): "R is zero",
    (1, 2): "R is singular and Q is indefinite",
    (1, 4): "R is singular and Q is indefinite",
}
"""Problems with no information matrix B R^-1 B', or with a process noise that is no covariance."""


class Control(NamedTuple):
    """A control-form problem, cut to size."""

    A: ndarray
    B: ndarray
    Q: ndarray
    R: ndarray
    S: ndarray


def example(number: tuple[int, int]) -> Control:
    """One problem with its default parameters, Q and R as full matrices."""
    flags = np.array([1, 1, 1, 0, 1, 1, 1], dtype=bool)
    sizes = np.zeros(3, dtype=np.int32)
    _, n, m, _, A, B, _, Q, R, S, _, info = ctrlsys.bb02ad("D", np.array(number, np.int32), np.zeros(4), sizes, flags)
    assert info == 0
    A, B, Q, R, S = (np.array(M) for M in (A[:n, :n], B[:n, :m], Q[:n, :n], R[:m, :m], S[:n, :m]))
    return Control(A, B, (Q + Q.T) / 2, (R + R.T) / 2, S)


def as_filter(problem: Control) -> tuple[ndarray, ndarray, ndarray]:
    """A, Q and S of the filter whose P is the control problem's X."""
    A, B, Q, R, S = problem
    A, Q = A - B @ np.linalg.solve(R, S.T), Q - S @ np.linalg.solve(R, S.T)
    information = B @ np.linalg.solve(R, B.T)
    return A.T, (Q + Q.T) / 2, (information + information.T) / 2


def residual(A: ndarray, Q: ndarray, S: ndarray, P: ndarray) -> float:
    """|P - A P (I + S P)^-1 A' - Q| / |P| in the Frobenius norm, in extended precision."""
    A, Q, S, P = (M.astype(np.longdouble) for M in (A, Q, S, P))
    return float(np.sqrt(((P - A @ P @ inverse(np.eye(len(A)) + S @ P) @ A.T - Q) ** 2).sum() / (P**2).sum()))


def inverse(M: ndarray) -> ndarray:
    """M^-1 in the precision of M, by refining numpy's."""
    X = np.linalg.inv(M.astype(float)).astype(M.dtype)
    for _ in range(4):
        X = X + X @ (np.eye(len(M)) - M @ X)
    return X


def rounding(A: ndarray, Q: ndarray, S: ndarray, P: ndarray) -> float:
    """What solving with I + S P in doubles leaves of the right side, n eps kappa(I + S P), in parts of P.

    Zero where that is no six digits, so that nothing is excused by it.
    """
    n, M = len(A), np.eye(len(A)) + S @ P
    error = n * np.finfo(float).eps * np.linalg.cond(M)
    return float(error * np.linalg.norm(P - Q) / np.linalg.norm(P)) if error < SIX_DIGITS else 0.0


@pytest.mark.parametrize("number", GENERATED, ids=str)
def test_residuals_are_no_worse_than_scipys(number: tuple[int, int]):
    problem = example(number)
    A, Q, S = as_filter(problem)
    state = analysis.solve_steady_states(A, Q, S[None], np.zeros(1))[0]
    X = solve_discrete_are(problem.A, problem.B, problem.Q, problem.R, s=problem.S)
    ours, theirs = residual(A, Q, S, state.P), residual(A, Q, S, (X + X.T) / 2)
    assert str(state.status) == "ok"
    assert ours <= max(theirs, np.finfo(float).eps, rounding(A, Q, S, state.P))  # P itself is rounded to eps


@pytest.mark.parametrize("number", NOT_A_FILTER, ids=str)
def test_the_others_are_no_filters(number: tuple[int, int]):
    problem = example(number)
    assert np.linalg.matrix_rank(problem.R) < len(problem.R), NOT_A_FILTER[number]
