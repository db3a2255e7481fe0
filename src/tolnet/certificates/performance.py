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
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import statements
from tolnet.certificates.deployed import Deployed
from tolnet.certificates.exact import Exact, is_semidefinite
from tolnet.certificates.exact_network import (
    ExactNetwork,
    both_sides,
    process_covariance,
    times_sensor_noise,
    weighted_rows,
)
from tolnet.certificates.numerals import (
    matrix_text,
    number_text,
    shortened,
    symmetric_matrix,
    symmetric_text,
    vector,
)
from tolnet.certificates.propagation import can_follow, follow_noise
from tolnet.certificates.stability import has_positive_diagonal, largest_ratio
from tolnet.certificates.verdicts import Proved, Undecided

_BITS = 30
_FINE = 2**20
"""y_i is a multiple of 1 / _FINE here, and may be any number a little above the root of Y_ii for a checker."""
_SLACK = 1 + Fraction(1, 2**16)
_AGAIN = 3
"""Whoever follows the noise again rounds in another order: both are off by at most the error."""
_KEYS = {"claim", "verdict", "statement", "margin", "reason", "nodes", "centre", "network", "proof"}
MOST = 1500
"""Dimension (N + 1) n up to which the whole covariance is judged; it is part of the certificate."""
CLAIM = "performance"


def prove_performance(
    network: ExactNetwork,
    Q: Float[ndarray, "d d"] | None,
    Y: Float[ndarray, "N n n"] | None,
    centre: Float[ndarray, "n n"] | None,
) -> Proved | Undecided:
    """Enclose MSD_k = tr Q_kk of Q = F Q F' + G G', (N + 1) n square, for every node.

    Q is an approximate solution; above MOST rows it is not asked for, and the noise is followed step by step.
    Y with Y - T*(Y) > 0 for the network block and `centre` with Y - F_e' Y F_e > 0 are the dual candidates.
    Source: docs/certificate.md, `performance`; docs/mathematics.md, section 11.
    """
    deployed = network.deployed
    small = (deployed.N + 1) * deployed.n <= MOST
    if deployed.centre is None:
        return _undecided("no least favourable model is stated; `tolnet performance` says why")
    if network.unmixed:
        return _undecided(network.unmixed)
    if not has_covariances(deployed):
        return _undecided("Q is not exactly semidefinite, or some R not definite; a factor B or D instead is always")
    if not small and not can_follow(deployed):
        return _undecided(f"there are {deployed.N} nodes; the noise of so many is not followed to the end")
    if (Q is None and small) or Y is None or centre is None or not all(map(has_positive_diagonal, (Y, centre))):
        return _undecided(
            "there is no solution of the Lyapunov equation, or no block-wise proof of stability, to start from"
        )
    plan = _plan(Y, centre, network)
    if plan is None or not contracts(network, *plan):
        return _undecided("the block-wise contraction with the coupling to the least favourable model is not proved")
    delta, matrices = plan
    proof: dict[str, Any] = {"Q": None, "Y": [symmetric_text(P) for P in matrices], "delta": number_text(delta)}
    if not small:
        found = follow_noise(network, matrices, delta)
        if found is None:
            return _undecided("the noise of the network was not followed to the end")
        traces, error = [Fraction(x) for x in found.traces.tolist()], _AGAIN * Fraction(found.error)
    else:
        assert Q is not None
        Q = (Q + Q.T) / 2
        if not has_positive_diagonal(Q):
            return _undecided("there is no solution of the Lyapunov equation")
        proof["Q"] = symmetric_text(Q)
        diagonal, n = [Fraction(x) for x in np.diagonal(Q).tolist()], deployed.n
        traces = [sum(diagonal[k : k + n], Fraction()) for k in range(0, len(diagonal), n)]
        error = _error(abs(ExactDynamics(network).residual(Q)), matrices) / Fraction(delta)
    *nodes, last, mean = _intervals(traces, error)
    keys = {"nodes": [matrix_text(np.array(pair)) for pair in nodes], "centre": matrix_text(np.array(last))}
    keys["network"] = matrix_text(np.array(mean))
    return Proved(CLAIM, statements.performance(*mean), proof, keys=keys)


def verify_performance(network: ExactNetwork, claim: dict[str, Any]) -> str | None:
    """Why a `performance` without Q is not shown by following the noise once more; None where it is.

    Raises KeyError, ValueError, TypeError or AttributeError where the claim is malformed.
    """
    deployed = network.deployed
    if claim.keys() != _KEYS or claim["proof"].keys() != {"Q", "Y", "delta"}:
        return "its keys are not those of such a claim"
    if claim["margin"] is not None or claim["reason"] is not None:
        return "margin and reason: expected null"
    delta, N, n = float.fromhex(claim["proof"]["delta"]), deployed.N, deployed.n
    Y = np.array([symmetric_matrix(text) for text in claim["proof"]["Y"]])
    intervals = np.array([vector(text) for text in [*claim["nodes"], claim["centre"], claim["network"]]])
    if Y.shape != (N + 1, n, n) or intervals.shape != (N + 2, 2) or not 0 < delta < 1:
        return "its matrices or its intervals are not those of such a network"
    if claim["statement"] != statements.performance(*intervals[-1].tolist()):
        return "the statement is not the one that the claim proves"
    if network.unmixed:
        return network.unmixed
    if not has_covariances(deployed):
        return "Q is not semidefinite, or some R is not definite"
    if deployed.centre is None or not can_follow(deployed):
        return "no least favourable model is stated, or the network is too large"
    if not contracts(network, delta, Y):
        return "the contraction is not shown"
    found = follow_noise(network, Y, delta)
    if found is None:
        return "the noise was not followed to the end"
    traces, error = [Fraction(x) for x in found.traces.tolist()], Fraction(found.error)
    for (low, high), (least, most) in zip(intervals.tolist(), _intervals(traces, error), strict=True):
        if not low <= least <= most <= high:
            return "the proof does not reach an interval"
    return None


def _undecided(reason: str) -> Undecided:
    return Undecided(CLAIM, "The mean square deviation of every node lies in an interval.", reason)


def contracts(network: ExactNetwork, delta: float, Y: Float[ndarray, "K n n"]) -> bool:
    """Whether Y > I and (11.4) are shown, so that Y - F' Y F > delta Y; exactly, the centre's Y last."""
    M, Fe, coupling, stack = network.loops, network.centre_loops[1], network.coupling_blocks, Exact.of(Y)
    N = network.deployed.N
    part, kept = Exact.of(delta), Exact.of(1.0) - Exact.of(delta)
    own = M.T @ network.spread(stack[:N], slice(0, N)) @ M
    reached = (coupling.T @ stack[:N] @ coupling).sum(0)
    last = part * (kept * stack[N] - Fe.T @ stack[N] @ Fe) - reached
    conditions = (stack - Exact.of(np.eye(Y.shape[1])), kept * kept * stack[:N] - own, last)
    return all(bool(condition.definite().all()) for condition in conditions)


def has_covariances(deployed: Deployed) -> bool:
    """Whether Q is positive semidefinite and every R positive definite, exactly."""
    network = deployed.network
    if network.B is None and not is_semidefinite(Exact.of(network.Q)):
        return False
    for nodes, _, R in network.sensors.groups():
        factors = network.factors
        by_factor = np.zeros(len(nodes), dtype=bool) if factors is None else factors.filled[nodes]
        given = [Exact.of(R[~by_factor])] if not by_factor.all() else []
        if factors is not None and by_factor.any():
            D = Exact.of(np.stack([factors.block(k) for k in nodes[by_factor].tolist()]))
            given.append(D @ D.T)
        if not all(S.definite().all() for S in given):
            return False
    return True


def _error(residual: Exact, Y: Float[ndarray, "K n n"]) -> Fraction:
    """sum_ij |Z_ij| y_i y_j, and a little more."""
    y = [math.isqrt(math.ceil(Fraction(x) * _FINE**2)) + 1 for x in np.diagonal(Y, axis1=1, axis2=2).flat]
    weights = np.array(y, dtype=object)
    total = Fraction(int(weights @ (residual.ints @ weights)), _FINE**2)
    return _SLACK * total * Fraction(2) ** residual.exponent


def _intervals(traces: Sequence[Fraction], error: Fraction) -> list[tuple[float, float]]:
    """One for each node, then the centre's, then that of the mean over the nodes."""
    N = len(traces) - 1
    bounds = [*((trace, error) for trace in traces), (sum(traces[:-1], Fraction()) / N, error / N)]
    return [(_down(trace - wide), _up(trace + wide)) for trace, wide in bounds]


class ExactDynamics:
    """F = U F_0 and G G' = U G_0 G_0' U', U = diag(W' (x) I, I): what the filters do, then the mixing, row by row.

    Assumes that a centre is stated. Nothing is stored that is larger than d x d, d = (N + 1) n.
    """

    def __init__(self, network: ExactNetwork) -> None:
        self.network, self.n = network, network.deployed.n

    @cached_property
    def noise(self) -> Exact:
        """G G', d x d."""
        deployed, n = self.network.deployed, self.n
        centre = deployed.centre
        assert centre is not None
        N, M = deployed.N, len(centre.gain)
        gains = np.zeros((M, N + 1, n))
        gains[deployed.sensor_rows, np.repeat(deployed.hearer, np.diff(deployed.columns))] = deployed.gains
        gains[:, N] = centre.gain
        G, sensed = Exact.of(gains), times_sensor_noise(deployed, gains.reshape(M, (N + 1) * n))
        heard = [*np.split(deployed.sensor_rows, deployed.columns[deployed.offsets][1:-1]), np.arange(M)]
        rows = [G.ints[seen, k].T @ sensed.ints[seen] for k, seen in enumerate(heard)]
        sensors = Exact(np.concatenate(rows), G.exponent + sensed.exponent)
        tilted = (self.network.shared_noise @ Exact.of(centre.tilt)).reshape((N + 1) * n, -1)
        Q = process_covariance(deployed)
        everywhere = Exact(np.tile(Q.ints, (N + 1, N + 1)), Q.exponent)
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
        own = self.network.couplings @ X[-1]
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


def _plan(
    Y: Float[ndarray, "N n n"],
    centre: Float[ndarray, "n n"],
    network: ExactNetwork,
) -> tuple[float, Float[ndarray, "K n n"]] | None:
    """delta, and the Y_k, the centre's last, of a size such that the inequalities should hold; or None."""
    coupling = network.coupling_blocks.rounded()
    M, W, Fe = network.deployed.loops[0], abs(network.deployed.mixing), network.centre_loops[1].rounded()
    sigma = np.asarray(W.sum(axis=1))
    image = M.mT @ (W.T @ (sigma[:, None] * Y.reshape(len(Y), -1))).reshape(Y.shape) @ M
    margin = 1 - max(largest_ratio(Y, image), largest_ratio(centre[None], (Fe.T @ centre @ Fe)[None]))
    if not margin > 0:
        return None
    delta = float(f"{0.45 * margin:.2e}")
    eye = np.eye(len(centre))[None]
    Y = Y * (1.01 * largest_ratio(Y, np.broadcast_to(eye, Y.shape)))
    room = delta * ((1 - delta) * centre - Fe.T @ centre @ Fe)
    reach = largest_ratio(room[None], (coupling.mT @ Y @ coupling).sum(axis=0)[None])
    centre = centre * max(1.1 * reach, 1.01 * largest_ratio(centre[None], eye))
    if not (np.isfinite(Y).all() and np.isfinite(centre).all()):
        return None
    return delta, shortened(np.concatenate([Y, centre[None]]), _BITS)


def _down(x: Fraction) -> float:
    near = float(x)
    return near if Fraction(near) <= x else float(np.nextafter(near, -np.inf))


def _up(x: Fraction) -> float:
    near = float(x)
    return near if Fraction(near) >= x else float(np.nextafter(near, np.inf))
