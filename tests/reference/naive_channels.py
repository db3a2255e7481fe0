"""The filter over corrupted channels as a textbook writes it: one node after another, explicit inverses."""

from __future__ import annotations

import numpy as np
from numpy import ndarray
from numpy.linalg import inv

from tolnet.model import CorruptedNetwork


def step(network: CorruptedNetwork, k: int, P: ndarray, Pi: ndarray, D: dict[tuple[int, int], ndarray] | None = None):
    """P_i, K_i, P~_i of instant k and Pi_k, from those of k - 1; D is the noise on the matrices, by (i, j)."""
    A, F, Q, mu = (part(k - 1) for part in (network.A, network.F, network.Q, network.mu))
    after = A @ Pi @ A.T + float(mu) * F @ Pi @ F.T + Q
    gains, updated = [], []
    for i in range(network.N):
        C = network.C(k)[network.rows[i] : network.rows[i + 1]]
        R, tau, phi = network.sensors(k).block(i), network.tau(k)[i], network.phi(k)[i]
        P_bar = A @ P[i] @ A.T + float(mu) * F @ Pi @ F.T + Q
        R_tilde = R + phi * C @ after @ C.T
        K = tau * P_bar @ C.T @ inv(tau**2 * C @ P_bar @ C.T + R_tilde)
        gains.append(K)
        updated.append((np.eye(network.n) - tau * K @ C) @ P_bar)
    bounds = {(i, j): network.D_bar(k)[e] + network.W_bar(k)[e] for e, (i, j) in enumerate(network.pairs.tolist())}
    fused = []
    for i in range(network.N):
        information = np.zeros((network.n, network.n))
        for j in network.neighbours(i):
            P_check = updated[j]
            if i != j:
                P_check = P_check + (D or {}).get((i, int(j)), 0.0) + bounds[i, int(j)]
            information += network.fusion[i, j] * inv(P_check)
        fused.append(inv(information))
    return np.array(fused), gains, np.array(updated), after


def information(network: CorruptedNetwork, k: int, Pi: ndarray, form: str) -> list[ndarray]:
    """tau^2 C' Rt^-1 C of every node."""
    found = []
    for i in range(network.N):
        C = network.C(k)[network.rows[i] : network.rows[i + 1]]
        R, tau, phi = network.sensors(k).block(i), network.tau(k)[i], network.phi(k)[i]
        if form == "classical":
            found.append(C.T @ inv(R) @ C)
            continue
        spread = C @ Pi @ C.T if form == "sharp" else np.linalg.norm(Pi, 2) * C @ C.T
        found.append(tau**2 * C.T @ inv(R + phi * spread) @ C)
    return found


def gramians(network: CorruptedNetwork, start: int, L: int, form: str, left_out: int | None = None) -> ndarray:
    """The sum of eqs. (6) and (11) over the window that begins at `start`; `form` stated needs the norm recursion."""
    Pi, pi = network.initial_second_moment, np.linalg.norm(network.initial_second_moment, 2)
    total, Phi = np.zeros((network.n, network.n)), np.eye(network.n)
    for s in range(start + L):
        A, F, Q, mu = (part(s) for part in (network.A, network.F, network.Q, network.mu))
        if s >= start:
            bound = pi * np.eye(network.n) if form == "stated" else Pi
            for i, each in enumerate(information(network, s, bound, form)):
                total += 0 if i == left_out else Phi.T @ each @ Phi
            Phi = A @ Phi
        Pi = A @ Pi @ A.T + float(mu) * F @ Pi @ F.T + Q
        norms = [np.linalg.norm(X, 2) for X in (A, F, Q)]
        pi = (norms[0] ** 2 + float(mu) * norms[1] ** 2) * pi + norms[2]
    return total
