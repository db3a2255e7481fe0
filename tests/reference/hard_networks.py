"""Random networks on which doubles lose their digits: one kind for each way in which users have met that.

skew      one axis of each sensor is 1e4 to 1e8 times more precise than the other, at random angles
units     states counted in units that differ by up to 1e16
jordan    chains of integrators or of slow poles, turned at random
unstable  plants that grow by up to 300 a step, with precise sensors
nearly    noise that drives one direction, and the others by 1e-16 to 1e-8 of it
tiny      next to no noise on a plant near the circle: the tolerance alone keeps P up
slow      plants that forget in up to 1e12 steps
cond      noise and information that span eight decades each, turned at random
quiet     no noise at all
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from tolnet.model import SensorNetwork

KINDS = ("skew", "units", "jordan", "unstable", "nearly", "tiny", "slow", "cond", "quiet")


def hard_network(kind: str, seed: int) -> tuple[SensorNetwork, float]:
    """A network of one to three nodes and one to four states, and its tolerance."""
    rng = np.random.default_rng([seed, *kind.encode()])
    n, N = int(rng.integers(2 if kind == "skew" else 1, 5)), int(rng.integers(1, 4))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.3, 1.05) / _radius(A)
    B = rng.normal(size=(n, n))
    C = [rng.normal(size=(int(rng.integers(1, 3)), n)) for _ in range(N)]
    R = [np.diag(10 ** rng.uniform(-1, 1, len(C_k))) for C_k in C]
    tolerance = 10 ** rng.uniform(-6, 3)
    match kind:
        case "skew":
            C = [rng.normal(size=(2, n)) for _ in range(N)]
            R = [np.diag([1.0, 10 ** rng.uniform(-16, -8)]) for _ in range(N)]
        case "units":
            d = 10 ** rng.uniform(-8, 8, n)
            A, B, C = A * d[:, None] / d, B * d[:, None], [C_k / d for C_k in C]
        case "jordan":
            pole = rng.choice([0.0, 1.0, -1.0, 0.5, 0.999])
            A = pole * np.eye(n) + np.diag(np.full(n - 1, 10 ** rng.uniform(-4, 3)), 1)
            if rng.random() < 0.5:
                T = _rotation(rng, n)
                A = T @ A @ T.T
            B *= 10 ** rng.uniform(-3, 0)
        case "unstable":
            A *= 10 ** rng.uniform(0, 2.5)
            R = [R_k * 10 ** rng.uniform(-6, 0) for R_k in R]
            B *= 10 ** rng.uniform(-3, 0)
        case "nearly":
            B = rng.normal(size=(n, 1)) @ rng.normal(size=(1, n))
            B += 10 ** rng.uniform(-16, -8) * rng.normal(size=(n, n))
            A *= 1.3
        case "tiny":
            B *= 10 ** rng.uniform(-16, -6)
            A *= rng.uniform(0.9, 1.1) / _radius(A)
        case "slow":
            A *= (1 - 10 ** rng.uniform(-12, -2)) / _radius(A)
        case "cond":
            B = _rotation(rng, n) * 10 ** rng.uniform(-6, 2, n)
            C = [10 ** rng.uniform(-3, 5, (len(C_k), 1)) * C_k for C_k in C]
        case "quiet":
            B = np.zeros((n, n))
    edges = [[k, k + 1] for k in range(N - 1)] if rng.random() < 0.7 else []
    return SensorNetwork(A=A, B=B, C=C, R=R, edges=edges), float(tolerance)


def _radius(A: ndarray) -> float:
    return float(np.abs(np.linalg.eigvals(A)).max())


def _rotation(rng: np.random.Generator, n: int) -> ndarray:
    return np.linalg.qr(rng.normal(size=(n, n)))[0]
