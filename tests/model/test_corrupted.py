"""Networks with corrupted channels: what the constructor takes, gives and refuses."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from scipy import sparse
from tests.instances_corrupted import arguments, drawn

from tolnet.model import CorruptedNetwork, InputError, LooseBoundWarning, ShapeError, SimulationModel, example

EYE = np.eye(2)
GOOD: dict[str, Any] = {
    "A": [[1.1, 0.0], [0.1, 0.5]],
    "Q": EYE,
    "F": 0.1 * EYE,
    "multiplicative_variance": 0.5,
    "C": [[[1.0, 0.0]], [[0.0, 1.0]], []],
    "R": [[[1.0]], [[2.0]], None],
    "fading_mean": [1.0, 0.9, 1.0],
    "fading_variance": [0.0, 0.01, 0.0],
    "estimate_noise": 0.1,
    "matrix_noise": 0.2,
    "edges": [[0, 1], [1, 2], [2, 0]],
    "directed": True,
}


def complaints(**changes: Any) -> list[str]:
    with pytest.raises(InputError) as caught:
        CorruptedNetwork(**{**GOOD, **changes})
    return [f"{each.key}: {each.message}" for each in caught.value.complaints]


def test_what_it_holds():
    network = CorruptedNetwork(**GOOD)
    assert (network.n, network.N, network.period) == (2, 3, 1)
    np.testing.assert_array_equal(network.pairs, [[0, 0], [0, 2], [1, 0], [1, 1], [2, 1], [2, 2]])
    np.testing.assert_array_equal(network.fusion.data, np.full(6, 0.5))
    now = network.at(7)
    np.testing.assert_array_equal(now.tau, [1.0, 0.9, 1.0])
    own = network.pairs[:, 0] == network.pairs[:, 1]
    assert not now.D_bar[own].any()
    np.testing.assert_array_equal(now.D_bar[~own], np.tile(0.2 * EYE, (3, 1, 1)))
    np.testing.assert_array_equal(now.W_bar[~own], np.tile(0.1 * EYE, (3, 1, 1)))
    np.testing.assert_array_equal(network.initial_covariance, np.tile(EYE, (3, 1, 1)))
    np.testing.assert_array_equal(network.initial_second_moment, EYE)
    assert now.sensors.block(1) == [[2.0]]
    assert now.sensors.block(2).size == 0
    for value in (network.A(0), network.fusion.data, network.initial_covariance, network.pairs):
        with pytest.raises(ValueError, match="read-only"):
            value[...] = 0


def test_the_second_moment_of_the_first_state_has_a_default():
    network = CorruptedNetwork(**GOOD, initial_mean=[1.0, 2.0], initial_covariance=3 * EYE)
    np.testing.assert_array_equal(network.initial_second_moment, [[4.0, 2.0], [2.0, 7.0]])


def test_periods_of_their_own():
    A = [np.array(GOOD["A"]), 2 * np.array(GOOD["A"])]
    C = [[[[1.0, 0.0]], [[2.0, 0.0]], [[3.0, 0.0]]], [[0.0, 1.0]], []]
    network = CorruptedNetwork(**{**GOOD, "A": A, "C": C, "fading_mean": [1.0, [0.9, 0.8], 1.0]})
    assert network.period == 6
    assert (network.A.period, network.C.period, network.tau.period, network.Q.period) == (2, 3, 2, 1)
    np.testing.assert_array_equal(network.A(3), A[1])
    assert [network.C(k)[0, 0] for k in range(4)] == [1.0, 2.0, 3.0, 1.0]
    assert [network.tau(k)[1] for k in range(3)] == [0.9, 0.8, 0.9]


def test_functions_of_k():
    calls: list[int] = []

    def A(k: int) -> Any:
        calls.append(k)
        return np.diag([1.0 + k, 1.0])

    network = CorruptedNetwork(
        **{**GOOD, "A": A, "fading_mean": lambda k: 0.5 + 0.1 * (k % 2), "matrix_noise": lambda k: 0.1 * k}
    )
    assert network.period is None
    assert network.A(4)[0, 0] == 5.0
    assert network.A(4)[0, 0] == 5.0
    assert calls.count(4) == 1
    assert network.tau(1)[0] == 0.6
    assert network.D_bar(3)[1, 0, 0] == pytest.approx(0.3)
    with pytest.raises(InputError, match=r"plant.A\(-1\) is singular"):
        network.A(-1)
    bad = CorruptedNetwork(**{**GOOD, "fading_mean": lambda k: 0.9 * (1 - k)})
    with pytest.raises(InputError, match=r"sensors.fading_mean\(1\) is 0.0"):
        bad.tau(1)


def test_exceptions_on_links():
    bound = [[1.0, 0.5], [0.5, 1.0]]
    links = [
        {"from": 2, "to": 0, "estimate_noise": 7.0},
        {"from": 0, "to": 1, "matrix_noise": bound},
    ]
    network = CorruptedNetwork(**GOOD, links=links)
    np.testing.assert_array_equal(network.W_bar(0)[1], 7 * EYE)
    np.testing.assert_array_equal(network.D_bar(0)[1], 0.2 * EYE)
    np.testing.assert_array_equal(network.D_bar(0)[2], bound)


def test_fusion_rules():
    network = CorruptedNetwork(**{**GOOD, "edges": [[0, 1], [1, 2]], "directed": False, "fusion": "metropolis"})
    np.testing.assert_allclose(
        network.fusion.toarray(), [[2 / 3, 1 / 3, 0], [1 / 3, 1 / 3, 1 / 3], [0, 1 / 3, 2 / 3]]
    )
    weights = [[0.25, 0.0, 0.75], [0.5, 0.5, 0.0], [0.0, 0.1, 0.9]]
    for given in (weights, sparse.csr_array(np.array(weights))):
        np.testing.assert_array_equal(CorruptedNetwork(**GOOD, fusion=given).fusion.toarray(), weights)


def test_a_loose_fading_variance_is_tightened_with_a_warning():
    with pytest.warns(LooseBoundWarning, match=r"sensors\[1\].fading_variance is 0.2; .* 0.09, which is taken"):
        network = CorruptedNetwork(**{**GOOD, "fading_variance": [0.0, 0.2, 0.0]})
    assert network.phi(0)[1] == pytest.approx(0.09)
    tau = np.array([0.9, 0.3, 0.7])
    CorruptedNetwork(**{**GOOD, "fading_mean": tau, "fading_variance": tau * (1 - tau)})  # no warning


BAD = {
    "rows that do not sum to one": (
        {"fusion": [[0.5, 0, 0.4], [0.5, 0.5, 0], [0, 0.5, 0.5]]},
        "fusion.weights[0]: sums to 0.9",
    ),
    "a stranger weighed": (
        {"fusion": [[0.5, 0.1, 0.4], [0.5, 0.5, 0], [0, 0.5, 0.5]]},
        "fusion.weights[0][1]: weighs node 1",
    ),
    "no weight on a link": (
        {"fusion": [[1.0, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0.5]]},
        "fusion.weights[0][2]: is 0; node 0 hears",
    ),
    "no weight on itself": (
        {"fusion": [[0.0, 0, 1], [0.5, 0.5, 0], [0, 0.5, 0.5]]},
        "fusion.weights[0][0]: is 0; a node weighs",
    ),
    "negative weight": ({"fusion": [[1.5, 0, -0.5], [0.5, 0.5, 0], [0, 0.5, 0.5]]}, "fusion.weights[0][2]: is -0.5"),
    "unknown rule": ({"fusion": "metropolys"}, "fusion.rule: is 'metropolys'; did you mean 'metropolis'"),
    "tau zero": ({"fading_mean": [1.0, 0.0, 1.0]}, "sensors[1].fading_mean: is 0.0; a number in (0, 1]"),
    "tau above one": ({"fading_mean": 1.1}, "sensors.fading_mean: is 1.1"),
    "negative phi": ({"fading_variance": [0, -1e-3, 0]}, "sensors[1].fading_variance: is -0.001"),
    "negative mu": ({"multiplicative_variance": -0.1}, "plant.multiplicative_variance: is -0.1"),
    "mu without F": ({"F": None}, "plant.F: is missing"),
    "singular A": ({"A": [[1.0, 2.0], [0.5, 1.0]]}, "plant.A: is singular"),
    "singular A at an instant": ({"A": [EYE, np.zeros((2, 2))]}, "plant.A[1]: is singular"),
    "Q not definite": ({"Q": np.diag([1.0, 0.0])}, "plant.Q: is not positive definite"),
    "Q not symmetric": ({"Q": [[1.0, 0.1], [0.0, 1.0]]}, "plant.Q: is not symmetric"),
    "B too narrow": ({"Q": None, "B": [[1.0], [0.0]]}, "plant.B: is not positive definite"),
    "B and Q": ({"B": EYE}, "plant: has both B and Q"),
    "estimate bound": (
        {"estimate_noise": np.diag([1.0, -1.0])},
        "channel.estimate_noise: is not positive semidefinite",
    ),
    "matrix bound": ({"matrix_noise": -0.5}, "channel.matrix_noise: is -0.5"),
    "bound of a link": (
        {"links": [{"from": 0, "to": 1, "matrix_noise": -1.0}]}, "channel.links[0].matrix_noise: is -1.0",
    ),
    "no such link": (
        {"links": [{"from": 1, "to": 0, "matrix_noise": 1.0}]},
        "channel.links[0]: goes from node 1 to node 0",
    ),
    "own pair": (
        {"links": [{"from": 1, "to": 1, "matrix_noise": 1.0}]},
        "channel.links[0]: goes from node 1 to itself",
    ),
    "link without bound": ({"links": [{"from": 0, "to": 1}]}, "channel.links[0]: has neither"),
    "not connected": ({"edges": [[0, 1], [1, 2]]}, "network.edges: does not connect the nodes strongly"),
    "matrix not connected": (
        {"edges": None, "adjacency": [[0, 1, 0], [0, 0, 1], [0, 0, 0]]}, "network.adjacency: does not connect",
    ),
    "window": ({"window": 0}, "fusion.window: is 0; a whole number >= 1"),
    "interval": ({"interval": 0}, "fusion.interval: is 0"),
    "interval of a node": ({"interval": [1, 0, 2]}, "sensors[1].interval: is 0"),
    "P_0 of a node": (
        {"initial_covariance": [EYE, -EYE, EYE]},
        "sensors[1].initial_covariance: is not positive definite",
    ),
    "Pi_0": ({"initial_second_moment": -EYE}, "plant.initial_second_moment: is not positive semidefinite"),
    "shapes over time": ({"A": [EYE, np.eye(3)]}, "plant.A[1]: is 3 x 3; 2 x 2 was expected"),
    "an empty period": ({"A": np.zeros((0, 2, 2))}, "plant.A: is empty"),
    "R at an instant": ({"R": [[[[1.0]], [[-1.0]]], [[2.0]], None]}, "sensors[0].R: is not positive definite"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD)
def test_bad_input_is_refused_with_its_key_path(fault: str):
    changes, expected = BAD[fault]
    found = complaints(**changes)
    assert len(found) == 1
    assert found[0].startswith(expected)


def test_every_complaint_comes_at_once():
    found = complaints(A=[[1.0, 1.0], [1.0, 1.0]], fading_mean=2.0, window=0, matrix_noise=-1.0)
    assert len(found) == 4
    with pytest.raises(ShapeError):
        CorruptedNetwork(**{**GOOD, "F": np.eye(3)})


def test_of_a_network_with_exact_channels():
    network = CorruptedNetwork.of(example("projectile"))
    assert (network.N, network.n, network.period) == (20, 6, 1)
    assert not network.D_bar(0).any()
    assert (network.tau(0) == 1).all()
    assert network.digest == example("projectile").digest


def test_replaced_and_scaled():
    network = drawn(3)
    other = network.replaced(matrix_noise=0.7, fading_mean=0.5, fading_variance=0.1)
    assert (other.tau(0) == 0.5).all()
    assert other.D_bar(0).max() == 0.7
    np.testing.assert_array_equal(other.W_bar(0), network.W_bar(0))
    np.testing.assert_array_equal(network.scaled("mu", 2.0).mu(0), 2 * network.mu(0))
    assert (network.tau(0) != 0.5).all()
    with pytest.raises(InputError, match=r"sensors\[0\].fading_mean"):
        network.scaled("tau", 4.0)
    with pytest.raises(InputError, match=r"channel.matrix_noise is -1"):
        network.replaced(matrix_noise=-1.0)


def test_copies_are_read_only():
    for other in (copy.deepcopy(drawn(2)), pickle.loads(pickle.dumps(drawn(2)))):
        with pytest.raises(ValueError, match="read-only"):
            other.A(0)[...] = 0
        with pytest.raises(ValueError, match="read-only"):
            other.initial_covariance[...] = 0


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"half_width": -0.1}, "simulation.channel.half_width is -0.1"),
        ({"half_width": float("inf")}, "simulation.channel.half_width is inf"),
    ],
)
def test_what_really_happens(given: dict[str, Any], said: str):
    with pytest.raises(InputError, match=said):
        SimulationModel(**given)


def test_arguments_are_not_touched():
    given = arguments(5)
    before = copy.deepcopy(given)
    CorruptedNetwork(**given)
    for key, value in before.items():
        np.testing.assert_equal(given[key], value)
