"""The modes of a plant that a set of rows does not see, each by itself: exactly, and up to rounding.

    A x = lambda x,   C x = 0,   x != 0                             Popov, Belevitch, Hautus (Indag. Math. 31, 1969)

1. What the doubles hide exactly is found exactly: the unobservable subspace N and its eigenvalues.
2. Modulo N, a mode is hidden up to rounding if a plant that rounding cannot tell from this one hides it: some x and
   lambda in question with |A x - lambda x| <= t E |x| and |C x| <= t F |x|, entry by entry, where E and F hold the
   norm of the block of A (the piece of the row of C) that each entry belongs to. By Oettli and Prager (1964) such x
   and lambda are exact for matrices within t E and t F, a witness that is checked and not a matter of conditions.

Blocks are those of the strong components, so that zeros stay zeros and a coupling however small is one; inside a
component, where a turned basis leaves rounding, size is that of the whole block, and t is the rounding of a matrix as
large as the larger of the two components. None of it depends on units.
Source: docs/mathematics.md, section 3.3.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.exact_subspace import (
    Eigenvalue,
    ExactSubspace,
    eigenspace,
    eigenvalues,
    generalised_eigenspace,
    to_doubles,
    unobservable,
)
from tolnet.analysis.state_units import block_norms, components, rounding, state_units, unit_rows

_REACH = 0.5  # farther from the region no eigenvalue of a matrix of up to 50 states is brought by rounding
_PATIENCE = 4  # steps without gain
_WIDEST = 1e-100  # what is allowed of a row, against the others, that no weight goes beyond
_SAME, _ALIKE = 1e-6, 1e-3  # eigenvalues found twice agree to the first; nearly defective ones to the second
_CARRIES = 1e-6  # a state whose share of a direction is below this, in its units, does not carry it


@dataclass(frozen=True)
class Region:
    """The eigenvalues in question: least <= |lambda| <= most."""

    least: float
    most: float

    def holds(self, root: Eigenvalue) -> bool:
        """Whether an eigenvalue lies there, up to rounding."""
        return self.least - 1 - root.margin <= root.excess <= self.most - 1 + root.margin

    def nearest(self, value: complex) -> complex | None:
        """The nearest number of the region; None where rounding could not have brought it so far."""
        modulus = abs(value)
        wanted = min(max(modulus, self.least), self.most)
        if wanted == modulus:
            return value
        return value * (wanted / modulus) if abs(wanted - modulus) <= _REACH else None


ANY = Region(0.0, np.inf)
OUTSIDE = Region(1.0, np.inf)
"""On or outside the unit circle: what does not decay."""
CIRCLE = Region(1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Mode:
    """An eigenvalue of A and what is not seen (or not driven) of it."""

    eigenvalue: complex
    direction: ndarray
    """An eigenvector of length one, (n,), complex where the eigenvalue is."""
    states: tuple[int, ...]
    """The states that carry what is not seen of the mode."""

    @property
    def modulus(self) -> float:
        """|lambda|."""
        return abs(self.eigenvalue)

    def __str__(self) -> str:
        value = self.eigenvalue
        return f"{value.real:.6g}" if value.imag == 0 else f"{value.real:.6g} ± {abs(value.imag):.6g}i"


def hidden_modes(
    A: Float[ndarray, "n n"], C: Float[ndarray, "p n"], region: Region, *, error: float = 0.0
) -> list[Mode]:
    """The modes of A in the region that no row of C sees, conjugates once, largest modulus first within each kind.

    `error` is what the rows of C are off by, relative to their pieces; rounding is allowed for besides. Modes that
    A' and B' give are those that B does not drive.
    """
    C = C[C.any(axis=1)]
    exactly = unobservable(A, C)
    found = [] if exactly is None else [_exact_mode(exactly, root) for root in _hidden_roots(exactly, region)]
    near = _Near.of(A, C, exactly, error)
    return found + [near.mode(value, y) for value, y in near.witnesses(region)]


def hides(A: Float[ndarray, "n n"], C: Float[ndarray, "p n"], region: Region) -> bool:
    """Whether C misses a mode of A in the region."""
    C = C[C.any(axis=1)]
    exactly = unobservable(A, C)
    if exactly is not None and _hidden_roots(exactly, region):
        return True
    return next(_Near.of(A, C, exactly, 0.0).witnesses(region), None) is not None


def _hidden_roots(exactly: ExactSubspace, region: Region) -> list[Eigenvalue]:
    return [root for root in eigenvalues(exactly.A_N) if region.holds(root)]


def _exact_mode(exactly: ExactSubspace, root: Eigenvalue) -> Mode:
    carried = exactly.lifted(generalised_eigenspace(exactly.A_N, root)).any(axis=1)
    states = tuple(np.flatnonzero(carried).tolist())
    if root.factor.degree() == 1:
        return Mode(root.value, _unit(exactly.lifted(eigenspace(exactly.A_N, root))[:, 0]), states)
    A_N = to_doubles(exactly.A_N)
    d = state_units(A_N, np.empty((0, len(A_N))))
    value = root.value if root.value.imag else root.value.real
    _, _, Vh = np.linalg.svd(A_N * (d / d[:, None]) - value * np.eye(len(A_N)))
    return Mode(root.value, _unit(np.where(carried, exactly.X @ (d * Vh[-1].conj()), 0.0)), states)


@dataclass(frozen=True, eq=False)
class _Near:
    """A pair (A, C) in its units, and the sizes that rounding is measured against."""

    A: Float[ndarray, "n n"]
    C: Float[ndarray, "p n"]
    d: Float[ndarray, " n"]
    kept: ndarray
    """Which states of the whole plant these are."""
    whole: int
    """How many states the whole plant has."""
    error: float

    @classmethod
    def of(cls, A: ndarray, C: ndarray, exactly: ExactSubspace | None, error: float) -> _Near:
        """The pair modulo what is hidden exactly."""
        whole, kept = len(A), np.arange(len(A))
        if exactly is not None:
            A, C, kept = exactly.quotient(A), C[:, exactly.rest], exactly.rest
        C = unit_rows(C)
        d = state_units(A, C)
        return cls(A * (d / d[:, None]), unit_rows(C * d), d, kept, whole, error)

    @cached_property
    def label(self) -> ndarray:
        """The component of every state."""
        return components(self.A)

    @cached_property
    def allowed(self) -> Float[ndarray, "np n"]:
        """t E over t F."""
        rows = block_norms(self.A, self.label)
        blocks = np.zeros((rows.shape[1], rows.shape[1]))
        np.add.at(blocks, self.label, rows**2)
        t = np.array([rounding(int(m)) for m in np.bincount(self.label)])[self.label]
        E = np.sqrt(blocks)[np.ix_(self.label, self.label)]
        F = block_norms(self.C, self.label)[:, self.label]
        return np.concatenate([np.maximum.outer(t, t) * E, (t + self.error) * F])

    def witnesses(self, region: Region) -> Iterator[tuple[complex, ndarray]]:
        """Eigenvalues in the region and directions y that a plant within rounding hides."""
        starts = [
            value
            for J in range(int(self.label.max(initial=-1)) + 1)
            for value in np.linalg.eigvals(self.A[np.ix_(self.label == J, self.label == J)])
        ]
        found: list[tuple[complex, ndarray]] = []
        for value in sorted(starts, key=lambda value: -abs(value)):
            start = region.nearest(complex(value)) if value.imag >= 0 else None
            if start is None:
                continue
            witness = self._seek(start, region)
            if witness is not None and not any(_same(witness, other) for other in found):
                found.append(witness)
                yield witness

    def _seek(self, value: complex, region: Region) -> tuple[complex, ndarray] | None:
        """Newton's method for a zero of the smallest singular value s of M = W [A - lambda I; C], by lambda.

        With M x = s u and u* W [x; 0] = g, s becomes |s - g dlambda| to first order. The rows are weighed anew by
        what is allowed of them at the last x, and the search ends where nothing is gained.
        """
        n = len(self.A)
        size, best, patience = self.allowed.sum(axis=1), np.inf, _PATIENCE
        while patience:
            value = value if value.imag else value.real
            M = np.concatenate([self.A - value * np.eye(n), self.C])
            weight = size.max() / np.maximum(size, _WIDEST * size.max())
            U, s, Vh = np.linalg.svd(weight[:, None] * M, full_matrices=False)
            x = Vh[-1].conj()
            size, left = self.allowed @ np.abs(x), np.abs(M @ x)
            if (left <= size).all():
                return complex(value), x
            worst = float((left[left > 0] / np.maximum(size[left > 0], _WIDEST * size.max())).max())
            best, patience = (worst, _PATIENCE) if worst < best / 2 else (best, patience - 1)
            slope = complex(np.vdot(U[:n, -1], weight[:n] * x))
            step = complex(s[-1]) / slope if abs(slope) * _REACH > s[-1] else _REACH
            nearest = region.nearest(complex(value) + step)
            if nearest is None:
                return None
            value = nearest
        return None

    def mode(self, value: complex, y: ndarray) -> Mode:
        """A witness as a mode of the whole plant."""
        value = complex(value.real, abs(value.imag))
        states = self.kept[np.abs(y) > _CARRIES * np.abs(y).max()]
        x = np.zeros(self.whole, dtype=y.dtype)
        x[self.kept] = self.d * y
        return Mode(value, _unit(x), tuple(states.tolist()))


def _same(one: tuple[complex, ndarray], other: tuple[complex, ndarray]) -> bool:
    """Whether two witnesses are of one mode: next to a defective one, eigenvalues are known to few digits."""
    apart = abs(one[0] - other[0])
    return apart <= _SAME or (apart <= _ALIKE and bool(abs(np.vdot(one[1], other[1])) >= 1 - _ALIKE))


def _unit(x: ndarray) -> ndarray:
    """The vector with length one, real where it is a multiple of a real one."""
    x = x / np.linalg.norm(x / np.abs(x).max()) / np.abs(x).max()
    turned = x * np.conj(x[np.abs(x).argmax()]) / np.abs(x).max()
    return np.real(turned) if not np.imag(turned).any() else turned
