"""Filters for the claims that are proved in ball arithmetic: solved in floating point, ready to be proved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy import ndarray
from tests.instances import ring_projectile
from tests.instances_random import random_network
from tests.reference import determinants, fifty_digits
from tests.reference.exact import mp

from tolnet import analysis
from tolnet.certificates.exact_filter import Covariance, ExactFilter, Sensor
from tolnet.certificates.fixed_point import Box, find_box
from tolnet.model import SensorNetwork, SteadyState


@dataclass(frozen=True)
class Solved:
    """A filter, with what a solver says of its steady state."""

    exact: ExactFilter
    P: ndarray
    V: ndarray
    theta: float
    attraction: float
    gain: tuple[ndarray, ...]

    def box(self) -> Box:
        """A box that passes."""
        found = find_box(self.exact, self.P, self.theta)
        assert isinstance(found, Box), found
        return found

    def oracle(self) -> fifty_digits.Exact:
        """The steady state in 50 digits, from the book."""
        exact = self.exact
        return fifty_digits.steady_state(exact.A, exact.process.matrix, information(exact), exact.c)


def information(exact: ExactFilter) -> ndarray:
    """S of a filter, as mpmath numbers."""
    C = np.concatenate([sensor.C for sensor in exact.sensors])
    R = np.zeros((len(C), len(C)))
    at = 0
    for sensor in exact.sensors:
        p = len(sensor.C)
        R[at : at + p, at : at + p] = sensor.noise.matrix
        at += p
    return fifty_digits.information(C, R)


def sensors_of(network: SensorNetwork, nodes: list[int]) -> tuple[Sensor, ...]:
    """The sensors of these nodes."""
    pairs = (network.sensor(k) for k in nodes)
    return tuple(Sensor(C, Covariance(R)) for C, R in pairs)


def centre(network: SensorNetwork, c: float) -> Solved:
    """The centre of a network at c."""
    state = analysis.solve_steady_state(network, c)
    exact = ExactFilter(network.A, Covariance(network.Q), sensors_of(network, list(range(network.N))), c)
    return _solved(exact, state)


def node(network: SensorNetwork, c: float, k: int) -> Solved:
    """The filter of node k in a network at c."""
    tolerance = analysis.local_tolerances(network, analysis.solve_steady_state(network, c))
    states = analysis.solve_local_steady_states(network, tolerance)
    heard = sensors_of(network, determinants.hears(network, k))
    return _solved(ExactFilter(network.A, Covariance(network.Q), heard, float(tolerance[k])), states[k])


def _solved(exact: ExactFilter, state: SteadyState) -> Solved:
    P, V = (np.asarray(M).reshape(exact.A.shape) for M in (state.P, state.V))
    R = [np.linalg.inv(sensor.noise.matrix) for sensor in exact.sensors]
    S = sum((s.C.T @ R_inv @ s.C for s, R_inv in zip(exact.sensors, R, strict=True)), np.zeros_like(P))
    Z = V @ np.linalg.inv(np.eye(len(P)) + S @ V)
    gain = tuple(exact.A @ Z @ s.C.T @ R_inv for s, R_inv in zip(exact.sensors, R, strict=True))
    return Solved(exact, P, V, float(state.theta), float(state.attraction), gain)


CASES = {
    "kalman": (1, 3, 0.0, {}),
    "tiny": (2, 2, 1e-14, {}),
    "scalar": (3, 1, 0.3, {}),
    "three": (4, 3, 0.02, {}),
    "singular-A": (5, 3, 0.05, {"singular": True}),
    "few-drives": (6, 4, 0.02, {"drives": 2}),
    "scaled": (7, 4, 0.02, {"state_decades": 3.0}),
    "noise": (8, 3, 1.0, {"noise_decades": 4.0}),
    "large": (9, 2, 1e4, {}),
    "larger": (11, 3, 1e7, {}),
}
"""Seed, states, tolerance and further options of a random network."""


@cache
def case(name: str) -> Solved:
    """The centre of a random network."""
    seed, n, c, options = CASES[name]
    return centre(random_network(np.random.default_rng(seed), n, 4, **options), c)


@cache
def projectile(c: float = 0.02) -> Solved:
    """The centre of the projectile on a ring."""
    return centre(ring_projectile(), c)


def oscillating() -> Solved:
    """A filter whose steady state does not attract, by 1.6 a step."""
    return centre(random_network(np.random.default_rng(10), 3, 8, radius=1.02, relays=0.9), 50.0)


def scalar(A: float, Q: float, S: float, c: float) -> ExactFilter:
    """A filter with one state and one sensor, y = x + noise of variance 1 / S; none for S = 0."""
    seen = (Sensor(np.eye(1), Covariance(np.array([[1 / S]]))),) if S else ()
    return ExactFilter(np.array([[A]]), Covariance(np.array([[Q]])), seen, c)


def at(exact: ExactFilter, c: float) -> ExactFilter:
    """The same filter at another tolerance."""
    return replace(exact, c=c)


__all__ = ["CASES", "Solved", "at", "case", "centre", "mp", "node", "oscillating", "projectile", "scalar"]
