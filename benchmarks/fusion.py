"""Fusion weights, eq. (17), against CVXPY with parameters (compiled once) and Clarabel called directly.

The same problems, and answers that agree: Newton's method takes a thousand problems at once, the peers one after the
other, which is how they work. `simplex` has no other constraint, `eq. (17)` has
P <= P_0 with uniform reference weights (on the current pairs, where there is a window).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy import ndarray
from tests.fusion_problems import covariances, stale

from benchmarks.harness import measure, show
from tolnet.analysis import solve_fusion_weights
from tolnet.design.fusion_sdp import solver_for
from tolnet.design.fusion_weights import FusionMethod, choose_fusion_weights
from tolnet.model import FusionWeights

COUNT = 1024
SAMPLE = 24
PEERS: dict[Literal["clarabel", "cvxpy"], str] = {
    "clarabel": "Clarabel, called directly",
    "cvxpy": "CVXPY with parameters",
}


def run() -> None:
    """Six pairs of six states; four neighbours and a window of three with four states."""
    rng = np.random.default_rng(0)
    six = covariances(rng, COUNT, 6, 6)
    window, a = stale(rng, COUNT, 4, 4, 3)
    for title, Omega, reference in (
        ("n = 6, 6 pairs, simplex", six, None),
        ("n = 6, 6 pairs, eq. (17)", six, np.full((COUNT, 6), 1 / 6)),
        ("n = 4, 4 neighbours x window 3, simplex", window, None),
        ("n = 4, 4 neighbours x window 3, eq. (17)", window, a),
    ):
        compare(title, Omega, reference)


def compare(title: str, Omega: ndarray, reference: ndarray | None) -> None:
    """Time the three on one stack, and make sure that they agree."""

    def peer(method: FusionMethod) -> FusionWeights:
        return choose_fusion_weights(Omega[:SAMPLE], None if reference is None else reference[:SAMPLE], method=method)

    ours = measure("analysis.solve_fusion_weights", lambda: solve_fusion_weights(Omega, reference).ok)
    lines = [ours]
    found = solve_fusion_weights(Omega, reference)
    for method, name in PEERS.items():
        solver_for(method, Omega.shape[1], Omega.shape[-1], reference is not None)
        slow = peer(method)
        off = float(np.abs(slow.trace / found.trace[:SAMPLE] - 1).max())
        line = measure(f"{name} (trace off by {off:.0e})", lambda method=method: peer(method), 3)
        lines.append(line.scaled(COUNT / SAMPLE))
    show(f"Fusion weights: {title}; {COUNT:,} problems", lines)
    print(
        f"  {COUNT / ours.cpu:,.0f} a second; proved gap at most {found.gap.max():.1e},"
        f" {'all' if found.ok.all() else 'NOT all'} ok"
    )
