"""Bad problem files: each fault is told once, with its key path, all of them at once, and nothing else is raised."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.instances import ring_projectile

from tolnet import model
from tolnet.model import Complaint, InputError, ShapeError

NAN, INF = float("nan"), float("inf")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = model.save(ring_projectile(), tmp_path_factory.mktemp("good") / "ring.toml")[0]
    return tomllib.loads(path.read_text(encoding="utf-8"))


def changed(mapping: dict[str, Any], *changes: tuple[tuple[Any, ...], Any]) -> dict[str, Any]:
    """A copy of a problem with values put at places."""
    result = copy.deepcopy(mapping)
    for place, value in changes:
        table = result
        for step in place[:-1]:
            table = table[step]
        table[place[-1]] = value
    return result


def complaints_about(mapping: Any) -> list[Complaint]:
    with pytest.raises(InputError) as caught:
        model.parse(mapping)
    return list(caught.value.complaints)


def test_the_good_one_is_good(good):
    assert model.parse(good).N == 20


FAULTS: list[tuple[tuple[Any, ...], Any, str, str]] = [
    (("schema",), "tolnet.problem/2", "schema", "is 'tolnet.problem/2'; 'tolnet.problem/1' was expected"),
    (("plnt",), {}, "plnt", "is no known key; the nearest is 'plant'"),
    (("plant", "initial_covarience"), [[1.0]], "plant.initial_covarience", "the nearest is 'initial_covariance'"),
    (("plant", "a"), 1, "plant.a", "the nearest is 'A'"),
    (("plant", "G"), [[1.0]], "plant.G", "is no known key"),
    (("sensors", 3, "r"), [[1.0]], "sensors[3].r", "the nearest is 'R'"),
    (("plant",), 3, "plant", "is 3; a table was expected"),
    (("plant", "A"), [[1.0, 2.0]], "plant.A", "is 1 x 2; an n x n matrix was expected"),
    (("plant", "A"), [[1.0], [1.0, 2.0]], "plant.A", "is not a rectangular array of real numbers"),
    (("plant", "A"), [], "plant.A", "an n x n matrix was expected"),
    (("plant", "A"), "eye", "plant.A", "is 'eye'; a list was expected"),
    (("plant", "A", 0, 1), NAN, "plant.A[0][1]", "is nan; a finite number was expected"),
    (("plant", "A", 0, 1), INF, "plant.A[0][1]", "is inf; a finite number was expected"),
    (("plant", "A", 0, 1), True, "plant.A[0][1]", "is true; a number was expected"),
    (("plant", "A", 0, 1), "1", "plant.A[0][1]", "is '1'; a number was expected"),
    (("plant", "A", 0, 1), 10**400, "plant.A[0][1]", "is an integer of about 401 digits; a number was expected"),
    (("plant", "A", 0, 1), 10**5000, "plant.A[0][1]", "is an integer of about 5001 digits; a number was expected"),
    (("plant", "A", 0, 1), {}, "plant.A[0][1]", "is a table; a number was expected"),
    (("plant", "B"), [[1.0]], "plant.B", "is 1 x 1; 6 x m was expected"),
    (("plant", "B", 0, 0), 1e300, "plant.B", "is too large: B B' overflows"),
    (("plant", "Q"), np.eye(6).tolist(), "plant", "has both B and Q; exactly one was expected"),
    (("plant", "input"), [0.0], "plant.input", "is a vector of 1; a vector of 6 was expected"),
    (("plant", "initial_mean"), [[0.0] * 6], "plant.initial_mean[0]", "is a list of 6; a number was expected"),
    (
        ("plant", "initial_covariance"),
        np.zeros((6, 6)).tolist(),
        "plant.initial_covariance",
        "is not positive definite",
    ),
    (("plant", "states"), ["v"], "plant.states", "has 1 entries; plant.A is 6 x 6"),
    (("plant", "states"), ["v"] * 5 + [6], "plant.states[5]", "is 6; a text was expected"),
    (("plant", "states"), ["v"] * 5 + ["\n"], "plant.states[5]", "text without control characters was expected"),
    (("plant", "dt"), 0.0, "plant.dt", "is 0.0; a number > 0 was expected"),
    (("network", "nodes"), 21, "network.nodes", "is 21; there are 20 sensors"),
    (("network", "nodes"), 19, "network.nodes", "is 19; there are 20 sensors"),
    (("network", "graphml"), "none.graphml", "network", "has both edges and graphml; exactly one was expected"),
    (("network", "nodes"), 0, "network.nodes", "is 0; a number >= 1 was expected"),
    (("network", "nodes"), 20.0, "network.nodes", "is 20.0; a whole number was expected"),
    (("network", "edges", 4), [1, 20], "network.edges[4]", "is [1, 20]; nodes are numbered from 0 to 19"),
    (("network", "edges", 4), [1, -1], "network.edges[4][1]", "is -1; a number >= 0 was expected"),
    (("network", "edges", 4), [1, 2**80], "network.edges[4][1]", "is an integer of about 25 digits; a number <="),
    (("network", "edges", 4), [1, 2.0], "network.edges[4][1]", "is 2.0; a whole number was expected"),
    (("network", "edges", 4), [1, True], "network.edges[4][1]", "is true; a whole number was expected"),
    (("network", "edges", 4), [1], "network.edges[4]", "is a list of 1; a pair was expected"),
    (("network", "edges", 1), [1, 0], "network.edges[1]", "is [1, 0], which edges[0] already gave"),
    (("network", "directed"), 1, "network.directed", "is 1; true or false was expected"),
    (("network", "names"), ["a"], "network.names", "has 1 entries; there are 20 nodes"),
    (("network", "positions"), [[0.0, 1.0]], "network.positions", "is 1 x 2; 20 x 2"),
    (("network", "positions"), [[0.0]] * 20, "network.positions", "is 20 x 1; 20 x 2"),
    (("network", "graphml"), "g.graphml", "network", "has both edges and graphml; exactly one was expected"),
    (("sensors",), [], "sensors", "is empty; one sensor a node was expected"),
    (("sensors",), {}, "sensors", "is a table; a list was expected"),
    (("sensors", 3), 7, "sensors[3]", "is 7; a table was expected"),
    (("sensors", 3), {"R": [[1.0]]}, "sensors[3].C", "is missing: observation matrix"),
    (("sensors", 3), {"C": [[1.0] * 6]}, "sensors[3]", "has neither R nor D; exactly one was expected"),
    (("sensors", 3, "C"), [[1.0, 2.0]], "sensors[3].C", "has 2 columns; plant.A is 6 x 6"),
    (("sensors", 3, "C", 0), 1.0, "sensors[3].C[0]", "is 1.0; a list was expected"),
    (("sensors", 3, "D"), np.eye(3).tolist(), "sensors[3]", "has both R and D; exactly one was expected"),
    (("sensors", 3, "R"), [[1.0]], "sensors[3].R", "is 1 x 1; 3 x 3, one row and column for each row of C,"),
    (("sensors", 3, "R", 0, 1), 0.5, "sensors[3].R", "is not symmetric: [0][1] is 0.5, [1][0] is 0.0"),
    (("sensors", 3, "R", 1, 1), 0.0, "sensors[3].R", "is not positive definite: [1][1] is 0.0"),
    (("sensors", 3, "R"), np.ones((3, 3)).tolist(), "sensors[3].R", "is not positive definite: scaled to a unit"),
    (("sensors", 3), {"C": [[1.0] * 6], "D": [[0.0]]}, "sensors[3].D", "is singular"),
    (("sensors", 3), {"C": [[1.0] * 6], "D": [[1e200]]}, "sensors[3].D", "is too large: D D' overflows"),
    (("sensors", 3), {"C": [], "R": [[1.0]]}, "sensors[3].R", "is 1 x 1; 0 x 0"),
    (("ambiguity", "tolerance"), -0.1, "ambiguity.tolerance", "is -0.1; a number >= 0 was expected"),
    (("ambiguity", "tolerance"), NAN, "ambiguity.tolerance", "is nan; a finite number was expected"),
    (("ambiguity", "tolerance"), INF, "ambiguity.tolerance", "is inf; a finite number was expected"),
    (("ambiguity", "tolerance"), 1e300, "ambiguity.tolerance", "0, or a number from 1e-200 to 1e+10, was expected"),
    (("ambiguity", "tolerance"), 1e-310, "ambiguity.tolerance", "0, or a number from 1e-200 to 1e+10, was expected"),
    (("ambiguity", "tolerance"), False, "ambiguity.tolerance", "is false; a number was expected"),
    (("ambiguity",), {}, "ambiguity.tolerance", "is missing: radius c of the ball"),
    (("ambiguity", "convention"), "bits", "ambiguity.convention", "is 'bits'; 'gamma' or 'nats' was expected"),
    (("ambiguity", "tau"), 2, "ambiguity.tau", "is 2; a number <= 1 was expected"),
    (("ambiguity",), {"tolerance": 1, "convention": "nats", "tau": 0.5}, "ambiguity.convention", "use 'gamma'"),
    (("diffusion", "rule"), "metropolys", "diffusion.rule", "did you mean 'metropolis'?"),
    (
        ("diffusion", "weights"),
        np.eye(20).tolist(),
        "diffusion",
        "has both rule and weights; exactly one was expected",
    ),
    (("diffusion",), {"weights": [[1.0]]}, "diffusion.weights", "is 1 x 1; there are 20 nodes"),
    (("diffusion",), {"weights": (0.9 * np.eye(20)).tolist()}, "diffusion.weights", "has column 0 summing to 0.9"),
    (("arrays",), "nowhere.npz", "arrays", "names 'nowhere.npz', which does not exist"),
    (("arrays",), "a\0b", "arrays", "cannot be read: embedded null byte"),
    (("plant", "A"), {"array": "A"}, "plant.A", "refers to 'A', but no archive is named"),
    (("plant", "A"), {"arry": "A"}, "plant.A.arry", "is no known key; the nearest is 'array'"),
    (("name",), "two\nlines", "name", "text without control characters was expected"),
]


@pytest.mark.parametrize(("place", "value", "key", "message"), FAULTS, ids=map(str, range(len(FAULTS))))
def test_one_fault(good, place, value, key, message):
    found = complaints_about(changed(good, (place, value)))
    assert [complaint for complaint in found if complaint.key == key and message in complaint.message], found
    # Nothing else is said, save what follows for other keys from a table that is gone.
    assert len({complaint.key for complaint in found}) <= (2 if isinstance(value, dict) else 1), found


@pytest.mark.parametrize("table", ["plant", "network", "sensors", "schema"])
def test_missing_tables(good, table):
    mapping = copy.deepcopy(good)
    del mapping[table]
    found = complaints_about(mapping)
    assert [complaint.key for complaint in found] == [table]
    assert "is missing" in found[0].message


@pytest.mark.parametrize(
    ("place", "key"),
    [
        (("plant", "A"), "plant.A"),
        (("plant", "B"), "plant"),
        (("network", "edges"), "network"),
        (("network", "nodes"), "network.nodes"),
        (("sensors", 0, "C"), "sensors[0].C"),
    ],
)
def test_missing_keys(good, place, key):
    mapping = copy.deepcopy(good)
    table = mapping
    for step in place[:-1]:
        table = table[step]
    del table[place[-1]]
    assert [complaint.key for complaint in complaints_about(mapping)] == [key]


def test_everything_at_once_in_the_order_of_the_file(good):
    mapping = changed(
        good,
        (("sensors", 3, "R", 0, 1), 0.5),
        (("diffusion", "rule"), "none at all"),
        (("plant", "initial_covariance"), (-np.eye(6)).tolist()),
        (("plant", "inputs"), [0.0]),
        (("plant", "A", 0, 0), NAN),
        (("network", "edges", 0), [0, 99]),
        (("sensors", 5, "C", 0, 0), "1"),
        (("ambiguity", "tolerance"), -1),
        (("comment",), "x"),
    )
    assert [complaint.key for complaint in complaints_about(mapping)] == [
        "comment",
        "plant.A[0][0]",
        "plant.inputs",
        "plant.initial_covariance",
        "network.edges[0]",
        "sensors[5].C[0][0]",
        "sensors[3].R",
        "ambiguity.tolerance",
        "diffusion.rule",
    ]


def test_what_is_wrong_with_weights(good):
    W = np.zeros((20, 20))
    W[:, :] = np.where(np.eye(20), 1.0, 0.0)
    W[[0, 1], 0] = [1.5, -0.5]
    W[[5, 10], 5] = [0.5, 0.5]
    W[7, 7] = 1 + 1e-6
    found = {c.key: c.message for c in complaints_about(changed(good, (("diffusion",), {"weights": W.tolist()})))}
    assert found["diffusion.weights[1][0]"] == "is -0.5; a finite number >= 0 was expected"
    assert found["diffusion.weights[10][5]"] == "weighs node 10 at node 5, which does not hear it"
    W[[0, 1], 0] = [1.0, 0.0]
    found = {c.key: c.message for c in complaints_about(changed(good, (("diffusion",), {"weights": W.tolist()})))}
    assert found["diffusion.weights"] == "has column 7 summing to 1.000001; 1 was expected"


WEIGHTS = {"weights": np.full((20, 20), 1 / 20).tolist()}


@pytest.mark.parametrize(
    ("place", "value", "keys"),
    [
        (("network", "edges", 4), [1, 20], ["network.edges[4]"]),
        (("network", "edges", 4), [1, "x"], ["network.edges[4][1]"]),
        (("network", "edges"), [[1], [2]], ["network.edges[0]"]),
        (("network",), {"nodes": 20}, ["network"]),
        (("network",), {"nodes": 20, "graphml": "none.graphml"}, ["network.graphml"]),
        (("network",), {"nodes": 3, "edges": [[0, 1], [2, 99]], "names": ["a"]}, ["network.nodes"]),
    ],
)
def test_what_hangs_on_a_broken_graph_is_not_blamed(good, place, value, keys):
    found = complaints_about(changed(good, (place, value), (("diffusion",), WEIGHTS)))
    assert [complaint.key for complaint in found] == keys


def test_strangers_and_repeats_are_told_together(good):
    edges = [[0, 1], [0, 20], [2, 3], [0, 20], [3, 2], [1, 0]]
    found = complaints_about(changed(good, (("network", "edges"), edges)))
    assert [(each.key, each.message) for each in found] == [
        ("network.edges[1]", "is [0, 20]; nodes are numbered from 0 to 19"),
        ("network.edges[3]", "is [0, 20]; nodes are numbered from 0 to 19"),
        ("network.edges[4]", "is [3, 2], which edges[2] already gave"),
        ("network.edges[5]", "is [1, 0], which edges[0] already gave"),
    ]


def test_one_is_no_plural(good):
    found = complaints_about(changed(good, (("sensors",), good["sensors"][:1])))
    assert [(each.key, each.message) for each in found] == [("network.nodes", "is 20; there is 1 sensor")]


def test_a_missing_schema_is_told_with_the_line_to_write(good):
    mapping = {key: value for key, value in good.items() if key != "schema"}
    assert complaints_about(mapping)[0].message == "is missing; schema = 'tolnet.problem/1' was expected"


def test_a_column_may_miss_one_by_rounding(good):
    W = np.eye(20)
    W[[0, 1, 2], 0] = [0.1, 0.2, 0.7 + 1e-12]
    network = model.parse(changed(good, (("diffusion",), {"weights": W.tolist()})))
    assert not isinstance(network.diffusion, str)
    assert network.diffusion.toarray()[2, 0] == 0.7 + 1e-12


def test_one_matrix_of_many_faults_is_one_complaint(good):
    found = complaints_about(changed(good, (("plant", "A"), [["x"] * 6] * 6)))
    assert [(c.key, c.message) for c in found] == [
        ("plant.A[0][0]", "is 'x'; a number was expected (and so for 35 more of its entries)")
    ]


def test_many_complaints_of_one_kind_are_counted(good):
    found = complaints_about(changed(good, (("network", "edges"), [[0, 1]] * 500)))
    assert len(found) == 21
    assert (found[-1].key, found[-1].message) == ("", "has 479 more complaints")


def test_only_shapes_to_blame(good):
    with pytest.raises(ShapeError):
        model.parse(changed(good, (("plant", "input"), [1.0])))
    with pytest.raises(InputError) as caught:
        model.parse(changed(good, (("plant", "input"), [1.0]), (("ambiguity", "tolerance"), -1.0)))
    assert not isinstance(caught.value, ShapeError)


def test_a_relay_needs_no_noise(good):
    network = model.parse(changed(good, (("sensors", 3), {"C": []}), (("sensors", 4), {"C": [], "D": []})))
    assert np.diff(network.rows)[[2, 3, 4, 5]].tolist() == [3, 0, 0, 3]


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


FILES: list[tuple[str, Callable[[Path], Any], str]] = [
    ("missing", lambda folder: folder / "none.toml", "does not exist"),
    ("directory", lambda folder: folder, "is a directory; a file was expected"),
    ("below a file", lambda folder: write(folder / "f", b"x") / "f.toml", "cannot be read: Not a directory"),
    ("no name", lambda folder: folder / "a\0b", "cannot be read: embedded null byte"),
    ("empty", lambda folder: write(folder / "e.toml", b""), "is empty; a problem file was expected"),
    ("blank", lambda folder: write(folder / "b.toml", b" \n\t"), "is empty; a problem file was expected"),
    ("syntax", lambda folder: write(folder / "s.toml", b"a = 1\nb = [1,\nc = 3\n"), "is not TOML: .*line 3"),
    ("twice", lambda folder: write(folder / "t.toml", b"a = 1\na = 2\n"), "is not TOML: .*line 2"),
    (
        "no text",
        lambda folder: write(folder / "u.toml", b"a = 1\nb = '\xff'\n"),
        "line 2 holds bytes that are not UTF-8",
    ),
    ("digits", lambda folder: write(folder / "d.toml", b"a = " + b"9" * 9999), "is not TOML: Exceeds the limit"),
    ("depth", lambda folder: write(folder / "n.toml", b"a = " + b"[" * 99999), "is nested too deeply"),
    ("archive", lambda folder: write(folder / "z.toml", b"PK\x03\x04"), "is not TOML"),
]


@pytest.mark.parametrize(("make", "message"), [file[1:] for file in FILES], ids=[file[0] for file in FILES])
def test_files_that_cannot_be_read(tmp_path, make, message):
    path = make(tmp_path)
    with pytest.raises(InputError, match=message) as caught:
        model.load(path)
    assert str(caught.value).startswith(str(path))
    assert caught.value.source == str(path)
    assert [str(c) for c in model.validate(path)] == [str(c) for c in caught.value.complaints]


def test_validate_of_a_good_file_says_nothing(tmp_path):
    path = model.save(ring_projectile(), tmp_path / "ring.toml")[0]
    assert model.validate(path) == []


def test_a_byte_order_mark_does_no_harm(tmp_path):
    path = model.save(ring_projectile(), tmp_path / "ring.toml")[0]
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert model.load(path).N == 20


def test_keys_that_are_no_text(good):
    assert ("[7]", "is no text; keys are text") in [(c.key, c.message) for c in complaints_about({**good, 7: 1})]


def test_every_line_names_the_file(tmp_path, good):
    import tomli_w

    mapping = changed(good, (("ambiguity", "tolerance"), -1), (("plant", "dt"), -1))
    path = write(tmp_path / "bad.toml", tomli_w.dumps(mapping).encode())
    with pytest.raises(InputError) as caught:
        model.load(path)
    assert caught.value.lines() == [
        f"{path}: plant.dt is -1; a number > 0 was expected",
        f"{path}: ambiguity.tolerance is -1; a number >= 0 was expected",
    ]
