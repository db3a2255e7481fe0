"""At most d neighbours in use: links are given up a few at a time, the rest searched again, and swaps are tried."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from tolnet.design.weights.admissible import Admissible
from tolnet.design.weights.msd import MsdObjective
from tolnet.design.weights.quasi_newton import minimise
from tolnet.design.weights.search import Search, Watch, search_msd
from tolnet.model import Start

_SWAPS = 8
"""Rounds in which every node may exchange one neighbour."""
_KEPT = 1e-12


def search_sparse(
    objective: MsdObjective,
    among: Admissible,
    starts: Mapping[str, Float[ndarray, " L"]],
    d: int,
    *,
    most: int,
    tolerance: float,
    watch: Watch,
) -> Search:
    """Minimise the criterion with at most d weights that are not zero in each column, w_kk among them.

    1. all links; 2. one link less a round for every node that uses too many, the one whose loss costs least to second
    order, and a search from there; 3. swaps of a used link for the unused one with the steepest descent, while they
    gain. A start is kept to its d largest weights. Local: the choice of links is combinatorial. Ctrl-C ends
    the search with the best so far, once there is one.
    """
    kept = {name: _largest(among, w, d) for name, w in starts.items()}
    found = Search()
    try:
        for name, w in kept.items():
            value = objective.exact(w)
            found.starts.append(Start(name, value, float("nan")))
            found.offer(name, w, value)
        if not most:
            return found
        full = search_msd(objective, among, starts, most=most, tolerance=1e-5, watch=watch)
        found.evaluations += full.evaluations
        if full.interrupted:
            raise KeyboardInterrupt
        if full.z is not None:
            begin = {"pruned": _prune(objective, among, full.z, d, watch, found)}
            begin |= {found.best_start: kept[found.best_start]} if found.best_start in kept else {}
            for name, w in begin.items():
                _polish(objective, among, w, d, name, tolerance, watch, found)
    except KeyboardInterrupt:
        if found.z is None:
            raise
        found.interrupted = True
    return found


def _largest(among: Admissible, w: Float[ndarray, " L"], d: int) -> Float[ndarray, " L"]:
    """w on its d largest weights a column; w_kk is one of them where it has a lower bound."""
    return among.narrowed(_support(among, among.project(w), d)).project(w)


def _support(among: Admissible, w: Float[ndarray, " L"], d: int) -> Bool[ndarray, " L"]:
    columns = among.columns
    rank = w.copy()
    rank[columns.own[among.lower > 0]] = np.inf
    order = np.argsort(np.argsort(-columns.spread(rank, -np.inf), axis=1, kind="stable"), axis=1)
    return columns.gather(order.astype(float)) < d


def _prune(
    objective: MsdObjective, among: Admissible, w: Float[ndarray, " L"], d: int, watch: Watch, found: Search
) -> Float[ndarray, " L"]:
    """One link less a round for every node that uses more than d."""
    columns = among.columns
    used = w > _KEPT
    while True:
        count = columns.sums(used.astype(float))
        crowded = count > d
        if not crowded.any():
            return w
        _, at = objective.value(w)
        _, B = objective.gradient(at)
        cost = columns.gather(np.einsum("kii->ki", B.weights)) * w**2 / 2  # what w_lk -> 0 costs, to second order
        cost[~used] = np.inf
        cost[columns.own[among.lower > 0]] = np.inf
        worst = columns.offsets[:-1] + np.argmin(columns.spread(cost, np.inf), axis=1)
        used[worst[crowded]] = False
        narrow = among.narrowed(used)
        end = minimise(objective, narrow.project(w), narrow.project, tolerance=1e-4, steps=10, centre=narrow.centred)
        found.evaluations += end.evaluations
        w = end.z
        watch(f"at most {int(columns.sums(used.astype(float)).max())} neighbours", end.value)


def _polish(
    objective: MsdObjective,
    among: Admissible,
    w: Float[ndarray, " L"],
    d: int,
    name: str,
    tolerance: float,
    watch: Watch,
    found: Search,
) -> None:
    """Search on the links in use, then exchange links while that gains."""
    columns = among.columns
    used = _support(among, w, d)
    best = np.inf
    for _ in range(_SWAPS):
        narrow = among.narrowed(used)
        value = np.inf
        for stage in objective.stages:
            end = minimise(stage, narrow.project(w), narrow.project, tolerance=tolerance, centre=narrow.centred)
            found.evaluations += end.evaluations
            w, value = end.z, objective.exact(end.z)
        found.offer(name, w, value)
        found.history.append(found.value)
        watch(f"at most {d} neighbours, from {name}", found.value)
        found.converged = True
        if not value < best * (1 - 10 * tolerance):
            return
        best = value
        _, at = objective.stages[-1].value(w)
        g, _ = objective.stages[-1].gradient(at)
        level = columns.sums(g * w)  # the multiplier: every weight in use has this derivative
        promise = np.where(used, np.inf, g - level[columns.hearer])
        entering = columns.offsets[:-1] + np.argmin(columns.spread(promise, np.inf), axis=1)
        leaving_rank = np.where(used, w, np.inf)
        leaving_rank[columns.own[among.lower > 0]] = np.inf
        leaving = columns.offsets[:-1] + np.argmin(columns.spread(leaving_rank, np.inf), axis=1)
        gains = np.isfinite(promise[entering]) & (promise[entering] < 0) & np.isfinite(leaving_rank[leaving])
        if not gains.any():
            return
        used = used.copy()
        used[leaving[gains]] = False
        used[entering[gains]] = True
