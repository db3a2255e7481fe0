"""Linear algebra in as many digits as asked for: object arrays of mpmath numbers, elimination by the book.

Write `array * number`, never `number * array`: mpmath would first turn the whole array into text and back.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mpmath import log, mp, mpf
from numpy import ndarray


def exact(array: Any) -> ndarray:
    """The same array, each double turned into the mpmath number that equals it."""
    given = np.asarray(array)
    return np.array([mpf(x) for x in given.ravel().tolist()], dtype=object).reshape(given.shape)


def eye(n: int) -> ndarray:
    """The identity."""
    return exact(np.eye(n))


def rounded(array: ndarray) -> ndarray:
    """The nearest doubles."""
    return np.array([float(x) for x in np.ravel(array)]).reshape(np.shape(array))


def solve(A: ndarray, B: ndarray) -> ndarray:
    """A^-1 B by Gauss-Jordan elimination with row pivoting; ZeroDivisionError where A is singular."""
    return _eliminate(A, B)[0]


def inverse(A: ndarray) -> ndarray:
    """A^-1."""
    return solve(A, eye(len(A)))


def determinant(A: ndarray) -> Any:
    """The product of the pivots, with the sign of the row exchanges."""
    try:
        return _eliminate(A, np.empty((len(A), 0), dtype=object))[1]
    except ZeroDivisionError:
        return mpf(0)


def trace(A: ndarray) -> Any:
    """The sum of the diagonal."""
    return sum(np.diag(A), mpf(0))


def size(A: ndarray) -> Any:
    """The largest modulus of an entry."""
    return max((abs(x) for x in np.ravel(A)), default=mpf(0))


def _eliminate(A: ndarray, B: ndarray) -> tuple[ndarray, Any]:
    A, B, product = A.copy(), B.copy(), mpf(1)
    scale = [size(row) for row in A]  # pivots are judged against their own row: rows may differ by many orders
    for j in range(len(A)):
        i = max(range(j, len(A)), key=lambda r: abs(A[r, j]) / scale[r] if scale[r] else mpf(-1))
        if i != j:
            A[[i, j]], B[[i, j]], product = A[[j, i]], B[[j, i]], -product
            scale[i], scale[j] = scale[j], scale[i]
        product *= A[j, j]
        factor = 1 / A[j, j]
        A[j], B[j] = A[j] * factor, B[j] * factor
        for r in range(len(A)):
            if r != j and A[r, j] != 0:
                B[r], A[r] = B[r] - B[j] * A[r, j], A[r] - A[j] * A[r, j]
    return B, product


def is_positive(A: ndarray) -> bool:
    """Whether every leading minor of a symmetric matrix is positive (Sylvester)."""
    return all(determinant(A[: j + 1, : j + 1]) > 0 for j in range(len(A)))


__all__ = [
    "determinant",
    "exact",
    "eye",
    "inverse",
    "is_positive",
    "log",
    "mp",
    "mpf",
    "rounded",
    "size",
    "solve",
    "trace",
]
