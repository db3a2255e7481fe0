"""Monte Carlo over corrupted channels against a plain loop over runs and nodes (tests/reference/corrupted_loop.py).

Both are first shown to agree on the same draws; the time of drawing counts on both sides. Steps per second and node
count every node of every run. The loop is timed on a few runs and multiplied. DRKF-SWF solves eq. (17) at every step;
the loop then calls Clarabel.
"""

from __future__ import annotations

import numpy as np
from tests.reference.corrupted_loop import LOOPS, Run

from benchmarks.harness import measure, show
from tolnet import model
from tolnet.analysis import CHANNEL_FILTERS, simulate_corrupted
from tolnet.analysis.channel_filters import moments
from tolnet.analysis.corrupted_truth import CorruptedInstant, walk_corrupted
from tolnet.model import CorruptedNetwork

STEPS = 50
CASES = (
    ("field", "DRKF", 500, 4),
    ("field", "DRKF-SWF", 100, 1),
    ("field", "DSEA-CP", 500, 4),
    ("field", "CRKF", 500, 10),
    ("field-50", "DRKF", 100, 1),
    ("field-50", "DRKF-SWF", 20, 1),
)


def run() -> None:
    """One filter after the other."""
    for name, kind, runs, sample in CASES:
        network = model.example(name)
        assert isinstance(network, CorruptedNetwork)
        compare(network, kind, runs, sample)


def compare(network: CorruptedNetwork, kind: str, runs: int, sample: int) -> None:
    """Time both on one network, after making sure that they agree."""
    check(network, kind)
    ours = measure(
        "analysis.simulate_corrupted",
        lambda: simulate_corrupted(network, runs=runs, steps=STEPS, filters=[kind]),
        3,
    )
    naive = measure("plain loop over runs and nodes", lambda: loop(network, kind, sample), 1).scaled(runs / sample)
    show(f"{kind} on {network.name}: {runs:,} runs of {STEPS} steps, {network.N} nodes", [ours, naive])
    each = runs * STEPS * network.N
    print(f"  {each / ours.cpu:,.0f} steps a second and node, {each / naive.cpu:,.0f} by the loop")


def check(network: CorruptedNetwork, kind: str) -> None:
    """The same estimates from the same draws; weights that a program found leave a flat optimum some digits."""
    walk = drawn(network, 0)
    each = CHANNEL_FILTERS[kind](network, 1)
    estimates = [each.x[0]]
    for moment, instant in zip(moments(network, STEPS), walk[1:], strict=True):
        each.step(moment, instant)
        estimates.append(each.x[0])
    x, _ = LOOPS[kind](network, one_run(walk))
    tolerance = 1e-3 if kind == "DRKF-SWF" else 1e-7
    np.testing.assert_allclose(np.array(estimates), x, rtol=tolerance, atol=tolerance)


def drawn(network: CorruptedNetwork, seed: int) -> list[CorruptedInstant]:
    """One run."""
    rng, path = (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(2))
    return list(walk_corrupted(network, rng, path, runs=1, steps=STEPS, shared=False))


def one_run(walk: list[CorruptedInstant]) -> Run:
    """As the loop reads it."""
    return [(at.x[0], at.y[0], at.e[0], at.D[0]) for at in walk]


def loop(network: CorruptedNetwork, kind: str, runs: int) -> np.ndarray:
    """Mean square errors over time, drawn and filtered run by run."""
    total = 0.0
    for seed in range(runs):
        walk = drawn(network, seed)
        x, _ = LOOPS[kind](network, one_run(walk))
        total = total + ((x - np.array([at.x for at in walk])) ** 2).sum(axis=2)
    return np.asarray(total / runs)
