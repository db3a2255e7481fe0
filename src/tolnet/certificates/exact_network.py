"""The exact matrices of a deployment, from which its claims are decided (docs/certificate.md)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.certificates.deployed import Deployed
from tolnet.certificates.exact import Exact, segment_sums


class ExactNetwork:
    """The exact matrices of a deployment from which its claims are decided."""

    def __init__(self, deployed: Deployed) -> None:
        self.deployed = deployed

    @cached_property
    def loops(self) -> Exact:
        """M_k, (N, n, n)."""
        return exact_loops(self.deployed)

    @cached_property
    def sizes(self) -> Exact:
        """|w_lk|, one for each entry."""
        return abs(Exact.of(self.deployed.weights))

    @cached_property
    def totals(self) -> Exact:
        """sigma_k."""
        return segment_sums(self.sizes, self.deployed.offsets)

    @cached_property
    def unmixed(self) -> str | None:
        """Which column of W does not sum to one; None where all do."""
        return unmixed_column(self.deployed.weights, self.deployed.offsets)

    @cached_property
    def centre_loops(self) -> tuple[Exact, Exact]:
        """F_0 = A - G C and F_e = F_0 + N T F_0. Assumes that a centre is stated."""
        deployed = self.deployed
        network, centre = deployed.network, deployed.centre
        assert centre is not None
        G, Y = Exact.of(centre.gain).T, Exact.of(centre.tilt)
        F0 = Exact.of(network.A) - G @ Exact.of(network.C)
        noise = process_covariance(deployed) + G @ times_sensor_noise(deployed, centre.gain)
        return F0, F0 + noise @ (Y @ (Y.T @ F0))

    @cached_property
    def shared_noise(self) -> Exact:
        """E_k = Q + G_k R G' for every filter, the centre's last, (N + 1, n, n). Assumes that a centre is stated."""
        deployed = self.deployed
        centre = deployed.centre
        assert centre is not None
        N, n, M = deployed.N, deployed.n, len(centre.gain)
        gains, sensors = np.concatenate([deployed.gains, centre.gain]), np.append(deployed.sensor_rows, np.arange(M))
        noise = times_sensor_noise(deployed, centre.gain)[sensors]
        ends = deployed.columns[deployed.offsets]
        each = segment_sums(Exact.of(gains).reshape(-1, n, 1) * noise.reshape(-1, 1, n), np.append(ends, ends[N] + M))
        return process_covariance(deployed) + each

    @cached_property
    def couplings(self) -> Exact:
        """E_k T F_0 for every filter, the centre's last, (N + 1, n, n). Assumes that a centre is stated."""
        centre = self.deployed.centre
        assert centre is not None
        Y = Exact.of(centre.tilt)
        return self.shared_noise @ (Y @ (Y.T @ self.centre_loops[0]))

    @cached_property
    def coupling_blocks(self) -> Exact:
        """C_k = sum_l w_lk E_l T F_0, (N, n, n). Assumes that a centre is stated."""
        return self.mixed(self.couplings[: self.deployed.N])

    def heard(self, values: Exact, nodes: slice) -> Exact:
        """sum_l |w_lk| values_l for the nodes k of a range."""
        entries = slice(*self.deployed.offsets[[nodes.start, nodes.stop]].tolist())
        l = self.deployed.neighbours[entries]
        weighted = self.sizes[entries].reshape(-1, 1, 1) * values[l]
        return segment_sums(weighted, self.deployed.offsets[nodes.start : nodes.stop + 1] - entries.start)

    def spread(self, Y: Exact, nodes: slice) -> Exact:
        """sum_k sigma_k |w_lk| Y_k for the nodes l of a range, Y of all nodes."""
        offsets, order = self.hearers
        entries = order[offsets[nodes.start] : offsets[nodes.stop]]
        k = self.deployed.hearer[entries]
        weighted = (self.totals[k] * self.sizes[entries]).reshape(-1, 1, 1) * Y[k]
        return segment_sums(weighted, offsets[nodes.start : nodes.stop + 1] - offsets[nodes.start])

    @cached_property
    def hearers(self) -> tuple[Int[ndarray, " N1"], Int[ndarray, " L"]]:
        """The entries sorted by l: offsets, and the entry numbers."""
        order = np.argsort(self.deployed.neighbours, kind="stable")
        counts = np.bincount(self.deployed.neighbours, minlength=self.deployed.N)
        return np.concatenate([[0], np.cumsum(counts)]), order

    def forwards(self, X: Exact) -> Exact:
        """A X for X of (N, n, anything), A the network block."""
        return self.mixed(self.loops @ X)

    def backwards(self, X: Exact) -> Exact:
        """A' X for X of (N, n, anything)."""
        offsets, order = self.hearers
        sums = weighted_rows(Exact.of(self.deployed.weights[order]), self.deployed.hearer[order], offsets, X)
        return self.loops.T @ sums

    def mixed(self, X: Exact) -> Exact:
        """(W' (x) I) X for X of (N, n, anything)."""
        deployed = self.deployed
        return weighted_rows(Exact.of(deployed.weights), deployed.neighbours, deployed.offsets, X)


def unmixed_column(weights: Float[ndarray, " L"], offsets: Int[ndarray, " N1"]) -> str | None:
    """Which column of W does not sum to one, as far as rounding lets it: F is no error dynamics then. None: all do.

    A column of m weights w > 0, divided by its sum in doubles, sums to one within m 2^-52, an ulp a weight; where all
    weights are numbers of single precision, each was rounded once more, by 2^-24 w at most. (Were the bound relative
    to sum |w|, weights that cancel could sum to anything.)
    Source: docs/certificate.md, `data`.
    """
    single = bool((np.frexp(weights)[0] * 2.0**24 % 1 == 0).all())
    w = Exact.of(weights)
    unit = min(w.exponent, 0)
    w = Exact(w.ints << (w.exponent - unit), unit)
    total = segment_sums(w, offsets)
    ulps = segment_sums(Exact((weights != 0).astype(object) + 0, 0), offsets).ints + (single << 28)
    one = 1 << -unit
    off = np.flatnonzero(abs(total.ints - one) * 2**52 > ulps * one)
    if not len(off):
        return None
    found = float(total[off[:1]].rounded()[0])
    return f"the weights of node {off[0]} sum to {found!r} instead of one, so that F is no error dynamics"


def weighted_rows(weights: Exact, of: Int[ndarray, " L"], offsets: Int[ndarray, " N1"], X: Exact) -> Exact:
    """Sums of weights_e X_of(e) over the entries e of k, offsets[k] to offsets[k + 1]; by k: X is large."""
    rows = np.zeros((len(offsets) - 1, *X.ints.shape[1:]), dtype=object)
    for k in range(len(rows)):
        e = slice(int(offsets[k]), int(offsets[k + 1]))
        rows[k] = (weights.ints[e, None, None] * X.ints[of[e]]).sum(axis=0)
    return Exact(rows, weights.exponent + X.exponent)


def both_sides(step: Callable[[Exact], Exact], X: Exact, n: int) -> Exact:
    """F X F' for a symmetric X, d x d, and a map of (d / n, n, anything) that multiplies by F."""
    d = len(X.ints)
    half = step(X.reshape(-1, n, d)).reshape(d, d).T
    return step(half.reshape(-1, n, d)).reshape(d, d)


def exact_loops(deployed: Deployed) -> Exact:
    """M_k = A - G_k C_k^loc, (N, n, n)."""
    C = Exact.of(deployed.network.C)[deployed.sensor_rows]
    product = Exact.of(deployed.gains).reshape(-1, deployed.n, 1) * C.reshape(-1, 1, deployed.n)
    return Exact.of(deployed.network.A) - segment_sums(product, deployed.columns[deployed.offsets])


def process_covariance(deployed: Deployed) -> Exact:
    """Q, or B B' exactly where the problem gave B."""
    if deployed.network.B is None:
        return Exact.of(deployed.network.Q)
    B = Exact.of(deployed.network.B)
    return B @ B.T


def times_sensor_noise(deployed: Deployed, X: Float[ndarray, "M m"]) -> Exact:
    """R X for the covariance R of all sensors together, block diagonal; D D' exactly where the problem gave D."""
    network = deployed.network
    factors = network.factors
    parts: list[tuple[ndarray, Exact]] = []
    for nodes, _, R in network.sensors.groups():
        rows = network.rows[nodes, None] + np.arange(R.shape[1])
        by_factor = np.zeros(len(nodes), dtype=bool) if factors is None else factors.filled[nodes]
        parts.append((rows[~by_factor], Exact.of(R[~by_factor]) @ Exact.of(X[rows[~by_factor]])))
        if factors is not None and by_factor.any():
            D = Exact.of(np.stack([factors.block(k) for k in nodes[by_factor].tolist()]))
            parts.append((rows[by_factor], D @ (D.T @ Exact.of(X[rows[by_factor]]))))
    low = min((product.exponent for _, product in parts), default=0)
    found = np.zeros(X.shape, dtype=object)
    for rows, product in parts:
        found[rows] = product.ints << (product.exponent - low)
    return Exact(found, low)


def exact_power(network: ExactNetwork, j: int) -> list[tuple[Int[ndarray, " m"], Exact]]:
    """For each node k the nodes l with a path of j links of non-zero weight to k, and the blocks (A^j)_kl."""
    deployed = network.deployed
    weights, M = Exact.of(deployed.weights), network.loops
    blocks = weights.reshape(-1, 1, 1) * M[deployed.neighbours]
    rows: list[dict[int, Exact]] = []
    for k in range(deployed.N):
        entries = range(*deployed.offsets[[k, k + 1]].tolist())
        rows.append({int(deployed.neighbours[i]): blocks[i] for i in entries if deployed.weights[i] != 0})
    power = rows
    for _ in range(j - 1):
        power = [_combined(row, rows) for row in power]
    return [
        (
            np.array(sorted(row)),
            Exact(np.stack([row[l].ints for l in sorted(row)]), next(iter(row.values())).exponent),
        )
        for row in power
    ]


def _combined(row: dict[int, Exact], rows: list[dict[int, Exact]]) -> dict[int, Exact]:
    """sum_m row_m rows[m], by blocks; every block has one exponent."""
    total: dict[int, Exact] = {}
    for m, block in row.items():
        for l, other in rows[m].items():
            more = block @ other
            total[l] = more if l not in total else total[l] + more
    return total
