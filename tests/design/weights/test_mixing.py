"""Fastest mixing against published values, closed forms and the dual."""

from __future__ import annotations

import numpy as np
import pytest

from tolnet import design
from tolnet.analysis.curvature import columns_of
from tolnet.design.weights import mixing
from tolnet.design.weights.admissible import Admissible
from tolnet.design.weights.mixing import MixingDesign, design_mixing
from tolnet.model import InputError, SensorNetwork, UnsupportedError
from tolnet.model.examples import random_network

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


def fastest(graph: SensorNetwork, *, sdp: bool = False, **asked: object) -> MixingDesign:
    constraints = design.Constraints(**asked)  # pyright: ignore[reportArgumentType]
    constraints.check(graph)
    return design_mixing(graph, Admissible.of(columns_of(graph.adjacency), constraints), constraints, sdp=sdp)


@pytest.mark.parametrize("sdp", [False, True])
@pytest.mark.parametrize("name", KNOWN)
def test_published_values(name: str, sdp: bool):
    edges, N, known = KNOWN[name]
    found = fastest(network(edges, N), symmetric=True, sdp=sdp)
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


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("own", [[0.0], [0.3], [1.0, 0.5, 1.0, *[0.1] * 9]])
def test_interior_points_and_the_general_solver_agree(symmetric: bool, own: list[float]):
    graph = random_network(12, 3)
    lower = np.resize(own, 12)
    mine = fastest(graph, symmetric=symmetric, own_weight=lower)
    other = fastest(graph, symmetric=symmetric, own_weight=lower, sdp=True)
    assert mine.value == pytest.approx(other.value, abs=1e-6)
    for found in (mine, other):
        assert found.value - 1e-6 <= found.bound <= found.value
        assert (found.W.diagonal() >= lower - 1e-9).all()
        np.testing.assert_allclose(found.W.sum(axis=0), 1, atol=1e-14)


@pytest.mark.parametrize("symmetric", [False, True])
def test_a_hundred_nodes_end_at_their_bound(symmetric: bool):
    graph = random_network(100, 0)
    found = fastest(graph, symmetric=symmetric)
    assert found.value - 1e-7 <= found.bound <= found.value
    for rule in ("metropolis", "uniform"):
        norm = np.linalg.norm(design.diffusion_matrix(graph, rule).toarray() - 1 / 100, 2)
        assert found.value < norm or (rule == "uniform" and symmetric)


def test_no_weight_has_a_choice():
    found = fastest(network([[0, 1], [1, 2]], 3), own_weight=1.0)
    assert found.W.toarray().tolist() == np.eye(3).tolist()
    assert found.value == pytest.approx(1, abs=1e-12)
    assert fastest(network([[0, 1]], 2), own_weight=1.0, symmetric=True).W.toarray().tolist() == np.eye(2).tolist()


def test_an_interrupt_leaves_the_best_rule(monkeypatch: pytest.MonkeyPatch):
    graph = random_network(12, 3)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(mixing, "solve_program_inside", stop)
    table = design.choose_tolerances(graph)
    for symmetric in (False, True):
        asked = design.Constraints(symmetric=symmetric, own_weight=0.2)
        found = design.optimise_diffusion(graph, table, "mixing", constraints=asked)
        assert found.interrupted
        assert (found.W.diagonal() >= 0.2 - 1e-12).all()
        assert not symmetric or (found.W != found.W.T).nnz == 0
        assert found.value == pytest.approx(np.linalg.norm(found.W.toarray() - 1 / 12, 2))
        assert found.value < 1
        assert np.isnan(found.bound)
        assert np.isnan(found.gap_closed)


def test_what_cannot_mix_is_refused():
    with pytest.raises(InputError, match="not connected: nodes 0 and 2 do not hear each other"):
        fastest(network([[0, 1], [2, 3]], 4))
    with pytest.raises(InputError, match="not connected"):
        fastest(network([[0, 1], [1, 2]], 3, directed=True))
    for N, sdp in ((301, False), (61, True)):
        path = network([[k, k + 1] for k in range(N - 1)], N)
        with pytest.raises(UnsupportedError, match=f"at most {N - 1}; symmetric weights are found up to"):
            fastest(path, sdp=sdp)
        with pytest.raises(UnsupportedError, match=f"at most {2 * (N - 1)}"):
            fastest(network([[k, k + 1] for k in range(2 * N)], 2 * N + 1), sdp=sdp, symmetric=True)
    assert fastest(network([], 1)).value == 0
