"""Instances that several tests share."""

from __future__ import annotations

import itertools

import numpy as np

from tolnet.model import Ambiguity, SensorNetwork

RANGES = ([1.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0])
"""The axes that a sensor of each type measures (the third output is noise only)."""


def ring_projectile(tolerance: float = 0.02) -> SensorNetwork:
    """The deterministic projectile network of the reference numbers in docs/mathematics.md: 20 nodes on a ring.

    Node k hears k, k +- 1 and k +- 2 (mod 20), measures the axes of type k mod 3, and has
    R_k = sqrt(k + 1) R0 with R0 = 0.5 diag(1, 4, 7) permuted by permutation k mod 6 in lexicographic order.
    """
    N, step = 20, 0.1
    Phi = np.kron([[0.0, 0.0], [1.0, 0.0]], np.eye(3))
    R0 = 0.5 * np.array([1.0, 4.0, 7.0])
    permutations = list(itertools.permutations(range(3)))
    gravity = np.array([0.0, 0.0, -10.0, 0.0, 0.0, 0.0])
    return SensorNetwork(
        A=np.eye(6) + step * Phi,
        B=np.sqrt(0.001) * np.eye(6),
        C=[np.hstack([np.zeros((3, 3)), np.diag(RANGES[k % 3])]) for k in range(N)],
        R=[np.sqrt(k + 1) * np.diag(R0[list(permutations[k % 6])]) for k in range(N)],
        edges=[[k, (k + d) % N] for k in range(N) for d in (1, 2)],
        input=(step * np.eye(6) + step**2 / 2 * Phi) @ gravity,
        dt=step,
        name="ring-projectile",
        ambiguity=Ambiguity(tolerance),
        diffusion="relative-degree",
    )
