"""The sensor network: one plant, N sensors, one graph (eqs. (5), (9)-(11))."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.model import _checks as checks
from tolnet.model import sensors
from tolnet.model._checks import Complaints, frozen
from tolnet.model.ambiguity import Ambiguity
from tolnet.model.bounded_reading import LARGEST_ARCHIVE, read_whole
from tolnet.model.errors import InputError
from tolnet.model.graph import DIFFUSION_RULES, parse_adjacency, parse_diffusion
from tolnet.model.nodes import Nodes, parse_nodes
from tolnet.model.sensors import Packed


@dataclass(frozen=True, eq=False, init=False, repr=False)
class SensorNetwork(Nodes):
    """A plant x+ = A x + B w + r watched by N sensors y_k = C_k x + D_k v_k that talk over a graph, eq. (5).

    Assumes w and v_k independent, zero mean, unit covariance. Every array is copied once, checked once and
    read-only. Sensors are packed one under the other, so p_k may differ, and may be 0 (a relay).

    Shapes: A (n, n); B (n, m) or Q = B B' (n, n), exactly one; C (M, n) with M = sum p_k, node k owning rows
    `rows[k]:rows[k + 1]`; R the blocks R_k (p_k, p_k), flattened row by row and concatenated; or D likewise,
    with R_k = D_k D_k', exactly one. The constructor also takes C, R, D as sequences of matrices or, where all
    p_k are equal, as stacks (N, p, n) and (N, p, p); A as a discrete-time `control.StateSpace`, whose A, B and
    sampling time are taken; the graph as `edges` (E, 2), as an N x N matrix (dense or sparse) or as a networkx graph.
    Units: those of the state squared for Q; `dt` in seconds (metadata).

    Raises InputError (ShapeError where only shapes are wrong) with every complaint at once, in the key paths of
    the problem file.
    Source: A. Emanuele et al., Sensors 20(11):3244, 2020, Section 2; docs/mathematics.md, section 1.
    """

    A: Float[ndarray, "n n"]
    B: Float[ndarray, "n m"] | None
    """The factor of the process noise, where it was given as such."""
    Q: Float[ndarray, "n n"]
    """Covariance of the process noise, B B'."""
    C: Float[ndarray, "M n"]
    R: Float[ndarray, " sum_p2"]
    D: Float[ndarray, " sum_p2"] | None
    rows: Int[ndarray, " N1"]
    adjacency: sparse.csr_array
    """N x N, boolean, self-loops included: [l, k] says that node k hears node l."""
    directed: bool
    input: Float[ndarray, " n"] | None
    initial_mean: Float[ndarray, " n"]
    initial_covariance: Float[ndarray, "n n"]
    states: tuple[str, ...] | None
    dt: float | None
    positions: Float[ndarray, "N d"] | None
    names: tuple[str, ...] | None
    name: str
    description: str
    ambiguity: Ambiguity | None
    diffusion: str | sparse.csr_array
    """The name of a rule, or W itself: [l, k] weighs neighbour l at node k, columns sum to one, eq. (11)."""
    digest: str | None
    """SHA-256 of the bytes of the file, and of its side archive, that the network was loaded from."""

    def __init__(
        self,
        *,
        A: Any,
        B: Any = None,
        Q: Any = None,
        C: Any,
        R: Any = None,
        D: Any = None,
        rows: Any = None,
        adjacency: Any = None,
        edges: Any = None,
        directed: bool = False,
        input: Any = None,
        initial_mean: Any = None,
        initial_covariance: Any = None,
        states: Sequence[str] | None = None,
        dt: float | None = None,
        positions: Any = None,
        names: Any = None,
        name: str = "",
        description: str = "",
        ambiguity: Ambiguity | None = None,
        diffusion: Any = DIFFUSION_RULES[0],
        digest: str | None = None,
    ) -> None:
        complaints = Complaints()
        if hasattr(A, "dt") and hasattr(A, "A"):
            from tolnet.model.convert import plant_matrices

            A, B, dt = plant_matrices(A, B, Q, dt, complaints)
        values = _parse_plant(A, B, Q, input, initial_mean, initial_covariance, complaints)
        n = None if values["A"] is None else len(values["A"])
        values |= sensors.parse_sensors(C, R, D, rows, n, complaints)
        N = sensors.count(C, rows) if values["rows"] is None else len(values["rows"]) - 1
        if not isinstance(directed, bool | np.bool_):
            complaints.add("network.directed", f"is {checks.shown(directed)}; true or false was expected")
        if N:
            values |= parse_nodes(adjacency, edges, bool(directed), positions, names, N, complaints)
            values["diffusion"] = parse_diffusion(diffusion, values["adjacency"], N, complaints)
        values |= {
            "states": checks.labels(states, n, "plant.states", f"plant.A is {n} x {n}", complaints),
            "dt": None if dt is None else checks.number(dt, "plant.dt", "a positive number of seconds", complaints),
            "name": name,
            "description": description,
            "ambiguity": ambiguity,
            "digest": digest,
        }
        if values["dt"] is not None and values["dt"] <= 0:
            complaints.add("plant.dt", f"is {checks.shown(dt)}; a positive number of seconds was expected")
        checks.text(name, "name", complaints)
        checks.text(description, "description", complaints, lines=True)
        if ambiguity is not None and not isinstance(ambiguity, Ambiguity):
            complaints.add("ambiguity", f"is {checks.shown(ambiguity)}; an Ambiguity was expected")
        complaints.raise_if_any()
        for key, value in values.items():
            object.__setattr__(self, key, frozen(value) if isinstance(value, ndarray) else value)

    @classmethod
    def from_mat(cls, path: str | Path) -> SensorNetwork:
        """The network in a MATLAB file (saved with -v6 or -v7), whose variables carry the constructor's names.

        A and B or Q, n x n and n x m; C, R or D as cell arrays of one matrix a node ([] for a relay) or stacked,
        C p x n x N and R p x p x N; `edges`, E x 2 with nodes counted from 1 as MATLAB does, [from, to] where
        `directed` is true, or `adjacency`, N x N, sparse or full, whose (l, k) says that node k hears node l, as
        MATLAB's own adjacency(digraph) does. Optional: input, initial_mean, initial_covariance, dt, positions
        (N x 2), names and states (cell arrays of texts), name, description, tolerance, convention, tau, and the
        diffusion as W, N x N with columns that sum to one, or as the name of a `rule`.
        Raises InputError for what is no such file, for variables that are not known, and for all that the
        constructor refuses. `digest` is the SHA-256 of the file's bytes.
        """
        from tolnet.model.matlab import arguments_of_mat

        try:
            return cls(**arguments_of_mat(read_whole(path, LARGEST_ARCHIVE)))
        except InputError as error:
            raise type(error)(error.complaints, source=str(path)) from None

    def with_diffusion(self, W: Any) -> SensorNetwork:
        """The same network with the weights W (N, N), or with the rule of that name; it comes from no file.

        Raises InputError where W is not admissible on the graph, eq. (11).
        """
        complaints = Complaints()
        diffusion = parse_diffusion(W, self.adjacency, self.N, complaints)
        complaints.raise_if_any()
        changed = copy.copy(self)
        object.__setattr__(changed, "diffusion", diffusion)
        object.__setattr__(changed, "digest", None)
        return changed

    def relinked(self, links: Int[ndarray, "E 2"]) -> SensorNetwork:
        """The same network on other links [from, to], from no file; W of its own gives way to the default rule.

        Raises InputError for links that are no links of these nodes.
        """
        complaints = Complaints()
        directed, graph = parse_adjacency(None, links, self.directed, self.N, complaints)
        complaints.raise_if_any()
        other = copy.copy(self)
        for name in ("degree", "_heard", "information"):
            other.__dict__.pop(name, None)
        rule = self.diffusion if isinstance(self.diffusion, str) else DIFFUSION_RULES[0]
        for name, value in {"adjacency": graph, "directed": directed, "diffusion": rule, "digest": None}.items():
            object.__setattr__(other, name, value)
        return other

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.A)

    @cached_property
    def sensors(self) -> Packed:
        """C, the offsets and R as one packed value."""
        return Packed(self.C, self.rows, self.R)

    @cached_property
    def factors(self) -> Packed | None:
        """C, the offsets and D; None where every node gave R. The block of a node that gave R is zero."""
        return None if self.D is None else Packed(self.C, self.rows, self.D)

    def sensor(self, k: int) -> tuple[Float[ndarray, "p n"], Float[ndarray, "p p"]]:
        """C_k and R_k of one node. Raises IndexError for a node that does not exist."""
        if not -self.N <= k < self.N:
            raise IndexError(f"node {k} does not exist: there are {self.N}")
        k %= self.N
        return self.C[self.rows[k] : self.rows[k + 1]], self.sensors.block(k)

    @cached_property
    def own_information(self) -> Float[ndarray, "N n n"]:
        """C_k' R_k^-1 C_k of each node alone; zero for a relay. Raises InputError where it overflows."""
        return frozen(sensors.information(self.sensors, self.n))

    @cached_property
    def information(self) -> Float[ndarray, "N n n"]:
        """S_k = sum of C_l' R_l^-1 C_l over the nodes l that node k hears, eqs. (9)-(10)."""
        J = self._heard.astype(float)
        return frozen((J @ self.own_information.reshape(self.N, -1)).reshape(self.N, self.n, self.n))

    @cached_property
    def total_information(self) -> Float[ndarray, "n n"]:
        """S_tot = sum over all nodes, eq. (6)."""
        return frozen(self.own_information.sum(axis=0))

    def __repr__(self) -> str:
        kind = "directed links" if self.directed else "links"
        return f"<SensorNetwork {self.name!r}: n = {self.n}, N = {self.N}, {len(self.links)} {kind}>"


def _parse_plant(
    A: Any, B: Any, Q: Any, input: Any, mean: Any, covariance: Any, complaints: Complaints
) -> dict[str, Any]:
    """The checked matrices of the plant; where A cannot be used, the shapes of the others are left alone."""
    A = checks.shaped(A, (None, None), "plant.A", "an n x n matrix", complaints)
    if A is not None and (A.size == 0 or A.shape[0] != A.shape[1]):
        complaints.add("plant.A", f"is {checks.by(A.shape)}; an n x n matrix was expected", shape=True)
        A = None
    n = None if A is None else len(A)
    many = "n" if n is None else str(n)
    if B is None and Q is None:
        complaints.add("plant", "has neither B nor Q; exactly one was expected")
    if B is not None and Q is not None:
        complaints.add("plant", "has both B and Q; exactly one was expected")
    if B is not None:
        B = checks.shaped(B, (n, None), "plant.B", f"{many} x m", complaints)
    if Q is not None:
        Q = checks.covariance(Q, n, "plant.Q", complaints, definite=False)
    elif B is not None:
        Q = sensors.gramian(B)
        if not np.isfinite(Q).all():
            complaints.add("plant.B", "is too large: B B' overflows")
    if input is not None:
        input = checks.shaped(input, (n,), "plant.input", f"a vector of {many}", complaints)
    if mean is not None:
        mean = checks.shaped(mean, (n,), "plant.initial_mean", f"a vector of {many}", complaints)
    if covariance is not None:
        covariance = checks.covariance(covariance, n, "plant.initial_covariance", complaints, definite=True)
    return {
        "A": A,
        "B": B,
        "Q": Q,
        "input": input,
        "initial_mean": np.zeros(n or 0) if mean is None else mean,
        "initial_covariance": np.eye(n or 0) if covariance is None else covariance,
    }
