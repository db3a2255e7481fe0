"""Exact arithmetic on stacks of matrices of doubles: Python integers in NumPy arrays, with one power of two for all.

Doubles are m 2^e, so sums and products of them are integers times a power of two; nothing is rounded, and every
operation runs over the whole stack.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped
from numpy import ndarray

_MANTISSA = 53
_ELIMINATED_UP_TO = 16
"""Sizes up to which definiteness is decided by elimination alone; the integers grow with every step of it."""
_CONGRUENCE_BITS = 40


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
        """Which members of a stack of symmetric matrices are positive definite: decided exactly up to size 16.

        Larger ones are transformed to L D L' near the identity first, whose dominant diagonal proves them definite;
        where it does not dominate, elimination decides.
        """
        d = self.ints.shape[-1]
        flat = self.ints.reshape(-1, d, d)
        if d <= _ELIMINATED_UP_TO:
            return _eliminates(flat).reshape(self.ints.shape[:-2])
        answers = [_dominates(Exact(D, self.exponent)) or bool(_eliminates(D[None])[0]) for D in flat]
        return np.array(answers, dtype=bool).reshape(self.ints.shape[:-2])


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


def _eliminates(D: ndarray) -> Bool[ndarray, " K"]:
    """Fraction-free elimination (E. H. Bareiss, Math. Comp. 22, 1968): pivots are leading principal minors."""
    D = D.copy()
    good = np.ones(len(D), dtype=bool)
    previous = np.full(len(D), 1, dtype=object)
    d = D.shape[-1]
    for j in range(d):
        pivot = D[:, j, j]
        positive = np.asarray(pivot > 0, dtype=bool)
        good[good] = positive
        D, pivot, previous = D[positive], pivot[positive], previous[positive]
        rest = slice(j + 1, d)
        crossed = D[:, rest, rest] * pivot[:, None, None] - D[:, rest, j, None] * D[:, None, j, rest]
        D[:, rest, rest] = crossed // previous[:, None, None]
        previous = pivot
    return good


def _dominates(D: Exact) -> bool:
    """Whether L D L' is strictly diagonally dominant with a positive diagonal for a rounded L near chol(D)^-1.

    Then L D L' is positive definite (Gershgorin), so L is regular and D definite too. L need not be accurate.
    """
    approximate = D.rounded()
    scale = np.sqrt(np.maximum(np.diagonal(approximate), 0))
    if not (scale > 0).all() or not np.isfinite(approximate).all():
        return False
    try:
        L = np.linalg.inv(np.linalg.cholesky(approximate / scale[:, None] / scale)) / scale
    except np.linalg.LinAlgError:
        return False
    size = np.exp2(np.ceil(np.log2(np.abs(L).max(axis=1, keepdims=True))))
    L = np.tril(np.round(L / size * 2.0**_CONGRUENCE_BITS) * 2.0**-_CONGRUENCE_BITS * size)
    E = (Exact.of(L) @ D @ Exact.of(L).T).ints
    diagonal = np.diagonal(E)
    others = abs(E).sum(axis=1) - abs(diagonal)
    return bool((diagonal > others).all())
