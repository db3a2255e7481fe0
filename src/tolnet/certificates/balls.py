"""Ball arithmetic: every number is an interval that holds the exact one, and a comparison that is true was proved.

Balls are python-flint's `arb` and `arb_mat` (Arb; F. Johansson, IEEE Trans. Computers 66, 2017). A comparison that is
false says nothing. A matrix that may be singular within its radii has no inverse here: ZeroDivisionError, which the
functions that prove and verify turn into a reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates.clock import check_clock

if TYPE_CHECKING:
    from flint import arb as Ball
    from flint import arb_mat as BallMatrix
else:
    Ball = BallMatrix = object

BITS = 256
"""Working precision to begin with: 6 x 6 products cost as much as at 64 bits."""


@dataclass(frozen=True)
class NotProved:
    """Why something could not be proved. It says nothing about the truth."""

    reason: str


def working_precision(bits: int) -> Any:
    """A context in which balls carry so many bits."""
    from flint import ctx

    return ctx.workprec(bits)


def ball(x: float | Ball, radius: float | Ball = 0) -> Ball:
    """The exact number x, or x with a radius."""
    from flint import arb

    return arb(x, radius)


def matrix(X: Float[ndarray, "m n"]) -> BallMatrix:
    """The exact matrix of these doubles."""
    from flint import arb_mat

    rows, columns = X.shape
    return arb_mat(rows, columns, X.ravel().tolist())


def matrix_of(rows: int, columns: int, entries: Iterable[Ball]) -> BallMatrix:
    """A matrix of balls, row by row."""
    from flint import arb_mat

    return arb_mat(rows, columns, list(entries))


def identity(n: int) -> BallMatrix:
    """The identity."""
    return matrix(np.eye(n))


def column(entries: Sequence[Ball]) -> BallMatrix:
    """A column."""
    return matrix_of(len(entries), 1, entries)


def symmetric_part(M: BallMatrix) -> BallMatrix:
    """(M + M') / 2, which encloses the same symmetric matrix as M does."""
    return (M + M.transpose()) * ball(0.5)


def midpoints(M: BallMatrix) -> Float[ndarray, "m n"]:
    """The doubles nearest to the middles."""
    return np.array([float(x.mid()) for x in M.entries()]).reshape(M.nrows(), M.ncols())


def above(x: Ball) -> float:
    """A double at least as large as every number in the ball."""
    return math.nextafter(float(x.upper()), math.inf)


def below(x: Ball) -> float:
    """A double at most as large as every number in the ball."""
    return math.nextafter(float(x.lower()), -math.inf)


def congruence(T: BallMatrix, M: BallMatrix) -> BallMatrix:
    """T M T' for symmetric M."""
    return symmetric_part(T * M * T.transpose())


def outward(M: BallMatrix, sign: int) -> BallMatrix:
    """An exact matrix below (sign -1) or above (sign 1) every symmetric matrix in M: its radii go to the diagonal."""
    n = M.nrows()
    rows = symmetric_part(M).tolist()
    for i, row in enumerate(rows):
        moved = row[i].mid() + sign * sum((x.rad() for x in row), ball(0)).upper()
        row[i] = moved.upper() if sign > 0 else moved.lower()
    return matrix_of(n, n, [rows[min(i, j)][max(i, j)].mid() for i in range(n) for j in range(n)])


def row_sum_norm(M: BallMatrix) -> Ball:
    """The largest row sum of moduli, bounded above."""
    n = M.ncols()
    sizes = [abs(x).upper() for x in M.entries()]
    sums = [sum(sizes[i : i + n], ball(0)).upper() for i in range(0, len(sizes), n)] if n else []
    largest = ball(0)
    for total in sums:
        largest = largest.max(total)
    return largest


def inverse_of_wide(M: BallMatrix) -> BallMatrix:
    """M^-1 for radii that are no longer small, by one approximate inverse B of the middle.

    With E = I - B M and |E| = e < 1 (largest row sum): M^-1 = B + E B + E^2 M^-1, where every column of M^-1 is at
    most 1 / (1 - e) times as large as that of B. ZeroDivisionError where e is not below 1.
    """
    n = M.nrows()
    B = M.mid().inv().mid()
    E = identity(n) - B * M
    e = row_sum_norm(E)
    if not e < 1:
        raise ZeroDivisionError("matrix may be singular")
    sizes = [max((above(abs(B[i, j])) for i in range(n)), default=0.0) for j in range(n)]
    bound = matrix_of(n, n, [ball(0, above(ball(s) / (1 - e))) for _ in range(n) for s in sizes])
    return B + E * (B + E * bound)


def is_positive(M: BallMatrix) -> bool:
    """Whether every symmetric matrix in M was shown to be positive definite.

    With X near the inverse of a Cholesky factor of the middle, X M X' is near the identity: where its off-diagonal
    row sums stay below its diagonal (Gershgorin) it is positive definite, hence X is non-singular and M positive
    definite. Where doubles do not reach that far, by a Cholesky decomposition in balls.
    """
    n = M.nrows()
    if n == 0:
        return True
    if not all(M[i, i] > 0 for i in range(n)):
        return False
    middle = midpoints(M)
    with np.errstate(all="ignore"):
        scale = np.sqrt(np.maximum(np.diag(middle), np.finfo(float).tiny))
        try:
            factor = np.linalg.cholesky(middle / scale[:, None] / scale)
            X = np.linalg.inv(factor) / scale
        except np.linalg.LinAlgError:
            return _cholesky_succeeds(M)
    if np.isfinite(X).all() and _is_dominant(congruence(matrix(X), M)):
        return True
    return _cholesky_succeeds(M)


def _is_dominant(M: BallMatrix) -> bool:
    n = M.nrows()
    sizes = [abs(x).upper() for x in M.entries()]
    return all(M[i, i] > sum(sizes[i * n : i * n + n], ball(0)) - sizes[i * n + i] for i in range(n))


def _cholesky_succeeds(M: BallMatrix) -> bool:
    """Whether every pivot of the symmetric elimination is positive for all of M."""
    n = M.nrows()
    rows = M.tolist()
    for k in range(n):
        check_clock()
        if not rows[k][k] > 0:
            return False
        for i in range(k + 1, n):
            share = rows[i][k] / rows[k][k]
            for j in range(k + 1, i + 1):
                rows[i][j] = rows[i][j] - share * rows[j][k]
        for i in range(k + 1, n):
            for j in range(i + 1, n):
                rows[i][j] = rows[j][i]
    return True
