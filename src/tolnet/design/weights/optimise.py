"""The front door: the best diffusion weights that can be found, what they are worth, and what bounds them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.analysis import error_dynamics, least_favourable_model, solve_lyapunov, solve_steady_state
from tolnet.analysis.curvature import Columns, columns_of
from tolnet.analysis.msd_gradient import NetworkErrors
from tolnet.design.diffusion import diffusion_matrix
from tolnet.design.weights.admissible import Admissible, Constraints, make_admissible
from tolnet.design.weights.decay import design_decay
from tolnet.design.weights.gains import pack_gains
from tolnet.design.weights.general import search_general
from tolnet.design.weights.mixing import design_mixing, distance_from_average, is_connected
from tolnet.design.weights.msd import Criterion, MsdObjective
from tolnet.design.weights.search import Search, Watch, search_msd
from tolnet.design.weights.sparsity import search_sparse
from tolnet.model import (
    DIFFUSION_RULES,
    OBJECTIVES,
    Complaint,
    Diffusion,
    Elsewhere,
    InputError,
    LeastFavourableModel,
    Performance,
    SensorNetwork,
    Start,
    Status,
    ToleranceTable,
    UnsupportedError,
)

Objective = Literal["msd", "worst", "robust", "decay", "mixing"]
Method = Literal["auto", "quasi-newton", "ipopt"]

_STARTS = ((50, 20), (150, 2))
"""Up to so many nodes the search goes on from so many of the best starts; beyond, from the best alone."""
_STARTS_OF_MAXIMA = 3
"""The same for a largest value, which takes several searches a start."""
_SDP_STARTS_UP_TO = 40
"""Nodes up to which the designs by semidefinite programming are among the starts."""
_ELSEWHERE = (("nominal", 0.0), ("half of c", 0.5), ("twice c", 2.0))
TOLERANCE = 1e-7
"""Relative decrease of the objective, as the model of a step promises it, at which a search ends."""


def optimise_diffusion(
    network: SensorNetwork,
    table: ToleranceTable,
    objective: Objective = "msd",
    *,
    nodes: Float[ndarray, " N"] | None = None,
    constraints: Constraints | None = None,
    scenarios: Sequence[ToleranceTable] | None = None,
    with_gains: bool = False,
    method: Method = "auto",
    watch: Watch = lambda what, value: None,
) -> Diffusion:
    """The best W that can be found, column-stochastic on the graph and nonnegative, eq. (11), for an objective:

        msd      sum_k a_k MSD_k, a_k = 1 / N or `nodes` divided by their sum
        worst    max_k MSD_k
        robust   the largest mean MSD over `scenarios`: tables of the same network at other tolerances, or of networks
                 with some of its links only, where what a lost link weighed goes to w_kk
        decay    the decay rate r with the best certificate: X_k > sigma_k / r^2 sum_l w_lk M_l X_l M_l' for all k
        mixing   |W - 11'/N|

    MSD is that of the table's filters (c_k, theta_k, V_k) under the least favourable model of its centre; `with_gains`
    makes every node's gain a variable too, on its own neighbours, and W, gains and model are then one design.
    `method` None of the general solvers: `quasi-newton` unless W must be symmetric, which takes `ipopt`.
    `watch(what, value)` is told how the objective falls. KeyboardInterrupt ends the search with the best so far.

    The result is never worse than any rule, or any design by semidefinite programming that it started from; it is a
    local minimum otherwise. Where the filters have no performance (their status), W is the baseline and says why.
    Raises InputError for constraints that nothing satisfies, or arguments that do not fit; UnsupportedError for tau
    other than 0, a graph that is not connected with `mixing`, and combinations that are not offered.
    Source: docs/mathematics.md, section 12; docs/decisions/0020 to 0024.
    """
    constraints = constraints or Constraints()
    _check(network, table, objective, nodes, scenarios, with_gains, method, constraints)
    at = _Setting.of(network, table, constraints)
    match objective:
        case "mixing":
            return _by_mixing(at)
        case "decay":
            return _by_decay(at, watch)
    a = np.full(network.N, 1 / network.N) if nodes is None else np.asarray(nodes, dtype=float) / np.sum(nodes)
    tables = list(scenarios or [table]) if objective == "robust" else [table]
    criterion = Criterion("worst" if objective == "worst" else "mean", a)
    return _by_msd(at, objective, tables, criterion, with_gains, method, watch)


@dataclass(frozen=True, eq=False)
class _Setting:
    """What every objective starts from."""

    network: SensorNetwork
    table: ToleranceTable
    constraints: Constraints
    among: Admissible
    baseline: sparse.csr_array
    rule: str
    model: LeastFavourableModel

    @classmethod
    def of(cls, network: SensorNetwork, table: ToleranceTable, constraints: Constraints) -> _Setting:
        """The baseline is the network's own W, or its rule."""
        own = network.diffusion
        return cls(
            network=network,
            table=table,
            constraints=constraints,
            among=Admissible.of(columns_of(network.adjacency), constraints),
            baseline=diffusion_matrix(network, table=table),
            rule=own if isinstance(own, str) else "weights",
            model=least_favourable_model(network, table.central),
        )

    def performance(self, W: sparse.csr_array, table: ToleranceTable | None = None) -> Performance:
        """Of a table's filters under W; what a link weighed that its network lacks goes to w_kk."""
        if table is None or table is self.table:
            return solve_lyapunov(error_dynamics(self.network, self.table.local, W, self.model))
        model = least_favourable_model(table.network, table.central)
        return solve_lyapunov(error_dynamics(table.network, table.local, folded(W, table.network), model))

    @property
    def bound(self) -> float:
        """MSD of the centralised robust filter; NaN where its model does not exist."""
        return float(np.trace(self.model.error_covariance))

    @property
    def words(self) -> dict[str, str]:
        """The constraints, as far as they ask for something."""
        asked, own = {}, np.asarray(self.constraints.own_weight)
        if self.constraints.symmetric:
            asked["symmetric"] = "yes"
        if own.any():
            asked["own_weight"] = f"at least {own.min():g}" if own.min() == own.max() else "at least as given"
        if self.constraints.max_neighbours is not None:
            asked["max_neighbours"] = str(self.constraints.max_neighbours)
        return asked


def folded(W: sparse.csr_array, network: SensorNetwork) -> sparse.csr_array:
    """W on a network that lacks some of its links: what a lost link weighed goes to w_kk."""
    kept = sparse.csr_array(W.multiply(network.adjacency.astype(float)))
    lost = np.asarray(W.sum(axis=0)) - np.asarray(kept.sum(axis=0))
    return sparse.csr_array(kept + sparse.diags_array(lost))


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
    complaints = []
    if objective not in OBJECTIVES:
        raise UnsupportedError(f"objective is {objective!r}; expected {', '.join(map(repr, OBJECTIVES))}")
    if method not in ("auto", "quasi-newton", "ipopt"):
        raise UnsupportedError(f"method is {method!r}; expected 'auto', 'quasi-newton' or 'ipopt'")
    if table.tau != 0:
        raise UnsupportedError(f"the least favourable model is defined for tau = 0 only (tau is {table.tau:g})")
    by_msd = objective in ("msd", "worst", "robust")
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
        if other.N != network.N or other.n != network.n or (other.adjacency > network.adjacency).nnz:
            complaints.append(Complaint(f"scenarios[{number}]", "is of a network with other nodes, states or links"))
    if with_gains and objective not in ("msd", "worst"):
        complaints.append(Complaint("with_gains", f"cannot be combined with the objective {objective!r}"))
    general = method == "ipopt" or constraints.symmetric
    if with_gains and (general or constraints.max_neighbours is not None):
        complaints.append(Complaint("with_gains", "cannot be combined with ipopt, symmetric or max_neighbours"))
    if general and constraints.max_neighbours is not None and not constraints.symmetric:
        complaints.append(Complaint("max_neighbours", "cannot be combined with ipopt"))
    if constraints.symmetric and method == "quasi-newton" and by_msd:
        complaints.append(Complaint("method", "is 'quasi-newton'; symmetric weights need 'ipopt'"))
    if constraints.max_neighbours is not None and not by_msd:
        complaints.append(Complaint("max_neighbours", f"cannot be combined with the objective {objective!r}"))
    if constraints.symmetric and objective == "decay":
        complaints.append(Complaint("symmetric", "cannot be combined with the objective 'decay'"))
    if complaints:
        raise InputError(complaints)
    constraints.check(network)


def _by_msd(
    at: _Setting,
    objective: str,
    tables: list[ToleranceTable],
    criterion: Criterion,
    with_gains: bool,
    method: Method,
    watch: Watch,
) -> Diffusion:
    network, among = at.network, at.among
    models = [at.model if t is at.table else least_favourable_model(t.network, t.central) for t in tables]
    scenarios = [
        NetworkErrors(t.network, t.local, model, columns=among.columns)
        for t, model in zip(tables, models, strict=True)
    ]
    lacking = next((s for s in scenarios if not s.exists), None)
    if lacking is not None:
        return _without_performance(at, objective, lacking.status, lacking.reason)
    problem = MsdObjective(scenarios, criterion, gains=with_gains)
    starts = _starts(at)
    most = next((count for size, count in _STARTS if network.N <= size), 1)
    most = most if problem.plain or with_gains else min(most, _STARTS_OF_MAXIMA)
    d = at.constraints.max_neighbours
    if at.constraints.symmetric or method == "ipopt":
        found = search_general(problem, among, starts, symmetric=at.constraints.symmetric, watch=watch)
    elif d is not None:
        found = search_sparse(problem, among, starts, d, most=most, tolerance=TOLERANCE, watch=watch)
    else:
        found = search_msd(problem, among, starts, most=most, tolerance=TOLERANCE, watch=watch)
    if found.z is None:
        reason = "no start has a finite mean square deviation, not even W = I: the filters themselves are unstable"
        return _without_performance(at, objective, Status.UNSTABLE, reason)
    bound = max(float(np.trace(model.error_covariance)) for model in models)
    return _told(at, objective, tables, criterion, problem, found, bound)


def _starts(at: _Setting) -> dict[str, Float[ndarray, " L"]]:
    """Every rule that the graph allows, the network's own W, and the designs by semidefinite programming."""
    network, columns = at.network, at.among.columns
    matrices: dict[str, sparse.csr_array] = {"weights": at.baseline} if at.rule == "weights" else {}
    for rule in DIFFUSION_RULES:
        try:
            matrices[rule] = diffusion_matrix(network, rule, at.table)
        except UnsupportedError:  # this graph has no such weights
            continue
    if 1 < network.N <= _SDP_STARTS_UP_TO:
        rules = {name: _links(W, columns) for name, W in matrices.items()}
        plain = Constraints(own_weight=at.constraints.own_weight)
        matrices["decay"] = design_decay(Admissible.of(columns, plain), local_loops(at.table), rules, _silent).W
        if is_connected(network):
            matrices["mixing"] = design_mixing(network, Admissible.of(columns, plain), plain).W
    return {name: _links(W, columns) for name, W in matrices.items()}


def _silent(what: str, value: float) -> None:
    """Nobody watches."""


def _links(W: sparse.csr_array, columns: Columns) -> Float[ndarray, " L"]:
    return np.asarray(W[columns.sender, columns.hearer], dtype=float).ravel()


def local_loops(table: ToleranceTable) -> Float[ndarray, "N n n"]:
    """M_k = A (I + V_k S_k)^-1."""
    eye = np.eye(table.network.n)
    return table.network.A @ np.linalg.solve(eye + table.local.V @ table.local.S, np.broadcast_to(eye, table.local.V.shape))


def _told(
    at: _Setting,
    objective: str,
    tables: list[ToleranceTable],
    criterion: Criterion,
    problem: MsdObjective,
    found: Search,
    bound: float,
) -> Diffusion:
    """The last step, and everything recomputed by the solver of `tolnet performance`; for gains, by their own."""
    assert found.z is not None
    columns, L = at.among.columns, len(at.among.columns.sender)
    W = make_admissible(columns, found.z[:L], symmetric=at.constraints.symmetric)
    before = [at.performance(at.baseline, each) for each in tables]
    baseline = criterion(np.array([each.node_msd for each in before]))
    first = tables.index(at.table) if at.table in tables else 0
    gains, errors = None, problem.scenarios[0]
    if problem.gains and len(found.z) > L:
        z = np.concatenate([_links(W, columns), found.z[L:]])
        solved = errors.solve(z)
        own = error_dynamics(at.network, at.table.local, at.baseline, at.model)
        gains = pack_gains(at.network, own, errors, z)
        node_msd, residual, radius = solved.node_msd, solved.residual, solved.radius
        radius = max(radius, before[0].least_favourable_radius)
        value, status, reason = criterion(node_msd[None]), errors.status, errors.reason
    else:
        z = _links(W, columns)
        after = [at.performance(W, each) for each in tables]
        value = criterion(np.array([each.node_msd for each in after]))
        node_msd, radius = after[first].node_msd, max(each.spectral_radius for each in after)
        residual = max(each.residual for each in after)
        bad = next((each for each in after if each.status != Status.OK), after[0])
        status, reason = bad.status, bad.reason
    return Diffusion(
        table=at.table,
        objective=objective,
        W=W,
        gains=gains,
        value=value,
        baseline=baseline,
        bound=bound,
        baseline_rule=at.rule,
        node_msd=node_msd,
        baseline_node_msd=before[first].node_msd,
        msd_bound=at.bound,
        spectral_radius=radius,
        status=status,
        reason=reason,
        starts=tuple(found.starts),
        best_start=found.best_start,
        history=np.array(found.history),
        change=float(value / found.value - 1),
        residual=residual,
        evaluations=found.evaluations,
        converged=found.converged,
        interrupted=found.interrupted,
        certificate=None,
        elsewhere=tuple(_elsewhere(at, W, errors, z)),
        about=at.words,
    )


def _elsewhere(
    at: _Setting, W: sparse.csr_array, errors: NetworkErrors, z: Float[ndarray, " z"]
) -> Iterator[Elsewhere]:
    """The same W (and gains) under the least favourable models of other tolerances."""
    network, c = at.network, float(at.table.central.tolerance)
    for name, factor in _ELSEWHERE:
        tolerance = factor * c
        model = least_favourable_model(network, solve_steady_state(network, tolerance))
        if not model.exists:
            yield Elsewhere(name, tolerance, float("nan"), float("nan"), float("nan"), model.reason)
            continue
        before = solve_lyapunov(error_dynamics(network, at.table.local, at.baseline, model))
        if len(z) > len(errors.columns.sender):
            there = NetworkErrors(network, at.table.local, model, unit=errors.unit)
            msd = float(there.solve(z).node_msd.mean())
        else:
            msd = solve_lyapunov(error_dynamics(network, at.table.local, W, model)).msd
        yield Elsewhere(name, tolerance, before.msd, msd, float(np.trace(model.error_covariance)))


def _by_mixing(at: _Setting) -> Diffusion:
    design = design_mixing(at.network, at.among, at.constraints)
    before = distance_from_average(at.baseline)
    change = design.value / design.before - 1 if design.before > 0 else 0.0
    start = Start("semidefinite program", before, design.value)
    return _plain(at, "mixing", design.W, design.value, before, design.bound, change, [start], [before, design.value])


def _by_decay(at: _Setting, watch: Watch) -> Diffusion:
    table, columns = at.table, at.among.columns
    if not table.local.exists.all():
        k = int(np.argmin(table.local.exists))
        reason = f"the filter of node {at.network.label(k)} has no steady state ({table.local.status[k]})"
        return _without_performance(at, "decay", Status(str(table.local.status[k])), reason)
    starts = {}
    for rule in DIFFUSION_RULES:
        try:
            starts[rule] = _links(diffusion_matrix(at.network, rule, table), columns)
        except UnsupportedError:
            continue
    starts[at.rule] = _links(at.baseline, columns)
    design = design_decay(at.among, local_loops(table), starts, watch)
    rates = [Start(name, rate, float("nan")) for name, rate in design.starts.items()]
    told = _plain(
        at,
        "decay",
        design.W,
        design.certificate.rate,
        design.starts[at.rule],
        design.bound,
        design.certificate.rate / design.before - 1,
        rates,
        design.history,
    )
    return replace(
        told, certificate=design.certificate, best_start=design.best_start, interrupted=design.interrupted
    )


def _plain(
    at: _Setting,
    objective: str,
    W: sparse.csr_array,
    value: float,
    baseline: float,
    bound: float,
    change: float,
    starts: Sequence[Start],
    history: Sequence[float],
) -> Diffusion:
    """A design whose objective is not the mean square deviation, with what it does to that."""
    before, after = at.performance(at.baseline), at.performance(W)
    return Diffusion(
        table=at.table,
        objective=objective,
        W=W,
        gains=None,
        value=value,
        baseline=baseline,
        bound=bound,
        baseline_rule=at.rule,
        node_msd=after.node_msd,
        baseline_node_msd=before.node_msd,
        msd_bound=at.bound,
        spectral_radius=after.spectral_radius,
        status=after.status,
        reason=after.reason,
        starts=tuple(starts),
        best_start=starts[0].name,
        history=np.array(history, dtype=float),
        change=float(change),
        residual=after.residual,
        evaluations=len(history),
        converged=True,
        interrupted=False,
        certificate=None,
        elsewhere=(),
        about=at.words,
    )


def _without_performance(at: _Setting, objective: str, status: Status, reason: str) -> Diffusion:
    """The baseline, and why there is nothing better to be had."""
    nan = float("nan")
    nothing = np.full(at.network.N, np.nan)
    return Diffusion(
        table=at.table,
        objective=objective,
        W=at.baseline,
        gains=None,
        value=nan,
        baseline=nan,
        bound=nan,
        baseline_rule=at.rule,
        node_msd=nothing,
        baseline_node_msd=nothing,
        msd_bound=at.bound,
        spectral_radius=nan,
        status=status,
        reason=reason,
        starts=(),
        best_start=at.rule,
        history=np.zeros(0),
        change=0.0,
        residual=nan,
        evaluations=0,
        converged=False,
        interrupted=False,
        certificate=None,
        elsewhere=(),
        about=at.words,
    )
