"""Theorem 3.1 with an explicit constant, and the sharper bound that is computed (docs/mathematics.md, 13.4)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tolnet.analysis.drkf_steady_state import solve_drkf
from tolnet.analysis.multiplicative_noise import multiplicative_noise_condition
from tolnet.analysis.observability import robust_observability
from tolnet.model import CorruptedNetwork, UnsupportedError
from tolnet.model.drkf import DrkfSteadyState
from tolnet.model.error_bound import ErrorBound
from tolnet.model.observability import RobustObservability

LARGEST = 3000
"""Nodes up to which powers of the fusion weights are formed; later ones have no zeros."""


def error_bound(
    network: CorruptedNetwork,
    *,
    horizon: int | None = None,
    window: int | None = None,
    observability: RobustObservability | None = None,
    steady_state: DrkfSteadyState | None = None,
) -> ErrorBound:
    """E e e' <= c_0 / alpha I at every node for k >= N + N_bar, with

        c_0 = max(a_upper, 1)^(N + N_bar - 2) / (a_min eta^(N + N_bar - 1) beta^(N + N_bar - 2)),

    alpha of eq. (11) over windows of N_bar + 1 instants, and beside it the largest eigenvalue that the filter's own P
    reaches under the worst admissible channels. A single node counts as N = 2 with a_min = 1. With a horizon every
    supremum is over k = 0..horizon. c_0 is a certificate, not a figure of performance: it is larger by many orders.
    What was found before may be handed in (`observability` in the sharp form, `steady_state` of the worst channel).
    Raises UnsupportedError for functions of k without a horizon, and beyond LARGEST nodes.
    Source: Theorem 3.1 and its proof, eqs. (37)-(41); docs/mathematics.md, section 13.4.
    """
    if network.N > LARGEST:
        raise UnsupportedError(
            f"the constant needs powers of the fusion weights of {network.N} nodes; {LARGEST} at most"
        )
    seen = observability
    if seen is None or seen.form != "sharp" or seen.horizon != horizon or window not in (None, seen.window):
        seen = robust_observability(network, horizon=horizon, window=window)
    noise = multiplicative_noise_condition(network, horizon=horizon)
    if steady_state is None and network.period is not None:
        steady_state = solve_drkf(network, channel="worst")
    N, N_bar = max(network.N, 2), seen.window - 1
    sup = _suprema(network, noise.supremum, horizon)
    # Rounding may leave a least eigenvalue of Q at or below zero, and then nothing is said.
    p_min = 1 / (1 / sup.q_lower + sup.information) if sup.q_lower > 0 else 0.0
    eta = p_min / (p_min + sup.channel) if p_min > 0 else 0.0
    beta = p_min * noise.a_lower / (p_min * noise.a_lower + sup.q_hat)
    a_min = _least_weight(network, N_bar)
    with np.errstate(divide="ignore"):
        log = (
            (N + N_bar - 2) * np.log10(max(noise.a_upper, 1.0))
            - np.log10(a_min)
            - (N + N_bar - 1) * np.log10(eta)
            - (N + N_bar - 2) * np.log10(beta)
        )
    reasons = [seen.reason] if not seen.holds else []
    reasons += ["rounding leaves no least eigenvalue of Q above zero"] if not p_min > 0 else []
    reasons += [noise.reason] if not math.isfinite(noise.supremum) else []
    return ErrorBound(
        network=network,
        observability=seen,
        multiplicative_noise=noise,
        applies=not reasons,
        start=network.N + N_bar,
        p_min=p_min,
        q_lower=sup.q_lower,
        q_hat=sup.q_hat,
        eta=eta,
        beta=beta,
        a_min=a_min,
        log10_c0=float(log),
        steady_state=steady_state,
        reason="; ".join(reasons),
    )


class _Suprema(NamedTuple):
    q_lower: float
    q_hat: float
    information: float
    """tau^2 |C|^2 |R^-1|."""
    channel: float
    """|W + 2 D|."""


def _suprema(network: CorruptedNetwork, driven: float, horizon: int | None) -> _Suprema:
    """Over one period or k = 0..horizon; `driven` is sup mu |F Pi F'|, which is added to |Q|."""
    count = horizon + 1 if horizon is not None else (network.period or 0)
    q_lower, q_upper, information, channel = np.inf, 0.0, 0.0, 0.0
    for k in range(count):
        now = network.at(k)
        sizes = np.linalg.eigvalsh(now.Q)
        q_lower, q_upper = min(q_lower, float(sizes[0])), max(q_upper, float(sizes[-1]))
        for nodes, C, R in now.sensors.groups():
            gain = now.tau[nodes] ** 2 * np.linalg.norm(C, 2, axis=(1, 2)) ** 2 / np.linalg.eigvalsh(R)[:, 0]
            information = max(information, float(gain.max()))
        channel = max(channel, float(np.linalg.eigvalsh(now.W_bar + 2 * now.D_bar).max()))
    return _Suprema(q_lower, q_upper + driven, information, channel)


def _least_weight(network: CorruptedNetwork, N_bar: int) -> float:
    """The least entry of the powers N - 1, ..., N + N_bar - 1 of the fusion weights."""
    N = network.N
    if N == 1:
        return 1.0
    weights = network.fusion.toarray()
    power = np.linalg.matrix_power(weights, N - 1)
    least = float(power.min())
    for _ in range(N_bar):
        power = power @ weights
        least = min(least, float(power.min()))
    return least
