"""What Algorithm 1 settles on, without data: its periodic covariances and gains (docs/mathematics.md, 13.5).

The map T from P of one instant to that of the next keeps the Loewner order and is strictly subhomogeneous,

    T(a P) <= (a - (a - 1) s) T(P)  for a >= 1,   s the largest with  noise >= s Pbar,

since prediction adds noise and everything after it is monotone and at most homogeneous. So there is at most one
periodic solution, it attracts every P_0 > 0, and a residual turns into a two-sided bound on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.drkf import fuse, predict
from tolnet.analysis.fading_information import rows_given_moment
from tolnet.analysis.lost_modes import lost_modes
from tolnet.analysis.second_moment import Moment, SecondMomentLimit, second_moment_limit, second_moments
from tolnet.analysis.stacked import symmetric_part
from tolnet.model import CorruptedNetwork, InputError, Status
from tolnet.model.drkf import CHANNELS, SIGNS, Channel, DrkfHistory, DrkfSteadyState

Progress = Callable[[int, int], None]

MAX_STEPS = 100_000
"""Instants after which the recursion counts as not converging."""
TOLERANCE = 1e-12
"""Relative change of P over a period at which it counts as settled."""
SIX_DIGITS = 1e-6
"""Above this error there is no answer."""
_UNSEEN = 1e-10  # F U below this share of F is rounding


@dataclass(frozen=True)
class _Phase:
    """What leads to an instant, at given second moments before and at it."""

    A: Float[ndarray, "n n"]
    noise: Float[ndarray, "n n"]
    """mu F Pi F' + Q of the instant before."""
    Y: Float[ndarray, "N p n"]
    Z: Float[ndarray, "N p p"]
    inflation: Float[ndarray, "E n n"]


def solve_drkf(
    network: CorruptedNetwork, *, channel: Channel = "worst", progress: Progress | None = None
) -> DrkfSteadyState:
    """The steady (or periodic) covariances and gains of Algorithm 1, for k so large that Pi_k is at its limit.

    `channel` says which noise on the matrices is realised on every link: the largest that its bound admits ("worst":
    P of any realisation is eventually below this one), none ("clean"), or the least ("best"), which is also the
    filter that sends no matrices and takes them from this table. The recursion is followed from P = 0, below all its
    orbits, until it settles; the error is then bounded from both sides.
    Assumes nothing: `undetectable` where a mode that does not decay is seen by nobody in the long run, `diverges`
    where the multiplicative noise acts on a growing direction, `not-converged` where six digits were not reached.
    Raises UnsupportedError for functions of k, InputError for an unknown channel.
    Source: Algorithm 1; docs/mathematics.md, section 13.5.
    """
    sign = _sign(channel)
    limit = second_moment_limit(network)
    T = len(limit.Pi)
    refused = _refused(network, limit)
    if refused is not None:
        return _no_answer(network, channel, T, *refused)
    try:
        return _settle(network, channel, limit, sign, progress)
    except np.linalg.LinAlgError:
        return _no_answer(network, channel, T, Status.NOT_CONVERGED, _SINGULAR)


def _settle(
    network: CorruptedNetwork,
    channel: Channel,
    limit: SecondMomentLimit,
    sign: float,
    progress: Progress | None,
) -> DrkfSteadyState:
    """From P = 0 until nothing changes. Raises LinAlgError where rounding leaves a covariance singular."""
    T = len(limit.Pi)
    phases = [_phase(network, t, limit.at(t), limit.at(t + 1), sign) for t in range(T)]
    P = np.zeros((network.N, network.n, network.n))
    change, periods = np.inf, 0
    while change > TOLERANCE and periods * T < MAX_STEPS:
        before = P
        for phase in phases:
            P = _step(network, phase, P)[2]
        periods += 1
        size = np.maximum(np.abs(P).max(axis=(1, 2)), 1e-300)
        change = float((np.abs(P - before).max(axis=(1, 2)) / size).max())
        if progress is not None:
            progress(min(periods * T, MAX_STEPS), MAX_STEPS)
    # P belongs to the last phase of a period; one more period fills the phases, whose last is compared with it.
    found = []
    start = P
    shrink = 1.0
    for phase in phases:
        P_bar, P_tilde, P, K = _step(network, phase, P)
        shrink *= 1 - _share(phase.noise, P_bar)
        found.append((P_bar, P_tilde, P, K))
    residual = _loewner_change(start, P)
    error = _error(residual, shrink)
    # phases[t] leads to instants of phase t + 1
    P_bar, P_tilde, P, K = (np.roll(np.stack(part), 1, axis=0) for part in zip(*found, strict=True))
    if not error <= SIX_DIGITS:
        reason = f"after {periods * T} instants the covariances still change by {change:.1e}; error bound {error:.1e}"
        return _no_answer(network, channel, T, Status.NOT_CONVERGED, reason)
    return DrkfSteadyState(network, channel, P_bar, P_tilde, P, K, residual, error, periods, Status.OK, "")


def follow_drkf(
    network: CorruptedNetwork, horizon: int, *, channel: Channel = "clean", progress: Progress | None = None
) -> DrkfHistory:
    """Algorithm 1's covariances and gains from P_0 over `horizon` steps, functions of k included.

    Raises InputError for an unknown channel or a horizon below 1.
    """
    sign = _sign(channel)
    if horizon < 1:
        raise InputError(f"the horizon is {horizon}; a number >= 1 was expected")
    limit = None if network.period is None else second_moment_limit(network)
    if limit is not None and is_driven(network, limit):
        limit = None  # what grows drives the filter as well
    moments = second_moments(network, limit)
    before = next(moments)
    P, Pi = [network.initial_covariance], [before.Pi]
    K = [np.zeros((int(network.rows[-1]), network.n))]
    for k in range(horizon):
        now = next(moments)
        try:
            _, _, fused, gains = _step(network, _phase(network, k, before, now, sign), P[-1])
        except np.linalg.LinAlgError:  # rounding left a covariance singular: no number from here on
            fused, gains = np.full_like(P[-1], np.nan), np.full_like(K[-1], np.nan)
        P.append(fused)
        K.append(gains)
        Pi.append(_with_infinity(now))
        before = now
        if progress is not None:
            progress(k + 1, horizon)
    return DrkfHistory(network, channel, np.stack(P), np.stack(K), np.stack(Pi))


_SINGULAR = "rounding leaves a fused covariance singular: some sensors are too precise beside the noise of the plant"


def _with_infinity(moment: Moment) -> Float[ndarray, "n n"]:
    """Pi, infinite in every entry that a growing direction has a part in once it counts as infinite."""
    touched = np.abs(moment.U).max(axis=1, initial=0.0) > _UNSEEN
    return np.where(touched[:, None] & touched, np.inf, moment.Pi)


def sweep_drkf(
    network: CorruptedNetwork,
    parameter: str,
    values: Sequence[float],
    *,
    relative: bool = False,
    channel: Channel = "worst",
    progress: Progress | None = None,
) -> list[DrkfSteadyState]:
    """The steady state for each value of one parameter of SWEPT, at every node or on every link.

    `relative` multiplies what the network has instead of replacing it. Raises InputError for an unknown parameter and
    for values that the network refuses.
    """
    if parameter not in SWEPT:
        raise InputError(f"{parameter!r} cannot be swept; {', '.join(SWEPT)} can")
    found = []
    for done, value in enumerate(values):
        found.append(solve_drkf(varied(network, parameter, value, relative=relative), channel=channel))
        if progress is not None:
            progress(done + 1, len(values))
    return found


SWEPT = {
    "fading_mean": "tau",
    "fading_variance": "phi",
    "multiplicative_variance": "mu",
    "estimate_noise": "W_bar",
    "matrix_noise": "D_bar",
}
"""What can be swept, and its letter."""


def varied(network: CorruptedNetwork, parameter: str, value: float, *, relative: bool) -> CorruptedNetwork:
    """The network with one parameter of SWEPT set to a value, or multiplied by it.

    Raises InputError for a value that the network refuses; a fading variance is tightened with a warning.
    """
    if not relative:
        given: dict[str, Any] = {parameter: value}
        return network.replaced(**given)
    if not value >= 0:
        raise InputError(f"{parameter} times {value} is asked for; a factor >= 0 was expected")
    return network.scaled(SWEPT[parameter], value)


def _sign(channel: str) -> float:
    if channel not in CHANNELS:
        raise InputError(f"there is no channel {channel!r}; {', '.join(CHANNELS)} are known")
    return SIGNS[channel]


def _refused(network: CorruptedNetwork, limit: SecondMomentLimit) -> tuple[Status, str] | None:
    """Why there cannot be a steady state, if that is known beforehand."""
    if is_driven(network, limit):
        return Status.DIVERGES, (
            "the multiplicative noise acts on a direction in which the second moment of the state grows without"
            " bound, and so does the noise that it makes"
        )
    lost = lost_modes(network, limit)
    if not lost:
        return None
    states = network.states or tuple(f"x{j + 1}" for j in range(network.n))
    mode = lost[0]
    along = " ".join(f"{x:+.3g} {state}" for x, state in zip(mode.direction, states, strict=True) if abs(x) > 1e-6)
    seen = (
        f"only by fading sensors (nodes {', '.join(map(network.label, mode.nodes))})" if mode.nodes else "by nobody"
    )
    return Status.UNDETECTABLE, f"the mode along {along} does not decay and is seen {seen}"


def is_driven(network: CorruptedNetwork, limit: SecondMomentLimit) -> bool:
    """Whether the multiplicative noise acts on a direction in which the second moment grows without bound."""
    if limit.bounded:
        return False
    acting = ((network.F(t), limit.U[t]) for t in range(len(limit.Pi)) if network.mu(t) > 0)
    return any(np.linalg.norm(F @ U, 2) > _UNSEEN * np.linalg.norm(F, 2) for F, U in acting)


def _phase(network: CorruptedNetwork, k: int, before: Moment, now: Moment, sign: float) -> _Phase:
    """From instant k to k + 1."""
    last, here = network.at(k), network.at(k + 1)
    noise = symmetric_part(last.mu * (last.F @ before.bounded @ last.F.T) + last.Q)
    Y, Z = rows_given_moment(network, k + 1, now)
    return _Phase(last.A, noise, Y, Z, here.W_bar + (1 + sign) * here.D_bar)


def _step(
    network: CorruptedNetwork, phase: _Phase, P: Float[ndarray, "N n n"]
) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Pbar, P~, P and the packed gains of one instant; K = Pbar Y'(I + Y Pbar Y')^-1 Z with Y = Z tau C."""
    P_bar = predict(phase.A, phase.noise, P)
    YP = phase.Y @ P_bar
    G = np.linalg.solve(symmetric_part(YP @ phase.Y.mT) + np.eye(phase.Y.shape[1]), YP).mT
    left = np.eye(network.n) - G @ phase.Y
    P_tilde = symmetric_part(left @ P_bar @ left.mT + G @ G.mT)
    P = fuse(network, P_tilde[network.pairs[:, 1]] + phase.inflation)
    sizes = np.diff(network.rows)
    own = np.arange(phase.Y.shape[1]) < sizes[:, None]
    return P_bar, P_tilde, P, (G @ phase.Z).mT[own]


def _share(noise: Float[ndarray, "n n"], P_bar: Float[ndarray, "N n n"]) -> float:
    """The largest s with noise >= s Pbar at every node."""
    L = np.linalg.cholesky(P_bar)
    scaled = np.linalg.solve(L, np.linalg.solve(L, np.broadcast_to(noise, L.shape)).mT)
    return float(np.clip(np.linalg.eigvalsh(symmetric_part(scaled)).min(), 0.0, 1.0))


def _loewner_change(P: Float[ndarray, "N n n"], after: Float[ndarray, "N n n"]) -> float:
    """The least e with P / (1 + e) <= after <= (1 + e) P at every node."""
    L = np.linalg.cholesky(P)
    scaled = np.linalg.solve(L, np.linalg.solve(L, after).mT)
    values = np.linalg.eigvalsh(symmetric_part(scaled))
    with np.errstate(divide="ignore"):
        return float(max(values.max() - 1, (1 / values.min() - 1) if values.min() > 0 else np.inf, 0.0))


def _error(residual: float, shrink: float) -> float:
    """a - 1 for the least a with T(a P) <= a P, where T(P) <= (1 + residual) P and T shrinks a - 1 by `shrink`."""
    s = 1 - shrink
    room = s - residual * shrink
    return residual / room if room > 0 else np.inf


def _no_answer(network: CorruptedNetwork, channel: Channel, T: int, status: Status, reason: str) -> DrkfSteadyState:
    nothing = np.full((T, network.N, network.n, network.n), np.nan)
    K = np.full((T, int(network.rows[-1]), network.n), np.nan)
    nan = float("nan")
    return DrkfSteadyState(network, channel, nothing, nothing, nothing, K, nan, nan, 0, status, reason)
