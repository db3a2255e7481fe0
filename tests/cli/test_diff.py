"""`tolnet diff`: which nodes changed, by how much, whatever the two tables were written as."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import Tolnet

from tolnet import model
from tolnet.design import choose_tolerances
from tolnet.model import Ambiguity


def network(noise: float = 1.0, N: int = 6, names: list[str] | None = None) -> model.SensorNetwork:
    """A path of N nodes; the sensor of node 0 has `noise` for its variance."""
    return model.SensorNetwork(
        A=[[0.9, 0.2], [0.0, 0.8]],
        B=np.eye(2),
        C=[[[1.0, 0.1 * k]] for k in range(N)],
        R=[[[noise if k == 0 else 1.0]] for k in range(N)],
        edges=[[k, k + 1] for k in range(N - 1)],
        names=names,
        name="path",
        ambiguity=Ambiguity(0.02),
    )


@pytest.fixture
def problem(tmp_path: Path):
    def save(name: str, *arguments: object, **options: object) -> Path:
        path = tmp_path / f"{name}.toml"
        model.save(network(*arguments, **options), path)  # pyright: ignore[reportArgumentType]
        return path

    return save


def test_equal_tables_do_not_differ_whatever_they_are_written_as(tolnet: Tolnet, problem, tmp_path: Path):
    path = problem("same")
    written = [tmp_path / f"t{suffix}" for suffix in (".json", ".csv", ".npz")]
    tolnet("table", path, *(word for each in written for word in ("-o", each)))
    for old in [*written, path]:
        for new in [*written, path]:
            ran = tolnet("diff", old, new, "--threshold", 0, "--json")
            assert ran.code == 0
            assert ran.document["changed"] == []
            assert ran.document["unchanged"] == 6


def test_changes_are_those_of_the_library(tolnet: Tolnet, problem):
    old, new = problem("old", 1.0), problem("new", 4.0)
    ran = tolnet("diff", old, new, "--json")
    assert ran.code == 0
    assert ran.document["schema"] == "tolnet.diff/1"
    before, after = choose_tolerances(network(1.0)), choose_tolerances(network(4.0))
    changes = {each["node"]: each for each in ran.document["changed"]}
    assert set(changes) == set(range(6))
    for k, change in changes.items():
        for key, a, b in (
            ("tolerance", before.tolerances[k], after.tolerances[k]),
            ("theta", before.local.theta[k], after.local.theta[k]),
            ("trace_V", before.local.trace_V[k], after.local.trace_V[k]),
        ):
            assert change["old"][key] == a
            assert change["new"][key] == b
            assert change["relative"][key] == pytest.approx((b - a) / abs(a), rel=1e-12)
    largest = [max(map(abs, change["relative"].values())) for change in ran.document["changed"]]
    assert largest == sorted(largest, reverse=True)


def test_a_threshold_leaves_the_small_ones_out(tolnet: Tolnet, problem):
    old, new = problem("old", 1.0), problem("new", 4.0)
    everything = tolnet("diff", old, new, "--json").document["changed"]
    sizes = sorted(max(map(abs, change["relative"].values())) for change in everything)
    between = (sizes[2] + sizes[3]) / 2
    few = tolnet("diff", old, new, "--json", "--threshold", between).document
    assert (len(few["changed"]), few["unchanged"]) == (3, 3)
    assert tolnet("diff", old, new, "--threshold", "nan").code == 2


def test_nodes_that_come_and_go_are_matched_by_name(tolnet: Tolnet, problem):
    old = problem("old", names=["a", "b", "c", "d", "e", "f"])
    new = problem("new", names=["a", "b", "x", "d", "e", "f"])
    document = tolnet("diff", old, new, "--json").document
    assert document["added"] == [{"node": 2, "name": "x"}]
    assert document["removed"] == [{"node": 2, "name": "c"}]
    assert document["unchanged"] == 5
    ran = tolnet("diff", old, new)
    assert "added: x" in ran.out
    assert "removed: c" in ran.out


def test_without_names_the_index_tells(tolnet: Tolnet, problem):
    document = tolnet("diff", problem("old", N=4), problem("new", N=6), "--json").document
    assert [each["node"] for each in document["added"]] == [4, 5]
    assert document["removed"] == []


def test_conventions_are_compared_in_one_unit(tolnet: Tolnet, problem, tmp_path: Path):
    path = problem("same")
    tolnet("table", path, "--convention", "nats", "-o", tmp_path / "nats.json")
    document = tolnet("diff", tmp_path / "nats.json", path, "--json").document
    assert document["changed"] == []
    assert (document["old"]["convention"], document["convention"]) == ("nats", "gamma")


def test_a_node_that_lost_its_answer_has_changed(tolnet: Tolnet, blind: Path, tmp_path: Path):
    tolnet("table", blind, "-o", tmp_path / "old.json")
    document = json.loads((tmp_path / "old.json").read_text())
    document["nodes"][2] |= {"status": "ok", "theta": 1.0, "trace_V": 2.0}
    (tmp_path / "old.json").write_text(json.dumps(document))
    ran = tolnet("diff", tmp_path / "old.json", blind, "--json")
    assert ran.code == 0
    (change,) = ran.document["changed"]
    assert (change["node"], change["name"]) == (2, "hill")
    assert (change["old"]["status"], change["new"]["status"]) == ("ok", "undetectable")
    assert change["relative"]["theta"] is None
    assert "ok -> undetectable" in tolnet("diff", tmp_path / "old.json", blind).out


def test_from_nothing_to_something_is_an_infinite_change(tolnet: Tolnet, problem):
    path = problem("same")
    zero = path.with_name("zero.json")
    assert tolnet("table", path, "-c", 0, "-o", zero).code == 0
    change = tolnet("diff", zero, path, "--json").document["changed"][0]
    assert change["relative"]["tolerance"] == "inf"
    assert change["relative"]["theta"] == "inf"
    assert change["relative"]["trace_V"] > 0


def test_changes_are_written_as_csv_and_json(tolnet: Tolnet, problem, tmp_path: Path):
    old, new = problem("old", 1.0), problem("new", 4.0)
    ran = tolnet("diff", old, new, "-o", tmp_path / "d.csv", "-o", tmp_path / "d.json", "--json")
    assert json.loads((tmp_path / "d.json").read_text()) == ran.document
    with (tmp_path / "d.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["node"]) for row in rows] == [change["node"] for change in ran.document["changed"]]
    assert float(rows[0]["theta_relative"]) == ran.document["changed"][0]["relative"]["theta"]


def test_problems_of_another_family_are_compared_with_uniform_tolerances(tolnet: Tolnet, problem):
    old, new = problem("old", 1.0), problem("new", 4.0)
    refused = tolnet("diff", old, new, "--tau", 0.5)
    assert (refused.code, refused.out) == (2, "")
    assert "local tolerances are defined for tau = 0 only (tau is 0.5); --uniform" in refused.err
    ran = tolnet("diff", old, new, "--tau", 0.5, "--uniform", "--json")
    assert (ran.code, ran.document["tau"]) == (0, 0.5)
    ambiguity = Ambiguity(0.02, tau=0.5)
    before, after = (choose_tolerances(network(noise), ambiguity, uniform=True) for noise in (1.0, 4.0))
    for change in ran.document["changed"]:
        k = change["node"]
        assert change["old"]["trace_V"] == before.local.trace_V[k]
        assert change["new"]["trace_V"] == after.local.trace_V[k]
        assert change["new"]["tolerance"] == 0.02
    assert {each["node"] for each in ran.document["changed"]} == {0, 1}
    said = tolnet("diff", old, new, "--tau", 0.5, "--uniform").out
    assert f"tolnet diff {old} {new} --tau 0.5 --uniform -o changes.csv" in said


def test_a_missing_table_is_refused(tolnet: Tolnet, problem, tmp_path: Path):
    ran = tolnet("diff", tmp_path / "missing.json", problem("same"))
    assert ran.code == 2
    assert "missing.json: does not exist" in ran.err
