"""What must hold of every tolerance table, on random networks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy import ndarray
from scipy import sparse
from tests import study
from tests.instances import ring_projectile
from tests.instances_random import random_network
from tests.reference import tau as naive_tau

from tolnet import design
from tolnet.model import Ambiguity, InputError, SensorNetwork, UnsupportedError

ROUNDING = 1e-10


@dataclass(frozen=True)
class Drawn:
    """A random network by its seed, so that a failure prints what is needed to see it again."""

    seed: int
    n: int
    N: int
    directed: bool

    @property
    def network(self) -> SensorNetwork:
        return random_network(np.random.default_rng(self.seed), self.n, self.N, directed=self.directed)


networks = st.builds(
    Drawn, seed=st.integers(0, 10**6), n=st.integers(1, 5), N=st.integers(1, 8), directed=st.booleans()
)
tolerances = st.floats(-8, 2).map(lambda decade: 10.0**decade)
few = study.few()


def changed(network: SensorNetwork, *, T: ndarray | None = None, **graph: object) -> SensorNetwork:
    """The same network on another graph or, with T orthogonal, in another basis of the state: x = T' z."""
    sensors = [network.sensor(k) for k in range(network.N)]
    T = np.eye(network.n) if T is None else T
    Q = T @ network.Q @ T.T
    return SensorNetwork(
        A=T @ network.A @ T.T,
        Q=(Q + Q.T) / 2,
        C=[C @ T.T for C, _ in sensors],
        R=[R for _, R in sensors],
        **({"adjacency": network.adjacency, "directed": network.directed} | graph),  # pyright: ignore[reportArgumentType]
    )


@few
@given(networks, tolerances)
def test_no_node_is_given_more_than_the_network(drawn: Drawn, c: float):
    table = design.choose_tolerances(drawn.network, c)
    assert table.tolerance == c
    assert (table.tolerances >= 0).all()
    assert (table.tolerances <= c * (1 + ROUNDING)).all()


@few
@given(networks, tolerances)
def test_a_node_that_hears_everybody_is_given_all(drawn: Drawn, c: float):
    everybody = np.ones((drawn.N, drawn.N))
    table = design.choose_tolerances(changed(drawn.network, adjacency=everybody), c)
    np.testing.assert_allclose(table.tolerances, c, rtol=ROUNDING)
    np.testing.assert_allclose(table.local.theta, float(table.central.theta), rtol=1e-9)


@few
@given(networks, tolerances, st.data())
def test_hearing_one_more_never_lowers_a_tolerance(drawn: Drawn, c: float, data: st.DataObject):
    network = drawn.network
    k, l = (data.draw(st.integers(0, drawn.N - 1)) for _ in range(2))
    hears = sparse.lil_array(network.adjacency.astype(float))
    hears[l, k] = 1.0
    before = design.choose_tolerances(network, c).tolerances
    after = design.choose_tolerances(changed(network, adjacency=hears.tocsr(), directed=True), c).tolerances
    assert after[k] >= before[k] * (1 - ROUNDING)
    others = np.arange(drawn.N) != k
    np.testing.assert_allclose(after[others], before[others], rtol=1e-12)


@few
@given(networks, tolerances, st.data())
def test_the_numbering_of_nodes_does_not_matter(drawn: Drawn, c: float, data: st.DataObject):
    network = drawn.network
    order = data.draw(st.permutations(range(drawn.N)))
    shuffled = SensorNetwork(
        A=network.A,
        Q=network.Q,
        C=[network.sensor(k)[0] for k in order],
        R=[network.sensor(k)[1] for k in order],
        adjacency=network.adjacency[order][:, order],
        directed=network.directed,
    )
    one, other = (design.choose_tolerances(x, c) for x in (network, shuffled))
    assert one.local.status[order].tolist() == other.local.status.tolist()
    np.testing.assert_allclose(other.tolerances, one.tolerances[order], rtol=1e-9)
    np.testing.assert_allclose(other.local.theta, one.local.theta[order], rtol=1e-9)
    np.testing.assert_allclose(other.local.trace_V, one.local.trace_V[order], rtol=1e-9)


@few
@given(networks, tolerances)
def test_the_basis_of_the_state_does_not_matter(drawn: Drawn, c: float):
    network = drawn.network
    T, _ = np.linalg.qr(np.random.default_rng(drawn.seed + 1).normal(size=(drawn.n, drawn.n)))
    one, other = (design.choose_tolerances(x, c) for x in (network, changed(network, T=T)))
    np.testing.assert_allclose(other.tolerances, one.tolerances, rtol=1e-9)
    np.testing.assert_allclose(other.local.theta, one.local.theta, rtol=1e-8)
    np.testing.assert_allclose(other.local.trace_P, one.local.trace_P, rtol=1e-9)
    np.testing.assert_allclose(other.local.attraction, one.local.attraction, rtol=1e-6, atol=1e-8)


@few
@given(networks)
def test_a_vanishing_tolerance_leaves_the_kalman_filter(drawn: Drawn):
    kalman, almost = (design.choose_tolerances(drawn.network, c) for c in (0.0, 1e-14))
    np.testing.assert_array_equal(kalman.tolerances, 0.0)
    np.testing.assert_array_equal(kalman.local.theta, 0.0)
    assert (almost.tolerances > 0).all()
    assert (almost.tolerances <= 1e-14 * (1 + ROUNDING)).all()
    scale = np.trace(kalman.local.V, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(almost.local.V / scale, kalman.local.V / scale, rtol=0, atol=1e-4)
    np.testing.assert_allclose(kalman.local.V / scale, kalman.local.P / scale, rtol=0, atol=1e-13)


def test_the_gain_is_the_published_one():
    """Eq. (44): A (V_k^-1 + S_k)^-1 C_l' R_l^-1 for each neighbour l, in the order given."""
    network = ring_projectile()
    table = design.choose_tolerances(network)
    for k in (0, 9, 19):
        neighbours, G = table.gain(k)
        assert neighbours.tolist() == sorted((k + d) % 20 for d in (-2, -1, 0, 1, 2))
        Z = np.linalg.inv(np.linalg.inv(table.local.V[k]) + network.information[k])
        parts = [network.A @ Z @ C.T @ np.linalg.inv(R) for C, R in map(network.sensor, neighbours.tolist())]
        np.testing.assert_allclose(G, np.hstack(parts), rtol=1e-11, atol=1e-14)


def test_nats_are_half_of_gamma():
    network = ring_projectile()
    gamma, nats = design.choose_tolerances(network, 0.02), design.choose_tolerances(network, Ambiguity(0.01, "nats"))
    assert nats.convention == "nats"
    assert nats.tolerance == pytest.approx(0.01, rel=1e-15)
    np.testing.assert_allclose(nats.tolerances, gamma.tolerances / 2, rtol=1e-14)
    np.testing.assert_allclose(nats.local.V, gamma.local.V, rtol=1e-13, atol=1e-18)


@pytest.mark.parametrize("tau", [0.4, 1.0])
def test_other_divergences_take_uniform_tolerances_only(tau: float):
    network = random_network(np.random.default_rng(4), 2, 3)
    with pytest.raises(UnsupportedError, match="uniform"):
        design.choose_tolerances(network, Ambiguity(0.1, tau=tau))
    table = design.choose_tolerances(network, Ambiguity(0.1, tau=tau), uniform=True)
    np.testing.assert_array_equal(table.tolerances, 0.1)
    for k in range(3):
        _, _, theta = naive_tau.steady_state(network.A, network.Q, network.information[k], 0.1, tau)
        assert table.local.theta[k] == pytest.approx(theta, rel=1e-9)


def test_a_network_without_a_tolerance_asks_for_one():
    network = random_network(np.random.default_rng(4), 2, 3)
    with pytest.raises(InputError, match="tolerance"):
        design.choose_tolerances(network)
    for bad in (-1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="tolerance"):
            design.choose_tolerances(network, bad)


def test_a_blind_node_spoils_no_other_row():
    """Node 2 sees the decaying state only, and nobody speaks to it."""
    network = SensorNetwork(
        A=np.diag([1.2, 0.5]),
        Q=np.eye(2),
        C=[np.eye(2), [], [[0.0, 1.0]]],
        R=[np.eye(2), [], [[1.0]]],
        edges=[[0, 1]],
    )
    table = design.choose_tolerances(network, 0.1)
    assert table.local.status.tolist() == ["ok", "ok", "undetectable"]
    assert not table.ok
    assert np.isnan(table.local.theta[2])
    assert np.isfinite(table.local.V[:2]).all()
    assert np.isfinite(table.tolerances).all()


def test_progress_ends_at_the_number_of_filters():
    calls: list[tuple[int, int]] = []
    network = random_network(np.random.default_rng(4), 2, 30)
    design.choose_tolerances(network, 0.1, progress=lambda done, total: calls.append((done, total)))
    assert calls[-1] == (30, 30)
    assert [done for done, _ in calls] == sorted(done for done, _ in calls)
