"""Sensors far more precise than the prediction: six digits, or a status that says so, never a crash."""

from __future__ import annotations

import numpy as np
import pytest
from tests.reference import exact_filter

from tolnet import analysis, design
from tolnet.model import SensorNetwork, Status

A = np.array([[0.9, 0.3, 0.0], [-0.3, 0.9, 0.1], [0.2, 0.0, 0.8]])


def network(variance: float, **changes) -> SensorNetwork:
    """Two sensors with skew axes, noise of this variance, on a plant whose noise has the variance 1."""
    C = [np.array([[0.6, 0.8, 0.3]]), np.array([[0.1, -0.7, 0.9]])]
    return SensorNetwork(A=A, B=np.eye(3), C=C, R=[[[variance]]] * 2, edges=[[0, 1]], **changes)


@pytest.mark.parametrize("variance", [1e-2, 1e-6])
def test_precise_sensors_have_answers(variance):
    own = network(variance)
    table = design.choose_tolerances(own, 0.02)
    assert table.ok
    W = design.diffusion_matrix(own)
    for found in (analysis.evaluate_filters(table, W), analysis.follow_filters(table, W, 5)):
        assert {each.status for each in found.values()} == {Status.OK}


@pytest.mark.parametrize("variance", [1e-14, 1e-18, 1e-25])
@pytest.mark.parametrize("c", [0.0, 0.02, 1e6])
def test_sensors_beyond_doubles_have_a_table(variance: float, c: float):
    """The table is right to six digits, from the sensors' rows; performance, computed in doubles, is refused."""
    own = network(variance)
    table = design.choose_tolerances(own, c)
    assert table.ok
    for k, state in enumerate(table.local):
        its = exact_filter.filter_of(own, own.neighbours(k).tolist())
        truth = exact_filter.polish(its, float(state.tolerance), state.P, float(state.theta))
        np.testing.assert_allclose(state.P, truth.P, rtol=1e-9)
        np.testing.assert_allclose(table.gain(k)[1], truth.gain, rtol=1e-6, atol=1e-9 * np.abs(truth.gain).max())
    W = design.diffusion_matrix(own)
    for found in (analysis.evaluate_filters(table, W), analysis.follow_filters(table, W, 5)):
        for each in found.values():
            assert each.status != Status.OK
            assert each.reason
            assert np.isnan(each.msd).all()


def test_a_transient_that_rounding_hides_is_refused_with_its_step():
    own = network(1e-6, initial_covariance=1e8 * np.eye(3))
    table = design.choose_tolerances(own, 0.02)
    assert table.ok
    found = analysis.follow_filters(table, design.diffusion_matrix(own), 5)
    assert {each.status for each in found.values()} == {Status.NOT_CONVERGED}
    assert all("at step 0 the sensors are so precise" in each.reason for each in found.values())
    assert analysis.simulate_filters(table, design.diffusion_matrix(own), runs=2, steps=2)["KFC"].status != Status.OK
