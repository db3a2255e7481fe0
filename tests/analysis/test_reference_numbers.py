"""The ring lattice after the published example, against the reference numbers of docs/mathematics.md."""

from __future__ import annotations

import numpy as np
import pytest
from tests.instances import ring_projectile
from tests.reference.test_oracles import REFERENCE

from tolnet import analysis


@pytest.mark.parametrize("c", REFERENCE)
def test_the_ring_lattice(c: float):
    network, want = ring_projectile(c), REFERENCE[c]
    np.testing.assert_allclose(
        np.diag(network.total_information)[3:], [7.68884822, 4.05107948, 3.47061219], rtol=0, atol=5e-9
    )
    centre = analysis.solve_steady_state(network)
    for name in ("theta", "trace_V", "trace_P"):
        number, digit = want[name]
        assert float(getattr(centre, name)) == pytest.approx(number, abs=digit)
    tolerances = analysis.local_tolerances(network, centre)
    numbers, digit = want["tolerances"]
    found = [tolerances.mean(), tolerances.min(), tolerances.max()]
    np.testing.assert_allclose(found, numbers, rtol=0, atol=digit)
    numbers, digit = want["nodes"]
    np.testing.assert_allclose(tolerances[[0, 9, 19]], numbers, rtol=0, atol=digit)
    A, Q, S = network.A, network.Q, network.information
    states = [analysis.solve_steady_states(A, Q, S, x) for x in (np.full(20, c), tolerances)]
    assert all(state.settles.all() for state in states)
    numbers, digit = want["mean_theta"]
    np.testing.assert_allclose([state.theta.mean() for state in states], numbers, rtol=0, atol=digit)
