"""What is proved of a network is proved of the same network in any units of its states."""

from __future__ import annotations

import numpy as np
import pytest
from numpy import ndarray
from scipy.linalg import solve_discrete_lyapunov
from tests.instances_random import random_network

from tolnet.certificates import performance
from tolnet.certificates.filter_claims import SteadyStates, decide, find_centre
from tolnet.certificates.verdicts import Proved
from tolnet.cli import evidence
from tolnet.cli.console import Console
from tolnet.cli.subject import Subject, prepare
from tolnet.model import SensorNetwork

DECADES = 8.0


def in_units(network: SensorNetwork, unit: ndarray) -> SensorNetwork:
    """The same network, its states multiplied by these numbers."""
    sensors = [network.sensor(k) for k in range(network.N)]
    both = unit[:, None] * unit
    return SensorNetwork(
        A=network.A * (unit[:, None] / unit),
        Q=network.Q * both,
        C=[C / unit for C, _ in sensors],
        R=[R for _, R in sensors],
        adjacency=network.adjacency,
        initial_covariance=np.asarray(network.initial_covariance) * both,
    )


def case(seed: int) -> tuple[SensorNetwork, ndarray]:
    """A network, and units between 10^-8 and 10^8 for its states."""
    rng = np.random.default_rng(seed)
    network = random_network(rng, int(rng.integers(2, 6)), int(rng.integers(2, 6)))
    return network, 10.0 ** rng.uniform(-DECADES, DECADES, network.n)


def certified(network: SensorNetwork) -> Subject:
    """What `tolnet certify --tolerance 0` speaks of: the Kalman filter, which is the same in all units."""
    return prepare(network, 0.0, None, None, None, "float64", Console(json=False, quiet=True))


def deviations(network: SensorNetwork) -> tuple[ndarray, float]:
    """The covariance of every state of every filter, and the spectral radius of F, by scipy."""
    F, noise = performance.ExactDynamics(certified(network).evidence.exact).rounded()
    Q = np.asarray(solve_discrete_lyapunov(F, noise))
    return np.diagonal(Q).reshape(network.N + 1, network.n), float(np.abs(np.linalg.eigvals(F)).max())


@pytest.mark.parametrize("followed", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_mean_square_deviations_are_proved_in_any_units(seed: int, followed: bool, monkeypatch: pytest.MonkeyPatch):
    """By the whole covariance, and by following the noise, as larger networks are judged."""
    network, unit = case(seed)
    variances, radius = deviations(network)
    if followed:
        monkeypatch.setattr(performance, "MOST", 0)
        monkeypatch.setattr(evidence, "MOST", 0)
    found = certified(in_units(network, unit)).evidence.performance()
    assert isinstance(found, Proved), found.reason
    low, high = (float.fromhex(x) for x in found.keys["network"].split())
    mean = float((variances[:-1] * unit**2).sum(axis=1).mean())
    rounding = 1e4 * network.n * network.N * np.finfo(float).eps / (1 - radius) ** 2
    assert low * (1 - rounding) <= mean <= high * (1 + rounding)
    assert high - low <= 1e-6 * mean


@pytest.mark.parametrize("seed", range(6, 10))
def test_every_claim_is_proved_in_any_units(seed: int):
    network, unit = case(seed)
    subject = certified(in_units(network, unit))
    assert isinstance(subject.evidence.stability(), Proved)
    central, local = subject.central, subject.local
    centre = find_centre(subject.deployed, 0.0, central.P, float(central.theta))
    states = SteadyStates(
        ["centre", *range(network.N)], [0.0] * (network.N + 1), [central.P, *local.P], [0.0] * (network.N + 1), centre
    )
    for verdict in decide(states, subject.deployed, ("steady-state", "attraction", "tolerance", "convergence")):
        assert isinstance(verdict, Proved), verdict
