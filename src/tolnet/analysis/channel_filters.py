"""DRKF and DRKF-SWF on data, and what filters over corrupted channels have in common.

A filter holds the estimates of all nodes (one, where it is centralised) in many runs, and the covariances that it
believes in: one path of channel noise in front, or one a run.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.analysis.corrupted_truth import CorruptedInstant
from tolnet.analysis.drkf import exchange, predict, step_second_moment, update
from tolnet.analysis.fusion_window import Fused, Received, SlidingWindow, fuse_current
from tolnet.model import CorruptedNetwork
from tolnet.model.corrupted import Instant


class Moment(NamedTuple):
    """What every filter may use in the step from k - 1 to k: the network at both, and bounds of the state."""

    before: Instant
    now: Instant
    noise: Float[ndarray, "n n"]
    """mu F Pi F' + Q of instant k - 1."""
    Pi: Float[ndarray, "n n"]
    """Pi_k."""


def moments(network: CorruptedNetwork, steps: int) -> list[Moment]:
    """The moments 1 to `steps`, which need no data, Lemma 3.1."""
    Pi, found = network.initial_second_moment, []
    for k in range(1, steps + 1):
        before = network.at(k - 1)
        noise = before.mu * (before.F @ Pi @ before.F.T) + before.Q
        Pi = step_second_moment(before, Pi)
        found.append(Moment(before, network.at(k), noise, Pi))
    return found


class ChannelFilter(ABC):
    """One filter in many runs, at some instant."""

    name: ClassVar[str]
    meaning: ClassVar[str]
    centralised: ClassVar[bool] = False

    x: Float[ndarray, "runs K n"]
    """Estimates."""
    P: Float[ndarray, "paths K n n"] | None
    """The filter's own covariance bounds, where it has any."""

    def __init__(self, network: CorruptedNetwork, runs: int) -> None:
        self.network = network
        K = 1 if self.centralised else network.N
        self.x = np.tile(network.initial_mean, (runs, K, 1))
        self.P = np.array(network.initial_covariance[None])
        if self.centralised:
            least = int(np.trace(network.initial_covariance, axis1=1, axis2=2).argmin())
            self.P = self.P[:, least : least + 1]

    @abstractmethod
    def step(self, moment: Moment, drawn: CorruptedInstant) -> None:
        """Go from instant k - 1 to k = drawn.k with everything that arrives in between."""


class Drkf(ChannelFilter):
    """Algorithm 1, eqs. (4)-(5)."""

    name = "DRKF"
    meaning = "distributed robust Kalman filter over corrupted channels, Algorithm 1"

    def step(self, moment: Moment, drawn: CorruptedInstant) -> None:
        self.x, self.P = self._fuse(drawn.k, self._exchange(moment, drawn))

    def _exchange(self, moment: Moment, drawn: CorruptedInstant) -> Received:
        """Prediction, update, and what every node then receives and inflates."""
        assert self.P is not None
        senders = self.network.pairs[:, 1]
        gain, P = update(moment.now, predict(moment.before.A, moment.noise, self.P), moment.Pi)
        x = correct(moment.now, self.x @ moment.before.A.T, gain, drawn.y)
        P = np.broadcast_to(P, (len(drawn.D), *P.shape[1:]))  # from the first channel noise on, paths differ
        return Received(x[:, senders] + drawn.e, exchange(self.network, moment.now, P, drawn.D))

    def _fuse(self, k: int, current: Received) -> Fused:
        return fuse_current(self.network, current)


class DrkfSwf(Drkf):
    """Algorithm 2: the same with a sliding window and the weights of eq. (17).

    `window` and `interval` (0: never) are one number, or one a node; the network's own without.
    """

    name = "DRKF-SWF"
    meaning = "the same with optimised fusion over a sliding window, Algorithm 2"

    def __init__(
        self,
        network: CorruptedNetwork,
        runs: int,
        window: int | Int[ndarray, " N"] | None = None,
        interval: int | Int[ndarray, " N"] | None = None,
    ) -> None:
        super().__init__(network, runs)
        length = network.window if window is None else window
        every = network.interval if interval is None else interval
        self.sliding = SlidingWindow(network, np.broadcast_to(length, network.N), np.broadcast_to(every, network.N))

    def step(self, moment: Moment, drawn: CorruptedInstant) -> None:
        self.sliding.propagate(moment.before.A, moment.noise)
        super().step(moment, drawn)

    def _fuse(self, k: int, current: Received) -> Fused:
        return self.sliding.fuse(k, current)


class WindowHistory(NamedTuple):
    """The covariances of DRKF-SWF over time, which need no data where the noise on matrices is given."""

    node_trace: Float[ndarray, "T1 N"]
    """tr P_{k,i}."""
    P: Float[ndarray, "N n n"]
    """At the end."""
    solved: dict[int, tuple[Int[ndarray, " d"], Float[ndarray, "d l"]]]
    """Of every node that solved, the last time: its rows of network.pairs, and the weights by age of what came."""
    solves: int
    fallbacks: int


def follow_window(
    network: CorruptedNetwork,
    steps: int,
    window: int | Int[ndarray, " N"] | None = None,
    interval: int | Int[ndarray, " N"] | None = None,
    *,
    step_done: Callable[[int], None] | None = None,
) -> WindowHistory:
    """Follow P_{k,i} of DRKF-SWF over `steps` steps with a clean channel, whose bounds are in force all the same.

    `window` and `interval` as in DrkfSwf; an interval of 0 is Algorithm 1.
    Source: eqs. (13)-(18); docs/mathematics.md, section 13.7.
    """
    each = DrkfSwf(network, 1, window, interval)
    E, n, M = len(network.pairs), network.n, int(network.rows[-1])
    nothing = np.zeros(n)[None], np.zeros((1, M)), np.zeros((1, E, n)), np.zeros((1, E, n, n))
    node_trace = np.empty((steps + 1, network.N))
    solved: dict[int, tuple[ndarray, ndarray]] = {}
    assert each.P is not None
    node_trace[0] = np.trace(each.P[0], axis1=1, axis2=2)
    for k, moment in enumerate(moments(network, steps), start=1):
        each.step(moment, CorruptedInstant(k, *nothing))
        node_trace[k] = np.trace(each.P[0], axis1=1, axis2=2)
        for group in each.sliding.solved:
            for number, node in enumerate(group.nodes.tolist()):
                if group.accepted[0, number]:
                    pairs = slice(group.degree[number])
                    solved[node] = group.pairs[number, pairs], group.weights[0, number, pairs]
        if step_done is not None:
            step_done(k)
    return WindowHistory(node_trace, each.P[0], solved, each.sliding.solves, each.sliding.fallbacks)


def correct(
    now: Instant,
    x: Float[ndarray, "runs N n"],
    gain: Float[ndarray, "paths M n"],
    y: Float[ndarray, "runs M"],
) -> Float[ndarray, "runs N n"]:
    """x_i + K_i (y_i - tau_i C_i x_i) at every node; gains transposed and packed like C."""
    x = x.copy()
    for nodes, C, _ in now.sensors.groups():
        rows = now.sensors.rows[nodes, None] + np.arange(C.shape[1])
        own = x[:, nodes]
        surprise = y[:, rows] - ((now.tau[nodes, None, None] * C) @ own[..., None])[..., 0]
        x[:, nodes] = own + (surprise[..., None, :] @ gain[:, rows])[..., 0, :]
    return x
