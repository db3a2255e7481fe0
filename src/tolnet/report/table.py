"""A tolerance table as people read it in a terminal: every row of a small one, the telling rows of a large one."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int
from numpy import ndarray
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from tolnet.design.export import HEADS, TableRecord
from tolnet.model import Status

if TYPE_CHECKING:
    from rich.console import RenderableType

ALL_ROWS_UP_TO = 40
ENDS = 5
"""Rows shown of the beginning, of the end and of the worst, where not all are shown."""
_MAIN = (
    "node",
    "name",
    "degree",
    "tolerance",
    "theta",
    "trace_P",
    "trace_V",
    "spectral_radius",
    "attraction",
    "status",
)
_DIGITS = {"spectral_radius": ".4f", "attraction": ".4f"}


def table_view(record: TableRecord) -> Iterator[RenderableType]:
    """The table of a network: its heading, the centre, the rows, and a summary of the tolerances.

    Above ALL_ROWS_UP_TO nodes only the first, the last and the worst: those without an answer, then those with the
    largest trace of V_k.
    """
    central = record.central
    yield (
        f"{record.problem or 'unnamed problem'}: {_count(len(record.nodes['node']), 'node')},"
        f" c = {record.tolerance:.6g} ({record.convention})" + (f", tau = {record.tau:g}" if record.tau else "")
    )
    yield (
        f"central filter: theta = {_number(central['theta'])}, tr P = {_number(central['trace_P'])},"
        f" tr V = {_number(central['trace_V'])}, attraction = {_number(central['attraction'], '.4f')},"
        f" {central['status']}"
    )
    shown = telling_rows(record)
    yield _rows(record.nodes, [key for key in _MAIN if key in record.nodes], shown)
    if record.node_limits is not None:
        yield from _limits(record, shown)
    yield summary(record)


def telling_rows(record: TableRecord) -> Int[ndarray, " rows"]:
    """Which rows are shown, in rising order."""
    N = len(record.nodes["node"])
    if N <= ALL_ROWS_UP_TO:
        return np.arange(N)
    bad = record.nodes["status"] != Status.OK.value
    spread = np.where(np.isnan(record.nodes["trace_V"]), np.inf, record.nodes["trace_V"])
    worst = np.lexsort((-spread, ~bad))[:ENDS]
    return np.unique(np.concatenate([np.arange(ENDS), worst, np.arange(N - ENDS, N)]))


def summary(record: TableRecord) -> str:
    """One line: how many nodes have an answer, and how their tolerances spread."""
    c, status = record.nodes["tolerance"], record.nodes["status"]
    good = int((status == Status.OK.value).sum())
    head = f"{good:,} of {_count(len(c), 'node')} ok"
    if np.isnan(c).all():
        return f"{head}; no tolerances"
    label = record.nodes.get("name", record.nodes["node"])
    least, most = int(np.nanargmin(c)), int(np.nanargmax(c))
    return (
        f"{head}; c_k from {c[least]:.6g} (node {label[least]}) to {c[most]:.6g} (node {label[most]}),"
        f" mean {np.nanmean(c):.6g}, median {np.nanmedian(c):.6g}"
    )


def empty_table(heads: Iterable[str], words: Container[str]) -> Table:
    """A table for a terminal; the columns named in `words` stand on the left."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1), show_edge=False)
    for head in heads:
        table.add_column(head, justify="left" if head in words else "right", no_wrap=head not in ("name", "node"))
    return table


def _limits(record: TableRecord, shown: Int[ndarray, " rows"]) -> Iterator[RenderableType]:
    node, centre = record.node_limits or {}, record.central_limits or {}
    limits = ", ".join(f"{HEADS[f'limits_{key}']} {_number(value)}" for key, value in centre.items())
    yield f"limits of the tolerance ({record.convention}); central filter: {limits}"
    columns = {"node": record.nodes["node"], "tolerance": record.nodes["tolerance"]}
    columns |= {f"limits_{key}": column for key, column in node.items()}
    yield _rows(columns, list(columns), shown)


def _rows(columns: Mapping[str, ndarray], keys: list[str], shown: Int[ndarray, " rows"]) -> Table:
    table = empty_table([HEADS[key] for key in keys], words=("name", "status"))
    previous = -1
    for k in shown.tolist():
        if k != previous + 1:
            table.add_row(*("..." if key == "node" else "" for key in keys), style="dim")
        bad = "status" in columns and columns["status"][k] != Status.OK.value
        cells = (_number(columns[key][k], _DIGITS.get(key, ".5g")) for key in keys)
        table.add_row(*(Text(cell) for cell in cells), style="bold red" if bad else None)
        previous = k
    return table


def _number(value: Any, digits: str = ".6g") -> str:
    if isinstance(value, float | np.floating):
        return "-" if np.isnan(value) else format(value, digits)
    return str(value)


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"
