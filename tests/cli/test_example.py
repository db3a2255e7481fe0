"""`tolnet example`: lists and writes the built-in problems."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.cli.conftest import Tolnet

from tolnet import model


def test_the_list_is_that_of_the_library(tolnet: Tolnet):
    ran = tolnet("example")
    assert ran.code == 0
    for name, description in model.example_names().items():
        assert any(line.split() == [name, *description.split()] for line in ran.out.splitlines())
    listed = tolnet("example", "--json").document
    assert listed["schema"] == "tolnet.examples/1"
    assert {each["name"]: each["description"] for each in listed["examples"]} == model.example_names()


@pytest.mark.parametrize("name", list(model.example_names()))
def test_what_is_written_is_a_valid_problem(name: str, tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "problem.toml"
    ran = tolnet("example", name, "-o", path)
    assert ran.code == 0
    command = "observability" if name.startswith("field") else "table"
    assert f"tolnet {command} {path}" in ran.out
    assert tolnet("validate", path).code == 0
    assert model.load_problem(path).name == model.example(name).name


def test_what_is_printed_is_the_file(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "problem.toml"
    tolnet("example", "projectile", "-o", path)
    for dash in ([], ["-o", "-"]):
        ran = tolnet("example", "projectile", *dash)
        assert ran.out == path.read_text()
    document = tolnet("example", "projectile", "--json").document
    assert document["toml"] == path.read_text()
    assert document["problem"]["sha256"] == model.load(path).digest


def test_a_random_network_is_its_seed(tolnet: Tolnet, tmp_path: Path):
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        assert tolnet("example", "random", "--nodes", 9, "--seed", seed, "-o", tmp_path / f"{name}.toml").code == 0
    a, b, c = ((tmp_path / f"{name}.toml").read_text() for name in "abc")
    assert a == b
    assert a != c
    assert model.load(tmp_path / "a.toml").N == 9


def test_a_large_one_is_a_file_and_an_archive(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "large.toml"
    ran = tolnet("example", "random", "--nodes", 2000, "-o", path, "--json")
    assert ran.document["written"] == [str(path), str(path.with_suffix(".npz"))]
    assert ran.document["problem"]["sha256"] == model.load(path).digest
    refused = tolnet("example", "random", "--nodes", 2000)
    assert refused.code == 2
    assert refused.out == ""
    assert "use -o FILE.toml" in refused.err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["iee14"], "did you mean 'ieee14'?"),
        (["ieee14", "--nodes", "5"], "only 'random' takes nodes"),
        (["ieee14", "--seed", "5"], "takes no seed"),
        (["random", "--nodes", "0"], "--nodes"),
        (["--nodes", "5"], f"NAME is missing: one of {', '.join(model.example_names())}"),
        (["projectile", "-o", "projectile.json"], "has the suffix '.json'; .toml was expected"),
        (["projectile", "-o", "nowhere/p.toml"], "nowhere does not exist"),
    ],
)
def test_refusals(arguments: list[str], said: str, tolnet: Tolnet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    ran = tolnet("example", *arguments)
    assert ran.code == 2
    assert said in " ".join(ran.err.split())
    assert list(tmp_path.iterdir()) == []
