"""Which links to add: ranked by the MSD that the network has with each, its weights optimised anew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis import least_favourable_model
from tolnet.analysis.msd_gradient import NetworkErrors
from tolnet.design.tolerances import choose_tolerances
from tolnet.design.weights.admissible import Admissible, Constraints
from tolnet.design.weights.msd import Criterion, MsdObjective
from tolnet.design.weights.quasi_newton import minimise
from tolnet.model import Ambiguity, InputError, SensorNetwork

_FINALISTS = 10
"""Candidates whose weights are optimised to the end; the others are judged after a few steps."""
_GLANCE = 3
_RUNNERS_UP = 3
_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class AddedLink:
    """A link that was added, after those before it."""

    link: tuple[int, int]
    msd: float
    """Of the network with it, weights optimised."""
    runners_up: tuple[tuple[tuple[int, int], float], ...]
    """The next best links in its place."""
    interrupted: bool = False


def add_links(
    network: SensorNetwork,
    ambiguity: Ambiguity,
    weights: Float[ndarray, "N N"],
    m: int,
    *,
    watch: Callable[[str, float], None] = lambda what, value: None,
) -> list[AddedLink]:
    """m links that the network lacks, one after the other, each the one that makes the optimised mean MSD least.

    A new link changes what its two ends measure, hence their filters, and where estimates go. Every candidate is
    judged from `weights`, the best W so far, after a few steps of the search; the ten best are searched to the end.
    Greedy: the best m links together may be others. KeyboardInterrupt ends with the links that were found.
    Raises InputError where m is below 1 or more than the links that are lacking.
    """
    lacking = _lacking(network)
    if not 1 <= m <= len(lacking):
        raise InputError(f"{m} links are to be added, and the graph lacks {len(lacking)}")
    added: list[AddedLink] = []
    W = np.asarray(weights)
    try:
        for number in range(m):
            best, W, network = _best_link(network, ambiguity, W, number, m, watch)
            added.append(best)
    except KeyboardInterrupt:
        if not added:
            raise
        added[-1] = AddedLink(added[-1].link, added[-1].msd, added[-1].runners_up, interrupted=True)
    return added


def _lacking(network: SensorNetwork) -> list[tuple[int, int]]:
    """The links that are not there: [from, to], or pairs where links work both ways."""
    there = network.adjacency.toarray()
    l, k = np.nonzero(~there)
    wanted = l != k if network.directed else l < k
    return list(zip(l[wanted].tolist(), k[wanted].tolist(), strict=True))


def _best_link(
    network: SensorNetwork,
    ambiguity: Ambiguity,
    W: Float[ndarray, "N N"],
    number: int,
    m: int,
    watch: Callable[[str, float], None],
) -> tuple[AddedLink, Float[ndarray, "N N"], SensorNetwork]:
    candidates = _lacking(network)
    glanced = []
    for i, link in enumerate(candidates):
        glanced.append((_Candidate.of(network, ambiguity, link).search(W, _GLANCE)[0], link))
        watch(f"link {number + 1} of {m}: candidate {i + 1} of {len(candidates)}", min(glanced)[0])
    glanced.sort()
    ranked = []
    for _, link in glanced[:_FINALISTS]:
        candidate = _Candidate.of(network, ambiguity, link)
        value, found = candidate.search(W, 100)
        ranked.append((value, link, found, candidate.network))
        watch(f"link {number + 1} of {m}: finalists", min(each[0] for each in ranked))
    ranked.sort(key=lambda each: each[0])
    value, link, found, relinked = ranked[0]
    if not np.isfinite(value):
        raise InputError("no link leaves the network with a finite mean square deviation")
    runners = tuple((other, msd) for msd, other, _, _ in ranked[1 : 1 + _RUNNERS_UP])
    return AddedLink(link, value, runners), found, relinked


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A network with one more link."""

    network: SensorNetwork
    objective: MsdObjective
    among: Admissible

    @classmethod
    def of(cls, network: SensorNetwork, ambiguity: Ambiguity, link: tuple[int, int]) -> _Candidate:
        longer = network.relinked(np.concatenate([network.links, np.array([link])]))
        table = choose_tolerances(longer, ambiguity)
        errors = NetworkErrors(longer, table.local, least_favourable_model(longer, table.central))
        criterion = Criterion("mean", np.full(longer.N, 1 / longer.N))
        return cls(longer, MsdObjective([errors], criterion), Admissible.of(errors.columns, Constraints()))

    def search(self, W: Float[ndarray, "N N"], steps: int) -> tuple[float, Float[ndarray, "N N"]]:
        """The MSD after so many steps from W, and the weights there."""
        start = self.among.weights(W)
        end = minimise(
            self.objective,
            start,
            self.among.project,
            tolerance=_TOLERANCE,
            steps=steps,
            centre=self.among.centred,
        )
        found = np.zeros_like(W)
        found[self.among.columns.sender, self.among.columns.hearer] = end.z
        return end.value, found
