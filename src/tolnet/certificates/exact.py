"""Exact arithmetic on stacks of matrices of doubles: Python integers in NumPy arrays, with one power of two for all.

Doubles are m 2^e, so sums and products of them are integers times a power of two; nothing is rounded, and every
operation runs over the whole stack.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped
from numpy import ndarray

_MANTISSA = 53
_MACHINE_BITS = 30
_PRECISIONS = (_MACHINE_BITS, 60, 240, 960)
"""Bits of a factor: more for what is nearly singular."""
_LARGE = 64
"""Sizes above which 60 bits must do: such matrices come from floating point, and would take minutes."""


@dataclass(frozen=True, eq=False)
class Exact:
    """The exact numbers `ints` 2^`exponent`."""

    ints: Shaped[ndarray, "*shape"]
    exponent: int

    @classmethod
    def of(cls, values: Float[ndarray, "*shape"] | float) -> Exact:
        """Doubles as the numbers that they are. Assumes them finite."""
        values = np.asarray(values, dtype=float)
        mantissa, exponent = np.frexp(values)
        whole = np.asarray(np.ldexp(mantissa, _MANTISSA), dtype=np.int64)
        lowest = np.where(whole != 0, exponent - _MANTISSA + _trailing_zeros(whole), np.iinfo(np.int32).max)
        least = int(lowest.min(initial=np.iinfo(np.int32).max))
        least = 0 if least == np.iinfo(np.int32).max else least
        shift = np.where(whole != 0, exponent - _MANTISSA - least, 0)
        right = np.maximum(-shift, 0)
        left = np.maximum(shift, 0).astype(object)
        return cls(np.asarray((whole >> right).astype(object) << left, dtype=object), least)

    @property
    def T(self) -> Exact:
        """Transposed in the last two axes."""
        return Exact(self.ints.swapaxes(-1, -2), self.exponent)

    def __matmul__(self, other: Exact) -> Exact:
        return Exact(np.matmul(self.ints, other.ints), self.exponent + other.exponent)

    def __mul__(self, other: Exact) -> Exact:
        return Exact(np.asarray(self.ints * other.ints, dtype=object), self.exponent + other.exponent)

    def __add__(self, other: Exact) -> Exact:
        low = min(self.exponent, other.exponent)
        a, b = (x.ints if x.exponent == low else x.ints << (x.exponent - low) for x in (self, other))
        return Exact(np.asarray(a + b, dtype=object), low)

    def __neg__(self) -> Exact:
        return Exact(np.asarray(-self.ints, dtype=object), self.exponent)

    def __sub__(self, other: Exact) -> Exact:
        return self + (-other)

    def __getitem__(self, key) -> Exact:
        return Exact(np.asarray(self.ints[key], dtype=object), self.exponent)

    def __abs__(self) -> Exact:
        return Exact(np.asarray(abs(self.ints), dtype=object), self.exponent)

    def reshape(self, *shape: int) -> Exact:
        """The same numbers in another shape."""
        return Exact(self.ints.reshape(shape), self.exponent)

    def sum(self, axis: int) -> Exact:
        """Sums along an axis."""
        return Exact(np.asarray(self.ints.sum(axis=axis), dtype=object), self.exponent)

    def positive(self) -> Bool[ndarray, "*shape"]:
        """Which are above zero."""
        return np.asarray(self.ints > 0, dtype=bool)

    def rounded(self) -> Float[ndarray, "*shape"]:
        """As doubles, to within a few units in the last place; for guidance, never for a proof."""
        flat = []
        for value in self.ints.ravel().tolist():
            extra = max(abs(value).bit_length() - 64, 0)
            flat.append(np.ldexp(float(value >> extra), extra + self.exponent))
        return np.array(flat, dtype=float).reshape(self.ints.shape)

    def definite(self) -> Bool[ndarray, "*stack"]:
        """Which members of a stack of symmetric matrices are shown to be positive definite."""
        d = self.ints.shape[-1]
        flat = self.ints.reshape(-1, d, d)
        good = np.zeros(len(flat), dtype=bool)
        for bits in _PRECISIONS[: 2 if d > _LARGE else None]:
            left = np.flatnonzero(~good)
            if not left.size:
                break
            good[left] = _have_factors(flat[left], bits)
        return good.reshape(self.ints.shape[:-2])


def is_semidefinite(S: Exact) -> bool:
    """Whether one symmetric matrix is positive semidefinite, decided by fraction-free elimination (Bareiss).

    No pivot is negative, and beside a pivot of zero there are only zeros.
    """
    rows, previous = S.ints, 1
    while len(rows):
        pivot, rest = rows[0, 0], rows[0, 1:]
        if pivot < 0 or (pivot == 0 and rest.any()):
            return False
        scale = pivot or previous
        rows = (rows[1:, 1:] * scale - np.multiply.outer(rows[1:, 0], rest)) // previous
        previous = scale
    return True


def segment_sums(values: Exact, offsets: ndarray) -> Exact:
    """Sums of the rows offsets[k] to offsets[k + 1] of the first axis, zero where there are none."""
    counts = np.diff(offsets)
    sums = np.zeros((len(counts), *values.ints.shape[1:]), dtype=object)
    some = counts > 0
    if some.any():
        sums[some] = np.add.reduceat(values.ints, offsets[:-1][some], axis=0)
    return Exact(sums, values.exponent)


def _trailing_zeros(whole: ndarray) -> ndarray:
    """Number of zero bits at the end of each integer, 0 for 0."""
    lowest = whole & -whole
    return np.where(whole != 0, np.frexp(lowest.astype(float))[1] - 1, 0)


def _have_factors(D: ndarray, bits: int) -> Bool[ndarray, " K"]:
    """Which D are shown to be positive definite by Cholesky's method in whole numbers (docs/decisions/0010).

    S D S = L L' + d 2^bits I + E for a diagonal S of powers of two that brings the diagonal below 4^bits, and L
    rounded down: E is symmetric, E_ii >= 0 and 0 <= E_ij < 2^bits, so that d 2^bits I + E > 0 (Gershgorin). Up to
    30 bits in machine integers: |L_ij| < 2^31 is seen before it is squared, and sum_k L_ik^2 < 4^30 bounds the rest.
    """
    d = D.shape[-1]
    diagonal = np.diagonal(D, axis1=1, axis2=2)
    at = np.flatnonzero(_everywhere(diagonal > 0))
    lift = bits - (_bit_length(diagonal[at]) + 1) // 2
    T = _shifted(D[at], lift[:, :, None] + lift[:, None, :])
    if bits <= _MACHINE_BITS:
        clear = _everywhere(abs(T) < 4**bits)
        at, T = at[clear], T[clear].astype(np.int64)
    L = np.zeros_like(T)
    rest = np.diagonal(T, axis1=1, axis2=2) - (d << bits)
    keep = _everywhere(rest > 0)
    for j in range(d):
        if not keep.all():
            at, T, L, rest = at[keep], T[keep], L[keep], rest[keep]
        root = _root(rest[:, j])
        below = slice(j + 1, d)
        column = (T[:, below, j] - (L[:, below, :j] @ L[:, j, :j, None])[:, :, 0]) // root[:, None]
        keep = _everywhere(abs(column) < 2 << bits)
        column = np.where(keep[:, None], column, 0)
        rest[:, below] -= column * column
        keep &= _everywhere(rest[:, below] > 0)
        L[:, j, j], L[:, below, j] = root, column
    good = np.zeros(len(D), dtype=bool)
    good[at[keep]] = True
    return good


def _everywhere(x: ndarray) -> ndarray:
    """Which members of the first axis are true throughout."""
    return np.asarray(np.all(x, axis=tuple(range(1, x.ndim))), dtype=bool)


def _shifted(D: ndarray, by: ndarray) -> ndarray:
    """D 2^by, rounded down."""
    return np.asarray((D << np.maximum(by, 0).astype(object)) >> np.maximum(-by, 0).astype(object), dtype=object)


def _root(x: ndarray) -> ndarray:
    """The root of whole numbers, rounded down."""
    return np.asarray(np.frompyfunc(math.isqrt, 1, 1)(x), dtype=x.dtype)


def _bit_length(x: ndarray) -> ndarray:
    return np.asarray(np.frompyfunc(int.bit_length, 1, 1)(x), dtype=np.int64)
