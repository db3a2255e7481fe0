"""python-control plants at the door."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest

from tolnet.model import InputError, SensorNetwork

SENSOR: dict[str, Any] = {"C": np.ones((1, 1, 2)), "R": np.ones((1, 1, 1))}
A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.3]])


def plant(dt: Any) -> control.StateSpace:
    return control.StateSpace(A, B, np.eye(2), np.zeros((2, 1)), dt)


def test_a_discrete_plant_brings_its_matrices_and_time():
    network = SensorNetwork(A=plant(0.1), **SENSOR)
    np.testing.assert_array_equal(network.A, A)
    assert network.B is not None
    np.testing.assert_array_equal(network.B, B)
    assert network.dt == 0.1


def test_what_is_given_beside_a_plant_comes_first():
    assert SensorNetwork(A=plant(0.1), B=np.eye(2), dt=7.0, **SENSOR).dt == 7.0
    network = SensorNetwork(A=plant(0.1), Q=4 * np.eye(2), **SENSOR)
    assert network.B is None
    np.testing.assert_array_equal(network.Q, 4 * np.eye(2))


def test_discrete_time_of_unknown_length():
    assert SensorNetwork(A=plant(True), **SENSOR).dt is None
    assert SensorNetwork(A=plant(None), dt=0.5, **SENSOR).dt == 0.5


def test_time_that_is_not_discrete_is_refused():
    with pytest.raises(InputError, match=r"plant is a continuous-time system; sample it first: plant\.sample\(dt\)"):
        SensorNetwork(A=plant(0), **SENSOR)
    with pytest.raises(InputError, match="plant does not say whether its time is discrete"):
        SensorNetwork(A=plant(None), **SENSOR)


def test_a_sampled_plant_is_taken():
    sampled = control.StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]]).sample(0.1)
    network = SensorNetwork(A=sampled, **SENSOR)
    np.testing.assert_allclose(network.A, A, atol=1e-15)
    assert network.dt == 0.1
