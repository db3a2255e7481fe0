"""Assumption 3.2: does what the multiplicative noise makes of the state stay bounded? (docs/mathematics.md, 13.4)"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.drkf_steady_state import is_driven
from tolnet.analysis.second_moment import second_moment_limit, second_moments
from tolnet.model import CorruptedNetwork, InputError, UnsupportedError
from tolnet.model.error_bound import MultiplicativeNoise

_RESIDUAL = 1e-10  # how far F_2 Phi may be from G F_1, relatively
_SETTLED = 1e-12
_PATIENCE = 5000


def multiplicative_noise_condition(network: CorruptedNetwork, *, horizon: int | None = None) -> MultiplicativeNoise:
    """Test eqs. (8)-(10) over a period, or over k = 0..horizon, and compute what Lemma 3.5 bounds.

    With k_1 < k_2 < ... the instants where mu > 0 and G_l such that F_{k_{l+1}} Phi_l = G_l F_{k_l},

        a_l = mu_{k_{l+1}} / mu_{k_l} |G_l|^2 + mu_{k_{l+1}} |F_{k_{l+1}} Phi_l^+|^2,   X_{l+1} <= a_l X_l + b_l

    for X_l = mu |F Pi F'| at k_l; a G_l exists where F_{k_{l+1}} Phi_l sees nothing that F_{k_l} does not.
    Raises UnsupportedError for functions of k without a horizon, InputError for a horizon below 1.
    Source: Assumption 3.2, Lemma 3.5; docs/mathematics.md, section 13.4.
    """
    T = network.period
    if horizon is None and T is None:
        raise UnsupportedError("some matrix is a function of k; give a horizon")
    if horizon is not None and horizon < 1:
        raise InputError(f"the horizon is {horizon}; a number >= 1 was expected")
    count = T if horizon is None and T is not None else (horizon or 0) + 1
    sizes = np.array([np.linalg.svd(network.A(k), compute_uv=False)[[-1, 0]] ** 2 for k in range(count)])
    acting = [k for k in range(count) if network.mu(k) > 0 and network.F(k).any()]
    following = acting[1:] + ([acting[0] + count] if horizon is None and acting else [])
    steps = [_step(network, k, l) for k, l in zip(acting, following, strict=False)]
    a, b = np.array([step[0] for step in steps]), np.array([step[1] for step in steps])
    with np.errstate(divide="ignore"):
        growth = float(np.exp(np.log(a).mean())) if len(a) else 0.0
    b_bar = float(b.max(initial=0.0))
    supremum = _supremum(network, horizon) if acting else 0.0
    first = _size(network, acting[0], _moment(network, acting[0])) if acting else 0.0
    holds = bool(sizes[:, 0].min() > 0 and (growth < 1 or not acting) and np.isfinite(b_bar))
    if horizon is not None:  # over finitely many instants nothing can grow without bound
        holds = bool(np.isfinite(a).all())
    return MultiplicativeNoise(
        network=network,
        horizon=horizon,
        holds=holds,
        a_lower=float(sizes[:, 0].min()),
        a_upper=float(sizes[:, 1].max()),
        a=a,
        growth=growth,
        b_bar=b_bar,
        bound=_scalar_bound(a, b, first, repeat=horizon is None) if acting else 0.0,
        supremum=supremum,
        reason="" if holds else _reason(a, supremum),
    )


def _step(network: CorruptedNetwork, k: int, l: int) -> tuple[float, float]:
    """a_l and b_l from one instant with mu > 0 to the next."""
    n = network.n
    Phi_plus, noise = np.eye(n), network.Q(k)
    for s in range(k + 1, l):
        A = network.A(s)
        Phi_plus, noise = A @ Phi_plus, A @ noise @ A.T + network.Q(s)
    F_1, F_2, mu_1, mu_2 = network.F(k), network.F(l), float(network.mu(k)), float(network.mu(l))
    image = F_2 @ Phi_plus @ network.A(k)
    G = image @ np.linalg.pinv(F_1)
    exists = np.linalg.norm(G @ F_1 - image) <= _RESIDUAL * np.linalg.norm(image)
    size = float(np.linalg.norm(G, 2)) if exists else np.inf
    a = mu_2 / mu_1 * size**2 + mu_2 * float(np.linalg.norm(F_2 @ Phi_plus, 2)) ** 2
    return a, mu_2 * float(np.linalg.norm(F_2 @ noise @ F_2.T, 2))


def _scalar_bound(a: Float[ndarray, " S"], b: Float[ndarray, " S"], first: float, *, repeat: bool) -> float:
    """sup X_l of X_{l+1} = a_l X_l + b_l from the first X; for ever where `repeat`, and infinite where it grows."""
    if not np.isfinite(a).all() or (repeat and np.log(np.maximum(a, 1e-300)).sum() >= 0):
        return np.inf
    X = largest = first
    for _ in range(_PATIENCE if repeat else 1):
        before = X
        for a_l, b_l in zip(a, b, strict=True):
            X = a_l * X + b_l
            largest = max(largest, X)
        if abs(X - before) <= _SETTLED * X:
            break
    return float(largest)


def _moment(network: CorruptedNetwork, k: int) -> Float[ndarray, "n n"]:
    for s, moment in enumerate(second_moments(network, None)):
        if s == k:
            return moment.Pi
    raise AssertionError


def _size(network: CorruptedNetwork, k: int, Pi: Float[ndarray, "n n"]) -> float:
    F = network.F(k)
    return float(network.mu(k)) * float(np.linalg.norm(F @ Pi @ F.T, 2))


def _supremum(network: CorruptedNetwork, horizon: int | None) -> float:
    """sup mu_k |F_k Pi_k F_k'|, along the transient and in the limit."""
    limit = None if network.period is None else second_moment_limit(network)
    driven = limit is not None and is_driven(network, limit)
    if horizon is None and driven:
        return np.inf
    moments = second_moments(network, None if driven else limit)
    largest = 0.0
    for k, moment in enumerate(moments):
        largest = max(largest, _size(network, k, moment.bounded))
        if k >= (_PATIENCE if horizon is None else horizon):
            break
        if horizon is None and limit is not None:
            goal = limit.at(k).Pi
            if np.abs(moment.bounded - goal).max() <= _SETTLED * np.abs(goal).max():
                break
    if horizon is None and limit is not None:
        largest = max(largest, *(_size(network, t, limit.at(t).Pi) for t in range(len(limit.Pi))))
    return largest


def _reason(a: Float[ndarray, " S"], supremum: float) -> str:
    if np.isinf(a).any():
        said = "eq. (9) has no G_l: F of one instant sees, after one transition, what F of the instant before did not"
    else:
        said = f"the a_l of eq. (9) have the geometric mean {np.exp(np.log(a).mean()):.4g}, which is not below 1"
    if np.isfinite(supremum):
        return f"{said}; still, mu |F Pi F'| stays below {supremum:.4g}"
    return f"{said}; and the multiplicative noise does act on a direction that grows without bound"
