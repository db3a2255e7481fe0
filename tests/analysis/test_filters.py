"""The six filters: against the printed recursions, the published order, and each other."""

import numpy as np
import pytest
from tests.instances import ring_projectile
from tests.instances_random import random_network
from tests.reference import determinants, naive_performance, recursion

from tolnet import model
from tolnet.analysis.filters import evaluate_filters, follow_filters
from tolnet.analysis.simulation import simulate_filters
from tolnet.design import choose_tolerances, diffusion_matrix
from tolnet.model import SensorNetwork, UnsupportedError
from tolnet.model.history import FILTERS


def naive_history(
    network: SensorNetwork, W: np.ndarray, c: float, name: str, T: int
) -> tuple[np.ndarray, np.ndarray]:
    """MSD_{k,t} and c_{k,t} of one filter by eqs. (4), (30), (34)-(40) as printed, with explicit inverses."""
    stacked, kind, n = naive_performance.stacked(network), FILTERS[name], network.n
    A, Q, V0 = network.A, network.Q, network.initial_covariance
    S_tot = determinants.information(stacked.C, stacked.R)
    V, theta = [V0], []
    for _ in range(T):
        _, at, following = recursion.step(A, Q, S_tot, c, V[-1])
        V.append(following)
        theta.append(at)
    backward, models = np.zeros((n, n)), []
    for t in reversed(range(T)):
        models.append(naive_performance.backward_step(stacked, V[t], theta[t], backward))
        backward = models[-1].inverse_Omega
    models.reverse()
    heard = [determinants.stacked(network, determinants.hears(network, k)) for k in range(network.N)]
    S = [S_tot] if kind.centralised else [determinants.information(*pair) for pair in heard]
    table = choose_tolerances(network, c)
    local, tolerances, msd = [V0] * len(S), [], []
    covariance = np.kron(np.ones((len(S) + 1, len(S) + 1)), V0)
    for t in range(T + 1):
        msd.append([np.trace(covariance[k * n : (k + 1) * n, k * n : (k + 1) * n]) for k in range(len(S))])
        if t == T:
            break
        if kind.centralised:
            F, G = naive_performance.central_dynamics(network, local[0], models[t])
        else:
            F, G = naive_performance.dynamics(network, local, W, models[t])
        covariance = F @ covariance @ F.T + G @ G.T
        c_now = {
            "none": lambda k: 0.0,
            "c": lambda k: c,
            "c_k": lambda k: float(table.local.tolerance[k]),
            "c_k,t": lambda k, t=t: determinants.local_tolerance(
                A, Q, stacked.C, stacked.R, heard[k][0], heard[k][1], V[t], V[t + 1]
            ),
        }[kind.ball]
        tolerances.append([c_now(k) for k in range(len(S))])
        local = [recursion.step(A, Q, S[k], tolerances[-1][k], local[k])[2] for k in range(len(S))]
    return np.array(msd), np.array(tolerances)


@pytest.mark.parametrize("name", FILTERS)
def test_history_is_the_printed_recursion(name):
    rng = np.random.default_rng(4)
    network = random_network(rng, 3, 5)
    W = diffusion_matrix(network)
    history = follow_filters(choose_tolerances(network, 0.02), W, 12, filters=[name])[name]
    msd, tolerances = naive_history(network, W.toarray(), 0.02, name, 12)
    np.testing.assert_allclose(history.node_msd, msd, rtol=1e-8)
    np.testing.assert_allclose(history.tolerance, tolerances, rtol=1e-7, atol=1e-14)


@pytest.mark.parametrize(
    ("c", "decibels"),
    [
        (0.02, {"KFC": -2.5306, "RKFC": -3.0745, "KFD": -0.8609, "RKFDU": -1.8217, "RKFDNU": -1.8344}),
        (0.06, {"KFC": 0.4638, "RKFC": -0.4384, "KFD": 2.1003, "RKFDU": 0.6834, "RKFDNU": 0.6591}),
    ],
)
def test_reference_numbers(c, decibels):
    network = ring_projectile()
    found = evaluate_filters(choose_tolerances(network, c), diffusion_matrix(network))
    assert {name: round(found[name].msd_db, 4) for name in decibels} == decibels
    radius = {0.02: 0.9595, 0.06: 0.9643}[c]
    assert round(found["RKFDU"].spectral_radius, 4) == radius


@pytest.mark.parametrize("c", [0.02, 0.06])
@pytest.mark.parametrize("links", [37, 68])
def test_published_order_on_projectile_networks(c, links):
    from tolnet.model.examples import projectile

    network = projectile(links=links)
    found = evaluate_filters(choose_tolerances(network, c), diffusion_matrix(network))
    assert found["KFD"].msd > found["RKFDU"].msd > found["RKFDNU"].msd > found["RKFC"].msd
    assert found["RKFDNU"].msd == found["RKFDNU2"].msd


def test_with_everybody_connected_the_distributed_filter_is_the_central_one():
    network = random_network(np.random.default_rng(1), 3, 6, degree=1e9)
    found = evaluate_filters(choose_tolerances(network, 0.05), diffusion_matrix(network))
    np.testing.assert_allclose(found["RKFDNU"].node_msd, found["RKFC"].msd, rtol=1e-9)
    np.testing.assert_allclose(found["KFD"].node_msd, found["KFC"].msd, rtol=1e-9)


def test_histories_reach_the_plateau_of_the_steady_state():
    network = ring_projectile()
    table, W = choose_tolerances(network, 0.02), diffusion_matrix(network)
    steady = evaluate_filters(table, W, filters=["RKFDNU", "RKFDNU2"])
    histories = follow_filters(table, W, 240, filters=["RKFDNU", "RKFDNU2"])
    for name, history in histories.items():
        assert history.msd_db[150] == pytest.approx(steady[name].msd_db, abs=2e-3)
    assert histories["RKFDNU"].msd_db[60] == pytest.approx(histories["RKFDNU2"].msd_db[60], abs=5e-3)
    assert histories["RKFDNU"].theta[190] == pytest.approx(table.local.theta, rel=1e-3)


@pytest.mark.slow
def test_an_oscillating_filter_still_has_a_history():
    network = random_network(np.random.default_rng(31), 4, 8, radius=1.02, relays=0.9)
    table, W = choose_tolerances(network, 1.0), diffusion_matrix(network)
    assert table.central.status == "oscillates"
    assert evaluate_filters(table, W, filters=["RKFC"])["RKFC"].status != "ok"
    for name, history in follow_filters(table, W, 6).items():
        msd, _ = naive_history(network, W.toarray(), 1.0, name, 6)
        np.testing.assert_allclose(history.node_msd, msd, rtol=1e-7)


def test_unknown_filter_is_named():
    network = ring_projectile()
    with pytest.raises(UnsupportedError, match=r"no filter 'EKF'.*RKFDNU2"):
        evaluate_filters(choose_tolerances(network, 0.02), diffusion_matrix(network), filters=["EKF"])


def test_tau_is_refused():
    network = ring_projectile()
    table = choose_tolerances(network, model.Ambiguity(0.02, tau=0.5), uniform=True)
    with pytest.raises(UnsupportedError, match="tau"):
        evaluate_filters(table, diffusion_matrix(network))


def test_without_a_tolerance_a_filter_has_no_history_while_the_others_have():
    network = SensorNetwork(A=np.diag([1.0, 0.5]), B=[[0.0], [1.0]], C=np.ones((1, 1, 2)), R=[[[1.0]]], edges=[])
    table, W = choose_tolerances(network, 0.01), diffusion_matrix(network)
    assert np.isnan(table.local.tolerance).all()
    histories, simulated = follow_filters(table, W, 5), simulate_filters(table, W, runs=60, steps=4)
    for found in (histories, simulated):
        assert {name for name, each in found.items() if each.status != "ok"} == {"RKFDNU2"}
        assert found["RKFDNU2"].status == "unstabilisable"
        assert "no c_k" in found["RKFDNU2"].reason
    assert np.isnan(histories["RKFDNU2"].msd).all()
    assert np.isnan(simulated["RKFDNU2"].mse).all()
    for name in set(histories) - {"RKFDNU2"}:
        assert np.isfinite(histories[name].msd).all()
        assert np.isfinite(simulated[name].mse).all()
