"""Random networks (24, in the study 60) against textbook arithmetic: tolerances, thetas and traces to nine digits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy import ndarray
from tests.instances_random import random_network
from tests.reference import determinants, fifty_digits, recursion, steady_state
from tests.reference.exact import rounded
from tests.study import sized

from tolnet import analysis
from tolnet.model import SensorNetwork

DIGITS = 1e-9


def case(seed: int) -> tuple[SensorNetwork, float]:
    """Network and tolerance number `seed`: n 1..8, N 1..40, p_k 0..3, relays, directed graphs, singular A and Q."""
    rng = np.random.default_rng(20_000 + seed)
    n, N = 1 + seed % 8, 1 + 7 * seed % 40
    network = random_network(
        rng,
        n,
        N,
        directed=seed % 3 == 0,
        singular=n > 1 and seed % 5 == 0,
        drives=n // 2 + 1 if seed % 4 == 0 else None,
        degree=rng.uniform(1, 6),
    )
    return network, float(10 ** rng.uniform(-3, 2))


def oracle(A: ndarray, Q: ndarray, S: ndarray, c: float) -> tuple[float, float, float]:
    """theta and the traces of P and V: in doubles, and in 50 digits where doubles do not get there."""
    try:
        state = steady_state.steady_state(A, Q, S, c)
        return state.theta, float(np.trace(state.P)), float(np.trace(state.V))
    except (RuntimeError, np.linalg.LinAlgError):
        exactly = fifty_digits.steady_state(A, Q, S, c)
        return float(exactly.theta), float(np.trace(exactly.P)), float(np.trace(exactly.V))


@pytest.mark.parametrize("seed", range(sized(24, 60)))  # 24: all n, residues mod 3 and, with 20, singular A
def test_a_random_network(seed: int):
    network, c = case(seed)
    A, Q = network.A, network.Q
    C, R = determinants.stacked(network, list(range(network.N)))
    centre = analysis.solve_steady_state(network, c)
    tolerances = analysis.local_tolerances(network, centre)
    local = analysis.solve_steady_states(A, Q, network.information, tolerances)

    found = [float(centre.theta), float(centre.trace_P), float(centre.trace_V)]
    np.testing.assert_allclose(found, oracle(A, Q, determinants.information(C, R), c), rtol=DIGITS)
    nodes = np.random.default_rng(seed).permutation(network.N)[:3].tolist()
    exactly = steady_state_of_the_centre(A, Q, determinants.information(C, R), c)
    for k in nodes:
        C_k, R_k = determinants.stacked(network, determinants.hears(network, k))
        c_k = float(fifty_digits.local_tolerance(A, Q, C_k, R_k, *exactly))
        found = [tolerances[k], local.theta[k], local.trace_P[k], local.trace_V[k]]
        want = [c_k, *oracle(A, Q, determinants.information(C_k, R_k), c_k)]
        np.testing.assert_allclose(found, want, rtol=DIGITS, err_msg=f"node {k}")


def steady_state_of_the_centre(A: ndarray, Q: ndarray, S: ndarray, c: float) -> tuple[ndarray, ndarray]:
    """P and V of the central filter, from the oracles."""
    try:
        state = steady_state.steady_state(A, Q, S, c)
    except (RuntimeError, np.linalg.LinAlgError):
        state = fifty_digits.steady_state(A, Q, S, c)
    return state.P, state.V


@pytest.mark.parametrize("seed", [0, 1, 3, 10, 16])
def test_the_status_is_what_the_recursion_does(seed: int):
    """`ok` where the published recursion settles; `oscillates` where it never does (seeds 1 and 10)."""
    network = random_network(np.random.default_rng(seed), 2 + seed % 3, 8, radius=1.02, relays=0.9)
    S = np.concatenate([network.total_information[None], network.information[:2]])
    statuses = []
    for c in (0.02, 1.0, 50.0):
        states = analysis.solve_steady_states(network.A, network.Q, S, np.full(3, c))
        for k, state in enumerate(states):
            end = recursion.run(network.A, network.Q, S[k], c, steps=1000)
            assert str(state.status) == {"settles": "ok", "oscillates": "oscillates"}[end.verdict]
            statuses.append(str(state.status))
            if end.verdict == "settles":
                found = [float(state.theta), float(state.trace_P), float(state.trace_V)]
                np.testing.assert_allclose(found, [end.theta, np.trace(end.P), np.trace(end.V)], rtol=DIGITS)
    assert ("oscillates" in statuses) == (seed in (1, 10))


def test_every_answer_is_symmetric_and_positive():
    network, c = case(31)
    state = analysis.solve_steady_states(network.A, network.Q, network.information, np.full(network.N, c))
    for M in (state.P, state.V, state.V - state.P):
        np.testing.assert_array_equal(M, M.mT)
        assert (np.linalg.eigvalsh(M)[:, 0] > 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_attraction_is_the_derivative_of_the_recursion(seed: int):
    network = random_network(np.random.default_rng(300 + seed), 1 + seed, 4)
    A, Q, S = network.A, network.Q, network.total_information
    for c in (0.0, 1e-3, 0.5, 100.0):
        exactly = fifty_digits.steady_state(A, Q, S, c)
        state = analysis.solve_steady_state(network, c)
        assert float(state.attraction) == pytest.approx(fifty_digits.attraction(A, Q, S, c, exactly), rel=1e-7)
        V = rounded(exactly.V)
        M = A @ np.linalg.inv(np.eye(network.n) + V @ S)
        assert float(state.spectral_radius) == pytest.approx(np.abs(np.linalg.eigvals(M)).max(), rel=1e-9)
