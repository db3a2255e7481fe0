"""The sliding window of Algorithm 2: what nodes keep of what they received, and how they fuse all of it.

For each pair (i, j) and each s of the last L instants, carried along open loop to the present, eqs. (13)-(14):

    x_check_{t+1|s} = A_t x_check_{t|s},   P_check_{t+1|s} = A_t P_check_{t|s} A_t' + mu_t F_t Pi_t F_t' + Q_t

At instants that its interval divides, a node fuses all of them with the weights of eq. (17), else the current ones
with a_ij (Algorithm 1). Covariances have one path of channel
noise in front, or one a run. Source: eqs. (13)-(18); docs/mathematics.md, 13.7.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from tolnet.analysis.drkf import sum_by_receiver
from tolnet.analysis.fusion_weights import solve_fusion_weights
from tolnet.analysis.stacked import symmetric_part
from tolnet.model import CorruptedNetwork

_ENOUGH = 32
"""Problems that make a stack worth its calls; a smaller one takes in nodes of other degrees."""


class Received(NamedTuple):
    """The pairs of one instant s, carried along to the present, one a row of `network.pairs`."""

    x: Float[ndarray, "runs E n"]
    P: Float[ndarray, "paths E n n"]


class Fused(NamedTuple):
    """What every node makes of them."""

    x: Float[ndarray, "runs N n"]
    P: Float[ndarray, "paths N n n"]


class Solved(NamedTuple):
    """The weights that some nodes found."""

    nodes: Int[ndarray, " K"]
    degree: Int[ndarray, " K"]
    """How many of the d slots of each are pairs; the others are empty, and have no weight."""
    pairs: Int[ndarray, "K d"]
    """The rows of `network.pairs` of each."""
    weights: Float[ndarray, "paths K d l"]
    """Of the pair that came so many instants ago; l = 0 is the current one."""
    accepted: Bool[ndarray, "paths K"]
    """False where the weights failed a check, and Algorithm 1 took over."""


def fuse_current(network: CorruptedNetwork, current: Received) -> Fused:
    """Algorithm 1: P_i = (sum_j a_ij P_check_ij^-1)^-1, x_i = P_i sum_j a_ij P_check_ij^-1 x_check_ij."""
    weighted = network.fusion.data[:, None, None] * np.linalg.inv(current.P)
    P = symmetric_part(np.linalg.inv(sum_by_receiver(network, weighted)))
    total = sum_by_receiver(network, weighted @ current.x[..., None])
    return Fused((P @ total)[..., 0], P)


class SlidingWindow:
    """What all nodes keep, and the fusion over it. `window` and `interval` per node; an interval of 0 is never."""

    def __init__(self, network: CorruptedNetwork, window: Int[ndarray, " N"], interval: Int[ndarray, " N"]) -> None:
        if window.min() < 1 or interval.min() < 0:
            raise ValueError("a window is at least 1 and an interval at least 0")
        self.network, self.window, self.interval = network, window, interval
        self.kept: list[Received] = []
        self.solved: list[Solved] = []
        """Of the last instant."""
        self.solves = self.fallbacks = 0

    def propagate(self, A: Float[ndarray, "n n"], noise: Float[ndarray, "n n"]) -> None:
        """One instant older: eqs. (13)-(14) with A, mu F Pi F' + Q of the instant that ends."""
        longest = int(self.window.max())
        self.kept = [
            Received(pair.x @ A.T, symmetric_part(A @ pair.P @ A.T + noise)) for pair in self.kept[: longest - 1]
        ]

    def fuse(self, k: int, current: Received) -> Fused:
        """Keep what was received at instant k, and fuse."""
        self.kept.insert(0, current)
        fused, self.solved = fuse_current(self.network, current), []
        for nodes, length in self._groups(k, len(current.P)):
            self._solve(nodes, min(length, len(self.kept)), fused)
        return fused

    def _groups(self, k: int, paths: int) -> Iterator[tuple[Int[ndarray, " K"], int]]:
        """The nodes that solve at instant k together, and how long they keep pairs: about as many pairs each."""
        due = (self.interval > 0) & (k % np.maximum(self.interval, 1) == 0)
        degree = np.diff(self.network.fusion.indptr)
        for length in np.unique(self.window[due]).tolist():
            nodes = np.flatnonzero(due & (self.window == length))
            nodes = nodes[np.argsort(degree[nodes], kind="stable")]
            first = 0
            for end in np.flatnonzero(np.diff(degree[nodes], append=0)) + 1:
                if (end - first) * paths >= _ENOUGH or end == len(nodes):
                    yield nodes[first:end], length
                    first = end

    def _solve(self, nodes: Int[ndarray, " K"], length: int, fused: Fused) -> None:
        """Eqs. (15)-(17) at some nodes; `fused` is written where the weights are accepted."""
        network = self.network
        start, degree = network.fusion.indptr[nodes].astype(np.int64), np.diff(network.fusion.indptr)[nodes]
        d = int(degree.max())
        there = np.arange(d) < degree[:, None]
        rows = start[:, None] + np.where(there, np.arange(d), 0)  # a slot without a pair: no information, no weight
        P = np.stack([pair.P[:, rows] for pair in self.kept[:length]], axis=2)  # paths, K, length, d, n, n
        x = np.stack([pair.x[:, rows] for pair in self.kept[:length]], axis=2)
        paths, K, n = len(P), len(nodes), network.n
        information = np.where(there[:, None, :, None, None], symmetric_part(np.linalg.inv(P)), 0.0)
        information = information.reshape(paths, K, length * d, n, n)
        reference = np.zeros((paths, K, length, d))
        reference[:, :, 0] = np.where(there, network.fusion.data[rows], 0.0)
        found = solve_fusion_weights(information, reference.reshape(paths, K, length * d))
        self.solves += paths * K
        self.fallbacks += int((~found.ok).sum())
        weighted = np.where(found.ok[..., None], found.weights, 0.0)[..., None, None] * information
        total = (weighted @ x.reshape(len(x), K, length * d, n, 1)).sum(axis=2)[..., 0]
        better = np.where(found.ok[..., None, None], found.covariance, fused.P[:, nodes])
        fused.P[:, nodes] = better
        fused.x[:, nodes] = np.where(found.ok[..., None], (better @ total[..., None])[..., 0], fused.x[:, nodes])
        weights = np.moveaxis(found.weights.reshape(paths, K, length, d), 2, 3)
        self.solved.append(Solved(nodes, degree, rows, weights, found.ok))
