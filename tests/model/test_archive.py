"""Side archives: what stands in for tables, and what is refused."""

from __future__ import annotations

import io
import pickle
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from numpy.lib import format as npy
from tests.model.networks import assert_same

from tolnet import model
from tolnet.model import InputError, SensorNetwork
from tolnet.model.archive import archive_bytes, read_archive

C, R = np.arange(1.0, 5.0).reshape(4, 1, 1), np.arange(1.0, 5.0).reshape(4, 1, 1)
GOOD: dict[str, np.ndarray] = {"C": C, "R": R, "edges": np.array([[0, 1], [1, 2], [2, 3]])}


def problem(folder: Path, arrays: dict[str, np.ndarray] | bytes, **tables: Any) -> Path:
    """A problem file beside an archive."""
    path, archive = folder / "p.toml", folder / "p.npz"
    if isinstance(arrays, bytes):
        archive.write_bytes(arrays)
    else:
        np.savez(archive, allow_pickle=True, **arrays)
    plant = {"A": [[0.5]], "B": [[1.0]]}
    content = {"schema": "tolnet.problem/1", "arrays": "p.npz", "plant": plant, "network": {"nodes": 4}, **tables}
    path.write_bytes(tomli_w.dumps(content).encode())
    return path


def test_stacks_replace_the_tables(tmp_path):
    loaded = model.load(problem(tmp_path, GOOD))
    assert_same(loaded, SensorNetwork(A=[[0.5]], B=[[1.0]], C=C, R=R, edges=GOOD["edges"]))


def test_packed_sensors_of_different_sizes(tmp_path):
    packed = {
        "C": np.arange(1.0, 4.0).reshape(3, 1),
        "D": np.array([2.0, 1.0, 0.0, 1.0, 1.0]),
        "rows": np.array([0, 1, 1, 3, 3]),
        "edges": GOOD["edges"],
    }
    loaded = model.load(problem(tmp_path, packed))
    assert np.diff(loaded.rows).tolist() == [1, 0, 2, 0]
    assert [R.tolist() for _, R in map(loaded.sensor, range(4))] == [[[4.0]], [], [[1.0, 1.0], [1.0, 2.0]], []]


def test_any_matrix_may_be_a_reference(tmp_path):
    names = np.array(["a", "b", "c", "d"])
    W = np.eye(4)
    arrays = {"a": np.array([[0.25]]), "q": np.array([[9.0]]), "m": np.array([3.0]), "xy": np.zeros((4, 2)), "W": W}
    arrays |= {"n": names, "links": GOOD["edges"], "c3": C[3], "r3": R[3]}
    sensors: list[dict[str, Any]] = [{"C": [[1.0]], "R": [[1.0]]}] * 3 + [
        {"C": {"array": "c3"}, "R": {"array": "r3"}}
    ]
    plant = {"A": {"array": "a"}, "Q": {"array": "q"}, "initial_mean": {"array": "m"}}
    network = {"nodes": 4, "edges": {"array": "links"}, "positions": {"array": "xy"}, "names": {"array": "n"}}
    path = problem(
        tmp_path, arrays, plant=plant, network=network, sensors=sensors, diffusion={"weights": {"array": "W"}}
    )
    loaded = model.load(path)
    assert (loaded.A.item(), loaded.Q.item(), loaded.initial_mean.item()) == (0.25, 9.0, 3.0)
    assert loaded.names == ("a", "b", "c", "d")
    assert loaded.links.tolist() == GOOD["edges"].tolist()
    assert loaded.sensor(3)[0].item() == 4.0
    assert not isinstance(loaded.diffusion, str)
    np.testing.assert_array_equal(loaded.diffusion.toarray(), W)


def npy_bytes(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    npy.write_array(stream, array, allow_pickle=True)
    return stream.getvalue()


def zipped(members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return stream.getvalue()


class Trap:
    """What a pickle that does harm looks like: unpickling it fails the test."""

    def __reduce__(self):
        return pytest.fail, ("a pickle was read",)


def header(shape: str, kind: str = "<f8") -> bytes:
    """The head of a .npy member that claims a shape."""
    text = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


WHOLE = zipped({"C.npy": npy_bytes(C), "R.npy": npy_bytes(R)})
BAD = {
    "empty": (b"", "is no archive of arrays"),
    "text": (b"hello", "is no archive of arrays"),
    "cut": (WHOLE[:-30], "is no archive of arrays"),
    "one byte changed": (WHOLE.replace(C.tobytes()[8:16], b"\0\0\0\0\0\0\1\0"), "is no archive of arrays .*CRC"),
    "a pickle": (pickle.dumps(Trap()), "is no archive of arrays"),
    "pickled objects": (
        zipped({"C.npy": npy_bytes(np.array([Trap()]))}),
        "holds 'C' as pickled objects, which are never",
    ),
    "a pickle as member": (zipped({"C": pickle.dumps(Trap())}), "is no archive of arrays"),
    "shorter than it says": (zipped({"C.npy": npy_bytes(C)[:-1]}), "holds 'C' with 31 bytes of data, which is not"),
    "longer than it says": (zipped({"C.npy": npy_bytes(C) + b"\0"}), "holds 'C' with 33 bytes of data, which is not"),
    "far larger than memory": (
        zipped({"C.npy": header("(10**12,)".replace("10**12", str(10**15)))}),
        "holds 'C' with 0",
    ),
    "negative": (zipped({"C.npy": header("(-1, -8)") + b"\0" * 64}), "holds 'C' with 64 bytes"),
    "no shape": (zipped({"C.npy": header("'x'")}), "is no archive of arrays"),
    "times": (zipped({"C.npy": npy_bytes(np.array(["2020-01-01"], dtype="M8[D]"))}), "holds 'C' of type datetime64"),
    "complex": (zipped({"C.npy": npy_bytes(np.array([1j]))}), "holds 'C' of type complex128; numbers or texts"),
    "records": (zipped({"C.npy": npy_bytes(np.zeros(1, dtype=[("a", "f8")]))}), "holds 'C' of type "),
    "texts of no width": (zipped({"C.npy": header(f"({10**15},)", "<U0")}), "holds 'C' with 0 bytes"),
    "later version": (
        zipped({"C.npy": b"\x93NUMPY\x03\x00" + b"\0" * 80}),
        "holds .C. in version",
    ),
    "a folder": (zipped({"folder/": b""}), "is no archive of arrays"),
}


@pytest.mark.parametrize(("data", "message"), BAD.values(), ids=BAD.keys())
def test_bad_archives(tmp_path, data, message):
    with pytest.raises(InputError, match=rf"p\.toml: arrays names 'p\.npz', which {message}"):
        model.load(problem(tmp_path, data))


def test_edges_in_two_places(tmp_path):
    np.savez(tmp_path / "a.npz", allow_pickle=False, **GOOD)
    links = GOOD["edges"].tolist()
    problem = {
        "schema": "tolnet.problem/1",
        "arrays": "a.npz",
        "plant": {"A": [[0.5]], "B": [[1.0]]},
        "network": {"nodes": 4, "edges": links},
    }
    with pytest.raises(InputError, match="network has both edges and edges in the archive; exactly one") as caught:
        model.parse(problem, tmp_path)
    assert len(caught.value.complaints) == 1


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"x": C}, r"sensors is missing: one table \[\[sensors\]\] a node, or C and R in an archive"),
        ({**GOOD, "edgse": C}, "arrays holds 'edgse', which nothing refers to; .* is 'edges'"),
        ({**GOOD, "C": C.ravel()}, r"sensors\.C is neither a stack N x p x n nor a sequence"),
        ({**GOOD, "C": np.array(["a"])}, r"sensors\.C is neither a stack N x p x n nor a sequence"),
        ({**GOOD, "C": np.where(C > 2, np.nan, C)}, r"sensors\[2\]\.C has a value that is not a finite number"),
        ({**GOOD, "R": np.where(R > 2, np.inf, R)}, r"sensors\[2\]\.R has a value that is not a finite number"),
        ({**GOOD, "R": R - 3}, r"sensors\[2\]\.R is not positive definite: \[0\]\[0\] is 0\.0"),
        ({**GOOD, "D": R}, "sensors have both R and D; exactly one was expected"),
        ({**GOOD, "edges": np.array([[0.0, 1.0]])}, r"network\.edges is not a list of pairs of node indices"),
        ({**GOOD, "edges": np.array([[0, 4]])}, r"network\.edges\[0\] is \[0, 4\]; nodes are numbered from 0 to 3"),
        ({"C": C, "R": R}, "network has neither edges nor a graph; exactly one was expected"),
    ],
)
def test_bad_arrays(tmp_path, arrays, message):
    with pytest.raises(InputError, match=message):
        model.load(problem(tmp_path, arrays))


@pytest.mark.parametrize(
    ("W", "message"),
    [
        (np.eye(4)[:, :2], "is no M x 3 array of numbers"),
        (np.array([[0.0, 4.0, 1.0]]), "has a place that is no node; nodes are numbered from 0 to 3"),
        (np.array([[0.0, 0.5, 1.0]]), "has a place that is no node"),
        (np.array([[0.0, np.nan, 1.0]]), "has a place that is no node"),
        (np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5]]), "gives a weight twice"),
        (np.array([[0.0, 0.0, 0.5]]), "has column 0 summing to 0.5; 1 was expected"),
    ],
)
def test_bad_triples(tmp_path, W, message):
    with pytest.raises(InputError, match=rf"diffusion\.weights {message}"):
        model.load(problem(tmp_path, {**GOOD, "W": W}, diffusion={"weights": {"triples": "W"}}))


def test_references_to_nothing_name_the_nearest(tmp_path):
    with pytest.raises(InputError, match=r"plant\.A refers to 'edgs', which the archive does not hold.* 'edges'"):
        model.load(problem(tmp_path, GOOD, plant={"A": {"array": "edgs"}, "B": [[1.0]]}))


def test_archives_are_the_same_bytes_for_the_same_arrays():
    arrays = {
        "a": np.arange(3.0),
        "b": np.asfortranarray(np.eye(3)),
        "c": np.array(["x", "yz"]),
        "d": np.empty((0, 2)),
    }
    assert archive_bytes(arrays) == archive_bytes({key: value.copy() for key, value in arrays.items()})
    read = read_archive(archive_bytes(arrays))
    for key, value in arrays.items():
        np.testing.assert_array_equal(read[key], value)
        assert read[key].dtype == value.dtype


def test_compressed_and_fortran_ordered_archives_are_read(tmp_path):
    np.savez_compressed(tmp_path / "x.npz", a=np.asfortranarray(np.arange(6.0).reshape(2, 3)), b=np.float64(3))
    read = read_archive((tmp_path / "x.npz").read_bytes())
    np.testing.assert_array_equal(read["a"], np.arange(6.0).reshape(2, 3))
    assert read["b"].shape == ()


@pytest.mark.parametrize("head", ["(" * 3000, "-" * 4000 + "1", "[" * 9000, "{'descr': 1L}", "'\\ud800'", "a\n b"])
def test_headers_that_are_no_header(head):
    text = head.encode() + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text
    with pytest.raises(InputError, match="is no archive of arrays"):
        read_archive(zipped({"C.npy": member}))


def test_a_name_that_stands_twice_is_refused():
    for names in (["C.npy", "C.npy"], ["C.npy", "C"]):
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for name in names:
                archive.writestr(name, npy_bytes(C))
        with pytest.raises(InputError, match="holds 'C' twice"):
            read_archive(stream.getvalue())


def compressed(count: int) -> bytes:
    """An archive of so many zeros."""
    stream = io.BytesIO()
    np.savez_compressed(stream, C=np.zeros(count))
    return stream.getvalue()


def test_what_unpacks_to_a_thousand_times_its_size_is_not_unpacked(monkeypatch):
    bomb = compressed(2**24)
    with monkeypatch.context() as patch:
        patch.setattr(zipfile.ZipExtFile, "read", lambda *_: pytest.fail("was read"))
        with pytest.raises(InputError, match=r"would unpack .* KiB to 128 MiB, more than 100 times as much"):
            read_archive(bomb)
    assert read_archive(compressed(2**20))["C"].shape == (2**20,)


def test_a_header_that_does_not_fit_ends_the_reading_of_a_member():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("C.npy", npy_bytes(C).replace(b"(4, 1, 1)", b"(9, 1, 1)"))
    with pytest.raises(InputError, match=r"holds 'C' with 32 bytes of data, which is not \(9, 1, 1\) of float64"):
        read_archive(stream.getvalue())


def test_strange_arrays_are_counted(tmp_path):
    strange = {f"x{i:03}": np.zeros(1) for i in range(100)}
    with pytest.raises(InputError) as caught:
        model.load(problem(tmp_path, {**GOOD, **strange}))
    assert caught.value.complaints[0].message.startswith("holds 'x000', which nothing refers to")
    assert str(caught.value.complaints[-1]) == "has 80 more complaints"


@pytest.mark.parametrize(
    ("spoilt", "reason"), [(C > 0, r"bool \(true and false\)"), (C.astype(str), "text")], ids=["bool", "text"]
)
def test_the_type_is_the_reason(tmp_path, spoilt, reason):
    with pytest.raises(
        InputError, match=rf"sensors\.C is not a rectangular array of real numbers: its type is {reason}"
    ):
        model.load(problem(tmp_path, {**GOOD, "C": spoilt}))
