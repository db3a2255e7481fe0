"""Algorithm 3: from one tolerance for the network to the table that is deployed."""

from __future__ import annotations

import numpy as np

from tolnet.analysis import local_tolerances, solve_local_steady_states, solve_steady_state
from tolnet.analysis.local_tolerance import LocalTolerances
from tolnet.analysis.steady_state import Progress, resolve_ambiguity
from tolnet.model import Ambiguity, SensorNetwork, ToleranceTable, UnsupportedError


def choose_tolerances(
    network: SensorNetwork,
    tolerance: float | Ambiguity | None = None,
    *,
    uniform: bool = False,
    progress: Progress | None = None,
) -> ToleranceTable:
    """Choose c_k of every node from one tolerance c of the network, and solve its filter at it (Algorithm 3).

    `tolerance` is c on the gamma scale or an Ambiguity; without it the network's own. `uniform` keeps c_k = c at
    every node (Algorithm 1), which needs no centre and is the only choice for tau != 0. `progress(done, total)` is
    called as blocks of nodes are finished. A filter without an answer says so in its status and leaves the others
    alone; where the centre has none, neither has any node whose c_k would come from it.
    Raises InputError for a bad or missing tolerance, UnsupportedError for tau != 0 without `uniform`.
    Source: eqs. (30), (42), (44); docs/mathematics.md, section 3.
    """
    ambiguity = resolve_ambiguity(network, tolerance)
    if ambiguity.tau != 0 and not uniform:
        raise UnsupportedError(
            f"local tolerances are defined for tau = 0 only (tau is {ambiguity.tau}); choose uniform ones, c_k = c"
        )
    central = solve_steady_state(network, ambiguity)
    c = np.full(network.N, ambiguity.gamma) if uniform else local_tolerances(network, central)
    refused = None if uniform or central.exists else np.full(network.N, str(central.status))
    refine = None if uniform or ambiguity.gamma == 0 or not central.exists else LocalTolerances(network, central).exact
    local = solve_local_steady_states(
        network, c, tau=ambiguity.tau, refused=refused, refine=refine, progress=progress
    )
    return ToleranceTable(network, ambiguity.convention, central, local)
