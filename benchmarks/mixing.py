"""Fastest mixing weights by interior points against CVXPY with Clarabel: time, and the distance to the bound.

The built-in `random` networks. Clarabel is asked up to 40 nodes.
"""

from __future__ import annotations

import time

from benchmarks.harness import Measurement, show
from tolnet.analysis.curvature import columns_of
from tolnet.design.weights.admissible import Admissible, Constraints
from tolnet.design.weights.mixing import MixingDesign, design_mixing
from tolnet.model import SensorNetwork
from tolnet.model.examples import random_network

SIZES = (20, 40, 100, 200, 300)
WITH_PEER_UP_TO = 40


def run() -> None:
    """Free and symmetric weights, five sizes of network."""
    for N in SIZES:
        network = random_network(N, 0)
        for symmetric in (False, True):
            compare(network, symmetric)


def compare(network: SensorNetwork, symmetric: bool) -> None:
    """One network, both ways where the peer can."""
    ways = {"interior points": False} | ({"CVXPY, Clarabel": True} if network.N <= WITH_PEER_UP_TO else {})
    lines, gaps = [], []
    for name, sdp in ways.items():
        line, found = solve(name, network, symmetric, sdp)
        lines.append(line)
        gaps.append(f"{name} {found.value:.9f}, above its bound by {found.value - found.bound:.0e}")
    kind = "symmetric" if symmetric else "free"
    show(f"Fastest mixing, N = {network.N}, {network.adjacency.nnz:,} weights, {kind}", lines)
    print("  |W - 11'/N|: " + "; ".join(gaps))


def solve(name: str, network: SensorNetwork, symmetric: bool, sdp: bool) -> tuple[Measurement, MixingDesign]:
    """One design, timed. Its memory is not watched, which would slow it down."""
    constraints = Constraints(symmetric=symmetric)
    among = Admissible.of(columns_of(network.adjacency), constraints)
    cpu, wall = time.process_time(), time.perf_counter()
    found = design_mixing(network, among, constraints, sdp=sdp)
    return Measurement(name, time.process_time() - cpu, time.perf_counter() - wall, 0), found
