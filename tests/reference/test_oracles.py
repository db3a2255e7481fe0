"""The oracles against one another, against closed forms and against the published example's reference numbers."""

from __future__ import annotations

from math import exp, log

import numpy as np
import pytest
from numpy import ndarray
from tests.instances import ring_projectile
from tests.instances_random import random_network
from tests.reference import determinants, fifty_digits, maxtol, recursion, steady_state, tau
from tests.reference.exact import determinant, exact, eye, is_positive, mp, mpf, rounded, solve

REFERENCE = {
    0.02: {
        "theta": (1.375649, 5e-7),
        "trace_V": (0.281739, 5e-7),
        "trace_P": (0.253797, 5e-7),
        "tolerances": ([0.014796, 0.014032, 0.015787], 5e-7),
        "nodes": ([0.015165, 0.014791, 0.014898], 5e-7),
        "mean_theta": ([0.441675, 0.417012], 5e-7),
    },
    0.06: {
        "theta": (1.723372, 5e-7),
        "trace_V": (0.381697, 5e-7),
        "trace_P": (0.316805, 5e-7),
        "tolerances": ([0.039741, 0.036695, 0.043824], 5e-7),
        "nodes": ([0.040529, 0.039936, 0.039927], 5e-7),
        "mean_theta": ([0.521502, 0.495340], 5e-7),
    },
}
"""docs/mathematics.md, reference numbers of the ring lattice, each with half a unit of its last digit."""


def random_filter(seed: int, n: int) -> tuple[ndarray, ndarray, ndarray]:
    """A, Q and the information of everybody in a random network."""
    network = random_network(np.random.default_rng(seed), n, 3)
    C, R = determinants.stacked(network, list(range(3)))
    return network.A, network.Q, determinants.information(C, R)


def test_the_recursion_reproduces_the_reference_numbers():
    c, want = 0.02, REFERENCE[0.02]
    network = ring_projectile(c)
    C, R = determinants.stacked(network, list(range(20)))
    centre = recursion.run(network.A, network.Q, determinants.information(C, R), c)
    for found, (number, digit) in (
        (centre.theta, want["theta"]),
        (np.trace(centre.V), want["trace_V"]),
        (np.trace(centre.P), want["trace_P"]),
    ):
        assert found == pytest.approx(number, abs=digit)
    tolerances, thetas = np.empty(20), np.empty((20, 2))
    for k in range(20):
        C_k, R_k = determinants.stacked(network, determinants.hears(network, k))
        tolerances[k] = determinants.local_tolerance(network.A, network.Q, C, R, C_k, R_k, centre.V, centre.V)
        S_k = determinants.information(C_k, R_k)
        thetas[k] = [recursion.run(network.A, network.Q, S_k, x).theta for x in (c, tolerances[k])]
    found = [tolerances.mean(), tolerances.min(), tolerances.max()]
    np.testing.assert_allclose(found, want["tolerances"][0], rtol=0, atol=want["tolerances"][1])
    np.testing.assert_allclose(tolerances[[0, 9, 19]], want["nodes"][0], rtol=0, atol=want["nodes"][1])
    np.testing.assert_allclose(thetas.mean(axis=0), want["mean_theta"][0], rtol=0, atol=want["mean_theta"][1])


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("c", [0.0, 1e-3, 0.5, 20.0])
def test_recursion_optimiser_and_fifty_digits_agree(seed: int, c: float):
    n = 1 + seed % 4
    A, Q, S = random_filter(seed, n)
    exactly = fifty_digits.steady_state(A, Q, S, c)
    naive = steady_state.steady_state(A, Q, S, c)
    np.testing.assert_allclose(naive.V, rounded(exactly.V), rtol=1e-9, atol=1e-10 * np.trace(naive.V))
    assert naive.theta == pytest.approx(float(exactly.theta), rel=1e-9)
    attraction = fifty_digits.attraction(A, Q, S, c, exactly)
    end = recursion.run(A, Q, S, c, steps=1000)
    assert end.verdict == ("settles" if attraction < 1 else "oscillates")
    if attraction < 1:
        np.testing.assert_allclose(end.V, rounded(exactly.V), rtol=1e-9, atol=1e-10 * np.trace(naive.V))


def test_fifty_digits_hold_to_fifty_digits():
    A, Q, S = random_filter(1, 3)
    for c in (1e-14, 0.5, 1e8):
        state = fifty_digits.steady_state(A, Q, S, c)
        with mp.workdps(60):
            I, P, theta = eye(3), state.P, state.theta
            V = solve(solve(P, I) - I * theta, I)
            riccati = exact(A) @ solve(solve(V, I) + exact(S), exact(A.T)) + exact(Q) - P
            assert max(abs(riccati).ravel()) < mpf(10) ** -40 * max(abs(P).ravel())
            assert abs(fifty_digits.gamma(P, theta) / mpf(c) - 1) < mpf(10) ** -30
            assert is_positive(V)


def test_fifty_digits_say_where_the_path_ends():
    """Without a sensor P = a^2 V + 1 and V = k P: the path ends where a^2 k = 1, at c = k - 1 - log k."""
    A, Q, S = np.array([[0.9]]), np.eye(1), np.zeros((1, 1))
    end = 1 / 0.81 - 1 - log(1 / 0.81)
    k = 1.2
    state = fifty_digits.steady_state(A, Q, S, k - 1 - log(k))
    assert float(state.P[0, 0]) == pytest.approx(1 / (1 - 0.81 * k), rel=1e-13)
    assert fifty_digits.attraction(A, Q, S, k - 1 - log(k), state) == pytest.approx(0.81 * k, rel=1e-12)
    with pytest.raises(ArithmeticError, match="path ends"):
        fifty_digits.steady_state(A, Q, S, end * 1.001)
    assert recursion.run(A, Q, S, 0.1).verdict == "diverges"


def test_attraction_of_the_kalman_filter_is_the_square_of_its_closed_loop():
    A, Q, S = random_filter(3, 4)
    state = fifty_digits.steady_state(A, Q, S, 0.0)
    loop = A @ np.linalg.inv(np.eye(4) + rounded(state.V) @ S)
    radius = np.abs(np.linalg.eigvals(loop)).max()
    assert fifty_digits.attraction(A, Q, S, 0.0, state) == pytest.approx(radius**2, rel=1e-10)


def test_beyond_the_fold_of_the_scalar_example():
    A, Q, S = np.array([[0.9]]), np.eye(1), np.array([[0.01]])
    state = fifty_digits.steady_state(A, Q, S, 0.1)
    assert float(state.P[0, 0]) == pytest.approx(19.44, abs=5e-3)
    assert float(state.theta) == pytest.approx(0.01751, abs=5e-6)
    thetas = {c: float(fifty_digits.steady_state(A, Q, S, c).theta) for c in (0.0268, 0.0269, 0.0270)}
    assert max(thetas, key=lambda c: thetas[c]) == 0.0269


@pytest.mark.parametrize("seed", range(4))
def test_both_determinants_agree_and_know_who_hears_everybody(seed: int):
    network = random_network(np.random.default_rng(seed), 2 + seed, 5)
    C, R = determinants.stacked(network, list(range(5)))
    centre = steady_state.steady_state(network.A, network.Q, determinants.information(C, R), 0.5)
    everybody = determinants.local_tolerance(network.A, network.Q, C, R, C, R, centre.V, centre.V)
    assert everybody == pytest.approx(0.5, rel=1e-8)
    for k in range(5):
        C_k, R_k = determinants.stacked(network, determinants.hears(network, k))
        plain = determinants.local_tolerance(network.A, network.Q, C, R, C_k, R_k, centre.V, centre.V)
        digits = fifty_digits.local_tolerance(network.A, network.Q, C_k, R_k, centre.P, centre.V)
        assert plain == pytest.approx(float(digits), rel=1e-8)
        assert 0 <= float(digits) <= 0.5 * (1 + 1e-9)


def test_the_published_bound_rises_with_the_window_and_ignores_how_sensors_are_stacked():
    network = ring_projectile()
    C, R = determinants.stacked(network, list(range(20)))
    S = determinants.information(C, R)
    P = steady_state.kalman(network.A, network.Q, S)
    B = np.sqrt(0.001) * np.eye(6)
    np.testing.assert_allclose(B @ B.T, network.Q, rtol=1e-15)
    whitened = np.hstack([np.zeros((3, 3)), np.linalg.cholesky(S[3:, 3:]).T])
    bounds = [maxtol.maxtol(network.A, B, whitened, np.eye(3), P, window) for window in (6, 9, 12)]
    assert bounds == sorted(bounds)
    plain = maxtol.maxtol(network.A, B, C, np.linalg.cholesky(R), P, 6)
    assert plain == pytest.approx(bounds[0], rel=1e-9)
    assert plain < 0.02  # the published example's tolerance converges although this bound does not cover it


def test_the_tau_family_meets_kullback_leibler_and_its_closed_forms():
    A, Q, S = random_filter(2, 3)
    P, V, theta = tau.steady_state(A, Q, S, 0.05, 0.0)
    leibler = recursion.run(A, Q, S, 0.05)
    np.testing.assert_allclose(P, leibler.P, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(V, leibler.V, rtol=1e-10, atol=1e-13)
    assert theta == pytest.approx(leibler.theta, rel=1e-10)
    one = np.eye(1)
    assert tau.inflate(one, 0.3, 1.0)[0, 0] == pytest.approx(exp(0.3), rel=1e-14)
    assert tau.inflate(one, 0.3, 0.5)[0, 0] == pytest.approx((1 - 0.15) ** -2, rel=1e-14)
    for x in (0.0, 0.3, 0.999999, 1.0):  # gamma is s^2 / 2 for small s, whichever the member
        assert tau.gamma(one, 1e-3, x) == pytest.approx(5e-7, rel=3e-3)


def test_elimination_on_matrices_whose_answer_is_known():
    hilbert = exact(np.eye(3))
    for i in range(3):
        for j in range(3):
            hilbert[i, j] = mpf(1) / (i + j + 1)
    with mp.workdps(50):
        assert abs(determinant(hilbert) * 2160 - 1) < mpf(10) ** -12
        swap = exact([[0.0, 1.0], [1.0, 0.0]])
        assert determinant(swap) == -1
        assert (solve(swap, exact([[2.0], [3.0]])) == exact([[3.0], [2.0]])).all()
        assert determinant(exact(np.ones((2, 2)))) == 0
        with pytest.raises(ZeroDivisionError):
            solve(exact(np.zeros((2, 2))), eye(2))
