"""The two objectives that look at eigenvalues instead of errors: certified decay, and mixing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tolnet.design.weights.admissible import make_admissible
from tolnet.design.weights.decay import design_decay
from tolnet.design.weights.mixing import MixingDesign, design_mixing, distance_from_average
from tolnet.design.weights.report import tell_other, without_performance
from tolnet.design.weights.search import Watch
from tolnet.design.weights.setting import Setting, local_loops
from tolnet.design.weights.starts import rule_weights
from tolnet.model import Diffusion, Start, Status


def by_mixing(at: Setting, sdp: bool, watch: Watch) -> Diffusion:
    """The fastest mixing weights, told with what they do to the errors; of the rules the best after Ctrl-C."""
    before = distance_from_average(at.baseline)
    name, interrupted = "semidefinite program", False
    try:
        design = design_mixing(at.network, at.among, at.constraints, sdp=sdp, watch=watch)
    except KeyboardInterrupt:
        (name, design), interrupted = _best_rule(at), True
    change = design.value / design.before - 1 if design.before > 0 else 0.0
    told = tell_other(
        at,
        "mixing",
        design.W,
        design.value,
        before,
        design.bound,
        change,
        [Start(name, before, design.value)],
        [before, design.value],
    )
    return replace(told, interrupted=interrupted, converged=not interrupted)


def _best_rule(at: Setting) -> tuple[str, MixingDesign]:
    """The rule that mixes fastest once it is made admissible; no bound is known of it."""
    symmetric = at.constraints.symmetric
    rules = {
        name: make_admissible(at.among, at.among.project(w), symmetric=symmetric)
        for name, w in rule_weights(at).items()
    }
    values = {name: distance_from_average(W) for name, W in rules.items()}
    name = min(values, key=lambda name: values[name])
    return name, MixingDesign(rules[name], values[name], float("nan"), values[name])


def by_decay(at: Setting, sdp: bool, watch: Watch) -> Diffusion:
    """The best certified decay rate that is found, with its certificate and with what the weights do to the errors.

    No bound: the searches are local, and what bounds the rate of one certificate bounds no other's.
    """
    table = at.table
    if not table.local.exists.all():
        k = int(np.argmin(table.local.exists))
        reason = f"the filter of node {at.network.label(k)} has no steady state ({table.local.status[k]})"
        return without_performance(at, "decay", Status(str(table.local.status[k])), reason)
    design = design_decay(at.among, local_loops(table), rule_weights(at), watch, sdp=sdp)
    rates = [Start(name, rate, design.ends.get(name, float("nan"))) for name, rate in design.starts.items()]
    told = tell_other(
        at,
        "decay",
        design.W,
        design.certificate.rate,
        design.starts[at.rule],
        float("nan"),
        design.certificate.rate / design.before - 1 if design.before > 0 else 0.0,
        rates,
        design.history,
    )
    return replace(
        told,
        certificate=design.certificate,
        best_start=design.best_start,
        evaluations=design.evaluations,
        interrupted=design.interrupted,
    )
