"""Whatever comes in, only InputError comes out, or a network."""

from __future__ import annotations

import copy
import io
import tempfile
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import networkx
import numpy as np
import pytest
import scipy.io
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.instances import ring_projectile
from tests.model.networks import arguments

from tolnet import model
from tolnet.model import InputError, SensorNetwork

KEYS = [
    *("schema", "name", "description", "arrays", "plant", "network", "sensors", "ambiguity", "diffusion"),
    *("A", "B", "Q", "input", "initial_mean", "initial_covariance", "states", "dt"),
    *("nodes", "edges", "graphml", "directed", "positions", "names", "C", "R", "D"),
    *("tolerance", "convention", "tau", "rule", "weights", "array", "triples"),
]
keys = st.sampled_from(KEYS) | st.text(max_size=3)
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 25),
    st.sampled_from([2**31, 2**63, -(2**70), 10**400, 10**4000]),
    st.floats(),
    st.text(max_size=5),
    st.sampled_from(
        ["tolnet.problem/1", "problem.npz", "../x.graphml", "gamma", "uniform", "a\0b", "\ud800", "C", "R"]
    ),
    st.dates(),
    st.binary(max_size=2),
)
values = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=4), max_leaves=12
)
matrices = st.integers(0, 4).flatmap(
    lambda rows: st.integers(0, 4).flatmap(
        lambda columns: st.lists(
            st.lists(st.floats() | st.integers(-2, 2), min_size=columns, max_size=columns),
            min_size=rows,
            max_size=rows,
        )
    )
)


def only_complaints(read: Any, *given: Any) -> None:
    """Call; a network is well, and so is an InputError that says something."""
    said, network = [], None
    try:
        network = read(*given)
    except InputError as error:
        said = [complaint.message for complaint in error.complaints]
    assert isinstance(network, SensorNetwork) or (said and all(said))


@cache
def a_file() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return model.save(ring_projectile(), Path(folder) / "ring.toml")[0].read_bytes()


@given(values)
def test_any_mapping(value):
    only_complaints(model.parse, value if isinstance(value, dict) else {"plant": value})


@given(
    st.lists(
        st.tuples(st.lists(st.integers(0, 30), min_size=1, max_size=5), values | matrices), min_size=1, max_size=4
    )
)
def test_a_good_mapping_spoilt_anywhere(changes):
    problem = copy.deepcopy(tomllib.loads(a_file().decode()))
    for path, value in changes:
        put(problem, path, value)
    only_complaints(model.parse, problem)


def put(table: Any, path: list[int], value: Any) -> None:
    """Put a value at a place that the numbers of `path` pick, as deep as there is something."""
    for step, choice in enumerate(path):
        if not isinstance(table, dict | list) or not table:
            return
        places = list(table) if isinstance(table, dict) else range(len(table))
        place = places[choice % len(places)]
        if step == len(path) - 1:
            table[place] = value
        else:
            table = table[place]


tables = st.dictionaries(keys, values | matrices, max_size=6)


@given(
    st.fixed_dictionaries(
        {
            "schema": st.just("tolnet.problem/1"),
            "plant": tables,
            "network": tables,
            "sensors": st.lists(tables, max_size=3),
        },
        optional={"ambiguity": tables, "diffusion": tables},
    )
)
def test_tables_of_the_right_names(mapping):
    only_complaints(model.parse, mapping)


@given(st.binary(max_size=200))
def test_any_bytes(data):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.toml"
        path.write_bytes(data)
        only_complaints(model.load, path)
        only_complaints(SensorNetwork.from_mat, path)


def spoilt(data: bytes, cuts: list[tuple[int, bytes]], length: float) -> bytes:
    """The bytes with some of them replaced, and cut off."""
    whole = bytearray(data)
    for place, new in cuts:
        start = place % max(1, len(whole))
        whole[start : start + len(new)] = new
    return bytes(whole[: int(len(whole) * length)])


cuts = st.lists(st.tuples(st.integers(0, 2**20), st.binary(min_size=1, max_size=8)), max_size=4)
lengths = st.just(1.0) | st.floats(0, 1)


@given(cuts, lengths)
def test_spoilt_text(cuts, length):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.toml"
        path.write_bytes(spoilt(a_file(), cuts, length))
        only_complaints(model.load, path)


@settings(max_examples=150)
@given(arguments(), cuts, lengths)
def test_a_spoilt_archive(given_arguments, cuts, length):
    with tempfile.TemporaryDirectory() as folder:
        path, archive = Path(folder) / "p.toml", Path(folder) / "p.npz"
        model.save(SensorNetwork(**given_arguments), path, arrays=True)
        if archive.exists():
            archive.write_bytes(spoilt(archive.read_bytes(), cuts, length))
        only_complaints(model.load, path)


@given(
    st.dictionaries(
        st.sampled_from(["C", "R", "D", "rows", "edges", "W", "A", "x"]), st.binary() | matrices, max_size=6
    )
)
def test_any_archive(arrays):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "p.toml"
        plant = {"A": {"array": "A"} if "A" in arrays else [[0.5]], "B": [[1.0]]}
        problem = {"schema": "tolnet.problem/1", "arrays": "p.npz", "plant": plant, "network": {"nodes": 2}}
        problem["diffusion"] = {"weights": {"triples": "W"}} if "W" in arrays else {"rule": "uniform"}
        path.write_bytes(tomli_w.dumps(problem).encode())
        np.savez(
            Path(folder) / "p.npz", allow_pickle=False, **{key: np.array(value) for key, value in arrays.items()}
        )
        only_complaints(model.load, path)


@cache
def a_graph() -> bytes:
    graph = networkx.gnp_random_graph(20, 0.3, seed=1)
    networkx.set_node_attributes(graph, {k: {"x": float(k), "y": 1.0, "name": f"node {k}"} for k in graph})
    stream = io.BytesIO()
    networkx.write_graphml(graph, stream)
    return stream.getvalue()


@settings(max_examples=150)
@given(
    cuts,
    lengths,
    st.sampled_from([b"double", b"node", b"key", b"undirected", b"id=", b"utf-8"]),
    st.binary(max_size=9),
)
def test_a_spoilt_graph(cuts, length, old, new):
    problem = tomllib.loads(a_file().decode())
    problem["network"] = {"nodes": 20, "graphml": "g.graphml"}
    with tempfile.TemporaryDirectory() as folder:
        data = spoilt(a_graph(), cuts, length)
        Path(folder, "g.graphml").write_bytes(data.replace(old, new) if new else data)
        only_complaints(model.parse, problem, folder)


@cache
def a_mat() -> bytes:
    stream = io.BytesIO()
    network = ring_projectile()
    C, R = np.moveaxis(network.C.reshape(20, 3, 6), 0, 2), np.moveaxis(network.R.reshape(20, 3, 3), 0, 2)
    names = np.array([f"node {k}" for k in range(20)], dtype=object)
    adjacency = network.adjacency.astype(float).tocsc()
    scipy.io.savemat(
        stream, {"A": network.A, "B": network.B, "C": C, "R": R, "adjacency": adjacency, "names": names, "dt": 0.1}
    )
    return stream.getvalue()


@settings(max_examples=150)
@given(cuts, lengths)
def test_a_spoilt_mat(cuts, length):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "p.mat"
        path.write_bytes(spoilt(a_mat(), cuts, length))
        only_complaints(SensorNetwork.from_mat, path)


@given(
    st.dictionaries(
        st.sampled_from(["A", "B", "C", "R", "edges", "adjacency", "W", "names", "dt", "rule", "tau", "input"]),
        matrices | st.text(max_size=3) | st.lists(matrices, max_size=3).map(tuple),
    )
)
def test_any_variables(given_variables):
    stream = io.BytesIO()
    cells = {}
    for key, value in given_variables.items():
        if isinstance(value, tuple):
            cell = np.empty(len(value), dtype=object)
            for i, item in enumerate(value):
                cell[i] = np.array(item, dtype=float)
            cells[key] = cell
        else:
            cells[key] = value if isinstance(value, str) else np.array(value, dtype=float)
    scipy.io.savemat(stream, cells)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "p.mat"
        path.write_bytes(stream.getvalue())
        only_complaints(SensorNetwork.from_mat, path)


array_likes = values | matrices | st.lists(matrices, max_size=3)


@given(
    st.dictionaries(
        st.sampled_from(
            [
                "B",
                "Q",
                "R",
                "D",
                "rows",
                "adjacency",
                "edges",
                "input",
                "initial_mean",
                "initial_covariance",
                "positions",
                "names",
                "diffusion",
            ]
        ),
        array_likes,
    ),
    array_likes,
    array_likes,
)
def test_any_arguments(others, A, C):
    only_complaints(lambda: SensorNetwork(A=A, C=C, **others))


@pytest.mark.parametrize("key", ["B", "C", "R", "edges", "adjacency", "diffusion", "positions", "names"])
@pytest.mark.parametrize(
    "value", [True, "x", {}, object(), 3, np.array(None), np.array([None, 1]), np.ones((2, 2, 2, 2))]
)
def test_strange_arguments(key, value):
    good: dict[str, Any] = {"A": [[0.5]], "B": [[1.0]], "C": [[[1.0]]], "R": [[[1.0]]], "edges": []}
    with pytest.raises(InputError):
        SensorNetwork(**{**good, key: value})
