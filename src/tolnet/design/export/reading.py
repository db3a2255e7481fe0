"""Tables read back from the files that `export_table` writes: JSON, CSV and NumPy archives."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from tolnet.design.export.record import CENTRAL, NODES, SCHEMA, TableRecord
from tolnet.model import CONVENTIONS, Complaint, InputError
from tolnet.model.archive import read_archive
from tolnet.model.bounded_reading import LARGEST_ARCHIVE, LARGEST_TEXT, read_whole, text_of

LARGEST = {".json": LARGEST_TEXT, ".csv": LARGEST_TEXT, ".npz": LARGEST_ARCHIVE}
"""Bytes of a table by its suffix."""
LONG_DOCUMENT = 2**21
"""Bytes from which on a JSON document is to open as `export_table` writes it, or is not built."""
MOST_HEADINGS = 1000
"""Lines above the columns of a .csv file; `export_table` writes about twenty."""
_OPENING = re.compile(rb'\s*\{\s*"schema"\s*:\s*"' + re.escape(SCHEMA.encode()) + rb'"\s*,')

NAMED = (NODES[0], "name", *NODES[1:])
"""The columns of a table whose nodes have names."""


def read_table(path: Path) -> TableRecord:
    """The record of a written table, numbers bit for bit as they were.

    Raises InputError, naming the file, where it is missing, damaged, or no table of schema `tolnet.table/1`.
    """
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        raise InputError(f"is no table that can be read back: expected {', '.join(_READERS)}", source=str(path))
    try:
        document = _READERS[suffix](read_whole(path, LARGEST[suffix], _look if suffix == ".json" else None))
    except InputError as error:
        raise InputError(error.complaints, source=str(path)) from None
    except (ValueError, RecursionError, csv.Error) as error:  # malformed JSON, UTF-8 or CSV
        raise InputError(f"is no table: {error}", source=str(path)) from None
    if document.get("schema") != SCHEMA:
        found = document.get("schema", "none")
        raise InputError([Complaint("schema", f"is {found!r}; {SCHEMA!r} was expected")], source=str(path))
    return _record(document, str(path))


def _look(head: bytes, size: int) -> None:
    """Raise InputError for a long document that does not open as a table does, before all of it is built."""
    if size > LONG_DOCUMENT and not _OPENING.match(head):
        raise InputError(f"is no table: a document as long as this was expected to open with {SCHEMA!r}")


def _read_json(data: bytes) -> dict[str, Any]:
    document = json.loads(text_of(data))
    if not isinstance(document, dict):
        raise ValueError("the document is no object")
    nodes = document.get("nodes")
    if isinstance(nodes, list) and all(isinstance(node, dict) for node in nodes):
        document["nodes"] = {
            key: [node[key] for node in nodes] for key in NAMED if all(key in node for node in nodes)
        }
    return document


def _read_csv(data: bytes) -> dict[str, Any]:
    document: dict[str, Any] = {}
    file = io.StringIO(text_of(data), newline="")
    line = file.readline()
    for _ in range(MOST_HEADINGS):
        if not line.startswith("# "):
            break
        key, _, value = line[2:].partition(": ")
        _put(document, key.split("."), json.loads(value))
        line = file.readline()
    columns = next(csv.reader([line]), [])
    cells: list[list[str | None]] = [[] for _ in columns]
    for row in csv.reader(file):
        if len(row) != len(columns):
            raise ValueError(f"a row has not {len(columns)} cells")
        for column, cell in zip(cells, row, strict=True):
            column.append(cell or None)
    document["nodes"] = dict(zip(columns, cells, strict=True))
    return document


def _put(tree: dict[str, Any], path: list[str], value: Any) -> None:
    for key in path[:-1]:
        tree = tree.setdefault(key, {})
        if not isinstance(tree, dict):
            raise ValueError(f"{key} is given twice")
    tree[path[-1]] = value


def _read_npz(data: bytes) -> dict[str, Any]:
    archive = read_archive(data)

    def values(keys: Iterable[str], prefix: str = "") -> dict[str, Any]:
        arrays = {key: archive[prefix + key] for key in keys if prefix + key in archive}
        return {key: array.tolist() if array.ndim == 0 else array for key, array in arrays.items()}

    document = values(["schema", "tolnet", "convention", "tau", "tolerance"])
    problem = values(["name", "sha256"], "problem_")
    document["problem"] = {**problem, "sha256": problem.get("sha256") or None}
    document["central"] = values(CENTRAL, "central_")
    document["nodes"] = values(NAMED, "nodes_")
    return document


_READERS: dict[str, Callable[[bytes], dict[str, Any]]] = {".json": _read_json, ".csv": _read_csv, ".npz": _read_npz}


def _record(document: Mapping[str, Any], source: str) -> TableRecord:
    """A checked record of what was read, whatever the format; complains about every key that is missing or wrong."""
    complaints: list[Complaint] = []

    def branch(key: str) -> Mapping[str, Any]:
        if isinstance(document.get(key), Mapping):
            return document[key]
        complaints.append(Complaint(key, "is missing"))
        return {}

    def column(key: str, tree: Mapping[str, Any], path: str, *, single: bool = False) -> ndarray:
        values = [tree.get(key)] if single else tree.get(key)
        found = None if key not in tree else _column(values, key)
        if found is None:
            wanted = "a number" if single else "a column of numbers"
            complaints.append(Complaint(path, f"is {'wrong' if key in tree else 'missing'}; {wanted} was expected"))
        return np.full(1, np.nan) if found is None else found

    problem, central, nodes = branch("problem"), branch("central"), branch("nodes")
    convention = document.get("convention")
    if convention not in CONVENTIONS:
        complaints.append(Complaint("convention", f"is {convention!r}; 'gamma' or 'nats' was expected"))
    columns = {key: column(key, nodes, f"nodes[].{key}") for key in NAMED if key != "name" or key in nodes}
    if len({column.shape for column in columns.values()}) > 1 and not complaints:
        complaints.append(Complaint("nodes", "has columns of different lengths"))
    tau, tolerance = (float(column(key, document, key, single=True)[0]) for key in ("tau", "tolerance"))
    centre = {key: column(key, central, f"central.{key}", single=True)[0] for key in CENTRAL}
    if complaints:
        raise InputError(complaints, source=source)
    return TableRecord(
        problem=str(problem.get("name") or ""),
        sha256=problem.get("sha256"),
        version=str(document.get("tolnet")),
        convention="nats" if convention == "nats" else "gamma",
        tau=tau,
        tolerance=tolerance,
        central={key: value.item() for key, value in centre.items()},
        nodes=columns,
    )


def _column(values: Any, key: str) -> ndarray | None:
    """A column of numbers or words, or None where it is none; null is NaN, "inf" infinity."""
    if isinstance(values, str) or not isinstance(values, Sequence | ndarray):
        return None
    if key in ("status", "name"):
        return np.array(["" if value is None else str(value) for value in values], dtype=np.str_)
    try:
        column = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    if key not in ("node", "degree"):
        return column if column.ndim == 1 else None
    whole = column.ndim == 1 and (column == np.floor(column)).all() and np.isfinite(column).all()
    return column.astype(np.int64) if whole else None
