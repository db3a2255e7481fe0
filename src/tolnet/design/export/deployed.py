"""What was deployed, read back from a table's file: gains, weights, tolerances and the centre's filter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.design.export.deployment import Deployment
from tolnet.design.export.reading import read_table
from tolnet.design.export.record import TableRecord
from tolnet.model import Complaint, InputError, gamma_per
from tolnet.model.archive import read_archive
from tolnet.model.bounded_reading import LARGEST_ARCHIVE, LARGEST_TEXT, read_whole, text_of

DEPLOYED_SUFFIXES = (".npz", ".json")


@dataclass(frozen=True, eq=False)
class DeployedTable:
    """A table as it was deployed: numbers without the network that they came from."""

    record: TableRecord
    deployment: Deployment
    central_P: Float[ndarray, "n n"]
    central_V: Float[ndarray, "n n"]
    P: Float[ndarray, "N n n"]

    @property
    def tolerance(self) -> float:
        """c of the network on the gamma scale."""
        return self.record.tolerance * gamma_per(self.record.convention)

    @property
    def tolerances(self) -> Float[ndarray, " N"]:
        """c_k on the gamma scale."""
        return self.record.nodes["tolerance"] * gamma_per(self.record.convention)


def read_deployed(path: Path) -> DeployedTable:
    """What `tolnet table -o FILE.npz`, or `--full -o FILE.json`, wrote, bit for bit.

    Raises InputError, naming the file, where it is missing, damaged, or a table without gains.
    """
    suffix = path.suffix.lower()
    if suffix not in DEPLOYED_SUFFIXES:
        raise InputError("is no table with gains: .npz, or .json written with --full, was expected", source=str(path))
    record = read_table(path)
    try:
        values = _of_archive(path) if suffix == ".npz" else _of_document(path)
        n = len(values["central_P"])
        N = len(record.nodes["node"])
        deployment = Deployment(*(np.asarray(values[key]) for key in _PACKED))
        shapes = {"central_P": (n, n), "central_V": (n, n), "P": (N, n, n)}
        good = all(np.shape(values[key]) == shape for key, shape in shapes.items())
        if not (good and _fits(deployment, N, n)):
            raise ValueError("its arrays do not fit one another")
    except KeyError as missing:
        hint = "; write it with --full" if suffix == ".json" else ""
        raise InputError([Complaint(str(missing.args[0]), f"is missing{hint}")], source=str(path)) from None
    except (ValueError, TypeError, IndexError, OverflowError) as error:
        raise InputError(f"holds no gains that can be read: {error}", source=str(path)) from None
    return DeployedTable(record, deployment, values["central_P"], values["central_V"], values["P"])


_PACKED = ("offsets", "neighbours", "weights", "columns", "gains")


def _fits(deployment: Deployment, N: int, n: int) -> bool:
    d = deployment
    whole = all(x.dtype.kind in "iu" and x.ndim == 1 for x in (d.offsets, d.neighbours, d.columns))
    if not (whole and len(d.offsets) == N + 1 and len(d.columns) == len(d.neighbours) + 1):
        return False
    rising = all(x[0] == 0 and (np.diff(x) >= 0).all() for x in (d.offsets, d.columns))
    ends = d.offsets[-1] == len(d.neighbours) == len(d.weights) and d.gains.shape == (d.columns[-1], n)
    return bool(rising and ends and all(x.dtype == np.float64 for x in (d.weights, d.gains)))


def _of_archive(path: Path) -> dict[str, ndarray]:
    archive = read_archive(read_whole(path, LARGEST_ARCHIVE))
    names = {
        "offsets": "neighbour_offsets",
        "neighbours": "neighbours",
        "weights": "weights",
        "columns": "gain_offsets",
        "gains": "gains",
        "central_P": "central_P",
        "central_V": "central_V",
        "P": "nodes_P",
    }
    return {key: archive[name] for key, name in names.items()}


def _of_document(path: Path) -> dict[str, Any]:
    import json

    document = json.loads(text_of(read_whole(path, LARGEST_TEXT)))
    nodes, central = document["nodes"], document["central"]
    links = [node["neighbours"] for node in nodes]
    columns = [link["columns"] for each in links for link in each]
    widths = np.array([stop - start for start, stop in columns], dtype=np.int64)
    gains = [_matrix(node["gain"]) for node in nodes]
    n = len(central["P"])
    return {
        "offsets": np.concatenate([[0], np.cumsum([len(each) for each in links])]),
        "neighbours": np.array([link["node"] for each in links for link in each], dtype=np.int64),
        "weights": _matrix([link["weight"] for each in links for link in each]),
        "columns": np.concatenate([[0], np.cumsum(widths)]).astype(np.int64),
        "gains": np.concatenate([np.empty((0, n)), *(gain.reshape(n, -1).T for gain in gains)]),
        "central_P": _matrix(central["P"]),
        "central_V": _matrix(central["V"]),
        "P": np.stack([_matrix(node["P"]) for node in nodes]),
    }


def _matrix(value: Mapping[str, Any] | list[Any]) -> ndarray:
    """Numbers, NaN for null."""
    return np.array(value, dtype=float)
