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
from tolnet.model.corrupted_parsing import (
    check_connected,
    parse_plant,
    parse_sensors,
    parse_start,
    parse_variance,
)
from tolnet.model.fusion import FUSION_RULES, parse_fusion
from tolnet.model.network import SensorNetwork
from tolnet.model.nodes import Nodes, parse_nodes
from tolnet.model.sensors import Packed
from tolnet.model.time_varying import TimeVarying, common_period


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
        values = parse_plant(A, B, Q, F, multiplicative_variance, complaints)
        n = None if values["A"] is None else values["A"](0).shape[0]
        values |= parse_sensors(C, R, D, rows, n, complaints)
        N = sensors.count(C, rows) if values["rows"] is None else len(values["rows"]) - 1
        values |= parse_start(initial_mean, initial_covariance, initial_second_moment, n, N, complaints)
        if not isinstance(directed, bool | np.bool_):
            complaints.add("network.directed", f"is {checks.shown(directed)}; true or false was expected")
        if N:
            values["tau"], values["phi"] = parse_fading(fading_mean, fading_variance, N, complaints) or (None, None)
            values["interval"] = parse_intervals(interval, N, complaints)
            key = "network.adjacency" if edges is None and adjacency is not None else "network.edges"
            before = len(complaints.found)
            values |= parse_nodes(adjacency, edges, bool(directed), positions, names, N, complaints)
            if len(complaints.found) == before:
                check_connected(values["adjacency"], key, complaints)
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
        window: Any = None,
        interval: Any = None,
    ) -> CorruptedNetwork:
        """The same network with other fading, multiplicative noise, channel bounds or windows.

        In the constructor's forms; bounds that are given count for every link. Raises InputError as it does.
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
        if window is not None:
            values["window"] = whole(window, "fusion.window", complaints)
        if interval is not None:
            found = parse_intervals(interval, self.N, complaints)
            values["interval"] = None if found is None else frozen(found)
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
