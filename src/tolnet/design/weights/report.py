"""From what a search found to what is reported: the last step, and everything recomputed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.analysis import error_dynamics, least_favourable_model, solve_lyapunov, solve_steady_state
from tolnet.analysis.msd_gradient import NetworkErrors
from tolnet.design.weights.admissible import make_admissible
from tolnet.design.weights.gains import pack_gains
from tolnet.design.weights.msd import Criterion, MsdObjective
from tolnet.design.weights.search import Search
from tolnet.design.weights.setting import Setting, links_of
from tolnet.model import Diffusion, Elsewhere, Start, Status, ToleranceTable

_ELSEWHERE = (("nominal", 0.0), ("half of c", 0.5), ("twice c", 2.0))


def tell_msd(
    at: Setting,
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
    W = make_admissible(at.among, found.z[:L], symmetric=at.constraints.symmetric)
    before = [at.performance(at.baseline, table) for table in tables]
    baseline = criterion(np.array([each.node_msd for each in before]))
    first = tables.index(at.table) if at.table in tables else 0
    gains, errors = None, problem.scenarios[0]
    if problem.gains and len(found.z) > L:
        z = np.concatenate([links_of(W, columns), found.z[L:]])
        errors, each = problem.scenarios[first], [scenario.solve(z) for scenario in problem.scenarios]
        own = error_dynamics(at.network, at.table.local, at.baseline, at.model)
        gains = pack_gains(at.network, own, errors, z)
        node_msd, residual = each[first].node_msd, max(solved.residual for solved in each)
        radius = max(solved.radius for solved in each)
        value = criterion(np.array([solved.node_msd for solved in each]))
        status, reason = errors.status, errors.reason
    else:
        z = links_of(W, columns)
        after = [at.performance(W, each) for each in tables]
        value = criterion(np.array([each.node_msd for each in after]))
        node_msd, radius = after[first].node_msd, max(each.network_radius for each in after)
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
        network_radius=radius,
        least_favourable_radius=max(each.least_favourable_radius for each in before),
        baseline_network_radius=max(each.network_radius for each in before),
        status=status,
        reason=reason,
        starts=tuple(found.starts),
        best_start=found.best_start,
        history=np.array(found.history),
        change=float(value / found.value - 1) if found.value else 0.0,
        residual=residual,
        evaluations=found.evaluations,
        converged=found.converged,
        interrupted=found.interrupted,
        certificate=None,
        elsewhere=tuple(_elsewhere(at, W, errors, z)),
        about=at.words,
    )


def _elsewhere(
    at: Setting, W: sparse.csr_array, errors: NetworkErrors, z: Float[ndarray, " z"]
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


def tell_other(
    at: Setting,
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
        network_radius=after.network_radius,
        least_favourable_radius=after.least_favourable_radius,
        baseline_network_radius=before.network_radius,
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


def without_performance(at: Setting, objective: str, status: Status, reason: str) -> Diffusion:
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
        network_radius=nan,
        least_favourable_radius=nan,
        baseline_network_radius=nan,
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
