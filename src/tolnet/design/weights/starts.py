"""Where a search for the least mean square deviation begins."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.design.diffusion import diffusion_matrix
from tolnet.design.weights.admissible import Admissible, Constraints
from tolnet.design.weights.combination import combine
from tolnet.design.weights.decay import design_decay
from tolnet.design.weights.mixing import design_mixing, is_connected
from tolnet.design.weights.msd import MsdObjective
from tolnet.design.weights.search import RANDOM, Watch
from tolnet.design.weights.setting import Setting, links_of, local_loops
from tolnet.model import DIFFUSION_RULES, UnsupportedError

_RANDOM_STARTS, _RANDOM_UP_TO = 4, 50
"""So many starts are drawn at random, always the same ones, in networks of up to so many nodes."""
_SDP_STARTS_UP_TO = 40
"""Nodes up to which the designs by semidefinite programming are among the starts."""

Starts = dict[str, Float[ndarray, " L"]]


def rule_weights(at: Setting) -> Starts:
    """Every rule that the graph allows, and the network's own W, link by link."""
    columns = at.among.columns
    starts = {at.rule: links_of(at.baseline, columns)}
    for rule in DIFFUSION_RULES:
        try:
            starts[rule] = links_of(diffusion_matrix(at.network, rule, at.table), columns)
        except UnsupportedError:  # this graph has no such weights
            continue
    return starts


def starting_weights(at: Setting, objective: MsdObjective, watch: Watch) -> tuple[Starts, bool]:
    """Rules, designs by semidefinite programming and random weights; and whether Ctrl-C came before all were there.

    The designs: `decay`, `mixing` and, from the best start so far, `combination`, a few steps to each node's best
    combination for the present error covariances. What is there when Ctrl-C comes is handed back, if it is anything.
    """
    starts: Starts = {}
    try:
        starts |= rule_weights(at)
        if 1 < at.network.N <= _SDP_STARTS_UP_TO:
            _add_designs(at, objective, starts, watch)
        if 1 < at.network.N <= _RANDOM_UP_TO:
            _add_random(at, starts)
    except KeyboardInterrupt:
        if not starts:
            raise
        return starts, True
    return starts, False


def _add_designs(at: Setting, objective: MsdObjective, starts: Starts, watch: Watch) -> None:
    plain = Constraints(own_weight=at.constraints.own_weight)
    columns, among = at.among.columns, Admissible.of(at.among.columns, plain)
    rules = dict(starts)
    values = {name: objective.exact(among.project(w)) for name, w in rules.items()}
    best = min(values, key=lambda name: values[name])
    watch("starts: certified decay", values[best])
    decay = design_decay(among, local_loops(at.table), rules, _silent, thorough=False)
    starts["decay"] = links_of(decay.W, columns)
    if decay.interrupted:
        raise KeyboardInterrupt
    if is_connected(at.network):
        watch("starts: fastest mixing", values[best])
        starts["mixing"] = links_of(design_mixing(at.network, among, plain).W, columns)
    watch(f"starts: best combinations, from {best}", values[best])
    starts["combination"] = combine(objective.stages[0], among, among.project(rules[best]))


def _add_random(at: Setting, starts: Starts) -> None:
    columns = at.among.columns
    drawn = np.random.default_rng(0).exponential(size=(_RANDOM_STARTS, len(columns.sender))) ** 2
    for number, w in enumerate(drawn):
        starts[f"{RANDOM}-{number + 1}"] = w / columns.sums(w)[columns.hearer]


def _silent(what: str, value: float) -> None:
    """Nobody watches."""
