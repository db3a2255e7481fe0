"""Trajectories of the least favourable model: what a network would meet if the model were as wrong as it may be.

The model drives plant and sensors by u = H e + L eps with L = I + M' Psi M, the symmetric root of K. With m = M eps:

    1.  u = eps + M' q,   q = T F e + Psi m,   M = [B, -G D],   m = B eps_w - A Z sum_l C_l' R_l^-1 D_l eps_l
    2.  x+ = A x + r + B eps_w + Q q,   y = C x + D eps_v - C Z A' q,   e+ = F e + m + N q

so a step costs one product with the stacked C and nothing of the size of K.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from tolnet.model import LeastFavourableModel, SensorNetwork
from tolnet.model.covariances import psd_factor
from tolnet.model.sensors import Packed


class Instant(NamedTuple):
    """One time step of many runs."""

    x: Float[ndarray, "runs n"]
    """The state."""
    e: Float[ndarray, "runs n"]
    """The error of the centralised robust filter."""
    y: Float[ndarray, "runs M"]
    """The outputs of all sensors, packed as in the network."""


class Disturbance(NamedTuple):
    """What one time step does to many runs, wherever their states are."""

    e: Float[ndarray, "runs n"]
    """The error of the centralised robust filter."""
    output: Float[ndarray, "runs M"]
    """y - C x."""
    state: Float[ndarray, "runs n"]
    """x+ - A x - r."""


class Trajectories(NamedTuple):
    """The same for every time step."""

    x: Float[ndarray, "steps runs n"]
    e: Float[ndarray, "steps runs n"]
    y: Float[ndarray, "steps runs M"]


def simulate_least_favourable(
    model: LeastFavourableModel, rng: Generator, *, runs: int, steps: int | None = None
) -> Trajectories:
    """Draw `runs` trajectories of x, e and y under the least favourable model, eq. (34), `steps` long.

    See `walk` for where they start; `steps` defaults to, and is at most, the horizon of a time-varying model.
    Raises ValueError where the model does not exist, or for a steady one without `steps`.
    """
    longest = model.horizon
    if steps is None and longest is None:
        raise ValueError("a steady model has no horizon: give the number of steps")
    if steps is not None and not 1 <= steps <= (longest or steps):
        raise ValueError(f"steps is {steps}; expected at least 1" + (f" and at most {longest}" if longest else ""))
    instants = list(islice(walk(model, rng, runs=runs), steps))
    return Trajectories(*(np.stack(series) for series in zip(*instants, strict=True)))


def walk(model: LeastFavourableModel, rng: Generator, *, runs: int) -> Iterator[Instant]:
    """Draw x_t, e_t, y_t of `runs` independent runs, t = 0, 1, ...: to the horizon, or for ever where it is steady.

    The centre starts from the network's initial mean, x_0 = mean + e_0. A steady model starts with e_0 ~ N(0, R), so
    that e is stationary; a time-varying one with e_0 ~ N(0, V_0), V_0 the network's initial covariance.
    Raises ValueError where the model does not exist. Source: eq. (34).
    """
    network = model.network
    constant = 0.0 if network.input is None else network.input
    x = None
    for e, output, state in disturb(model, rng, runs=runs):
        x = network.initial_mean + e if x is None else x
        yield Instant(x, e, x @ network.C.T + output)
        x = x @ network.A.T + constant + state


def disturb(model: LeastFavourableModel, rng: Generator, *, runs: int) -> Iterator[Disturbance]:
    """Draw what drives such trajectories: it stays of one size where an unstable plant runs out of all doubles.

    Raises ValueError where the model does not exist. Source: eq. (34); `walk` says where e starts.
    """
    if not model.exists:
        raise ValueError(f"there is no least favourable model to draw from: {model.reason}")
    network = model.network
    steady = model.horizon is None
    covariance = model.error_covariance if steady else network.initial_covariance
    e = rng.normal(size=(runs, network.n)) @ psd_factor(covariance).T
    noise = _Noise(network)
    t = 0
    while steady or t < len(model.theta):
        at = model if steady else model[t]
        w, v, nu = noise.draw(rng, runs)
        AZ = network.A @ at.filtered
        m = w - nu @ AZ.T
        q = e @ at.steering.T + m @ at.tilt_root.T
        yield Disturbance(e, v - q @ AZ @ network.C.T, w + q @ network.Q)
        e = e @ at.loop.T + m + q @ at.noise
        t += 1


class _Noise:
    """Draws B eps_w, D eps_v and sum_l C_l' R_l^-1 D_l eps_l of the nominal model."""

    def __init__(self, network: SensorNetwork) -> None:
        self.process = psd_factor(network.Q)
        weights = np.zeros_like(network.C)  # R_l^-1 C_l, rows as in C
        self.groups: list[tuple[ndarray, ndarray]] = []
        sensors: Packed = network.sensors
        for nodes, C, R in sensors.groups():
            rows = network.rows[nodes, None] + np.arange(C.shape[1])
            weights[rows] = np.linalg.solve(R, C)
            self.groups.append((rows, np.linalg.cholesky(R)))
        self.weights = weights

    def draw(self, rng: Generator, runs: int) -> tuple[ndarray, ndarray, ndarray]:
        """(runs, n), (runs, M), (runs, n)."""
        w = rng.normal(size=(runs, len(self.process))) @ self.process.T
        eps = rng.normal(size=(runs, len(self.weights)))
        v = np.empty_like(eps)
        for rows, D in self.groups:
            v[:, rows] = np.einsum("kij,rkj->rki", D, eps[:, rows])
        return w, v, v @ self.weights
