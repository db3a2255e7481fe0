"""Matrices of numbers with 320 bits, by python-flint's `arb_mat` without its error bounds (docs/mathematics.md, 4.8).

Midpoints only: a radius says how far rounding may have gone at worst, grows through every elimination, and is of no
use where an answer is checked by its residuals. Everything is called inside `precision()`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg
from jaxtyping import Float
from numpy import ndarray

if TYPE_CHECKING:
    from flint import arb_mat as Matrix
else:
    Matrix = object

BITS = 320
"""Working precision: a double has 53 bits, so that 240 may be lost before six digits are in danger."""
_NO_VARIANCE = 1e-80


class NoAnswer(Exception):
    """No steady state was found; the text says what ended the search."""


def precision() -> Any:
    """The context in which everything here computes."""
    from flint import ctx

    return ctx.workprec(BITS)


def matrix(X: Float[ndarray, "m n"]) -> Matrix:
    """These doubles, exactly."""
    from flint import arb_mat

    rows, columns = X.shape
    return arb_mat(rows, columns, X.ravel().tolist())


def rounded(X: Matrix) -> Float[ndarray, "m n"]:
    """The nearest doubles."""
    values = [float(x.mid()) for x in X.entries()]
    return np.array(values).reshape(X.nrows(), X.ncols())


def number(x: float | int) -> Any:
    from flint import arb

    return arb(x)


def identity(n: int) -> Matrix:
    return matrix(np.eye(n))


def zeros(n: int) -> Matrix:
    return matrix(np.zeros((n, n)))


def solve(X: Matrix, Y: Matrix) -> Matrix:
    """X^-1 Y without error bounds; ZeroDivisionError where X is singular."""
    return X.solve(Y, algorithm="approx")


def middle(X: Matrix) -> Matrix:
    """Without the radii, which only grow here."""
    return X.mid()


def symmetric(X: Matrix) -> Matrix:
    return ((X + X.transpose()) / 2).mid()


def pivots(X: Matrix) -> list[Any] | None:
    """Of an elimination without exchanges in a symmetric matrix; None unless all are positive: X is then definite."""
    n = X.nrows()
    rest = [[X[i, j].mid() for j in range(n)] for i in range(n)]
    for k in range(n):
        if not rest[k][k] > 0:
            return None
        for i in range(k + 1, n):
            share = (rest[i][k] / rest[k][k]).mid()
            for j in range(k + 1, i + 1):
                rest[i][j] = rest[j][i] = (rest[i][j] - share * rest[k][j]).mid()
    return [rest[k][k] for k in range(n)]


def upper_triangle(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i, n)]


def unpacked(x: Matrix, column: int, n: int) -> Matrix:
    """The symmetric matrix whose upper triangle is a column of x."""
    X = zeros(n)
    for row, (i, j) in enumerate(upper_triangle(n)):
        X[i, j] = X[j, i] = x[row, column]
    return X


def inverse_units(P: Matrix) -> Matrix:
    """1 / sqrt(P_ii P_jj); 1 for a state without variance."""
    from flint import arb_mat

    root = [x.sqrt() if x > 0 else number(1) for x in (P[i, i].mid() for i in range(P.nrows()))]
    return middle(arb_mat([[1 / (a * b) for b in root] for a in root]))


def distance(X: Matrix, Y: Matrix) -> float:
    """max |X_ij - Y_ij| / sqrt(X_ii X_jj): a change in the units of each state; inf where that is no number.

    A variance below 1e-80 of the largest, beyond the range of units, is none: a state that is known exactly.
    """
    gap, variance = np.abs(rounded(X - Y)), np.abs(np.diag(rounded(X)))
    scale = np.sqrt(np.maximum(variance, _NO_VARIANCE * variance.max()))
    with np.errstate(all="ignore"):
        ratio = np.where(gap == 0, 0.0, gap / scale[:, None] / scale)
    worst = float(ratio.max())
    return math.inf if math.isnan(worst) else worst


def radius(F: Matrix) -> float:
    """Spectral radius, from eigenvalues in the working precision."""
    from flint import acb_mat

    values = acb_mat(middle(F)).eig(algorithm="approx")
    return max(float(abs(x).mid()) for x in values)


def radius_with_error(F: Float[ndarray, "d d"]) -> tuple[float, float]:
    """Spectral radius, and what rounding may do to it: d eps |F| / |y* x| for unit eigenvectors y, x."""
    if not np.isfinite(F).all():
        return math.nan, math.inf
    solved: Any = scipy.linalg.eig(F, left=True, right=True)
    values, left, right = solved
    largest = int(np.abs(values).argmax())
    overlap = abs(np.vdot(left[:, largest], right[:, largest]))
    rounding = len(F) * np.finfo(float).eps * float(np.linalg.norm(F))
    return float(abs(values[largest])), rounding / overlap if overlap > 0 else math.inf
