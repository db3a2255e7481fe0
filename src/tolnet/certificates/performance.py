"""Mean square deviations, enclosed exactly from a solution of the Lyapunov equation (docs/certificate.md).

1.  Z = F Q F' + G G' - Q exactly, and +-Z <= D = diag(sum_j |Z_ij| y_j / y_i) for any y > 0
2.  Y_k > I and Y - F' Y F > d Y for Y = diag(Y_k), block by block, with a share d of the room for the coupling
3.  so |tr (Q - Q*)_kk| <= tr Y (sum of F^t D F'^t) <= tr(Y D) / d, least for y_i^2 = Y_ii: sum_ij |Z_ij| y_i y_j / d
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from numpy import ndarray

from tolnet.certificates import statements
from tolnet.certificates.exact import Exact
from tolnet.certificates.exact_network import ExactNetwork, both_sides, process_covariance, weighted_rows
from tolnet.certificates.numerals import matrix_text, number_text, shortened, symmetric_text
from tolnet.certificates.stability import has_positive_diagonal, largest_ratio
from tolnet.certificates.verdicts import Proved, Undecided

_BITS = 30
_FINE = 2**20
"""y_i is a multiple of 1 / _FINE here, and may be any number a little above the root of Y_ii for a checker."""
_SLACK = 1 + Fraction(1, 2**16)
MOST = 1500
"""Dimension (N + 1) n up to which the whole covariance is judged; it is part of the certificate."""
CLAIM = "performance"


def prove_performance(
    network: ExactNetwork,
    Q: Float[ndarray, "d d"] | None,
    Y: Float[ndarray, "N n n"] | None,
    centre: Float[ndarray, "n n"] | None,
) -> Proved | Undecided:
    """Enclose MSD_k = tr Q_kk of Q = F Q F' + G G', (N + 1) n square, for every node, from an approximate solution.

    Y with Y - T*(Y) > 0 for the network block and `centre` with Y - F_e' Y F_e > 0 are the dual candidates.
    Source: docs/certificate.md, `performance`; docs/mathematics.md, section 11.
    """
    deployed = network.deployed
    d = (deployed.N + 1) * deployed.n
    if d > MOST:
        reason = f"the whole covariance would be {d} x {d}; up to {MOST} it is judged"
    elif deployed.centre is None:
        reason = "there is no least favourable model"
    elif Q is None or Y is None or centre is None or not all(map(has_positive_diagonal, (Q, Y, centre))):
        reason = "there is no solution of the Lyapunov equation, or no block-wise proof of stability, to start from"
    else:
        found = _Enclosure(network, (Q + Q.T) / 2, Y, centre)
        if found.holds:
            return found.verdict()
        reason = "the block-wise contraction with the coupling to the least favourable model is not proved"
    return Undecided(CLAIM, "The mean square deviation of every node lies in an interval.", reason)


class _Enclosure:
    """Q, and how far it can be from the solution."""

    def __init__(
        self,
        network: ExactNetwork,
        Q: Float[ndarray, "d d"],
        Y: Float[ndarray, "N n n"],
        centre: Float[ndarray, "n n"],
    ) -> None:
        self.N, self.n = network.deployed.N, network.deployed.n
        self.Q, self.holds = Q, False
        dynamics = ExactDynamics(network)
        M, Fe, coupling = network.loops, network.centre_loops[1], dynamics.coupling
        plan = _plan(Y, centre, network, coupling.rounded(), Fe.rounded())
        if plan is None:
            return
        self.delta, self.Y = plan
        stack, delta, kept = Exact.of(self.Y), Exact.of(self.delta), Exact.of(1.0) - Exact.of(self.delta)
        # divided by nothing: (1 - d)^2 Y_l - M_l' (...) M_l, and d (1 - d) Y_N - d F_e' Y_N F_e - sum_k C_k' Y_k C_k
        own = M.T @ network.spread(stack[: self.N], slice(0, self.N)) @ M
        reached = (coupling.T @ stack[: self.N] @ coupling).sum(0)
        good = (stack - Exact.of(np.eye(self.n))).definite().all()
        good = good and (kept * kept * stack[: self.N] - own).definite().all()
        last = delta * (kept * stack[self.N] - Fe.T @ stack[self.N] @ Fe) - reached
        if good and last.definite():
            self.error = self._error(abs(dynamics.residual(Q)))
            self.holds = True

    def _error(self, residual: Exact) -> Fraction:
        """sum_ij |Z_ij| y_i y_j / delta, and a little more."""
        y = [math.isqrt(math.ceil(Fraction(x) * _FINE**2)) + 1 for x in np.diagonal(self.Y, axis1=1, axis2=2).flat]
        weights = np.array(y, dtype=object)
        total = Fraction(int(weights @ (residual.ints @ weights)), _FINE**2)
        return _SLACK * total * Fraction(2) ** residual.exponent / Fraction(self.delta)

    def intervals(self) -> list[tuple[float, float]]:
        """One for each node, then the centre's, then that of the mean over the nodes."""
        diagonal = [Fraction(x) for x in np.diagonal(self.Q).tolist()]
        traces = [sum(diagonal[k * self.n : (k + 1) * self.n], Fraction()) for k in range(self.N + 1)]
        bounds = [(trace, self.error) for trace in traces]
        bounds.append((sum(traces[:-1], Fraction()) / self.N, self.error / self.N))
        return [(_down(trace - error), _up(trace + error)) for trace, error in bounds]

    def verdict(self) -> Proved:
        intervals = self.intervals()
        *nodes, centre, mean = (matrix_text(np.array(interval)) for interval in intervals)
        low, high = intervals[-1]
        proof: dict[str, Any] = {
            "Q": symmetric_text(self.Q),
            "Y": [symmetric_text(Y) for Y in self.Y],
            "delta": number_text(self.delta),
        }
        statement = statements.performance(low, high)
        return Proved(CLAIM, statement, proof, keys={"nodes": nodes, "centre": centre, "network": mean})


class ExactDynamics:
    """F = U F_0 and G G' = U G_0 G_0' U', U = diag(W' (x) I, I): what the filters do, then the mixing, row by row.

    Assumes that a centre is stated. Nothing is stored that is larger than d x d, d = (N + 1) n.
    """

    def __init__(self, network: ExactNetwork) -> None:
        self.network, deployed = network, network.deployed
        N, n = deployed.N, deployed.n
        self.n, centre = n, deployed.centre
        assert centre is not None
        gains = np.zeros((N + 1, n, len(deployed.network.C)))
        hearer = np.repeat(deployed.hearer, np.diff(deployed.columns))
        gains[hearer, :, deployed.sensor_rows] = deployed.gains
        gains[N] = centre.gain.T
        ends = deployed.columns[deployed.offsets]
        self.heard = [*np.split(deployed.sensor_rows, ends[1:-1]), np.arange(gains.shape[-1])]
        self.G, self.tilt = Exact.of(gains), Exact.of(centre.tilt)
        self.Q, R = process_covariance(deployed), _noise_covariance(deployed)
        self.GR = [self.G[k][:, seen] @ R[np.ix_(seen, seen)] for k, seen in enumerate(self.heard)]
        E = [self.Q + GR @ self.G[N][:, seen].T for GR, seen in zip(self.GR, self.heard, strict=True)]
        low = min(each.exponent for each in E)
        self.E = Exact(np.stack([each.ints << (each.exponent - low) for each in E]), low)

    @cached_property
    def own(self) -> Exact:
        """The coupling of each filter to the centre before the mixing, E_k T F_0, (N + 1, n, n)."""
        F0 = self.network.centre_loops[0]
        return self.E @ (self.tilt @ (self.tilt.T @ F0))

    @cached_property
    def coupling(self) -> Exact:
        """The blocks C_k of F, (N, n, n)."""
        return self.mixed(self.own)[: self.network.deployed.N]

    @cached_property
    def noise(self) -> Exact:
        """G G', d x d."""
        N, n = self.network.deployed.N, self.network.deployed.n
        d = (N + 1) * n
        flat, tilted = self.G.reshape(d, -1), (self.E @ self.tilt).reshape(d, -1)
        sensed = [GR @ flat[:, seen].T for GR, seen in zip(self.GR, self.heard, strict=True)]
        low = min(each.exponent for each in sensed)
        sensors = Exact(np.concatenate([each.ints << (each.exponent - low) for each in sensed]), low)
        everywhere = Exact(np.tile(self.Q.ints, (N + 1, N + 1)), self.Q.exponent)
        return both_sides(self.mixed, everywhere + sensors + tilted @ tilted.T, n)

    def mixed(self, X: Exact) -> Exact:
        """U X for X of (N + 1, n, anything)."""
        deployed = self.network.deployed
        weights = Exact.of(np.append(deployed.weights, 1.0))
        return weighted_rows(
            weights,
            np.append(deployed.neighbours, deployed.N),
            np.append(deployed.offsets, deployed.offsets[-1] + 1),
            X,
        )

    def step(self, X: Exact) -> Exact:
        """F X for X of (N + 1, n, anything)."""
        M, F0 = self.network.loops, self.network.centre_loops[0]
        own = self.own @ X[-1]
        filtered = M @ X[:-1]
        low = min(filtered.exponent, F0.exponent + X.exponent)
        centre = F0 @ X[-1]
        filters = np.concatenate(
            [filtered.ints << (filtered.exponent - low), centre.ints[None] << (centre.exponent - low)]
        )
        return self.mixed(Exact(filters, low) + own)

    def residual(self, Q: Float[ndarray, "d d"]) -> Exact:
        """F Q F' + G G' - Q."""
        exact = Exact.of(Q)
        return both_sides(self.step, exact, self.n) + self.noise - exact

    def rounded(self) -> tuple[Float[ndarray, "d d"], Float[ndarray, "d d"]]:
        """F and G G' in floating point."""
        n = self.network.deployed.n
        d = len(self.noise.ints)
        eye = Exact.of(np.eye(d)).reshape(-1, n, d)
        return self.step(eye).reshape(d, d).rounded(), self.noise.rounded()


def _noise_covariance(deployed) -> Exact:
    """R of all sensors, block diagonal; D D' exactly where the problem gave D."""
    network = deployed.network
    M = len(network.C)
    factors = network.factors
    parts: list[tuple[int, Exact]] = []
    for k in range(network.N):
        start = int(network.rows[k])
        if factors is not None and factors.filled[k]:
            D = Exact.of(factors.block(k))
            parts.append((start, D @ D.T))
        elif network.rows[k + 1] > start:
            parts.append((start, Exact.of(network.sensors.block(k))))
    return _block_diagonal(parts, M)


def _block_diagonal(parts: Sequence[tuple[int, Exact]], M: int) -> Exact:
    low = min((block.exponent for _, block in parts), default=0)
    dense: Shaped[ndarray, "M M"] = np.zeros((M, M), dtype=object)
    for start, block in parts:
        rows = slice(start, start + len(block.ints))
        dense[rows, rows] = block.ints << (block.exponent - low)
    return Exact(dense, low)


def _plan(
    Y: Float[ndarray, "N n n"],
    centre: Float[ndarray, "n n"],
    network: ExactNetwork,
    coupling: Float[ndarray, "N n n"],
    Fe: Float[ndarray, "n n"],
) -> tuple[float, Float[ndarray, "K n n"]] | None:
    """delta, and the Y_k, the centre's last, of a size such that the inequalities should hold; or None."""
    M, W = network.deployed.loops[0], abs(network.deployed.mixing)
    sigma = np.asarray(W.sum(axis=1))
    image = M.mT @ (W.T @ (sigma[:, None] * Y.reshape(len(Y), -1))).reshape(Y.shape) @ M
    margin = 1 - max(largest_ratio(Y, image), largest_ratio(centre[None], (Fe.T @ centre @ Fe)[None]))
    if not margin > 0:
        return None
    delta = float(f"{margin / 4:.2e}")
    Y = Y * 1.01 / np.linalg.eigvalsh(Y).min()
    room = delta * ((1 - delta) * centre - Fe.T @ centre @ Fe)
    reach = largest_ratio(room[None], (coupling.mT @ Y @ coupling).sum(axis=0)[None])
    centre = centre * max(1.1 * reach, 1.01 / np.linalg.eigvalsh(centre).min())
    return delta, shortened(np.concatenate([Y, centre[None]]), _BITS)


def _down(x: Fraction) -> float:
    near = float(x)
    return near if Fraction(near) <= x else float(np.nextafter(near, -np.inf))


def _up(x: Fraction) -> float:
    near = float(x)
    return near if Fraction(near) >= x else float(np.nextafter(near, np.inf))
