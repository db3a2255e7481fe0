"""The choice of windows as documents, and for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tolnet.design.export import csv_lines, markdown_table, opening
from tolnet.model import Status
from tolnet.model.window_choice import WindowChoice, WindowPoint
from tolnet.report.table import empty_table

if TYPE_CHECKING:
    from rich.console import RenderableType

MOST_ROWS = 30
"""Nodes that people are shown one by one."""


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
        "front": [
            {
                "window": point.window,
                "interval": point.interval or None,
                "solves": point.solves,
                "bytes": point.bytes,
                "trace": point.trace,
                "on_front": point.on_front,
                "affordable": point.affordable,
            }
            for point in choice.front
        ],
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
    shown = _front(choice.front)
    yield from markdown_table(list(shown), zip(*shown.values(), strict=True), ("",))


def window_view(choice: WindowChoice) -> Iterator[RenderableType]:
    """What was tried, what was chosen, and what it saves."""
    network = choice.network
    limits = ", ".join(f"{key} <= {value:g}" for key, value in choice.budget.items()) or "no budget"
    yield f"{network.name or 'unnamed problem'}: {network.N:,} nodes over corrupted channels, {limits}"
    table = empty_table(shown := _front(choice.front), ("",))
    for point, *cells in zip(choice.front, *shown.values(), strict=True):
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


def _front(front: tuple[WindowPoint, ...]) -> Mapping[str, list[str]]:
    return {
        "L": [str(point.window) if point.interval else "-" for point in front],
        "every": [f"{point.interval}" if point.interval else "never" for point in front],
        "solves": [f"{point.solves:.4g}" for point in front],
        "bytes": [f"{point.bytes:,}" for point in front],
        "mean tr P": [f"{point.trace:.5g}" for point in front],
        "": ["front" if point.on_front else "" for point in front],
    }
