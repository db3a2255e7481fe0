"""Window length and interval of every node, from what a fusion costs and what it saves."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from numpy import ndarray

from tolnet.analysis.channel_filters import WindowHistory, follow_window
from tolnet.design.window_search import Trials, exchange, late, lengthen, save, thin_out
from tolnet.model import Complaint, CorruptedNetwork, InputError
from tolnet.model.window_choice import KeptPair, WindowChoice, WindowPoint, solve_rates

WINDOWS, INTERVALS = (1, 2, 3), (1, 2, 5, 10)
"""What is tried by default, every window with every interval."""
_AS_GOOD = 1e-3
"""A choice is good where no node is worse by more, relatively, than with the best that all nodes alike can afford."""
_RUNS_A_NODE = 3
"""How many runs the search takes for each node, about; in large networks it ends with them."""
_DUST = 1e-6
"""What an interior-point method leaves of a weight that is zero."""
_DOUBLE = 8

Progress = Callable[[int, int], None]


def choose_window(
    network: CorruptedNetwork,
    budget: Mapping[str, int | float] | None = None,
    *,
    windows: Iterable[int] = WINDOWS,
    intervals: Iterable[int] = INTERVALS,
    steps: int = 60,
    common_window: bool = False,
    progress: Progress | None = None,
) -> WindowChoice:
    """Choose the window length L_i and the interval Delta_i of every node for a budget, eqs. (13)-(18).

    Every L is tried with every Delta, all nodes alike, beside Algorithm 1. From the cheapest of these that is within
    the budget and within 0.1 % of the best, solves are taken from one node after the other, the least loss for each
    solve saved first; the cheapest mixture that is within 0.1 % of the best at every node is improved by exchanges,
    and by what cheaper pairs save at each node. So nodes are credited with what their own solves bring. Covariances
    only, over `steps` steps with a clean channel whose bounds are in force; traces are means over the second half.
    With `common_window` nodes differ in their intervals only, as a problem file can say it (`WindowChoice.designed`).

    `budget` limits `solves` (fusion problems per second at a node; per step where plant.dt is missing) and `bytes`
    (per link and step: 8 (n + n (n + 1) / 2) for each pair that is kept of a neighbour and carried along).
    Raises InputError for other budgets, for one that not even Algorithm 1 meets, for a window or an interval below 1,
    and for fewer than 2 steps.
    Source: docs/mathematics.md, section 13.9; docs/decisions/0026-window-search.md.
    """
    limits = {key: float(value) for key, value in (budget or {}).items()}
    lengths, every = sorted(set(windows)), sorted(set(intervals))
    _check(network, limits, lengths, every, steps)
    N, pairs = network.N, [(1, 0), *((L, interval) for L in lengths for interval in every)]
    about = len(pairs) + _RUNS_A_NODE * N
    count = _Count(about, progress)
    trials = Trials(
        network, steps, lambda L, interval, trace: _point(network, L, interval, trace, limits), about, count.one_more
    )
    alike = [trials.at(np.full(N, L), np.full(N, interval)) for L, interval in pairs]
    within = [point for point in alike if point.affordable]
    most = np.array(min(within, key=lambda point: point.trace).node_trace) * (1 + _AS_GOOD)

    def good(point: WindowPoint) -> bool:
        return point.affordable and bool((point.node_trace <= most).all())

    start = min(filter(good, within), key=lambda point: (point.solves, point.bytes))
    path = [start, *thin_out(trials, start, every)]
    path += lengthen(trials, path, every)
    chosen = exchange(trials, min(filter(good, path), key=lambda point: point.solves))
    if common_window:
        pairs = [(L, interval) for L, interval in pairs if chosen.window == L or not interval]
    chosen = save(trials, chosen, good, pairs)
    history = follow_window(network, steps, chosen.windows, chosen.intervals)
    count.done()
    mixed = sorted(trials.mixtures, key=lambda point: (-point.solves, point.trace))
    return WindowChoice(
        network=network,
        budget=limits,
        window=chosen.windows,
        interval=chosen.intervals,
        node_trace=late(history),
        weights=_weights(network, history),
        front=tuple(point._replace(on_front=_on_front(point, [*alike, *mixed])) for point in alike),
        mixtures=tuple(point._replace(on_front=_on_front(point, [*alike, *mixed])) for point in mixed),
        steps=steps,
        solves=history.solves,
        fallbacks=history.fallbacks,
    )


class _Count:
    """How many runs are done, of how many there may be about."""

    def __init__(self, about: int, progress: Progress | None) -> None:
        self._about, self._progress, self._done = about, progress, 0

    def one_more(self) -> None:
        self._done += 1
        if self._progress is not None:
            self._progress(min(self._done, self._about - 1), self._about)

    def done(self) -> None:
        if self._progress is not None:
            self._progress(self._about, self._about)


def pair_bytes(network: CorruptedNetwork) -> int:
    """An estimate and the upper triangle of its matrix, in doubles: also what a message takes."""
    n = network.n
    return _DOUBLE * (n + n * (n + 1) // 2)


def _check(
    network: CorruptedNetwork, budget: dict[str, float], lengths: list[int], every: list[int], steps: int
) -> None:
    complaints = [
        Complaint(f"budget.{key}", "is no known budget; solves and bytes are")
        for key in budget
        if key not in ("solves", "bytes")
    ]
    for key, value in budget.items():
        if not value >= 0:
            complaints.append(Complaint(f"budget.{key}", f"is {value}; a number >= 0 was expected"))
    message = pair_bytes(network)
    if budget.get("bytes", message) < message:
        complaints.append(
            Complaint("budget.bytes", f"is {budget['bytes']:g}; a link needs {message} bytes a step, window or not")
        )
    for key, values in (("windows", lengths), ("intervals", every)):
        if not values or values[0] < 1:
            complaints.append(Complaint(key, f"is {values}; whole numbers of at least 1 were expected"))
    if steps < 2:
        complaints.append(Complaint("steps", f"is {steps}; at least 2 were expected"))
    if complaints:
        raise InputError(complaints)


def _point(
    network: CorruptedNetwork, windows: ndarray, intervals: ndarray, node_trace: ndarray, budget: Mapping[str, float]
) -> WindowPoint:
    rates, size = solve_rates(network, intervals), int(windows.max()) * pair_bytes(network)
    affordable = rates.max() <= budget.get("solves", np.inf) * (1 + 1e-12) and size <= budget.get("bytes", np.inf)
    return WindowPoint(windows, intervals, float(rates.mean()), size, node_trace, False, bool(affordable))


def _on_front(point: WindowPoint, others: Iterable[WindowPoint]) -> bool:
    """Whether nothing that costs no more gives a trace that is lower by more than rounding."""
    return not any(
        (other.solves <= point.solves and other.bytes <= point.bytes and other.trace < point.trace * (1 - 1e-9))
        or (
            (other.solves, other.bytes) != (point.solves, point.bytes)
            and other.solves <= point.solves
            and other.bytes <= point.bytes
            and other.trace <= point.trace * (1 + 1e-9)
        )
        for other in others
    )


def _weights(network: CorruptedNetwork, history: WindowHistory) -> tuple[tuple[KeptPair, ...], ...]:
    """The weights of every node's last fusion, without the dust."""
    found = []
    for i in range(network.N):
        own = np.arange(network.fusion.indptr[i], network.fusion.indptr[i + 1])
        rows, weights = history.solved.get(i, (own, network.fusion.data[own][:, None]))
        senders = network.pairs[rows, 1].tolist()
        found.append(
            tuple(
                KeptPair(sender, age, float(weights[at, age]))
                for at, sender in enumerate(senders)
                for age in range(weights.shape[1])
                if weights[at, age] > _DUST
            )
        )
    return tuple(found)
