"""Diffusion weights by rule, against the formulas written out node by node."""

from __future__ import annotations

import numpy as np
import pytest

from tolnet.design.diffusion import diffusion_matrix
from tolnet.model import InputError, SensorNetwork, UnsupportedError

RULES = ["uniform", "relative-degree", "metropolis", "laplacian", "none"]


def scalar_network(edges, N: int, *, directed: bool = False, diffusion: object = "relative-degree") -> SensorNetwork:
    return SensorNetwork(
        A=[[0.9]],
        B=[[1.0]],
        C=np.ones((N, 1, 1)),
        R=np.ones((N, 1, 1)),
        edges=edges,
        directed=directed,
        diffusion=diffusion,
    )


def random_network(seed: int, *, directed: bool) -> SensorNetwork:
    generator = np.random.default_rng(seed)
    N = int(generator.integers(1, 25))
    linked = generator.random((N, N)) < 0.3
    if not directed:
        linked = np.triu(linked, 1)
    np.fill_diagonal(linked, False)
    return scalar_network(np.argwhere(linked), N, directed=directed)


def by_the_book(network: SensorNetwork, rule: str) -> np.ndarray:
    """The formulas of the docstring, one entry at a time."""
    N = network.N
    hears = [set(network.neighbours(k).tolist()) for k in range(N)]
    n = [len(heard) for heard in hears]
    W = np.zeros((N, N))
    for k in range(N):
        for l in hears[k] - {k}:
            W[l, k] = {
                "uniform": 1 / n[k],
                "relative-degree": n[l] / sum(n[m] for m in hears[k]),
                "metropolis": 1 / max(n[l], n[k]),
                "laplacian": 1 / max(n),
                "none": 0.0,
            }[rule]
        W[k, k] = 1 - W[:, k].sum()
    return W


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("seed", range(8))
def test_rules_are_their_formulas_on_undirected_graphs(rule: str, seed: int):
    network = random_network(seed, directed=False)
    np.testing.assert_allclose(diffusion_matrix(network, rule).toarray(), by_the_book(network, rule), atol=1e-15)


@pytest.mark.parametrize("rule", ["uniform", "relative-degree", "none"])
@pytest.mark.parametrize("seed", range(8))
def test_rules_are_their_formulas_on_directed_graphs(rule: str, seed: int):
    network = random_network(seed, directed=True)
    np.testing.assert_allclose(diffusion_matrix(network, rule).toarray(), by_the_book(network, rule), atol=1e-15)


@pytest.mark.parametrize("rule", RULES)
def test_columns_sum_to_one_and_weigh_no_stranger(rule: str):
    network = random_network(3, directed=False)
    W = diffusion_matrix(network, rule)
    np.testing.assert_allclose(np.asarray(W.sum(axis=0)).ravel(), 1.0, rtol=1e-14)
    assert (W.toarray()[~network.adjacency.toarray()] == 0).all()
    assert W.data.min() > 0


@pytest.mark.parametrize("rule", ["metropolis", "laplacian"])
def test_averaging_rules_are_symmetric(rule: str):
    W = diffusion_matrix(random_network(5, directed=False), rule).toarray()
    np.testing.assert_array_equal(W, W.T)


@pytest.mark.parametrize("rule", ["metropolis", "laplacian"])
def test_averaging_rules_refuse_one_way_links(rule: str):
    with pytest.raises(UnsupportedError, match=f"{rule}.*one-way"):
        diffusion_matrix(scalar_network([[0, 1], [1, 0], [1, 2]], 3, directed=True), rule)


def test_averaging_rules_take_a_directed_graph_whose_links_all_work_both_ways():
    directed = scalar_network([[0, 1], [1, 0], [1, 2], [2, 1]], 3, directed=True)
    undirected = scalar_network([[0, 1], [1, 2]], 3)
    W = diffusion_matrix(directed, "metropolis")
    np.testing.assert_array_equal(W.toarray(), diffusion_matrix(undirected, "metropolis").toarray())


def test_orientation_node_that_hears_is_the_column():
    W = diffusion_matrix(scalar_network([[0, 1]], 2, directed=True), "uniform").toarray()
    np.testing.assert_array_equal(W, [[1.0, 0.5], [0.0, 0.5]])


def test_the_network_decides_where_no_rule_is_named():
    ring = [[0, 1], [1, 2]]
    assert (diffusion_matrix(scalar_network(ring, 3, diffusion="none")).toarray() == np.eye(3)).all()
    weights = np.array([[0.75, 0.5, 0.0], [0.25, 0.25, 0.5], [0.0, 0.25, 0.5]])
    own = scalar_network(ring, 3, diffusion=weights)
    np.testing.assert_array_equal(diffusion_matrix(own).toarray(), weights)


def test_an_unknown_rule_names_the_nearest():
    network = scalar_network([[0, 1]], 2)
    with pytest.raises(InputError, match=r"diffusion\.rule is 'metropolys'; did you mean 'metropolis'\?"):
        diffusion_matrix(network, "metropolys")
    with pytest.raises(InputError, match="expected one of relative-degree, uniform"):
        diffusion_matrix(network, "zzz")


def test_a_large_network_takes_no_loop_over_nodes():
    N = 200_000
    chain = scalar_network(np.stack([np.arange(N - 1), np.arange(1, N)], axis=1), N)
    for rule in RULES:
        W = diffusion_matrix(chain, rule)
        np.testing.assert_allclose(np.asarray(W.sum(axis=0)).ravel(), 1.0, rtol=1e-14)
