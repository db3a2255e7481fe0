"""`tolnet simulate` and `tolnet window` over corrupted channels, as people and programs see them."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import Tolnet

from tolnet import analysis, design, model
from tolnet.model.window_choice import NEVER

FEW = ("--runs", 40, "--steps", 6, "--seed", 2)


def test_simulation_json_has_the_numbers_of_the_library(tolnet: Tolnet):
    ran = tolnet("simulate", "field", "--filters", "all", *FEW, "--json")
    assert ran.code == 0
    document = ran.document
    assert (document["schema"], document["status"]) == ("tolnet.simulation/1", "ok")
    assert (document["tolerance"], document["shared_path"]) == (None, False)
    found = analysis.simulate_corrupted(model.example("field"), runs=40, steps=6, seed=2)
    assert list(document["filters"]) == list(found) == list(analysis.CHANNEL_FILTERS)
    for name, each in document["filters"].items():
        assert (each["runs"], each["steps"], each["seed"], each["diverged"]) == (40, 6, 2, 0)
        for key in ("mse", "interval", "node_mse"):
            assert each[key] == getattr(found[name], key).tolist()
        bound = found[name].bound.tolist()
        assert each["bound"] == ([None] * 7 if name.startswith("CSGF") else bound)
        assert (each["status"], each["reason"]) == ("ok", None)
    assert document["filters"]["DRKF-SWF"]["solves"] == 40 * 4 * 6
    assert document["filters"]["DRKF"]["overconfident"] is False
    assert document["filters"]["CSGF"]["overconfident"] is document["filters"]["CSGF-tau"]["overconfident"] is None


def test_a_person_sees_each_filter_beside_its_own_bound(tolnet: Tolnet):
    ran = tolnet("simulate", "field", *FEW, "--filters", "crkf,drkf,CKF-tau", "--shared-path")
    assert "4 nodes over corrupted channels" in ran.out
    assert "40 runs of 6 steps, one path of noise on matrices for all, seed 2" in ran.out
    rows = {line.split()[0]: line.split() for line in ran.out.splitlines() if line[1:5] in ("DRKF", "CKF-", "CRKF")}
    assert list(rows) == ["DRKF", "CKF-tau", "CRKF"]
    assert rows["DRKF"][-3:] == ["steady", "0", "ok"]
    assert "tolnet window field" in ran.out


@pytest.mark.parametrize("name", analysis.CHANNEL_FILTERS)
def test_every_filter_is_chosen_by_its_name_and_offered_in_the_help(name: str, tolnet: Tolnet, small: Path):
    """Over a problem without a word of channels too: the name alone tells which kind of problem it is."""
    ran = tolnet("simulate", small, "--runs", 2, "--steps", 1, "--filters", name.lower(), "--json")
    assert list(ran.document["filters"]) == [name]
    offered = "".join(tolnet("simulate", "--help").out.split()).replace("│", "")
    assert f",{name}," in offered.replace(";", ",").replace("channelsof", ",")


def test_every_format_says_the_same_and_the_picture_is_one(tolnet: Tolnet, tmp_path: Path):
    paths = {suffix: tmp_path / f"s{suffix}" for suffix in (".json", ".csv", ".npz", ".md")}
    outputs = [word for path in paths.values() for word in ("-o", path)]
    document = tolnet("simulate", "field", *FEW, *outputs, "--plot", tmp_path / "s.png", "--json").document
    assert json.loads(paths[".json"].read_text()) == document
    rows = list(csv.DictReader(line for line in paths[".csv"].read_text().splitlines() if line[0] != "#"))
    with np.load(paths[".npz"], allow_pickle=False) as arrays:
        for name, each in document["filters"].items():
            assert [float(row[f"{name}_mse"]) for row in rows] == each["mse"]
            assert arrays[f"filters_{name}_node_error"].shape[2:] == (4, 4)
    assert document["problem"]["sha256"] in paths[".md"].read_text()
    assert (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")


def test_workers_do_not_change_the_numbers(process: Tolnet, tolnet: Tolnet):
    options = ("simulate", "field", "--runs", 270, "--steps", 2, "--filters", "DRKF", "--json")
    assert process(*options, "--workers", 2).document == tolnet(*options).document


def test_the_filters_decide_where_the_problem_leaves_it_open(tolnet: Tolnet, small: Path, tmp_path: Path):
    """A problem without a word of channels has exact ones; one with both is what its filters take it for."""
    network = model.load(small)
    definite = tmp_path / "definite.toml"
    model.save(network, definite)
    ran = tolnet("simulate", definite, *FEW, "--filters", "DRKF,CRKF", "--json")
    assert list(ran.document["filters"]) == ["DRKF", "CRKF"]
    assert tolnet("simulate", definite, *FEW, "--filters", "KFC", "--json").document["tolerance"] == 0.02


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--tolerance", "0.1"], "--tolerance is for problems without corrupted channels"),
        (["--filters", "EKF"], "--filters names 'EKF'; the filters are DRKF"),
        (["-o", "s.parquet"], "s.parquet: has the suffix '.parquet'"),
        (["--window", "0"], "--window"),
        (["--interval", "0"], "--interval"),
    ],
)
def test_bad_options_are_refused_before_anything_is_computed(
    options: list[str], said: str, tolnet: Tolnet, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("tolnet.analysis.simulate_corrupted", pytest.fail)
    ran = tolnet("simulate", "field", *options)
    assert (ran.code, ran.out) == (2, "")
    assert said in ran.err


def test_channel_options_need_channels(tolnet: Tolnet, small: Path):
    ran = tolnet("simulate", small, "--shared-path", "--window", "2")
    assert ran.code == 2
    assert "--shared-path is for problems with corrupted channels" in ran.err
    assert "--window is for problems with corrupted channels" in ran.err


@pytest.mark.parametrize("command", ["simulate", "window"])
def test_a_window_of_nothing_in_a_file_is_refused_with_its_key(command: str, tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "field.toml"
    model.save(model.example("field"), path)
    text = path.read_text()
    assert text.count("[fusion]\n") == 1
    path.write_text(text.replace("[fusion]\n", "[fusion]\nwindow = 0\n"))
    ran = tolnet(command, path)
    assert ran.code == 2
    assert "field.toml: fusion.window is 0" in ran.err


def test_runs_that_diverge_are_no_answer(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "wild.toml"
    model.save(
        model.CorruptedNetwork(
            A=40 * np.eye(2), Q=np.eye(2), C=[[[1.0, 0.0]], [[0.0, 1.0]]], R=[[[1.0]], [[1.0]]], edges=[[0, 1]],
            fading_mean=[0.5, 1.0], fading_variance=[0.2, 0.0], matrix_noise=0.5, name="wild",
        ),
        path,
    )  # fmt: skip
    ran = tolnet("simulate", path, "--runs", 5, "--steps", 250, "--filters", "CKF,CSGF")
    assert ran.code == 4
    assert "no answer: CKF, CSGF: diverges: 5 of 5 runs diverged" in ran.err


WINDOW = ("window", "field", "--windows", "1,2", "--intervals", "1,4", "--steps", 12)


def test_window_json_has_the_numbers_of_the_library(tolnet: Tolnet):
    document = tolnet(*WINDOW, "--budget", "solves=0.5", "--json").document
    assert (document["schema"], document["status"], document["per"]) == ("tolnet.window/1", "ok", "step")
    choice = design.choose_window(model.example("field"), {"solves": 0.5}, windows=(1, 2), intervals=(1, 4), steps=12)
    assert document["budget"] == {"solves": 0.5}
    assert [node["trace"] for node in document["nodes"]] == choice.node_trace.tolist()
    assert {node["interval"] for node in document["nodes"]} <= {None, 4}
    points = [*choice.front, *choice.mixtures]
    assert [point["trace"] for point in document["front"]] == [point.trace for point in points]
    assert [point["solving"] for point in document["front"]] == [point.solving for point in points]
    assert (document["solves"], document["solve_rate"]) == (choice.solves, choice.rate)
    for point in document["front"][len(choice.front) :]:
        assert len(point["intervals"]) == 4
    assert document["nodes"][0]["weights"][0]["sender"] == 0


def test_window_for_people_and_files(tolnet: Tolnet, tmp_path: Path):
    outputs = [word for suffix in ("json", "csv", "md") for word in ("-o", tmp_path / f"w.{suffix}")]
    ran = tolnet(*WINDOW, *outputs, "--plot", tmp_path / "w.png")
    assert ran.code == 0
    assert "below Algorithm 1" in ran.out
    assert "tolnet window field --windows 1,2 --intervals 1,4 --steps 12 -o designed.toml" in ran.out
    document = json.loads((tmp_path / "w.json").read_text())
    assert f"{document['solves']} fusion problems in 12 steps, {document['solve_rate']:.4g} a step" in ran.out
    assert document["solves"] == 12 * sum(1 / (node["interval"] or math.inf) for node in document["nodes"])
    rows = list(csv.DictReader(line for line in (tmp_path / "w.csv").read_text().splitlines() if line[0] != "#"))
    assert [float(row["trace"]) for row in rows] == [node["trace"] for node in document["nodes"]]
    assert "# Windows of field" in (tmp_path / "w.md").read_text()
    assert (tmp_path / "w.png").read_bytes().startswith(b"\x89PNG")


def test_a_choice_is_simulated_from_the_file_that_it_wrote(tolnet: Tolnet, tmp_path: Path):
    designed, told = tmp_path / "designed.toml", tmp_path / "w.json"
    ran = tolnet(
        "window", "field", "--windows", "1,2", "--intervals", "1,4", "--steps", 40, "-o", designed, "-o", told
    )
    assert f"tolnet simulate {designed} --filters DRKF,DRKF-SWF,CRKF" in ran.out
    nodes = json.loads(told.read_text())["nodes"]
    read = model.load_corrupted(designed)
    assert {node["window"] for node in nodes if node["interval"]} <= {read.window}
    assert read.interval.tolist() == [node["interval"] or NEVER for node in nodes]
    ran = tolnet("simulate", designed, "--runs", 3, "--steps", 8, "--filters", "DRKF-SWF", "--json")
    assert ran.document["filters"]["DRKF-SWF"]["solves"] == 3 * (8 // read.interval).sum() > 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--budget", "solve=1"], "--budget names 'solve'; solves=X or bytes=X was expected; did you mean 'solves'?"),
        (["--budget", "bytes=much"], "--budget bytes is 'much'; a number was expected"),
        (["--budget", "bytes=3"], "budget.bytes is 3; a link needs 112 bytes a step"),
        (["--windows", "0,1"], "--windows is '0,1'; whole numbers of at least 1"),
        (["--intervals", "x"], "--intervals is 'x'"),
        (["--steps", "1"], "--steps"),
        (["-o", "w.npz"], "w.npz: has the suffix '.npz'"),
    ],
)
def test_bad_options_of_window(options: list[str], said: str, tolnet: Tolnet):
    ran = tolnet("window", "field", *options)
    assert (ran.code, ran.out) == (2, "")
    assert said in ran.err
