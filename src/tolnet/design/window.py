"""Window length and interval of every node, from what a fusion costs and what it saves."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from numpy import ndarray

from tolnet.analysis.channel_filters import WindowHistory, follow_window
from tolnet.model import Complaint, CorruptedNetwork, InputError
from tolnet.model.window_choice import KeptPair, WindowChoice, WindowPoint

WINDOWS, INTERVALS = (1, 2, 3), (1, 2, 5, 10)
"""What is tried by default, every window with every interval."""
_AS_GOOD = 1e-3
"""A node takes the cheapest that is at most this part worse for it than the best that it can afford."""
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

    Every L is tried with every Delta, all nodes alike, beside Algorithm 1; each node takes the cheapest pair that is
    within the budget and within 0.1 % of the best for it, and the mixture is followed once more. Where that is worse
    than the best uniform pair by more than 1 %, since a node also gains by what its neighbours do, the uniform pair
    stands. Covariances only, over `steps` steps with a clean channel whose bounds are in force; traces are means
    over the second half. With `common_window` nodes differ in their intervals only, as a problem file can say it
    (`WindowChoice.designed`): L is the shortest with which all nodes alike are within 0.1 % of the best.

    `budget` limits `solves` (fusion problems per second and node; per step where plant.dt is missing) and `bytes`
    (per link and step: 8 (n + n (n + 1) / 2) for each pair that is kept of a neighbour and carried along).
    Raises InputError for other budgets, for one that not even Algorithm 1 meets, for a window or an interval below 1,
    and for fewer than 2 steps.
    Source: docs/mathematics.md, section 13.9.
    """
    limits = {key: float(value) for key, value in (budget or {}).items()}
    lengths, every = sorted(set(windows)), sorted(set(intervals))
    _check(network, limits, lengths, every, steps)
    candidates = [(1, 0), *((L, interval) for L in lengths for interval in every)]
    total = (len(candidates) + 1) * steps
    done = 0

    def step_done(k: int) -> None:
        if progress is not None:
            progress(done + k, total)

    tried = []
    for L, interval in candidates:
        history = follow_window(network, steps, L, interval, step_done=step_done)
        tried.append(_point(network, L, interval, _late(history), limits))
        done += steps
    front = tuple(point._replace(on_front=_on_front(point, tried)) for point in tried)
    within = [point for point in front if point.affordable]
    within = _of_one_length(within) if common_window else within
    window, interval = _cheapest(within)
    history = follow_window(network, steps, window, interval, step_done=step_done)
    best = min(within, key=lambda point: point.trace)
    if _late(history).mean() > 1.01 * best.trace:
        window, interval = np.full(network.N, best.window), np.full(network.N, best.interval)
        history = follow_window(network, steps, window, interval)
    return WindowChoice(
        network=network,
        budget=limits,
        window=window,
        interval=interval,
        node_trace=_late(history),
        weights=_weights(network, history),
        front=front,
        steps=steps,
        solves=history.solves,
        fallbacks=history.fallbacks,
    )


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


def _late(history: WindowHistory) -> ndarray:
    """The mean of every node's trace over the second half."""
    return history.node_trace[len(history.node_trace) // 2 :].mean(axis=0)


def _point(
    network: CorruptedNetwork, L: int, interval: int, node_trace: ndarray, budget: Mapping[str, float]
) -> WindowPoint:
    solves = 1 / (interval * (network.dt or 1.0)) if interval else 0.0
    size = L * pair_bytes(network)
    affordable = solves <= budget.get("solves", np.inf) * (1 + 1e-12) and size <= budget.get("bytes", np.inf)
    return WindowPoint(L, interval, solves, size, node_trace, False, affordable)


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


def _of_one_length(within: list[WindowPoint]) -> list[WindowPoint]:
    """Algorithm 1, and one length: the shortest with which all nodes alike do about as well as with any."""
    solving = [point for point in within if point.interval]
    least = min((point.trace for point in solving), default=np.inf)
    shortest = min((point.window for point in solving if point.trace <= least * (1 + _AS_GOOD)), default=1)
    return [point for point in within if not point.interval or point.window == shortest]


def _cheapest(within: list[WindowPoint]) -> tuple[ndarray, ndarray]:
    """What every node takes: fewest solves first, then fewest bytes."""
    cheap = sorted(within, key=lambda point: (point.solves, point.bytes))
    traces = np.array([point.node_trace for point in cheap])
    taken = (traces <= traces.min(axis=0) * (1 + _AS_GOOD)).argmax(axis=0)
    return np.array([cheap[i].window for i in taken]), np.array([cheap[i].interval for i in taken])


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
