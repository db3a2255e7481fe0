"""Mean square deviations, enclosed exactly from a solution of the Lyapunov equation (docs/certificate.md).

1.  Z = F Q F' + G G' - Q exactly, and +-Z <= diag(z), z_i = sum_j |Z_ij| t_j / t_i for any t > 0
2.  z <= e X block by block
3.  T(X) <= (1 - d) X for T(X)_k = sigma_k sum_l |w_lk| M_l X_l M_l' / (1 - p) + C_k X_N C_k' / p
4.  so |(Q - Q*)_kk| <= (e / d) X_k: sums of F^t diag(X) F'^t have blocks below X_k / d
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from numpy import ndarray

from tolnet.certificates import statements
from tolnet.certificates.exact import Exact
from tolnet.certificates.exact_network import ExactNetwork, exact_network_matrix, process_covariance
from tolnet.certificates.numerals import matrix_text, number_text, shortened, symmetric_text
from tolnet.certificates.stability import has_positive_diagonal, largest_ratio
from tolnet.certificates.verdicts import Proved, Undecided

_BITS = 30
_SLACK = 4
"""A checker's t may differ from ours by a factor of two in every entry."""
MOST = 700
"""Dimension (N + 1) n up to which the whole covariance is judged; it is part of the certificate."""
CLAIM = "performance"


def prove_performance(
    network: ExactNetwork,
    Q: Float[ndarray, "d d"] | None,
    X: Float[ndarray, "N n n"] | None,
    centre: Float[ndarray, "n n"] | None,
) -> Proved | Undecided:
    """Enclose MSD_k = tr Q_kk of Q = F Q F' + G G', (N + 1) n square, for every node, from an approximate solution.

    X with X - T(X) > 0 for the network block and `centre` with X - F_e X F_e' > 0 come from a stability proof.
    Source: docs/certificate.md, `performance`; docs/mathematics.md, section 11.
    """
    deployed = network.deployed
    d = (deployed.N + 1) * deployed.n
    if d > MOST:
        reason = f"the whole covariance would be {d} x {d}; up to {MOST} it is judged"
    elif deployed.centre is None:
        reason = "there is no least favourable model"
    elif Q is None or X is None or centre is None or not all(map(has_positive_diagonal, (Q, X, centre))):
        reason = "there is no solution of the Lyapunov equation, or no block-wise proof of stability, to start from"
    else:
        found = _Enclosure(network, (Q + Q.T) / 2, shortened(X, _BITS), shortened(centre, _BITS))
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
        X: Float[ndarray, "N n n"],
        centre: Float[ndarray, "n n"],
    ) -> None:
        self.N, self.n = network.deployed.N, network.deployed.n
        self.Q = Q
        self.holds = False
        F, coupling, noise = exact_dynamics(network)
        exact = Exact.of(Q)
        residual = abs(F @ exact @ F.T + noise - exact)
        M, Fe = network.loops, network.centre_loops[1]
        moved = network.totals.reshape(-1, 1, 1) * network.heard(M @ Exact.of(X) @ M.T, slice(0, self.N))
        plan = _plan(X, centre, moved.rounded(), coupling.rounded(), Fe.rounded())
        if plan is None:
            return
        self.delta, self.share, scale = plan
        self.X = np.concatenate([X, scale * centre[None]])
        stack = Exact.of(self.X)
        # (1 - d) p (1 - p) X_k - p sigma_k sum - (1 - p) C_k X_N C_k', so that nothing is divided
        p, rest, kept = (
            Exact.of(self.share),
            Exact.of(1.0) - Exact.of(self.share),
            Exact.of(1.0) - Exact.of(self.delta),
        )
        reached = p * moved + rest * (coupling @ stack[self.N] @ coupling.T)
        good = (kept * p * rest * stack[: self.N] - reached).definite().all()
        good = good and bool((kept * stack[self.N] - Fe @ stack[self.N] @ Fe.T).definite())
        if not (good and stack.definite().all()):
            return
        self.epsilon = self._spread(residual)
        self.holds = np.isfinite(self.epsilon)

    def _spread(self, residual: Exact) -> float:
        """The least epsilon, nearly, that step 2 of the derivation allows; inf where none was found."""
        exponents = np.round(np.log2(np.maximum(np.diagonal(self.Q), 1e-300)) / 2).astype(int)
        lift = exponents.max() - exponents  # t_i = 2^lift up to a common factor
        weighted = Exact(
            np.asarray(residual.ints << lift[None, :].astype(object), dtype=object).sum(axis=1), residual.exponent
        )
        drop = Exact.of(np.ldexp(1.0, -lift))
        bound = (weighted * drop).reshape(self.N + 1, self.n)
        D = np.zeros((self.N + 1, self.n, self.n), dtype=object)
        D[:, range(self.n), range(self.n)] = bound.ints
        bounds, X = Exact(D, bound.exponent), Exact.of(self.X)
        scale = np.sqrt(np.diagonal(self.X, axis1=1, axis2=2))
        inverse = np.linalg.inv(self.X / (scale[:, :, None] * scale[:, None, :]))
        ratio = np.linalg.norm(inverse, 2, axis=(1, 2)) * (bound.rounded() / scale**2).max(axis=1)
        epsilon = float(np.maximum(ratio.max(), 1e-300))
        for _ in range(60):
            if (Exact.of(epsilon) * X - bounds).definite().all():
                return float(f"{_SLACK * 1.01 * epsilon:.2e}")
            epsilon *= 2
        return np.inf

    def intervals(self) -> list[tuple[float, float]]:
        """One for each node, then the centre's, then that of the mean over the nodes."""
        ratio = Fraction(self.epsilon) / Fraction(self.delta)
        traces = [
            sum((Fraction(self.Q[i, i]) for i in range(k * self.n, (k + 1) * self.n)), Fraction())
            for k in range(self.N + 1)
        ]
        widths = [ratio * sum(map(Fraction, np.diagonal(X).tolist()), Fraction()) for X in self.X]
        bounds = list(zip(traces, widths, strict=True))
        mean = (
            sum((t for t, _ in bounds[:-1]), Fraction()) / self.N,
            sum((w for _, w in bounds[:-1]), Fraction()) / self.N,
        )
        return [(_down(t - w), _up(t + w)) for t, w in [*bounds, mean]]

    def verdict(self) -> Proved:
        intervals = self.intervals()
        *nodes, centre, mean = (matrix_text(np.array(interval)) for interval in intervals)
        low, high = intervals[-1]
        proof: dict[str, Any] = {
            "method": "blocks",
            "Q": symmetric_text(self.Q),
            "X": [symmetric_text(X) for X in self.X],
            "epsilon": number_text(self.epsilon),
            "delta": number_text(self.delta),
            "share": number_text(self.share),
        }
        statement = statements.performance(low, high)
        return Proved(CLAIM, statement, proof, keys={"nodes": nodes, "centre": centre, "network": mean})


def exact_dynamics(network: ExactNetwork) -> tuple[Exact, Exact, Exact]:
    """F, the coupling blocks C_k, and G G', all dense: (d, d), (N, n, n), (d, d) with d = (N + 1) n."""
    deployed = network.deployed
    N, n = deployed.N, deployed.n
    centre = deployed.centre
    assert centre is not None
    F0, Fe = network.centre_loops
    Q, R = process_covariance(deployed), _noise_covariance(deployed)
    gains = np.zeros((N + 1, n, len(deployed.network.C)))
    hearer = np.repeat(deployed.hearer, np.diff(deployed.columns))
    gains[hearer, :, deployed.sensor_rows] = deployed.gains
    gains[N] = centre.gain.T
    G, Y = Exact.of(gains), Exact.of(centre.tilt)
    E = Q + G @ R @ G[N].T
    mixing = np.zeros((N + 1, N + 1))
    mixing[deployed.hearer, deployed.neighbours] = deployed.weights
    mixing[N, N] = 1.0
    W = Exact.of(mixing)
    d = (N + 1) * n
    flat, tilted = G.reshape(d, -1), (E @ Y).reshape(d, -1)
    everywhere = Exact(np.tile(Q.ints, (N + 1, N + 1)), Q.exponent)
    noise = _mixed(W, everywhere + flat @ R @ flat.T + tilted @ tilted.T, n)
    coupling = (W @ (E @ (Y @ (Y.T @ F0))).reshape(N + 1, n * n)).reshape(N + 1, n, n)[:N]
    A = exact_network_matrix(network)
    low = min(A.exponent, coupling.exponent, Fe.exponent)
    F = np.zeros((d, d), dtype=object)
    F[: N * n, : N * n] = A.ints << (A.exponent - low)
    F[: N * n, N * n :] = coupling.reshape(N * n, n).ints << (coupling.exponent - low)
    F[N * n :, N * n :] = Fe.ints << (Fe.exponent - low)
    return Exact(F, low), coupling, noise


def _mixed(W: Exact, X: Exact, n: int) -> Exact:
    """U X U' for U = W (x) I."""
    d = len(X.ints)
    half = (W @ X.reshape(-1, n * d)).reshape(d, d).T
    return (W @ half.reshape(-1, n * d)).reshape(d, d)


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
    X: Float[ndarray, "N n n"],
    centre: Float[ndarray, "n n"],
    moved: Float[ndarray, "N n n"],
    coupling: Float[ndarray, "N n n"],
    Fe: Float[ndarray, "n n"],
) -> tuple[float, float, float] | None:
    """delta, the share p, and the scale of the centre's X, such that the inequalities should hold; or None."""
    margin = 1 - max(largest_ratio(X, moved), largest_ratio(centre[None], (Fe @ centre @ Fe.T)[None]))
    if not margin > 0:
        return None
    share = float(f"{margin / 4:.2e}")
    reach = largest_ratio(X, coupling @ centre @ coupling.mT)
    scale = 1.0 if reach == 0 else min(1.0, 2.0 ** np.floor(np.log2(share * margin / 4 / reach)))
    return float(f"{margin / 4:.2e}"), share, float(scale)


def _down(x: Fraction) -> float:
    near = float(x)
    return near if Fraction(near) <= x else float(np.nextafter(near, -np.inf))


def _up(x: Fraction) -> float:
    near = float(x)
    return near if Fraction(near) >= x else float(np.nextafter(near, np.inf))
