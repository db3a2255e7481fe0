"""How large a tolerance may be: where theta folds, where the filter stops settling, where steady states end.

All three are read off one path of steady states, from the Kalman filter at c = 0 upwards:

    fold      the loop at fixed theta, K = A (V^-1 + S)^-1 P^-1, leaves the unit disc: theta stops rising with c
    attracts  the derivative of the covariance recursion leaves the unit disc
    exists    no steady state is found any more; infinite where every mode is observable, since the recursion then
              maps a compact convex set of covariances into itself (docs/mathematics.md, section 6)

`published` is the sufficient bound of the literature, from strict contraction over a block of `window` steps:

    M + J Omega^-1 J' is the covariance of the whole trajectory of `window` states given its measurements and no
    prior, and the published phi = largest theta with Omega - theta J' (I - theta M)^-1 J >= 0 is the inverse of its
    largest eigenvalue (Schur complement), in closed form; the bound is gamma(P(theta = 0), phi).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from tolnet.analysis import stacked
from tolnet.analysis.continuation import solve_fixed_points
from tolnet.analysis.detectability import detectability
from tolnet.analysis.divergence import gamma
from tolnet.analysis.fixed_point import Recursion, attraction, derivative, step
from tolnet.analysis.riccati import is_valid, solve_riccati
from tolnet.model import SensorNetwork, ToleranceLimits

_SMALLEST = 1e-9
_PER_DECADE = 2
_REFINEMENTS = 60
_RELATIVE = 1e-9
_BLOCK = 256

Progress = Callable[[int, int], None]


def tolerance_limits(
    network: SensorNetwork, *, window: int | None = None, largest: float = 1e8, progress: Progress | None = None
) -> tuple[ToleranceLimits, ToleranceLimits]:
    """The limits of the central filter (no stack) and of every node's own tolerance c_k (a stack of N), gamma scale.

    Up to `largest`; beyond, inf. The path is sampled twice a decade from 1e-9 and each change of sign refined, so
    the first crossing is reported and a limit below 1e-9 appears as 0. `window` is the block length of the published
    bound (default 2 n). Filters without detectability, and all filters of a plant that is not stabilisable, have 0
    throughout. Kullback-Leibler balls only.
    Source: docs/mathematics.md, sections 4 and 6; published bound: M. Zorzi, SIAM J. Control Optim. 55, 2017.
    """
    n = network.n
    window = 2 * n if window is None else window
    if window < n:
        raise ValueError(f"window is {window}; at least n = {n} steps are needed")
    seen = detectability(network)
    S = np.concatenate([network.total_information[None], network.information])
    solvable = seen.stabilisable & np.concatenate([[seen.centre_detectable], seen.detectable])
    observable = np.concatenate([[seen.centre_observable], seen.observable])
    values = {name: np.zeros(len(S)) for name in ("fold", "attracts", "exists", "published")}
    todo = np.flatnonzero(solvable)
    for start in range(0, len(todo), _BLOCK):
        block = todo[start : start + _BLOCK]
        part = _limits_of(network.A, network.Q, S[block], observable[block], window, largest)
        for name, value in part.items():
            values[name][block] = value
        if progress is not None:
            progress(min(start + _BLOCK, len(todo)), len(todo))
    centre, nodes = [
        ToleranceLimits(**{k: np.asarray(v[where]) for k, v in values.items()}, window=window, largest=largest)
        for where in (0, slice(1, None))
    ]
    return centre, nodes


def _limits_of(
    A: ndarray, Q: ndarray, S: Float[ndarray, "K n n"], observable: Bool[ndarray, " K"], window: int, largest: float
) -> dict[str, Float[ndarray, " K"]]:
    K = len(S)
    grid = np.geomspace(_SMALLEST, largest, int(np.log10(largest / _SMALLEST) * _PER_DECADE) + 1)
    names = ("fold", "attracts", "exists")
    low = {name: np.zeros(K) for name in names}
    high = {name: np.full(K, np.inf) for name in names}
    for c in grid:  # a limit is bracketed by the last tolerance where its value is below one and the first where not
        searching = np.flatnonzero(np.any([np.isinf(high[name]) for name in names], axis=0))
        if not searching.size:
            break
        values = _indicators(A, Q, S[searching], np.full(len(searching), c))
        for name in names:
            still = np.isinf(high[name][searching])
            within = values[name] < 1
            low[name][searching[still & within]] = c
            high[name][searching[still & ~within]] = c
    limits = {}
    for name in names:
        limits[name] = _refine(
            lambda index, c, name=name: _indicators(A, Q, S[index], c)[name], low[name], high[name]
        )
    limits["exists"] = np.where(observable, np.inf, limits["exists"])
    with np.errstate(all="ignore"):
        limits["published"] = published_bound(A, Q, S, window)
    return limits


def _indicators(
    A: ndarray, Q: ndarray, S: Float[ndarray, "K n n"], c: Float[ndarray, " K"]
) -> dict[str, Float[ndarray, " K"]]:
    """Numbers that reach 1 at each limit; 2 where there is no steady state."""
    with np.errstate(all="ignore"):
        recursion = Recursion(A, Q, S, c)
        points = solve_fixed_points(recursion)
        at = step(recursion, np.where(points.found[:, None, None], points.P, np.eye(len(A))))
        slope = derivative(recursion, at)
        found = points.found
        return {
            "fold": np.where(found, stacked.spectral_radius(slope.loop), 2.0),
            "attracts": np.where(found, attraction(slope), 2.0),
            "exists": np.where(found, 0.0, 2.0),
        }


def _refine(
    value: Callable[[ndarray, ndarray], ndarray], low: Float[ndarray, " K"], high: Float[ndarray, " K"]
) -> Float[ndarray, " K"]:
    """Shrink brackets of `value` = 1 in log c: the secant where it falls inside and shrinks fast, else the middle."""
    limit = np.where(np.isinf(high), np.inf, low)
    todo = np.flatnonzero(np.isfinite(high) & (low > 0))
    lo, hi = np.log(low[todo]), np.log(high[todo])
    f_lo, f_hi = value(todo, low[todo]) - 1, value(todo, high[todo]) - 1
    middle_next = np.zeros(len(todo), dtype=bool)
    for _ in range(_REFINEMENTS):
        open_ = hi - lo > _RELATIVE
        if not open_.any():
            break
        width = hi - lo
        cut = lo + width * np.where(middle_next, 0.5, np.clip(f_lo / (f_lo - f_hi), 0.01, 0.99))
        f = np.zeros(len(todo))
        f[open_] = value(todo[open_], np.exp(cut[open_])) - 1
        below = open_ & (f < 0)
        above = open_ & ~below
        lo, f_lo = np.where(below, cut, lo), np.where(below, f, f_lo)
        hi, f_hi = np.where(above, cut, hi), np.where(above, f, f_hi)
        middle_next = hi - lo > 0.5 * width
    limit[todo] = np.exp(lo)
    return limit


def published_bound(
    A: Float[ndarray, "n n"], Q: Float[ndarray, "n n"], S: Float[ndarray, "K n n"], window: int
) -> Float[ndarray, " K"]:
    """The largest tolerance for which the robust recursion is known to contract over blocks of `window` steps.

    With S_k = Y'Y, the noise of the whole trajectory stacked as x = O_R x_0 + L w and its measurements as
    y = O x_0 + H w + v, v ~ N(0, I): phi = 1 / lambda_max(cov(x | y, no prior on x_0)) and c = gamma(P_0, phi),
    inf where phi >= 1 / lambda_max(P_0), P_0 the Kalman filter's steady state; 0 where x_0 cannot be recovered.
    Source: M. Zorzi, SIAM J. Control Optim. 55, 2017; docs/mathematics.md, section 6.
    """
    K, n = len(S), len(A)
    kalman = solve_riccati(A, Q, S)
    usable = is_valid(kalman.P, np.zeros(K), kalman.residual)
    powers = [np.eye(n)]
    for _ in range(window):
        powers.append(A @ powers[-1])
    values, U = np.linalg.eigh(Q)
    B = U * np.sqrt(np.maximum(values, 0.0))
    # Latest state first, as published: row i is the state at time window - 1 - i, column j the noise just before it.
    O_R = np.concatenate(powers[window - 1 :: -1])
    zero = np.zeros((n, n))
    L = np.block([[powers[j - i - 1] @ B if j > i else zero for j in range(window)] for i in range(window)])
    weights, E = np.linalg.eigh(S)
    Y = np.sqrt(np.maximum(weights, 0.0))[:, :, None] * E.mT
    bound = np.zeros(K)
    for k in range(K):  # the matrices are window n square: large, and few
        O = np.concatenate(list(Y[k] @ O_R.reshape(window, n, n)))
        H = (Y[k] @ L.reshape(window, n, window * n)).reshape(window * n, window * n)
        R = np.eye(window * n) + H @ H.T
        R_O = np.linalg.solve(R, np.concatenate([O, H @ L.T], axis=1))
        omega = O.T @ R_O[:, :n]
        J = O_R - L @ H.T @ R_O[:, :n]
        M = L @ L.T - L @ H.T @ R_O[:, n:]
        spread = np.linalg.eigvalsh(omega)
        if usable[k] and spread[0] > 1e-13 * spread[-1]:
            largest = np.linalg.eigvalsh(stacked.symmetric_part(M + J @ np.linalg.solve(omega, J.T)))[-1]
            bound[k] = gamma(kalman.P[k], 1.0 / largest)
    return bound
