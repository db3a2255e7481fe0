"""Extended precision: what doubles vouch for comes out the same, and the parts do what they say."""

from __future__ import annotations

import numpy as np
import pytest
from tests.instances_random import random_network

from tolnet import analysis, design
from tolnet.analysis.extended_algebra import distance, matrix, precision
from tolnet.analysis.local_tolerance import LocalTolerances
from tolnet.analysis.sources import Sources
from tolnet.model import Status


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("c", [0.0, 1e-6, 0.02, 3.0])
def test_what_doubles_vouch_for_is_the_same(seed: int, c: float):
    network = random_network(np.random.default_rng(seed), 1 + seed % 4, 4)
    table = design.choose_tolerances(network, c)
    sources = Sources.of_nodes(network)
    exact = LocalTolerances(network, table.central).exact if c else lambda k: 0.0
    for k in np.flatnonzero(table.local.settles & (table.local.error > np.finfo(float).eps)).tolist():
        state, found = table.local[k], sources.solve(k, float(table.local.tolerance[k]), undriven=False)
        error = float(state.error)
        units = np.sqrt(np.outer(np.diag(found.P), np.diag(found.P)))
        assert np.abs((state.P - found.P) / units).max() <= error
        assert float(state.theta) == pytest.approx(found.theta, rel=error)
        assert float(state.spectral_radius) == pytest.approx(found.spectral_radius, rel=error)
        assert float(state.attraction) == pytest.approx(found.attraction, rel=100 * error)
        assert exact(k) == pytest.approx(float(state.tolerance), rel=1e-8)
        G = table.gain(k)[1]
        assert found.gain is not None
        assert np.abs(G - found.gain).max(initial=0.0) <= 1e-7 * np.abs(found.gain).max(initial=0.0)


def test_a_guess_that_is_not_quite_symmetric_is_no_obstacle():
    """Newton's method in doubles leaves the last bit of P unsymmetric."""
    network = random_network(np.random.default_rng(3), 3, 4)
    central = analysis.solve_steady_state(network, 0.1)
    P = central.P + np.triu(np.full((3, 3), 1e-16 * np.abs(central.P).max()), 1)
    found = Sources.of_centre(network).solve(0, 0.1, False, (P, float(central.theta)), only_near=True)
    np.testing.assert_allclose(found.P, central.P, rtol=1e-9)
    assert found.riccati_residual < 1e-60


def test_several_filters_that_oscillate_keep_their_numbers():
    network = random_network(np.random.default_rng(31), 4, 8, radius=1.02, relays=0.9)
    table = design.choose_tolerances(network, 1.0)
    assert table.local.exists.all()
    restless = table.local.attraction >= 1
    assert restless.sum() == 6
    np.testing.assert_array_equal(table.local.status == Status.OSCILLATES, restless)


def test_distance_is_in_the_units_of_the_states():
    d = np.array([1e-15, 1.0, 1e20])
    X = np.outer(d, d) * np.array([[1.0, 0.1, 0.0], [0.1, 1.0, 0.2], [0.0, 0.2, 1.0]])
    Y = X.copy()
    Y[0, 1] += 3e-7 * d[0] * d[1]
    with precision():
        assert distance(matrix(X), matrix(Y)) == pytest.approx(3e-7, rel=1e-6)
        assert distance(matrix(X), matrix(X)) == 0
