"""JSON documents that are not tables: how they open, and how they are written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tolnet import __version__

if TYPE_CHECKING:
    from tolnet.model import SensorNetwork


def opening(schema: str, network: SensorNetwork | None, status: str) -> dict[str, Any]:
    """The keys that open every document; null for what does not exist."""
    own = network.ambiguity if network is not None else None
    return {
        "schema": schema,
        "tolnet": __version__,
        "problem": None if network is None else {"name": network.name, "sha256": network.digest},
        "convention": own and own.convention,
        "tau": own and own.tau,
        "tolerance": own and own.tolerance,
        "status": status,
    }


def render(document: dict[str, Any]) -> str:
    """A document as text: null for NaN, "inf" for infinity, floats that read back as the same double."""
    from tolnet.design.export import plain

    return json.dumps(plain(document), indent=2, allow_nan=False) + "\n"


def write(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    from tolnet.model import replacing

    with replacing(path) as file:
        file.write(text.encode())
