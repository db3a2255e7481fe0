"""Which nodes should solve: one after the other is credited with what its own solves bring.

With all nodes alike every node looks as good as its neighbours make it. So, from all nodes alike,

    thin out   take the solves from the node, or lengthen the interval of the node, whose loss is least for the solves
               that it saves; again and again, until nobody solves. A loss grows as others stop solving (nobody else
               makes up for it), so the loss at an earlier stage bounds the present one from below: only what looks
               best is followed again (lazy greedy)
    exchange   what a node has for what a neighbour has, as long as the trace falls; then save what can be saved. In
               networks of more than 12 nodes both end when a number of runs is spent

Every loss is that of covariances that were followed, none is estimated. Greedy choices are no proof of the best one.
Source: docs/mathematics.md, section 13.9; docs/decisions/0026-window-search.md.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from tolnet.analysis.channel_filters import WindowHistory, follow_window
from tolnet.model import CorruptedNetwork
from tolnet.model.window_choice import WindowPoint

_SMALL = 12
"""Nodes up to which any two are exchanged and intervals are lengthened step by step; beyond, neighbours, and off."""
_LEAST_GAIN = 1e-9
"""Relative decrease of the trace that is more than the rounding of the weights' solver."""

Makes = Callable[[Int[ndarray, " N"], Int[ndarray, " N"], ndarray], WindowPoint]
"""The point of a window and an interval a node, with the traces that were followed."""


@dataclass(eq=False)
class Trials:
    """Everything that was followed, each choice once."""

    network: CorruptedNetwork
    steps: int
    make: Makes
    most: int
    """Runs after which large networks are improved no further."""
    followed: Callable[[], None]
    """Called after each run."""
    _seen: dict[bytes, WindowPoint] = field(default_factory=dict)

    @property
    def mixtures(self) -> list[WindowPoint]:
        """What was followed with nodes that are not all alike."""
        mixed = [np.ptp(point.windows) > 0 or np.ptp(point.intervals) > 0 for point in self._seen.values()]
        return [point for point, differ in zip(self._seen.values(), mixed, strict=True) if differ]

    @property
    def spent(self) -> bool:
        """Whether a large network had its runs."""
        return self.network.N > _SMALL and len(self._seen) >= self.most

    def at(self, windows: Int[ndarray, " N"], intervals: Int[ndarray, " N"]) -> WindowPoint:
        """Follow it, unless it was. A node that never solves keeps one pair."""
        windows = np.where(intervals > 0, windows, 1)
        key = np.concatenate([windows, intervals]).tobytes()
        if key not in self._seen:
            history = follow_window(self.network, self.steps, windows, intervals)
            self._seen[key] = self.make(windows, intervals, late(history))
            self.followed()
        return self._seen[key]


def late(history: WindowHistory) -> ndarray:
    """The mean of every node's trace over the second half."""
    return history.node_trace[len(history.node_trace) // 2 :].mean(axis=0)


def thin_out(trials: Trials, start: WindowPoint, intervals: Sequence[int]) -> Iterator[WindowPoint]:
    """From `start` to Algorithm 1, one node's solves less each time: the least loss for what it saves."""
    small = trials.network.N <= _SMALL
    longer = dict(pairwise(intervals)) if small else {}
    here, stage = start, 0
    heap: list[tuple[float, int, int, int]] = []
    """(loss for each solve saved, the stage at which it was found, node, its new interval)."""
    for i in np.flatnonzero(start.intervals).tolist():
        for interval in _steps(longer, int(start.intervals[i])):
            heapq.heappush(heap, (0.0, -1, i, interval))
    while heap:
        loss, found_at, i, interval = heapq.heappop(heap)
        now = int(here.intervals[i])
        if not now or 0 < interval <= now:
            continue  # of an interval that the node no longer has
        there = trials.at(here.windows, _with(here.intervals, i, interval))
        if found_at < stage:
            lost = there.trace - here.trace
            lost = 0.0 if lost <= _LEAST_GAIN * here.trace else lost
            loss = lost / (1 / now - (1 / interval if interval else 0.0))
            if heap and loss > heap[0][0]:
                heapq.heappush(heap, (loss, stage, i, interval))
                continue
        here, stage = there, stage + 1
        for later in _steps(longer, interval) if interval else []:
            heapq.heappush(heap, (0.0, -1, i, later))
        yield here


def lengthen(trials: Trials, path: Sequence[WindowPoint], intervals: Sequence[int]) -> list[WindowPoint]:
    """The nodes that solve at each stage of a path with every interval, alike: in small networks, for the front."""
    if trials.network.N > _SMALL:
        return []
    stages = {(point.intervals > 0).tobytes(): point for point in path if point.solving}
    return [
        trials.at(point.windows, np.where(point.intervals > 0, interval, 0))
        for point in stages.values()
        for interval in intervals
    ]


def exchange(trials: Trials, start: WindowPoint) -> WindowPoint:
    """Two nodes' choices for each other, as long as that lowers the trace and runs are left; it costs the same."""
    network, here = trials.network, start
    improved = True
    while improved and not trials.spent:
        improved = False
        for i, j in _pairs(network):
            if trials.spent:
                break
            if here.windows[i] == here.windows[j] and here.intervals[i] == here.intervals[j]:
                continue
            order = np.arange(network.N)
            order[[i, j]] = j, i
            there = trials.at(here.windows[order], here.intervals[order])
            if there.trace < here.trace * (1 - _LEAST_GAIN):
                here, improved = there, True
    return here


def save(
    trials: Trials, start: WindowPoint, good: Callable[[WindowPoint], bool], pairs: Iterable[tuple[int, int]]
) -> WindowPoint:
    """Node by node the cheapest of some pairs (L, Delta), fewest solves first, with which the whole is still good."""
    here = start
    cheapest = sorted(pairs, key=lambda pair: (1 / pair[1] if pair[1] else 0.0, pair[0]))
    for i in np.flatnonzero(start.intervals).tolist():
        for L, interval in cheapest:
            if trials.spent or (1 / interval if interval else 0.0, L) >= (1 / here.intervals[i], here.windows[i]):
                break
            there = trials.at(_with(here.windows, i, L), _with(here.intervals, i, interval))
            if good(there):
                here = there
                break
    return here


def _with(values: Int[ndarray, " N"], i: int, value: int) -> Int[ndarray, " N"]:
    changed = values.copy()
    changed[i] = value
    return changed


def _steps(longer: dict[int, int], interval: int) -> list[int]:
    """The next longer interval, and never."""
    return [longer[interval], 0] if interval in longer else [0]


def _pairs(network: CorruptedNetwork) -> list[tuple[int, int]]:
    """Nodes that may be exchanged, each pair once."""
    heard = ((i, j) for i in range(network.N) for j in network.neighbours(i).tolist() if i != j)
    every = ((i, j) for i in range(network.N) for j in range(i))
    pairs = every if network.N <= _SMALL else heard
    return sorted({(min(pair), max(pair)) for pair in pairs})
