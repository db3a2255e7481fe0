"""Writing problem files: whole or not at all, and so that reading them back changes no bit."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomli_w
from numpy import ndarray

from tolnet.model import writing_corrupted as corrupted
from tolnet.model.archive import archive_bytes
from tolnet.model.corrupted import CorruptedNetwork
from tolnet.model.errors import Complaint, InputError
from tolnet.model.network import SensorNetwork
from tolnet.model.whole_files import check_writable, replacing

Either = SensorNetwork | CorruptedNetwork

LARGEST_TEXT = 10_000
"""How many numbers a network may have before `save` puts its arrays into an archive of its own accord."""

LARGEST_INLINE = 400
"""How many numbers a matrix of the plant, or how many names, stay in the text beside an archive."""


def save(network: Either, path: str | Path, arrays: bool | Literal["auto"] = "auto") -> list[Path]:
    """Write a network as a problem file, from which `load` gives it back without the change of a bit.

    A CorruptedNetwork is given back by `load_corrupted`; functions of k are refused.

    `arrays` True puts large matrices, sensors and links into an archive beside the file (`problem.npz` beside
    `problem.toml`); False keeps everything in the text; "auto" decides by size. Returns the paths written.
    Each file is written beside its target and renamed into place, the archive first.
    Raises InputError for a path that cannot be written.
    """
    if isinstance(network, CorruptedNetwork):
        corrupted.check_periodic(network)
    path = Path(path)
    side = path.with_suffix(".npz")
    if side == path:
        raise InputError("is the name of an archive; give the problem file another suffix", source=str(path))
    apart = _numbers(network) > LARGEST_TEXT if arrays == "auto" else arrays
    archive: dict[str, ndarray] | None = {} if apart else None
    content = _content(network, side.name, archive)
    files = {path: _toml(content).encode()}
    if archive is not None:
        files = {side: archive_bytes(archive), **files}
    for target in files:
        check_writable(target)
    for target, data in files.items():
        with replacing(target) as file:
            file.write(data)
    return [path] if archive is None else [path, side]


def _numbers(network: Either) -> int:
    links = 2 * len(network.links)
    if isinstance(network, CorruptedNetwork):
        varying = (network.A, network.F, network.Q, network.C, network.R, network.tau)
        return sum(part.one_period.size for part in varying) + links
    weights = 0 if isinstance(network.diffusion, str) else network.N**2
    return network.A.size + network.Q.size + network.C.size + network.R.size + links + weights


def _toml(content: dict[str, Any]) -> str:
    """The text of a file, with each list of numbers on one line, where tomli_w would spread it over many.

    No text is touched: inside one, tomli_w writes a line break as an escape.
    """
    numbers = re.compile(r"\[\n\s+([-+.\w\s,]*),\n\s*\]")
    return numbers.sub(lambda found: "[" + " ".join(found[1].split()) + "]", tomli_w.dumps(content))


def _content(network: Either, side: str, archive: dict[str, ndarray] | None) -> dict[str, Any]:
    """The tables of the file; arrays that do not belong into them are put into `archive`, where there is one."""

    def kept(name: str, value: ndarray) -> Any:
        if archive is None or value.size <= LARGEST_INLINE:
            return value.tolist()
        archive[name] = value
        return {"array": name}

    content: dict[str, Any] = {"schema": "tolnet.problem/1", "name": network.name}
    if network.description:
        content["description"] = network.description
    if archive is not None:
        content["arrays"] = side
    other = isinstance(network, CorruptedNetwork)
    content["plant"] = (corrupted.plant_table(network, kept) if other else _plant(network, kept)) | _labels(network)
    content["network"] = _graph(network, kept, archive)
    if archive is None or (not other and _mixed(network)):
        sensors = [_sensor(network, k) for k in range(network.N)] if not other else corrupted.sensor_tables(network)
        content["sensors"] = sensors
    else:
        archive |= corrupted.packed_sensors(network) if other else _packed(network)
    if other:
        return content | corrupted.channel_tables(network, archive)
    if network.ambiguity is not None:
        ambiguity = network.ambiguity
        content["ambiguity"] = {
            "tolerance": ambiguity.tolerance,
            "convention": ambiguity.convention,
            "tau": ambiguity.tau,
        }
    content["diffusion"] = _diffusion(network, archive)
    return content


def _plant(network: SensorNetwork, kept: Any) -> dict[str, Any]:
    factor = "Q" if network.B is None else "B"
    plant = {"A": kept("A", network.A), factor: kept(factor, getattr(network, factor))}
    if network.input is not None:
        plant["input"] = kept("input", network.input)
    for key, default in (("initial_mean", np.zeros(network.n)), ("initial_covariance", np.eye(network.n))):
        value: ndarray = getattr(network, key)
        if value.tobytes() != default.tobytes():
            plant[key] = kept(key, value)
    return plant


def _labels(network: Either) -> dict[str, Any]:
    labels = {} if network.states is None else {"states": list(network.states)}
    return labels if network.dt is None else {**labels, "dt": network.dt}


def _graph(network: Either, kept: Any, archive: dict[str, ndarray] | None) -> dict[str, Any]:
    graph: dict[str, Any] = {"nodes": network.N, "directed": network.directed}
    if archive is None:
        graph["edges"] = network.links.tolist()
    else:
        archive["edges"] = network.links.astype(np.int32 if network.N < 2**31 else np.int64)
    if network.positions is not None:
        graph["positions"] = kept("positions", network.positions)
    if network.names is not None:
        graph["names"] = kept("names", np.array(network.names))
    return graph


def _mixed(network: SensorNetwork) -> bool:
    """Whether some nodes gave R and some D, which only a table for each node can say."""
    return network.factors is not None and not network.factors.filled[np.diff(network.rows) > 0].all()


def _sensor(network: SensorNetwork, k: int) -> dict[str, Any]:
    C, R = network.sensor(k)
    if network.factors is not None and network.factors.filled[k]:
        return {"C": C.tolist(), "D": network.factors.block(k).tolist()}
    return {"C": C.tolist(), "R": R.tolist()}


def _packed(network: SensorNetwork) -> dict[str, ndarray]:
    """C and its noise as stacks where every node has as many rows, else as C, offsets and flattened blocks."""
    letter = "R" if network.D is None else "D"
    C, blocks = network.C, getattr(network, letter)
    p = int(network.rows[1])
    if (np.diff(network.rows) == p).all():
        return {"C": C.reshape(network.N, p, network.n), letter: blocks.reshape(network.N, p, p)}
    return {"C": C, letter: blocks, "rows": network.rows}


def _diffusion(network: SensorNetwork, archive: dict[str, ndarray] | None) -> dict[str, Any]:
    W = network.diffusion
    if isinstance(W, str):
        return {"rule": W}
    if archive is None:
        if network.N > LARGEST_TEXT:
            message = f"is {network.N} x {network.N}, too large for text; save with arrays=True"
            raise InputError([Complaint("diffusion.weights", message)])
        return {"weights": W.toarray().tolist()}
    own = W.tocoo()
    archive["W"] = np.stack([own.row, own.col, own.data], axis=1)
    return {"weights": {"triples": "W"}}
