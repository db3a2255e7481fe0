"""The front door: the best diffusion weights that can be found, what they are worth, and what bounds them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.analysis import least_favourable_model
from tolnet.analysis.msd_gradient import NetworkErrors
from tolnet.design.weights.admissible import Admissible, Constraints
from tolnet.design.weights.general import search_general
from tolnet.design.weights.msd import Criterion, MsdObjective
from tolnet.design.weights.report import tell_msd, without_performance
from tolnet.design.weights.search import Search, Watch, search_msd
from tolnet.design.weights.setting import Setting
from tolnet.design.weights.sparsity import search_sparse
from tolnet.design.weights.spectral import by_decay, by_mixing
from tolnet.design.weights.starts import starting_weights
from tolnet.model import (
    OBJECTIVES,
    Complaint,
    Diffusion,
    InputError,
    SensorNetwork,
    Status,
    ToleranceTable,
    UnsupportedError,
)

Objective = Literal["msd", "worst", "robust", "decay", "mixing"]
Method = Literal["auto", "quasi-newton", "ipopt", "sdp"]

_STARTS = ((50, 20), (150, 2))
"""Up to so many nodes the search goes on from so many of the best starts; beyond, from the best alone."""
_STARTS_OF_MAXIMA = 3
"""The same for a largest value, which takes several searches a start."""
TOLERANCE = 1e-7
"""Relative decrease of the objective, as the model of a step promises it, at which a search ends."""


def optimise_diffusion(
    network: SensorNetwork,
    table: ToleranceTable,
    objective: Objective | str = "msd",
    *,
    nodes: Float[ndarray, " N"] | None = None,
    constraints: Constraints | None = None,
    scenarios: Sequence[ToleranceTable] | None = None,
    with_gains: bool = False,
    method: Method | str = "auto",
    watch: Watch = lambda what, value: None,
) -> Diffusion:
    """The best W that can be found, column-stochastic on the graph and nonnegative, eq. (11), for an objective:

        msd      sum_k a_k MSD_k, a_k = 1 / N or `nodes` divided by their sum
        worst    max_k MSD_k
        robust   the largest mean MSD over `scenarios`: tables of the same network at other tolerances, or of networks
                 with some of its links only, where what a lost link weighed goes to w_kk
        decay    the decay rate r with the best certificate: X_k > sigma_k / r^2 sum_l w_lk M_l X_l M_l' for all k
        mixing   |W - 11'/N|

    MSD is that of the table's filters (c_k, theta_k, V_k) under the least favourable model of the centre.
    `with_gains` makes every node's gain a variable too, on its own neighbours: one gain for all scenarios, of which a
    node that has lost a link uses what belongs to the others.
    `method` `auto` is the projected quasi-Newton method, unless W must be symmetric, which takes IPOPT; for `decay`
    and `mixing` what solves their semidefinite programs fastest, and `sdp` is CVXPY with Clarabel, their reference.
    `watch(what, value)` is told how the objective falls. KeyboardInterrupt ends the search with the best so far.

    The result is never worse than any rule, or any design by semidefinite programming that it started from; it is a
    local minimum otherwise. Where the filters have no performance (their status), W is the baseline and says why.
    Raises InputError for constraints that nothing satisfies, arguments that do not fit, or a graph in pieces with
    `mixing`; UnsupportedError for tau other than 0, unknown words, and networks too large for `mixing`.
    Source: docs/mathematics.md, section 12; docs/decisions/0020 to 0022.
    """
    constraints = constraints or Constraints()
    _check(network, table, objective, nodes, scenarios, with_gains, method, constraints)
    at = Setting.of(network, table, constraints)
    match objective:
        case "mixing":
            return by_mixing(at, method == "sdp", watch)
        case "decay":
            return by_decay(at, method == "sdp", watch)
    a = np.full(network.N, 1 / network.N) if nodes is None else np.asarray(nodes, dtype=float) / np.sum(nodes)
    tables = list(scenarios or [table]) if objective == "robust" else [table]
    criterion = Criterion("worst" if objective == "worst" else "mean", a)
    return _by_msd(at, objective, tables, criterion, with_gains, method, watch)


def _gains_on_links_in_use(problem: MsdObjective, among: Admissible, sparse: Search, watch: Watch) -> Search:
    """The gains too, with the links that the search for weights left in use; sensors are heard over all links."""
    assert sparse.z is not None
    narrow = among.narrowed(sparse.z > 0)
    begin = {sparse.best_start: sparse.z}
    found = search_msd(problem, narrow, begin, most=1, tolerance=TOLERANCE, watch=watch)
    found.starts, found.history = sparse.starts, [*sparse.history, *found.history]
    found.evaluations += sparse.evaluations
    return found


def _check(
    network: SensorNetwork,
    table: ToleranceTable,
    objective: str,
    nodes: Any,
    scenarios: Sequence[ToleranceTable] | None,
    with_gains: bool,
    method: str,
    constraints: Constraints,
) -> None:
    """Raise for arguments that do not fit each other, before anything is computed."""
    if objective not in OBJECTIVES:
        raise UnsupportedError(f"objective is {objective!r}; expected {', '.join(map(repr, OBJECTIVES))}")
    if method not in get_args(Method):
        raise UnsupportedError(f"method is {method!r}; expected {', '.join(map(repr, get_args(Method)))}")
    if table.tau != 0:
        raise UnsupportedError(f"the least favourable model is defined for tau = 0 only (tau is {table.tau:g})")
    complaints = complaints_of(objective, constraints, with_gains, method)
    if nodes is not None:
        a = np.asarray(nodes, dtype=float)
        if objective != "msd":
            complaints.append(Complaint("nodes", f"is given; the objective {objective!r} weighs no nodes"))
        elif a.shape != (network.N,) or not (np.isfinite(a) & (a >= 0)).all() or not a.any():
            complaints.append(Complaint("nodes", f"is no list of {network.N} weights >= 0, not all of them 0"))
    if scenarios and objective != "robust":
        complaints.append(Complaint("scenarios", f"are given; the objective {objective!r} has one"))
    for number, scenario in enumerate(scenarios or ()):
        other = scenario.network
        if other.N != network.N or other.n != network.n or sparse.csr_array(other.adjacency > network.adjacency).nnz:
            complaints.append(Complaint(f"scenarios[{number}]", "is of a network with other nodes, states or links"))
    if complaints:
        raise InputError(complaints)
    constraints.check(network)


def complaints_of(objective: str, constraints: Constraints, with_gains: bool, method: str) -> list[Complaint]:
    """What cannot be had together, whatever the network."""
    complaints = []
    by_msd = objective in ("msd", "worst", "robust")
    if method not in ("auto", *(("quasi-newton", "ipopt") if by_msd else ("sdp",))):
        complaints.append(Complaint("method", f"is {method!r}, which cannot be had for the objective {objective!r}"))
    if with_gains and not by_msd:
        complaints.append(Complaint("with_gains", f"cannot be combined with the objective {objective!r}"))
    if with_gains and constraints.symmetric:
        complaints.append(Complaint("with_gains", "cannot be combined with symmetric weights"))
    if with_gains and method == "ipopt":
        complaints.append(Complaint("with_gains", "cannot be combined with the method 'ipopt'"))
    if method == "ipopt" and constraints.max_neighbours is not None and not constraints.symmetric:
        complaints.append(Complaint("max_neighbours", "cannot be combined with the method 'ipopt'"))
    if constraints.symmetric and method == "quasi-newton" and by_msd:
        complaints.append(Complaint("method", "is 'quasi-newton'; symmetric weights need 'ipopt'"))
    if constraints.max_neighbours is not None and not by_msd:
        complaints.append(Complaint("max_neighbours", f"cannot be combined with the objective {objective!r}"))
    if constraints.symmetric and objective == "decay":
        complaints.append(Complaint("symmetric", "cannot be combined with the objective 'decay'"))
    return complaints


def _by_msd(
    at: Setting,
    objective: str,
    tables: list[ToleranceTable],
    criterion: Criterion,
    with_gains: bool,
    method: str,
    watch: Watch,
) -> Diffusion:
    network, among = at.network, at.among
    models = [at.model if t is at.table else least_favourable_model(t.network, t.central) for t in tables]
    scenarios: list[NetworkErrors] = []
    for t, model in zip(tables, models, strict=True):
        unit = scenarios[0].unit if scenarios else None  # gains of all scenarios are the same numbers
        scenarios.append(NetworkErrors(t.network, t.local, model, columns=among.columns, unit=unit))
    lacking = next((s for s in scenarios if not s.exists), None)
    if lacking is not None:
        return without_performance(at, objective, lacking.status, lacking.reason)
    problem = MsdObjective(scenarios, criterion, gains=with_gains)
    starts, cut_short = starting_weights(at, MsdObjective(scenarios, criterion), watch)
    most = next((count for size, count in _STARTS if size >= network.N), 1)
    most = most if problem.plain or with_gains else min(most, _STARTS_OF_MAXIMA)
    most = 0 if cut_short else most
    d = at.constraints.max_neighbours
    symmetric = at.constraints.symmetric
    if symmetric or method == "ipopt":
        found = search_general(problem, among, starts, symmetric=symmetric, most=most, watch=watch)
    elif d is not None and d < network.degree.max():
        alone = MsdObjective(scenarios, criterion)
        found = search_sparse(alone, among, starts, d, most=most, tolerance=TOLERANCE, watch=watch)
        if with_gains and found.z is not None and not found.interrupted:
            found = _gains_on_links_in_use(problem, among, found, watch)
    else:
        found = search_msd(problem, among, starts, most=most, tolerance=TOLERANCE, watch=watch)
    found.interrupted |= cut_short
    if found.z is None:
        reason = "no start has a finite mean square deviation, not even W = I: the filters themselves are unstable"
        return without_performance(at, objective, Status.UNSTABLE, reason)
    bound = max(float(np.trace(model.error_covariance)) for model in models)
    return tell_msd(at, objective, tables, criterion, problem, found, bound)
