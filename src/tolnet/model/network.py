"""The sensor network: one plant, N sensors, one graph (eqs. (5), (9)-(11))."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.model import _checks as checks
from tolnet.model import sensors
from tolnet.model._checks import Complaints, frozen
from tolnet.model.ambiguity import Ambiguity
from tolnet.model.graph import parse_adjacency, parse_diffusion
from tolnet.model.sensors import Packed


@dataclass(frozen=True, eq=False, init=False, repr=False)
class SensorNetwork:
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
        names: Sequence[str] | None = None,
        name: str = "",
        description: str = "",
        ambiguity: Ambiguity | None = None,
        diffusion: Any = "relative-degree",
        digest: str | None = None,
    ) -> None:
        complaints = Complaints()
        if hasattr(A, "dt") and hasattr(A, "A"):
            from tolnet.model.convert import plant_matrices

            A, B, dt = plant_matrices(A, B, Q, dt, complaints)
        values: dict[str, Any] = _parse_plant(A, B, Q, input, initial_mean, initial_covariance, states, complaints)
        n = len(values["A"]) if values["A"] is not None else None
        if n is not None:
            values |= _parse_sensors(C, R, D, rows, n, complaints)
        N = len(values["rows"]) - 1 if values.get("rows") is not None else None
        if N is not None:
            directed, graph = parse_adjacency(adjacency, edges, directed, N, complaints)
            values["adjacency"] = graph
            values["diffusion"] = parse_diffusion(diffusion, graph, complaints)
            if positions is not None:
                values["positions"] = checks.shaped(
                    positions, (N, None), "network.positions", f"{N} x 2, a point for each node,", complaints
                )
            if names is not None and len(names) != N:
                complaints.add("network.names", f"has {len(names)} entries; there are {N} nodes", shape=True)
        if dt is not None and not (np.isfinite(dt) and dt > 0):
            complaints.add("plant.dt", f"is {dt}; a positive number of seconds was expected")
        complaints.raise_if_any()
        values |= {
            "directed": directed,
            "states": None if states is None else tuple(states),
            "dt": None if dt is None else float(dt),
            "names": None if names is None else tuple(names),
            "name": name,
            "description": description,
            "ambiguity": ambiguity,
            "digest": digest,
        }
        values.setdefault("positions", None)
        for key, value in values.items():
            object.__setattr__(self, key, frozen(value) if isinstance(value, ndarray) else value)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def N(self) -> int:
        """Number of nodes."""
        return len(self.rows) - 1

    @property
    def sensors(self) -> Packed:
        """C, the offsets and R as one packed value."""
        return Packed(self.C, self.rows, self.R)

    def sensor(self, k: int) -> tuple[Float[ndarray, "p n"], Float[ndarray, "p p"]]:
        """C_k and R_k of one node."""
        if not -self.N <= k < self.N:
            raise IndexError(f"node {k} does not exist: there are {self.N}")
        k %= self.N
        p = int(self.rows[k + 1] - self.rows[k])
        start = int(self.sensors.block_offsets[k])
        return self.C[self.rows[k] : self.rows[k + 1]], self.R[start : start + p * p].reshape(p, p)

    @cached_property
    def degree(self) -> Int[ndarray, " N"]:
        """n_k = |N_k|: how many nodes each node hears, itself included."""
        return frozen(np.bincount(self.adjacency.indices, minlength=self.N))

    def neighbours(self, k: int) -> Int[ndarray, " d"]:
        """The nodes that node k hears, itself included, in rising order."""
        heard = self._heard
        return heard.indices[heard.indptr[k] : heard.indptr[k + 1]].astype(np.int64)

    @cached_property
    def _heard(self) -> sparse.csr_array:
        heard = self.adjacency.T.tocsr()
        heard.sort_indices()
        return heard

    @cached_property
    def own_information(self) -> Float[ndarray, "N n n"]:
        """C_k' R_k^-1 C_k of each node alone; zero for a relay."""
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

    def label(self, k: int) -> str:
        """A node as people call it: its name where it has one, else its index."""
        return self.names[k] if self.names else str(k)

    def __repr__(self) -> str:
        links = (self.adjacency.nnz - self.N) // (1 if self.directed else 2)
        kind = "directed links" if self.directed else "links"
        return f"<SensorNetwork {self.name!r}: n = {self.n}, N = {self.N}, {links} {kind}>"


def _parse_plant(
    A: Any, B: Any, Q: Any, input: Any, mean: Any, covariance: Any, states: Any, complaints: Complaints
) -> dict[str, Any]:
    values: dict[str, Any] = dict.fromkeys(("A", "B", "Q", "input", "initial_mean", "initial_covariance"))
    A = checks.shaped(A, (None, None), "plant.A", "an n x n matrix", complaints)
    if A is None:
        return values
    n = len(A)
    if n == 0 or A.shape != (n, n):
        complaints.add("plant.A", f"is {checks.by(A.shape)}; an n x n matrix was expected", shape=True)
        return values
    values["A"] = A
    if B is not None:
        B = values["B"] = checks.shaped(B, (n, None), "plant.B", f"{n} x m", complaints)
    if Q is not None:
        values["Q"] = checks.shaped(Q, (n, n), "plant.Q", f"{n} x {n}", complaints)
        if values["Q"] is not None and checks.symmetric(values["Q"], "plant.Q", complaints):
            checks.positive(values["Q"], "plant.Q", complaints, definite=False)
    if B is None and Q is None and not complaints.found:
        complaints.add("plant", "has neither B nor Q; exactly one was expected")
    if B is not None:
        product = B @ B.T
        if values["Q"] is not None and not np.array_equal(values["Q"], product):
            complaints.add("plant", "has both B and Q; exactly one was expected")
        values["Q"] = product
    if input is not None:
        values["input"] = checks.shaped(input, (n,), "plant.input", f"a vector of {n}", complaints)
    mean = np.zeros(n) if mean is None else mean
    values["initial_mean"] = checks.shaped(mean, (n,), "plant.initial_mean", f"a vector of {n}", complaints)
    covariance = np.eye(n) if covariance is None else covariance
    key = "plant.initial_covariance"
    V0 = values["initial_covariance"] = checks.shaped(covariance, (n, n), key, f"{n} x {n}", complaints)
    if V0 is not None and checks.symmetric(V0, key, complaints):
        checks.positive(V0, key, complaints, definite=True)
    if states is not None and len(states) != n:
        complaints.add("plant.states", f"has {len(states)} labels; plant.A is {n} x {n}", shape=True)
    return values


def _parse_sensors(C: Any, R: Any, D: Any, rows: Any, n: int, complaints: Complaints) -> dict[str, Any]:
    values: dict[str, Any] = dict.fromkeys(("C", "R", "D", "rows"))
    packed = sensors.pack_observations(C, rows, n, complaints)
    if packed is None:
        return values
    C, rows = packed
    values |= {"C": C, "rows": rows}
    if R is None and D is None:
        complaints.add("sensors", "have neither R nor D; exactly one was expected")
    if D is not None:
        D = values["D"] = sensors.pack_blocks(D, rows, "D", complaints)
    if R is not None:
        R = sensors.pack_blocks(R, rows, "R", complaints)
    if D is not None and D.size == (np.diff(rows) ** 2).sum():
        product = sensors.squared(Packed(C, rows, D))
        if R is not None and not np.array_equal(R, product):
            complaints.add("sensors", "have both R and D; exactly one was expected")
        R = product
    if R is not None and R.size == (np.diff(rows) ** 2).sum():
        sensors.check_noise(Packed(C, rows, R), "R" if D is None else "D", complaints)
    values["R"] = R
    return values
