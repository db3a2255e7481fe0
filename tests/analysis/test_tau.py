"""The tau-divergence family through the same door, against matrix functions of scipy."""

from __future__ import annotations

import numpy as np
import pytest
from tests.instances_random import random_network
from tests.reference import tau as naive

from tolnet import analysis
from tolnet.model import Ambiguity


@pytest.mark.parametrize("tau", [0.0, 1e-6, 0.25, 0.5, 0.9, 1 - 1e-9, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_steady_states_of_the_family(tau: float, seed: int):
    network = random_network(np.random.default_rng(70 + seed), 2 + seed, 4)
    for c in (0.01, 1.0):
        state = analysis.solve_steady_state(network, Ambiguity(c, tau=tau))
        if tau in (1e-6, 1 - 1e-9):  # the printed formula cancels next to both ends, where the family is continuous
            end = analysis.solve_steady_state(network, Ambiguity(c, tau=float(round(tau))))
            assert float(state.theta) == pytest.approx(float(end.theta), rel=1e-5)
            assert float(state.trace_V) == pytest.approx(float(end.trace_V), rel=1e-5)
            continue
        P, V, theta = naive.steady_state(network.A, network.Q, network.total_information, c, tau)
        assert str(state.status) == "ok"
        found = [float(state.theta), float(state.trace_P), float(state.trace_V)]
        np.testing.assert_allclose(found, [theta, np.trace(P), np.trace(V)], rtol=1e-9)
        assert float(state.tolerance_residual) < 1e-9


def test_the_divergence_is_the_printed_one():
    P = np.diag([0.3, 0.1])
    for tau in (0.0, 0.2, 0.7, 1.0):
        for theta in (0.5, 1.5, 3.0):
            assert float(analysis.gamma(P, theta, tau)) == pytest.approx(naive.gamma(P, theta, tau), rel=1e-12)


@pytest.mark.parametrize("tau", [0.3, 1.0])
def test_attraction_of_the_family_is_the_derivative_of_its_recursion(tau: float):
    network = random_network(np.random.default_rng(5), 2, 3)
    A, Q, S = network.A, network.Q, network.total_information
    state = analysis.solve_steady_state(network, Ambiguity(0.5, tau=tau))

    def advance(V: np.ndarray) -> np.ndarray:
        P = A @ np.linalg.inv(np.linalg.inv(V) + S) @ A.T + Q
        return naive.inflate(P, naive.find_theta(P, 0.5, tau), tau)

    columns, upper, h = [], np.triu_indices(2), 1e-5 * np.trace(state.V)
    for i, j in zip(*upper, strict=True):
        E = np.zeros((2, 2))
        E[i, j] = E[j, i] = h
        columns.append(((advance(state.V + E) - advance(state.V - E)) / (2 * h))[upper])
    radius = np.abs(np.linalg.eigvals(np.stack(columns, axis=1))).max()
    assert float(state.attraction) == pytest.approx(radius, rel=1e-6)


def test_every_member_starts_at_the_kalman_filter_and_pessimism_grows_with_c():
    network = random_network(np.random.default_rng(8), 3, 4)
    kalman = analysis.solve_steady_state(network, 0.0)
    for tau in (0.0, 0.5, 1.0):
        states = [analysis.solve_steady_state(network, Ambiguity(c, tau=tau)) for c in (0.0, 1e-8, 1e-3, 0.1)]
        np.testing.assert_allclose(states[0].V, kalman.V, rtol=1e-12, atol=1e-15)
        traces = [float(state.trace_V) for state in states]
        assert traces == sorted(traces)
        assert traces[1] == pytest.approx(traces[0], rel=1e-3)
