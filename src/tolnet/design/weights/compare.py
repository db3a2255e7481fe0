"""All rules and all objectives side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from tolnet.analysis import error_dynamics, least_favourable_model, solve_lyapunov
from tolnet.analysis.curvature import columns_of
from tolnet.design.diffusion import diffusion_matrix
from tolnet.design.weights.admissible import Constraints
from tolnet.design.weights.mixing import distance_from_average, is_connected
from tolnet.design.weights.optimise import optimise_diffusion
from tolnet.design.weights.second_moments import SecondMoments
from tolnet.design.weights.setting import local_loops
from tolnet.model import DIFFUSION_RULES, SensorNetwork, ToleranceTable, UnsupportedError

_NORM_UP_TO = 2000


@dataclass(frozen=True, eq=False)
class Rival:
    """One choice of W under all criteria; NaN where there is no number."""

    name: str
    W: sparse.csr_array
    msd: float
    worst: float
    radius: float
    rate: float
    """Of the best certificate: the root of the spectral radius of T_W; below 1 proves stability."""
    mixing: float
    """|W - 11'/N|."""
    gap_closed: float
    status: str


def compare_diffusions(
    network: SensorNetwork,
    table: ToleranceTable,
    constraints: Constraints | None = None,
    *,
    watch: Callable[[str, float], None] = lambda what, value: None,
) -> list[Rival]:
    """Every rule that the graph allows, then W designed for each objective that has one answer without scenarios.

    `gap_closed` is that of the mean MSD, against the network's own weights. Objectives that refuse the graph or the
    constraints are left out.
    """
    rivals: dict[str, sparse.csr_array] = {}
    for rule in DIFFUSION_RULES:
        try:
            rivals[rule] = diffusion_matrix(network, rule, table)
        except UnsupportedError:
            continue
    if not isinstance(network.diffusion, str):
        rivals["weights"] = network.diffusion
    asked = constraints or Constraints()
    for objective in ("mixing", "decay", "worst", "msd"):
        if objective == "mixing" and not is_connected(network):
            continue
        if objective in ("mixing", "decay") and asked.max_neighbours is not None:
            continue
        if objective == "decay" and asked.symmetric:
            continue
        try:
            found = optimise_diffusion(network, table, objective, constraints=asked, watch=watch)
        except UnsupportedError:
            continue
        rivals[f"optimised: {objective}"] = found.W
    model = least_favourable_model(network, table.central)
    baseline = solve_lyapunov(error_dynamics(network, table.local, diffusion_matrix(network, table=table), model)).msd
    bound = float(np.trace(model.error_covariance))
    moments = SecondMoments(columns_of(network.adjacency), local_loops(table))
    return [_rival(network, table, model, moments, name, W, baseline, bound) for name, W in rivals.items()]


def _rival(network, table, model, moments: SecondMoments, name: str, W: sparse.csr_array, baseline, bound) -> Rival:
    found = solve_lyapunov(error_dynamics(network, table.local, W, model))
    columns = moments.columns
    w = np.asarray(W[columns.sender, columns.hearer], dtype=float).ravel()
    room = baseline - bound
    return Rival(
        name=name,
        W=W,
        msd=found.msd,
        worst=float(found.node_msd.max()),
        radius=found.spectral_radius,
        rate=float(np.sqrt(moments.radius(w))) if np.isfinite(moments.M).all() else float("nan"),
        mixing=distance_from_average(W) if network.N <= _NORM_UP_TO else float("nan"),
        gap_closed=(baseline - found.msd) / room if room > 0 else float("nan"),
        status=str(found.status),
    )
