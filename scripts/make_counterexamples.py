"""Search networks of stable filters that ordinary weights make unstable, and write the most telling ones as built-in
problems: python scripts/make_counterexamples.py

Small networks are drawn with an unstable plant and sensors of very unequal quality, each node filtering what it hears
from its neighbours. Every local filter is stable, and so is the network without diffusion; with weights by rule some
are not. The literature states that they would be, for every admissible W and small tolerances. Numbers are rounded to
few digits, so that the files can be read.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tolnet import analysis, design, model
from tolnet.model import Ambiguity, SensorNetwork

TARGET = Path(__file__).parents[1] / "src/tolnet/model/examples"
DRAWS = 4_000
TOLERANCE = 1e-4


class Kind(NamedTuple):
    """One of the counter-examples: its name, and what is drawn."""

    name: str
    states: int
    rule: str
    edges: Callable[[int], list[list[int]]]
    seed: int


def path(N: int) -> list[list[int]]:
    """0 - 1 - ... - N-1."""
    return [[k, k + 1] for k in range(N - 1)]


def ring(N: int) -> list[list[int]]:
    """The path with its ends joined."""
    return [*path(N), [0, N - 1]]


KINDS = (
    Kind("unstable-path", 2, "relative-degree", path, 1),
    Kind("unstable-ring", 2, "uniform", ring, 2),
    Kind("unstable-metropolis", 3, "metropolis", path, 3),
)


def draw(generator: np.random.Generator, kind: Kind) -> SensorNetwork:
    """One network: an unstable plant, one output a node, information spread over eight decades."""
    n, N = kind.states, int(generator.integers(3, 7))
    A = generator.standard_normal((n, n))
    A *= generator.uniform(1.0, 1.8) / np.abs(np.linalg.eigvals(A)).max()
    C = np.round(generator.standard_normal((N, 1, n)), 1)
    R = [[[float(f"{10 ** generator.uniform(-5, 3):.0e}")]] for _ in range(N)]
    return SensorNetwork(
        A=np.round(A, 2),
        Q=np.eye(n),
        C=C,
        R=R,
        edges=kind.edges(N),
        name=kind.name,
        description=f"{N} stable filters that {kind.rule} weights make unstable",
        ambiguity=Ambiguity(TOLERANCE),
        diffusion=kind.rule,
    )


def spectral_radius(network: SensorNetwork) -> float:
    """That of the network block of F; 0 where some filter, or the centre, has no answer without reservation."""
    table = design.choose_tolerances(network)
    if not (table.ok and (table.local.spectral_radius < 0.95).all()):
        return 0.0
    central = table.central
    W = design.diffusion_matrix(network)
    dynamics = analysis.error_dynamics(network, table.local, W, analysis.least_favourable_model(network, central))
    d = network.N * network.n
    return float(np.abs(np.linalg.eigvals(dynamics.matrix()[:d, :d])).max()) if dynamics.exists else 0.0


def search(kind: Kind) -> tuple[SensorNetwork, float, int]:
    """The draw with the largest spectral radius, that radius, and how many draws were unstable."""
    generator = np.random.default_rng(kind.seed)
    best: SensorNetwork | None = None
    largest, unstable = 0.0, 0
    for _ in range(DRAWS):
        try:
            network = draw(generator, kind)
        except model.InputError:
            continue
        radius = spectral_radius(network)
        unstable += radius > 1
        if radius > largest:
            best, largest = network, radius
    if best is None or largest <= 1:
        raise SystemExit(f"{kind.name}: no draw of {DRAWS} is unstable")
    return best, largest, unstable


if __name__ == "__main__":
    for kind in KINDS:
        start = time.monotonic()
        network, radius, unstable = search(kind)
        for written in model.save(network, TARGET / f"{kind.name}.toml", arrays=False):
            seconds = time.monotonic() - start
            print(f"{written}: spectral radius {radius:.4f}; {unstable} of {DRAWS} unstable, {seconds:.0f} s")
