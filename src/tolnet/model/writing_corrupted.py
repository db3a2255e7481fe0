"""What a problem file says of a network with corrupted channels; `save` writes it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy import ndarray

from tolnet.model._checks import Complaints
from tolnet.model.channels import SimulationModel
from tolnet.model.corrupted import CorruptedNetwork
from tolnet.model.errors import Complaint, InputError
from tolnet.model.fusion import FUSION_RULES, parse_fusion
from tolnet.model.sensors import Packed

Kept = Callable[[str, ndarray], Any]
"""Puts an array into the text, or into the archive under a name and a reference to it into the text."""

_KEYS = {
    "A": "plant.A",
    "F": "plant.F",
    "Q": "plant.Q",
    "mu": "plant.multiplicative_variance",
    "C": "sensors.C",
    "R": "sensors.R",
    "tau": "sensors.fading_mean",
    "phi": "sensors.fading_variance",
    "W_bar": "channel.estimate_noise",
    "D_bar": "channel.matrix_noise",
}


def check_periodic(network: CorruptedNetwork) -> None:
    """Refuse functions of k, which no file can hold. Raises InputError with the key of each."""
    functions = [letter for letter, part in network.varying.items() if part.period is None]
    message = "is a function of k, which a file cannot hold; give one period as an array"
    if functions:
        raise InputError([Complaint(_KEYS[letter], message) for letter in functions])


def plant_table(network: CorruptedNetwork, kept: Kept) -> dict[str, Any]:
    """A, Q, and what a plant has here beside them."""
    plant = {"A": kept("A", _short(network.A.one_period)), "Q": kept("Q", _short(network.Q.one_period))}
    if network.F.one_period.any():
        plant["F"] = kept("F", _short(network.F.one_period))
    if network.mu.one_period.any():
        plant["multiplicative_variance"] = _number(network.mu.one_period)
    if network.initial_mean.tobytes() != np.zeros(network.n).tobytes():
        plant["initial_mean"] = kept("initial_mean", network.initial_mean)
    P_0 = network.initial_covariance
    if _same(P_0) and P_0[0].tobytes() != np.eye(network.n).tobytes():
        plant["initial_covariance"] = kept("initial_covariance", P_0[0])
    return plant | {"initial_second_moment": kept("initial_second_moment", network.initial_second_moment)}


def sensor_tables(network: CorruptedNetwork) -> list[dict[str, Any]]:
    """One table a node."""
    C, R = network.C.one_period, network.R.one_period
    R = R[:1] if _same(R) else R
    blocks = [Packed(C[0], network.rows, R_t) for R_t in R]
    tables: list[dict[str, Any]] = []
    for i in range(network.N):
        own = C[:, network.rows[i] : network.rows[i + 1]]
        tables.append(
            {
                "C": _short(own).tolist() if own.shape[1] else [],
                "R": _short(np.stack([block.block(i) for block in blocks])).tolist() if own.shape[1] else [],
            }
        )
    for key, values in _fading(network).items():
        for i, table in enumerate(tables):
            table[key] = _number(values[:, i])
    for key, values in _each(network).items():
        for i, table in enumerate(tables):
            table[key] = values[i].tolist()
    return tables


def packed_sensors(network: CorruptedNetwork) -> dict[str, ndarray]:
    """The same as arrays of an archive: stacks where every node has as many rows, else packed with offsets."""
    C, R, N, p = network.C.one_period, network.R.one_period, network.N, int(network.rows[1])
    R = R[:1] if _same(R) else R
    if (np.diff(network.rows) == p).all():
        arrays = {"C": C.reshape(len(C), N, p, network.n), "R": R.reshape(len(R), N, p, p)}
    else:
        arrays = {"C": C, "R": R}
    arrays |= _fading(network)
    packed = {key: _short(value) for key, value in arrays.items()}
    if (np.diff(network.rows) != p).any():
        packed["rows"] = network.rows
    names = {"initial_covariance": "P0"}
    return packed | {names.get(key, key): value for key, value in _each(network).items()}


def channel_tables(network: CorruptedNetwork, archive: dict[str, ndarray] | None) -> dict[str, Any]:
    """[channel], [fusion] and [simulation]."""
    tables: dict[str, Any] = {"channel": _channel(network), "fusion": _weights(network, archive)}
    if network.window != 1:
        tables["fusion"]["window"] = network.window
    if _same(network.interval) and network.interval[0] != 1:
        tables["fusion"]["interval"] = int(network.interval[0])
    own = network.simulation
    channel = {"kind": own.channel} | ({} if own.half_width is None else {"half_width": own.half_width})
    if own != SimulationModel():
        tables["simulation"] = {"fading": own.fading, "channel": channel, "noise": own.noise}
    return tables


def _fading(network: CorruptedNetwork) -> dict[str, ndarray]:
    """tau and phi, (T, N), where they are not the default."""
    found = {"fading_mean": network.tau.one_period, "fading_variance": network.phi.one_period}
    defaults = {"fading_mean": 1.0, "fading_variance": 0.0}
    return {key: value for key, value in found.items() if (value != defaults[key]).any()}


def _each(network: CorruptedNetwork) -> dict[str, ndarray]:
    """What differs from node to node and never in time: intervals and P_0."""
    found = {"interval": network.interval, "initial_covariance": network.initial_covariance}
    return {key: value for key, value in found.items() if not _same(value)}


def _channel(network: CorruptedNetwork) -> dict[str, Any]:
    """The bound that most links have, and exceptions."""
    own = network.pairs[:, 0] == network.pairs[:, 1]
    channel: dict[str, Any] = {}
    links: dict[int, dict[str, Any]] = {}
    for key, bounds in (("estimate_noise", network.W_bar), ("matrix_noise", network.D_bar)):
        values = bounds.one_period
        others = {int(e): values[:, e] for e in np.flatnonzero(~own)}
        if not others:
            continue
        usual, _ = Counter(value.tobytes() for value in others.values()).most_common(1)[0]
        default = next(value for value in others.values() if value.tobytes() == usual)
        if default.any():
            channel[key] = _bound(default)
        for e, value in others.items():
            if value.tobytes() != usual:
                i, j = network.pairs[e].tolist()
                links.setdefault(e, {"from": j, "to": i})[key] = _bound(value)
    return channel | ({"links": [links[e] for e in sorted(links)]} if links else {})


def _bound(values: ndarray) -> Any:
    """A bound as people write it: s for s I, a matrix, or a list of either over one period."""
    eye = np.eye(values.shape[-1])
    numbers = values[:, 0, 0]
    if (numbers[:, None, None] * eye).tobytes() == np.ascontiguousarray(values).tobytes():
        return _number(numbers)
    return _short(values).tolist()


def _weights(network: CorruptedNetwork, archive: dict[str, ndarray] | None) -> dict[str, Any]:
    fusion = network.fusion
    for rule in FUSION_RULES:
        same = parse_fusion(rule, network.adjacency, Complaints())
        if same.data.tobytes() == fusion.data.tobytes():
            return {"rule": rule}
    if archive is None:
        return {"weights": fusion.toarray().tolist()}
    own = fusion.tocoo()
    archive["a"] = np.stack([own.row, own.col, own.data], axis=1)
    return {"weights": {"triples": "a"}}


def _same(values: ndarray) -> bool:
    """Whether all members along the leading axis are the same to the last bit."""
    return all(value.tobytes() == values[0].tobytes() for value in values[1:])


def _short(values: ndarray) -> ndarray:
    """Without the leading axis of a period of one."""
    return values[0] if len(values) == 1 else values


def _number(values: ndarray) -> Any:
    return float(values[0]) if len(values) == 1 else values.tolist()
