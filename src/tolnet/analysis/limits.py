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
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from tolnet.analysis import stacked
from tolnet.analysis.continuation import PathEnd, follow
from tolnet.analysis.detectability import detectability
from tolnet.analysis.divergence import gamma
from tolnet.analysis.fixed_point import Recursion, attraction, derivative, step
from tolnet.analysis.riccati import is_valid, solve_riccati
from tolnet.model import SensorNetwork, ToleranceLimits

_SMALLEST = 1e-9  # tolerance at which the walk begins
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
    """Walk up the grid with every filter at once, then shrink each bracket that was passed."""
    K = len(S)
    kalman = solve_riccati(A, Q, S)
    usable = is_valid(kalman.P, np.zeros(K), kalman.residual)
    low = {name: _Bracket(np.zeros(K), kalman.P.copy(), np.full(K, np.inf)) for name in ("fold", "attracts")}
    exists = np.where(usable, np.inf, 0.0)
    P, c = kalman.P.copy(), np.zeros(K)
    walking = np.flatnonzero(usable)
    for target in np.geomspace(_SMALLEST, largest, int(np.log10(largest / _SMALLEST) * _PER_DECADE) + 1):
        if not walking.size:
            break
        recursion = Recursion(A, Q, S[walking], np.full(len(walking), target))
        end = follow(recursion, P[walking], c[walking], smallest=_RELATIVE)
        P[walking], c[walking] = end.P, end.reached
        lost = walking[~end.found]
        exists[lost] = np.where(observable[lost], np.inf, end.reached[~end.found])
        # A path that turned back ends with the derivative's eigenvalue 1: it attracts up to there.
        for name, value in _indicators(recursion.at(end.reached), end.P).items():
            low[name].meet(walking, end, value)
        open_ = np.any([np.isinf(bracket.high[walking]) for bracket in low.values()], axis=0) | ~observable[walking]
        walking = walking[end.found & open_]
    limits = {name: _refine(A, Q, S, name, bracket) for name, bracket in low.items()}
    return limits | {"exists": exists, "published": published_bound(A, Q, S, window)}


@dataclass(eq=False)
class _Bracket:
    """Between which tolerances an indicator passes 1, and the steady state at the lower one."""

    low: Float[ndarray, " K"]
    P: Float[ndarray, "K n n"]
    high: Float[ndarray, " K"]

    def meet(self, index: ndarray, end: PathEnd, value: Float[ndarray, " K"]) -> None:
        """Move an end of the brackets of `index`: the path came to `end`, where the indicator has `value`."""
        still = np.isinf(self.high[index])
        within = still & (value < 1)
        self.low[index[within]], self.P[index[within]] = end.reached[within], end.P[within]
        passed = still & (~within | ~end.found)
        self.high[index[passed]] = end.reached[passed]


def _indicators(recursion: Recursion, P: Float[ndarray, "K n n"]) -> dict[str, Float[ndarray, " K"]]:
    """Numbers that reach 1 at each limit."""
    with np.errstate(all="ignore"):
        slope = derivative(recursion, step(recursion, P))
        return {"fold": stacked.spectral_radius(slope.loop), "attracts": attraction(slope)}


def _refine(A: ndarray, Q: ndarray, S: Float[ndarray, "K n n"], name: str, bracket: _Bracket) -> Float[ndarray, " K"]:
    """Shrink brackets of an indicator = 1 in log c: a secant where it shrinks fast, else the middle."""
    limit = np.where(np.isinf(bracket.high), np.inf, bracket.low)
    todo = np.flatnonzero(np.isfinite(bracket.high) & (bracket.low > 0) & (bracket.low < bracket.high))
    low, high, P = bracket.low[todo], bracket.high[todo], bracket.P[todo]
    f_low = _indicators(Recursion(A, Q, S[todo], low), P)[name] - 1
    f_high, halve = np.full(len(todo), np.nan), np.zeros(len(todo), dtype=bool)
    for _ in range(_REFINEMENTS):
        if not todo.size:
            break
        share = np.clip(f_low / (f_low - f_high), 0.01, 0.99)
        cut = low * (high / low) ** np.where(halve | np.isnan(share), 0.5, share)
        recursion = Recursion(A, Q, S[todo], cut)
        end = follow(recursion, P, low, smallest=_RELATIVE)
        f = np.where(end.found, _indicators(recursion, end.P)[name] - 1, 1.0)
        below, width = f < 0, np.log(high / low)
        low, f_low = np.where(below, cut, low), np.where(below, f, f_low)
        P = np.where(below[:, None, None], end.P, P)
        high, f_high = np.where(below, high, cut), np.where(below, f_high, f)
        halve = np.log(high / low) > 0.5 * width
        limit[todo] = low
        open_ = np.log(high / low) > _RELATIVE
        todo, low, high, P = todo[open_], low[open_], high[open_], P[open_]
        f_low, f_high, halve = f_low[open_], f_high[open_], halve[open_]
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
        unit = np.sqrt(np.maximum(np.diagonal(omega), np.finfo(float).tiny))  # of the states, which may differ much
        omega, J = omega / unit[:, None] / unit, J / unit
        spread = np.linalg.eigvalsh(omega)
        if usable[k] and spread[0] > 1e-13 * spread[-1]:
            largest = np.linalg.eigvalsh(stacked.symmetric_part(M + J @ np.linalg.solve(omega, J.T)))[-1]
            bound[k] = gamma(kalman.P[k], 1.0 / largest)
    return bound
