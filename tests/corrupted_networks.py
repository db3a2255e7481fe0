"""Small networks with corrupted channels that differ in everything: sizes, rows of sensors, periods, bounds."""

from __future__ import annotations

import numpy as np

from tolnet.model import CorruptedNetwork, SimulationModel


def odd_network(seed: int = 0, *, window: int = 2, interval: object = 2) -> CorruptedNetwork:
    """Five nodes, three states, sensors of 0 to 2 rows, everything of period 2 or 3, unequal links and starts."""
    rng = np.random.default_rng(seed)
    n, N = 3, 5
    rows = [1, 2, 0, 1, 1]
    C = [np.eye(n)[rng.permutation(n)[:p]] for p in rows]
    C[0] = C[0] / np.linalg.norm(C[0])

    def covariance(scale: float) -> np.ndarray:
        X = rng.normal(size=(n, n))
        return scale * (X @ X.T + np.eye(n))

    return CorruptedNetwork(
        A=[0.95 * np.eye(n) + 0.1 * rng.normal(size=(n, n)) for _ in range(2)],
        F=0.2 * rng.normal(size=(n, n)),
        multiplicative_variance=[0.5, 0.0, 1.0],
        Q=covariance(0.05),
        C=C,
        R=[np.eye(p) * (1 + 0.3 * p) for p in rows],
        fading_mean=[1.0, 0.9, 1.0, 0.6, 0.8],
        fading_variance=[0.0, 0.003, 0.0, 0.02, 0.01],
        estimate_noise=0.01,
        matrix_noise=0.3,
        links=[{"from": 1, "to": 0, "estimate_noise": 0.04, "matrix_noise": 0.6}],
        edges=[[1, 0], [2, 1], [3, 2], [4, 3], [0, 4], [2, 0], [4, 0], [1, 3]],
        directed=True,
        window=window,
        interval=interval,
        initial_mean=[0.5, -0.2, 0.1],
        initial_second_moment=covariance(1.0) + np.eye(n),
        initial_covariance=[covariance(3.0) + 9 * np.eye(n) for _ in range(N)],
        simulation=SimulationModel(),
        name="odd",
    )
