"""Stacks of fusion problems: well and badly scaled, with and without room beside the reference weights."""

from __future__ import annotations

import numpy as np
from numpy import ndarray


def covariances(rng: np.random.Generator, B: int, J: int, n: int, *, units: float = 0.0) -> ndarray:
    """Omega_j = P_j^-1 of random covariances; `units` decades up and down between the units of the states."""
    X = rng.normal(size=(B, J, n, n))
    Omega = np.linalg.inv(X @ X.mT + 0.1 * np.eye(n))
    scale = 10.0 ** rng.uniform(-units, units, size=(B, 1, n))
    Omega *= scale[..., :, None] * scale[..., None, :]
    return (Omega + Omega.mT) / 2


def stale(rng: np.random.Generator, B: int, J: int, n: int, L: int) -> tuple[ndarray, ndarray]:
    """J current pairs and older ones of a window L, which carry more noise; uniform weights of the current ones."""
    current = covariances(rng, B, J, n)
    P, pairs = np.linalg.inv(current), [current]
    for _ in range(L - 1):
        P = 1.02 * P + 0.1 * np.eye(n)
        pairs.append(np.linalg.inv(P))
    Omega = np.concatenate(pairs, axis=1)
    reference = np.zeros((B, J * L))
    reference[:, :J] = 1 / J
    return (Omega + Omega.mT) / 2, reference


def some_reference(rng: np.random.Generator, B: int, J: int) -> ndarray:
    """Random weights on the first half of the pairs."""
    a = rng.dirichlet(np.ones(J), B)
    a[:, (J + 1) // 2 :] = 0
    return a / a.sum(axis=1, keepdims=True)
