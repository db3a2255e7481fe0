"""The network with corrupted channels: multiplicative noise, fading measurements, noise on all that nodes send."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.model import _checks as checks
from tolnet.model import sensors
from tolnet.model._checks import Complaints, frozen
from tolnet.model.channels import (
    SimulationModel,
    check_links,
    parse_channel,
    parse_fading,
    parse_intervals,
    whole,
)
from tolnet.model.fusion import FUSION_RULES, parse_fusion
from tolnet.model.network import SensorNetwork
from tolnet.model.nodes import Nodes, parse_nodes
from tolnet.model.sensors import Packed
from tolnet.model.time_varying import PerNode, TimeVarying, all_nodes_over_time, common_period, over_time


class Instant(NamedTuple):
    """Everything about one instant k, in the letters of the method."""

    A: Float[ndarray, "n n"]
    F: Float[ndarray, "n n"]
    Q: Float[ndarray, "n n"]
    mu: float
    sensors: Packed
    """C_{k,i} and R_{k,i}."""
    tau: Float[ndarray, " N"]
    phi: Float[ndarray, " N"]
    W_bar: Float[ndarray, "E n n"]
    """Bounds of the noise on received estimates, one a pair (`pairs`), zero for a node's own."""
    D_bar: Float[ndarray, "E n n"]
    """Bounds of the noise on received matrices, likewise."""


@dataclass(frozen=True, eq=False, init=False, repr=False)
class CorruptedNetwork(Nodes):
    """A plant with multiplicative noise, watched through fading sensors by nodes that talk over noisy channels.

        x_{k+1} = (A_k + eps_k F_k) x_k + w_k,     y_{k,i} = gamma_{k,i} C_{k,i} x_k + v_{k,i}          eqs. (1), (2)
        node i hears (x~_{k,j} + e_{k,i,j},  P~_{k,j} + D_{k,i,j}) from j, and its own pair exactly              (3)

    Assumes all noises zero mean and independent in time and space; E w w' <= Q_k, E v v' <= R_{k,i},
    E eps^2 <= mu_k; gamma in [0, 1] with mean tau_{k,i} and variance at most phi_{k,i}; E e e' <= W_{k,i,j} and, for
    every realisation, -D_{k,i,j} <= noise on the matrix <= D_{k,i,j} (Assumption 2.1). A_k is non-singular, Q_k and
    R_{k,i} are positive definite, the graph is strongly connected, fusion weights are row stochastic and positive
    exactly where a node hears.

    Whatever depends on k is a `TimeVarying`: `network.A(3)` is A_3, `network.at(3)` everything at once. The
    constructor takes constants; arrays with one more axis in front, one period long (different quantities may have
    different periods); or functions of k. Shapes at one instant, with N nodes, M = sum p_i rows and E pairs
    (receiver, sender): A, F, Q (n, n); mu (); C (M, n), node i owning rows `rows[i]:rows[i + 1]`; R flattened blocks;
    tau, phi (N,); W, D (E, n, n). C and R (or its factor D) and the graph are given as to SensorNetwork;
    `fading_mean`, `fading_variance` and `interval` as one number for all nodes or one a node; `estimate_noise` and
    `matrix_noise` as a number s, which means s I, or n x n, with exceptions in `links`, tables {from, to,
    estimate_noise, matrix_noise}; `initial_covariance` as n x n or one a node; `fusion` as a_ij, N x N, or a rule.
    Units: those of the state squared for Q, Pi_0, P_0, W and D.

    Raises InputError (ShapeError where only shapes are wrong) with every complaint at once, in the key paths of the
    problem file. A fading variance above tau (1 - tau) is tightened to that with a LooseBoundWarning.
    Source: distributed robust Kalman filtering over corrupted channels, eqs. (1)-(3), Assumption 2.1;
    docs/mathematics.md, section 13.
    """

    A: TimeVarying
    F: TimeVarying
    Q: TimeVarying
    mu: TimeVarying
    C: TimeVarying
    R: TimeVarying
    rows: Int[ndarray, " N1"]
    tau: TimeVarying
    phi: TimeVarying
    W_bar: TimeVarying
    D_bar: TimeVarying
    initial_mean: Float[ndarray, " n"]
    initial_covariance: Float[ndarray, "N n n"]
    """P_{0,i} of every node."""
    initial_second_moment: Float[ndarray, "n n"]
    """Pi_0, a bound on E x_0 x_0'."""
    adjacency: sparse.csr_array
    """N x N, boolean, self-loops included: [l, k] says that node k hears node l."""
    directed: bool
    fusion: sparse.csr_array
    """a_ij, N x N: row i says how node i weighs what it receives from j; rows sum to one."""
    window: int
    """L: how many pairs a node keeps of each neighbour, the current one included."""
    interval: Int[ndarray, " N"]
    """Delta_i: node i may solve the fusion problem at the instants that it divides."""
    simulation: SimulationModel
    states: tuple[str, ...] | None
    dt: float | None
    positions: Float[ndarray, "N d"] | None
    names: tuple[str, ...] | None
    name: str
    description: str
    digest: str | None
    """SHA-256 of the bytes of the file, and of its side archive, that the network was loaded from."""

    def __init__(
        self,
        *,
        A: Any,
        B: Any = None,
        Q: Any = None,
        F: Any = None,
        multiplicative_variance: Any = 0.0,
        C: Any,
        R: Any = None,
        D: Any = None,
        rows: Any = None,
        fading_mean: Any = 1.0,
        fading_variance: Any = 0.0,
        estimate_noise: Any = 0.0,
        matrix_noise: Any = 0.0,
        links: Any = (),
        initial_mean: Any = None,
        initial_covariance: Any = None,
        initial_second_moment: Any = None,
        adjacency: Any = None,
        edges: Any = None,
        directed: bool = False,
        fusion: Any = FUSION_RULES[0],
        window: int = 1,
        interval: Any = 1,
        simulation: SimulationModel | None = None,
        states: Sequence[str] | None = None,
        dt: float | None = None,
        positions: Any = None,
        names: Any = None,
        name: str = "",
        description: str = "",
        digest: str | None = None,
    ) -> None:
        complaints = Complaints()
        values = _parse_plant(A, B, Q, F, multiplicative_variance, complaints)
        n = None if values["A"] is None else values["A"](0).shape[0]
        values |= _parse_sensors(C, R, D, rows, n, complaints)
        N = sensors.count(C, rows) if values["rows"] is None else len(values["rows"]) - 1
        values |= _parse_start(initial_mean, initial_covariance, initial_second_moment, n, N, complaints)
        if not isinstance(directed, bool | np.bool_):
            complaints.add("network.directed", f"is {checks.shown(directed)}; true or false was expected")
        if N:
            values["tau"], values["phi"] = parse_fading(fading_mean, fading_variance, N, complaints) or (None, None)
            values["interval"] = parse_intervals(interval, N, complaints)
            key = "network.adjacency" if edges is None and adjacency is not None else "network.edges"
            before = len(complaints.found)
            values |= parse_nodes(adjacency, edges, bool(directed), positions, names, N, complaints)
            if len(complaints.found) == before:
                _check_connected(values["adjacency"], key, complaints)
            if values["adjacency"] is not None:
                values["fusion"] = parse_fusion(fusion, values["adjacency"], complaints)
            if n and values["adjacency"] is not None:
                heard = sparse.coo_array(values["adjacency"].T.tocsr())
                ends = np.stack([heard.row, heard.col], axis=1)
                exceptions = links if check_links(links, ends, complaints) else ()
                for letter, bound, given in (
                    ("W_bar", "estimate_noise", estimate_noise),
                    ("D_bar", "matrix_noise", matrix_noise),
                ):
                    values[letter] = parse_channel(bound, given, exceptions, ends, n, complaints)
        values |= {
            "window": whole(window, "fusion.window", complaints),
            "simulation": SimulationModel() if simulation is None else simulation,
            "states": checks.labels(states, n, "plant.states", f"plant.A is {n} x {n}", complaints),
            "dt": None if dt is None else checks.number(dt, "plant.dt", "a positive number of seconds", complaints),
            "name": name,
            "description": description,
            "digest": digest,
        }
        if values["dt"] is not None and values["dt"] <= 0:
            complaints.add("plant.dt", f"is {checks.shown(dt)}; a positive number of seconds was expected")
        checks.text(name, "name", complaints)
        checks.text(description, "description", complaints, lines=True)
        if not isinstance(values["simulation"], SimulationModel):
            complaints.add("simulation", f"is {checks.shown(simulation)}; a SimulationModel was expected")
        complaints.raise_if_any()
        for key, value in values.items():
            object.__setattr__(self, key, frozen(value) if isinstance(value, ndarray) else value)

    @classmethod
    def of(cls, network: SensorNetwork) -> CorruptedNetwork:
        """The same plant, sensors and graph with exact channels: tau = 1 and nothing else but w and v_k.

        Its known input is left out: without multiplicative noise and fading it enters no covariance.
        Raises InputError where A is singular, Q is not positive definite or the graph is not strongly connected.
        """
        return cls(
            A=network.A,
            Q=network.Q,
            C=network.C,
            R=network.R,
            rows=network.rows,
            adjacency=network.adjacency,
            directed=network.directed,
            initial_mean=network.initial_mean,
            initial_covariance=network.initial_covariance,
            **{key: getattr(network, key) for key in ("states", "dt", "positions", "names")},
            **{key: getattr(network, key) for key in ("name", "description", "digest")},
        )

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.initial_second_moment)

    @property
    def varying(self) -> dict[str, TimeVarying]:
        """Everything that may depend on the instant, by its letter."""
        return {letter: getattr(self, letter) for letter in _VARYING}

    @cached_property
    def period(self) -> int | None:
        """After how many instants everything repeats: 1 where it is constant; None where something is a function."""
        return common_period(self.varying.values())

    @cached_property
    def pairs(self) -> Int[ndarray, "E 2"]:
        """[receiver, sender] of everything that is fused, a node's own pair included, sorted by receiver."""
        own = self.fusion.tocoo()
        return frozen(np.stack([own.row, own.col], axis=1).astype(np.int64))

    def replaced(
        self,
        *,
        fading_mean: Any = None,
        fading_variance: Any = None,
        multiplicative_variance: Any = None,
        estimate_noise: Any = None,
        matrix_noise: Any = None,
    ) -> CorruptedNetwork:
        """The same network with other fading, multiplicative noise or channel bounds, in the constructor's forms.

        Bounds that are given count for every link. Raises InputError as the constructor does.
        """
        complaints, values = Complaints(), {}
        if fading_mean is not None or fading_variance is not None:
            mean = self.tau.given if fading_mean is None else fading_mean
            variance = self.phi.given if fading_variance is None else fading_variance
            found = parse_fading(mean, variance, self.N, complaints)
            values["tau"], values["phi"] = found or (None, None)
        if multiplicative_variance is not None:
            values["mu"] = parse_variance(multiplicative_variance, complaints)
        for letter, name, given in (
            ("W_bar", "estimate_noise", estimate_noise),
            ("D_bar", "matrix_noise", matrix_noise),
        ):
            if given is not None:
                values[letter] = parse_channel(name, given, (), self.pairs, self.n, complaints)
        complaints.raise_if_any()
        return self._with(values)

    def scaled(self, letter: str, factor: float) -> CorruptedNetwork:
        """The same network with tau, phi, mu, W_bar or D_bar multiplied by a factor >= 0 at every instant.

        Raises InputError where tau or phi leave their range, as the constructor does.
        """
        part: TimeVarying = getattr(self, letter)
        if letter in ("tau", "phi"):
            key = {"tau": "fading_mean", "phi": "fading_variance"}[letter]
            return self.replaced(**{key: part.times(factor).given})
        return self._with({letter: part.times(factor)})

    def _with(self, values: dict[str, Any]) -> CorruptedNetwork:
        other = copy.copy(self)
        other.__dict__.pop("period", None)
        other.__dict__.update(values)
        return other

    def sensors(self, k: int) -> Packed:
        """C_{k,i} and R_{k,i} of every node, packed."""
        return Packed(self.C(k), self.rows, self.R(k))

    def at(self, k: int) -> Instant:
        """Everything at instant k."""
        return Instant(
            A=self.A(k),
            F=self.F(k),
            Q=self.Q(k),
            mu=float(self.mu(k)),
            sensors=self.sensors(k),
            tau=self.tau(k),
            phi=self.phi(k),
            W_bar=self.W_bar(k),
            D_bar=self.D_bar(k),
        )

    def __repr__(self) -> str:
        kind = "directed links" if self.directed else "links"
        of = {None: ", functions of k", 1: ""}.get(self.period, f", period {self.period}")
        return f"<CorruptedNetwork {self.name!r}: n = {self.n}, N = {self.N}, {len(self.links)} {kind}{of}>"


_VARYING = ("A", "F", "Q", "mu", "C", "R", "tau", "phi", "W_bar", "D_bar")


def _parse_plant(A: Any, B: Any, Q: Any, F: Any, mu: Any, complaints: Complaints) -> dict[str, Any]:
    """A, F, Q and mu over time; where A cannot be used, the shapes of the others are left alone."""
    sizes: list[int] = []

    def plant(value: Any, key: str, more: Complaints) -> ndarray | None:
        array = _non_singular(value, sizes[0] if sizes else None, key, more)
        if array is not None and not sizes:
            sizes.append(len(array))
        return array

    found = over_time(A, 2, "plant.A", plant, complaints)
    n = sizes[0] if sizes else None
    many = "n" if n is None else str(n)

    def square(value: Any, key: str, more: Complaints) -> ndarray | None:
        return checks.shaped(value, (n, n), key, f"{many} x {many}", more)

    def covariance(value: Any, key: str, more: Complaints) -> ndarray | None:
        return checks.covariance(value, n, key, more, definite=True)

    def gramian(value: Any, key: str, more: Complaints) -> ndarray | None:
        factor = checks.shaped(value, (n, None), key, f"{many} x m", more)
        return None if factor is None else covariance(sensors.gramian(factor), key, more)

    if (B is None) == (Q is None):
        complaints.add("plant", f"has {'neither' if B is None else 'both'} B and Q; exactly one was expected")
    noise = over_time(B, 2, "plant.B", gramian, complaints) if Q is None else None
    noise = noise if Q is None else over_time(Q, 2, "plant.Q", covariance, complaints)
    mu = parse_variance(mu, complaints)
    if F is None:
        F = np.zeros((n or 0, n or 0))
        if mu is not None and (mu.values is None or mu.values.any()):
            complaints.add("plant.F", "is missing: multiplicative_variance is not 0")
    return {"A": found, "F": over_time(F, 2, "plant.F", square, complaints), "Q": noise, "mu": mu}


def parse_variance(mu: Any, complaints: Complaints) -> TimeVarying | None:
    """mu over time, numbers >= 0."""

    def variance(value: Any, key: str, more: Complaints) -> ndarray | None:
        number = checks.number(value, key, "a number >= 0", more)
        if number is not None and number < 0:
            more.add(key, f"is {checks.shown(value)}; a number >= 0 was expected")
        return None if number is None else np.array(number)

    return over_time(mu, 0, "plant.multiplicative_variance", variance, complaints)


def _non_singular(value: Any, n: int | None, key: str, complaints: Complaints) -> ndarray | None:
    """A square matrix whose inverse exists, judged after scaling its rows and columns to largest entries of one."""
    A = checks.shaped(value, (n, n), key, "an n x n matrix" if n is None else f"{n} x {n}", complaints)
    if A is None:
        return None
    if A.size == 0 or A.shape[0] != A.shape[1]:
        complaints.add(key, f"is {checks.by(A.shape)}; an n x n matrix was expected", shape=True)
        return None
    rows = np.abs(A).max(axis=1, keepdims=True)
    unit = A / np.where(rows > 0, rows, 1.0)
    columns = np.abs(unit).max(axis=0)
    sizes = np.linalg.svd(unit / np.where(columns > 0, columns, 1.0), compute_uv=False)
    if sizes[-1] <= len(A) * float(np.finfo(float).eps) * sizes[0]:
        complaints.add(key, "is singular; a non-singular one was expected")
    return A


def _parse_sensors(C: Any, R: Any, D: Any, rows: Any, n: int | None, complaints: Complaints) -> dict[str, Any]:
    """C and R over time, and the offsets, which must be the same at every instant."""
    offsets: list[ndarray] = []

    def parse(instant: Sequence[Any], found: Complaints) -> Sequence[ndarray] | None:
        C_k, R_k, D_k = instant
        packed = sensors.parse_sensors(C_k, R_k, D_k, rows, n, found)
        if packed["R"] is None or found.found:
            return None
        if offsets and not np.array_equal(offsets[0], packed["rows"]):
            found.add("sensors.C", "has another number of rows at another instant", shape=True)
            return None
        offsets.append(packed["rows"])
        return packed["C"], packed["R"]

    flat = () if rows is None else (1,)
    sources = [PerNode(C, 2, (3,) if rows is None else (2,)), PerNode(R, 2, (3, *flat)), PerNode(D, 2, (3, *flat))]
    found = all_nodes_over_time(sources, parse, complaints)
    if found is None:
        return dict.fromkeys(("C", "R", "rows"))
    return {"C": found[0], "R": found[1], "rows": offsets[0]}


def _parse_start(
    mean: Any, P_0: Any, Pi_0: Any, n: int | None, N: int | None, complaints: Complaints
) -> dict[str, Any]:
    """What is known of the first state; Pi_0 is by default that of the initial mean and node 0's covariance."""
    many, width = "n" if n is None else str(n), n or 0
    if mean is not None:
        mean = checks.shaped(mean, (n,), "plant.initial_mean", f"a vector of {many}", complaints)
    mean = np.zeros(width) if mean is None else mean
    if sensors.by_node(P_0) and len(P_0) == N and all(np.ndim(item) == 2 or item is None for item in P_0):
        found = [
            np.eye(width)
            if item is None
            else checks.covariance(item, n, f"sensors[{i}].initial_covariance", complaints, definite=True)
            for i, item in enumerate(P_0)
        ]
    elif isinstance(P_0, ndarray) and P_0.ndim == 3:
        if N is not None and len(P_0) != N:
            complaints.add(
                "sensors.initial_covariance", f"is {checks.by(P_0.shape)}; there are {N} nodes", shape=True
            )
        found = [
            checks.covariance(item, n, f"sensors[{i}].initial_covariance", complaints, definite=True)
            for i, item in enumerate(P_0)
        ]
    else:
        one = np.eye(width)
        if P_0 is not None:
            one = checks.covariance(P_0, n, "plant.initial_covariance", complaints, definite=True)
        found = [one] * (N or 0)
    known = n is not None and not any(item is None for item in found)
    P_0 = np.array(found).reshape(len(found), width, width) if known else None
    if Pi_0 is not None:
        Pi_0 = checks.covariance(Pi_0, n, "plant.initial_second_moment", complaints, definite=False)
    elif P_0 is not None and len(P_0):
        Pi_0 = P_0[0] + np.outer(mean, mean)
    return {"initial_mean": mean, "initial_covariance": P_0, "initial_second_moment": Pi_0}


def _check_connected(adjacency: sparse.csr_array, key: str, complaints: Complaints) -> None:
    """Complain unless every node hears of every other, if only through others."""
    from scipy.sparse import csgraph

    count, part = csgraph.connected_components(adjacency, directed=True, connection="strong")
    if count == 1:
        return
    reached = csgraph.breadth_first_order(adjacency, 0, directed=True, return_predecessors=False)
    deaf = np.setdiff1d(np.arange(len(part)), reached)
    l, k = (0, deaf[0]) if deaf.size else (int(np.flatnonzero(part != part[0])[0]), 0)
    complaints.add(key, f"does not connect the nodes strongly: nothing that node {l} sends ever reaches node {k}")
