"""Tolerance tables made by hand: consistent shapes and exact numbers without solving anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tolnet.model.covariances import condition
from tolnet.model import Convention, SensorNetwork, Status, SteadyState, ToleranceTable, gamma_per


def hand_made(
    network: SensorNetwork,
    *,
    convention: Convention = "gamma",
    status: Mapping[int, Status] | None = None,
    centre: Status = Status.OK,
    seed: int = 0,
) -> ToleranceTable:
    """A table of positive definite P < V and a c_k a node; `status` says which nodes are other than ok.

    The numbers solve no equation. Nodes without an answer (neither ok nor oscillating) have NaN, as solved ones do.
    """
    generator = np.random.default_rng(seed)
    N, n = network.N, network.n
    words = np.array([(status or {}).get(k, Status.OK).value for k in range(N)])
    factors = generator.normal(size=(N + 1, n, n))
    P = factors @ factors.mT + np.eye(n)
    theta = 0.5 / np.linalg.eigvalsh(P)[:, -1]
    V = np.linalg.inv(np.linalg.inv(P) - theta[:, None, None] * np.eye(n))
    tolerance = 0.02 * generator.uniform(0.5, 1.0, N + 1)
    tolerance[N] = 0.02

    def filters(which: np.ndarray | int, S: np.ndarray, status: np.ndarray) -> SteadyState:
        answered = np.isin(status, [Status.OK.value, Status.OSCILLATES.value])
        gap = np.where(answered, 0.0, np.nan)

        posterior = condition(V[which], S)

        def numbers(value: Any) -> np.ndarray:
            return np.asarray(value + gap)

        return SteadyState(
            A=network.A,
            Q=network.Q,
            S=S,
            tolerance=np.asarray(tolerance[which] * gamma_per(convention)),
            tau=0.0,
            P=P[which] + gap[..., None, None],
            V=V[which] + gap[..., None, None],
            theta=numbers(theta[which]),
            spectral_radius=numbers(0.9),
            attraction=numbers(np.where(status == Status.OSCILLATES.value, 1.25, 0.75)),
            riccati_residual=numbers(1e-16),
            tolerance_residual=numbers(1e-16),
            error=numbers(1e-15),
            iterations=np.ones(np.shape(gap), dtype=np.int64),
            filtered=posterior.covariance + gap[..., None, None],
            gains={},
            status=status,
            reason=np.full(np.shape(gap), "", dtype=object),
        )

    return ToleranceTable(
        network=network,
        convention=convention,
        central=filters(N, network.total_information, np.array(centre.value)),
        local=filters(np.arange(N), network.information, words),
    )
