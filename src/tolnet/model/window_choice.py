"""What was chosen for the sliding window of every node, and what else could have been."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.model.corrupted import CorruptedNetwork
from tolnet.model.errors import UnsupportedError
from tolnet.model.results import _ReadOnly

NEVER = 10**9
"""An interval beyond any horizon: a problem file has no other word for Algorithm 1."""


class WindowPoint(NamedTuple):
    """A window length and an interval for every node: what it costs, and what it gives."""

    windows: Int[ndarray, " N"]
    """L; 1 where a node never solves."""
    intervals: Int[ndarray, " N"]
    """Delta; 0 is never, Algorithm 1."""
    solves: float
    """Fusion problems per second and node, the mean (per step, where the problem does not say how long one is)."""
    bytes: int
    """Per link and step: the pairs that a node keeps of a neighbour, each of which is carried along every step; the
    most of any node."""
    node_trace: Float[ndarray, " N"]
    """Mean of tr P_{k,i} over the second half of the horizon."""
    on_front: bool
    """Whether nothing else costs at most as much in both ways and gives less."""
    affordable: bool
    """Whether every node is within the budget."""

    @property
    def window(self) -> int:
        """The longest of any node."""
        return int(self.windows.max())

    @property
    def interval(self) -> int:
        """The shortest of those nodes that solve; 0 where none does."""
        return int(self.intervals[self.intervals > 0].min(initial=NEVER)) if self.solving else 0

    @property
    def solving(self) -> int:
        """How many nodes ever solve."""
        return int((self.intervals > 0).sum())

    @property
    def trace(self) -> float:
        """Mean over the nodes."""
        return float(self.node_trace.mean())


def solve_rates(network: CorruptedNetwork, interval: Int[ndarray, " N"]) -> Float[ndarray, " N"]:
    """Fusion problems per second at every node; per step, where the problem does not say how long a step is."""
    per = np.where(interval > 0, interval, np.inf) * (network.dt or 1.0)
    return 1 / per


class KeptPair(NamedTuple):
    """One of the pairs that a node fuses."""

    sender: int
    age: int
    """How many instants ago it came."""
    weight: float


@dataclass(frozen=True, eq=False, repr=False)
class WindowChoice(_ReadOnly):
    """Window length and interval of every node, for a budget; traces are means over the second half of `steps`."""

    network: CorruptedNetwork
    budget: Mapping[str, float]
    """`solves` per second at a node, `bytes` per link and step; what is missing is not limited."""
    window: Int[ndarray, " N"]
    interval: Int[ndarray, " N"]
    """0 is never: Algorithm 1."""
    node_trace: Float[ndarray, " N"]
    """Of tr P_{k,i}, all nodes running what was chosen."""
    weights: tuple[tuple[KeptPair, ...], ...]
    """Of every node at the last instant at which it solved; those of Algorithm 1 where it never did."""
    front: tuple[WindowPoint, ...]
    """Everything that was tried with all nodes alike, Algorithm 1 first."""
    mixtures: tuple[WindowPoint, ...]
    """What was tried node by node, from the most solves to the fewest."""
    steps: int
    solves: int
    """Fusion problems that were solved in all these steps, by all nodes together."""
    fallbacks: int
    """How many of the solves Algorithm 1 had to answer, since the weights failed a check."""

    @property
    def trace(self) -> float:
        """Mean over the nodes."""
        return float(self.node_trace.mean())

    @property
    def plain(self) -> WindowPoint:
        """Algorithm 1."""
        return self.front[0]

    @property
    def rate(self) -> float:
        """Fusion problems per second (or step), the mean over nodes."""
        return float(solve_rates(self.network, self.interval).mean())

    @property
    def gain(self) -> float:
        """The part of Algorithm 1's trace that is saved."""
        return 1 - self.trace / self.plain.trace

    def designed(self) -> CorruptedNetwork:
        """The network with these windows in it, which has one length for all nodes, and intervals a node.

        Raises UnsupportedError where nodes that solve keep different lengths; `common_window` keeps them alike.
        """
        lengths = np.unique(self.window[self.interval > 0]).tolist() or [1]
        if len(lengths) > 1:
            raise UnsupportedError(f"nodes keep windows of {lengths} instants; a problem file has one for all")
        return self.network.replaced(window=lengths[0], interval=np.where(self.interval, self.interval, NEVER))

    def method(self, i: int) -> str:
        """Which filter node i runs."""
        return "DRKF-SWF" if self.interval[i] else "DRKF"

    def __repr__(self) -> str:
        lengths, every = np.unique(self.window[self.interval > 0]), np.unique(self.interval)
        return f"<WindowChoice: L in {lengths.tolist()}, every {every.tolist()} steps, trace {self.trace:.6g}>"
