"""Where there is no answer, the status says why, numbers are NaN, and the other rows are what they are alone."""

from __future__ import annotations

from math import log

import numpy as np
import pytest
from numpy import ndarray
from tests.instances_random import random_network
from tests.reference import recursion

from tolnet import analysis
from tolnet.model import SensorNetwork, SteadyState

NUMBERS = ("theta", "spectral_radius", "attraction", "riccati_residual", "tolerance_residual")


def scalar(A: float, S: float, c: float) -> SteadyState:
    """One state, Q = 1."""
    return analysis.solve_steady_states(np.array([[A]]), np.eye(1), np.array([[[S]]]), np.array([c]))[0]


def assert_nothing(state: SteadyState) -> None:
    """Every number of a row without an answer is NaN."""
    assert not np.any(state.exists)
    for name in NUMBERS:
        assert np.isnan(getattr(state, name)).all(), name
    assert np.isnan(state.P).all()
    assert np.isnan(state.V).all()


def blind_star(A: ndarray, Q: ndarray) -> SensorNetwork:
    """Three nodes: 0 sees both states, 1 hears 0, 2 sees the second state only and hears nobody."""
    return SensorNetwork(
        A=A, Q=Q, C=[[[1.0, 0.3], [0.2, 1.0]], [[0.0, 1.0]], [[0.0, 1.0]]],
        R=[[[0.1, 0.0], [0.0, 0.2]], [[0.3]], [[0.1]]], edges=[[0, 1]],
    )  # fmt: skip


def test_an_undetectable_node_leaves_the_others_alone():
    network = blind_star(np.diag([1.2, 0.5]), np.eye(2))
    seen = analysis.detectability(network)
    np.testing.assert_array_equal(seen.detectable, [True, True, False])
    assert seen.centre_detectable
    assert seen.stabilisable
    assert [mode.modulus for mode in seen.offending(2)] == pytest.approx([1.2])
    assert seen.offending(0) == seen.offending(None) == []
    together = analysis.solve_steady_states(
        network.A, network.Q, network.information, np.full(3, 0.1), refused=np.array(["ok", "ok", "undetectable"])
    )
    assert_nothing(together[2])
    for k in (0, 1):
        alone = analysis.solve_steady_states(network.A, network.Q, network.information[[k]], np.array([0.1]))[0]
        assert str(together[k].status) == str(alone.status) == "ok"
        np.testing.assert_allclose(together[k].V, alone.V, rtol=1e-12, atol=1e-15)


def test_an_undetectable_centre():
    network = SensorNetwork(A=np.diag([1.2, 0.5]), Q=np.eye(2), C=[[[0.0, 1.0]]], R=[[[1.0]]], edges=[])
    state = analysis.solve_steady_state(network, 0.1)
    assert str(state.status) == "undetectable"
    assert_nothing(state)


@pytest.mark.parametrize("value", [1.0, -1.0])
def test_an_undriven_mode_on_the_circle(value: float):
    network = blind_star(np.array([[value, 0.0], [1.0, 0.5]]), np.diag([0.0, 1.0]))
    seen = analysis.detectability(network)
    assert not seen.stabilisable
    assert [mode.eigenvalue for mode in seen.offending_undriven()] == [value]
    state = analysis.solve_steady_state(network, 0.1)
    assert str(state.status) == "unstabilisable"
    assert_nothing(state)


def test_an_undriven_mode_that_decays_is_no_obstacle():
    network = blind_star(np.array([[0.9, 0.0], [1.0, 0.5]]), np.diag([0.0, 1.0]))
    state = analysis.solve_steady_state(network, 0.1)
    assert str(state.status) == "ok"
    end = recursion.run(network.A, network.Q, network.total_information, 0.1, steps=2000)
    assert float(state.theta) == pytest.approx(end.theta, rel=1e-9)


@pytest.mark.parametrize("angle", [0.3, 1.0, 3.0])
def test_a_hidden_rotation_is_found_in_any_basis(angle: float):
    """A conjugate pair on the unit circle that the only sensor cannot see, the basis turned at random."""
    T, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(4, 4)))
    turn = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    A = np.block([[np.array(turn), np.zeros((2, 2))], [np.zeros((2, 2)), np.diag([0.5, 0.7])]])
    C = np.array([[0.0, 0.0, 1.0, 1.0]])
    for basis in (np.eye(4), T):
        network = SensorNetwork(A=basis @ A @ basis.T, Q=np.eye(4), C=[C @ basis.T], R=[[[1.0]]], edges=[])
        seen = analysis.detectability(network)
        assert not seen.centre_detectable
        (mode,) = seen.offending(0)
        assert mode.modulus == pytest.approx(1.0)
        assert abs(mode.eigenvalue.imag) == pytest.approx(abs(np.sin(angle)))
        assert str(analysis.solve_steady_state(network, 0.0).status) == "undetectable"


def test_a_repeated_mode_is_seen_by_two_outputs_and_not_by_one():
    def network(C: list[list[float]]) -> SensorNetwork:
        return SensorNetwork(A=1.1 * np.eye(2), Q=np.eye(2), C=[C], R=[np.eye(len(C))], edges=[])

    assert str(analysis.solve_steady_state(network([[1.0, 2.0]]), 0.1).status) == "undetectable"
    assert str(analysis.solve_steady_state(network([[1.0, 2.0], [2.0, 1.0]]), 0.1).status) == "ok"


def test_a_defective_mode_is_seen_through_its_chain():
    """A Jordan block at 1.05: the head of the chain shows the whole of it, its tail nothing of the head."""
    A = np.array([[1.05, 1.0], [0.0, 1.05]])
    sees = SensorNetwork(A=A, Q=np.eye(2), C=[[[1.0, 0.0]]], R=[[[1.0]]], edges=[])
    blind = SensorNetwork(A=A, Q=np.eye(2), C=[[[0.0, 1.0]]], R=[[[1.0]]], edges=[])
    assert str(analysis.solve_steady_state(sees, 0.01).status) == "ok"
    assert str(analysis.solve_steady_state(blind, 0.01).status) == "undetectable"


def test_detectability_is_not_enough():
    """A = 0.9 without a sensor: P = 0.81 k P + 1 with k - 1 - log k = c has a solution while 0.81 k < 1."""
    end = 1 / 0.81 - 1 - log(1 / 0.81)
    for share in (0.5, 0.99, 0.999999):
        state = scalar(0.9, 0.0, share * end)
        assert str(state.status) == "ok"
        k = float(state.V[0, 0] / state.P[0, 0])
        assert k - 1 - log(k) == pytest.approx(share * end, rel=1e-10)
        assert float(state.P[0, 0]) == pytest.approx(1 / (1 - 0.81 * k), rel=1e-7)
        assert float(state.attraction) == pytest.approx(0.81 * k, rel=1e-9)
    beyond = np.array([1.000001, 1.01, 2.0, 1e6]) * end
    states = analysis.solve_steady_states(np.array([[0.9]]), np.eye(1), np.zeros((4, 1, 1)), beyond)
    assert_nothing(states)
    assert states.status[1:].tolist() == ["diverges"] * 3  # the first grows by a millionth a step: no telling


def test_without_process_noise_the_ambiguity_drives_the_filter():
    """A = 0.9, S = 1, Q = 0: V = k P and P = 0.81 k P / (1 + k P), hence P = (0.81 k - 1) / k for 0.81 k > 1."""
    A, Q, S = np.array([[0.9]]), np.zeros((1, 1)), np.ones((1, 1, 1))
    state = analysis.solve_steady_states(A, Q, S, np.array([0.1]))[0]
    assert str(state.status) == "ok"
    k = float(state.V[0, 0] / state.P[0, 0])
    assert k - 1 - log(k) == pytest.approx(0.1, rel=1e-12)
    assert float(state.P[0, 0]) == pytest.approx((0.81 * k - 1) / k, rel=1e-12)


@pytest.mark.parametrize("seed", [5, 38, 45])
def test_a_hopeless_filter_is_a_status_and_no_exception(seed: int):
    """Eight states that grow fivefold a step, one noise, hardly an output, c = 20,000; and a harmless filter."""
    network = random_network(np.random.default_rng(seed), 8, 1, radius=5.0, drives=1, noise_decades=2.0)
    S = np.concatenate([network.information, 100 * np.eye(8)[None]])
    states = analysis.solve_steady_states(network.A, network.Q, S, np.array([2e4, 0.01]))
    assert str(states[1].status) == "ok"
    if not states[0].exists:
        assert_nothing(states[0])


def test_a_negative_tolerance_is_misuse():
    with pytest.raises(ValueError, match="tolerance"):
        scalar(0.9, 1.0, -1.0)


def test_beyond_the_fold():
    """A = 0.9, S = 0.01: theta is largest at c = 0.0269 and falls beyond, where the filter settles all the same."""
    state = scalar(0.9, 0.01, 0.1)
    assert float(state.P[0, 0]) == pytest.approx(19.44, abs=5e-3)
    assert float(state.theta) == pytest.approx(0.01751, abs=5e-6)
    for c in (0.0268, 0.0269, 0.027, 0.1, 1.0, 30.0):
        state = scalar(0.9, 0.01, c)
        end = recursion.run(np.array([[0.9]]), np.eye(1), np.array([[0.01]]), c)
        assert str(state.status) == "ok"
        assert end.verdict == "settles"
        assert float(state.theta) == pytest.approx(end.theta, rel=1e-9)
        assert float(state.P[0, 0]) == pytest.approx(end.P[0, 0], rel=1e-9)


def test_a_relay_without_neighbours_in_a_network_that_settles():
    """Node 1 is a relay that hears nobody: S = 0. With a plant this stable only a large c makes it diverge."""
    network = SensorNetwork(A=[[0.9]], Q=[[1.0]], C=[[[1.0]], []], R=[[[1.0]], []], edges=[])
    A, Q, S = network.A, network.Q, network.information
    states = analysis.solve_steady_states(A, Q, np.concatenate([S, S]), np.array([0.01, 0.01, 0.1, 0.1]))
    assert states.status.tolist() == ["ok", "ok", "ok", "diverges"]
    np.testing.assert_array_equal(states.exists, [True, True, True, False])


def test_a_stack_is_what_its_members_are_alone():
    """Settling, oscillating, folded, diverging and refused filters in one stack."""
    rng = np.random.default_rng(9)
    A, Q = np.array([[0.9, 0.2], [0.0, 0.8]]), np.diag([1.0, 0.5])
    S = np.stack([np.zeros((2, 2)), 0.01 * np.eye(2), *(M @ M.T for M in rng.normal(size=(6, 2, 2)))])
    c = np.array([0.5, 0.5, 1e-14, 1e-3, 0.5, 100.0, 1e8, np.nan])
    together = analysis.solve_steady_states(A, Q, S, c)
    assert together.status[0] == "diverges"
    assert together.status[-1] == "no-steady-state"
    for k in range(1, len(c)):
        alone = analysis.solve_steady_states(A, Q, S[k : k + 1], c[k : k + 1])[0]
        assert str(alone.status) == together.status[k]
        for name in ("theta", "P", "V"):
            np.testing.assert_allclose(getattr(alone, name), getattr(together, name)[k], rtol=1e-11, atol=1e-13)


def test_large_tolerances_make_some_filter_oscillate():
    """A random network with n = 4 and N = 8 that settles at 0.02 and never at 1, as the recursion itself shows."""
    network = random_network(np.random.default_rng(31), 4, 8, radius=1.02, relays=0.9)
    for c, settles in ((0.02, True), (1.0, False), (50.0, False)):
        end = recursion.run(network.A, network.Q, network.total_information, c, steps=1000)
        state = analysis.solve_steady_state(network, c)
        assert end.verdict == ("settles" if settles else "oscillates")
        assert str(state.status) == ("ok" if settles else "oscillates")
        assert float(state.riccati_residual) < 1e-12
        assert float(state.tolerance_residual) < 1e-12
