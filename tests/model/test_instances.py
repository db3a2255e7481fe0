"""The shared instance is the one whose reference numbers are published."""

from __future__ import annotations

import numpy as np
from tests.instances import ring_projectile


def test_ring_projectile_has_the_reference_information():
    network = ring_projectile()
    assert network.degree.tolist() == [5] * 20
    np.testing.assert_allclose(
        np.diag(network.total_information)[3:], [7.68884822, 4.05107948, 3.47061219], rtol=0, atol=5e-9
    )
    assert network.input is not None
    np.testing.assert_allclose(network.input, [0, 0, -1, 0, 0, -0.05], atol=1e-15)
