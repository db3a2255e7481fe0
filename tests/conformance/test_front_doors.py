"""What every way to a steady state promises, whichever door it is reached through."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy import ndarray
from tests.instances_random import random_network

from tolnet import analysis, design
from tolnet.model import SensorNetwork, Status, SteadyState

Door = Callable[[SensorNetwork, float], SteadyState]

DOORS: dict[str, Door] = {
    "centre": lambda network, c: analysis.solve_steady_state(network, c),
    "stack": lambda network, c: analysis.solve_steady_states(
        network.A, network.Q, network.information, np.full(network.N, c)
    ),
    "tau": lambda network, c: analysis.solve_steady_states(
        network.A, network.Q, network.information, np.full(network.N, c), tau=0.5
    ),
    "table": lambda network, c: design.choose_tolerances(network, c).local,
    "table's centre": lambda network, c: design.choose_tolerances(network, c).central,
    "uniform table": lambda network, c: design.choose_tolerances(network, c, uniform=True).local,
}
MATRICES = ("S", "P", "V")
NUMBERS = ("tolerance", "theta", "spectral_radius", "attraction", "riccati_residual", "tolerance_residual")
doors = pytest.mark.parametrize("door", DOORS.values(), ids=DOORS)


def network() -> SensorNetwork:
    """Five nodes; node 4 is a relay that hears nobody, which a stable plant allows while c is small."""
    drawn = random_network(np.random.default_rng(6), 3, 4, radius=0.95)
    sensors = [drawn.sensor(k) for k in range(4)]
    adjacency = np.zeros((5, 5))
    adjacency[:4, :4] = drawn.adjacency.toarray()
    return SensorNetwork(
        A=drawn.A, B=drawn.B, C=[*(C for C, _ in sensors), []], R=[*(R for _, R in sensors), []], adjacency=adjacency
    )


@pytest.mark.parametrize(
    ("door", "c"),
    [*((door, c) for door in DOORS for c in (0.0, 0.001)), ("stack", 0.5)],  # at 0.5 the relay's filter diverges
)
def test_shapes_statuses_and_numbers(door: str, c: float):
    state = DOORS[door](network(), c)
    stack = state.theta.shape
    assert stack in ((), (5,))
    for name in MATRICES:
        assert getattr(state, name).shape == (*stack, 3, 3)
    for name in NUMBERS:
        assert getattr(state, name).shape == stack
    assert state.iterations.dtype.kind == "i"
    for status, exists in zip(np.ravel(state.status).tolist(), np.ravel(state.exists).tolist(), strict=True):
        assert exists == (Status(status) in (Status.OK, Status.OSCILLATES))
    for name in ("P", "V", *NUMBERS[1:]):
        found = np.isfinite(getattr(state, name).reshape(*stack, -1)).all(axis=-1)
        np.testing.assert_array_equal(found, state.exists, err_msg=name)
    settled = np.ravel(state.settles)
    assert (np.ravel(state.attraction)[settled] < 1).all()
    assert (np.ravel(state.spectral_radius)[settled] < 1).all()
    assert (np.ravel(state.riccati_residual)[settled] < 1e-12).all()
    assert (np.ravel(state.tolerance_residual)[settled] < 1e-9).all()


@doors
def test_results_are_read_only_and_inputs_are_left_alone(door: Door):
    given = network()
    before: list[ndarray] = [given.A.copy(), given.Q.copy(), given.information.copy(), given.total_information.copy()]
    state = door(given, 0.001)
    for name in (*MATRICES, *NUMBERS, "A", "Q"):
        assert not getattr(state, name).flags.writeable, name
    with pytest.raises(AttributeError):
        state.theta = np.zeros(())  # pyright: ignore[reportAttributeAccessIssue]
    after = [given.A, given.Q, given.information, given.total_information]
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)


@doors
def test_the_same_question_has_the_same_answer_to_the_bit(door: Door):
    one, other = (door(network(), 0.001) for _ in range(2))
    for name in ("P", "V", *NUMBERS):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert np.ravel(one.status).tolist() == np.ravel(other.status).tolist()
