"""The choice of windows as documents, and for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from tolnet.design.export import csv_lines, markdown_table, opening
from tolnet.model import Status
from tolnet.model.window_choice import WindowChoice, WindowPoint
from tolnet.report.table import empty_table

if TYPE_CHECKING:
    from rich.console import RenderableType

MOST_ROWS = 30
"""Nodes, and points node by node, that people are shown one by one."""
_NAMED_UP_TO = 4


def window_document(choice: WindowChoice) -> dict[str, Any]:
    """The document `tolnet.window/1`; an interval of null is never, a window of Algorithm 1."""
    network = choice.network
    return {
        **_heading(choice),
        "nodes": [
            {
                "node": i,
                "name": network.label(i) if network.names else None,
                "method": choice.method(i),
                "window": int(choice.window[i]),
                "interval": int(choice.interval[i]) or None,
                "trace": float(choice.node_trace[i]),
                "algorithm_1": float(choice.plain.node_trace[i]),
                "weights": [pair._asdict() for pair in choice.weights[i]],
            }
            for i in range(network.N)
        ],
        "front": [_point(point, alike=True) for point in choice.front]
        + [_point(point, alike=False) for point in choice.mixtures],
    }


def _point(point: WindowPoint, *, alike: bool) -> dict[str, Any]:
    """The longest window and the shortest interval of any node; those of each where they differ."""
    return {
        "window": point.window,
        "interval": point.interval or None,
        "windows": None if alike else point.windows.tolist(),
        "intervals": None if alike else [interval or None for interval in point.intervals.tolist()],
        "solving": point.solving,
        "solves": point.solves,
        "bytes": point.bytes,
        "trace": point.trace,
        "on_front": point.on_front,
        "affordable": point.affordable,
    }


def window_csv(choice: WindowChoice) -> Iterator[str]:
    """A row a node, everything else in comment lines."""
    names, rows = _node_rows(choice)
    return csv_lines(_heading(choice), names, rows)


def window_markdown(choice: WindowChoice) -> Iterator[str]:
    """What was chosen for every node, and everything that was tried."""
    heading = _heading(choice)
    problem = heading.pop("problem")
    yield f"# Windows of {problem['name'] or 'an unnamed problem'}\n\n"
    yield f"- problem file: SHA-256 `{problem['sha256'] or 'none, it was not read from a file'}`\n"
    skipped = ("schema", "convention", "tau", "tolerance")
    yield from (f"- {key}: {value}\n" for key, value in heading.items() if key not in skipped)
    names, rows = _node_rows(choice)
    yield "\n"
    yield from markdown_table(names, rows, ("name", "method"))
    yield "\n"
    shown = _front(choice, _telling(choice))
    yield from markdown_table(list(shown), zip(*shown.values(), strict=True), ("nodes", ""))


def window_view(choice: WindowChoice) -> Iterator[RenderableType]:
    """What was tried, what was chosen, and what it saves."""
    network = choice.network
    limits = ", ".join(f"{key} <= {value:g}" for key, value in choice.budget.items()) or "no budget"
    yield f"{network.name or 'unnamed problem'}: {network.N:,} nodes over corrupted channels, {limits}"
    points = _telling(choice)
    table = empty_table(shown := _front(choice, points), ("nodes", ""))
    for point, *cells in zip(points, *shown.values(), strict=True):
        table.add_row(*cells, style=None if point.affordable else "dim")
    yield table
    for L, interval in sorted({*zip(choice.window.tolist(), choice.interval.tolist(), strict=True)}):
        nodes = np.flatnonzero((choice.window == L) & (choice.interval == interval))
        some = ", ".join(network.label(int(i)) for i in nodes[:MOST_ROWS])
        rest = f" and {len(nodes) - MOST_ROWS:,} more" if len(nodes) > MOST_ROWS else ""
        yield f"{_said(L, interval)}: node{'' if len(nodes) == 1 else 's'} {some}{rest}"
    yield (
        f"mean tr P {choice.trace:.5g}, {100 * choice.gain:.1f} % below Algorithm 1's {choice.plain.trace:.5g}"
        f" (second half of {choice.steps:,} steps)"
    )
    yield (
        f"{choice.solves:,} fusion problem{'' if choice.solves == 1 else 's'} in {choice.steps:,} steps,"
        f" {choice.rate:.4g} a {'step' if network.dt is None else 'second'} and node on average"
    )
    own = np.mean([sum(pair.weight for pair in choice.weights[i] if pair.sender == i) for i in range(network.N)])
    yield f"weight on a node's own pairs at the end: {100 * own:.0f} % on average"
    if choice.fallbacks:
        yield f"{choice.fallbacks:,} of {choice.solves:,} fusions fell back on the weights of Algorithm 1"


def _said(L: int, interval: int) -> str:
    if not interval:
        return "Algorithm 1"
    every = "every step" if interval == 1 else f"every {interval} steps"
    return f"L = {L}, {every}"


def _heading(choice: WindowChoice) -> dict[str, Any]:
    return {
        **opening("tolnet.window/1", choice.network, str(Status.OK)),
        "budget": dict(choice.budget),
        "per": "step" if choice.network.dt is None else "second",
        "steps": choice.steps,
        "trace": choice.trace,
        "algorithm_1": choice.plain.trace,
        "gain": choice.gain,
        "solves": choice.solves,
        "solve_rate": choice.rate,
        "fallbacks": choice.fallbacks,
    }


def _node_rows(choice: WindowChoice) -> tuple[list[str], list[tuple[Any, ...]]]:
    network = choice.network
    named = network.names is not None
    names = ["node", *(["name"] if named else []), "method", "window", "interval", "trace", "algorithm_1"]
    rows = [
        (
            i,
            *([network.label(i)] if named else []),
            choice.method(i),
            int(choice.window[i]),
            int(choice.interval[i]) or None,
            float(choice.node_trace[i]),
            float(choice.plain.node_trace[i]),
        )
        for i in range(network.N)
    ]
    return names, rows


def _telling(choice: WindowChoice) -> list[WindowPoint]:
    """All nodes alike, and what is on the front of what was tried node by node; of too many evenly some."""
    mixed = [point for point in choice.mixtures if point.on_front]
    if len(mixed) > MOST_ROWS:
        mixed = [mixed[i] for i in np.linspace(0, len(mixed) - 1, MOST_ROWS).round().astype(int).tolist()]
    return [*choice.front, *mixed]


def _front(choice: WindowChoice, points: Sequence[WindowPoint]) -> Mapping[str, list[str]]:
    return {
        "L": [_numbers(point.windows[point.intervals > 0]) or "-" for point in points],
        "every": [_numbers(point.intervals[point.intervals > 0]) or "never" for point in points],
        "nodes": [_who(choice, point) for point in points],
        "solves": [f"{point.solves:.4g}" for point in points],
        "bytes": [f"{point.bytes:,}" for point in points],
        "mean tr P": [f"{point.trace:.5g}" for point in points],
        "": ["front" if point.on_front else "" for point in points],
    }


def _numbers(values: Int[ndarray, " k"]) -> str:
    return ", ".join(map(str, np.unique(values).tolist()))


def _who(choice: WindowChoice, point: WindowPoint) -> str:
    """The nodes that solve, by name where they are few."""
    network = choice.network
    if point.solving in (0, network.N):
        return "all" if point.solving else "none"
    if point.solving > _NAMED_UP_TO:
        return f"{point.solving:,} of {network.N:,}"
    return ", ".join(network.label(int(i)) for i in np.flatnonzero(point.intervals))
