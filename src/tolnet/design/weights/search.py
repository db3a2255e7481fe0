"""One search from many starts: the best point that any of them led to, also where somebody interrupts it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.design.weights.admissible import Admissible
from tolnet.design.weights.msd import MsdObjective
from tolnet.design.weights.quasi_newton import Minimum, minimise
from tolnet.model import Start

Watch = Callable[[str, float], None]
"""(what is going on, the best value so far)."""

_BLENDS = (0.25, 0.5, 0.75, 0.9, 1.0)
SENT = (1e-2, 1e-3)
"""How much the errors of what is sent count while gains are searched for, ever less; the last is what remains."""
RANDOM = "random"
"""How the names of random starts begin."""
_RANDOM_WITH_GAINS, _SPREAD = 8, 1.5
"""With gains there are many valleys: so many random weights, w_lk in proportion to exp(1.5 z), z standard normal."""
_STEPS_WITH_GAINS = 300


@dataclass
class Search:
    """What has been found so far."""

    z: Float[ndarray, " z"] | None = None
    value: float = np.inf
    best_start: str = ""
    starts: list[Start] = field(default_factory=list)
    history: list[float] = field(default_factory=list)
    evaluations: int = 0
    converged: bool = False
    interrupted: bool = False

    def offer(self, name: str, z: Float[ndarray, " z"], value: float) -> None:
        """Keep z where it is better than the best."""
        if value < self.value:
            self.z, self.value, self.best_start = z.copy(), value, name


def search_msd(
    objective: MsdObjective,
    among: Admissible,
    starts: Mapping[str, Float[ndarray, " L"]],
    *,
    most: int,
    tolerance: float,
    watch: Watch,
) -> Search:
    """Minimise the criterion from the `most` best of the starts; with gains too from the best weights found, from the
    two best starts as they are, and from random ones, these without a larger weight on what is sent before.

    A start with infinite MSD is blended with W = I until it is stable, which W = I always is where the filters are.
    KeyboardInterrupt ends the search with the best so far, once there is one.
    """
    found = Search()
    try:
        _search(objective, among, starts, most, tolerance, watch, found)
    except KeyboardInterrupt:
        if found.z is None:
            raise
        found.interrupted = True
    return found


def _search(
    objective: MsdObjective,
    among: Admissible,
    starts: Mapping[str, Float[ndarray, " L"]],
    most: int,
    tolerance: float,
    watch: Watch,
    found: Search,
) -> None:
    weights_only = replace(objective, gains=False, sent=0.0)
    ranked = []
    for name, w in starts.items():
        w = among.project(w)
        value = weights_only.exact(w)
        found.evaluations += 1
        found.offer(name, w, value)
        found.starts.append(Start(name, value, float("nan")))
        usable, at = _stabilised(weights_only, among, w, value)
        if np.isfinite(at):
            ranked.append((at, name, usable))
    ranked.sort(key=lambda each: each[0])
    ends = []
    for number, (_, name, w) in enumerate(ranked[:most]):
        label = f"from {name} ({number + 1} of {min(most, len(ranked))})"
        end = _descend(weights_only.stages, among, w, name, label, tolerance, watch, found)
        ends.append((end.value, name, end.z))
        _note(found, name, weights_only.exact(end.z))
    if not objective.gains or not ends:
        return
    ends.sort(key=lambda each: each[0])
    gains = objective.scenarios[0].gains
    stages = [replace(stage, gains=True, sent=sent) for stage in objective.stages[:1] for sent in SENT]
    stages += [replace(stage, gains=True, sent=SENT[-1]) for stage in objective.stages[1:]]
    others = [each for each in ranked[1:] if not each[1].startswith(RANDOM)][:1]
    begin = [(name, w, stages) for _, name, w in [*ends[:1], *ranked[:1], *others]]
    begin += [(f"{RANDOM}-spread-{i + 1}", w, stages[1:]) for i, w in enumerate(_spread(weights_only, among))]
    for number, (name, w, through) in enumerate(begin):
        label = f"gains too, from {name} ({number + 1} of {len(begin)})"
        z = np.concatenate([w, gains])
        _descend(through, among, z, name, label, tolerance, watch, found)


def _spread(objective: MsdObjective, among: Admissible) -> Iterator[Float[ndarray, " L"]]:
    """Random weights further apart than the random starts are, as far as W = I makes them stable."""
    generator = np.random.default_rng(0)
    for _ in range(_RANDOM_WITH_GAINS):
        w = np.exp(_SPREAD * generator.normal(size=len(among.columns.sender)))
        w = among.project(w / among.columns.sums(w)[among.columns.hearer])
        usable, at = _stabilised(objective, among, w, objective.exact(w))
        if np.isfinite(at):
            yield usable


def _descend(
    stages: Sequence[MsdObjective],
    among: Admissible,
    z: Float[ndarray, " z"],
    name: str,
    label: str,
    tolerance: float,
    watch: Watch,
    found: Search,
) -> Minimum:
    """Through all stages, offering what each step finds; a smoothed value stands for the criterion on the way."""
    end = Minimum(z, np.inf, 0, False)
    for stage in stages:

        def step(z: Float[ndarray, " z"], value: float, stage: MsdObjective = stage) -> None:
            exact = value if stage.plain else stage.exact(z)
            found.offer(name, z, exact)
            found.history.append(found.value)
            watch(label, found.value)

        steps = _STEPS_WITH_GAINS if stage.gains else 200
        end = minimise(
            stage, end.z, among.project, tolerance=tolerance, steps=steps, centre=among.centred, watch=step
        )
        found.evaluations += end.evaluations
    if found.best_start == name:
        found.converged = end.converged
    return end


def _stabilised(
    objective: MsdObjective, among: Admissible, w: Float[ndarray, " L"], value: float
) -> tuple[Float[ndarray, " L"], float]:
    """w itself where its MSD is finite, or the first blend with W = I whose MSD is."""
    if np.isfinite(value):
        return w, value
    alone = np.zeros_like(w)
    alone[among.columns.own] = 1.0
    for blend in _BLENDS:
        mixed = among.project((1 - blend) * w + blend * alone)
        value = objective.exact(mixed)
        if np.isfinite(value):
            return mixed, value
    return w, np.inf


def _note(found: Search, name: str, value: float) -> None:
    found.starts = [replace(start, found=value) if start.name == name else start for start in found.starts]
