"""Inputs that are hostile or absurd: exit code 2, in little memory, and a reason in few lines."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import Tolnet

MOST_MEMORY = 200 * 2**10
"""KiB that the process may have held at any time."""
ENDLESS = 120
"""Seconds after which a process is taken to wait for what never comes; they take two."""
PLANT = "[plant]\nA = [[0.5]]\nQ = [[1.0]]\n"
OPENING = f'schema = "tolnet.problem/1"\n{PLANT}'
SENSOR = "[[sensors]]\nC = [[1.0]]\nR = [[1.0]]\n"
TWO = "[network]\nnodes = 2\nedges = [[0, 1]]\n" + 2 * SENSOR

MEASURED = """
import sys
from tolnet.cli import main
code = main(sys.argv[1:])
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(peak.split()[1])
sys.exit(code)
"""
"""The command line, which then prints the most memory that it held: what a parent is told counts the parent too."""


def refused(*arguments: object) -> list[str]:
    """The complaints of a command, which must end with exit code 2 within the bounds."""
    ran = subprocess.run(
        [sys.executable, "-c", MEASURED, *map(str, arguments)],
        capture_output=True, text=True, check=False, timeout=ENDLESS, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert ran.returncode == 2, ran.stderr[-2000:]
    assert "Traceback" not in ran.stderr
    assert int(ran.stdout.split()[-1]) < MOST_MEMORY
    return ran.stderr.splitlines()


def written(folder: Path, text: str) -> Path:
    path = folder / "p.toml"
    path.write_text(text, encoding="utf-8")
    return path


def unknown_keys(folder: Path) -> Path:
    return written(folder, "".join(f"k{i} = 1\n" for i in range(10**6)) + OPENING + TWO)


def unknown_keys_of_a_table(folder: Path) -> Path:
    keys = "".join(f"k{i} = 1\n" for i in range(10**6))
    return written(folder, (OPENING + TWO).replace("[network]\n", f"[network]\n{keys}"))


def wrong_sensors(folder: Path) -> Path:
    network = "[network]\nnodes = 100000\nedges = []\n"
    return written(folder, OPENING + network + SENSOR.replace("R = [[1.0]]", 'R = [["x"]]') * 100_000)


def indefinite_sensors(folder: Path) -> Path:
    network = "[network]\nnodes = 100000\nedges = []\n"
    return written(folder, OPENING + network + SENSOR.replace("R = [[1.0]]", "R = [[0.0]]") * 100_000)


@pytest.mark.parametrize("make", [unknown_keys, unknown_keys_of_a_table, wrong_sensors, indefinite_sensors])
def test_many_faults_are_twenty_complaints_and_a_count(tmp_path, make):
    lines = refused("validate", make(tmp_path))
    assert len(lines) == 21
    assert " more complaints " in lines[-1]


def a_bomb(folder: Path) -> Path:
    shape = {"descr": "<f8", "fortran_order": False, "shape": (10**9 // 8, 1, 1)}
    archive = zipfile.ZipFile(folder / "p.npz", "w", zipfile.ZIP_DEFLATED)
    with archive, archive.open("C.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, shape)
        for _ in range(1000):
            member.write(bytes(10**6))
    return written(folder, f'arrays = "p.npz"\n{OPENING}[network]\nnodes = 2\n')


def a_graph_of_many(folder: Path) -> Path:
    N = 200_000
    nodes = "".join(f'<node id="{i}"/>' for i in range(N))
    edges = "".join(f'<edge source="{i}" target="{i + 1}"/>' for i in range(N - 1))
    head = '<graphml xmlns="http://graphml.graphdrawing.org/xmlns"><graph edgedefault="undirected">'
    (folder / "g.graphml").write_text(f"{head}{nodes}{edges}</graph></graphml>")
    return written(folder, f'{OPENING}[network]\ngraphml = "g.graphml"\n{2 * SENSOR}')


def a_laugh(folder: Path) -> Path:
    entities = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10 if i else "lol"}">' for i in range(9))
    graph = '<graph edgedefault="undirected"><node id="0">&l8;</node></graph>'
    (folder / "g.graphml").write_text(f"<!DOCTYPE g [{entities}]><graphml>{graph}</graphml>")
    return written(folder, f'{OPENING}[network]\ngraphml = "g.graphml"\n{2 * SENSOR}')


DEEP = " . ".join(100_000 * ["'a'", '"b"'])
ABSURD: list[tuple[Callable[[Path], Path], str]] = [
    (lambda folder: written(folder, f"{OPENING}{TWO}x = {'[' * 2000}{']' * 2000}\n"), "is nested too deeply"),
    (lambda folder: written(folder, f"{OPENING}{TWO}[{'.'.join('a' * 2000)}]\n"), "is nested too deeply"),
    (lambda folder: written(folder, f"{OPENING}{TWO}{'.'.join('a' * 200_000)} = 1\n"), "is nested too deeply"),
    (lambda folder: written(folder, f"{OPENING}{TWO}x = {{{DEEP} = 1}}\n"), "is nested too deeply"),
    (lambda folder: written(folder, f"{'k' * 5_000_000} = 1\n{OPENING}{TWO}"), "is no known key"),
    (a_bomb, "more than 100 times as much"),
    (a_graph_of_many, "network has a graph of 200,000 nodes; there are 2 sensors"),
    (a_laugh, "declares entities, which are not read"),
]


@pytest.mark.parametrize(("make", "message"), ABSURD, ids=[message for _, message in ABSURD])
def test_absurd_files(tmp_path, make, message):
    (line,) = refused("validate", make(tmp_path))
    assert message in line
    assert len(line) < 1000


PLACES = ["problem", "arrays", "graphml", "table", "archive", "csv", "mat", "data", "scenarios"]
"""Whatever names a file."""


@pytest.mark.parametrize("kind", ["a pipe", "a device"])
@pytest.mark.parametrize(
    "place", ["problem", "arrays", "graphml", "table", "archive", "csv", "mat", "data", "scenarios"]
)
def test_nothing_is_read_that_never_ends(tmp_path, kind, place):
    suffix = {"table": ".json", "archive": ".npz", "csv": ".csv", "mat": ".mat", "data": ".npz"}.get(place, "")
    endless = tmp_path / f"endless{suffix}"
    endless.symlink_to("/dev/zero") if kind == "a device" else os.mkfifo(endless)
    good = written(tmp_path, OPENING + TWO + "[ambiguity]\ntolerance = 0.01\n")
    beside = good.read_text()
    match place:
        case "arrays":
            written(tmp_path, f'arrays = "{endless.name}"\n{beside}')
        case "graphml":
            written(tmp_path, beside.replace("edges = [[0, 1]]", f'graphml = "{endless.name}"'))
    command: dict[str, list[object]] = {
        "problem": ["table", endless, "-o", tmp_path / "t.json"],
        "mat": ["validate", endless],
        "table": ["diff", endless, good],
        "archive": ["certify", good, "--table", endless],
        "csv": ["diff", good, endless],
        "data": ["table", good, "--data", endless],
        "scenarios": ["certify", good, "--claims", "switching", "--scenarios", endless],
    }
    lines = refused(*command.get(place, ["validate", good]))
    assert f"is {kind}; a file was expected" in lines[-1]


def test_a_circle_of_links_is_told_as_one(tolnet: Tolnet, tmp_path: Path):
    (tmp_path / "a.toml").symlink_to("b.toml")
    (tmp_path / "b.toml").symlink_to("a.toml")
    for command in (["validate"], ["table", "-o", tmp_path / "t.json"], ["diff", tmp_path / "a.toml"]):
        ran = tolnet(command[0], tmp_path / "a.toml", *command[1:])
        assert ran.code == 2
        assert "cannot be read: Too many levels of symbolic links" in ran.err


def test_a_link_that_leads_nowhere_is_no_built_in_problem(tolnet: Tolnet, tmp_path: Path):
    (tmp_path / "p.toml").symlink_to("none.toml")
    ran = tolnet("validate", tmp_path / "p.toml")
    assert (ran.code, ran.err) == (2, f"error: {tmp_path / 'p.toml'}: does not exist\n")


def test_a_bad_file_is_refused_without_what_designs(tmp_path: Path):
    program = "import sys; from tolnet.cli import main; main(sys.argv[1:]); print('tolnet.design' in sys.modules)"
    command = [sys.executable, "-c", program, "validate", str(written(tmp_path, OPENING))]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ran.stdout == "False\n"


def test_a_long_document_that_is_no_table_is_not_built(tmp_path: Path):
    for text in ("[" + "[]," * 3_000_000 + "[]]", "[" * 3_000_000):
        (tmp_path / "t.json").write_text(text)
        (line,) = refused("diff", tmp_path / "t.json", tmp_path / "t.json")
        assert "is no table: a document as long as this was expected to open with 'tolnet.table/1'" in line
