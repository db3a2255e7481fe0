"""Bad input ends with exit code 2 and one line that says where and what was expected; never with a traceback."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import Tolnet

GOOD = """
schema = "tolnet.problem/1"
name = "two"

[plant]
A = [[0.9, 0.1], [0.0, 0.8]]
B = [[1.0, 0.0], [0.0, 1.0]]

[network]
nodes = 2
edges = [[0, 1]]

[[sensors]]
C = [[1.0, 0.0]]
R = [[0.5]]

[[sensors]]
C = [[0.0, 1.0], [1.0, 1.0]]
R = [[0.5, 0.1], [0.1, 0.5]]

[ambiguity]
tolerance = 0.02
"""

WRONG = {
    "unknown key": ("nodes = 2", "nodes = 2\nnods = 2", ["network.nods", "nodes"]),
    "wrong shape": ("C = [[1.0, 0.0]]", "C = [[1.0, 0.0, 0.0]]", ["sensors[0].C"]),
    "not a number": ("R = [[0.5]]", "R = [[nan]]", ["sensors[0].R"]),
    "infinity": ("A = [[0.9,", "A = [[inf,", ["plant.A"]),
    "R not symmetric": ("[[0.5, 0.1], [0.1, 0.5]]", "[[0.5, 0.1], [0.2, 0.5]]", ["sensors[1].R"]),
    "R not positive definite": ("[[0.5, 0.1], [0.1, 0.5]]", "[[0.5, 0.9], [0.9, 0.5]]", ["sensors[1].R"]),
    "both B and Q": ("[network]", "Q = [[1.0, 0.0], [0.0, 2.0]]\n[network]", ["plant", "B", "Q"]),
    "negative tolerance": ("tolerance = 0.02", "tolerance = -0.02", ["ambiguity.tolerance"]),
    "tolerance no number": ("tolerance = 0.02", "tolerance = nan", ["ambiguity.tolerance"]),
    "tolerance a word": ("tolerance = 0.02", 'tolerance = "some"', ["ambiguity.tolerance"]),
    "unknown convention": ("tolerance = 0.02", 'tolerance = 0.02\nconvention = "bits"', ["ambiguity.convention"]),
    "edge to nobody": ("[[0, 1]]", "[[0, 7]]", ["network.edges[0]"]),
    "edge given twice": ("[[0, 1]]", "[[0, 1], [1, 0]]", ["network.edges[1]"]),
    "weights that do not sum to one": (
        "[ambiguity]", "[diffusion]\nweights = [[0.5, 0.5], [0.4, 0.5]]\n[ambiguity]", ["diffusion.weights"],
    ),
    "unknown rule": (
        "[ambiguity]", '[diffusion]\nrule = "metropolys"\n[ambiguity]', ["diffusion.rule", "metropolis"],
    ),
    "not TOML": ("[plant]", "[plant", []),
    "another schema": ("problem/1", "problem/9", ["schema"]),
}  # fmt: skip


@pytest.mark.parametrize("command", ["table", "validate"])
@pytest.mark.parametrize("fault", WRONG)
def test_a_wrong_file_is_refused_with_its_key_path(fault: str, command: str, tolnet: Tolnet, tmp_path: Path):
    right, wrong, named = WRONG[fault]
    assert right in GOOD
    path = tmp_path / "wrong.toml"
    path.write_text(GOOD.replace(right, wrong, 1))
    ran = tolnet(command, path)
    assert ran.code == 2
    assert ran.out == ""
    assert ran.err.startswith(f"error: {path}: ")
    for word in named:
        assert word in ran.err


def test_the_file_that_these_are_made_from_is_right(tolnet: Tolnet, tmp_path: Path):
    (tmp_path / "good.toml").write_text(GOOD)
    assert tolnet("table", tmp_path / "good.toml").code == 0
    assert tolnet("validate", tmp_path / "good.toml").code == 0


def test_one_way_links_refuse_averaging_rules_before_anything_is_computed(
    tolnet: Tolnet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "one-way.toml"
    one_way = GOOD.replace("nodes = 2", "nodes = 2\ndirected = true")
    path.write_text(one_way.replace("[ambiguity]", '[diffusion]\nrule = "metropolis"\n[ambiguity]'))
    monkeypatch.setattr("tolnet.design.choose_tolerances", pytest.fail)
    for command in ("table", "validate"):
        ran = tolnet(command, path)
        assert ran.code == 2
        assert "metropolis" in ran.err
        assert "one-way" in ran.err


@pytest.mark.parametrize("command", ["table", "validate"])
@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("missing.toml", None, "no such file"),
        ("empty.toml", b"", "empty"),
        ("deep.toml", b"a = " + b"[" * 100_000, "nested too deeply"),
        ("binary.toml", b"\xff\xfe\x00", "UTF-8"),
    ],
)
def test_what_is_no_problem_file_is_refused(
    name: str, content: bytes | None, said: str, command: str, tolnet: Tolnet, tmp_path: Path
):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    ran = tolnet(command, tmp_path / name, "-o", tmp_path / "out.json")
    assert ran.code == 2
    assert said in ran.err
    assert ran.out == ""


@pytest.mark.parametrize("command", ["table", "validate", "diff"])
def test_a_directory_is_refused(command: str, tolnet: Tolnet, tmp_path: Path):
    arguments = [tmp_path, tmp_path] if command == "diff" else [tmp_path]
    ran = tolnet(command, *arguments)
    assert ran.code == 2
    assert f"{tmp_path}: is a directory" in ran.err


def test_a_name_too_long_for_any_file_is_refused(tolnet: Tolnet):
    ran = tolnet("table", "x" * 5000)
    assert ran.code == 2
    assert "File name too long" in ran.err


def test_a_near_miss_of_a_built_in_problem_is_named(tolnet: Tolnet):
    ran = tolnet("table", "projectil")
    assert ran.code == 2
    assert "did you mean 'projectile'?" in ran.err


def test_a_pickled_side_archive_is_refused(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "pickled.toml"
    plant = 'schema = "tolnet.problem/1"\narrays = "pickled.npz"\n[plant]\nA = {array = "A"}\nB = [[1.0]]\n'
    path.write_text(plant + "[network]\nnodes = 1\nedges = []\n[[sensors]]\nC = [[1.0]]\nR = [[1.0]]\n")
    np.savez(tmp_path / "pickled.npz", A=np.array([[object()]], dtype=object))
    ran = tolnet("table", path, "-c", "0.1")
    assert ran.code == 2
    assert "pickled" in ran.err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--tolerance", "-1"], "--tolerance is -1.0; a finite number >= 0 was expected"),
        (["--tolerance", "nan"], "--tolerance is nan"),
        (["--tolerance", "inf"], "--tolerance is inf"),
        (["--tolerance", "much"], "--tolerance"),
        (["--tau", "2", "--uniform"], "--tau is 2.0; a number from 0 to 1 was expected"),
        (["--tau", "nan", "--uniform"], "--tau is nan"),
        (["--convention", "bits"], "--convention"),
        (["--tolerence", "1"], "--tolerance"),
        (["extra"], "extra"),
        (["-o", "t.xlsx"], "t.xlsx: has the suffix '.xlsx'; .json or .csv"),
        (["-o", "table"], "table: has no suffix"),
        (["-o", "nowhere/t.json"], "nowhere/t.json: cannot be written: nowhere does not exist"),
        (["-o", "folder.json"], "folder.json: cannot be written: it is a directory"),
        (["-o", "t.json", "-o", "./t.json"], "t.json: cannot be written: it is given twice"),
        (["--plot", "map.bmp"], "map.bmp: has the suffix '.bmp'; .png or .svg or .pdf was expected"),
        (["--plot", "nowhere/map.png"], "nowhere does not exist"),
    ],
)
def test_bad_options_are_refused_before_anything_is_computed(
    options: list[str], said: str, tolnet: Tolnet, ring: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.json").mkdir()
    monkeypatch.setattr("tolnet.design.choose_tolerances", pytest.fail)
    before = set(tmp_path.iterdir())
    ran = tolnet("table", ring, *options)
    assert ran.code == 2
    assert ran.out == ""
    assert said in ran.err
    assert set(tmp_path.iterdir()) == before


def test_parquet_without_pyarrow_says_how_to_get_it(tolnet: Tolnet, ring: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    ran = tolnet("table", ring, "-o", ring.with_name("t.parquet"))
    assert ran.code == 2
    assert "pip install 'tolnet[parquet]'" in ran.err


def test_a_file_that_is_write_protected_stays_as_it_is(tolnet: Tolnet, ring: Path, monkeypatch: pytest.MonkeyPatch):
    target = ring.with_name("t.json")
    target.write_text("precious")
    monkeypatch.setattr("os.access", lambda path, mode: mode != os.W_OK)
    ran = tolnet("table", ring, "-o", target)
    assert ran.code == 2
    assert "t.json: cannot be written: it is write-protected" in ran.err
    assert target.read_text() == "precious"


def test_too_little_memory_is_no_answer(tolnet: Tolnet, ring: Path, monkeypatch: pytest.MonkeyPatch):
    def too_large(*_: object, **__: object):
        raise MemoryError

    monkeypatch.setattr("tolnet.design.choose_tolerances", too_large)
    ran = tolnet("table", ring)
    assert ran.code == 4
    assert ran.err == "error: not enough memory for a network of this size\n"


def test_no_arguments_is_bad_usage(tolnet: Tolnet):
    assert tolnet().code == 2
    assert tolnet("tabel", "x").code == 2
    assert "Did you mean 'table'?" in tolnet("tabel", "x").err
