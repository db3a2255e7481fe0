"""Tolerances from 1e-14 to 1e8, modes next to the unit circle and bad units, against 50 digits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy import ndarray
from scipy.linalg import solve_discrete_are
from tests.instances_random import random_network
from tests.reference import determinants, fifty_digits, recursion
from tests.reference.exact import rounded
from tests.reference.fifty_digits import Exact

from tolnet import analysis
from tolnet.model import SteadyState

DIGITS = 1e-9


def assert_agrees(state: SteadyState, exactly: Exact) -> None:
    """theta and both traces to nine digits, and each entry in units of its row and column."""
    found = [float(state.theta), float(state.trace_P), float(state.trace_V)]
    want = [float(exactly.theta), float(np.trace(exactly.P)), float(np.trace(exactly.V))]
    np.testing.assert_allclose(found, want, rtol=DIGITS)
    for M, reference in ((state.P, exactly.P), (state.V, exactly.V)):
        units = np.sqrt(np.outer(np.diag(rounded(reference)), np.diag(rounded(reference))))
        np.testing.assert_allclose(M / units, rounded(reference) / units, rtol=0, atol=1e-8)


def solve_one(A: ndarray, Q: ndarray, S: ndarray, c: float) -> SteadyState:
    """The steady state of one filter from its matrices."""
    return analysis.solve_steady_states(A, Q, S[None], np.array([c]))[0]


@pytest.mark.parametrize("c", [1e-14, 1e-11, 1e-8, 1e-5, 1e-3, 0.1, 3.0, 100.0, 3e3, 1e5, 1e8])
@pytest.mark.parametrize("seed", range(3))
def test_every_size_of_tolerance(seed: int, c: float):
    network = random_network(np.random.default_rng(700 + seed), 1 + seed, 5)
    state = analysis.solve_steady_state(network, c)
    exactly = fifty_digits.steady_state(network.A, network.Q, network.total_information, c)
    assert_agrees(state, exactly)
    attraction = fifty_digits.attraction(network.A, network.Q, network.total_information, c, exactly)
    assert str(state.status) == ("ok" if attraction < 1 else "oscillates")
    assert float(state.attraction) == pytest.approx(attraction, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("c", [1e-14, 1e-6, 1.0, 1e8])
def test_local_tolerances_of_every_size(c: float):
    network = random_network(np.random.default_rng(41), 3, 6)
    centre = fifty_digits.steady_state(network.A, network.Q, network.total_information, c)
    found = analysis.local_tolerances(network, analysis.solve_steady_state(network, c))
    for k in range(network.N):
        C_k, R_k = determinants.stacked(network, determinants.hears(network, k))
        want = fifty_digits.local_tolerance(network.A, network.Q, C_k, R_k, centre.P, centre.V)
        assert found[k] == pytest.approx(float(want), rel=DIGITS)


@pytest.mark.parametrize("seed", range(6))
def test_without_tolerance_it_is_the_kalman_filter(seed: int):
    network = random_network(np.random.default_rng(900 + seed), 1 + seed, 4)
    C, R = determinants.stacked(network, list(range(network.N)))
    P = solve_discrete_are(network.A.T, C.T, network.Q, R)
    state = analysis.solve_steady_state(network, 0.0)
    np.testing.assert_allclose(state.P, P, rtol=1e-9, atol=1e-12 * np.trace(P))
    np.testing.assert_allclose(state.V, state.P, rtol=1e-12, atol=1e-14 * np.trace(P))
    assert float(state.theta) == 0
    assert float(state.tolerance_residual) == 0
    np.testing.assert_array_equal(analysis.local_tolerances(network, state), 0.0)


@pytest.mark.parametrize("modulus", [1 - 1e-9, 1.0, 1 + 1e-9])
@pytest.mark.parametrize("c", [0.0, 1e-3, 1.0, 1e4])
def test_a_mode_next_to_the_unit_circle(modulus: float, c: float):
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    A = modulus * np.block([[turn, 0.3 * np.ones((2, 1))], [np.zeros((1, 2)), np.array([[0.5]])]])
    S = np.zeros((3, 3))
    S[0, 0] = 0.04
    Q = np.diag([0.01, 0.02, 0.03])
    assert_agrees(solve_one(A, Q, S, c), fifty_digits.steady_state(A, Q, S, c))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("c", [0.0, 1e-3, 1.0])
def test_states_in_bad_units(seed: int, c: float):
    """Units from 1e-4 to 1e4: covariances over sixteen orders, each of which keeps its digits."""
    network = random_network(np.random.default_rng(60 + seed), 2 + seed % 2, 4, state_decades=4.0)
    S = network.total_information
    exactly = fifty_digits.steady_state(network.A, network.Q, S, c)
    assert_agrees(analysis.solve_steady_state(network, c), exactly)


@pytest.mark.parametrize(("seed", "n"), [(3006, 3), (3007, 3), (3015, 3), (3018, 3), (4011, 4), (4014, 4), (4018, 4)])
@pytest.mark.parametrize("decades", [3.0, 4.0])
def test_states_in_worse_combinations_of_bad_units(seed: int, n: int, decades: float):
    rng = np.random.default_rng(seed)
    network = random_network(rng, n, 4, state_decades=decades)
    exactly = fifty_digits.steady_state(network.A, network.Q, network.total_information, 0.01)
    assert_agrees(analysis.solve_steady_state(network, 0.01), exactly)


@pytest.mark.parametrize("decade", range(-8, 5, 2))
def test_noise_of_every_size(decade: int):
    rng = np.random.default_rng(5)
    network = random_network(rng, 3, 4, noise_decades=0.5)
    S = network.total_information / 10.0**decade
    exactly = fifty_digits.steady_state(network.A, network.Q, S, 0.05)
    assert_agrees(solve_one(network.A, network.Q, S, 0.05), exactly)


@pytest.mark.parametrize("decade", [5, 6])
def test_noise_that_leaves_next_to_no_information(decade: int):
    """Far beyond the fold, where 50 digits take long and the recursion does not."""
    network = random_network(np.random.default_rng(5), 3, 4, noise_decades=0.5)
    S = network.total_information / 10.0**decade
    state, end = solve_one(network.A, network.Q, S, 0.05), recursion.run(network.A, network.Q, S, 0.05)
    assert (str(state.status), end.verdict) == ("ok", "settles")
    found = [float(state.theta), float(state.trace_P), float(state.trace_V)]
    np.testing.assert_allclose(found, [end.theta, np.trace(end.P), np.trace(end.V)], rtol=DIGITS)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("c", [0.0, 1e-6, 0.5, 100.0])
def test_singular_plants_driven_by_few_noises(seed: int, c: float):
    network = random_network(np.random.default_rng(80 + seed), 3, 4, singular=True, drives=1 + seed % 2)
    assert np.linalg.matrix_rank(network.A) == 2
    S = network.total_information
    assert_agrees(analysis.solve_steady_state(network, c), fifty_digits.steady_state(network.A, network.Q, S, c))


def test_a_covariance_that_stays_singular():
    """A nilpotent plant driven along one axis: P and V have rank one, and so has every inverse that is not taken."""
    A, Q = np.array([[0.5, 0.0], [0.0, 0.0]]), np.diag([1.0, 0.0])
    S = np.array([[1.0, 0.3], [0.3, 2.0]])
    state = solve_one(A, Q, S, 0.2)
    scalar = fifty_digits.steady_state(A[:1, :1], Q[:1, :1], S[:1, :1], 0.2)
    assert str(state.status) == "ok"
    np.testing.assert_allclose(state.V, [[float(scalar.V[0, 0]), 0], [0, 0]], rtol=1e-12, atol=1e-15)
    assert float(state.theta) == pytest.approx(float(scalar.theta), rel=1e-12)


@pytest.mark.parametrize("c", [0.0, 1e-14, 0.02, 1e8])
def test_one_node_with_one_state(c: float):
    network = random_network(np.random.default_rng(1), 1, 1, radius=0.95)
    exactly = fifty_digits.steady_state(network.A, network.Q, network.total_information, c)
    state = analysis.solve_steady_state(network, c)
    assert_agrees(state, exactly)
    assert analysis.local_tolerances(network, state)[0] == pytest.approx(c, rel=1e-12)


@pytest.mark.parametrize("c", [0.7, 1.0, 10.0, 100.0])
def test_of_two_steady_states_the_one_that_attracts_is_reported(c: float):
    """A filter with a repelling and an attracting steady state at the same c: the recursion settles on the latter."""
    A = np.array([[0.50785767, -0.14882533], [-0.04101217, -0.92718015]])
    Q = np.array([[0.15015423, -0.00204352], [-0.00204352, 0.00669113]])
    S = np.array([[0.15140492, -0.30559727], [-0.30559727, 1.08405514]])
    state = analysis.solve_steady_states(A, Q, S[None], np.array([c]))[0]
    end = recursion.run(A, Q, S, c, steps=1000)
    assert end.verdict == "settles"
    assert str(state.status) == "ok"
    assert float(state.trace_P) == pytest.approx(np.trace(end.P), rel=1e-8)
