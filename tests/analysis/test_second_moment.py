"""Where the second moment grows, and its limit elsewhere."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from tests.instances_corrupted import drawn

from tolnet.analysis.drkf import step_second_moment
from tolnet.analysis.second_moment import norm_limit, norm_recursion, second_moment_limit, second_moments
from tolnet.model import CorruptedNetwork
from tolnet.model.examples import field


def plant(A, F=None, mu=0.0) -> CorruptedNetwork:
    n = len(np.asarray(A)[0]) if np.ndim(A) == 3 else len(A)
    return CorruptedNetwork(A=A, F=F, multiplicative_variance=mu, Q=np.eye(n), C=[np.eye(n)], R=[np.eye(n)], edges=[])


GROWING = {
    "decays": ([[0.5, 3.0], [0.0, 0.9]], []),
    "grows": ([[1.1, 0.0], [0.0, 0.5]], [[1, 0]]),
    "badly scaled": ([[0.5, 0.0], [1e6, 1.1]], [[0, 1]]),
    "marginal": ([[1.0, 0.0], [0.0, 0.5]], [[1, 0]]),
    "integrates twice": ([[1.0, 0.1], [0.0, 1.0]], [[1, 0], [0, 1]]),
    "turns": ([[0.8, 0.6], [-0.6, 0.8]], [[1, 0], [0, 1]]),
    "slowly": ([[0.99999, 0.0], [0.0, 0.5]], []),
    "slowly beside an integrator": ([[1.0, 0.0], [0.0, 0.9995]], [[1, 0]]),
    "slowly into an integrator": ([[1.0, 1.0], [0.0, 0.9995]], [[1, 0]]),
}


@pytest.mark.parametrize("name", GROWING)
def test_growing_directions(name: str):
    A, expected = GROWING[name]
    limit = second_moment_limit(plant(np.array(A)))
    U = limit.U[0]
    basis = np.array(expected, dtype=float).reshape(-1, 2).T
    np.testing.assert_allclose(U @ U.T, basis @ basis.T, atol=1e-9)
    assert limit.residual < 1e-9


def test_a_defective_eigenvalue_on_the_circle_in_any_basis():
    generator = np.random.default_rng(0)
    jordan = np.array([[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 0], [0, 0, 0, 0.5]])
    for _ in range(10):
        S = generator.standard_normal((4, 4))
        limit = second_moment_limit(plant(S @ jordan @ np.linalg.inv(S)))
        assert limit.U.shape[2] == 3
        assert np.abs(np.linalg.inv(S)[3] @ limit.U[0]).max() < 1e-9 * np.linalg.norm(np.linalg.inv(S))


def test_noise_alone_may_make_a_stable_plant_grow():
    A, F = np.diag([0.9, 0.5]), np.array([[0.0, 1.0], [1.0, 0.0]])
    assert second_moment_limit(plant(A, F, 0.1)).bounded
    assert second_moment_limit(plant(A, F, 0.5)).U.shape[2] == 2  # the noise couples both
    assert second_moment_limit(plant(A, np.diag([1.0, 0.0]), 0.5)).U.shape[2] == 1


@pytest.mark.parametrize("seed", range(8))
def test_the_limit_is_that_of_the_recursion(seed: int):
    network = drawn(seed)
    T = network.period
    assert T is not None
    limit = second_moment_limit(network)
    for k, moment in enumerate(islice(second_moments(network, limit), 400 * T)):
        if k >= 399 * T:
            goal = limit.at(k).Pi
            np.testing.assert_allclose(moment.bounded, goal, atol=1e-8 * max(1, np.abs(goal).max()))


def test_the_bounded_part_survives_growth():
    network = field()
    limit = second_moment_limit(network)
    *_, last = islice(second_moments(network, limit), 1500)
    assert np.trace(last.Pi) > 1e30
    np.testing.assert_allclose(last.bounded, limit.at(1499).Pi, atol=1e-12)


def test_the_norm_recursion_bounds_the_second_moment():
    for seed in range(10):
        network = drawn(seed)
        pi, Pi = norm_recursion(network, 10), network.initial_second_moment
        for k in range(11):
            assert np.linalg.norm(Pi, 2) <= pi[k] * (1 + 1e-12)
            Pi = step_second_moment(network.at(k), Pi)
    small = plant(np.array([[0.5, 0.1], [0.0, 0.3]]))
    assert norm_limit(small)[0] == pytest.approx(norm_recursion(small, 400)[-1])
    assert np.isinf(norm_limit(plant(np.eye(2)))).all()
