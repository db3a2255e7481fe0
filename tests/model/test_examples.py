"""The built-in problems are what they say, and come out of their generators again."""

from __future__ import annotations

from importlib import resources

import networkx
import numpy as np
import pytest
from tests.model.networks import assert_same

from tolnet import model
from tolnet.model import InputError, SensorNetwork
from tolnet.model.examples import projectile, random_network


def locally_observable(network: SensorNetwork) -> bool:
    """Whether every (A, C_k^loc) is observable, by the rank of its observability matrix."""
    n = network.n
    for S in network.information:
        powers = [S @ np.linalg.matrix_power(network.A, t) for t in range(n)]
        if np.linalg.matrix_rank(np.concatenate(powers)) < n:
            return False
    return True


def connected(network: SensorNetwork) -> bool:
    return networkx.is_connected(networkx.from_scipy_sparse_array(network.adjacency))


def test_the_shipped_projectile_is_the_default_draw(tmp_path):
    shipped = resources.files("tolnet.model.examples").joinpath("projectile.toml").read_bytes()
    written = model.save(projectile(), tmp_path / "projectile.toml", arrays=False)[0]
    assert written.read_bytes() == shipped, "run scripts/make_projectile.py"
    assert_same(model.example("projectile"), projectile())
    assert model.example("projectile").digest == model.load(written).digest


@pytest.mark.parametrize("links", [37, 46, 68])
@pytest.mark.parametrize("seed", range(5))
def test_projectile_networks_are_as_published(seed, links):
    network = projectile(seed, links)
    assert (network.N, network.n, len(network.links)) == (20, 6, links)
    assert connected(network)
    assert locally_observable(network)
    assert not network.directed
    assert network.B is not None
    np.testing.assert_array_equal(network.B, np.sqrt(0.001) * np.eye(6))
    np.testing.assert_allclose(network.Q, 1e-3 * np.eye(6), rtol=1e-15)
    np.testing.assert_array_equal(network.initial_covariance, np.eye(6))
    assert network.input is not None
    np.testing.assert_allclose(network.input, [0, 0, -1, 0, 0, -0.05], rtol=1e-14)
    expected = np.eye(6)
    expected[range(3, 6), range(3)] = 0.1
    np.testing.assert_array_equal(network.A, expected)
    types = {(1.0, 1.0, 0.0), (1.0, 0.0, 1.0), (0.0, 1.0, 1.0)}
    for k in range(20):
        C, R = network.sensor(k)
        assert not C[:, :3].any()
        assert tuple(np.diag(C[:, 3:])) in types
        assert np.count_nonzero(C) == 2
        np.testing.assert_allclose(sorted(np.diag(R)), np.sqrt(k + 1) * np.array([0.5, 2.0, 3.5]), rtol=1e-15)
        assert np.count_nonzero(R) == 3
    assert network.ambiguity == model.Ambiguity(0.02)
    assert network.diffusion == "relative-degree"
    assert network.positions is not None
    shortest = np.sort(np.linalg.norm(network.positions[:, None] - network.positions, axis=2)[np.triu_indices(20, 1)])
    lengths = np.linalg.norm(np.subtract(*network.positions[network.links.T]), axis=1)
    np.testing.assert_array_equal(np.sort(lengths), shortest[:links])


def test_projectile_draws_are_repeatable_and_different():
    assert_same(projectile(3), projectile(3))
    assert_same(projectile(3), projectile(np.random.default_rng(3)))
    assert (projectile(3).C != projectile(4).C).any()
    assert_same(model.example("projectile", seed=3), projectile(3))


@pytest.mark.parametrize("links", [18, 191])
def test_projectile_graphs_that_do_not_exist(links):
    with pytest.raises(InputError, match=f"{links} links were asked for, which no connected graph of 20 nodes has"):
        projectile(0, links)


def test_projectile_networks_of_two_nodes():
    network = projectile(0, links=1, nodes=2)
    assert locally_observable(network)


def test_hopeless_draws_end(monkeypatch):
    monkeypatch.setattr("tolnet.model.examples._projectile.DRAWS", 200)
    with pytest.raises(InputError, match="200 draws gave no connected geometric graph of 20 nodes with 19 links"):
        projectile(0, links=19)
    monkeypatch.setattr("tolnet.model.examples._projectile.AXES", np.ones((1, 3)))
    with pytest.raises(InputError, match=r"200 draws .* where every node hears all three axes; ask for more links"):
        projectile(0, links=100)


def test_ieee14_is_the_grid():
    """Branches and reactances as published for the IEEE 14-bus test case (per unit; taps of its transformers)."""
    network = model.example("ieee14")
    lines = {
        (1, 2): 0.05917, (1, 5): 0.22304, (2, 3): 0.19797, (2, 4): 0.17632, (2, 5): 0.17388, (3, 4): 0.17103,
        (4, 5): 0.04211, (6, 11): 0.19890, (6, 12): 0.25581, (6, 13): 0.13027, (7, 8): 0.17615, (7, 9): 0.11001,
        (9, 10): 0.08450, (9, 14): 0.27038, (10, 11): 0.19207, (12, 13): 0.19988, (13, 14): 0.34802,
    }  # fmt: skip
    transformers = {(4, 7): 0.20912 * 0.978, (4, 9): 0.55618 * 0.969, (5, 6): 0.25202 * 0.932}
    b = {(i - 1, j - 1): 1 / x for (i, j), x in (lines | transformers).items()}
    assert sorted(b) == network.links.tolist() or {tuple(link) for link in network.links.tolist()} == set(b)
    assert (network.N, network.n) == (14, 13)
    np.testing.assert_array_equal(network.A, 0.98 * np.eye(13))
    np.testing.assert_array_equal(network.Q, 1e-4 * np.eye(13))
    for bus in range(14):
        C, R = network.sensor(bus)
        np.testing.assert_array_equal(R, 0.01**2 * np.eye(len(C)))
        full = np.insert(C, 0, 0.0, axis=1)
        flows = full[1:] if bus else full
        if bus:
            np.testing.assert_array_equal(full[0], np.eye(14)[bus])
        others = [l for l in network.neighbours(bus).tolist() if l != bus]
        assert len(flows) == len(others)
        expected = []
        for other in others:
            row = np.zeros(14)
            row[[bus, other]] = np.array([1, -1]) * b[min(bus, other), max(bus, other)]
            row[0] = 0.0
            expected.append(row)
        np.testing.assert_allclose(sorted(flows.tolist()), sorted(np.array(expected).tolist()), rtol=1e-9)
    assert network.positions is not None
    assert network.names is not None
    assert network.names[0] == "bus 1"
    assert network.states is not None
    assert network.states[0] == "theta 2"


def test_the_mean_of_ieee14_is_its_power_flow():
    network = model.example("ieee14")
    assert network.input is not None
    np.testing.assert_allclose(network.input, 0.02 * network.initial_mean, rtol=1e-12)
    published = [-5.01, -12.95, -10.58, -9.09, -14.85, -13.91, -13.91, -15.69, -15.97, -15.62, -15.97, -16.14, -17.19]
    np.testing.assert_allclose(np.rad2deg(network.initial_mean), published, atol=0.01)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 9])
@pytest.mark.parametrize("nodes", [1, 2, 3, 8, 40])
def test_random_networks_are_locally_observable(nodes, n):
    network = random_network(nodes, seed=nodes, n=n)
    assert (network.N, network.n) == (nodes, n)
    assert connected(network)
    assert locally_observable(network)


def test_random_networks_have_about_eight_neighbours():
    network = random_network(5000, seed=0)
    assert 7.5 < network.degree.mean() - 1 < 8.5
    assert network.degree.min() >= 8
    assert connected(network)


def test_parts_that_are_apart_are_joined(monkeypatch):
    monkeypatch.setattr("tolnet.model.examples._random.NEAREST", 1)
    assert connected(random_network(500, seed=0))


def test_coincident_nodes_do_not_hear_only_themselves():
    from tolnet.model.examples._random import _links

    links = _links(np.zeros((30, 2)))
    assert (links[:, 0] != links[:, 1]).all()
    assert len(np.unique(links, axis=0)) == len(links)


def test_random_networks_that_do_not_exist():
    for nodes, n in ((0, 4), (3, 0)):
        with pytest.raises(InputError, match="at least 1 of each was expected"):
            random_network(nodes, seed=0, n=n)


def test_the_list_of_examples():
    names = model.example_names()
    unstable = ["unstable-path", "unstable-ring", "unstable-metropolis"]
    assert list(names) == ["projectile", "ieee14", *unstable, "random", "field", "field-50"]
    for name in names:
        network = model.example(name)
        assert network.name == name
        assert network.description
        corrupted = isinstance(network, model.CorruptedNetwork)
        assert corrupted == name.startswith("field")
        assert corrupted or network.ambiguity is not None
    assert_same(model.example("random", nodes=7, seed=2), random_network(7, 2))


def test_examples_that_do_not_exist():
    with pytest.raises(InputError, match="'projectil' is no built-in problem; did you mean 'projectile'"):
        model.example("projectil")
    with pytest.raises(InputError, match="only 'random' takes nodes"):
        model.example("ieee14", nodes=5)
    with pytest.raises(InputError, match="it takes no seed"):
        model.example("ieee14", seed=5)
