"""The distributed robust Kalman filter over corrupted channels, Algorithm 1: its covariances, which need no data.

One step from k - 1 to k at every node i, with pairs (i, j) for everything that i fuses (docs/mathematics.md, 13.2):

    second moment  Pi_k      = A Pi A' + mu F Pi F' + Q                                   Lemma 3.1
    prediction     Pbar_i    = A P_i A' + mu F Pi F' + Q                                  Lemma 3.2
    update         P~_i^-1   = Pbar_i^-1 + tau_i^2 C_i' Rt_i^-1 C_i,  Rt_i = R_i + phi_i C_i Pi_k C_i'    Lemma 3.3
    exchange       Pcheck_ij = P~_j + D_ij + Dbar_ij + Wbar_ij  (j != i),   Pcheck_ii = P~_i              eq. (3)
    fusion         P_i       = (sum_j a_ij Pcheck_ij^-1)^-1                               eq. (5)

with A, F, Q, mu and Pi on the right of the first two of instant k - 1. Leading axes of P (runs, say) are carried on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.stacked import symmetric_part
from tolnet.model import CorruptedNetwork
from tolnet.model.corrupted import Instant


class DrkfStep(NamedTuple):
    """One step of the recursion at every node."""

    P_bar: Float[ndarray, "*r N n n"]
    """Predicted."""
    K: Float[ndarray, "*r M n"]
    """Gains K_{k,i}, transposed and packed like C: node i owns the rows of K_i' (p_i, n)."""
    P_tilde: Float[ndarray, "*r N n n"]
    """Updated: what node i sends."""
    P_check: Float[ndarray, "*r E n n"]
    """Received and inflated, one a pair of `network.pairs`."""
    P: Float[ndarray, "*r N n n"]
    """Fused."""


def step_second_moment(before: Instant, Pi: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    """Pi_k = A Pi A' + mu F Pi F' + Q with everything of instant k - 1, Lemma 3.1."""
    A, F = before.A, before.F
    return symmetric_part(A @ Pi @ A.T + before.mu * (F @ Pi @ F.T) + before.Q)


def step_drkf(
    network: CorruptedNetwork,
    k: int,
    P: Float[ndarray, "*r N n n"],
    Pi: Float[ndarray, "n n"],
    *,
    channel: Float[ndarray, "*r E n n"] | float = 0.0,
) -> tuple[DrkfStep, Float[ndarray, "n n"]]:
    """Everything of instant k >= 1, and Pi_k, from P and Pi of instant k - 1.

    `channel` is the realised noise D_{k,i,j} on the matrices that were sent, one a pair and zero on a node's own
    (which `exchange` does not check); 0 for a clean channel, whose bounds are in force all the same.
    """
    before, now = network.at(k - 1), network.at(k)
    noise = before.mu * (before.F @ Pi @ before.F.T) + before.Q
    Pi = step_second_moment(before, Pi)
    P_bar = predict(before.A, noise, P)
    K, P_tilde = update(now, P_bar, Pi)
    P_check = exchange(network, now, P_tilde, channel)
    return DrkfStep(P_bar, K, P_tilde, P_check, fuse(network, P_check)), Pi


def predict(
    A: Float[ndarray, "n n"], noise: Float[ndarray, "n n"], P: Float[ndarray, "*r N n n"]
) -> Float[ndarray, "*r N n n"]:
    """A P A' + noise, where noise = mu F Pi F' + Q."""
    return symmetric_part(A @ P @ A.T + noise)


def update(
    now: Instant, P_bar: Float[ndarray, "*r N n n"], Pi: Float[ndarray, "n n"]
) -> tuple[Float[ndarray, "*r M n"], Float[ndarray, "*r N n n"]]:
    """The gains K_i = tau Pbar C' (tau^2 C Pbar C' + Rt)^-1, packed and transposed, and P~_i, Lemma 3.3.

    P~ is formed as (I - tau K C) Pbar (I - tau K C)' + K Rt K', which rounding cannot make indefinite.
    """
    eye, rows = np.eye(P_bar.shape[-1]), now.sensors.rows
    K = np.zeros((*P_bar.shape[:-3], int(rows[-1]), P_bar.shape[-1]))
    P_tilde = P_bar.copy()
    for nodes, C, R in now.sensors.groups():
        tau, phi = now.tau[nodes, None, None], now.phi[nodes, None, None]
        R_tilde = R + phi * (C @ Pi @ C.mT)
        C = tau * C
        own = P_bar[..., nodes, :, :]
        CP = C @ own
        K_T = np.linalg.solve(symmetric_part(CP @ C.mT + R_tilde), CP)
        left = eye - K_T.mT @ C
        P_tilde[..., nodes, :, :] = symmetric_part(left @ own @ left.mT + K_T.mT @ R_tilde @ K_T)
        p = C.shape[-2]
        K[..., rows[nodes, None] + np.arange(p), :] = K_T
    return K, P_tilde


def exchange(
    network: CorruptedNetwork,
    now: Instant,
    P_tilde: Float[ndarray, "*r N n n"],
    channel: Float[ndarray, "*r E n n"] | float = 0.0,
) -> Float[ndarray, "*r E n n"]:
    """What every node receives, inflated by the bounds of the channel, one a pair."""
    return P_tilde[..., network.pairs[:, 1], :, :] + channel + (now.D_bar + now.W_bar)


def fuse(network: CorruptedNetwork, P_check: Float[ndarray, "*r E n n"]) -> Float[ndarray, "*r N n n"]:
    """P_i = (sum_j a_ij Pcheck_ij^-1)^-1, covariance intersection with the network's weights."""
    weighted = network.fusion.data[:, None, None] * np.linalg.inv(P_check)
    return symmetric_part(np.linalg.inv(sum_by_receiver(network, weighted)))


def sum_by_receiver(network: CorruptedNetwork, parts: Float[ndarray, "*r E n m"]) -> Float[ndarray, "*r N n m"]:
    """The sum of what each node received, over its pairs."""
    return np.add.reduceat(parts, network.fusion.indptr[:-1], axis=-3)
