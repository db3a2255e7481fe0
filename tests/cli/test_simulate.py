"""`tolnet simulate`: what was measured beside what was predicted, the same whatever the number of workers."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import Tolnet

from tolnet import analysis, model
from tolnet.analysis import simulation
from tolnet.design import choose_tolerances, diffusion_matrix
from tolnet.model.history import FILTERS

FEW = ("--runs", 60, "--steps", 5, "--seed", 3)


def test_json_is_the_contract_with_the_numbers_of_the_library(tolnet: Tolnet, small: Path):
    ran = tolnet("simulate", small, *FEW, "--json")
    assert (ran.code, ran.err) == (0, "")
    document = ran.document
    assert document["schema"] == "tolnet.simulation/1"
    assert (document["status"], document["diffusion"], document["tolerance"]) == ("ok", "relative-degree", 0.02)
    network = model.load(small)
    expected = analysis.simulate_filters(
        choose_tolerances(network), diffusion_matrix(network), runs=60, steps=5, seed=3
    )
    assert list(document["filters"]) == list(FILTERS)
    for name, each in document["filters"].items():
        found = expected[name]
        assert (each["runs"], each["steps"], each["seed"], each["diverged"]) == (60, 5, 3, 0)
        for key in ("mse", "bound", "consistency", "interval", "node_mse"):
            assert each[key] == getattr(found, key).tolist()
        assert np.shape(each["node_mse"]) == (6, 1 if FILTERS[name].centralised else 4)
        assert (each["status"], each["reason"]) == ("ok", None)


def test_a_person_sees_measured_beside_predicted(tolnet: Tolnet, small: Path):
    ran = tolnet("simulate", small, *FEW)
    found = tolnet("simulate", small, *FEW, "--json").document["filters"]
    assert "60 runs of 5 steps of the least favourable model, seed 3" in ran.out
    for name, each in found.items():
        (row,) = (line.split() for line in ran.out.splitlines() if line.split()[:1] == [name])
        low, high = each["interval"][-1]
        assert row[2:7] == [
            f"{each['mse'][-1]:.5g}", f"{low:.5g}", "to", f"{high:.5g}", f"{each['bound'][-1]:.5g}",
        ]  # fmt: skip
        assert row[7:] == [f"{each['consistency'][-1]:.4f}", "0", "ok"]
    assert f"tolnet performance {small} --horizon 5" in ran.out


def test_the_numbers_do_not_depend_on_the_workers_but_on_the_seed(process: Tolnet, tolnet: Tolnet, small: Path):
    options = ("--runs", 120, "--steps", 3, "--filters", "RKFDNU2", "--json")
    one = tolnet("simulate", small, *options)
    assert process("simulate", small, *options, "--workers", 2).out == one.out
    assert tolnet("simulate", small, *options, "--seed", 1).out != one.out


def test_every_format_says_the_same(tolnet: Tolnet, small: Path, tmp_path: Path):
    paths = {suffix: tmp_path / f"s{suffix}" for suffix in (".json", ".csv", ".npz", ".md")}
    outputs = [word for path in paths.values() for word in ("-o", path)]
    document = tolnet("simulate", small, *FEW, *outputs, "--plot", tmp_path / "s.png", "--json").document
    assert json.loads(paths[".json"].read_text()) == document
    rows = list(csv.DictReader(line for line in paths[".csv"].read_text().splitlines() if line[0] != "#"))
    assert [int(row["t"]) for row in rows] == list(range(6))
    with np.load(paths[".npz"], allow_pickle=False) as arrays:
        for name, each in document["filters"].items():
            assert [float(row[f"{name}_mse"]) for row in rows] == each["mse"]
            assert [[float(row[f"{name}_{end}"]) for end in ("low", "high")] for row in rows] == each["interval"]
            assert arrays[f"filters_{name}_node_mse"].tolist() == each["node_mse"]
            assert arrays[f"filters_{name}_node_bound"].mean(axis=1) == pytest.approx(each["bound"], rel=1e-14)
    assert document["problem"]["sha256"] in paths[".md"].read_text()
    assert (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")


def test_runs_that_leave_the_range_of_doubles_are_no_answer(
    tolnet: Tolnet, small: Path, monkeypatch: pytest.MonkeyPatch
):
    honest = simulation.disturb

    def spoilt(model, rng, *, runs):
        for t, at in enumerate(honest(model, rng, runs=runs)):
            at.output[0] += 1e300 * (t == 1)
            yield at

    monkeypatch.setattr(simulation, "disturb", spoilt)
    ran = tolnet("simulate", small, *FEW, "--filters", "KFC", "--json")
    assert ran.code == 4
    each = ran.document["filters"]["KFC"]
    assert (ran.document["status"], each["status"], each["diverged"]) == ("diverges", "diverges", 2)
    assert each["mse"][-1] > 0
    assert "KFC: diverges: 2 of 60 runs left the range of doubles" in ran.err


def test_without_a_tolerance_one_filter_is_not_run(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "undriven.toml"
    network = model.SensorNetwork(
        A=np.diag([1.0, 0.5]), B=[[0.0], [1.0]], C=np.ones((1, 1, 2)), R=[[[1.0]]], edges=[], name="undriven",
        ambiguity=model.Ambiguity(0.01),
    )  # fmt: skip
    model.save(network, path)
    ran = tolnet("simulate", path, *FEW, "--plot", tmp_path / "s.svg")
    assert ran.code == 4
    assert "no answer: RKFDNU2: unstabilisable" in ran.err
    (row,) = (line.split() for line in ran.out.splitlines() if line.split()[:1] == ["RKFDNU2"])
    assert row[1:] == ["-", "-", "-", "-", "-", "0", "unstabilisable"]
    assert "RKFDNU2 (unstabilisable)" in (tmp_path / "s.svg").read_text()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--runs", "1"], "--runs"),
        (["--steps", "0"], "--steps"),
        (["--seed", "-1"], "--seed"),
        (["--workers", "0"], "--workers"),
        (["--filters", "EKF"], "--filters names 'EKF'"),
        (["-o", "s.parquet"], "s.parquet: has the suffix '.parquet'"),
    ],
)
def test_bad_options_are_refused_before_anything_is_computed(
    options: list[str], said: str, tolnet: Tolnet, small: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("tolnet.design.choose_tolerances", pytest.fail)
    ran = tolnet("simulate", small, *options)
    assert (ran.code, ran.out) == (2, "")
    assert said in ran.err
