"""F and G: against eqs. (35)-(37) as printed, with stacked outputs and explicit inverses."""

import dataclasses

import numpy as np
import pytest
from scipy import sparse
from tests.instances import ring_projectile
from tests.instances_random import random_network
from tests.reference import naive_performance as naive

from tolnet.analysis import solve_steady_state, solve_steady_states
from tolnet.analysis.error_dynamics import error_dynamics
from tolnet.analysis.least_favourable import least_favourable_model
from tolnet.analysis.spectrum import spectral_radii
from tolnet.design import choose_tolerances, diffusion_matrix
from tolnet.model import ErrorDynamics, InputError, SensorNetwork, ShapeError, Status

RULES = ("relative-degree", "uniform", "none")


def some_network(seed: int) -> SensorNetwork:
    """A small network of the given seed: mixed p_k, relays, every second one directed, every fifth A singular."""
    rng = np.random.default_rng(seed)
    n, N = int(rng.integers(1, 5)), int(rng.integers(1, 9))
    return random_network(rng, n, N, directed=bool(seed % 2), singular=seed % 5 == 4)


def some_dynamics(seed: int, c: float = 0.02) -> ErrorDynamics:
    """The network's table under its diffusion rule."""
    network = some_network(seed)
    table = choose_tolerances(network, c)
    W = diffusion_matrix(network, RULES[seed % 3])
    return error_dynamics(network, table.local, W, least_favourable_model(network, table.central))


def close(found, wanted, digits=1e-11):
    """Equal up to a part of the largest entry."""
    np.testing.assert_allclose(found, wanted, rtol=0, atol=digits * max(np.abs(wanted).max(), 1e-300))


@pytest.mark.parametrize("seed", range(30))
def test_F_and_G_as_printed(seed):
    network = some_network(seed)
    table = choose_tolerances(network, [0.0, 1e-3, 0.02, 0.01][seed % 4])
    W = diffusion_matrix(network, RULES[seed % 3])
    found = error_dynamics(network, table.local, W, least_favourable_model(network, table.central))
    assert found.status == Status.OK
    at = naive.steady_model(naive.stacked(network), table.central.V, float(table.central.theta))
    F, G = naive.dynamics(network, list(table.local.V), W.toarray(), at)
    close(found.matrix(), F)
    close(found.noise_matrix(), G @ G.T)
    columns = found.noise_columns(0, found.columns).reshape(found.dimension, -1)
    close(columns @ columns.T, G @ G.T)
    assert abs(max(spectral_radii(found)) - naive.spectral_radius(F)) < 1e-8


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("c", [0.0, 0.05])
def test_centralised_filters_as_printed(seed, c):
    network = some_network(seed)
    centre = solve_steady_state(network, 0.05)
    used = solve_steady_state(network, c)
    found = error_dynamics(network, used, None, least_favourable_model(network, centre))
    at = naive.steady_model(naive.stacked(network), centre.V, float(centre.theta))
    F, G = naive.central_dynamics(network, used.V, at)
    close(found.matrix(), F)
    close(found.noise_matrix(), G @ G.T)


@pytest.mark.parametrize("seed", range(6))
def test_operators_are_the_matrices(seed):
    dynamics = some_dynamics(seed)
    F, D = dynamics.matrix(), dynamics.noise_matrix()
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(dynamics.dimension, 3))
    operator, noise = dynamics.operator(), dynamics.noise_operator()
    close(operator @ X, F @ X)
    close(operator.T @ X, F.T @ X)
    close(operator @ X[:, 0], F @ X[:, 0])
    close(operator.rmatvec(X[:, 1]), F.T @ X[:, 1])
    close(noise @ X, D @ X)
    close(dynamics.sparse_matrix().toarray(), F, 1e-15)


def test_columns_of_the_noise_in_any_pieces():
    dynamics = some_dynamics(3)
    whole = dynamics.noise_columns(0, dynamics.columns)
    for size in (1, 2, 5):
        edges = range(0, dynamics.columns, size)
        pieces = [dynamics.noise_columns(i, min(i + size, dynamics.columns)) for i in edges]
        np.testing.assert_allclose(np.concatenate(pieces, axis=2), whole, rtol=1e-14, atol=1e-18)


@pytest.mark.parametrize("seed", range(4))
def test_units_change_nothing(seed):
    dynamics = some_dynamics(seed)
    unit = np.random.default_rng(seed).uniform(1e-3, 1e3, dynamics.n)
    scaled, D = dynamics.rescaled(unit), np.tile(unit, dynamics.filters + 1)
    close(scaled.matrix() * D[:, None] / D, dynamics.matrix())
    close(scaled.noise_matrix() * D[:, None] * D, dynamics.noise_matrix())


def test_sparsity_is_that_of_the_graph():
    network = ring_projectile()
    table = choose_tolerances(network)
    model = least_favourable_model(network, table.central)
    F = error_dynamics(network, table.local, diffusion_matrix(network), model).sparse_matrix()
    blocks = np.abs(F.toarray()).reshape(21, 6, 21, 6).max(axis=(1, 3)) > 0
    np.testing.assert_array_equal(blocks[:20, :20], network.adjacency.toarray())
    assert blocks[:20, 20].all()
    np.testing.assert_array_equal(blocks[20], np.arange(21) == 20)


def test_without_tolerance_the_centre_drives_nobody():
    dynamics = some_dynamics(2, c=0.0)
    assert not dynamics.coupling.any()
    assert dynamics.tilted.shape[2] == 0


def test_islands_are_the_groups_that_mix():
    network = some_network(11)
    table = choose_tolerances(network, 0.02)
    model = least_favourable_model(network, table.central)
    W = np.eye(network.N)
    W[0, 1], W[1, 1] = 0.3, 0.7
    dynamics = error_dynamics(network, table.local, sparse.csr_array(W), model)
    islands = dynamics.islands()
    assert sorted(tuple(island.filters) for island in islands) == [(0, 1), *((k,) for k in range(2, network.N))]
    F, D, n = dynamics.matrix(), dynamics.noise_matrix(), network.n
    for members, states, part in islands:
        rows = (np.append(members, network.N)[:, None] * n + states).ravel()
        close(part.matrix(), F[np.ix_(rows, rows)])
        close(part.noise_matrix(), D[np.ix_(rows, rows)])


def test_axes_that_nothing_couples_are_islands():
    network = ring_projectile()
    table = choose_tolerances(network)
    model = least_favourable_model(network, table.central)
    dynamics = error_dynamics(network, table.local, diffusion_matrix(network), model)
    islands = dynamics.islands()
    assert [island.states.tolist() for island in islands] == [[0, 3], [1, 4], [2, 5]]
    assert sum(len(island.dynamics.channels) for island in islands) == len(dynamics.channels)
    F, D = dynamics.matrix(), dynamics.noise_matrix()
    for _, states, part in islands:
        rows = (np.arange(21)[:, None] * 6 + states).ravel()
        close(part.matrix(), F[np.ix_(rows, rows)])
        close(part.noise_matrix(), D[np.ix_(rows, rows)])
        others = np.setdiff1d(np.arange(126), rows)
        assert np.abs(F[np.ix_(rows, others)]).max() < 1e-14


def test_axes_that_a_gain_couples_are_no_islands():
    network = ring_projectile()
    table = choose_tolerances(network)
    model = least_favourable_model(network, table.central)
    dynamics = error_dynamics(network, table.local, diffusion_matrix(network), model)
    loops = dynamics.loops.copy()
    loops[7, 0, 1] = 1e-6
    assert len(dataclasses.replace(dynamics, loops=loops).islands()) == 1


def test_who_has_no_steady_state_is_named():
    blind = SensorNetwork(
        A=[[1.1]],
        Q=[[1.0]],
        C=[[[1.0]], np.empty((0, 1))],
        R=[[[1.0]], np.empty((0, 0))],
        edges=np.empty((0, 2), dtype=int),
        names=["seeing", "blind"],
    )
    table = choose_tolerances(blind, 0.01)
    dynamics = error_dynamics(blind, table.local, np.eye(2), least_favourable_model(blind, table.central))
    assert dynamics.status == Status.UNDETECTABLE
    assert not dynamics.exists
    assert "blind" in dynamics.reason
    assert "seeing" not in dynamics.reason


def test_what_oscillates_says_so_and_keeps_its_numbers():
    A = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.05, 0.9]])
    rng = np.random.default_rng(0)
    network = SensorNetwork(
        A=A,
        Q=1e-3 * np.eye(3),
        C=rng.normal(size=(30, 1, 3)),
        R=10 ** rng.uniform(-1, 1, size=(30, 1, 1)),
        edges=[[0, k] for k in range(1, 30)],
    )
    table = choose_tolerances(network, 0.1)
    assert (table.local.status == Status.OSCILLATES).any()
    model = least_favourable_model(network, table.central)
    dynamics = error_dynamics(network, table.local, diffusion_matrix(network), model)
    assert dynamics.status == Status.OSCILLATES
    assert dynamics.exists
    assert "never settles" in dynamics.reason


def test_refusals():
    network = some_network(7)
    N = network.N
    table = choose_tolerances(network, 0.02)
    model = least_favourable_model(network, table.central)
    with pytest.raises(ShapeError, match="is missing"):
        error_dynamics(network, table.local, None, model)
    with pytest.raises(ShapeError, match=f"{N} x {N} was expected"):
        error_dynamics(network, table.local, np.eye(N + 1), model)
    with pytest.raises(ShapeError, match="mixes with nobody"):
        error_dynamics(network, table.central, np.eye(N), model)
    with pytest.raises(InputError, match=r"column 0 summing to 1\.1"):
        error_dynamics(network, table.local, np.eye(N) * np.where(np.arange(N) == 0, 1.1, 1.0), model)
    with pytest.raises(InputError, match="column 0 summing to nan"):
        error_dynamics(network, table.local, np.where(np.eye(N) == 1, np.nan, 0.0), model)
    stack = solve_steady_states(network.A, network.Q, network.information[:1].repeat(N + 2, axis=0), np.zeros(N + 2))
    with pytest.raises(ShapeError, match=f"the network has {N} nodes"):
        error_dynamics(network, stack, np.eye(N), model)
