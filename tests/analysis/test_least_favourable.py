"""The least favourable model: against the printed recursion, where it exists, and what draws from it look like."""

from dataclasses import replace

import numpy as np
import pytest
from tests.instances import ring_projectile
from tests.instances_random import random_network
from tests.reference import naive_performance as naive

from tolnet.analysis import solve_steady_state
from tolnet.analysis.error_dynamics import error_dynamics
from tolnet.analysis.least_favourable import fold_tolerance, least_favourable_model
from tolnet.analysis.trajectories import simulate_least_favourable, walk
from tolnet.model import Ambiguity, SensorNetwork, Status, UnsupportedError

SCALAR_FOLD = np.log(0.8) + 0.25
"""gamma at the fold of the scalar example: P = 10, theta = 0.02."""


def scalar() -> SensorNetwork:
    """A = 0.9, S = 0.01, Q = 1."""
    return SensorNetwork(A=[[0.9]], Q=[[1.0]], C=[[[0.1]]], R=[[[1.0]]])


def assert_same(found, wanted, digits=1e-10):
    """Equal up to a part of the largest entry."""
    np.testing.assert_allclose(found, wanted, rtol=0, atol=digits * np.abs(wanted).max())


@pytest.mark.parametrize("seed", range(8))
def test_steady_model_is_the_fixed_point_of_the_printed_recursion(seed):
    rng = np.random.default_rng(seed)
    network = random_network(rng, int(rng.integers(1, 6)), int(rng.integers(1, 9)), directed=bool(seed % 2))
    central = solve_steady_state(network, [1e-3, 0.02, 0.3, 0.6][seed % 4])
    found = least_favourable_model(network, central)
    stacked = naive.stacked(network)
    at = naive.steady_model(stacked, central.V, float(central.theta))
    M = stacked.Gamma_B - at.G @ stacked.Gamma_D
    assert found.status == Status.OK
    assert_same(found.backward, at.inverse_Omega)
    assert_same(found.closed_loop, network.A - at.G @ stacked.C + M @ at.Gamma_H)
    assert_same(found.closed_noise, M @ at.K @ M.T)
    assert_same(M.T @ found.steering, at.Gamma_H)
    assert_same(np.eye(M.shape[1]) + M.T @ found.tilt @ M, at.K)
    assert_same(found.error_covariance, np.linalg.inv(np.linalg.inv(central.V) - at.inverse_Omega))


@pytest.mark.parametrize("seed", range(3))
def test_symmetric_root_of_K(seed):
    network = random_network(np.random.default_rng(seed), 4, 5)
    found = least_favourable_model(network, solve_steady_state(network, 0.5))
    stacked = naive.stacked(network)
    M = stacked.Gamma_B - naive.gain(stacked, found.V) @ stacked.Gamma_D
    L = np.eye(M.shape[1]) + M.T @ found.tilt_root @ M
    assert_same(L @ L.T, np.eye(M.shape[1]) + M.T @ found.tilt @ M)


def test_without_tolerance_the_model_is_the_nominal_one():
    network = ring_projectile()
    central = solve_steady_state(network, 0.0)
    found = least_favourable_model(network, central)
    assert found.status == Status.OK
    assert not found.tilt.any()
    assert not found.steering.any()
    np.testing.assert_array_equal(found.closed_loop, found.loop)
    np.testing.assert_allclose(found.error_covariance, central.P, rtol=1e-13)


@pytest.mark.parametrize(("c", "decibels"), [(0.02, -3.0745), (0.06, -0.4384)])
def test_reference_numbers_of_the_centre(c, decibels):
    network = ring_projectile(c)
    R = least_favourable_model(network, solve_steady_state(network)).error_covariance
    assert abs(10 * np.log10(np.trace(R)) - decibels) < 5e-5


def rounding_of_the_residual(network, central, found):
    """What m eps, m = 4 n, in every product and inverse allows of F R F' + N + N T N - R, in parts of |R|.

    F = A - G C + N Y and T are made of X ~ P^-1 and Z ~ R^-1, with |P X - I| <= m eps kappa(P) and so for R: for
    Delta = R - P, the steering Y = X Delta L' Z moves N Y R F' by m eps (kappa(P) + kappa(R)) |N X| |Delta L'| |F| at
    most, and so does its transpose; L = Z A' X once more by kappa(P). X T^-1 X = Delta^-1 + ..., so that N T N moves
    by m eps kappa(P) |N X|^2 |Delta|. Evaluating the sum rounds by m eps of its terms. To it, what the centre's own
    equation P = (A - G C) V (A - G C)' + N leaves.
    """
    eps, norm, cond = np.finfo(float).eps, lambda X: np.linalg.norm(X, 2), np.linalg.cond
    P, R, N, F = central.P, found.error_covariance, found.noise, found.closed_loop
    inverse, Delta = np.linalg.inv(P), R - P
    L = found.filtered @ network.A.T @ inverse
    NX = norm(N @ inverse)
    steering = 2 * NX * norm(Delta @ L.T) * norm(F) * (2 * cond(P) + cond(R))
    tilt = 2 * NX**2 * norm(Delta) * cond(P)
    sum_itself = (norm(found.loop) + norm(N @ found.steering)) ** 2 * norm(R) + norm(found.closed_noise) + norm(R)
    centre = norm(found.loop @ found.V @ found.loop.T + N - P)
    return (4 * network.n * eps * (steering + tilt + sum_itself) + centre) / norm(R)


@pytest.mark.parametrize("c", [1e-14, 1e-8, 1.0, 1e2, 1e4, 1e6])
def test_covariance_satisfies_the_closed_loop_at_any_tolerance(c):
    network = ring_projectile()
    central = solve_steady_state(network, c)
    found = least_favourable_model(network, central)
    assert found.status == Status.OK
    assert found.residual < rounding_of_the_residual(network, central, found)
    assert np.linalg.eigvalsh(found.error_covariance - central.V).min() > -1e-15 * np.trace(central.V)
    for part in ("tilt", "steering"):  # the neighbouring model, in which one matrix is off by a part of 1e-6 (1e-3)
        changed = replace(found, **{part: getattr(found, part) * (1 + (1e-6 if c < 1e3 else 1e-3))})
        if c > 1e-9:  # below, the matrix itself is as small as that
            assert changed.residual > rounding_of_the_residual(network, central, changed)


def test_small_tolerances_move_the_model_by_their_square_root():
    network = ring_projectile()
    tilt = [least_favourable_model(network, solve_steady_state(network, c)).tilt for c in (1e-14, 1e-12, 1e-10)]
    assert_same(10 * tilt[0], tilt[1], 1e-5)
    assert_same(10 * tilt[1], tilt[2], 1e-4)


def test_fold_is_named_and_nothing_is_given_beyond_it():
    network = scalar()
    for c in (SCALAR_FOLD * (1 + 1e-7), 0.1, 10.0):
        found = least_favourable_model(network, solve_steady_state(network, c))
        assert found.status == Status.FOLD
        assert not found.exists
        assert "0.0268564" in found.reason
    assert fold_tolerance(network, 0.1) == pytest.approx(SCALAR_FOLD, rel=1e-7)


def test_covariance_grows_without_bound_towards_the_fold():
    network = scalar()
    gaps = np.array([1e-3, 1e-4, 1e-5, 1e-6])
    R = []
    for gap in gaps:
        found = least_favourable_model(network, solve_steady_state(network, SCALAR_FOLD * (1 - gap)))
        assert found.status == Status.OK
        R.append(float(found.error_covariance[0, 0]))
    np.testing.assert_allclose(R[-1] * gaps[-1], R[-2] * gaps[-2], rtol=1e-3)  # a simple pole


def test_rounding_at_the_fold_is_confessed():
    network = scalar()
    found = least_favourable_model(network, solve_steady_state(network, SCALAR_FOLD * (1 - 1e-12)))
    assert found.status in (Status.NOT_CONVERGED, Status.FOLD)
    assert not found.exists


def test_a_state_known_exactly():
    network = SensorNetwork(
        A=np.diag([0.9, 0.5, 0.0]),
        Q=np.diag([1.0, 0.0, 0.0]),
        C=np.random.default_rng(0).normal(size=(4, 1, 3)),
        R=np.ones((4, 1, 1)),
        edges=[[0, 1], [1, 2], [2, 3]],
    )
    found = least_favourable_model(network, solve_steady_state(network, 0.05))
    alone = SensorNetwork(
        A=[[0.9]], Q=[[1.0]], C=network.C[:, None, :1], R=network.R.reshape(4, 1, 1), edges=[[0, 1]]
    )
    wanted = least_favourable_model(alone, solve_steady_state(alone, 0.05))
    assert found.status == Status.OK
    np.testing.assert_allclose(found.error_covariance[0, 0], wanted.error_covariance[0, 0], rtol=1e-12)
    np.testing.assert_allclose(found.closed_loop[0, 0], wanted.closed_loop[0, 0], rtol=1e-12)
    assert np.abs(found.error_covariance[1:, 1:]).max() < 1e-90


@pytest.mark.parametrize("turned", [False, True])
def test_a_state_known_exactly_beside_a_sensor_that_sees_both(turned):
    basis = np.linalg.qr(np.random.default_rng(1).normal(size=(2, 2)))[0] if turned else np.eye(2)
    network = SensorNetwork(
        A=basis @ np.diag([0.5, 0.9]) @ basis.T,
        B=basis[:, 1:],
        C=np.ones((3, 1, 2)) @ basis.T,
        R=np.ones((3, 1, 1)),
        edges=[[0, 1], [1, 2]],
    )
    alone = SensorNetwork(A=[[0.9]], Q=[[1.0]], C=np.ones((3, 1, 1)), R=np.ones((3, 1, 1)), edges=[[0, 1], [1, 2]])
    for horizon in (None, 5):
        found = least_favourable_model(network, solve_steady_state(network, 0.01), horizon)
        wanted = least_favourable_model(alone, solve_steady_state(alone, 0.01), horizon)
        assert found.status == Status.OK
        if horizon is None:
            np.testing.assert_allclose(np.trace(found.error_covariance), wanted.error_covariance[0, 0], rtol=1e-9)


@pytest.mark.parametrize("c", [0.02, 3.0])
def test_finite_horizon_is_the_printed_recursion(c):
    network = random_network(np.random.default_rng(5), 3, 5)
    T = 25
    found = least_favourable_model(network, solve_steady_state(network, c), horizon=T)
    stacked, backward = naive.stacked(network), np.zeros((3, 3))
    assert found.horizon == T
    np.testing.assert_array_equal(found.V[0], network.initial_covariance)
    for t in reversed(range(T)):
        at = naive.backward_step(stacked, found.V[t], float(found.theta[t]), backward)
        backward = at.inverse_Omega
        assert_same(found.backward[t], backward)
        assert_same(
            found[t].closed_loop,
            network.A - at.G @ stacked.C + (stacked.Gamma_B - at.G @ stacked.Gamma_D) @ at.Gamma_H,
        )
        assert_same(found.error_covariance[t], np.linalg.inv(np.linalg.inv(found.V[t]) - backward))
    assert found.residual < 1e-12


def test_finite_horizon_exists_beyond_the_fold():
    network = scalar()
    found = least_favourable_model(network, solve_steady_state(network, 0.1), horizon=60)
    assert found.status == Status.OK
    assert found.residual < 1e-12
    assert (found.error_covariance[:, 0, 0] > found.V[:, 0, 0]).all()
    assert found.error_covariance[0, 0, 0] > 1e3 * found.V[0, 0, 0]  # grows backwards: no steady state


def test_middle_of_a_long_horizon_is_steady():
    network = ring_projectile()
    central = solve_steady_state(network)
    steady, long = least_favourable_model(network, central), least_favourable_model(network, central, horizon=700)
    assert_same(long.error_covariance[350], steady.error_covariance, 1e-9)
    assert_same(long.tilt[350], steady.tilt, 1e-9)
    assert_same(long[350].closed_loop, steady.closed_loop, 1e-9)


def test_refusals():
    network = ring_projectile()
    with pytest.raises(UnsupportedError, match="tau = 0"):
        least_favourable_model(network, solve_steady_state(network, Ambiguity(0.02, tau=0.5)))
    with pytest.raises(ValueError, match="horizon is 0"):
        least_favourable_model(network, solve_steady_state(network), horizon=0)
    with pytest.raises(ValueError, match="give the number of steps"):
        simulate_least_favourable(
            least_favourable_model(network, solve_steady_state(network)), np.random.default_rng(0), runs=1
        )


@pytest.mark.parametrize("steps", [0, -1, 8])
def test_steps_that_the_model_does_not_have(steps):
    network = ring_projectile()
    model = least_favourable_model(network, solve_steady_state(network), horizon=7)
    with pytest.raises(ValueError, match=f"steps is {steps}; expected at least 1 and at most 7"):
        simulate_least_favourable(model, np.random.default_rng(0), runs=1, steps=steps)
    assert len(simulate_least_favourable(model, np.random.default_rng(0), runs=1).y) == 7


def test_a_centre_without_steady_state_gives_its_status_on():
    blind = SensorNetwork(A=[[1.1]], Q=[[1.0]], C=[[[0.0]]], R=[[[1.0]]])
    found = least_favourable_model(blind, solve_steady_state(blind, 0.01))
    assert found.status == Status.UNDETECTABLE
    assert not found.exists
    with pytest.raises(ValueError, match="no least favourable model"):
        next(walk(found, np.random.default_rng(0), runs=1))


def test_drawn_outputs_lead_the_central_filter_to_the_drawn_error():
    """Run eq. (4) on the outputs that were drawn: its error must be the e that was drawn, to rounding."""
    network = random_network(np.random.default_rng(2), 3, 6)
    central = solve_steady_state(network, 0.4)
    drawn = simulate_least_favourable(
        least_favourable_model(network, central), np.random.default_rng(3), runs=5, steps=30
    )
    stacked = naive.stacked(network)
    G = naive.gain(stacked, central.V)
    estimate = np.tile(network.initial_mean, (5, 1))
    for t in range(29):
        estimate = estimate @ network.A.T + (drawn.y[t] - estimate @ network.C.T) @ G.T
        np.testing.assert_allclose(drawn.x[t + 1] - estimate, drawn.e[t + 1], atol=1e-11)


@pytest.mark.parametrize("horizon", [None, 12])
def test_drawn_errors_have_the_covariance_of_the_model(horizon):
    network = ring_projectile()
    found = least_favourable_model(network, solve_steady_state(network), horizon=horizon)
    runs = 20_000
    drawn = simulate_least_favourable(found, np.random.default_rng(11), runs=runs, steps=12)
    covariance = network.initial_covariance if horizon else found.error_covariance
    for t in range(12):
        at = found[t] if horizon else found
        whitened = np.linalg.solve(np.linalg.cholesky(covariance), drawn.e[t].T)
        sample = whitened @ whitened.T / runs
        # each entry has mean 1 or 0 and a standard deviation of at most sqrt(2 / runs); 5 of them in 252 comparisons
        assert np.abs(sample - np.eye(6)).max() < 5 * np.sqrt(2 / runs)
        covariance = at.closed_loop @ covariance @ at.closed_loop.T + at.closed_noise


def test_outputs_have_the_covariance_of_the_model():
    """y - C x = D v + D H e + ...: against eq. (34) with the stacked matrices."""
    network = random_network(np.random.default_rng(8), 2, 3, relays=0.0)
    found = least_favourable_model(network, solve_steady_state(network, 2.0))
    stacked = naive.stacked(network)
    at = naive.steady_model(stacked, found.V, float(found.theta))
    H, L = stacked.Gamma_D @ at.Gamma_H, stacked.Gamma_D @ at.Gamma_L
    wanted = H @ found.error_covariance @ H.T + L @ L.T
    runs = 50_000
    drawn = simulate_least_favourable(found, np.random.default_rng(4), runs=runs, steps=1)
    v = drawn.y[0] - drawn.x[0] @ network.C.T
    whitened = np.linalg.solve(np.linalg.cholesky(wanted), v.T)
    assert np.abs(whitened @ whitened.T / runs - np.eye(len(wanted))).max() < 5 * np.sqrt(2 / runs)


def test_model_of_a_filter_is_not_needed_for_its_status():
    network = scalar()
    beyond = solve_steady_state(network, 0.1)
    dynamics = error_dynamics(network, beyond, None, least_favourable_model(network, beyond))
    assert dynamics.status == Status.FOLD
    assert not dynamics.exists
