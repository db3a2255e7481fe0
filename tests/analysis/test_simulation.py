"""Monte Carlo against the covariances: two roads that share nothing but the gains."""

import numpy as np
import pytest
from tests.instances import ring_projectile
from tests.instances_random import random_network

from tolnet.analysis import least_favourable_model, simulate_least_favourable, simulation
from tolnet.analysis.simulation import simulate_filters
from tolnet.design import choose_tolerances, diffusion_matrix
from tolnet.model import SensorNetwork


@pytest.mark.parametrize("instance", ["ring", "directed"])
def test_errors_lie_where_the_covariances_say(instance):
    """The largest of the z-scores of 6 filters at 4 instants stays below what chance allows once in 10^4."""
    network = ring_projectile()
    if instance == "directed":
        network = random_network(np.random.default_rng(2), 3, 6, directed=True, drives=2)
    found = simulate_filters(
        choose_tolerances(network, 0.05), diffusion_matrix(network), runs=1000, steps=30, seed=11
    )
    assert len(found) == 6
    for result in found.values():
        at = [1, 5, 15, 30]
        z = (result.mse[at] - result.bound[at]) / result.standard_error[at]
        assert np.abs(z).max() < 4.5
        assert result.diverged == 0
        assert result.consistency[0] == pytest.approx(0.95, abs=0.03)


def test_robust_filters_promise_less_and_keep_it():
    network = ring_projectile()
    found = simulate_filters(choose_tolerances(network, 0.06), diffusion_matrix(network), runs=400, steps=40)
    assert found["RKFDU"].consistency[-1] > found["KFD"].consistency[-1]
    assert found["RKFC"].consistency[-1] > found["KFC"].consistency[-1]


def test_the_answer_does_not_depend_on_the_workers_but_on_the_seed():
    network = ring_projectile()
    table, W = choose_tolerances(network, 0.02), diffusion_matrix(network)

    def run(**more):
        return simulate_filters(table, W, runs=130, steps=3, filters=["RKFDNU2"], **more)["RKFDNU2"]

    one = run()
    np.testing.assert_array_equal(one.node_mse, run(workers=2).node_mse)
    np.testing.assert_array_equal(one.standard_error, run(workers=2).standard_error)
    assert not np.array_equal(one.node_mse, run(seed=1).node_mse)
    assert one.runs == 130


def test_progress_counts_runs():
    network, seen = ring_projectile(), []
    table, W = choose_tolerances(network, 0.02), diffusion_matrix(network)
    simulate_filters(table, W, runs=120, steps=2, filters=["KFC"], progress=lambda *at: seen.append(at))
    assert seen == [(50, 120), (100, 120), (120, 120)]


def test_runs_that_leave_the_range_of_doubles_are_counted_apart(monkeypatch):
    network = ring_projectile()
    table, W = choose_tolerances(network, 0.02), diffusion_matrix(network)
    honest = simulation.disturb

    def spoilt(model, rng, *, runs):
        for t, at in enumerate(honest(model, rng, runs=runs)):
            at.output[0] += 1e300 * (t == 1)
            yield at

    monkeypatch.setattr(simulation, "disturb", spoilt)
    found = simulate_filters(table, W, runs=100, steps=3, filters=["KFC"])["KFC"]
    assert found.diverged == 2
    assert found.mse[-1] == pytest.approx(found.bound[-1], rel=0.5)


@pytest.mark.slow
def test_the_errors_of_an_unstable_plant_keep_their_digits():
    """rho(A) = 1.2: after 400 steps the state is 1e31 and more, the error as large as ever."""
    network = SensorNetwork(
        A=[[1.2, 0.1], [0.0, 1.1]], Q=np.eye(2), C=[[[1.0, 0.0]], [[0.0, 1.0]]], R=[[[1.0]]] * 2, edges=[[0, 1]]
    )
    found = simulate_filters(choose_tolerances(network, 0.01), diffusion_matrix(network), runs=300, steps=400)
    for result in found.values():
        z = (result.mse[[40, 200, 400]] - result.bound[[40, 200, 400]]) / result.standard_error[[40, 200, 400]]
        assert np.abs(z).max() < 4.5
        assert result.diverged == 0


def test_a_moving_origin_changes_no_error():
    """One filter by hand on the states and outputs themselves, on the same draws."""
    network = ring_projectile()
    table, W = choose_tolerances(network, 0.02), diffusion_matrix(network)
    runs, steps = 50, 12
    found = simulate_filters(table, W, runs=runs, steps=steps, filters=["RKFDNU2"], seed=3)["RKFDNU2"]
    model = least_favourable_model(network, table.central, steps + 1)
    child = np.random.SeedSequence(3).spawn(1)[0]
    drawn = simulate_least_favourable(model, np.random.default_rng(child), runs=runs)
    schedule = simulation._schedule(table, W, simulation.kinds(["RKFDNU2"])[0], steps)
    weights = simulation._output_weights(network)
    K, n = schedule.AZ.shape[1], network.n
    estimate = np.broadcast_to(network.initial_mean, (K, runs, n))
    for t in range(steps + 1):
        error = drawn.x[t] - estimate
        np.testing.assert_allclose((error**2).sum(axis=2).mean(axis=1), found.node_mse[t], rtol=1e-9)
        if t == steps:
            break
        each = [drawn.y[t][:, rows] @ weights[rows] for rows in _rows(network)]
        heard = schedule.side.heard.toarray()
        sensed = np.einsum("kl,lrn->krn", heard, np.array(each))
        innovation = sensed - estimate @ schedule.side.S
        psi = estimate @ network.A.T + innovation @ schedule.AZ[t].mT
        psi = psi + (0.0 if network.input is None else network.input)
        estimate = np.einsum("kl,lrn->krn", schedule.side.mixing.toarray(), psi)


def _rows(network):
    return [slice(network.rows[k], network.rows[k + 1]) for k in range(network.N)]


@pytest.mark.parametrize("bad", [{"runs": 1, "steps": 3}, {"runs": 5, "steps": 0}])
def test_too_few_runs_or_steps(bad):
    network = ring_projectile()
    with pytest.raises(ValueError, match="at least 2 runs of 1 step"):
        simulate_filters(choose_tolerances(network, 0.02), diffusion_matrix(network), **bad)
