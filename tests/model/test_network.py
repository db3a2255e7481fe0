"""The constructor: what it takes, what it keeps, what it refuses."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from scipy import sparse
from tests.model.networks import arguments, assert_same

from tolnet.model import Ambiguity, InputError, SensorNetwork, ShapeError


def scalar(**others: Any) -> SensorNetwork:
    """Three nodes on a path, n = 1."""
    good: dict[str, Any] = {"A": [[0.5]], "B": [[1.0]], "C": np.ones((3, 1, 1)), "R": np.ones((3, 1, 1))}
    return SensorNetwork(**{**good, "edges": [[0, 1], [1, 2]], **others})


@given(arguments())
def test_inputs_are_left_alone_and_not_kept(given_arguments):
    before = copy.deepcopy(given_arguments)
    network = SensorNetwork(**given_arguments)
    for key, value in before.items():
        np.testing.assert_equal(given_arguments[key], value, err_msg=key)
    kept = [
        getattr(network, key) for key in ("A", "B", "Q", "C", "R", "D", "rows", "positions", "initial_mean", "input")
    ]
    given_arrays = [given_arguments.get(key) for key in ("A", "B", "Q", "positions", "initial_mean", "input")]
    for array in kept:
        for own in (*given_arrays, *given_arguments["C"], *given_arguments["R"], *given_arguments["D"]):
            assert array is None or own is None or not np.shares_memory(array, own)


@given(arguments())
def test_every_array_is_read_only(given_arguments):
    network = SensorNetwork(**given_arguments)
    computed = [network.degree, network.information, network.own_information, network.total_information]
    arrays = [value for value in vars(network).values() if isinstance(value, np.ndarray)] + computed
    graphs = [graph for graph in (network.adjacency, network.diffusion) if not isinstance(graph, str)]
    arrays += [part for graph in graphs for part in (graph.data, graph.indices, graph.indptr)]
    assert len(arrays) >= 12
    assert not any(array.flags.writeable for array in arrays)
    with pytest.raises(AttributeError):
        network.A = np.eye(1)  # pyright: ignore[reportAttributeAccessIssue]


def test_copies_are_read_only_too():
    network = scalar(diffusion=np.eye(3), adjacency=np.eye(3), edges=None)
    assert network.information.any()
    for other in (copy.deepcopy(network), pickle.loads(pickle.dumps(network))):
        assert_same(network, other)
        assert not isinstance(other.diffusion, str)
        for array in (other.A, other.R, other.information, other.adjacency.indices, other.diffusion.data):
            assert not array.flags.writeable


@given(arguments())
def test_every_sensor_comes_back(given_arguments):
    network = SensorNetwork(**given_arguments)
    for k, C_k in enumerate(given_arguments["C"]):
        C, R = network.sensor(k)
        np.testing.assert_array_equal(C, C_k)
        if given_arguments["R"][k] is not None:
            np.testing.assert_array_equal(R, given_arguments["R"][k])
        else:
            D = given_arguments["D"][k]
            np.testing.assert_allclose(R, D @ D.T, rtol=1e-14, atol=1e-14)
            assert (R == R.T).all()


@given(arguments())
def test_information_is_the_sum_over_who_is_heard(given_arguments):
    network = SensorNetwork(**given_arguments)
    own = []
    for C, R in map(network.sensor, range(network.N)):
        own.append(C.T @ np.linalg.inv(R) @ C)
    J = network.adjacency.toarray()
    for k in range(network.N):
        heard = np.flatnonzero(J[:, k])
        assert heard.tolist() == network.neighbours(k).tolist()
        assert network.degree[k] == len(heard)
        np.testing.assert_allclose(network.information[k], sum(own[l] for l in heard), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(network.total_information, sum(own), rtol=1e-9, atol=1e-12)


def test_packed_stacked_and_listed_sensors_are_the_same():
    C, R = np.arange(12.0).reshape(3, 2, 2), np.stack([np.eye(2) * (k + 1) for k in range(3)])
    shared: dict[str, Any] = {"A": np.eye(2), "B": np.eye(2), "edges": []}
    stacked = SensorNetwork(C=C, R=R, **shared)
    for other in (
        SensorNetwork(C=list(C), R=list(R), **shared),
        SensorNetwork(C=C.tolist(), R=R.tolist(), **shared),
        SensorNetwork(C=C.reshape(6, 2), R=R.ravel(), rows=[0, 2, 4, 6], **shared),
    ):
        np.testing.assert_array_equal(other.C, stacked.C)
        np.testing.assert_array_equal(other.R, stacked.R)
        np.testing.assert_array_equal(other.rows, stacked.rows)


def test_information_beyond_the_doubles_is_refused():
    network = scalar(C=np.array([1.0, 1e200, 1.0]).reshape(3, 1, 1))
    with pytest.raises(InputError, match=r"sensors\[1\] has C too large for its R: C' R\^-1 C overflows"):
        _ = network.information


@pytest.mark.parametrize("p", range(1, 9))
def test_what_counts_as_definite_has_a_cholesky_factor(p):
    generator = np.random.default_rng(p)
    accepted = 0
    for exponent in np.linspace(-17, -13, 80):
        V, _ = np.linalg.qr(generator.standard_normal((p, p)))
        R = (V * np.geomspace(1, 10**exponent, p)) @ V.T
        R = (R + R.T) / 2 * np.outer(*[10.0 ** generator.integers(-50, 50, p)] * 2)
        try:
            network = SensorNetwork(A=[[0.5]], B=[[1.0]], C=[np.ones((p, 1))], R=[(R + R.T) / 2])
        except InputError:
            continue
        accepted += 1
        assert np.isfinite(network.information).all()
    assert accepted >= 20


def test_relays_alone_make_a_network():
    network = scalar(C=[[], [], []], R=None)
    assert network.C.shape == (0, 1)
    assert network.R.shape == (0,)
    np.testing.assert_array_equal(network.information, np.zeros((3, 1, 1)))
    stacked = scalar(C=np.empty((3, 0, 1)), R=np.empty((3, 0, 0)))
    np.testing.assert_array_equal(stacked.rows, network.rows)


def test_one_node_with_one_state_needs_no_edges():
    network = SensorNetwork(A=[[0.0]], B=[[0.0]], C=[[[1.0]]], R=[[[2.0]]])
    assert (network.n, network.N, network.adjacency.nnz) == (1, 1, 1)
    np.testing.assert_allclose(network.information, [[[0.5]]], rtol=1e-15)


def test_noise_may_lack_rank():
    assert scalar(A=np.zeros((2, 2)), B=[[1.0], [1.0]], C=np.ones((3, 1, 2))).Q.tolist() == [[1.0, 1.0], [1.0, 1.0]]
    assert scalar(A=np.eye(2), B=None, Q=np.ones((2, 2)), C=np.ones((3, 1, 2))).B is None


@pytest.mark.parametrize("Q", [[[1.0, 2.0], [2.0, 1.0]], [[0.0, 1e-9], [1e-9, 1.0]], [[-1e-300, 0.0], [0.0, 1.0]]])
def test_noise_that_is_no_covariance_is_refused(Q):
    with pytest.raises(InputError, match=r"plant\.Q is not positive semidefinite"):
        scalar(A=np.eye(2), B=None, Q=Q, C=np.ones((3, 1, 2)))


def test_definiteness_does_not_depend_on_units():
    skewed = np.array([[1.0, 0.999e-150], [0.999e-150, 1e-300]])
    network = scalar(C=np.ones((3, 2, 1)), R=np.stack([skewed] * 3))
    np.testing.assert_array_equal(network.sensor(2)[1], skewed)
    with pytest.raises(InputError, match=r"sensors\[0\]\.R is not positive definite"):
        scalar(C=np.ones((3, 2, 1)), R=np.stack([np.array([[1.0, 1.1e-150], [1.1e-150, 1e-300]])] * 3))
    with pytest.raises(InputError, match=r"sensors\[0\]\.R is not positive definite"):
        scalar(C=np.ones((3, 2, 1)), R=np.stack([np.array([[1e-300, 1e300], [1e300, 1e-300]])] * 3))


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ({"C": np.ones((3, 1, 2))}, r"sensors\.C is 3 x 1 x 2; N x p x 1 was expected"),
        ({"C": np.full((3, 1, 1), np.nan)}, r"sensors\[0\]\.C has a value that is not a finite number"),
        ({"C": np.ones((3, 1))}, r"sensors\.C is neither a stack N x p x n nor a sequence"),
        ({"C": np.ones((0, 1, 1))}, "sensors is empty"),
        (
            {"C": [[[1.0]], [[np.inf]], [[1.0]]]},
            r"sensors\[1\]\.C has inf at \[0\]\[0\]; finite numbers were expected",
        ),
        ({"C": [[[1j]]] * 3}, r"sensors\[0\]\.C is not a rectangular array of real numbers"),
        ({"C": [[[True]]] * 3}, r"sensors\[0\]\.C is not a rectangular array of real numbers"),
        ({"C": np.ones((3, 1, 1), dtype=bool)}, r"sensors\.C is not a rectangular array of real numbers"),
        (
            {"C": np.ones((2, 1)), "rows": [0, 1, 1]},
            r"sensors\.rows is not N \+ 1 whole offsets that rise from 0 to 2",
        ),
        ({"C": np.ones((2, 1)), "rows": [0, 2, 1, 2]}, r"sensors\.rows is not N \+ 1 whole offsets"),
        ({"C": np.ones((2, 1)), "rows": [0.0, 1.0, 2.0]}, r"sensors\.rows is not N \+ 1 whole offsets"),
        ({"R": np.ones((2, 1, 1))}, r"sensors\.R is 2 x 1 x 1; 3 x 1 x 1 was expected"),
        ({"R": np.ones(4)}, r"sensors\.R is a vector of 4; 3 numbers, the sum of p_k squared, was expected"),
        ({"R": [[[1.0]]]}, r"sensors\.R has 1 matrices; C has 3"),
        ({"R": -np.ones((3, 1, 1))}, r"sensors\[2\]\.R is not positive definite: \[0\]\[0\] is -1\.0"),
        ({"D": np.ones((3, 1, 1))}, "sensors have both R and D; exactly one was expected"),
        ({"R": None}, "sensors have neither R nor D; exactly one was expected"),
        ({"R": None, "D": np.zeros((3, 1, 1))}, r"sensors\[0\]\.D is singular: R = D D' is not positive definite"),
        ({"Q": [[1.0]]}, "plant has both B and Q; exactly one was expected"),
        ({"B": None}, "plant has neither B nor Q; exactly one was expected"),
        ({"dt": -1.0}, r"plant\.dt is -1\.0; a positive number of seconds was expected"),
        ({"dt": np.inf}, r"plant\.dt is inf; a positive number of seconds was expected"),
        ({"names": "abc"}, r"network\.names is not a list of texts"),
        ({"names": ["a", "b", "\x1b[31m"]}, r"network\.names\[2\] is '\\x1b\[31m'; text without control characters"),
        ({"diffusion": np.ones((3, 2))}, r"diffusion\.weights is 3 x 2; there are 3 nodes"),
        ({"diffusion": [["a"]]}, r"diffusion\.weights is not an N x N matrix of numbers"),
        ({"diffusion": np.diag([1.0, np.nan, 1.0])}, r"diffusion\.weights\[1\]\[1\] is nan; a finite number >= 0"),
        ({"edges": None}, "network has neither edges nor a graph; exactly one was expected"),
        ({"adjacency": np.eye(3)}, "network has both edges and adjacency; exactly one was expected"),
        ({"edges": [0, 1]}, r"network\.edges is not a list of pairs of node indices"),
        ({"edges": [[0, 1.0]]}, r"network\.edges is not a list of pairs of node indices"),
        ({"edges": [[0, True]]}, r"network\.edges is not a list of pairs of node indices"),
        ({"edges": [[0, 1, 2]]}, r"network\.edges is not a list of pairs of node indices"),
        ({"edges": [[0], [1, 2]]}, r"network\.edges is not a list of pairs of node indices"),
    ],
)
def test_what_is_refused(others, message):
    with pytest.raises(InputError, match=message):
        scalar(**others)


def test_shapes_alone_are_a_shape_error():
    with pytest.raises(ShapeError):
        scalar(A=np.ones((2, 3)))
    with pytest.raises(InputError) as caught:
        scalar(A=np.ones((2, 3)), dt=-1.0)
    assert not isinstance(caught.value, ShapeError)


def test_many_bad_sensors_are_counted():
    with pytest.raises(InputError) as caught:
        SensorNetwork(A=[[0.5]], B=[[1.0]], C=np.ones((90, 1, 1)), R=np.zeros((90, 1, 1)), edges=[])
    assert len(caught.value.complaints) == 21
    assert str(caught.value.complaints[-1]) == "has 70 more complaints"


def test_nodes_that_do_not_exist_have_no_sensor():
    network = scalar()
    np.testing.assert_array_equal(network.sensor(-1)[0], network.sensor(2)[0])
    for k in (3, -4):
        with pytest.raises(IndexError, match="there are 3"):
            network.sensor(k)


@pytest.mark.parametrize("tolerance", [-1.0, float("nan"), float("inf"), -1e-300])
def test_balls_that_do_not_exist(tolerance):
    with pytest.raises(InputError, match=r"ambiguity\.tolerance is .*; a finite number >= 0 was expected"):
        Ambiguity(tolerance)


def test_the_two_scales_of_a_ball():
    assert Ambiguity(0.25, "nats").gamma == 0.5
    assert Ambiguity(0.25).gamma == 0.25
    with pytest.raises(InputError, match=r"ambiguity\.tau is 1\.5; a number from 0 to 1 was expected"):
        Ambiguity(0.1, "gamma", 1.5)
    with pytest.raises(InputError, match="which only tau = 0 has"):
        Ambiguity(0.1, "nats", 0.5)


def test_how_a_network_presents_itself():
    network = scalar(name="path", names=["west", "mid", "east"])
    assert repr(network) == "<SensorNetwork 'path': n = 1, N = 3, 2 links>"
    assert [network.label(k) for k in range(3)] == ["west", "mid", "east"]
    assert scalar().label(2) == "2"
    assert repr(scalar(directed=True)) == "<SensorNetwork '': n = 1, N = 3, 2 directed links>"


def test_weights_are_kept_sparse_and_exact():
    W = sparse.csr_array(np.array([[0.75, 0.5, 0.0], [0.25, 0.25, 0.5], [0.0, 0.25, 0.5]]))
    network = scalar(diffusion=W)
    assert not isinstance(network.diffusion, str)
    np.testing.assert_array_equal(network.diffusion.toarray(), W.toarray())
    assert W.data.flags.writeable
