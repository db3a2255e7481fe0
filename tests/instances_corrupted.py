"""Networks with corrupted channels for the tests: of every kind, drawn at random."""

from __future__ import annotations

from typing import Any

import numpy as np

from tolnet.model import CorruptedNetwork


def covariance(generator: np.random.Generator, n: int) -> np.ndarray:
    """A random covariance, symmetric to the last bit."""
    factor = generator.standard_normal((n, n))
    product = factor @ factor.T / n + 0.1 * np.eye(n)
    return (product + product.T) / 2


def arguments(seed: int, **changes: Any) -> dict[str, Any]:
    """Mixed p_i with relays, one-way links in a ring and more, periodic plants, exceptions on links."""
    generator = np.random.default_rng(seed)
    n, N = int(generator.integers(1, 5)), int(generator.integers(2, 6))
    T = int(generator.choice([1, 1, 2, 3]))
    sizes = generator.integers(0, 3, size=N)
    linked = generator.random((N, N)) < 0.3
    linked[np.arange(N), (np.arange(N) + 1) % N] = True
    np.fill_diagonal(linked, False)
    edges = np.argwhere(linked)
    weights = np.where(linked.T | np.eye(N, dtype=bool), generator.random((N, N)) + 0.1, 0.0)
    tau = generator.uniform(0.3, 1.0, N)
    A = generator.standard_normal((T, n, n)) / np.sqrt(n)
    return {
        "A": list(A) if T > 1 else A[0],
        "Q": covariance(generator, n),
        "F": 0.3 * generator.standard_normal((n, n)),
        "multiplicative_variance": [0.2, 0.0][: 1 + T % 2],
        "C": [generator.standard_normal((p, n)) for p in sizes],
        "R": [covariance(generator, p) for p in sizes],
        "fading_mean": tau,
        "fading_variance": tau * (1 - tau) * generator.choice([0.0, 0.5], N),
        "estimate_noise": 0.02,
        "matrix_noise": covariance(generator, n),
        "links": [{"from": int(edges[0, 0]), "to": int(edges[0, 1]), "estimate_noise": 0.5}],
        "edges": edges,
        "directed": True,
        "fusion": weights / weights.sum(axis=1, keepdims=True),
        "initial_covariance": np.array([covariance(generator, n) for _ in range(N)]),
        "initial_second_moment": covariance(generator, n),
        **changes,
    }


def drawn(seed: int, **changes: Any) -> CorruptedNetwork:
    """A network from those arguments."""
    return CorruptedNetwork(**arguments(seed, **changes))
