"""The covariances of Algorithm 1: reference numbers, a naive oracle, and what must hold for any network."""

from __future__ import annotations

import numpy as np
import pytest
from tests.instances_corrupted import drawn
from tests.reference import naive_channels as naive

from tolnet.analysis import follow_drkf, solve_drkf
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


@pytest.mark.parametrize("seed", range(12))
def test_it_agrees_with_the_textbook(seed: int):
    network = drawn(seed)
    generator = np.random.default_rng(seed)
    P, Pi = network.initial_covariance, network.initial_second_moment
    for k in range(1, 7):
        D = {}
        channel = np.zeros((len(network.pairs), network.n, network.n))
        for e, (i, j) in enumerate(network.pairs.tolist()):
            if i != j:
                channel[e] = generator.uniform(-1, 1) * network.D_bar(k)[e]
                D[i, j] = channel[e]
        expected, gains, updated, after = naive.step(network, k, P, Pi, D)
        step, Pi = step_drkf(network, k, P, Pi, channel=channel)
        P = step.P
        np.testing.assert_allclose(Pi, after, rtol=1e-12)
        np.testing.assert_allclose(step.P_tilde, updated, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(P, expected, rtol=1e-9, atol=1e-12)
        packed = np.concatenate([K.T for K in gains])
        np.testing.assert_allclose(step.K, packed.reshape(step.K.shape), rtol=1e-9, atol=1e-12)
        assert (np.linalg.eigvalsh(P) > 0).all()


def test_runs_are_carried_along():
    network = field()
    generator = np.random.default_rng(1)
    channel = generator.uniform(-0.05, 0.05, (3, len(network.pairs), 4, 4))
    channel = channel + channel.mT
    P = np.broadcast_to(network.initial_covariance, (3, 4, 4, 4))
    together, _ = step_drkf(network, 1, P, network.initial_second_moment, channel=channel)
    for run in range(3):
        alone, _ = step_drkf(network, 1, P[run], network.initial_second_moment, channel=channel[run])
        np.testing.assert_allclose(together.P[run], alone.P, rtol=1e-13)


def test_following_it_is_stepping_it():
    for seed in range(10):
        network = drawn(seed)
        found = follow_drkf(network, 12, channel="worst")
        P, Pi = network.initial_covariance, network.initial_second_moment
        for k in range(1, 13):
            step, Pi = step_drkf(network, k, P, Pi, channel=network.D_bar(k))
            P = step.P
            np.testing.assert_allclose(found.P[k], P, rtol=1e-9)
            np.testing.assert_allclose(found.K[k], step.K, rtol=1e-8, atol=1e-12)


def test_a_growing_state_does_not_drown_the_filter():
    """After 800 steps the second moment is 1e20, of which doubles keep 1e4; the recursion as published is lost."""
    network = field()
    steady, found = solve_drkf(network, channel="clean"), follow_drkf(network, 800)
    np.testing.assert_allclose(found.P[800], steady.P[800 % 157], rtol=1e-9)
    P, Pi = network.initial_covariance, network.initial_second_moment
    for k in range(1, 801):
        step, Pi = step_drkf(network, k, P, Pi)
        P = step.P
    assert np.abs(P - steady.P[800 % 157]).max() > 10
