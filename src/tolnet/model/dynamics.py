"""How the errors of a network's filters move under the least favourable model, and how large they become."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.model.results import _ReadOnly
from tolnet.model.status import Status
from tolnet.model.worst_case import LeastFavourableModel

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

_ROUNDING = 1e-12
"""What couples states less than this part of the largest entry is rounding, if the network itself does not."""


@dataclass(frozen=True, eq=False, repr=False)
class ErrorDynamics(_ReadOnly):
    """How the errors of K filters and of the centre move under the least favourable model, eqs. (35)-(37):

        eta+ = F eta + G eps,   eta = [x~_1; ...; x~_K; e],   F = [[A, C], [0, A - G C + M H]].

    With U = W' (x) I, and the last block, numbered K, that of e, whose filter is the centre itself:

        (F eta)_k = sum_l w_lk (M_l eta_l + E_l T (A - G C) eta_e),        M_k = A (I + V_k S_k)^-1
        G G' = U (1 Q 1' + channels + E T E') U',                          E_k = Q + A Z_k S_k Z A'
        channels: block (k, j) is A Z_k S_kj Z_j A', S_kj the information that both k and j hear.

    G is the columns -A Z_k f over the nodes k that hear a sensor, for each column f of C' R^-1/2; B for all; E Y with
    T = Y Y'. K is N for diffusion filters and 1 for a centralised one, which mixes with nobody and hears everybody.
    Where `status` is neither `ok` nor `oscillates` there are no dynamics: the numbers are NaN, `reason` says why.
    Source: eqs. (35)-(37); docs/mathematics.md, section 7.
    """

    model: LeastFavourableModel
    loops: Float[ndarray, "K n n"]
    """M_k, the error loops of the filters before diffusion."""
    coupling: Float[ndarray, "K n n"]
    """E_k T (A - G C), how e drives each filter before diffusion."""
    least_favourable_loop: Float[ndarray, "n n"]
    """A - G C + M H."""
    mixing: sparse.csr_array
    """W', K x K; rows sum to one."""
    gains: Float[ndarray, "K1 n n"]
    """A Z_k, and A Z of the centre last."""
    hearing: sparse.csr_array
    """(K + 1, N): [k, l] is 1 where filter k uses sensor l; the centre, last, uses all."""
    channels: Float[ndarray, "c n"]
    """Each sensor's information as columns f: C_l' R_l^-1 C_l is the sum of its f f'."""
    owner: Int[ndarray, " c"]
    """The sensor of each channel."""
    process: Float[ndarray, "n m"]
    """B."""
    tilted: Float[ndarray, "K1 n r"]
    """E_k Y with T = Y Y', and N Y last."""
    status: Status
    reason: str

    @property
    def n(self) -> int:
        """Number of states of the plant."""
        return len(self.least_favourable_loop)

    @property
    def filters(self) -> int:
        """K."""
        return len(self.loops)

    @property
    def sensors(self) -> int:
        """N."""
        return self.model.network.N

    @property
    def dimension(self) -> int:
        """(K + 1) n."""
        return (self.filters + 1) * self.n

    @property
    def exists(self) -> bool:
        """Whether there are numbers."""
        return bool(np.isfinite(self.least_favourable_loop).all() and np.isfinite(self.loops).all())

    @property
    def columns(self) -> int:
        """Number of columns of G: measurement channels, process noise, correction of rank n."""
        return len(self.channels) + self.process.shape[1] + self.tilted.shape[2]

    def step(self, Y: Float[ndarray, "K1 n b"]) -> Float[ndarray, "K1 n b"]:
        """F Y for b vectors at once, blocks first."""
        K, n, b = self.filters, self.n, Y.shape[2]
        moved = np.matmul(self.loops, Y[:K]).reshape(K * n, b)
        moved += self.coupling.reshape(K * n, n) @ Y[K]
        following = np.empty_like(Y)
        following[:K] = (self.mixing @ moved.reshape(K, n * b)).reshape(K, n, b)
        following[K] = self.least_favourable_loop @ Y[K]
        return following

    def step_back(self, Y: Float[ndarray, "K1 n b"]) -> Float[ndarray, "K1 n b"]:
        """F' Y for b vectors at once, blocks first."""
        K, n, b = self.filters, self.n, Y.shape[2]
        unmixed = self._unmix(Y)[:K]
        following = np.empty_like(Y)
        following[:K] = self.loops.mT @ unmixed
        following[K] = self.least_favourable_loop.T @ Y[K]
        following[K] += self.coupling.reshape(K * n, n).T @ unmixed.reshape(K * n, b)
        return following

    def noise_columns(self, start: int, stop: int) -> Float[ndarray, "K1 n b"]:
        """Columns start..stop - 1 of G, blocks first: channels, then process noise, then the correction."""
        K, n, c = self.filters, self.n, len(self.channels)
        some = slice(start, min(stop, c))
        heard = self.hearing[:, self.owner[some]].toarray()
        parts = [-(self.gains @ self.channels[some].T) * heard[:, None, :]] if start < c else []
        if stop > c:
            m = self.process.shape[1]
            rest = np.concatenate([np.broadcast_to(self.process, (K + 1, n, m)), self.tilted], axis=2)
            parts.append(rest[:, :, max(start - c, 0) : stop - c])
        return self._mix(np.concatenate(parts, axis=2))

    def noise_product(self, Y: Float[ndarray, "K1 n b"]) -> Float[ndarray, "K1 n b"]:
        """G G' Y for b vectors at once, blocks first, from sums over who hears whom instead of columns."""
        K, n, b = self.filters, self.n, Y.shape[2]
        Y = self._unmix(Y)
        sent = (self.hearing.T @ (self.gains.mT @ Y).reshape(K + 1, n * b)).reshape(-1, n, b)
        sent = self._own_information @ sent
        heard = (self.hearing @ sent.reshape(-1, n * b)).reshape(K + 1, n, b)
        common = self.process @ (self.process.T @ Y.sum(axis=0))
        tilted = self.tilted.reshape((K + 1) * n, -1)
        correction = tilted @ (tilted.T @ Y.reshape(-1, b))
        return self._mix(self.gains @ heard + common + correction.reshape(K + 1, n, b))

    @cached_property
    def _own_information(self) -> Float[ndarray, "N n n"]:
        information = np.zeros((self.sensors, self.n, self.n))
        np.add.at(information, self.owner, self.channels[:, :, None] * self.channels[:, None, :])
        return information

    def _mix(self, Y: ndarray) -> ndarray:
        K = self.filters
        mixed = (self.mixing @ Y[:K].reshape(K, -1)).reshape(Y[:K].shape)
        return np.concatenate([mixed, Y[K:]])

    def _unmix(self, Y: ndarray) -> ndarray:
        K = self.filters
        unmixed = (self.mixing.T @ Y[:K].reshape(K, -1)).reshape(Y[:K].shape)
        return np.concatenate([unmixed, Y[K:]])

    def operator(self) -> LinearOperator:
        """F as a linear operator, with its transpose; nothing is formed."""
        from scipy.sparse.linalg import LinearOperator

        return self._operator(LinearOperator, self.step, self.step_back)

    def noise_operator(self) -> LinearOperator:
        """G G' as a linear operator; nothing is formed."""
        from scipy.sparse.linalg import LinearOperator

        return self._operator(LinearOperator, self.noise_product, self.noise_product)

    def _operator(self, kind, forward, backward) -> LinearOperator:
        blocks = (self.filters + 1, self.n, -1)

        def flat(apply):
            return lambda Y: apply(np.asarray(Y, dtype=float).reshape(blocks)).reshape(np.shape(Y))

        shape = (self.dimension, self.dimension)
        f, b = flat(forward), flat(backward)
        return kind(shape=shape, matvec=f, matmat=f, rmatvec=b, rmatmat=b, dtype=np.float64)

    def matrix(self) -> Float[ndarray, "d d"]:
        """F itself, dense: (K + 1) n squared numbers."""
        return self._dense(self.step)

    def noise_matrix(self) -> Float[ndarray, "d d"]:
        """G G' itself, dense."""
        product = self._dense(self.noise_product)
        return (product + product.T) / 2  # rounding only: the exact matrix is symmetric

    def _dense(self, apply) -> ndarray:
        d = self.dimension
        return apply(np.eye(d).reshape(self.filters + 1, self.n, d)).reshape(d, d)

    def sparse_matrix(self) -> sparse.csr_array:
        """F itself, sparse: blocks only where a weight, or the coupling to e, is not zero."""
        K, n = self.filters, self.n
        W = sparse.coo_array(self.mixing)
        network = sparse.coo_array(
            (
                (W.data[:, None, None] * self.loops[W.col]).ravel(),
                (
                    np.broadcast_to(W.row[:, None, None] * n + np.arange(n)[:, None], (W.nnz, n, n)).ravel(),
                    np.broadcast_to(W.col[:, None, None] * n + np.arange(n), (W.nnz, n, n)).ravel(),
                ),
            ),
            shape=(K * n, K * n),
        )
        coupling = (self.mixing @ self.coupling.reshape(K, n * n)).reshape(K * n, n)
        blocks = [[network, sparse.csr_array(coupling)], [None, sparse.csr_array(self.least_favourable_loop)]]
        return sparse.csr_array(sparse.block_array(blocks, format="csr"))

    def islands(self) -> list[Island]:
        """The parts that do not influence one another: groups of filters that mix, groups of states that are coupled.

        States are coupled where A, Q or a sensor's information couples them, directly or by way of others; the x, y
        and z of a tracked target often are not. What rounding put between groups is left out.
        """
        from scipy.sparse.csgraph import connected_components

        mixing, filters = connected_components(self.mixing, directed=False)
        network = self.model.network
        information = np.abs(network.own_information).max(axis=0)
        count, states = connected_components((network.A != 0) | (network.Q != 0) | (information > 0), directed=False)
        apart = states[:, None] != states
        matrices = (self.loops, self.coupling, self.least_favourable_loop, self.gains, self.model.tilt)
        if any(np.abs(X[..., apart]).max(initial=0.0) > _ROUNDING * np.abs(X).max() for X in matrices):
            count, states = 1, np.zeros_like(states)
        if mixing * count == 1:
            return [Island(np.arange(self.filters), np.arange(self.n), self)]
        return [self._island(k, i) for k in _groups(filters, mixing) for i in _groups(states, count)]

    def _island(self, filters: Int[ndarray, " k"], states: Int[ndarray, " i"]) -> Island:
        with_centre = np.append(filters, self.filters)
        channels = self.channels[:, states]
        heard = channels.any(axis=1)
        process = self.process[states]
        part = replace(
            self,
            loops=self.loops[np.ix_(filters, states, states)],
            coupling=self.coupling[np.ix_(filters, states, states)],
            least_favourable_loop=self.least_favourable_loop[np.ix_(states, states)],
            mixing=sparse.csr_array(self.mixing[filters][:, filters]),
            gains=self.gains[np.ix_(with_centre, states, states)],
            hearing=sparse.csr_array(self.hearing[with_centre]),
            channels=channels[heard],
            owner=self.owner[heard],
            process=process[:, process.any(axis=0)],
            tilted=self.tilted[np.ix_(with_centre, states, np.arange(self.tilted.shape[2]))],
        )
        return Island(filters, states, part)

    def rescaled(self, unit: Float[ndarray, " n"]) -> ErrorDynamics:
        """The same dynamics with every state counted in `unit`: x_i / unit_i."""
        ratio = unit / unit[:, None]
        return replace(
            self,
            loops=self.loops * ratio,
            coupling=self.coupling * ratio,
            least_favourable_loop=self.least_favourable_loop * ratio,
            gains=self.gains / (unit * unit[:, None]),
            channels=self.channels * unit,
            process=self.process / unit[:, None],
            tilted=self.tilted / unit[:, None],
        )

    def __repr__(self) -> str:
        return f"<ErrorDynamics {self.status}: {self.filters} filters, dimension {self.dimension}>"


class Island(NamedTuple):
    """Part of the dynamics that nothing else influences: some filters, and some states of theirs and of e."""

    filters: Int[ndarray, " k"]
    states: Int[ndarray, " i"]
    dynamics: ErrorDynamics


def _groups(label: ndarray, count: int) -> list[ndarray]:
    """The members of each label, in rising order."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])


@dataclass(frozen=True, eq=False, repr=False)
class Performance(_ReadOnly):
    """How well K filters estimate in the steady state: diagonal blocks of Q = F Q F' + G G', eq. (41).

    Node k's block is the covariance of x - x^_k under the least favourable model, its trace MSD_k, eq. (40).
    Where `status` is neither `ok` nor `oscillates` there is no answer: the numbers are NaN, except spectral radii
    that are known, and `reason` says why. With `oscillates` the numbers hold for gains frozen at the steady state,
    which the covariance recursion itself never reaches. Units: those of the state squared.
    """

    dynamics: ErrorDynamics
    method: str
    """What solved it: `projected`, `smith`, `scipy` or `slycot`."""
    status: Status
    reason: str
    blocks: Float[ndarray, "K n n"]
    least_favourable_block: Float[ndarray, "n n"]
    """Covariance of e, the error of the centralised robust filter."""
    network_radius: float
    """Spectral radius of the block of F that the filters and their weights make."""
    least_favourable_radius: float
    """Spectral radius of A - G C + M H."""
    residual: float
    """|F Q F' + G G' - Q| / |Q| in the Frobenius norm, recomputed; by random vectors where Q is not formed."""
    error_estimate: float
    """Estimated relative error of the worst MSD_k, from the residual and how far F amplifies it."""
    iterations: int
    """Steps of the iteration, or doublings."""
    rank: int
    """Dimension of the subspace of the slow modes (`projected`); 0 otherwise."""
    Q: Float[ndarray, "d d"] | None
    """The whole solution, for the methods that form it."""

    @property
    def node_msd(self) -> Float[ndarray, " K"]:
        """MSD_k, the trace of each filter's block."""
        return np.trace(self.blocks, axis1=1, axis2=2)

    @property
    def msd(self) -> float:
        """The mean of MSD_k over the network, eq. (40)."""
        return float(self.node_msd.mean())

    @property
    def msd_db(self) -> float:
        """10 log10 of the mean."""
        with np.errstate(divide="ignore"):  # minus infinity for nothing
            return float(10 * np.log10(self.msd))

    @property
    def spectral_radius(self) -> float:
        """Of the whole F."""
        return max(self.network_radius, self.least_favourable_radius)

    def __repr__(self) -> str:
        return f"<Performance {self.status}: MSD = {self.msd_db:.4f} dB, spectral radius {self.spectral_radius:.6f}>"
