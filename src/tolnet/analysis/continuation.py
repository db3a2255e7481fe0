"""From the Kalman filter to the steady state at a tolerance: a search in theta, then a path in c.

Up to the fold, gamma rises with theta along the stabilising branch, and theta is found in a bracket. The search runs
on phi = s(gamma), where s is the theta lambda of a scalar P with that divergence: for one state and fixed P, phi is
exactly proportional to theta; in general theta / phi is close to linear in theta, and the secant on it needs a median
of one Riccati solution at c = 0.06 and of six at c = 100. Past the fold theta falls as c rises and the branch of the
doubling solver is the wrong one: there the path is followed in c, by Newton's method on P = T_c(P)
(docs/mathematics.md, section 4; docs/decisions/0002-steady-state.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from tolnet.analysis import stacked
from tolnet.analysis.divergence import gamma, inflate, scalar_excess
from tolnet.analysis.fixed_point import Recursion, newton, step
from tolnet.analysis.riccati import is_valid, solve_riccati

ACCEPT = 1e-9
"""Largest relative defect |T_c(P) - P| / |P| of a P that is passed on as a steady state."""
_NEAR = 0.05  # how close, in phi and log gamma, the search must come before Newton's method takes over
_MOST_SEARCH = 60
_NEARLY_AT_REST = 1e-4  # the same, for an orbit that is still on its way when it is left
_AT_REST = 1e-9  # relative change in one step below which an orbit has come to rest
_GONE = 1e60  # growth of the trace from which on an orbit is not followed further
_MOST_STEPS = 3000
_STRETCHES = 6  # pieces of an orbit whose growth is compared
_MOST_STRIDES = 400
_FARTHEST = 0.15  # relative change of P in one stride; with more, Newton has been seen to land on another branch
_PATH_START = 1e-7  # a tolerance so small that Newton's method gets there from the Kalman filter


class FixedPoints(NamedTuple):
    """P = T_c(P) of a stack, where `found`; the best attempt elsewhere."""

    P: Float[ndarray, "K n n"]
    found: Bool[ndarray, " K"]
    iterations: Int[ndarray, " K"]


def solve_fixed_points(recursion: Recursion) -> FixedPoints:
    """Solve P = T_c(P) for the steady state that is joined to the Kalman filter's by a path of falling c.

    Not `found` are, for tau = 0, those beyond the fold, at which theta stops rising along the path.
    Assumes no undriven mode on the unit circle and (A, S_k) detectable for every member.
    """
    kalman = solve_riccati(recursion.A, recursion.Q, recursion.S, recursion.start)
    usable = is_valid(kalman.P, np.zeros(len(kalman.P)), kalman.residual)
    iterations = kalman.doublings.copy()
    P, found = kalman.P.copy(), np.zeros(len(iterations), dtype=bool)
    start, reached = kalman.P.copy(), np.zeros(len(iterations))
    todo = np.flatnonzero(usable)
    if recursion.tau == 0:
        near = search(recursion.part(todo), kalman.P[todo])
        start[todo], reached[todo] = near.P, near.reached
        iterations[todo] += near.doublings
    polished = newton(recursion.part(todo), start[todo])
    good = polished.residual <= ACCEPT
    P[todo], found[todo[good]] = polished.P, True
    iterations[todo] += polished.steps
    rest = todo[~good]
    if rest.size and recursion.tau != 0:
        end = follow(recursion.part(rest), start[rest], reached[rest])
        P[rest[end.found]], found[rest] = end.P[end.found], end.found
        iterations[rest] += end.iterations
    return FixedPoints(P, found, iterations)


class Wanderers(NamedTuple):
    """Where filters go whose steady state is on no path from the Kalman filter: guesses, and who grows away."""

    guesses: tuple[Float[ndarray, "K n n"], ...]
    diverges: Bool[ndarray, " K"]
    steps: int


def find_wanderers(recursion: Recursion) -> Wanderers:
    """Run the recursion from the upper bracket, or from the Kalman filter where it is unbounded (section 6).

    Where the bracket exists nothing diverges. A steady state exists all the same where every mode is observable, and
    the mean and the calmest point of the orbit are near it.
    """
    P, bounded = upper_bracket(recursion)
    kalman = solve_riccati(recursion.A, recursion.Q, recursion.S, recursion.start)
    usable = is_valid(kalman.P, np.zeros(len(P)), kalman.residual) & (np.trace(kalman.P, axis1=-2, axis2=-1) > 0)
    begin = np.where(usable[:, None, None], kalman.P, np.eye(len(recursion.A)))
    orbit = wander(recursion, np.where(bounded[:, None, None], P, begin), steps=_MOST_STEPS)
    return Wanderers((orbit.centre, orbit.calmest), orbit.diverges & ~bounded, orbit.steps)


def upper_bracket(recursion: Recursion) -> tuple[Float[ndarray, "K n n"], Bool[ndarray, " K"]]:
    """P+ with P_t <= P+ in the end, from every start, and where it exists: V <= kappa_c P whatever theta is.

    P+ is the Riccati solution of (sqrt(kappa_c) A, kappa_c S, Q); it exists unless an unobservable mode has
    kappa_c |lambda|^2 >= 1. Kullback-Leibler balls.
    """
    kappa = 1 + scalar_excess(recursion.tolerance, recursion.tau)
    n, P = len(recursion.A), np.full_like(recursion.S, np.nan)
    exists = np.zeros(len(P), dtype=bool)
    for k in range(len(P)):
        A, S = np.sqrt(kappa[k]) * recursion.A, kappa[k] * recursion.S[[k]]
        solution = solve_riccati(A, recursion.Q, S, np.eye(n))
        P[k] = solution.P[0]
        loop = A @ stacked.solve(np.eye(n)[None] + P[[k]] @ S, np.eye(n)[None])[0]
        settled = is_valid(solution.P, np.zeros(1), solution.residual)[0]
        exists[k] = settled and stacked.spectral_radius(loop[None])[0] < 1
    return P, exists


def settle(recursion: Recursion, P: Float[ndarray, "K n n"]) -> FixedPoints:
    """The steady state on which the recursion comes to rest from P, where it does (`found`).

    For a filter whose steady state on the path does not attract: another, at the same tolerance, may.
    """
    orbit = wander(recursion, P)
    rested = newton(recursion, orbit.calmest)
    found = (orbit.least < _NEARLY_AT_REST) & (rested.residual <= ACCEPT)
    return FixedPoints(rested.P, found, rested.steps + orbit.steps)


class Nearby(NamedTuple):
    """Steady states at fixed theta whose gamma, `reached`, is near the tolerance, or the largest found below it."""

    P: Float[ndarray, "K n n"]
    reached: Float[ndarray, " K"]
    doublings: Int[ndarray, " K"]


def search(recursion: Recursion, kalman: Float[ndarray, "K n n"]) -> Nearby:
    """Bracketed secant on theta / phi until gamma(P(theta), theta) is near c (tau = 0).

    1.  upper end: gamma(P(theta), theta) >= gamma(P(0), theta), so theta <= the root for the Kalman filter's P
    2.  phi wanted: phi_c = s(c); phi(theta) = s(gamma(P(theta), theta)); psi(theta) = theta / phi(theta)
    3.  next theta: where the line through the last two psi meets theta / phi_c; the bracket's middle failing that
    """
    A, Q, S, c = recursion.A, recursion.Q, recursion.S, recursion.tolerance
    K, n = len(S), len(A)
    P, reached, doublings = kalman.copy(), np.zeros(K), np.zeros(K, dtype=np.int64)
    with np.errstate(all="ignore"):
        wanted = _phi(c)
        low, high = np.zeros(K), inflate(np.linalg.eigvalsh(kalman), c).theta
        before, psi_before = np.zeros(K), 1.0 / stacked.norm(kalman)
        theta = np.minimum(wanted * psi_before, high)
        todo = np.flatnonzero((c > 0) & np.isfinite(high))
        for _ in range(_MOST_SEARCH):
            if not todo.size:
                break
            at = theta[todo]
            solution = solve_riccati(A, Q, S[todo] - at[:, None, None] * np.eye(n), recursion.start)
            doublings[todo] += solution.doublings
            valid = is_valid(solution.P, at, solution.residual)
            value = np.where(valid, gamma(np.where(valid[:, None, None], solution.P, 0.0), at), np.inf)
            phi = _phi(value)
            near = valid & (np.abs(phi / wanted[todo] - 1) < _NEAR) & (np.abs(np.log(value / c[todo])) < _NEAR**0.5)
            below = valid & (value < c[todo])
            keep = near | (below & (value > reached[todo]))
            P[todo[keep]], reached[todo[keep]] = solution.P[keep], value[keep]
            low[todo] = np.where(below, np.maximum(low[todo], at), low[todo])
            high[todo] = np.where(below, high[todo], np.minimum(high[todo], at))
            psi = at / phi
            rise = (psi - psi_before[todo]) / (at - before[todo])
            secant = (psi - rise * at) / (1 / wanted[todo] - rise)
            inside = valid & (secant > low[todo]) & (secant < high[todo])
            theta[todo] = np.where(inside, secant, (low[todo] + high[todo]) / 2)
            before[todo], psi_before[todo] = np.where(valid, (at, psi), (before[todo], psi_before[todo]))
            todo = todo[~near & (high[todo] - low[todo] > 1e-6 * high[todo])]
    return Nearby(P, reached, doublings)


def _phi(value: Float[ndarray, " K"]) -> Float[ndarray, " K"]:
    """s with gamma(1, s) = value: theta lambda of a scalar; 1 where value is infinite."""
    mu = scalar_excess(np.where(np.isfinite(value), value, 1.0))
    return np.where(np.isfinite(value), mu / (1 + mu), 1.0)


class PathEnd(NamedTuple):
    """How far a path in c came: P at `reached`, and whether that is the tolerance."""

    P: Float[ndarray, "K n n"]
    reached: Float[ndarray, " K"]
    found: Bool[ndarray, " K"]
    iterations: Int[ndarray, " K"]


def follow(
    recursion: Recursion, P: Float[ndarray, "K n n"], reached: Float[ndarray, " K"], *, smallest: float = 1e-5
) -> PathEnd:
    """Follow P = T_c(P) in c from P, a steady state at about `reached`, to the tolerance, in strides of log c.

    A stride is doubled where Newton's method converges near its start and quartered where it does not; below
    the `smallest` stride, and after 400, the path is taken to have ended.
    """
    K = len(P)
    P, c = P.copy(), recursion.tolerance
    iterations = np.zeros(K, dtype=np.int64)
    reached = np.where(reached > 0, reached, np.minimum(_PATH_START, c))
    corrected = newton(recursion.at(reached), P)
    started = corrected.residual <= ACCEPT
    P[started] = corrected.P[started]
    stride = np.full(K, 1.0)
    todo = np.flatnonzero(started & (reached < c))
    for _ in range(_MOST_STRIDES):
        if not todo.size:
            break
        with np.errstate(over="ignore"):
            ahead = np.minimum(reached[todo] * np.exp(stride[todo]), c[todo])
        attempt = newton(recursion.part(todo).at(ahead), P[todo], most=12)
        iterations[todo] += attempt.steps
        # A jump to another branch shows as a P that is far from the last one.
        moved = stacked.norm(attempt.P - P[todo]) / stacked.norm(P[todo])
        good = (attempt.residual <= ACCEPT) & (moved <= _FARTHEST)
        at = todo[good]
        P[at], reached[at] = attempt.P[good], ahead[good]
        stride[todo] = np.where(good, np.minimum(stride[todo] * 2, 2.0), stride[todo] / 4)
        todo = todo[(reached[todo] < c[todo]) & (stride[todo] > smallest)]
    return PathEnd(P, reached, started & (reached >= c), iterations)


class Orbit(NamedTuple):
    """Where the recursion goes: the mean of its last half, its most nearly stationary P, and whether it grew away."""

    centre: Float[ndarray, "K n n"]
    calmest: Float[ndarray, "K n n"]
    least: Float[ndarray, " K"]
    """|T_c(P) - P| / |P| at the calmest."""
    diverges: Bool[ndarray, " K"]
    steps: int


def wander(recursion: Recursion, P: Float[ndarray, "K n n"], *, steps: int = 600) -> Orbit:
    """Run the recursion from P, until all have come to rest or gone. An orbit that circles has its mean near a state.

    `diverges` says that the trace was growing geometrically to the end: by the same factor, or nearly, in the last
    stretch as in the one before. From a tiny start many bounded orbits grow for long; their growth wanes.
    """
    first = np.trace(P, axis1=-2, axis2=-1)
    centre, calmest, least = np.zeros_like(P), P.copy(), np.full(len(P), np.inf)
    traces, t = [first], 0
    with np.errstate(all="ignore"):
        for t in range(steps):
            following = step(recursion, P).following
            defect = stacked.norm(following - P) / stacked.norm(P)
            calmer = defect < least
            calmest[calmer], least[calmer] = P[calmer], defect[calmer]
            # What has grown away stands still, so that the others can be followed.
            gone = ~(np.trace(following, axis1=-2, axis2=-1) <= _GONE * first)
            P = np.where(gone[:, None, None], P, following)
            traces.append(np.where(gone, np.inf, np.trace(P, axis1=-2, axis2=-1)))
            if t >= steps // 2:
                centre = centre + P
            if (gone | (least < _AT_REST)).all():
                break
        milestones = np.stack(traces)[np.linspace(0, t + 1, _STRETCHES + 1).astype(int)]
        growth = np.diff(np.log(milestones), axis=0)
        gone = np.isinf(traces[-1])
        doubles = growth[_STRETCHES // 2 :].sum(axis=0) > np.log(2)
        diverges = gone | (doubles & (growth[-1] > 0.5 * growth[-3]) & (growth[-3] > 0))
    middle_of_it = P if t < steps // 2 else centre / (t + 1 - steps // 2)
    return Orbit(middle_of_it, calmest, least, diverges, t + 1)
