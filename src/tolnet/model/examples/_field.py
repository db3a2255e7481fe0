"""Surrogates of the published temperature field, whose own numbers are not available."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.model.channels import SimulationModel
from tolnet.model.corrupted import CorruptedNetwork

PERIOD = 157
"""Instants of A that are kept: sin(0.2 k) has turned 5 times less 0.016 rad after so many, so that a simulation of
fewer steps sees exactly the A_k below, and a longer one a seam of at most 2e-4."""

TAU = np.array([1.0, 0.8, 0.7, 0.9])
HALF_WIDTH = np.array([0.0, 0.1, 0.2, 0.05])
"""Fading of the four kinds of sensors: uniform on tau - h to tau + h, hence phi = h^2 / 3."""
NOISE = 0.1
"""Half width b of the uniform noise on the channels; its bounds are b^2 / 3 I and n b I (Gershgorin)."""

SEED, RADIUS, LARGE = 1, 0.23, 50


def field(base: float = 1.03) -> CorruptedNetwork:
    """Four cells in a ring exchange heat and heat up; a sensor sits in each, and hears the next.

        A_k = (base + 0.01 sin 0.2 k) I + 0.2 L,  L = -I and 1/2 to both neighbours;   F = 0.3 (I - 1 1' / 4),  mu = 1
        Q = 0.1 I,  C_i = e_i',  R_i = 1,  tau = 1, 0.8, 0.7, 0.9,  h = 0, 0.1, 0.2, 0.05,  a_ii = a_i,i+1 = 1/2
        x_0 ~ N(0, I),  estimates start at 0 with P_0 = 2 I;  b = 0.1

    The mean temperature grows without bound (base + 0.01 sin > 1) and the multiplicative noise leaves it alone.
    A surrogate: it shows what the published example shows, but its numbers are ours.
    Source: docs/mathematics.md, section 13.
    """
    return _network(
        base,
        kinds=np.arange(4),
        edges=np.array([[1, 0], [2, 1], [3, 2], [0, 3]]),
        directed=True,
        positions=np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        name="field",
        description="4 sensors in a field that heats up (a surrogate of the published example)",
    )


def field_50(seed: int = SEED) -> CorruptedNetwork:
    """The same field watched by 50 sensors, each of one of the four kinds at random, a_ij = 1 / |N_i|.

    Nodes are uniform in the unit square and linked where closer than 0.23, drawn again until connected; what is
    measured does not depend on where a sensor stands. A surrogate, too.
    """
    from scipy.sparse import csgraph
    from scipy.spatial.distance import pdist

    generator = np.random.default_rng(seed)
    first, second = np.triu_indices(LARGE, 1)
    while True:
        positions = np.round(generator.random((LARGE, 2)), 4)
        near = pdist(positions) < RADIUS
        edges = np.stack([first[near], second[near]], axis=1)
        graph = sparse.coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(LARGE, LARGE))
        if csgraph.connected_components(graph, directed=False, return_labels=False) == 1:
            break
    return _network(
        1.03,
        kinds=generator.integers(4, size=LARGE),
        edges=edges,
        directed=False,
        positions=positions,
        name="field-50",
        description="50 sensors in the same field (a surrogate of the published example)",
    )


def _network(
    base: float,
    *,
    kinds: Int[ndarray, " N"],
    edges: Int[ndarray, "E 2"],
    directed: bool,
    positions: Float[ndarray, "N 2"],
    name: str,
    description: str,
) -> CorruptedNetwork:
    n = 4
    eye = np.eye(n)
    L = 0.5 * (np.roll(eye, 1, axis=0) + np.roll(eye, -1, axis=0)) - eye
    return CorruptedNetwork(
        A=[(base + 0.01 * np.sin(0.2 * k)) * eye + 0.2 * L for k in range(PERIOD)],
        F=0.3 * (eye - 1 / n),
        multiplicative_variance=1.0,
        Q=0.1 * eye,
        C=eye[kinds][:, None, :],
        R=np.ones((len(kinds), 1, 1)),
        fading_mean=TAU[kinds],
        fading_variance=HALF_WIDTH[kinds] ** 2 / 3,
        estimate_noise=NOISE**2 / 3,
        matrix_noise=n * NOISE,
        edges=edges,
        directed=directed,
        fusion="uniform",
        initial_covariance=2 * eye,
        initial_second_moment=eye,
        simulation=SimulationModel(fading="uniform", channel="uniform", half_width=NOISE),
        states=[f"T{i + 1}" for i in range(n)],
        positions=positions,
        name=name,
        description=description,
    )
