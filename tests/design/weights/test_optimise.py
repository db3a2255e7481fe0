"""The front door: never worse than its starts, as good as an independent optimiser, admissible whatever is asked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy import ndarray
from scipy.linalg import block_diag, solve_discrete_lyapunov
from scipy.optimize import minimize
from tests.reference import naive_performance as naive

from tolnet import analysis, design
from tolnet.analysis.curvature import columns_of
from tolnet.analysis.msd_gradient import NetworkErrors
from tolnet.design.weights.admissible import Admissible
from tolnet.design.weights.intersection import intersect_covariances
from tolnet.design.weights.setting import folded
from tolnet.design.weights.topology import add_links
from tolnet.model import (
    DIFFUSION_RULES,
    Ambiguity,
    Diffusion,
    InputError,
    SensorNetwork,
    Status,
    ToleranceTable,
    UnsupportedError,
)
from tolnet.model.examples import projectile


@pytest.fixture(scope="module")
def small() -> tuple[SensorNetwork, ToleranceTable]:
    """Six nodes that see the projectile, on nine links."""
    network = projectile(4, nodes=6, links=9)
    return network, design.choose_tolerances(network, 0.02)


@pytest.fixture(scope="module")
def best(small: tuple[SensorNetwork, ToleranceTable]) -> Diffusion:
    return design.optimise_diffusion(*small)


def evaluated(network: SensorNetwork, table: ToleranceTable, W) -> ndarray:
    """MSD_k of W, by the solver of performance."""
    worst = analysis.least_favourable_model(network, table.central)
    return analysis.solve_lyapunov(analysis.error_dynamics(network, table.local, W, worst)).node_msd


def check_admissible(found: Diffusion) -> ndarray:
    W = found.W.toarray()
    assert (W >= 0).all()
    assert not W[~found.table.network.adjacency.toarray()].any()
    np.testing.assert_allclose(W.sum(axis=0), 1, atol=4e-16 * len(W))
    return W


def independent(errors: NetworkErrors, a: ndarray, restarts: int, *, gains: bool = False, sent: float = 0.0) -> float:
    """The best of L-BFGS-B searches in softmax coordinates, from random weights."""
    columns, L = errors.columns, len(errors.columns.sender)

    def value(u: ndarray) -> tuple[float, ndarray]:
        e = np.exp(u[:L] - columns.spread(u[:L], -np.inf).max(axis=1)[columns.hearer])
        w = e / columns.sums(e)[columns.hearer]
        at = errors.solve(np.concatenate([w, u[L:]]))
        if not np.isfinite(at.node_msd).all():
            return 1e3, np.zeros_like(u)
        g, _ = errors.gradient(at, a, sent * a, gains=gains)
        slope = w * (g[:L] - columns.sums(w * g[:L])[columns.hearer])
        return float(a @ at.node_msd + sent * a @ errors.sent_msd(at)), np.concatenate([slope, g[L:]])

    best = np.inf
    for restart in range(restarts):
        rng = np.random.default_rng(restart)
        u = rng.normal(size=L) * 1.5
        if gains:
            u = np.concatenate([u, errors.gains * np.exp(0.2 * rng.normal(size=errors.gains.shape))])
        options = {"maxiter": 400, "maxfun": 1000, "ftol": 1e-12}
        best = min(best, minimize(value, u, jac=True, method="L-BFGS-B", options=options).fun)
    return best


def test_it_is_admissible_better_than_every_start_and_what_it_says(small, best: Diffusion):
    network, table = small
    W = check_admissible(best)
    drawn = {f"random-{number}" for number in (1, 2, 3, 4)}
    assert {start.name for start in best.starts} == {*DIFFUSION_RULES, "decay", "mixing", "combination", *drawn}
    for start in best.starts:
        assert best.value <= start.value
        if start.name in DIFFUSION_RULES:
            rule = evaluated(network, table, design.diffusion_matrix(network, start.name, table))
            assert start.value == pytest.approx(rule.mean(), rel=1e-9)
    np.testing.assert_allclose(evaluated(network, table, best.W), best.node_msd, rtol=1e-12)
    assert best.value == pytest.approx(best.node_msd.mean(), rel=1e-12)
    assert best.bound < best.value < best.baseline
    assert best.gap_closed == (best.baseline - best.value) / (best.baseline - best.bound)
    assert (np.diff(best.history) <= 0).all()
    assert abs(best.change) < 1e-9
    assert best.residual < 1e-9
    assert best.converged
    assert not best.interrupted
    rng = np.random.default_rng(0)
    mask = network.adjacency.toarray()
    for _ in range(20):  # neighbours of W are no better
        other = W * np.exp(0.05 * rng.normal(size=W.shape)) + 0.01 * rng.random(W.shape) * mask
        assert evaluated(network, table, other / other.sum(axis=0)).mean() > best.value


@pytest.mark.parametrize(("seed", "rule", "optimised", "bound"), [
    (0, -0.88, -1.46, -2.55), pytest.param(1, -0.23, -0.66, -1.71, marks=pytest.mark.study),
])  # fmt: skip
def test_projectile_networks_against_an_independent_optimiser(seed: int, rule: float, optimised: float, bound: float):
    """A small version of the study in notebook 05; decibels from a plain gradient method in NumPy."""
    network = projectile(seed)
    table = design.choose_tolerances(network, 0.02)
    found = design.optimise_diffusion(network, table)
    in_db = 10 * np.log10([found.baseline, found.value, found.bound])
    np.testing.assert_allclose(in_db, [rule, optimised, bound], atol=0.006)
    errors = NetworkErrors(network, table.local, analysis.least_favourable_model(network, table.central))
    assert found.value <= 1.005 * independent(errors, np.full(20, 0.05), 1)


def test_gains_close_more_of_the_gap_and_are_what_is_deployed(
    small, best: Diffusion, monkeypatch: pytest.MonkeyPatch
):
    network, table = small
    monkeypatch.setattr("tolnet.design.weights.search._RANDOM_WITH_GAINS", 0)
    monkeypatch.setattr("tolnet.design.weights.search._STEPS_WITH_GAINS", 100)
    found = design.optimise_diffusion(network, table, with_gains=True)
    check_admissible(found)
    assert found.bound < found.value < best.value
    assert found.gains is not None
    model = analysis.least_favourable_model(network, table.central)
    F, G = written_out(network, table, found)
    Q = solve_discrete_lyapunov(F, G @ G.T)
    msd = np.diagonal(Q).reshape(-1, network.n).sum(axis=1)
    np.testing.assert_allclose(found.node_msd, msd[:-1], rtol=1e-8)
    assert msd[-1] == pytest.approx(np.trace(model.error_covariance), rel=1e-8)
    assert found.spectral_radius == pytest.approx(np.abs(np.linalg.eigvals(F)).max(), rel=1e-6)
    assert [there.name for there in found.elsewhere] == ["nominal", "half of c", "twice c"]
    assert all(there.bound < there.msd for there in found.elsewhere)
    errors, a = NetworkErrors(network, table.local, model), np.full(network.N, 1 / network.N)
    sent = 1e-3  # what the errors of what is sent count
    assert found.value <= 1.005 * independent(errors, a, 1, gains=True, sent=sent)


@pytest.mark.study
@pytest.mark.parametrize("asked", [{"constraints": design.Constraints(max_neighbours=2)}, {"objective": "robust"}])
def test_gains_with_few_neighbours_and_over_scenarios(small, asked: dict[str, Any], monkeypatch: pytest.MonkeyPatch):
    network, table = small
    monkeypatch.setattr("tolnet.design.weights.search._RANDOM_WITH_GAINS", 1)
    monkeypatch.setattr("tolnet.design.weights.search._STEPS_WITH_GAINS", 30)
    tables = [table, design.choose_tolerances(network, 0.05)] if "objective" in asked else [table]
    more: dict[str, Any] = {"scenarios": tables} if "objective" in asked else {}
    alone = design.optimise_diffusion(network, table, **asked, **more)
    found = design.optimise_diffusion(network, table, with_gains=True, **asked, **more)
    W = check_admissible(found)
    assert found.value < alone.value
    assert found.gains is not None
    if "constraints" in asked:
        assert ((W > 0).sum(axis=0) <= 2).all()
    each = []
    for scenario in tables:  # the same gains under both least favourable models
        F, G = written_out(network, scenario, found)
        each.append(np.diagonal(solve_discrete_lyapunov(F, G @ G.T)).reshape(-1, network.n).sum(axis=1)[:-1])
    np.testing.assert_allclose(found.node_msd, each[0], rtol=1e-8)
    assert found.value == pytest.approx(max(msd.mean() for msd in each), rel=1e-8)


@pytest.mark.study
def test_gains_of_a_lost_link_wait_for_its_return(small, monkeypatch: pytest.MonkeyPatch):
    network, table = small
    monkeypatch.setattr("tolnet.design.weights.search._RANDOM_WITH_GAINS", 0)
    monkeypatch.setattr("tolnet.design.weights.search._STEPS_WITH_GAINS", 30)
    lost = a_link_less(network)
    tables = [lost, table]
    alone = design.optimise_diffusion(network, table, "robust", scenarios=tables)
    found = design.optimise_diffusion(network, table, "robust", scenarios=tables, with_gains=True)
    check_admissible(found)
    assert found.value < alone.value
    assert found.gains is not None
    missing = network.adjacency.astype(int) - lost.network.adjacency.astype(int)
    gains, each = found.gains.gains.copy(), []
    for k, l in np.argwhere(missing.toarray()).tolist():
        place = int(np.flatnonzero(network.neighbours(k) == l)[0]) + found.gains.offsets[k]
        own = slice(*found.gains.columns[[place, place + 1]])
        assert gains[own].any()  # they are deployed
        gains[own] = 0.0
    without = replace(found, gains=replace(found.gains, gains=gains), W=folded(found.W, lost.network))
    for scenario, deployed in ((lost, without), (table, found)):
        F, G = written_out(network, scenario, deployed)
        each.append(np.diagonal(solve_discrete_lyapunov(F, G @ G.T)).reshape(-1, network.n).sum(axis=1)[:-1])
    np.testing.assert_allclose(found.node_msd, each[1], rtol=1e-8)
    assert found.value == pytest.approx(max(msd.mean() for msd in each), rel=1e-8)


def a_link_less(network: SensorNetwork) -> ToleranceTable:
    """The table without the first link that is not needed."""
    shorter = [network.relinked(np.delete(network.links, i, axis=0)) for i in range(len(network.links))]
    return next(t for t in (design.choose_tolerances(other, 0.02) for other in shorter) if t.ok)


def written_out(network: SensorNetwork, table: ToleranceTable, found: Diffusion) -> tuple[ndarray, ndarray]:
    """F and G of eqs. (35)-(37) for any gains, from the stacked least favourable model."""
    assert found.gains is not None
    stacked = naive.stacked(network)
    central = table.central
    at = naive.steady_model(stacked, central.V, float(central.theta))
    N, n, m = network.N, network.n, stacked.B.shape[1]
    loops, sensed = [], np.zeros((N * n, len(stacked.C)))
    for k in range(N):
        rows = np.concatenate([np.arange(*network.rows[[l, l + 1]]) for l in network.neighbours(k)])
        G_k = found.gains.gain(k)
        loops.append(network.A - G_k @ stacked.C[rows])
        sensed[k * n : (k + 1) * n, rows] = G_k @ stacked.D[rows][:, rows]
    mix = np.kron(found.W.toarray().T, np.eye(n))
    driven = np.kron(np.ones((N, 1)), stacked.B)
    return naive._assemble(stacked, at, mix @ block_diag(*loops), mix @ sensed, driven, m)


def test_the_worst_node_and_chosen_nodes(small, best: Diffusion):
    network, table = small
    worst = design.optimise_diffusion(network, table, "worst")
    check_admissible(worst)
    assert worst.value == pytest.approx(worst.node_msd.max(), rel=1e-12)
    assert worst.value < best.node_msd.max()
    assert worst.bound == best.bound
    one = design.optimise_diffusion(network, table, nodes=np.eye(6)[2])
    assert one.value == pytest.approx(one.node_msd[2], rel=1e-12)
    assert one.value <= best.node_msd[2] * (1 + 1e-6)


def test_scenarios(small, best: Diffusion):
    network, table = small
    lost = a_link_less(network)
    tables = [table, design.choose_tolerances(network, 0.04), lost]
    found = design.optimise_diffusion(network, table, "robust", scenarios=tables)
    check_admissible(found)
    each = [evaluated(t.network, t, folded(found.W, t.network)).mean() for t in tables]
    assert found.value == pytest.approx(max(each), rel=1e-9)
    others = [evaluated(t.network, t, folded(best.W, t.network)).mean() for t in tables]
    assert found.value <= max(others) * (1 + 1e-6)


@pytest.mark.study
def test_symmetric_weights_and_ipopt_as_a_second_opinion(small, best: Diffusion):
    network, table = small
    other = design.optimise_diffusion(network, table, method="ipopt")
    check_admissible(other)
    assert other.value == pytest.approx(best.value, rel=3e-3)
    symmetric = design.optimise_diffusion(
        network, table, constraints=design.Constraints(symmetric=True, own_weight=0.1)
    )
    W = check_admissible(symmetric)
    np.testing.assert_allclose(W, W.T, atol=1e-16)
    assert W.diagonal().min() >= 0.1 - 1e-9
    for rule in ("metropolis", "laplacian"):
        if design.diffusion_matrix(network, rule).diagonal().min() >= 0.1:
            assert symmetric.value <= evaluated(network, table, design.diffusion_matrix(network, rule)).mean()


def test_bounds_on_own_weights_and_on_neighbours(small, best: Diffusion):
    network, table = small
    own = np.linspace(0, 0.5, 6)
    bounded = design.optimise_diffusion(network, table, constraints=design.Constraints(own_weight=own))
    assert (check_admissible(bounded).diagonal() >= own - 1e-12).all()
    alone = design.optimise_diffusion(network, table, constraints=design.Constraints(own_weight=1.0))
    np.testing.assert_array_equal(alone.W.toarray(), np.eye(6))
    values = []
    for d in (1, 2, 6):
        few = design.optimise_diffusion(network, table, constraints=design.Constraints(max_neighbours=d))
        assert ((check_admissible(few) > 0).sum(axis=0) <= d).all()
        values.append(few.value)
    # Two neighbours are all that the best weights use here, so that both searches end near one optimum; each ends
    # where a step gains less than a millionth.
    assert values[0] > values[1] > (1 - 1e-5) * values[2]
    assert values[2] == best.value


def test_an_interrupt_keeps_the_best_so_far(small, best: Diffusion):
    network, table = small
    ways: list[dict[str, Any]] = [{}, {"constraints": design.Constraints(max_neighbours=2)}, {"objective": "decay"}]
    for asked in ways:
        calls = []

        def stop(what: str, value: float, calls: list[float] = calls) -> None:
            calls.append(value)
            if len(calls) == 2:
                raise KeyboardInterrupt

        found = design.optimise_diffusion(network, table, watch=stop, **asked)
        assert found.interrupted
        check_admissible(found)
        assert found.value <= min(start.value for start in found.starts) * (1 + 1e-4)


@pytest.mark.parametrize(
    "asked",
    [
        {},
        {"with_gains": True},
        {"objective": "worst"},
        {"constraints": design.Constraints(symmetric=True)},
        {"constraints": design.Constraints(max_neighbours=2)},
        {"method": "ipopt"},
    ],
)
def test_an_interrupt_before_the_search_leaves_the_best_start(
    small, asked: dict[str, Any], monkeypatch: pytest.MonkeyPatch
):
    network, table = small

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tolnet.design.weights.starts.design_mixing", stop)
    found = design.optimise_diffusion(network, table, **asked)
    assert found.interrupted
    check_admissible(found)
    assert {start.name for start in found.starts} == {*DIFFUSION_RULES, "decay"}
    assert found.value == pytest.approx(min(start.value for start in found.starts), rel=1e-9)
    assert all(np.isnan(start.found) for start in found.starts)


@pytest.mark.study
def test_links_are_ranked_by_the_optimised_msd(small, best: Diffusion):
    network, _ = small
    found = add_links(network, Ambiguity(0.02), best.W.toarray(), 2)
    assert len({added.link for added in found}) == 2
    assert best.value > found[0].msd > found[1].msd
    assert all(msd >= found[0].msd for _, msd in found[0].runners_up)
    longer = network.relinked(np.concatenate([network.links, [found[0].link]]))
    again = design.optimise_diffusion(longer, design.choose_tolerances(longer, 0.02))
    assert again.value == pytest.approx(found[0].msd, rel=5e-3)
    with pytest.raises(InputError, match="the graph lacks"):
        add_links(network, Ambiguity(0.02), best.W.toarray(), 7)


def test_covariance_intersection_is_optimal_column_by_column(small):
    network, table = small
    W = design.diffusion_matrix(network, "covariance-intersection", table).toarray()
    V = table.local.V
    for k in range(network.N):
        heard = network.neighbours(k)
        information = np.linalg.inv(V[heard])

        def trace(w: ndarray, information: ndarray = information) -> float:
            return float(np.trace(np.linalg.inv(np.einsum("l,lij->ij", w, information))))

        best = minimize(
            trace,
            np.full(len(heard), 1 / len(heard)),
            method="SLSQP",
            bounds=[(0, 1)] * len(heard),
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1},
            options={"ftol": 1e-14, "maxiter": 300},
        ).fun
        assert trace(W[heard, k]) <= best * (1 + 1e-7)
    assert intersect_covariances is not None
    relative = design.diffusion_matrix(network, "relative-variance", table).toarray()
    heard = network.neighbours(0)
    precision = 1 / np.trace(V, axis1=1, axis2=2)[heard]
    np.testing.assert_allclose(relative[heard, 0], precision / precision.sum(), rtol=1e-12)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (
            {"constraints": design.Constraints(own_weight=1.2)},
            "own_weight is 1.2 at node 0: no column sums to one beyond 1",
        ),
        ({"constraints": design.Constraints(own_weight=-0.1)}, "own_weight"),
        ({"constraints": design.Constraints(max_neighbours=0)}, "max_neighbours is 0; at least 1"),
        ({"nodes": np.zeros(6)}, "not all of them 0"),
        ({"nodes": np.ones(6), "objective": "worst"}, "weighs no nodes"),
        ({"with_gains": True, "objective": "decay"}, "with_gains cannot be combined"),
        ({"constraints": design.Constraints(max_neighbours=2), "objective": "mixing"}, "max_neighbours cannot"),
        ({"constraints": design.Constraints(symmetric=True), "method": "quasi-newton"}, "need 'ipopt'"),
        ({"method": "sdp"}, "method is 'sdp', which cannot be had for the objective 'msd'"),
        ({"method": "ipopt", "objective": "decay"}, "method is 'ipopt', which cannot be had"),
    ],
)
def test_what_nothing_satisfies_is_refused(small, asked: dict, said: str):
    with pytest.raises(InputError, match=said):
        design.optimise_diffusion(*small, **asked)


def test_unknown_words_and_other_divergences_are_refused(small):
    network, table = small
    with pytest.raises(UnsupportedError, match="objective is 'best'"):
        design.optimise_diffusion(network, table, "best")
    tau = design.choose_tolerances(network, Ambiguity(0.02, tau=0.5), uniform=True)
    with pytest.raises(UnsupportedError, match="tau = 0 only"):
        design.optimise_diffusion(network, tau)


def test_a_network_without_performance_keeps_its_weights_and_says_why():
    network = SensorNetwork(
        A=[[1.1, 0.0], [0.0, 0.5]],
        B=0.1 * np.eye(2),
        C=[[[1.0, 0.0]], [[0.0, 1.0]], [[0.0, 1.0]]],
        R=np.full((3, 1, 1), 0.1),
        edges=[[0, 1]],
    )
    table = design.choose_tolerances(network, 0.01)
    for objective in ("msd", "decay"):
        found = design.optimise_diffusion(network, table, objective)
        assert found.status == Status.UNDETECTABLE
        assert "node 2" in found.reason
        assert np.isnan(found.value)
        check_admissible(found)


def test_nodes_whose_weights_do_not_matter():
    """Two nodes with the same sensor on one link, and a third alone: curvature is rounding, and steps are huge."""
    one = np.ones((3, 1, 1))
    network = SensorNetwork(A=[[0.9]], B=[[1.0]], C=one, R=one, edges=[[0, 1]])
    table = design.choose_tolerances(network, 0.02)
    for with_gains in (False, True):
        found = design.optimise_diffusion(network, table, with_gains=with_gains)
        check_admissible(found)
        assert found.bound < found.value <= found.baseline * (1 + 1e-12)


@pytest.mark.parametrize("size", [1e-20, 1.0, 1e20])
def test_projections_keep_their_sums(size: float):
    network = projectile(4, nodes=6, links=9)
    columns, rng = columns_of(network.adjacency), np.random.default_rng(0)
    lower = np.array([0.0, 0.5, 1.0, 0.0, 1.0, 0.2])
    among = Admissible.of(columns, design.Constraints(own_weight=lower))
    v = size * rng.normal(size=len(columns.sender))
    w = among.project(v)
    np.testing.assert_allclose(columns.sums(w), 1, rtol=1e-15)
    assert w.min() >= 0
    assert (w[columns.own] >= lower).all()
    for other in rng.dirichlet(np.ones(len(w)), 50):  # v - w makes an obtuse angle with every admissible step
        step = among.project(other) - w
        assert (v - w) @ step <= 1e-14 * max(size, 1.0)


def test_one_node_alone():
    network = SensorNetwork(A=[[0.9]], B=[[1.0]], C=[[[1.0]]], R=[[[1.0]]], edges=[])
    found = design.optimise_diffusion(network, design.choose_tolerances(network, 0.02))
    assert found.W.toarray().tolist() == [[1.0]]
    assert found.value == pytest.approx(found.bound, rel=1e-9)
