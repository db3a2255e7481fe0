"""The best decay rate near given weights: down the slope of the spectral radius of T_W.

    w_lk = m_k [l = k] + (1 - m_k) exp(z_lk) / sum_j exp(z_jk),    min over z of rho(T_W)

in which every z is admissible; what falls is the rate, the root of rho. It is smooth where its eigenvalue is simple,
and has kinks where parts of the network that hardly hear each other decay alike, where minima like to lie: so
BFGS with a line search for the weak Wolfe conditions, whose matrix learns the kinks (A. S. Lewis, M. L. Overton,
Mathematical Programming 141, 2013).
Source: docs/mathematics.md, section 12.3; docs/decisions/0025-decay-search.md.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.design.weights.admissible import Admissible
from tolnet.design.weights.second_moments import SecondMoments

_LEAST_WEIGHT = 1e-4
"""What the search begins with where a weight is smaller: from zero there is no way back."""
_PARTS = (1.0, 0.5)
_WORTHWHILE = 1e-6
"""Relative decrease for which a column is exchanged."""
_STEPS = 200
_TRIALS = 30
_ENOUGH, _STEEP = 1e-4, 0.9
"""Of the Wolfe conditions."""
_SETTLED = 1e-7
"""Relative decrease in a step at which the search ends."""
_DUST = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
"""Weights below which all are left out, if the radius stays what it is."""


class Polished(NamedTuple):
    """Where the search ended."""

    w: Float[ndarray, " L"]
    radius: float
    evaluations: int


def exchange(
    moments: SecondMoments,
    among: Admissible,
    w: Float[ndarray, " L"],
    watch: Callable[[float], None] = lambda radius: None,
) -> Polished:
    """Node by node another column: all that is free, or half of it, to one neighbour, as long as such a step helps.

    Minima of rho often lie where a node listens to few others, and no slope leads from one such place to the next.
    """
    columns, evaluations = among.columns, 0
    radius = moments.radius(w)
    least = np.zeros_like(w)
    least[columns.own] = among.lower
    while True:
        best, after = w, radius
        for i, k in enumerate(columns.hearer.tolist()):
            here = slice(columns.offsets[k], columns.offsets[k + 1])
            for part in _PARTS:
                trial = w.copy()
                trial[here] = (1 - part) * w[here] + part * least[here]
                trial[i] += part * (1 - among.lower[k])
                tried = moments.radius(trial)
                evaluations += 1
                if tried < after:
                    best, after = trial, tried
        if after > (1 - _WORTHWHILE) * radius:
            return Polished(w, radius, evaluations)
        w, radius = best, after
        watch(radius)


class _Point(NamedTuple):
    z: Float[ndarray, " L"]
    w: Float[ndarray, " L"]
    rate: float
    slope: Float[ndarray, " L"]
    """Of the rate, in z."""


def polish(
    moments: SecondMoments,
    among: Admissible,
    w: Float[ndarray, " L"],
    watch: Callable[[float], None] = lambda radius: None,
) -> Polished:
    """Weights near `w` with a smaller spectral radius of T_W; `w` itself where none is found.

    A local minimum: another start may lead to a better one. Shape (L,), link by link as `among.columns` has them.
    """
    columns, room = among.columns, 1 - among.lower

    def at(z: Float[ndarray, " L"]) -> _Point | None:
        rows = np.exp(z - columns.spread(z, -np.inf).max(axis=1)[columns.hearer])
        share = rows / columns.sums(rows)[columns.hearer]
        weights = share * room[columns.hearer]
        weights[columns.own] += among.lower
        found = moments.perron(weights)
        if found is None:
            return None
        rate = float(np.sqrt(found.radius))
        g = moments.slope(found) * room[columns.hearer] / (2 * rate)
        slope = share * (g - columns.sums(share * g)[columns.hearer])
        return _Point(z, weights, rate, slope)

    own = np.zeros_like(w)
    own[columns.own] = among.lower
    free = np.maximum((w - own) / np.maximum(room, np.finfo(float).tiny)[columns.hearer], _LEAST_WEIGHT)
    before, begin = moments.radius(w), at(np.log(free))
    if begin is None:
        return Polished(w, before, 1)
    end, evaluations = _descend(at, begin, watch)
    found, radius = _without_dust(moments, among, end.w)
    return Polished(found, radius, evaluations) if radius < before else Polished(w, before, evaluations)


def _descend(
    at: Callable[[ndarray], _Point | None], here: _Point, watch: Callable[[float], None]
) -> tuple[_Point, int]:
    """BFGS from a point, until a step lowers the rate by next to nothing."""
    H, evaluations = np.eye(len(here.z)), 1
    for step in range(_STEPS):
        direction = -H @ here.slope
        if not here.slope @ direction < 0:
            break
        reached, tried = _weak_wolfe(at, here, direction)
        evaluations += tried
        if reached is None:
            break
        s, y = reached.z - here.z, reached.slope - here.slope
        along = float(s @ y)
        if along > np.finfo(float).eps * np.linalg.norm(s) * np.linalg.norm(y):
            H = _updated(H * (along / float(y @ y)) if step == 0 else H, s, y, along)
        settled = here.rate - reached.rate < _SETTLED * here.rate
        here = reached
        watch(here.rate**2)
        if settled:
            break
    return here, evaluations


def _weak_wolfe(
    at: Callable[[ndarray], _Point | None], here: _Point, direction: Float[ndarray, " L"]
) -> tuple[_Point | None, int]:
    """By doubling and bisection: a point that falls enough, less steep there; the lowest where none is found."""
    falling = float(here.slope @ direction)
    low, high, length = 0.0, np.inf, 1.0
    best: _Point | None = None
    for trial in range(1, _TRIALS + 1):
        there = at(here.z + length * direction)
        if there is not None and there.rate < (here if best is None else best).rate:
            best = there
        if there is None or there.rate > here.rate + _ENOUGH * length * falling:
            high = length
        elif there.slope @ direction < _STEEP * falling:
            low = length
        else:
            return there, trial
        length = 2 * length if np.isinf(high) else (low + high) / 2
    return best, _TRIALS


def _updated(
    H: Float[ndarray, "L L"], s: Float[ndarray, " L"], y: Float[ndarray, " L"], along: float
) -> Float[ndarray, "L L"]:
    """BFGS, for the inverse of the second derivative."""
    Hy = H @ y
    return H + (1 + y @ Hy / along) * np.outer(s, s) / along - (np.outer(Hy, s) + np.outer(s, Hy)) / along


def _without_dust(
    moments: SecondMoments, among: Admissible, w: Float[ndarray, " L"]
) -> tuple[Float[ndarray, " L"], float]:
    """The same without the small weights, which exp never takes to zero, as far as that costs nothing."""
    columns, radius = among.columns, moments.radius(w)
    for dust in _DUST:
        swept = np.where(w < dust, 0.0, w)
        swept[columns.own] = np.maximum(swept[columns.own], among.lower)
        swept = among.project(swept / columns.sums(swept)[columns.hearer])
        left = moments.radius(swept)
        if left <= radius * (1 + _SETTLED):
            return swept, left
    return w, radius
