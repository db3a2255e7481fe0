"""Monte Carlo over corrupted channels: any filters on the same runs, all nodes and many runs at a time.

Runs are drawn in batches of fixed size, each from its own child of the seed, and added up in order: the result does
not depend on the number of workers, nor on which filters run. Within a batch all filters walk abreast, so that
nothing of the size of a trajectory is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.analysis.channel_filters import ChannelFilter, Drkf, DrkfSwf, Moment, moments
from tolnet.analysis.comparison_filters import Ckf, CkfTau, Crkf, Csgf, CsgfTau, DseaCp
from tolnet.analysis.corrupted_truth import Truth, walk_corrupted
from tolnet.analysis.stacked import definite, inverse
from tolnet.model import CorruptedNetwork, UnsupportedError
from tolnet.model.corrupted_simulation import CorruptedSimulation

BATCH, MOST_NUMBERS = 250, 500_000
"""Runs drawn from one child of the seed; fewer where one matrix a pair and run were more numbers than that."""
CHANNEL_FILTERS: dict[str, type[ChannelFilter]] = {
    kind.name: kind for kind in (Drkf, DrkfSwf, Ckf, CkfTau, Crkf, Csgf, CsgfTau, DseaCp)
}
"""The filters by name."""
_ABSURD = 1e12
"""A squared error this many times the bound of the squared state is no estimate of it."""
_LARGEST = 1e300

Progress = Callable[[int, int], None]


def simulate_corrupted(
    network: CorruptedNetwork,
    *,
    runs: int,
    steps: int,
    seed: int = 0,
    filters: Iterable[str] | None = None,
    shared_path: bool = False,
    window: int | Int[ndarray, " N"] | None = None,
    interval: int | Int[ndarray, " N"] | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> dict[str, CorruptedSimulation]:
    """Run filters on `runs` simulated runs of the network, and judge them at instants 0, 1, ..., `steps`.

    Every filter sees the same state, measurements and channel noise, which are as large as the network's bounds and
    network.simulation allow (`walk_corrupted`). `filters` names some of CHANNEL_FILTERS, all without; DRKF-SWF takes
    its window and intervals (one for all, or one a node) from the network unless they are given. With `shared_path`
    all runs meet one path of noise on matrices, and P of DRKF and DRKF-SWF bounds their covariances given that path
    (Definition 2.2); else every run has a path of its own, and the mean of P bounds the mean square error.
    `progress(done, total)` counts runs.
    Raises UnsupportedError for an unknown filter, ValueError for fewer than 2 runs or 1 step, a window below 1 or an
    interval below 0 (never), InputError where network.simulation contradicts the bounds.
    Source: eqs. (1)-(4), (13)-(18); docs/mathematics.md, sections 13.7 and 13.8.
    """
    if runs < 2 or steps < 1:
        raise ValueError(f"runs is {runs} and steps is {steps}; at least 2 runs of 1 step were expected")
    names = channel_filters(filters)
    batch = int(np.clip(MOST_NUMBERS // (len(network.pairs) * network.n**2), 2, BATCH))
    path, *children = np.random.SeedSequence(seed).spawn(1 + -(-runs // batch))
    sizes = [min(batch, runs - start) for start in range(0, runs, batch)]
    job = _Job(network, names, steps, path if shared_path else None, window, interval)
    sums: list[_Sums] | None = None
    done = 0
    for size, found in zip(sizes, _map(job, sizes, children, workers), strict=True):
        sums = found if sums is None else [total.plus(more) for total, more in zip(sums, found, strict=True)]
        done += size
        if progress is not None:
            progress(done, runs)
    assert sums is not None
    beyond = tuple(Truth(network).beyond_bounds())
    return {
        name: total.summary(CHANNEL_FILTERS[name], beyond, shared_path, runs, steps, seed)
        for name, total in zip(names, sums, strict=True)
    }


def channel_filters(names: Iterable[str] | None) -> list[str]:
    """The names in their order; all without any. Raises UnsupportedError for one that is unknown."""
    if names is None:
        return list(CHANNEL_FILTERS)
    wanted = list(names)
    strangers = [name for name in wanted if name not in CHANNEL_FILTERS]
    if strangers:
        raise UnsupportedError(f"there is no filter {strangers[0]!r}; the filters are {', '.join(CHANNEL_FILTERS)}")
    return [name for name in CHANNEL_FILTERS if name in wanted]


@dataclass
class _Sums:
    """What is added up over batches, for one filter; runs that diverged are counted and left out."""

    errors: Float[ndarray, "T1 K n n"]
    P: Float[ndarray, "T1 K n n"]
    inside: Float[ndarray, "T1 K"]
    distance: Float[ndarray, "T1 K"]
    squared_distance: Float[ndarray, "T1 K"]
    means: Float[ndarray, " T1"]
    squared_means: Float[ndarray, " T1"]
    alive: Float[ndarray, " T1"]
    """Runs that P was added up over: those that had not diverged by then."""
    growth: float
    """Of log error, from one fifth of the second half of a run to the last."""
    squared_growth: float
    runs: int
    diverged: int
    solves: int
    fallbacks: int

    def plus(self, other: _Sums) -> _Sums:
        return _Sums(*(mine + its for mine, its in zip(vars(self).values(), vars(other).values(), strict=True)))

    def summary(
        self,
        kind: type[ChannelFilter],
        beyond: tuple[str, ...],
        shared: bool,
        runs: int,
        steps: int,
        seed: int,
    ) -> CorruptedSimulation:
        """Means over the runs that are left; NaN where none is."""
        n = self.runs if self.runs else np.nan
        variance = np.maximum(self.squared_means / n - (self.means / n) ** 2, 0.0)
        return CorruptedSimulation(
            name=kind.name,
            meaning=kind.meaning,
            centralised=kind.centralised,
            node_error=self.errors / n,
            node_P=self.P / np.where(self.alive > 0, self.alive, np.nan)[:, None, None, None],
            node_consistency=self.inside / n,
            node_nees=self.distance / n / self.errors.shape[-1],
            node_spread=np.sqrt(self.squared_distance / n / n),
            standard_error=np.sqrt(variance / max(self.runs - 1, 1)),
            growth=self._growth(steps),
            diverged=self.diverged,
            solves=self.solves,
            fallbacks=self.fallbacks,
            beyond_bounds=beyond,
            shared=shared,
            runs=runs,
            steps=steps,
            seed=seed,
        )

    def _growth(self, steps: int) -> float:
        """A factor a step; 1 where the mean is not above 0 by three standard errors, or the runs are short."""
        first, last = _fifths(steps)
        if self.runs < 2 or not last.stop - last.start:
            return 1.0
        mean = self.growth / self.runs
        error = np.sqrt(max(self.squared_growth / self.runs - mean**2, 0.0) / (self.runs - 1))
        return float(np.exp(mean / (last.start - first.start))) if mean > 3 * error else 1.0


def _fifths(steps: int) -> tuple[slice, slice]:
    """The instants of the first and the last fifth of the second half of a run; none where it is short."""
    half, length = (steps + 1) // 2, (steps + 1) // 10
    length = length if length >= 2 else 0
    return slice(half, half + length), slice(steps + 1 - length, steps + 1)


@dataclass(frozen=True)
class _Job:
    """What every batch does."""

    network: CorruptedNetwork
    names: list[str]
    steps: int
    path: np.random.SeedSequence | None
    """Of the one path of noise on matrices, where it is shared."""
    window: int | Int[ndarray, " N"] | None
    interval: int | Int[ndarray, " N"] | None

    def __call__(self, size: int, child: np.random.SeedSequence) -> list[_Sums]:
        """Walk `size` runs with all filters abreast."""
        own, paths = child.spawn(2)
        walk = walk_corrupted(
            self.network,
            np.random.default_rng(own),
            np.random.default_rng(paths if self.path is None else self.path),
            runs=size,
            steps=self.steps,
            shared=self.path is not None,
        )
        running = [self._filter(name, size) for name in self.names]
        records = [_Record(each, size, self.steps) for each in running]
        with np.errstate(all="ignore"):  # a filter that diverges is told of in words
            ahead: list[Moment | None] = [None, *moments(self.network, self.steps)]
            for moment, drawn in zip(ahead, walk, strict=True):
                Pi = self.network.initial_second_moment if moment is None else moment.Pi
                for each, record in zip(running, records, strict=True):
                    if moment is not None:
                        each.step(moment, drawn)
                    record.note(drawn.k, drawn.x, min(_ABSURD * float(np.trace(Pi)), _LARGEST))
            return [record.sums() for record in records]

    def _filter(self, name: str, runs: int) -> ChannelFilter:
        if name == DrkfSwf.name:
            return DrkfSwf(self.network, runs, self.window, self.interval)
        return CHANNEL_FILTERS[name](self.network, runs)


class _Record:
    """The errors of one filter in one batch."""

    def __init__(self, filter: ChannelFilter, runs: int, steps: int) -> None:
        self.filter, (_, K, n) = filter, filter.x.shape
        self.chi_square = _chi_square(n)
        self.good = np.ones(runs, dtype=bool)
        self.e = np.empty((steps + 1, runs, K, n))
        self.distance = np.full((steps + 1, runs, K), np.nan)
        self.P, self.alive = np.full((steps + 1, K, n, n), np.nan), np.zeros(steps + 1)

    def note(self, k: int, x: Float[ndarray, "runs n"], absurd: float) -> None:
        """The errors at instant k, and what the filter thinks of them; a run beyond `absurd` has diverged."""
        self.e[k] = self.filter.x - x[:, None]
        self.good &= ((self.e[k] ** 2).sum(axis=2) < absurd).all(axis=1)
        self.alive[k] = self.good.sum()
        P = self.filter.P
        if P is None:
            return
        every = len(P) == len(self.good)
        self.P[k] = P[self.good].sum(axis=0) if every else P[0] * self.alive[k]
        flat = P.reshape(-1, *P.shape[2:])
        metric, positive = inverse(flat).reshape(P.shape), definite(flat).reshape(P.shape[:2])
        e = self.e[k]
        distance = ((metric @ e[..., None])[..., 0] * e).sum(axis=-1)
        self.distance[k] = np.where(positive, distance, np.inf)  # else there is no ellipsoid, and nothing in it

    def sums(self) -> _Sums:
        """Add up the runs that stayed within reason."""
        e, distance = self.e[:, self.good], self.distance[:, self.good]
        each = (e**2).sum(axis=3).mean(axis=2)
        first, last = _fifths(len(e) - 1)
        growth = np.log(each[last]).mean(axis=0) - np.log(each[first]).mean(axis=0) if last.stop > last.start else 0.0
        sliding = self.filter.sliding if isinstance(self.filter, DrkfSwf) else None
        inside = np.where(np.isnan(distance), np.nan, distance <= self.chi_square)
        return _Sums(
            errors=np.einsum("trki,trkj->tkij", e, e, optimize=True),
            P=self.P,
            inside=inside.sum(axis=1),
            distance=distance.sum(axis=1),
            squared_distance=(distance**2).sum(axis=1),
            means=each.sum(axis=1),
            squared_means=(each**2).sum(axis=1),
            alive=self.alive,
            growth=float(np.sum(growth)),
            squared_growth=float(np.sum(np.square(growth))),
            runs=int(self.good.sum()),
            diverged=int((~self.good).sum()),
            solves=0 if sliding is None else sliding.solves,
            fallbacks=0 if sliding is None else sliding.fallbacks,
        )


def _map(job: _Job, sizes: list[int], children: list[np.random.SeedSequence], workers: int) -> Iterator[list[_Sums]]:
    """Batch after batch, in order, on as many processes as asked for."""
    if workers == 1 or len(sizes) == 1:
        return (job(size, child) for size, child in zip(sizes, children, strict=True))
    import joblib

    parallel: Any = joblib.Parallel(n_jobs=workers, return_as="generator")
    return parallel(joblib.delayed(job)(size, child) for size, child in zip(sizes, children, strict=True))


def _chi_square(n: int) -> float:
    """The 95 % point of the chi-square law with n degrees of freedom."""
    from scipy.special import chdtri

    return float(chdtri(n, 0.05))
