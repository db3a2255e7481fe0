"""The deployment that a certificate states, as values again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates.deployed import Centre, Deployed
from tolnet.certificates.numerals import vector
from tolnet.model import InputError, SensorNetwork


def stated_deployment(data: Mapping[str, Any]) -> Deployed:
    """The `data` of a certificate whose form the checker has found to be right.

    Raises InputError where the numbers are no sensor network: an R that is not positive definite, say.
    """
    n, N = data["n"], data["nodes"]
    C = [_matrix(text, -1, n) for text in data["C"]]
    noise = [_noise(entry, len(C_k)) for entry, C_k in zip(data["noise"], C, strict=True)]
    process = data["process"]
    neighbours = data["neighbours"]
    directed = data["directed"]
    links = [[l, k] for k, heard in enumerate(neighbours) for l in heard if l != k and (directed or l < k)]
    network = SensorNetwork(
        A=_matrix(data["A"], n, n),
        B=_matrix(process["B"], n, process["columns"]) if "B" in process else None,
        Q=_matrix(process["Q"], n, n) if "Q" in process else None,
        C=C,
        R=[R for R, _ in noise],
        D=[D for _, D in noise],
        edges=links,
        directed=directed,
    )
    if network.N != N:
        raise InputError(f"states {N} nodes, and sensors of {network.N}")
    heard = np.array([l for each in neighbours for l in each], dtype=np.int64)
    widths = np.diff(network.rows)
    columns = np.concatenate([[0], np.cumsum(widths[heard])])
    gains = [_matrix(text, n, -1).T.reshape(-1, n) for text in data["gains"]]
    return Deployed(
        network,
        np.concatenate([[0], np.cumsum([len(each) for each in neighbours])]),
        heard,
        np.concatenate([vector(text) for text in data["weights"]]),
        columns,
        np.concatenate(gains) if gains else np.empty((0, n)),
        _centre(data["centre"], n),
    )


def _matrix(text: str, height: int, width: int) -> Float[ndarray, "h w"]:
    entries = vector(text)
    if height < 0:
        height = len(entries) // width
    return entries.reshape(height, len(entries) // height if width < 0 and height else max(width, 0))


def _noise(entry: Mapping[str, str], p: int) -> tuple[ndarray | None, ndarray | None]:
    R, D = (_matrix(entry[key], p, p) if key in entry else None for key in ("R", "D"))
    return R, D


def _centre(stated: Mapping[str, Any] | None, n: int) -> Centre | None:
    if stated is None:
        return None
    gain = [_matrix(text, n, -1).T.reshape(-1, n) for text in stated["gain"]]
    return Centre(np.concatenate(gain), _matrix(stated["tilt"], n, stated["columns"]))
