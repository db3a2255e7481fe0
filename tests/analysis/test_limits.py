"""How large a tolerance may be: closed forms, bisection with the naive oracles, and the published bound."""

from __future__ import annotations

from math import inf, log

import numpy as np
import pytest
from numpy import ndarray
from tests.instances_random import poorly_informed, random_network
from tests.reference import determinants, fifty_digits, maxtol, recursion, steady_state

from tolnet import analysis
from tolnet.model import SensorNetwork, ToleranceLimits


def scalar_network(A: float, S: float) -> SensorNetwork:
    """One node, one state, Q = 1."""
    C, R = ([[1.0]], [[1 / S]]) if S else ([], [])
    return SensorNetwork(A=[[A]], Q=[[1.0]], C=[C], R=[R], edges=[])


def centre_of(network: SensorNetwork) -> ToleranceLimits:
    """The centre's limits."""
    return analysis.tolerance_limits(network)[0]


def test_a_scalar_without_a_sensor():
    """V = k P, P = 0.81 k P + 1, theta = (1 - 1 / k)(1 - 0.81 k): largest at k = 1 / 0.9, gone at k = 1 / 0.81."""
    limits = centre_of(scalar_network(0.9, 0.0))
    fold, end = ((k - 1 - log(k)) for k in (1 / 0.9, 1 / 0.81))
    assert float(limits.fold) == pytest.approx(fold, rel=1e-6)
    assert float(limits.exists) == pytest.approx(end, rel=1e-5)
    assert float(limits.attracts) == pytest.approx(end, rel=1e-5)


def test_a_scalar_with_a_poor_sensor():
    """The published fold of A = 0.9, S = 0.01 is 0.0269; theta as a function of c has its maximum there."""
    limits = centre_of(scalar_network(0.9, 0.01))
    assert float(limits.fold) == pytest.approx(0.0269, abs=5e-5)
    A, Q, S = np.array([[0.9]]), np.eye(1), np.array([[0.01]])
    around = [float(fifty_digits.steady_state(A, Q, S, float(limits.fold) * x).theta) for x in (0.99, 1.0, 1.01)]
    assert around[1] == max(around)
    assert float(limits.exists) == inf
    assert float(limits.attracts) == inf


def first_crossing(A: ndarray, Q: ndarray, S: ndarray, low: float, high: float) -> float:
    """Where the attraction of the naive steady state reaches 1, by bisection in log c."""

    def attracts(c: float) -> bool:
        return fifty_digits.attraction(A, Q, S, c, fifty_digits.steady_state(A, Q, S, c, digits=20)) < 1

    assert attracts(low)
    assert not attracts(high)
    while high / low > 1 + 1e-7:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if attracts(middle) else (low, middle)
    return low


def test_where_the_steady_state_stops_attracting():
    """A random network of two states; on both sides the recursion itself agrees."""
    network = random_network(np.random.default_rng(1), 2, 3)
    A, Q, S = network.A, network.Q, network.total_information
    limits = centre_of(network)
    assert float(limits.attracts) == pytest.approx(first_crossing(A, Q, S, 0.1, 1.0), rel=1e-6)
    assert recursion.run(A, Q, S, 0.8 * float(limits.attracts), steps=3000).verdict == "settles"
    assert recursion.run(A, Q, S, 1.2 * float(limits.attracts), steps=3000).verdict == "oscillates"
    assert float(limits.exists) == inf


@pytest.mark.parametrize("seed", range(3))
def test_theta_rises_up_to_the_fold_and_falls_after_it(seed: int):
    network = random_network(np.random.default_rng(110 + seed), 2, 3, relays=0.9, noise_decades=2.0)
    S = network.information
    _, nodes = analysis.tolerance_limits(network)
    for k in range(network.N):
        fold = float(nodes.fold[k])
        if np.isfinite(fold):
            before, at, after = analysis.solve_steady_states(
                network.A, network.Q, np.stack([S[k]] * 3), fold * np.array([0.97, 1.0, 1.03])
            ).theta
            assert before < at > after


def test_a_fold_far_beyond_where_the_filter_stops_settling():
    """theta rises to c = 118.9, although the steady state no longer attracts from c = 6.58 on."""
    A, Q, S = poorly_informed(55)
    around = analysis.solve_steady_states(A, Q, np.stack([S] * 4), np.array([10.0, 100.0, 119.0, 140.0])).theta
    assert around[0] < around[1] < around[2] > around[3]
    weights, E = np.linalg.eigh(S)
    C = np.sqrt(np.maximum(weights, 0.0))[:, None] * E.T
    limits = centre_of(SensorNetwork(A=A, Q=Q, C=[C], R=[np.eye(4)], edges=[]))
    assert float(limits.attracts) == pytest.approx(6.58, abs=5e-3)
    assert float(limits.fold) == pytest.approx(118.9, abs=0.2)


@pytest.mark.parametrize(("seed", "c"), [(84, 0.8), (165, 0.55)])
def test_limits_and_statuses_agree(seed: int, c: float):
    A, Q, S = poorly_informed(seed)
    weights, E = np.linalg.eigh(S)
    C = np.sqrt(np.maximum(weights, 0.0))[:, None] * E.T
    network = SensorNetwork(A=A, Q=Q, C=[C], R=[np.eye(len(A))], edges=[])
    settles = str(analysis.solve_steady_state(network, c).status) == "ok"
    assert settles == (c < float(centre_of(network).attracts))


@pytest.mark.parametrize("window", [3, 6, 15])
def test_the_published_bound(window: int):
    network = random_network(np.random.default_rng(12), 3, 5)
    centre, nodes = analysis.tolerance_limits(network, window=window)
    assert centre.window == nodes.window == window
    neighbourhoods = [list(range(5)), *(determinants.hears(network, k) for k in range(5))]
    assert network.B is not None
    for nodes_heard, found in zip(neighbourhoods, [centre.published, *nodes.published], strict=True):
        C, R = determinants.stacked(network, nodes_heard)
        P = steady_state.kalman(network.A, network.Q, determinants.information(C, R))
        want = maxtol.maxtol(network.A, network.B, C, np.linalg.cholesky(R), P, window)
        assert float(found) == pytest.approx(want, rel=1e-6)


def test_the_published_bound_ends_for_tiny_noise():
    """Measurement noise of 1e-12: an absolute stopping rule would bisect for ever."""
    network = SensorNetwork(A=[[1.0, 0.1], [0.0, 1.0]], Q=np.eye(2), C=[np.eye(2)], R=[1e-12 * np.eye(2)], edges=[])
    centre, _ = analysis.tolerance_limits(network)
    assert float(centre.published) > 0
    assert float(centre.published) <= float(centre.attracts)


def test_filters_without_detectability_have_no_limit_above_zero():
    network = SensorNetwork(
        A=np.diag([1.2, 0.5]), Q=np.eye(2), C=[np.eye(2), [[0.0, 1.0]]], R=[np.eye(2), [[1.0]]], edges=[]
    )
    centre, nodes = analysis.tolerance_limits(network)
    for name in ("fold", "attracts", "exists", "published"):
        assert getattr(nodes, name)[1] == 0
        assert getattr(nodes, name)[0] > 0
        assert float(getattr(centre, name)) > 0


def test_below_every_limit_everybody_settles():
    network = random_network(np.random.default_rng(21), 3, 6)
    _, nodes = analysis.tolerance_limits(network)
    below = 0.999 * np.minimum(nodes.attracts, 1e6)
    states = analysis.solve_steady_states(network.A, network.Q, network.information, below)
    assert states.settles.all()
    oscillating = np.isfinite(nodes.attracts)
    above = analysis.solve_steady_states(
        network.A, network.Q, network.information[oscillating], 1.001 * nodes.attracts[oscillating]
    )
    assert not above.settles.any()


def test_a_window_shorter_than_the_state_is_refused():
    with pytest.raises(ValueError, match="window"):
        analysis.tolerance_limits(random_network(np.random.default_rng(1), 3, 2), window=2)


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1e3, 1e9, 1e12])
def test_the_published_bound_needs_no_common_unit(unit: float):
    """It depends on the units itself, through the largest eigenvalue of a covariance, but exists in all of them."""
    A, Q, S = np.array([[1.0, 0.1], [0.0, 0.95]]), np.diag([0.01, 0.1]), np.diag([1.0, 0.0])
    u = np.array([1.0, unit])
    found = analysis.published_bound(A * u[:, None] / u, Q * u[:, None] * u, (S / u[:, None] / u)[None], 4)[0]
    assert 1e-6 < found < 1
