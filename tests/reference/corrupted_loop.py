"""Filters over corrupted channels as one would write them from the papers: a loop over nodes, one run at a time.

Each takes the network and one run as `walk_corrupted` drew it, and returns estimates (T + 1, K, n) and covariances
(T + 1, K, n, n). Explicit inverses, no stacks.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy import ndarray
from numpy.linalg import inv

from tolnet.design import choose_fusion_weights
from tolnet.model import CorruptedNetwork

Run = list[tuple[ndarray, ndarray, ndarray, ndarray]]
"""x (n,), y (M,), e (E, n) and D (E, n, n) of the instants 0, 1, ..., T."""
Found = tuple[ndarray, ndarray]


def sensor(network: CorruptedNetwork, k: int, i: int) -> tuple[ndarray, ndarray]:
    """C_i and R_i at instant k."""
    C, R = network.C(k), network.R(k)
    p = np.diff(network.rows)
    start = int((p[:i] ** 2).sum())
    return C[network.rows[i] : network.rows[i + 1]], R[start : start + p[i] ** 2].reshape(p[i], p[i])


def outputs(network: CorruptedNetwork, y: ndarray, i: int) -> ndarray:
    """y_i."""
    return y[network.rows[i] : network.rows[i + 1]]


def second_moments(network: CorruptedNetwork, steps: int) -> list[ndarray]:
    """Pi_0, ..., Pi_T."""
    found = [network.initial_second_moment]
    for k in range(steps):
        at = network.at(k)
        found.append(at.A @ found[-1] @ at.A.T + at.mu * at.F @ found[-1] @ at.F.T + at.Q)
    return found


def drkf(network: CorruptedNetwork, run: Run, *, sliding: bool = False) -> Found:
    """Algorithms 1 and 2; the programs of eq. (17) by Clarabel."""
    N, n, T = network.N, network.n, len(run) - 1
    Pi = second_moments(network, T)
    x, P = np.tile(network.initial_mean, (N, 1)), network.initial_covariance.copy()
    found, covariances = [x.copy()], [P.copy()]
    kept: list[list[tuple[ndarray, ndarray]]] = []
    for k in range(1, T + 1):
        before, now = network.at(k - 1), network.at(k)
        noise = before.mu * before.F @ Pi[k - 1] @ before.F.T + before.Q
        _, y, e, D = run[k]
        sent_x, sent_P = [], []
        for i in range(N):
            x_bar, P_bar = before.A @ x[i], before.A @ P[i] @ before.A.T + noise
            C, R = sensor(network, k, i)
            tau = now.tau[i]
            R = R + now.phi[i] * C @ Pi[k] @ C.T
            K = tau * P_bar @ C.T @ inv(tau**2 * C @ P_bar @ C.T + R)
            sent_x.append(x_bar + K @ (outputs(network, y, i) - tau * C @ x_bar))
            sent_P.append((np.eye(n) - tau * K @ C) @ P_bar)
        kept = [[(before.A @ z, before.A @ Z @ before.A.T + noise) for z, Z in old] for old in kept]
        kept.insert(0, [
            (sent_x[j] + e[r], sent_P[j] + D[r] + now.D_bar[r] + now.W_bar[r])
            for r, (_, j) in enumerate(network.pairs.tolist())
        ])  # fmt: skip
        kept = kept[: network.window if sliding else 1]
        for i in range(N):
            rows = np.flatnonzero(network.pairs[:, 0] == i)
            a = [network.fusion[i, j] for j in network.pairs[rows, 1]]
            solve = sliding and k % network.interval[i] == 0
            pairs = [old[r] for old in (kept if solve else kept[:1]) for r in rows]
            weights = np.array(a + [0.0] * (len(pairs) - len(a)))
            information = np.array([inv(Z) for _, Z in pairs])
            if solve:
                symmetric = (information + information.swapaxes(1, 2)) / 2
                weights = choose_fusion_weights(symmetric, weights, method="clarabel").or_reference()
            P[i] = inv(sum(w * I for w, I in zip(weights, information, strict=True)))
            x[i] = P[i] @ sum(w * I @ z for w, I, (z, _) in zip(weights, information, pairs, strict=True))
        found.append(x.copy())
        covariances.append(P.copy())
    return np.array(found), np.array(covariances)


def centralised(network: CorruptedNetwork, run: Run, *, fading_known: bool, robust: bool) -> Found:
    """CKF, CKF-tau and CRKF with stacked sensors."""
    n, T = network.n, len(run) - 1
    Pi = second_moments(network, T)
    least = int(np.trace(network.initial_covariance, axis1=1, axis2=2).argmin())
    x, P = network.initial_mean.copy(), network.initial_covariance[least]
    found, covariances = [x], [P]
    for k in range(1, T + 1):
        before, now = network.at(k - 1), network.at(k)
        P_bar = before.A @ P @ before.A.T + before.Q
        if robust:
            P_bar = P_bar + before.mu * before.F @ Pi[k - 1] @ before.F.T
        C, R = np.zeros((0, n)), np.zeros((len(run[k][1]),) * 2)
        for i in range(network.N):
            C_i, R_i = sensor(network, k, i)
            if robust:
                R_i = R_i + now.phi[i] * C_i @ Pi[k] @ C_i.T
            own = slice(len(C), len(C) + len(C_i))
            R[own, own] = R_i
            C = np.vstack([C, now.tau[i] * C_i if fading_known else C_i])
        K = P_bar @ C.T @ inv(C @ P_bar @ C.T + R)
        x = before.A @ x + K @ (run[k][1] - C @ before.A @ x)
        P = (np.eye(n) - K @ C) @ P_bar
        found.append(x)
        covariances.append(P)
    return np.array(found)[:, None], np.array(covariances)[:, None]


def csgf(network: CorruptedNetwork, run: Run, *, gain: float, fading_known: bool) -> Found:
    """CSGF and CSGF-tau: consensus with a scalar gain."""
    N, T = network.N, len(run) - 1
    x = np.tile(network.initial_mean, (N, 1))
    found = [x]
    for k in range(1, T + 1):
        A, y, e = network.A(k - 1), run[k][1], run[k][2]
        new = np.zeros_like(x)
        for i in range(N):
            for r in np.flatnonzero(network.pairs[:, 0] == i):
                j = network.pairs[r, 1]
                C, _ = sensor(network, k, j)
                expected = (network.tau(k)[j] if fading_known else 1.0) * C @ A @ x[i]
                new[i] += network.fusion[i, j] * A @ (x[j] + e[r])
                new[i] += gain * C.T @ (outputs(network, y, j) - expected)
        x = new
        found.append(x)
    return np.array(found), np.full((T + 1, N, network.n, network.n), np.nan)


def dsea(network: CorruptedNetwork, run: Run) -> Found:
    """Consensus on information pairs (q, Omega)."""
    N, T = network.N, len(run) - 1
    x, P = np.tile(network.initial_mean, (N, 1)), network.initial_covariance.copy()
    found, covariances = [x], [P]
    for k in range(1, T + 1):
        before, (_, y, e, D) = network.at(k - 1), run[k]
        q, Omega = [], []
        for i in range(N):
            C, R = sensor(network, k, i)
            P_bar = before.A @ P[i] @ before.A.T + before.Q
            Omega.append(inv(P_bar) + C.T @ inv(R) @ C)
            q.append(inv(P_bar) @ before.A @ x[i] + C.T @ inv(R) @ outputs(network, y, i))
        x, P = np.zeros_like(x), np.zeros_like(P)
        for i in range(N):
            total_q, total = 0.0, 0.0
            for r in np.flatnonzero(network.pairs[:, 0] == i):
                j, a = network.pairs[r, 1], network.fusion[i, network.pairs[r, 1]]
                received = inv(inv(Omega[j]) + D[r])
                total = total + a * received
                total_q = total_q + a * received @ (inv(Omega[j]) @ q[j] + e[r])
            P[i] = inv(total)
            x[i] = P[i] @ total_q
        found.append(x)
        covariances.append(P)
    return np.array(found), np.array(covariances)


LOOPS: dict[str, Callable[[CorruptedNetwork, Run], Found]] = {
    "DRKF": drkf,
    "DRKF-SWF": lambda network, run: drkf(network, run, sliding=True),
    "CKF": lambda network, run: centralised(network, run, fading_known=False, robust=False),
    "CKF-tau": lambda network, run: centralised(network, run, fading_known=True, robust=False),
    "CRKF": lambda network, run: centralised(network, run, fading_known=True, robust=True),
    "CSGF": lambda network, run: csgf(network, run, gain=0.25, fading_known=False),
    "CSGF-tau": lambda network, run: csgf(network, run, gain=0.25, fading_known=True),
    "DSEA-CP": dsea,
}
"""The filters by name; the gain of both kinds of CSGF is that of sensors with C_i C_i' = 1."""
