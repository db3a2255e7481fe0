"""Documents that are not tables: how they are written."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

REPORT_SUFFIXES = (".json", ".csv", ".npz", ".md")


@runtime_checkable
class Report(Protocol):
    """What can be written in every format."""

    def document(self) -> dict[str, Any]: ...
    def csv(self) -> Iterable[str]: ...
    def markdown(self) -> Iterable[str]: ...
    def arrays(self) -> dict[str, Any]: ...


def render(document: dict[str, Any]) -> str:
    """A document as text: null for NaN, "inf" for infinity, floats that read back as the same double.

    Objects that hold objects or lists are spread over lines, and so are lists of objects and lists of lists.
    """
    from tolnet.design.export import plain

    return _spread(plain(document), "") + "\n"


def _spread(value: Any, margin: str) -> str:
    inner, nested = margin + "  ", (dict, list)
    if isinstance(value, dict) and (not margin or any(isinstance(item, nested) for item in value.values())):
        lines = [f"{inner}{json.dumps(key)}: {_spread(item, inner)}" for key, item in value.items()]
        return "{\n" + ",\n".join(lines) + f"\n{margin}}}"
    if isinstance(value, list) and any(isinstance(item, nested) for item in value):
        lines = [f"{inner}{json.dumps(item, allow_nan=False)}" for item in value]
        return "[\n" + ",\n".join(lines) + f"\n{margin}]"
    return json.dumps(value, allow_nan=False)


def write(path: Path, pieces: Iterable[str]) -> None:
    """Write a text file, whole or not at all."""
    from tolnet.model import replacing

    with replacing(path) as file:
        for piece in pieces:
            file.write(piece.encode())


def write_report(report: Report, path: Path) -> None:
    """Write what is reported in the format that the suffix names, one of REPORT_SUFFIXES."""
    import numpy as np

    from tolnet.model import replacing

    match path.suffix.lower():
        case ".npz":
            with replacing(path) as file:
                np.savez(file, allow_pickle=False, **report.arrays())
        case ".csv":
            write(path, report.csv())
        case ".md":
            write(path, report.markdown())
        case _:
            write(path, [render(report.document())])
