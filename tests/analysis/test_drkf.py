"""The covariances of Algorithm 1: reference numbers, a naive oracle, and what must hold for any network."""

from __future__ import annotations

import numpy as np
import pytest

from tolnet.analysis.drkf import step_drkf
from tolnet.model.examples import field

REFERENCE = {
    1: (3.374400, [5.570065, 5.826434, 5.802008, 5.541723]),
    2: (3.076228, [4.643341, 4.861358, 4.801546, 4.579983]),
    10: (3.673245, [3.400034, 3.538961, 3.502529, 3.359568]),
    40: (9.616262, [3.325149, 3.466143, 3.427847, 3.282440]),
}
"""tr Pi_k and tr P_{k,i} of the surrogate with base 1.01 and no matrix noise, docs/mathematics.md, section 13."""


def test_reference_numbers():
    network = field(base=1.01)
    P, Pi = network.initial_covariance, network.initial_second_moment
    for k in range(1, 41):
        step, Pi = step_drkf(network, k, P, Pi)
        P = step.P
        if k in REFERENCE:
            second_moment, traces = REFERENCE[k]
            assert np.trace(Pi) == pytest.approx(second_moment, abs=1e-6)
            assert np.trace(P, axis1=1, axis2=2) == pytest.approx(traces, abs=1e-6)
