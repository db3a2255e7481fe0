"""Which modes of the plant each node's sensors miss, and which the process noise does not reach.

A node misses a mode lambda of A when some x != 0 has A x = lambda x and C_l x = 0 for every l that it hears. The
covariances R_l have no part in that: a direction seen through a sensor a million times worse is seen.

`hidden_modes` decides one pair (A, C). Of a million nodes nearly all are decided before, by

1. structure: states that act on no heard row, at once for all nodes that hear rows of the same reach;
2. a screen in floating point: whoever sees every direction that A hardly moves, clearly, misses nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.analysis.exact_subspace import eigenvalues, rational
from tolnet.analysis.hidden_modes import ANY, CIRCLE, OUTSIDE, Mode, Region, hidden_modes, hides
from tolnet.analysis.state_units import UNIT, components, reachable, rounding, state_units, unit_rows
from tolnet.model import SensorNetwork

_RING = np.exp(2j * np.pi * np.arange(12) / 12)
_CLEAR = 1e4  # how much farther than an eigenvalue is uncertain the directions lie that the screen leaves out
_BLOCK = 2**22  # numbers in one stack of Gramians
_LEAST = 1e-100  # a radius for a plant of zeros, to which rounding does nothing


class _Missed(NamedTuple):
    """What each of K sets of nodes misses in a region."""

    visible: Bool[ndarray, "K n"]
    """States that act on some row that the set hears."""
    by_structure: Bool[ndarray, " K"]
    """Whether the other states have a mode in the region."""
    besides: Bool[ndarray, " K"]
    """Whether a mode of the visible states is hidden."""

    @property
    def nothing(self) -> Bool[ndarray, " K"]:
        """Sets that see every mode."""
        return ~self.by_structure & ~self.besides


@dataclass(frozen=True, eq=False)
class Detectability:
    """What is reached by the noise and seen by the sensors of a network. Nothing is looked for before it is asked."""

    network: SensorNetwork

    @cached_property
    def stabilisable(self) -> bool:
        """Whether the noise drives every mode on the unit circle, without which there is no stabilising solution."""
        return not hides(*self._driven, CIRCLE)

    @cached_property
    def undriven_outside(self) -> bool:
        """Whether the noise misses a mode outside the unit circle; then no filter meets it from P = 0."""
        return self.stabilisable and hides(*self._driven, OUTSIDE)

    @property
    def detectable(self) -> Bool[ndarray, " N"]:
        """Nodes that see every mode that does not decay."""
        return self._missed.nothing

    @property
    def centre_detectable(self) -> bool:
        """Whether all sensors together see every mode that does not decay."""
        return bool(self._centre_missed.nothing[0])

    @cached_property
    def observable(self) -> Bool[ndarray, " N"]:
        """Nodes that see every mode."""
        return _missed(self.network, self._heard, ANY).nothing

    @cached_property
    def centre_observable(self) -> bool:
        """Whether all sensors together see every mode."""
        return bool(_missed(self.network, self._everything, ANY).nothing[0])

    def offending(self, k: int | None) -> list[Mode]:
        """Modes that do not decay and that node k (None: the centre) misses."""
        network, at = self.network, k or 0
        missed = self._centre_missed if k is None else self._missed
        if missed.nothing[at]:
            return []
        rows = np.eye(network.n)[missed.visible[at]]
        if missed.besides[at]:
            heard = np.arange(network.N) if k is None else network.neighbours(k)
            rows = np.concatenate([network.C[network.rows[l] : network.rows[l + 1]] for l in heard.tolist()])
            rows = np.unique(rows, axis=0)
        key = rows.tobytes()
        if key not in self._modes:
            self._modes[key] = hidden_modes(network.A, rows, OUTSIDE)
        return self._modes[key]

    def offending_undriven(self) -> list[Mode]:
        """Modes on the unit circle that the noise does not drive."""
        return hidden_modes(*self._driven, CIRCLE)

    @cached_property
    def _modes(self) -> dict[bytes, list[Mode]]:
        """Those that were looked for, by the rows that miss them: many nodes miss the same."""
        return {}

    @cached_property
    def _missed(self) -> _Missed:
        return _missed(self.network, self._heard, OUTSIDE)

    @cached_property
    def _centre_missed(self) -> _Missed:
        return _missed(self.network, self._everything, OUTSIDE)

    @property
    def _driven(self) -> tuple[ndarray, ndarray]:
        """A' and B'. Q stands for B where only Q was given, since Q w = 0 where B' w = 0."""
        network = self.network
        return network.A.T, network.Q if network.B is None else network.B.T

    @property
    def _heard(self) -> sparse.csr_array:
        """N x N, which nodes each node hears."""
        return self.network.adjacency.T.astype(float).tocsr()

    @property
    def _everything(self) -> sparse.csr_array:
        return sparse.csr_array(np.ones((1, self.network.N)))


def detectability(network: SensorNetwork) -> Detectability:
    """Test (A, B) and every (A, C_k^loc), every eigenvalue by itself and in the units of the states.

    Assumes nothing. Where the doubles hide a subspace exactly, it is found exactly; else a mode counts as missed, and
    as being on the circle, where rounding cannot tell the plant from one of which that is true.
    Source: M. L. J. Hautus, Indag. Math. 31, 1969; docs/mathematics.md, section 3.3.
    """
    return Detectability(network)


def _missed(network: SensorNetwork, heard: sparse.csr_array, region: Region) -> _Missed:
    """What sets of nodes, one a row of `heard` (K, N), miss in the region."""
    A, K = network.A, _count(heard)
    blocks = _Blocks(A, region)
    found = _Missed(np.zeros((K, network.n), dtype=bool), np.zeros(K, dtype=bool), np.zeros(K, dtype=bool))
    for members, visible in _by_reach(network, heard):
        found.visible[members] = visible
        found.by_structure[members] = blocks.any_among(~visible)
        part = _Part.of(network, heard[members], np.flatnonzero(visible))
        besides = ~part.clearly_seen(region)
        for alike, rows in part.alike(np.flatnonzero(besides)):
            besides[alike] = hides(part.A, rows, region)
        found.besides[members] = besides
    return found


def _by_reach(
    network: SensorNetwork, heard: sparse.csr_array
) -> Iterator[tuple[Int[ndarray, " k"], Bool[ndarray, " n"]]]:
    """The members of `heard` whose rows are reached by the same states, and these states."""
    reached = ((network.C != 0).astype(float) @ reachable(network.A)) > 0
    owner = np.repeat(np.arange(network.N), np.diff(network.rows))
    by_node = np.zeros((network.N, network.n))
    np.maximum.at(by_node, owner, reached)
    visible = np.asarray(heard @ by_node) > 0
    patterns, which = np.unique(np.packbits(visible, axis=1), axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    ends = np.cumsum(np.bincount(which.ravel(), minlength=len(patterns)))[:-1]
    for members in np.split(order, ends):
        yield members, visible[members[0]]


class _Blocks:
    """The strong components of A, and which of them have an eigenvalue in the region."""

    def __init__(self, A: Float[ndarray, "n n"], region: Region) -> None:
        self._A, self._region = A, region
        self._label = components(A)
        self._known: dict[int, bool] = {}

    def any_among(self, states: Bool[ndarray, " n"]) -> bool:
        """Whether one of those that these states make up has."""
        return any(self._has(int(J)) for J in np.unique(self._label[states]))

    def _has(self, J: int) -> bool:
        if J not in self._known:
            own = np.flatnonzero(self._label == J)
            roots = eigenvalues(rational(self._A[np.ix_(own, own)]))
            self._known[J] = any(self._region.holds(root) for root in roots)
        return self._known[J]


class _Part(NamedTuple):
    """Sets of nodes with the same visible states, and the plant of these states."""

    A: Float[ndarray, "n n"]
    C: Float[ndarray, "m n"]
    rows: Int[ndarray, " U1"]
    """Offsets into C of the nodes that are heard."""
    heard: sparse.csr_array
    """K x U."""

    @classmethod
    def of(cls, network: SensorNetwork, heard: sparse.csr_array, kept: Int[ndarray, " n"]) -> _Part:
        """The part of the states `kept`, which alone act on the rows of the nodes heard."""
        used = np.unique(heard.indices)
        sizes = np.diff(network.rows)[used]
        rows = np.concatenate([[0], np.cumsum(sizes)])
        at = np.arange(rows[-1]) + np.repeat(network.rows[:-1][used] - rows[:-1], sizes)
        return cls(network.A[np.ix_(kept, kept)], network.C[np.ix_(at, kept)], rows, heard[:, used].tocsr())

    def alike(self, doubtful: Int[ndarray, " k"]) -> Iterator[tuple[list[int], Float[ndarray, "p n"]]]:
        """The doubtful sets that hear the same rows, and these rows."""
        if not doubtful.size:
            return
        distinct, which = np.unique(self.C, axis=0, return_inverse=True)
        groups: dict[bytes, list[int]] = {}
        for k in doubtful.tolist():
            nodes = self.heard.indices[self.heard.indptr[k] : self.heard.indptr[k + 1]]
            ids = np.unique(np.concatenate([which.ravel()[self.rows[l] : self.rows[l + 1]] for l in nodes]))
            groups.setdefault(ids.tobytes(), []).append(k)
        for ids, members in groups.items():
            yield members, distinct[np.frombuffer(ids, dtype=which.dtype)]

    def clearly_seen(self, region: Region) -> Bool[ndarray, " K"]:
        """Sets that see every mode in the region by far, whatever rounding did; of the others nothing is said.

        Let |x| = 1 and |(A - lambda) x| <= delta, |c x| <= eps for every row c, of length one; let r bound how far
        such a lambda is from a computed eigenvalue, and let the columns of E span the directions of the singular
        values of A - (that eigenvalue) I below tau. Then x = E a + (the rest), of which the rest is at most
        (delta + r) / tau =: q, and so is 1 - |a|; and sum |c E a|^2 <= p (q + eps)^2 for p rows.
        """
        n = len(self.A)
        seen = np.ones(_count(self.heard), dtype=bool)
        if n == 0:
            return seen
        d = state_units(self.A, _typical(self.C))
        A, C = self.A * (d / d[:, None]), unit_rows(unit_rows(self.C) * d)
        delta, eps = rounding(n) * n * float(np.linalg.norm(A)), rounding(n) * np.sqrt(n)
        p = self.heard @ np.diff(self.rows)
        for value in np.linalg.eigvals(A).astype(complex).tolist():
            r = _uncertainty(A, value, delta)
            if value.imag < 0 or (abs(value) + r < region.least - rounding(n)):
                continue
            E, tau = _hardly_moved(A, value, _CLEAR * (r + delta))
            enough = p * (2 * (delta + r) / tau + 2 * eps) ** 2 + 16 * p * (p + n) * UNIT
            seen &= self._smallest(C @ E) > enough
        return seen

    def _smallest(self, Y: Float[ndarray, "m q"] | ndarray) -> Float[ndarray, " K"]:
        """The smallest eigenvalue of the sum of y* y over the rows that each set hears."""
        q = Y.shape[1]
        owner = np.repeat(np.arange(len(self.rows) - 1), np.diff(self.rows))
        owned = sparse.csr_array((np.ones(len(owner)), (owner, np.arange(len(owner)))), (len(self.rows) - 1, len(Y)))
        parts = (Y.conj()[:, :, None] * Y[:, None, :]).reshape(-1, q * q)
        own = [owned @ np.real(parts), owned @ np.imag(parts)]
        found = []
        for start in range(0, _count(self.heard), step := max(1, _BLOCK // (q * q))):
            heard = self.heard[start : start + step]
            local = (heard @ own[0] + 1j * (heard @ own[1])).reshape(-1, q, q)
            found.append(np.linalg.eigvalsh(local if np.iscomplexobj(Y) else np.real(local))[:, 0])
        return np.concatenate(found)


def _count(heard: sparse.csr_array) -> int:
    """How many sets there are, one a row."""
    return len(heard.indptr) - 1


def _typical(C: Float[ndarray, "m n"]) -> Float[ndarray, "1 n"]:
    """A row of the geometric means of what is not zero of each column."""
    some = C != 0
    logs = np.log2(np.abs(C), where=some, out=np.zeros_like(C)).sum(axis=0) / np.maximum(some.sum(axis=0), 1)
    return np.where(some.any(axis=0), np.exp2(logs), 0.0)[None]


def _uncertainty(A: ndarray, value: complex, delta: float) -> float:
    """A radius about an eigenvalue where A - z I is farther than 2 delta from singular: no change by delta leads out.

    Doubled until the smallest singular value, which moves no faster than z, is large enough on a ring of points.
    """
    r, eye = max(4 * delta, _LEAST), np.eye(len(A))
    while r < 1:
        ring = A - (value + r * _RING)[:, None, None] * eye
        if np.linalg.svd(ring, compute_uv=False)[:, -1].min() > 2 * delta:
            return r
        r *= 4
    return np.inf


def _hardly_moved(A: ndarray, value: complex, least: float) -> tuple[ndarray, float]:
    """An orthonormal basis of the directions of small singular values of A - value I, and the least of the others.

    The others are at least `least`; none is left where no singular value is.
    """
    n = len(A)
    M = A - (value if value.imag else value.real) * np.eye(n)
    _, sizes, Vh = np.linalg.svd(M)
    m = min(max(int((sizes < least).sum()), 1), n)
    return Vh[n - m :].conj().T, float(sizes[n - m - 1]) if m < n else np.inf
