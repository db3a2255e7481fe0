"""Numbers about the filters of the literature, side by side: documents for programs, tables for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray

from tolnet.design.export import csv_lines, flat, markdown_table, opening
from tolnet.model import Ambiguity, CorruptedNetwork, SensorNetwork, Status, ToleranceTable
from tolnet.report.table import empty_table

if TYPE_CHECKING:
    from rich.table import Table

_WORDS = ("filter", "messages from the centre", "status")


@dataclass(frozen=True, eq=False)
class FilterReport:
    """What was found about some filters, at the tolerance of one table where there is one, ready to be told.

    NaN stands for a value that does not exist, None for words that do not; tolerances are in the table's convention.
    """

    schema: str
    title: str
    table: ToleranceTable | CorruptedNetwork
    """What the filters were compared at; corrupted channels have no tolerances."""
    about: Mapping[str, Any]
    """Keys of the document beside those that open every document: `diffusion` and so on."""
    filters: Mapping[str, Mapping[str, Any]]
    """By name, what the document says of each; `status` and `reason` among it."""
    shown: Mapping[str, Sequence[str]]
    """The columns that people read, a row a filter."""
    columns: Mapping[str, ndarray]
    """The columns of a CSV file."""
    arrays_only: Mapping[str, ndarray] = field(default_factory=dict)
    """What an archive of arrays holds beside the document."""

    @property
    def status(self) -> str:
        """`ok`, or the status of the first filter that is not."""
        bad = (entry["status"] for entry in self.filters.values() if entry["status"] != Status.OK)
        return str(next(bad, Status.OK))

    @property
    def ok(self) -> bool:
        """Whether every filter has an answer without reservation."""
        return self.status == Status.OK

    def complaints(self) -> Iterator[str]:
        """One line for each reason that there is, with the filters that it concerns."""
        found: dict[tuple[str, str], list[str]] = {}
        for name, entry in self.filters.items():
            if entry["status"] != Status.OK:
                found.setdefault((entry["status"], entry["reason"]), []).append(name)
        for (status, reason), names in found.items():
            yield f"{', '.join(names)}: {status}: {reason}"

    def document(self) -> dict[str, Any]:
        """The document of the contract."""
        return {**self._heading(), "filters": {name: dict(entry) for name, entry in self.filters.items()}}

    def csv(self) -> Iterator[str]:
        """The columns, with all single numbers of the document in comment lines before them."""
        numbers = {
            name: {key: value for key, value in flat(entry) if np.ndim(value) == 0}
            for name, entry in self.filters.items()
        }
        rows = zip(*(column.tolist() for column in self.columns.values()), strict=True)
        return csv_lines({**self._heading(), "filters": numbers}, self.columns, rows)

    def markdown(self) -> Iterator[str]:
        """What people are shown, and the columns of the CSV file, rounded for reading."""
        heading = self._heading()
        problem = heading.pop("problem")
        yield f"# {self.title} of {problem['name'] or 'an unnamed problem'}\n\n"
        yield f"- problem file: SHA-256 `{problem['sha256'] or 'none, it was not read from a file'}`\n"
        yield from (f"- {key}: {value}\n" for key, value in heading.items() if key != "schema")
        yield from (f"- no answer: {line}\n" for line in self.complaints())
        yield "\n"
        yield from markdown_table(list(self.shown), zip(*self.shown.values(), strict=True), _WORDS)
        yield "\n"
        rows = zip(*(column.tolist() for column in self.columns.values()), strict=True)
        yield from markdown_table(list(self.columns), rows, ("name",))

    def arrays(self) -> dict[str, Any]:
        """The document as arrays, keys joined by `_` where they are nested; words that do not exist are empty."""
        leaves = dict(flat(self.document(), "_"))
        return {key: "" if value is None else value for key, value in {**leaves, **self.arrays_only}.items()}

    def view(self) -> Table:
        """A table for a terminal; filters without an answer stand out."""
        table = empty_table(self.shown, _WORDS)
        bad = (entry["status"] != Status.OK for entry in self.filters.values())
        for is_bad, *cells in zip(bad, *self.shown.values(), strict=True):
            table.add_row(*cells, style="bold red" if is_bad else None)
        return table

    def _heading(self) -> dict[str, Any]:
        table = self.table
        if isinstance(table, CorruptedNetwork):
            return {**opening(self.schema, table, self.status), **self.about}
        ambiguity = Ambiguity(table.tolerance, table.convention, table.tau)
        return {**opening(self.schema, table.network, self.status, ambiguity), **self.about}


def per_node(network: SensorNetwork, values: Mapping[str, ndarray]) -> dict[str, ndarray]:
    """Columns with a row a node; a centralised filter, whose estimate every node has, says the same at each."""
    names = {} if network.names is None else {"name": np.array(network.names)}
    spread = {key: np.broadcast_to(value, network.N) for key, value in values.items()}
    return {"node": np.arange(network.N), **names, **spread}


def headline(report: FilterReport) -> str:
    """The network, its tolerance and its weights in one line."""
    table = report.table
    if isinstance(table, CorruptedNetwork):
        return f"{table.name or 'unnamed problem'}: {table.N:,} nodes over corrupted channels"
    nodes = f"{table.network.N:,} node{'' if table.network.N == 1 else 's'}"
    return (
        f"{table.network.name or 'unnamed problem'}: {nodes}, c = {table.tolerance:.6g} ({table.convention}),"
        f" weights: {report.about['diffusion']}"
    )


def words_of(status: Status, reason: str) -> dict[str, str | None]:
    """Status and reason as documents have them."""
    return {"status": str(status), "reason": reason or None}


def number(value: float, digits: str) -> str:
    """A number for people, a dash where there is none."""
    return "-" if np.isnan(value) else format(value, digits)


def decibels(msd: float) -> float:
    """10 log10, minus infinity for nothing."""
    with np.errstate(divide="ignore"):
        return float(10 * np.log10(msd))
