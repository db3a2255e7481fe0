"""What is known of fading and channels, per node and per link; and what really happens in a simulation."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.model import _checks as checks
from tolnet.model._checks import Complaints
from tolnet.model.time_varying import (
    PerNode,
    TimeVarying,
    all_nodes_over_time,
    common_period,
    depth,
    function_of_time,
    over_time,
)

Fading = Literal["uniform", "constant", "bernoulli"]
ChannelNoise = Literal["uniform", "none"]
Noise = Literal["gaussian"]

ROUNDING = 1e-12
"""How far above tau (1 - tau), relatively, a variance may be by rounding alone."""


class LooseBoundWarning(UserWarning):
    """A bound that cannot be attained was given; the tightest one was taken instead."""


@dataclass(frozen=True)
class SimulationModel:
    """What really happens in a Monte Carlo study; the bounds of the network are what its filters know.

    `fading` "uniform" has the half width sqrt(3 phi) around tau; "constant" stays at tau; "bernoulli" is 1 with
    probability tau, else 0. `channel` "uniform" draws each entry of the noise on estimates, and each entry on and
    above the diagonal of the noise on matrices, from U[-half_width, half_width]; `half_width` None is the largest
    that the network's bounds allow.
    Raises InputError for other names and for a half width that is negative or no number.
    """

    fading: Fading = "uniform"
    channel: ChannelNoise = "uniform"
    half_width: float | None = None
    noise: Noise = "gaussian"

    def __post_init__(self) -> None:
        complaints = Complaints()
        for key, value, known in (
            ("simulation.fading", self.fading, get_args(Fading)),
            ("simulation.channel.kind", self.channel, get_args(ChannelNoise)),
            ("simulation.noise", self.noise, get_args(Noise)),
        ):
            if value not in known:
                names = " or ".join(map(repr, known))
                complaints.add(key, f"is {checks.shown(value)}; {names} was expected")
        if self.half_width is not None:
            meant, key = "a finite number >= 0", "simulation.channel.half_width"
            width = checks.number(self.half_width, key, meant, complaints)
            if width is not None and width < 0:
                complaints.add(key, f"is {checks.shown(self.half_width)}; {meant} was expected")
            object.__setattr__(self, "half_width", width)
        complaints.raise_if_any()


def parse_fading(mean: Any, variance: Any, N: int, complaints: Complaints) -> tuple[TimeVarying, ...] | None:
    """tau (T, N) in (0, 1] and phi (T, N) >= 0 of every node; phi is tightened to tau (1 - tau), with a warning."""
    tightened: dict[int, tuple[float, float, float]] = {}

    def parse(instant: Sequence[Any], found: Complaints) -> Sequence[ndarray] | None:
        tau = _per_node(instant[0], N, "fading_mean", "a number in (0, 1]", lambda x: 0 < x <= 1, found)
        phi = _per_node(instant[1], N, "fading_variance", "a number >= 0", lambda x: x >= 0, found)
        if tau is None or phi is None:
            return None
        most = tau * (1 - tau)
        for i in np.flatnonzero(phi > most * (1 + ROUNDING)):
            tightened.setdefault(int(i), (float(phi[i]), float(tau[i]), float(most[i])))
        return tau, np.minimum(phi, most)

    fading = all_nodes_over_time([PerNode(mean, 0, (0, 1)), PerNode(variance, 0, (0, 1))], parse, complaints)
    for i, (phi, tau, most) in sorted(tightened.items()):
        warnings.warn(
            f"sensors[{i}].fading_variance is {phi:.6g}; a factor in [0, 1] with mean {tau:.6g} has a variance of at"
            f" most tau (1 - tau) = {most:.6g}, which is taken",
            LooseBoundWarning,
            stacklevel=4,
        )
    return fading


def _per_node(
    value: Any, N: int, key: str, meant: str, allowed: Callable[[float], bool], complaints: Complaints
) -> Float[ndarray, " N"] | None:
    """One number a node, or one for all."""
    if isinstance(value, ndarray) and value.ndim == 1:
        value = value.tolist()
    if not isinstance(value, Sequence) or isinstance(value, str):
        number = _allowed(value, f"sensors.{key}", meant, allowed, complaints)
        return None if number is None else np.full(N, number)
    if len(value) != N:
        complaints.add(f"sensors.{key}", f"has {len(value)} entries; there are {N} nodes", shape=True)
        return None
    numbers = [_allowed(item, f"sensors[{i}].{key}", meant, allowed, complaints) for i, item in enumerate(value)]
    return None if None in numbers else np.array(numbers, dtype=float)


def _allowed(
    value: Any, key: str, meant: str, allowed: Callable[[float], bool], complaints: Complaints
) -> float | None:
    number = checks.number(value, key, meant, complaints)
    if number is None or allowed(number):
        return number
    complaints.add(key, f"is {checks.shown(value)}; {meant} was expected")
    return None


def parse_intervals(value: Any, N: int, complaints: Complaints) -> Int[ndarray, " N"] | None:
    """Delta_i of every node; one number counts for all. A single wrong number is the default's, `fusion.interval`."""
    if not isinstance(value, Sequence | ndarray):
        number = whole(value, "fusion.interval", complaints)
        return None if number is None else np.full(N, number)
    if len(value) != N:
        complaints.add("sensors.interval", f"has {len(value)} entries; there are {N} nodes", shape=True)
        return None
    found = [whole(item, f"sensors[{i}].interval", complaints) for i, item in enumerate(value)]
    return None if None in found else np.array(found, dtype=np.int64)


def whole(value: Any, key: str, complaints: Complaints) -> int | None:
    """A whole number of at least 1."""
    number = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not number or value < 1:
        complaints.add(key, f"is {checks.shown(value)}; a whole number >= 1 was expected")
        return None
    return int(value)


def parse_channel(
    name: str, default: Any, links: Any, ends: Int[ndarray, "E 2"], n: int, complaints: Complaints
) -> TimeVarying | None:
    """The bound `name` (estimate_noise or matrix_noise) of every pair that a node fuses, (T, E, n, n).

    `ends` [receiver, sender] lists the pairs; a node's own pair is exact and has a bound of zero. `default` and what
    the exceptions in `links` give are a number s, which means s I, or n x n; each may be periodic or a function.
    """

    def parse(value: Any, key: str, found: Complaints) -> ndarray | None:
        if depth(value) == 0:
            meant = "a number >= 0, or n x n,"
            number = checks.number(value, key, meant, found)
            if number is not None and number < 0:
                found.add(key, f"is {checks.shown(value)}; {meant} was expected")
            return None if number is None else number * np.eye(n)
        return checks.covariance(value, n, key, found, definite=False)

    def bound(value: Any, key: str) -> TimeVarying | None:
        return over_time(value, 0 if depth(value) == 1 else 2, key, parse, complaints)

    parts = [bound(default, f"channel.{name}")]
    owners = [np.flatnonzero(ends[:, 0] != ends[:, 1])]
    for index, (pair, link) in sorted(_exceptions(links, ends).items()):
        if name in link:
            parts.append(bound(link[name], f"channel.links[{index}].{name}"))
            owners.append(np.array([pair]))
    known = [part for part in parts if part is not None]
    if len(known) < len(parts):
        return None

    def at(k: int) -> ndarray:
        bounds = np.zeros((len(ends), n, n))
        for pairs, part in zip(owners, known, strict=True):
            bounds[pairs] = part(k)
        return bounds

    T = common_period(known)
    return function_of_time(at) if T is None else TimeVarying(np.stack([at(t) for t in range(T)]))


def check_links(links: Any, ends: Int[ndarray, "E 2"], complaints: Complaints) -> bool:
    """Complain about exceptions that are no links, are given twice, or say nothing. Whether all is well."""
    before = len(complaints.found)
    if not isinstance(links, Sequence) or not all(isinstance(link, Mapping) for link in links):
        complaints.add("channel.links", "is not a list of tables {from, to, estimate_noise, matrix_noise}")
        return False
    pairs = {(int(j), int(i)) for i, j in ends}
    first: dict[tuple[Any, Any], int] = {}
    for index, link in enumerate(links):
        key, pair = f"channel.links[{index}]", (link.get("from"), link.get("to"))
        strange = set(link) - {"from", "to", "estimate_noise", "matrix_noise"}
        if strange:
            complaints.add(f"{key}.{min(strange)}", "is no known key; from, to, estimate_noise, matrix_noise are")
        if pair[0] == pair[1]:
            complaints.add(key, f"goes from node {pair[0]} to itself; a node's own pair is exact")
        elif pair not in pairs:
            complaints.add(key, f"goes from node {pair[0]} to node {pair[1]}, where no link is")
        elif pair in first:
            complaints.add(key, f"is of the same link as links[{first[pair]}]")
        elif not {"estimate_noise", "matrix_noise"} & set(link):
            complaints.add(key, "has neither estimate_noise nor matrix_noise; at least one was expected")
        first.setdefault(pair, index)
    return len(complaints.found) == before


def _exceptions(links: Any, ends: Int[ndarray, "E 2"]) -> dict[int, tuple[int, Mapping[str, Any]]]:
    """For each exception, by its place in the list: the pair that it is about, and itself."""
    place = {(int(j), int(i)): e for e, (i, j) in enumerate(ends)}
    return {index: (place[link["from"], link["to"]], link) for index, link in enumerate(links)}
