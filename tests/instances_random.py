"""Random networks for comparisons: every kind that the model allows, each node seeing at least one output."""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from tolnet.model import SensorNetwork


def random_network(
    rng: np.random.Generator,
    n: int,
    N: int,
    *,
    radius: float | None = None,
    directed: bool = False,
    singular: bool = False,
    drives: int | None = None,
    relays: float = 0.2,
    noise_decades: float = 1.0,
    state_decades: float = 0.0,
    degree: float = 3.0,
) -> SensorNetwork:
    """A network with `rng`'s plant, sensors and graph.

    radius: spectral radius of A (None: between 0.5 and 1.05). singular: A gets a zero eigenvalue.
    drives: columns of B (None: n); fewer leave Q singular, generically still stabilisable.
    relays: share of nodes without a sensor, where a neighbour has one.
    noise_decades, state_decades: R_k and the units of the states spread by 10^(+-that).
    degree: mean number of others that a node hears.
    """
    A = _plant(rng, n, rng.uniform(0.5, 1.05) if radius is None else radius, singular)
    B = rng.normal(size=(n, n if drives is None else drives)) * 10 ** rng.uniform(-1.5, 0)
    hears = rng.random((N, N)) < degree / N
    if not directed:
        hears |= hears.T
    np.fill_diagonal(hears, True)
    p = rng.integers(1, 4, N)
    for k in np.flatnonzero(rng.random(N) < relays):
        was, p[k] = p[k], 0
        if not (p @ hears).all():
            p[k] = was
    unit = 10 ** rng.uniform(-state_decades, state_decades, n)
    C = [rng.normal(size=(p_k, n)) / unit for p_k in p]
    return SensorNetwork(
        A=A * unit[:, None] / unit,
        B=B * unit[:, None],
        C=C,
        R=[_noise(rng, int(p_k), noise_decades) for p_k in p],
        adjacency=hears,
        directed=directed,
    )


def _plant(rng: np.random.Generator, n: int, radius: float, singular: bool) -> ndarray:
    A = rng.normal(size=(n, n))
    if singular:
        u = rng.normal(size=n)
        A = A - np.outer(A @ u, u) / (u @ u)
    largest = np.abs(np.linalg.eigvals(A)).max()
    return A * (radius / largest) if largest > 1e-12 else A


def _noise(rng: np.random.Generator, p: int, decades: float) -> ndarray:
    D = np.eye(p) + 0.3 * rng.normal(size=(p, p))
    R = D @ D.T * 10 ** rng.uniform(-decades, decades)
    return np.asarray((R + R.T) / 2)


def poorly_informed(seed: int) -> tuple[ndarray, ndarray, ndarray]:
    """A, Q and S of a filter with 2 to 4 states, some of them hardly driven or hardly seen.

    Such filters have folds, turning points in c and several steady states at one c.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    A = rng.normal(size=(n, n))
    A = A * (rng.uniform(0.5, 1.2) / np.abs(np.linalg.eigvals(A)).max())
    B = rng.normal(size=(n, int(rng.integers(1, n + 1)))) * 10 ** rng.uniform(-2, 1)
    C = rng.normal(size=(p := int(rng.integers(1, n + 1)), n)) * 10 ** rng.uniform(-1.5, 1.5, size=(p, 1))
    Q, S = B @ B.T, C.T @ C
    return A, (Q + Q.T) / 2, (S + S.T) / 2
