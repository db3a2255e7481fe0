"""MATLAB files: what scipy writes comes back, what MATLAB writes otherwise is understood, damage is refused."""

from __future__ import annotations

import hashlib
import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse
from tests.model.networks import assert_same

from tolnet.model import Ambiguity, InputError, SensorNetwork
from tolnet.model.matfile import read_mat


def cell(items: list[Any], shape: tuple[int, ...] | None = None) -> np.ndarray:
    """A cell array for scipy to write."""
    result = np.empty(len(items), dtype=object)
    result[:] = items
    return result.reshape(shape or (-1, 1), order="F")


def saved(folder: Path, **variables: Any) -> Path:
    path = folder / "net.mat"
    scipy.io.savemat(path, variables)
    return path


C = np.arange(12.0).reshape(3, 2, 2)
"""N x p x n, as here."""
R = np.stack([np.diag([1.0 + k, 2.0]) for k in range(3)])
HERE: dict[str, Any] = {"A": np.eye(2), "B": np.eye(2), "C": C, "R": R}
THERE: dict[str, Any] = {**HERE, "C": np.moveaxis(C, 0, 2), "R": np.moveaxis(R, 0, 2)}


def test_stacks_and_edges_counted_from_one(tmp_path):
    path = saved(tmp_path, **THERE, edges=[[1, 2], [3, 2]], directed=True)
    own = SensorNetwork.from_mat(path)
    assert_same(own, SensorNetwork(**HERE, edges=[[0, 1], [2, 1]], directed=True))
    assert own.digest == hashlib.sha256(path.read_bytes()).hexdigest()


def test_cells_adjacency_and_all_the_rest(tmp_path):
    adjacency = np.array([[0, 1, 0], [0, 0, 1], [0, 0, 0]])
    W = np.array([[1.0, 0.5, 0.0], [0.0, 0.5, 0.25], [0.0, 0.0, 0.75]])
    path = saved(
        tmp_path,
        A=np.eye(2),
        Q=np.eye(2),
        C=cell([C[0], [], C[2]]),
        D=cell([R[0], [], R[2]], (1, 3)),
        adjacency=sparse.csc_array(adjacency.astype(float)),
        input=[1.0, 2.0],
        initial_mean=[[3.0], [4.0]],
        initial_covariance=2 * np.eye(2),
        states=cell(["p", "v"]),
        dt=0.5,
        positions=np.arange(6.0).reshape(3, 2),
        names=cell(["west", "mid", "östlich"]),
        name="three",
        description="",
        tolerance=0.25,
        convention="nats",
        W=W,
    )
    expected = SensorNetwork(
        A=np.eye(2),
        Q=np.eye(2),
        C=[C[0], [], C[2]],
        D=[R[0], [], R[2]],
        adjacency=adjacency,
        input=[1.0, 2.0],
        initial_mean=[3.0, 4.0],
        initial_covariance=2 * np.eye(2),
        states=["p", "v"],
        dt=0.5,
        positions=np.arange(6.0).reshape(3, 2),
        names=["west", "mid", "östlich"],
        name="three",
        ambiguity=Ambiguity(0.25, "nats"),
        diffusion=W,
    )
    assert_same(SensorNetwork.from_mat(path), expected)


def test_one_node(tmp_path):
    own = SensorNetwork.from_mat(
        saved(tmp_path, A=0.5, B=1.0, C=[[1.0]], R=[[4.0]], rule="none", tau=0.5, tolerance=1)
    )
    assert (own.n, own.N, own.diffusion, own.ambiguity) == (1, 1, "none", Ambiguity(1.0, "gamma", 0.5))


def test_character_matrices_and_sparse_plants(tmp_path):
    own = SensorNetwork.from_mat(
        saved(
            tmp_path, **{**THERE, "A": sparse.csc_array(np.eye(2))}, edges=np.empty((0, 2)), names=["a", "bcd", "ef"]
        )
    )
    assert own.names == ("a", "bcd", "ef")
    np.testing.assert_array_equal(own.A, np.eye(2))


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"edges": [[0, 1]]}, r"edges\(1,:\) is \[0, 1\]; nodes are numbered from 1 to 3, as MATLAB counts"),
        ({"edges": [[1.0, 2.0], [2.0, 4.0]]}, r"edges\(2,:\) is \[2.0, 4.0\]; nodes are numbered from 1 to 3"),
        ({"edges": [[1.0, 1.5]]}, r"edges\(1,:\) is \[1.0, 1.5\]"),
        ({"edges": [[1, 2, 3]]}, "edges is 1 x 3; E x 2 was expected"),
        ({"edges": "x"}, "edges is a text; a matrix of real numbers was expected"),
        ({"edges": [[1, 2], [2, 1]]}, r"network\.edges\[1\] is \[1, 0\], which edges\[0\] already gave"),
        ({"adjacancy": np.eye(3)}, "adjacancy is no known variable; the nearest is 'adjacency'"),
        ({"A": cell([1.0])}, "A is a cell array; a matrix of real numbers was expected"),
        ({"input": np.eye(2)}, "input is 2 x 2; a vector of real numbers was expected"),
        ({"dt": [1.0, 2.0]}, "dt is 1 x 2; a number was expected"),
        ({"directed": 2}, "directed is 1 x 1; true or false was expected"),
        ({"name": 3}, "name is 1 x 1; a text was expected"),
        ({"names": cell([1.0])}, "names is a cell array; a cell array of texts was expected"),
        ({"C": "x"}, "C is a text; a cell array or a stack of matrices was expected"),
        ({"tolerance": -1.0}, r"ambiguity\.tolerance is -1\.0; a finite number >= 0 was expected"),
        ({"tau": 0.5}, "tolerance is missing"),
        ({"tolerance": 1.0, "convention": "bits"}, "convention is 'bits'; 'gamma' or 'nats' was expected"),
        ({"W": np.eye(3), "rule": "none"}, "has both W and rule; at most one was expected"),
        ({"R": np.zeros((2, 2, 3))}, r"sensors\[0\]\.R is not positive definite"),
        ({"A": np.eye(2) * 1j}, "holds 'A' as complex numbers; real ones were expected"),
        ({"A": {"field": 1.0}}, "holds 'A', a structure; numbers, texts and cell arrays of them are read"),
        ({"B": sparse.coo_array(([1.0], ([0], [0])), shape=(10**5, 10**5))}, "B is sparse and 100000 x 100000"),
    ],
)
def test_variables_that_are_refused(tmp_path, variables, message):
    path = saved(tmp_path, **{**THERE, "edges": [[1, 2]], **variables})
    with pytest.raises(InputError, match=message) as caught:
        SensorNetwork.from_mat(path)
    assert caught.value.source == str(path)


@pytest.mark.parametrize("missing", ["A", "C"])
def test_variables_that_are_missing(tmp_path, missing):
    variables = {key: value for key, value in THERE.items() if key != missing}
    with pytest.raises(InputError, match=f"{missing} is missing"):
        SensorNetwork.from_mat(saved(tmp_path, **variables))


def test_files_that_are_none(tmp_path):
    for content, message in (
        (b"", "is no MATLAB file of format 5 to 7"),
        (b"x" * 200, "is no MATLAB file of format 5 to 7"),
        (b"MATLAB 7.3 MAT-file" + b" " * 600, "format 7.3, which is not read; save it with -v7"),
    ):
        (tmp_path / "x.mat").write_bytes(content)
        with pytest.raises(InputError, match=message):
            SensorNetwork.from_mat(tmp_path / "x.mat")
    with pytest.raises(InputError, match="does not exist"):
        SensorNetwork.from_mat(tmp_path / "none.mat")
    with pytest.raises(InputError, match="is a directory"):
        SensorNetwork.from_mat(tmp_path)


# What follows is about the bytes.

numbers = st.sampled_from(["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "?"])
shapes = st.lists(st.integers(0, 3), min_size=2, max_size=4).map(tuple)


@given(numbers, shapes, st.booleans(), st.integers(0, 2**32 - 1))
def test_numbers_come_back(kind, shape, compressed, seed):
    array = (np.random.default_rng(seed).integers(0, 100, shape)).astype(kind)
    stream = io.BytesIO()
    scipy.io.savemat(stream, {"x": array, "y": 1.0}, do_compression=compressed)
    found = read_mat(stream.getvalue())
    assert list(found) == ["x", "y"]
    while array.ndim > 2 and array.shape[-1] == 1:  # as MATLAB would have it; scipy writes them as they are
        array = array[..., 0]
    assert found["x"].dtype == array.dtype
    np.testing.assert_array_equal(found["x"].reshape(array.shape, order="F"), array)


def element(kind: int, data: bytes, order: str = "<") -> bytes:
    """A data element in its long form."""
    return struct.pack(f"{order}II", kind, len(data)) + data + b"\0" * (-len(data) % 8)


def array(
    kind: int, flags: int, shape: tuple[int, ...], *parts: bytes, name: bytes = b"x", order: str = "<"
) -> bytes:
    """An array element from its parts."""
    header = element(6, struct.pack(f"{order}II", kind | flags, 0), order)
    header += element(5, struct.pack(f"{order}{len(shape)}i", *shape), order) + element(1, name, order)
    return element(14, header + b"".join(parts), order)


def mat(*elements: bytes, order: str = "<") -> bytes:
    """A whole file."""
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(f"{order}HH", 0x0100, 0x4D49) + b"".join(elements)


LOGICAL = 0x200


def test_logical_sparse_matrices_have_one_byte_an_entry():
    rows, starts = element(5, struct.pack("<2i", 0, 2)), element(5, struct.pack("<3i", 0, 1, 2))
    found = read_mat(mat(array(5, LOGICAL, (3, 2), rows, starts, element(9, b"\1\1"))))["x"]
    assert found.toarray().tolist() == [[True, False], [False, False], [False, True]]


def test_big_endian_files():
    data = element(4, struct.pack(">2H", 7, 9), ">")
    assert read_mat(mat(array(6, 0, (1, 2), data, order=">"), order=">"))["x"].tolist() == [[7.0, 9.0]]


def test_short_elements_and_small_types():
    short = struct.pack("<HH", 2, 3) + bytes([1, 2, 3, 0])
    assert read_mat(mat(array(6, 0, (3, 1), short)))["x"].tolist() == [[1.0], [2.0], [3.0]]


def test_text_of_every_encoding():
    for kind, encoded in ((16, "né".encode()), (17, "né".encode("utf-16-le")), (18, "né".encode("utf-32-le"))):
        assert read_mat(mat(array(4, 0, (1, 2), element(kind, encoded))))["x"] == "né"
    assert read_mat(mat(array(4, 0, (0, 0), element(1, b""))))["x"] == ""


def test_cells_in_cells_and_empty_ones():
    inner = array(1, 0, (1, 2), element(14, b""), array(4, 0, (1, 1), element(16, b"a")))
    found = read_mat(mat(array(1, 0, (2, 1), inner, array(6, 0, (1, 1), element(2, b"\5")))))["x"]
    assert found[0][0].shape == (0, 0)
    assert found[0][1] == "a"
    assert found[1].tolist() == [[5.0]]


def sparse_array(shape: tuple[int, ...], rows: list[int], starts: list[int], values: bytes) -> bytes:
    parts = [element(5, struct.pack(f"<{len(part)}i", *part)) for part in (rows, starts)]
    return array(5, 0, shape, *parts, element(9, values))


BAD = {
    "a tag is cut": mat(b"\1\2\3"),
    "a number follows": mat(element(9, b"\0" * 8)),
    "longer than the file": mat(struct.pack("<II", 14, 999)),
    "no header": mat(element(14, b"")),
    "negative size": mat(array(6, 0, (-1, -1), element(9, b"\0" * 8))),
    "one dimension": mat(array(6, 0, (1,), element(9, b"\0" * 8))),
    "too few values": mat(array(6, 0, (2, 2), element(9, b"\0" * 8))),
    "odd bytes": mat(array(6, 0, (1, 1), element(9, b"\0" * 7))),
    "unknown type": mat(array(6, 0, (1, 1), element(8, b"\0" * 8))),
    "unknown class": mat(array(99, 0, (1, 1), element(9, b"\0" * 8))),
    "nameless type": mat(array(6, 0, (1, 1), element(9, b"\0" * 8)).replace(struct.pack("<II", 1, 1), b"\x09" * 8)),
    "too few cells": mat(array(1, 0, (2, 1), array(6, 0, (1, 1), element(2, b"\5")))),
    "no cell": mat(array(1, 0, (1, 1), element(9, b"\0" * 8))),
    "text too short": mat(array(4, 0, (1, 9), element(16, b"abc"))),
    "no text": mat(array(4, 0, (1, 1), element(9, b"\0" * 8))),
    "bad text": mat(array(4, 0, (1, 1), element(16, b"\xff"))),
    "row outside": mat(sparse_array((1, 1), [7], [0, 1], b"\0" * 8)),
    "columns fall": mat(sparse_array((1, 2), [0], [0, 1, 0], b"")),
    "no columns": mat(sparse_array((1, 0), [], [], b"")),
    "values are missing": mat(sparse_array((1, 1), [0], [0, 1], b"")),
    "bad compression": mat(element(15, b"abcdefgh")),
    "cut compression": mat(element(15, zlib.compress(array(6, 0, (1, 1), element(2, b"\5")))[:-6])),
}


@pytest.mark.parametrize("data", BAD.values(), ids=BAD.keys())
def test_damage(data):
    with pytest.raises(InputError, match="is a damaged MATLAB file: "):
        read_mat(data)


def test_cells_nested_without_end():
    data = array(6, 0, (1, 1), element(2, b"\5"))
    for _ in range(15):
        data = array(1, 0, (1, 1), data)
    assert isinstance(read_mat(mat(data))["x"], tuple)
    for _ in range(2000):
        data = array(1, 0, (1, 1), data)
    with pytest.raises(InputError, match="is a damaged MATLAB file: an array has no header"):
        read_mat(mat(data))


def test_what_belongs_to_matlab_is_passed_over():
    assert read_mat(mat(array(6, 0, (1, 1), element(2, b"\5"), name=b""))) == {}


@pytest.mark.parametrize("kind", [2, 3, 16])
def test_classes_that_are_not_read(kind):
    with pytest.raises(InputError, match="holds 'x', a"):
        read_mat(mat(array(kind, 0, (1, 1))))


def test_strings_in_double_quotes_are_not_read():
    opaque = element(6, struct.pack("<II", 17, 0)) + element(1, b"x")
    with pytest.raises(InputError, match="holds 'x', an object, such as a string in double quotes"):
        read_mat(mat(element(14, opaque)))


def packed(data: bytes) -> bytes:
    """A compressed element, which nothing fills up to eight bytes."""
    inside = zlib.compress(data)
    return struct.pack("<II", 15, len(inside)) + inside


def test_what_unpacks_to_a_thousand_times_its_size_is_not_unpacked():
    zeros = array(6, 0, (1, 2**23), element(9, bytes(2**26)))
    with pytest.raises(InputError, match=r"would unpack .* KiB to .* MiB, more than 100 times as much"):
        read_mat(mat(packed(zeros)))
    small = [array(6, 0, (1, 2**20), element(9, bytes(2**23)), name=b"x%d" % i) for i in range(9)]
    assert read_mat(mat(packed(small[0])))["x0"].shape == (1, 2**20)
    with pytest.raises(InputError, match="more than 100 times as much"):  # each of them would do
        read_mat(mat(*map(packed, small)))
    bytes_of_doubles = array(6, 0, (1, 2**23), element(2, bytes(2**23)))
    with pytest.raises(InputError, match="more than 100 times as much"):  # stored as bytes, meant as doubles
        read_mat(mat(packed(bytes_of_doubles)))


def test_a_name_that_stands_twice_is_refused():
    with pytest.raises(InputError, match="holds 'x' twice"):
        read_mat(mat(*[array(6, 0, (1, 1), element(9, bytes(8)))] * 2))


def test_compressed_elements_hold_one_array():
    nested = array(6, 0, (1, 1), element(9, bytes(8)))
    for _ in range(3000):
        nested = packed(nested)
    with pytest.raises(InputError, match="an element of type 15 stands where a variable was expected"):
        read_mat(mat(nested))
    longer = array(6, 0, (1, 1), element(9, bytes(8))) + bytes(8)
    with pytest.raises(InputError, match="a compressed element is not as long as it says"):
        read_mat(mat(packed(longer)))


def test_a_sparse_matrix_is_not_made_full_beyond_what_it_can_mean(tmp_path):
    path = saved(tmp_path, **{**THERE, "A": sparse.csc_array((4000, 4000))}, edges=[[1, 2]])
    with pytest.raises(InputError, match="A is sparse and 4000 x 4000; a matrix of real numbers was expected"):
        SensorNetwork.from_mat(path)
