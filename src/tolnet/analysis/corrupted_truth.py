"""What really happens in a network with corrupted channels: state, measurements and channel noise of many runs.

The draws of one instant do not depend on which filters look at them. The noise on matrices comes from a generator of
its own: shared by all runs (one path, which the covariances of DRKF then share too), or independent for each.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from tolnet.model import Complaint, CorruptedNetwork, InputError
from tolnet.model.worst_case import psd_factor


class CorruptedInstant(NamedTuple):
    """One instant k of many runs."""

    k: int
    x: Float[ndarray, "runs n"]
    y: Float[ndarray, "runs M"]
    """Measurements of all sensors, packed as in the network."""
    e: Float[ndarray, "runs E n"]
    """Noise on what was sent, one a pair; zero on a node's own."""
    D: Float[ndarray, "paths E n n"]
    """Noise on the matrices that were sent, likewise; one path for all runs, or one a run."""


def walk_corrupted(
    network: CorruptedNetwork, rng: Generator, path: Generator, *, runs: int, steps: int, shared: bool
) -> Iterator[CorruptedInstant]:
    """Draw instants 1 to `steps` of `runs` runs, eqs. (1)-(3), after instant 0, which has a state and nothing else.

    x_0 ~ N(m, V), V = Pi_0 - m m', scaled down where a P_{0,i} is smaller. All noises are as large as their bounds
    allow: w, v and eps Gaussian, fading and channels as network.simulation says (`Truth`).
    Raises InputError where simulation.fading or plant.initial_second_moment contradict the bounds.
    """
    truth = Truth(network)
    E, M, n = len(network.pairs), int(network.rows[-1]), network.n
    x = network.initial_mean + rng.normal(size=(runs, n)) @ truth.start.T
    paths = 1 if shared else runs
    nothing = np.zeros((runs, E, n)), np.zeros((paths, E, n, n))
    yield CorruptedInstant(0, x, np.zeros((runs, M)), *nothing)
    for k in range(1, steps + 1):
        before = network.at(k - 1)
        eps = np.sqrt(before.mu) * rng.normal(size=(runs, 1))
        w = rng.normal(size=(runs, n)) @ psd_factor(before.Q).T
        x = x @ before.A.T + eps * (x @ before.F.T) + w
        y = truth.measure(k, x, rng)
        yield CorruptedInstant(k, x, y, truth.estimate_noise(k, rng, runs), truth.matrix_noise(k, path, paths))


class Truth:
    """How large the noises are, as far as the bounds of the network leave it open."""

    def __init__(self, network: CorruptedNetwork) -> None:
        self.network, self.model = network, network.simulation
        self.own = network.pairs[:, 0] == network.pairs[:, 1]
        self.owner = np.repeat(np.arange(network.N), np.diff(network.rows))
        self.start = _start(network)

    def measure(self, k: int, x: Float[ndarray, "runs n"], rng: Generator) -> Float[ndarray, "runs M"]:
        """y = gamma C x + v, eq. (2)."""
        now = self.network.at(k)
        gamma = self._fading(now.tau, now.phi, rng, len(x))
        y = gamma[:, self.owner] * (x @ now.sensors.C.T)
        v = rng.normal(size=y.shape)
        for nodes, C, R in now.sensors.groups():
            rows = now.sensors.rows[nodes, None] + np.arange(C.shape[1])
            y[:, rows] += (np.linalg.cholesky(R) @ v[:, rows, None])[..., 0]
        return y

    def _fading(self, tau: ndarray, phi: ndarray, rng: Generator, runs: int) -> Float[ndarray, "runs N"]:
        u = rng.random((runs, len(tau)))
        if self.model.fading == "bernoulli":
            off = np.flatnonzero(tau * (1 - tau) > phi * (1 + 1e-9))
            if off.size:
                i, most = int(off[0]), float(tau[off[0]] * (1 - tau[off[0]]))
                raise InputError(
                    [
                        Complaint(
                            f"sensors[{i}].fading_variance",
                            f"is {phi[i]:.6g}; Bernoulli fading with mean {tau[i]:.6g} has {most:.6g}",
                        )
                    ]
                )
            return (u < tau).astype(float)
        if self.model.fading == "constant":
            return np.broadcast_to(tau, u.shape)
        half = np.minimum(np.sqrt(3 * phi), np.minimum(tau, 1 - tau))  # within [0, 1]
        return tau + half * (2 * u - 1)

    def estimate_noise(self, k: int, rng: Generator, runs: int) -> Float[ndarray, "runs E n"]:
        """Uniform on [-b, b], of covariance b^2 / 3 I: the largest b within the bound unless one is given."""
        E, n = len(self.own), self.network.n
        u = rng.uniform(-1, 1, size=(runs, E, n))
        least = np.linalg.eigvalsh(self.network.W_bar(k))[:, 0]
        return self._width(np.sqrt(3 * np.maximum(least, 0.0)))[:, None] * u

    def matrix_noise(self, k: int, rng: Generator, paths: int) -> Float[ndarray, "paths E n n"]:
        """Symmetric, entries uniform on [-b, b], so within n b I (Gershgorin): the largest b within the bound."""
        E, n = len(self.own), self.network.n
        upper = np.triu(rng.uniform(-1, 1, size=(paths, E, n, n)))
        least = np.linalg.eigvalsh(self.network.D_bar(k))[:, 0]
        width = self._width(np.maximum(least, 0.0) / n)
        return width[:, None, None] * (upper + np.triu(upper, 1).mT)

    def _width(self, largest: Float[ndarray, " E"]) -> Float[ndarray, " E"]:
        if self.model.channel == "none":
            return np.zeros(len(largest))
        given = self.model.half_width
        return np.where(self.own, 0.0, largest if given is None else given)

    def beyond_bounds(self) -> list[str]:
        """What the given half width makes larger than the filters believe; nothing for noise within its bounds."""
        b = self.model.half_width
        if b is None or self.model.channel == "none" or self.own.all():
            return []
        network, said = self.network, []
        W, D = (np.linalg.eigvalsh(bound(0))[~self.own, 0].min() for bound in (network.W_bar, network.D_bar))
        if b**2 / 3 > W * (1 + 1e-9):
            said.append(f"the covariance of the noise on estimates is {b**2 / 3:.4g} I, beyond its bound {W:.4g}")
        if network.n * b > D * (1 + 1e-9):
            said.append(f"the noise on matrices reaches {network.n * b:.4g} I, beyond its bound {D:.4g}")
        return said


def _start(network: CorruptedNetwork) -> Float[ndarray, "n n"]:
    """A factor of the covariance of x_0."""
    mean = network.initial_mean
    V = network.initial_second_moment - np.outer(mean, mean)
    values = np.linalg.eigvalsh(V)
    if values[0] < -1e-9 * max(abs(values[-1]), 1.0):
        raise InputError(
            [Complaint("plant.initial_second_moment", "is below the square of initial_mean; it bounds E x_0 x_0'")]
        )
    root = psd_factor(V)
    ratio = root.T @ np.linalg.solve(network.initial_covariance, root)
    return root / np.sqrt(max(1.0, float(np.linalg.eigvalsh(ratio)[:, -1].max())))
