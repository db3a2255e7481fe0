"""The tolerance from data: against the divergence in closed form, and on records that say nothing."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from tolnet.analysis.data import Record, tolerance_from_data
from tolnet.model import InputError, SensorNetwork, ShapeError, UnsupportedError

NETWORK = SensorNetwork(
    A=[[0.9, 0.1], [0.0, 0.8]],
    Q=np.eye(2) * 0.1,
    C=[[[1, 0]], [], [[0, 1.0], [1, 1]]],
    R=[[[1.0]], [], [[2.0, 0.3], [0.3, 1.0]]],
    edges=[[0, 1], [1, 2]],
)


def record(A, T, seed, scale=1.0, shift=0.0):
    """A record of the plant with another A, process noise `scale` times as large, and a constant push."""
    rng = np.random.default_rng(seed)
    x = np.zeros((T + 1, 2))
    for t in range(T):
        x[t + 1] = A @ x[t] + shift + scale * np.sqrt(0.1) * rng.normal(size=2)
    v = [rng.normal(size=(T, 1)), rng.normal(size=(T, 2)) @ np.linalg.cholesky(NETWORK.sensor(2)[1]).T]
    return Record(x, x[:-1] @ NETWORK.C.T + np.hstack(v))


def test_a_wrong_plant_gives_its_divergence():
    wrong = np.array([[0.95, 0.1], [0.0, 0.9]])
    states = solve_discrete_lyapunov(wrong, NETWORK.Q)
    truth = np.trace(np.linalg.solve(NETWORK.Q, (wrong - NETWORK.A) @ states @ (wrong - NETWORK.A).T))
    found = [tolerance_from_data(NETWORK, record(wrong, 2_000, seed), resamples=60) for seed in range(40)]
    error = np.array([f.tolerance for f in found]) - truth
    assert abs(error.mean()) < 3 * error.std() / np.sqrt(len(found))
    covered = np.mean([f.interval[0] < truth < f.interval[1] for f in found])
    assert covered >= 0.75  # nominally 0.95; a mode of 0.95 leaves few independent stretches in 2,000 steps


def test_a_larger_noise_gives_its_divergence():
    truth = 2 * (1.2**2 - 1 - np.log(1.2**2))
    found = tolerance_from_data(NETWORK, record(NETWORK.A, 40_000, 2, scale=1.2), resamples=100)
    assert found.tolerance == pytest.approx(truth, rel=0.05)
    assert found.ambiguity("nats").tolerance == pytest.approx(found.tolerance / 2)


def test_a_constant_push_counts():
    found = tolerance_from_data(NETWORK, record(NETWORK.A, 5_000, 3, shift=0.1), resamples=50)
    assert found.tolerance > 0.1


def test_nominal_records_give_little_and_the_bias_is_removed():
    found = [tolerance_from_data(NETWORK, record(NETWORK.A, 500, seed), resamples=100) for seed in range(20)]
    observed = np.array([f.observed for f in found])
    assert all(f.interval[0] == 0 for f in found[:1])
    assert np.mean(observed - [f.bias for f in found]) == pytest.approx(0, abs=3 * observed.std() / np.sqrt(20))
    assert np.mean([f.interval[0] <= 0 <= f.interval[1] for f in found]) >= 0.8


def test_the_same_record_gives_the_same_answer():
    data = record(NETWORK.A, 200, 4)
    assert tolerance_from_data(NETWORK, data) == tolerance_from_data(NETWORK, data)


def test_known_inputs_are_taken_away():
    data = record(NETWORK.A, 2_000, 5, shift=0.3)
    without = tolerance_from_data(NETWORK, data, resamples=50)
    known = tolerance_from_data(NETWORK, data._replace(u=np.full((2_000, 2), 0.3)), resamples=50)
    assert known.tolerance < 0.02 < without.tolerance


def test_likelihood_per_step():
    data = record(NETWORK.A, 300, 6)
    found = tolerance_from_data(NETWORK, data, method="likelihood")
    residual = np.hstack([data.x[1:] - data.x[:-1] @ NETWORK.A.T, data.y - data.x[:-1] @ NETWORK.C.T])
    R = np.zeros((3, 3))
    R[0, 0], R[1:, 1:] = 1.0, NETWORK.sensor(2)[1]
    Sigma = np.block([[NETWORK.Q, np.zeros((2, 3))], [np.zeros((3, 2)), R]])
    each = np.einsum("ti,ij,tj->t", residual, np.linalg.inv(Sigma), residual)
    expected = each.mean() + np.linalg.slogdet(2 * np.pi * Sigma)[1]
    assert found.tolerance == pytest.approx(expected, rel=1e-10)


def test_a_negative_likelihood_is_refused_with_the_reason():
    network = SensorNetwork(A=[[0.5]], Q=[[1e-6]], C=[[[1.0]]], R=[[[1e-6]]], edges=[])
    data = Record(np.zeros((50, 1)), np.zeros((49, 1)))
    with pytest.raises(UnsupportedError, match=r"below zero.*units"):
        tolerance_from_data(network, data, method="likelihood")


def test_a_singular_process_noise_is_refused():
    network = SensorNetwork(A=np.eye(2) / 2, Q=np.diag([1.0, 0.0]), C=[np.eye(2)], R=[np.eye(2)], edges=[])
    with pytest.raises(UnsupportedError, match="singular"):
        tolerance_from_data(network, Record(np.zeros((50, 2)), np.zeros((49, 2))))


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"x": np.zeros((10, 3))}, ShapeError, "x has shape"),
        ({"y": np.zeros((10, 3))}, ShapeError, "y has shape"),
        ({"u": np.zeros(3)}, ShapeError, "u has shape"),
        ({"y": np.full((50, 3), np.nan)}, InputError, "y has a value that is not finite"),
        ({"x": np.full((51, 2), 1e200)}, InputError, "x is so far from the model"),
        ({"x": np.full((51, 2), 1e308)}, InputError, "x is so far from the model"),
        ({"y": np.full((50, 3), -1e200)}, InputError, "y is so far from the model"),
    ],
)
def test_bad_records(change, error, match):
    data = record(NETWORK.A, 50, 7)._replace(**change)
    with pytest.raises(error, match=match):
        tolerance_from_data(NETWORK, data)


def test_short_records_say_how_long_they_must_be():
    with pytest.raises(InputError, match="5 transitions; at least 8 are needed"):
        tolerance_from_data(NETWORK, record(NETWORK.A, 5, 8))


def test_noiseless_outputs_are_not_of_this_model():
    data = record(NETWORK.A, 100, 9)
    with pytest.raises(InputError, match="no residual"):
        tolerance_from_data(NETWORK, data._replace(y=data.x[:-1] @ NETWORK.C.T))
