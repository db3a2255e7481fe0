"""Deployable artefacts: a tolerance table as JSON, CSV, Markdown, NumPy archive, Parquet or C header, and back."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from tolnet.design.export.arrays import write_npz, write_parquet
from tolnet.design.export.header import table_header
from tolnet.design.export.reading import read_table
from tolnet.design.export.reasons import Reasons
from tolnet.design.export.record import Limits, TableRecord, opening, plain
from tolnet.design.export.text import (
    HEADS,
    cell,
    csv_lines,
    flat,
    markdown_table,
    table_csv,
    table_json,
    table_markdown,
)
from tolnet.model import InputError, ToleranceTable, UnsupportedError, check_writable, replacing

__all__ = [
    "HEADS",
    "TABLE_SUFFIXES",
    "Reasons",
    "TableRecord",
    "cell",
    "check_table_path",
    "csv_lines",
    "export_table",
    "flat",
    "markdown_table",
    "opening",
    "plain",
    "read_table",
    "table_json",
]


def export_table(
    table: ToleranceTable,
    path: str | Path,
    *,
    limits: Limits | None = None,
    full: bool = False,
    data: Mapping[str, Any] | None = None,
) -> None:
    """Write a tolerance table in the format that the suffix of `path` names, whole or not at all.

        .json      the document `tolnet.table/1`; `full` adds P_k, V_k, the gain G_k and W's column
        .csv .md   one row a node; .md is rounded for reading, .csv reads back as the same doubles
        .npz       everything that is deployed, as arrays without pickle
        .parquet   one row a node (needs pyarrow)
        .h         everything that is deployed, as constants for C99 and C++

    Every file says which problem (name and SHA-256), convention, tau, c and version. `limits`, as
    analysis.tolerance_limits returns them, and `data`, what is known of the data that the tolerance was estimated
    from, are added to every format but .h; limits are written in the table's convention, `data` as it is.
    Raises InputError where the file cannot be written there or the suffix is unknown, UnsupportedError where pyarrow
    is missing.
    """
    path = Path(path)
    check_table_path(path)
    with replacing(path) as file:
        _WRITERS[path.suffix.lower()](table, file, _More(limits, full, data))


def check_table_path(path: Path) -> None:
    """Raise now what `export_table` would raise after the computation."""
    suffix = path.suffix.lower()
    if suffix not in _WRITERS:
        found = f"the suffix {suffix!r}" if suffix else "no suffix"
        raise InputError(f"has {found}; one of {', '.join(_WRITERS)} was expected", source=str(path))
    if suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise UnsupportedError(f"{path}: Parquet needs pyarrow; pip install 'tolnet[parquet]'")
    check_writable(path)


class _More(NamedTuple):
    """What a file may say beside the table."""

    limits: Limits | None
    full: bool
    data: Mapping[str, Any] | None


def _write(pieces: Iterable[str], file: BinaryIO) -> None:
    for piece in pieces:
        file.write(piece.encode())


_WRITERS: dict[str, Callable[[ToleranceTable, BinaryIO, _More], None]] = {
    ".json": lambda table, file, more: _write(table_json(table, **more._asdict()), file),
    ".csv": lambda table, file, more: _write(table_csv(TableRecord.of(table, more.limits, more.data)), file),
    ".md": lambda table, file, more: _write(table_markdown(TableRecord.of(table, more.limits, more.data)), file),
    ".npz": lambda table, file, more: write_npz(table, file, limits=more.limits, data=more.data),
    ".parquet": lambda table, file, more: write_parquet(TableRecord.of(table, more.limits, more.data), file),
    ".h": lambda table, file, _: _write(table_header(table), file),
}
TABLE_SUFFIXES = tuple(_WRITERS)
