"""Monte Carlo over corrupted channels against a plain loop over runs and nodes (tests/reference/corrupted_loop.py).

Both see the same draws, and the time of drawing counts on both sides. Steps per second and node count every node of
every run. The loop is timed on a few runs and multiplied. DRKF-SWF solves eq. (17) at every step;
the loop then calls Clarabel.
"""

from __future__ import annotations

import numpy as np
from tests.reference.corrupted_loop import LOOPS, Run

from benchmarks.harness import measure, show
from tolnet import model
from tolnet.analysis import simulate_corrupted
from tolnet.analysis.corrupted_truth import walk_corrupted
from tolnet.model import CorruptedNetwork

STEPS = 50
CASES = (
    ("field", "DRKF", 500, 4),
    ("field", "DRKF-SWF", 100, 1),
    ("field", "DSEA-CP", 500, 4),
    ("field", "CRKF", 500, 10),
    ("field-50", "DRKF", 100, 1),
)


def run() -> None:
    """One filter after the other."""
    for name, kind, runs, sample in CASES:
        network = model.example(name)
        assert isinstance(network, CorruptedNetwork)
        compare(network, kind, runs, sample)


def compare(network: CorruptedNetwork, kind: str, runs: int, sample: int) -> None:
    """Time both on one network, after making sure that they agree."""
    slow = loop(network, kind, 2)
    found = simulate_corrupted(network, runs=2, steps=STEPS, filters=[kind])[kind]
    if slow.shape != found.node_mse.shape:
        raise RuntimeError(f"the loop and the library differ in shape: {slow.shape}, {found.node_mse.shape}")
    ours = measure(
        "analysis.simulate_corrupted",
        lambda: simulate_corrupted(network, runs=runs, steps=STEPS, filters=[kind]),
        3,
    )
    naive = measure("plain loop over runs and nodes", lambda: loop(network, kind, sample), 1).scaled(runs / sample)
    show(f"{kind} on {network.name}: {runs:,} runs of {STEPS} steps, {network.N} nodes", [ours, naive])
    each = runs * STEPS * network.N
    print(f"  {each / ours.cpu:,.0f} steps a second and node, {each / naive.cpu:,.0f} by the loop")


def loop(network: CorruptedNetwork, kind: str, runs: int) -> np.ndarray:
    """Mean square errors over time, drawn and filtered run by run."""
    total = 0.0
    for seed in range(runs):
        rng, path = (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(2))
        walk = list(walk_corrupted(network, rng, path, runs=1, steps=STEPS, shared=False))
        one: Run = [(at.x[0], at.y[0], at.e[0], at.D[0]) for at in walk]
        x, _ = LOOPS[kind](network, one)
        total = total + ((x - np.array([at.x for at in walk])) ** 2).sum(axis=2)
    return np.asarray(total / runs)
