"""A table as text: JSON for programs, CSV for spreadsheets, Markdown for people."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from tolnet.design.export.deployment import Deployment
from tolnet.design.export.reasons import Reasons
from tolnet.design.export.record import Limits, TableRecord, plain
from tolnet.model import ToleranceTable


def table_json(
    table: ToleranceTable,
    *,
    limits: Limits | None = None,
    full: bool = False,
    data: Mapping[str, Any] | None = None,
) -> Iterator[str]:
    """The document `tolnet.table/1` in pieces, a line a node. `full` adds P, V, the gain and W's column.

    Beside every `status` stands a `reason`, null where that is `ok`. Floats are written so that reading them back
    gives the same double.
    """
    record, reasons = TableRecord.of(table, limits, data), Reasons(table)
    central: dict[str, Any] = {**plain(record.central), "reason": reasons.of(None)}
    if record.central_limits is not None:
        central["limits"] = plain(record.central_limits)
    if full:
        central |= {"P": plain(table.central.P), "V": plain(table.central.V)}
    yield "{\n"
    estimated = {} if data is None else {"data": plain(data)}
    for key, value in {**record.heading(), **estimated, "central": central}.items():
        yield f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False)},\n"
    yield '  "nodes": ['
    separator = "\n"
    for node in _nodes(table, record, reasons, full):
        yield f"{separator}    {json.dumps(node, allow_nan=False)}"
        separator = ",\n"
    yield "\n  ]\n}\n"


def _nodes(table: ToleranceTable, record: TableRecord, reasons: Reasons, full: bool) -> Iterator[dict[str, Any]]:
    deployment = Deployment.of(table) if full else None
    own, settles = len(record.nodes), table.local.settles.tolist()
    for k, row in enumerate(record.rows()):
        node = dict(zip(record.nodes, map(plain, row[:own]), strict=True))
        node["reason"] = None if settles[k] else reasons.of(k)
        if record.node_limits is not None:
            node["limits"] = dict(zip(record.node_limits, map(plain, row[own:]), strict=True))
        if deployment is not None:
            node |= _deployed(table, deployment, k)
        yield node


def _deployed(table: ToleranceTable, deployment: Deployment, k: int) -> dict[str, Any]:
    begin, end = deployment.offsets[[k, k + 1]].tolist()
    columns = (deployment.columns[begin : end + 1] - deployment.columns[begin]).tolist()
    links = zip(deployment.neighbours[begin:end].tolist(), deployment.weights[begin:end].tolist(), strict=True)
    return {
        "P": plain(table.local.P[k]),
        "V": plain(table.local.V[k]),
        "gain": plain(deployment.gain(k)),
        "neighbours": [{"node": l, "weight": w, "columns": columns[i : i + 2]} for i, (l, w) in enumerate(links)],
    }


def table_csv(record: TableRecord) -> Iterator[str]:
    """One row a node, the rest in comment lines."""
    rest = {"data": record.data or {}, "central": {**record.central, "limits": record.central_limits or {}}}
    yield from csv_lines({**record.heading(), **rest}, record.columns, record.rows())


def csv_lines(heading: Mapping[str, Any], columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> Iterator[str]:
    """Rows under a line of column names, after comment lines `# key: value` with the heading, values as JSON.

    A value that does not exist is an empty cell, infinity is `inf`; floats read back as the same double.
    """
    for key, value in flat(heading):
        yield f"# {key}: {json.dumps(plain(value), allow_nan=False)}\n"
    line = io.StringIO()
    writer = csv.writer(line, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow(["" if value is None else value for value in map(plain, row)])
        yield line.getvalue()
        line.seek(0)
        line.truncate()
    yield line.getvalue()


def flat(tree: Mapping[str, Any], joint: str = ".", prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of nested mappings, their keys joined by `joint`."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from flat(value, joint, f"{prefix}{key}{joint}")
        else:
            yield f"{prefix}{key}", value


HEADS = {
    "node": "node",
    "name": "name",
    "degree": "n_k",
    "tolerance": "c_k",
    "theta": "theta_k",
    "trace_P": "tr P_k",
    "trace_V": "tr V_k",
    "spectral_radius": "rho(M_k)",
    "attraction": "attraction",
    "status": "status",
    "limits_fold": "fold at",
    "limits_attracts": "settles below",
    "limits_exists": "steady state up to",
    "limits_published": "published bound",
}
"""The columns as people know them."""


def table_markdown(record: TableRecord) -> Iterator[str]:
    """A heading, where the table comes from, and all rows, rounded to six digits for reading."""
    central = record.central
    yield f"# Tolerance table of {_cell(record.problem or 'an unnamed problem')}\n\n"
    yield f"- tolerance c = {record.tolerance!r} ({record.convention}), tau = {record.tau!r}\n"
    yield f"- problem file: SHA-256 `{record.sha256 or 'none, it was not read from a file'}`\n"
    yield f"- tolnet {record.version}, status: {record.status}\n"
    yield (
        f"- central filter: theta = {cell(central['theta'])}, tr P = {cell(central['trace_P'])},"
        f" tr V = {cell(central['trace_V'])}, attraction = {cell(central['attraction'])}, {central['status']}\n"
    )
    if record.data is not None:
        yield f"- tolerance from data: {', '.join(f'{key} {cell(value)}' for key, value in record.data.items())}\n"
    if record.central_limits is not None:
        limits = (f"{HEADS[f'limits_{key}']} {cell(value)}" for key, value in record.central_limits.items())
        yield f"- limits of c for the central filter: {', '.join(limits)}\n"
    columns = record.columns
    yield "\n"
    yield from markdown_table([HEADS[key] for key in columns], record.rows(), words=("name", "status"))


def markdown_table(heads: Sequence[str], rows: Iterable[Iterable[Any]], words: Container[str]) -> Iterator[str]:
    """Rows under their heads, rounded for reading; the columns named in `words` stand on the left."""
    yield f"| {' | '.join(heads)} |\n"
    yield "|" + "|".join(" --- " if head in words else " ---: " for head in heads) + "|\n"
    for row in rows:
        yield f"| {' | '.join(_cell(cell(value)) for value in row)} |\n"


def cell(value: Any) -> str:
    """One value for people: six digits, a dash where there is none."""
    if isinstance(value, float | np.floating):
        return "-" if np.isnan(value) else f"{value:.6g}"
    return str(value)


def _cell(text: str) -> str:
    return " ".join(text.replace("\\", "\\\\").replace("|", "\\|").split())
