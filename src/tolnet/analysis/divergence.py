"""The divergence gamma and its inverse: from the eigenvalues of P and a tolerance to V (eq. (4), section 5).

The unknown is never theta. With lambda_1 the largest eigenvalue of P, every quantity is a function of the excess
mu_1 = v_1 / lambda_1 - 1 by which the largest eigenvalue of V exceeds that of P, free of cancellation at both ends:
theta lambda_1 -> 0 (mu_1 -> 0) and theta lambda_1 -> 1 (mu_1 -> infinity), where 1 - theta lambda_1
has lost its digits.

    1.  s_i = theta lambda_i,  1 + mu_i = v_i / lambda_i = (1 - (1 - tau) s_i)^(-1 / (1 - tau)),  e^(s_i) at tau = 1
    2.  gamma_tau = sum_i d_tau(log(1 + mu_i)),  d_tau(L) = (tau (e^L - 1) - (e^(tau L) - 1)) / (tau (1 - tau))
    3.  tau = 0:  mu_i = r_i mu_1 / (1 + (1 - r_i) mu_1),  r_i = lambda_i / lambda_1;  d_0(L) = e^L - 1 - L
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

_SERIES_BELOW = 0.4
_SERIES_TERMS = 18
_NEWTON_STEPS = 60
_LAST_STEP = 1e-9  # in log mu: Newton squares it, so that nothing is left to gain


class Inflation(NamedTuple):
    """How V exceeds P: V = U diag(lambda (1 + excess)) U' with P = U diag(lambda) U'."""

    theta: Float[ndarray, "*K"]
    excess: Float[ndarray, "*K n"]


def inflate(eigenvalues: Float[ndarray, "*K n"], tolerance: Float[ndarray, "*K"], tau: float = 0.0) -> Inflation:
    """Solve gamma_tau(P, theta) = c for theta > 0 and for V, given the eigenvalues of P in rising order.

    Assumes eigenvalues >= 0 with the largest positive, c >= 0 finite; c = 0 gives theta = 0, V = P.
    Safeguarded Newton on log gamma against log mu_1, to rounding. Where the largest eigenvalue is not a positive
    number there is no root: NaN.
    Source: eq. (4); docs/mathematics.md, sections 2 and 5.
    """
    largest = eigenvalues[..., -1]
    solvable = (largest > 0) & np.isfinite(largest)
    ratio = np.where(solvable[..., None], eigenvalues, 1.0) / np.where(solvable, largest, 1.0)[..., None]
    ratio = np.maximum(ratio, 0.0)  # rounding of a singular P
    gap = 1.0 - ratio
    wanted = np.where(tolerance > 0, tolerance, 1.0)
    # d_tau'' = (1 + mu)^(tau - 2) lies between that of tau = 0 and 1, and n d(mu_1) >= gamma >= d(mu_1):
    # sqrt(2 c / n) <= mu_1 <= sqrt(2 c) + c.
    low, high = np.sqrt(2 * wanted / eigenvalues.shape[-1]), np.sqrt(2 * wanted) + wanted
    low, high = low * (1 - _LAST_STEP), high * (1 + _LAST_STEP)
    top = np.clip(np.sqrt(2 * wanted / (ratio**2).sum(axis=-1)) + wanted, low, high)
    for _ in range(_NEWTON_STEPS):
        excess, slope = _spread(top, ratio, gap, tau)
        value = divergence(np.log1p(excess), tau).sum(axis=-1)
        low, high = np.where(value <= wanted, top, low), np.where(value >= wanted, top, high)
        derivative = (_derivative(excess, tau) * slope).sum(axis=-1)
        step = np.log(value / wanted) * value / (derivative * top)
        proposed = top * np.exp(-np.clip(step, -50, 50))
        inside = (proposed >= low) & (proposed <= high)
        small = np.abs(step) <= _LAST_STEP
        top = np.where(inside | small, proposed, np.sqrt(low * high))
        if small.all():
            break
    excess, _ = _spread(top, ratio, gap, tau)
    s = 1.0 / (1.0 + 1.0 / top) if tau == 0 else _scaled_theta(top, tau)
    positive = solvable & (tolerance > 0)
    theta = np.where(positive, s / np.where(solvable, largest, 1.0), 0.0)
    excess = np.where(positive[..., None], excess, 0.0)
    undefined = ~solvable & ~((tolerance == 0) & (largest == 0))
    return Inflation(np.where(undefined, np.nan, theta), np.where(undefined[..., None], np.nan, excess))


def scalar_excess(tolerance: Float[ndarray, "*K"], tau: float = 0.0) -> Float[ndarray, "*K"]:
    """Solve d_tau(log(1 + mu)) = c for mu >= 0: how far one eigenvalue alone may be inflated.

    1 + mu is the factor kappa_c of docs/mathematics.md, section 6: V <= kappa_c P for every P.
    """
    c = np.where(tolerance > 0, tolerance, 1.0)
    mu = np.sqrt(2 * c) + c if tau < 0.5 else np.sqrt(2 * c) + c / (1 + np.log1p(c))
    for _ in range(_NEWTON_STEPS):
        value = divergence(np.log1p(mu), tau)
        step = np.log(value / c) * value / (_derivative(mu, tau) * mu)
        mu = mu * np.exp(-np.clip(step, -50, 50))
        if (np.abs(step) <= _LAST_STEP).all():
            break
    return np.where(tolerance > 0, mu, 0.0)


def divergence(L: Float[ndarray, "*K"], tau: float = 0.0) -> Float[ndarray, "*K"]:
    """d_tau(L) of one eigenvalue inflated by e^L, L >= 0, to full relative accuracy.

    For small L by the series sum_{j >= 2} L^j / j! (1 - tau^(j-1)) / (1 - tau).
    """
    L = np.asarray(L, dtype=float)
    small = np.where(L < _SERIES_BELOW, L, 0.0)
    weights = np.cumsum(tau ** np.arange(_SERIES_TERMS))  # (1 - tau^(j-1)) / (1 - tau), j = 2, 3, ...
    series = np.zeros_like(small)
    for j in range(_SERIES_TERMS + 1, 1, -1):
        series = (series * (small / (j + 1))) + weights[j - 2]
    series = series * small**2 / 2
    large = np.where(L < _SERIES_BELOW, 1.0, L)
    if tau == 0:
        direct = np.expm1(large) - large
    elif tau <= 0.5:
        direct = (np.expm1(large) - np.expm1(tau * large) / tau) / (1 - tau)
    else:
        a = 1 - tau
        drop = np.expm1(-a * large) / a if a > 0 else -large
        direct = (1 - np.exp(large) * (drop + 1)) / tau
    return np.where(L < _SERIES_BELOW, series, direct)


def _derivative(excess: ndarray, tau: float) -> ndarray:
    """d gamma / d mu of one eigenvalue: (1 - (1 + mu)^(tau - 1)) / (1 - tau), mu / (1 + mu) at tau = 0."""
    if tau == 0:
        return excess / (1 + excess)
    if tau == 1:
        return np.log1p(excess)
    return -np.expm1((tau - 1) * np.log1p(excess)) / (1 - tau)


def _scaled_theta(top: ndarray, tau: float) -> ndarray:
    """s_1 = theta lambda_1 from mu_1."""
    return np.log1p(top) if tau == 1 else -np.expm1((tau - 1) * np.log1p(top)) / (1 - tau)


def _spread(top: ndarray, ratio: ndarray, gap: ndarray, tau: float) -> tuple[ndarray, ndarray]:
    """mu_i of every eigenvalue and d mu_i / d mu_1, from mu_1."""
    top = top[..., None]
    if tau == 0:
        below = 1 + gap * top
        return ratio * top / below, ratio / below**2
    L1 = np.log1p(top)
    if tau == 1:
        L = ratio * L1
        return np.expm1(L), ratio * np.exp(L - L1)
    a = 1 - tau
    x1, rest = -np.expm1(-a * L1), np.exp(-a * L1)  # x = a s; rest = 1 - x_1
    x = ratio * x1
    L = -np.where(x < 0.5, np.log1p(-np.minimum(x, 0.5)), np.log(gap * x1 + rest)) / a
    return np.expm1(L), ratio * np.exp((1 + a) * (L - L1))


def gamma(P: Float[ndarray, "*K n n"], theta: Float[ndarray, "*K"] | float, tau: float = 0.0) -> Float[ndarray, "*K"]:
    """gamma(P, theta) = log det(I - theta P) + tr((I - theta P)^-1 - I), eq. (4), or gamma_tau of section 5.

    Assumes P symmetric positive semidefinite, theta >= 0; inf where (1 - tau) theta lambda_max(P) >= 1.
    """
    s = np.asarray(theta)[..., None] * np.maximum(np.linalg.eigvalsh(P), 0.0)
    inside = (1 - tau) * s < 1
    x = np.where(inside, (1 - tau) * s, 0.0)
    L = s if tau == 1 else -np.log1p(-x) / (1 - tau)
    return np.where(inside.all(axis=-1), divergence(L, tau).sum(axis=-1), np.inf)
