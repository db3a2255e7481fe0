"""Fastest mixing against published values, closed forms and the dual."""

from __future__ import annotations

import numpy as np
import pytest

from tolnet import design
from tolnet.analysis.curvature import columns_of
from tolnet.design.weights.admissible import Admissible
from tolnet.design.weights.mixing import MixingDesign, design_mixing
from tolnet.model import InputError, SensorNetwork, UnsupportedError

TRIANGLE = [[0, 1], [1, 2], [0, 2]]
KNOWN = {
    "path of 3": ([[0, 1], [1, 2]], 3, 1 / 2),
    "triangle and an edge": ([*TRIANGLE, [2, 3]], 4, 7 / 11),
    "complete bipartite 2 + 3": ([[i, j] for i in (0, 1) for j in (2, 3, 4)], 5, 3 / 7),
    "wheel of 5": ([[0, 1], [1, 2], [2, 3], [0, 3], *([k, 4] for k in range(4))], 5, 1 / 4),
    "path of 7": ([[k, k + 1] for k in range(6)], 7, float(np.cos(np.pi / 7))),
    "complete of 6": ([[i, j] for i in range(6) for j in range(i)], 6, 0.0),
}
"""S. Boyd, P. Diaconis, L. Xiao, SIAM Review 46(4), 2004, section 1 (small graphs), and the path in closed form."""


def network(edges: list[list[int]], N: int, *, directed: bool = False) -> SensorNetwork:
    ones = np.ones((N, 1, 1))
    return SensorNetwork(A=[[0.9]], B=[[1.0]], C=ones, R=ones, edges=edges, directed=directed)


def fastest(graph: SensorNetwork, **asked: object) -> MixingDesign:
    constraints = design.Constraints(**asked)  # pyright: ignore[reportArgumentType]
    constraints.check(graph)
    return design_mixing(graph, Admissible.of(columns_of(graph.adjacency), constraints), constraints)


@pytest.mark.parametrize("name", KNOWN)
def test_published_values(name: str):
    edges, N, known = KNOWN[name]
    found = fastest(network(edges, N), symmetric=True)
    assert found.value == pytest.approx(known, abs=1e-6)
    assert found.value - 1e-6 <= found.bound <= found.value
    W = found.W.toarray()
    np.testing.assert_array_equal(W, W.T)
    np.testing.assert_allclose(W.sum(axis=0), 1, atol=1e-15)
    assert W.min() >= 0
    assert abs(np.linalg.eigvalsh(W))[:-1].max(initial=0.0) == pytest.approx(known, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_weights_that_need_not_be_symmetric_mix_at_least_as_fast(seed: int):
    rng = np.random.default_rng(seed)
    N = 6
    linked = np.triu(rng.random((N, N)) < 0.5, 1) | np.eye(N, k=1, dtype=bool)
    graph = network(np.argwhere(linked).tolist(), N)
    free, symmetric = fastest(graph), fastest(graph, symmetric=True)
    assert free.value <= symmetric.value + 1e-7
    assert free.value - 1e-6 <= free.bound <= free.value
    for rule in ("uniform", "relative-degree", "metropolis"):
        dense = design.diffusion_matrix(graph, rule).toarray()
        assert free.bound <= np.linalg.norm(dense - 1 / N, 2) + 1e-12
    lower = fastest(graph, own_weight=0.4)
    assert lower.W.diagonal().min() >= 0.4 - 1e-9
    assert lower.bound >= free.bound - 1e-6


def test_what_cannot_mix_is_refused():
    with pytest.raises(InputError, match="not connected: nodes 0 and 2 do not hear each other"):
        fastest(network([[0, 1], [2, 3]], 4))
    with pytest.raises(InputError, match="not connected"):
        fastest(network([[0, 1], [1, 2]], 3, directed=True))
    with pytest.raises(UnsupportedError, match="at most 60"):
        fastest(network([[k, k + 1] for k in range(60)], 61))
    assert fastest(network([], 1)).value == 0
