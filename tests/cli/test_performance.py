"""`tolnet performance`: the six filters side by side, over time, in every format, and where there is no answer."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import Tolnet

from tolnet import analysis, model
from tolnet.design import choose_tolerances, diffusion_matrix
from tolnet.model.history import FILTERS

CENTRALISED = ("KFC", "RKFC")


def test_json_is_the_contract_with_the_published_numbers(tolnet: Tolnet, ring: Path):
    ran = tolnet("performance", ring, "--json")
    assert (ran.code, ran.err) == (0, "")
    document = ran.document
    assert document["schema"] == "tolnet.performance/1"
    assert (document["convention"], document["tau"], document["tolerance"]) == ("gamma", 0.0, 0.02)
    assert (document["status"], document["diffusion"]) == ("ok", "relative-degree")
    assert document["problem"]["name"] == "ring-projectile"
    decibels = {name: round(each["msd_db"], 4) for name, each in document["filters"].items()}
    assert decibels == {
        "KFC": -2.5306, "RKFC": -3.0745, "KFD": -0.8609, "RKFDU": -1.8217, "RKFDNU": -1.8344, "RKFDNU2": -1.8344,
    }  # fmt: skip
    for name, each in document["filters"].items():
        assert len(each["node_msd"]) == (1 if name in CENTRALISED else 20)
        assert each["msd"] == pytest.approx(np.mean(each["node_msd"]), rel=1e-14)
        assert set(each["blocks"]) == {"network", "least_favourable"}
        assert each["spectral_radius"] == max(each["blocks"].values())
        assert (each["status"], each["reason"]) == ("ok", None)
        assert "history" not in each
    assert round(document["filters"]["RKFDU"]["spectral_radius"], 4) == 0.9595


def test_the_numbers_are_those_of_the_library_to_the_last_bit(tolnet: Tolnet, small: Path):
    network = model.load(small)
    table, W = choose_tolerances(network), diffusion_matrix(network)
    steady, histories = analysis.evaluate_filters(table, W), analysis.follow_filters(table, W, 7)
    document = tolnet("performance", small, "--horizon", 7, "--json").document
    assert document["horizon"] == 7
    assert list(document["filters"]) == list(FILTERS)
    for name, each in document["filters"].items():
        assert each["node_msd"] == steady[name].node_msd.tolist()
        assert each["blocks"]["network"] == steady[name].network_radius
        history = each["history"]
        assert history["msd"] == histories[name].msd.tolist()
        assert history["theta"] == histories[name].theta.mean(axis=1).tolist()
        assert history["tolerance"] == histories[name].tolerance.mean(axis=1).tolist()
        assert (len(history["msd"]), len(history["theta"]), history["status"]) == (8, 7, "ok")


def test_the_means_and_messages_of_the_published_table(tolnet: Tolnet, small: Path):
    found = tolnet("performance", small, "--json").document["filters"]
    table = choose_tolerances(model.load(small))
    uniform = choose_tolerances(model.load(small), uniform=True)
    means = {name: (each["mean_tolerance"], each["mean_theta"]) for name, each in found.items()}
    local = float(table.local.tolerance.mean()), float(table.local.theta.mean())
    assert means == {
        "KFC": (0, 0),
        "RKFC": (0.02, float(table.central.theta)),
        "KFD": (0, 0),
        "RKFDU": (pytest.approx(0.02), pytest.approx(float(uniform.local.theta.mean()), rel=1e-12)),
        "RKFDNU": local,
        "RKFDNU2": local,
    }
    assert [each["messages"] for each in found.values()] == ["n/a", "n/a", "none", "one", "every step", "one"]


def test_a_person_sees_the_filters_side_by_side_and_what_to_try_next(tolnet: Tolnet, small: Path):
    ran = tolnet("performance", small, "--horizon", 50)
    document = tolnet("performance", small, "--json").document
    lines = ran.out.splitlines()
    assert lines[0] == "small: 4 nodes, c = 0.02 (gamma), weights: relative-degree"
    rows = {line.split()[0]: line.split() for line in lines if line.split() and line.split()[-1] == "ok"}
    assert list(rows) == list(FILTERS)
    for name, row in rows.items():
        each = document["filters"][name]
        assert row[1:3] == [f"{each['msd_db']:.4f}", f"{each['msd']:.5g}"]
        assert f"{each['spectral_radius']:.6f}" in row
    worst = int(np.argmax(document["filters"]["KFD"]["node_msd"]))
    assert rows["KFD"][3] == f"{worst}:"
    assert rows["RKFDNU"][-3:-1] == ["every", "step"]
    instants = [int(line.split()[0]) for line in lines if len(line.split()) == 7 and line.split()[0].isdigit()]
    assert instants == list(range(0, 51, 5))
    assert f"  tolnet simulate {small} --runs 500 --steps 50" in lines


def test_filters_are_chosen_by_name_in_any_case_and_told_in_the_order_of_the_literature(tolnet: Tolnet, small: Path):
    ran = tolnet("performance", small, "--filters", "rkfdnu2, KFD", "--json")
    assert list(ran.document["filters"]) == ["KFD", "RKFDNU2"]
    refused = tolnet("performance", small, "--filters", "KFD,RKFDNU3")
    assert (refused.code, refused.out) == (2, "")
    assert "--filters names 'RKFDNU3'" in refused.err
    assert "did you mean 'RKFDNU'?" in refused.err
    assert tolnet("performance", small, "--filters", "").code == 2


def test_weights_are_those_asked_for(tolnet: Tolnet, small: Path):
    network = model.load(small)
    table = choose_tolerances(network)
    for rule in ("uniform", "none"):
        document = tolnet("performance", small, "--diffusion", rule, "--filters", "KFD", "--json").document
        expected = analysis.evaluate_filters(table, diffusion_matrix(network, rule), filters=["KFD"])["KFD"]
        assert document["diffusion"] == rule
        assert document["filters"]["KFD"]["node_msd"] == expected.node_msd.tolist()
    refused = tolnet("performance", small, "--diffusion", "metropolys")
    assert (refused.code, refused.out) == (2, "")
    assert "--diffusion is 'metropolys'; did you mean 'metropolis'?" in refused.err


def test_given_weights_are_called_so(tolnet: Tolnet, small: Path):
    text = small.read_text().replace('rule = "relative-degree"', f"weights = {np.eye(4).tolist()}")
    small.write_text(text)
    document = tolnet("performance", small, "--filters", "KFD", "--json").document
    assert document["diffusion"] == "weights"


def test_every_method_gives_the_same_numbers(tolnet: Tolnet, small: Path):
    found = {}
    for method in ("projected", "smith", "scipy"):
        entry = tolnet("performance", small, "--method", method, "--filters", "KFD", "--json").document["filters"]
        assert entry["KFD"]["method"] == method
        assert entry["KFD"]["error_estimate"] < 1e-6
        found[method] = entry["KFD"]["node_msd"]
    assert found["projected"] == pytest.approx(found["scipy"], rel=1e-8)
    assert found["smith"] == pytest.approx(found["scipy"], rel=1e-10)


def test_in_nats_tolerances_are_half_and_nothing_else_changes(tolnet: Tolnet, small: Path):
    gamma = tolnet("performance", small, "--horizon", 3, "--json").document
    nats = tolnet("performance", small, "--horizon", 3, "--json", "--convention", "nats").document
    assert (nats["convention"], nats["tolerance"]) == ("nats", 0.01)
    for name, each in gamma["filters"].items():
        other = nats["filters"][name]
        assert other["node_msd"] == each["node_msd"]
        assert other["mean_tolerance"] == each["mean_tolerance"] / 2
        assert other["history"]["tolerance"] == [c / 2 for c in each["history"]["tolerance"]]
        assert other["history"]["theta"] == each["history"]["theta"]


def test_some_filters_have_an_answer_where_others_have_none(tolnet: Tolnet, blind: Path, tmp_path: Path):
    ran = tolnet("performance", blind, "--json", "-o", tmp_path / "p.json")
    assert ran.code == 4
    assert json.loads((tmp_path / "p.json").read_text()) == ran.document
    assert ran.document["status"] == "undetectable"
    found = ran.document["filters"]
    for name in CENTRALISED:
        assert found[name]["status"] == "ok"
        assert found[name]["msd"] > 0
    for name in FILTERS.keys() - CENTRALISED:
        assert found[name]["status"] == "undetectable"
        assert found[name]["msd"] is None
        assert found[name]["node_msd"] == [None] * 3
        assert "node hill" in found[name]["reason"]
    assert "no answer: KFD, RKFDU, RKFDNU, RKFDNU2: undetectable: the filter of node hill" in ran.err
    shown = tolnet("performance", blind)
    assert shown.code == 4
    assert "--limits" not in shown.out  # no tolerance helps
    row = next(line.split() for line in shown.out.splitlines() if line.split()[:1] == ["KFD"])
    assert row[1:5] == ["-"] * 4


def test_without_a_steady_state_a_horizon_gives_the_transient(tolnet: Tolnet, folded: Path):
    steady = tolnet("performance", folded, "--json")
    assert steady.code == 4
    assert "fold: the tolerance 0.1 is not below the centre's fold, 0.0268564" in steady.err
    assert "--horizon T still gives the transient" in steady.err
    over_time = tolnet("performance", folded, "--horizon", 6, "--json")
    assert over_time.code == 4
    assert "--horizon T" not in over_time.err
    network = model.load(folded)
    table = choose_tolerances(network)
    expected = analysis.follow_filters(table, diffusion_matrix(network), 6)
    for name, each in over_time.document["filters"].items():
        assert (each["status"], each["msd"]) == ("fold", None)
        assert each["history"]["status"] == "ok"
        assert each["history"]["msd"] == expected[name].msd.tolist()


def test_every_format_says_the_same(tolnet: Tolnet, small: Path, tmp_path: Path):
    paths = {suffix: tmp_path / f"p{suffix}" for suffix in (".json", ".csv", ".npz", ".md")}
    outputs = [word for path in paths.values() for word in ("-o", path)]
    document = tolnet("performance", small, "--horizon", 4, *outputs, "--json").document
    assert json.loads(paths[".json"].read_text()) == document
    lines = paths[".csv"].read_text().splitlines()
    said = dict(line[2:].split(": ", 1) for line in lines if line.startswith("# "))
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert json.loads(said["problem.sha256"]) == document["problem"]["sha256"]
    for name, each in document["filters"].items():
        assert json.loads(said[f"filters.{name}.msd"]) == each["msd"]
        assert json.loads(said[f"filters.{name}.blocks.network"]) == each["blocks"]["network"]
        column = [float(row[name]) for row in rows]
        assert column == (each["node_msd"] * 4 if name in CENTRALISED else each["node_msd"])
    with np.load(paths[".npz"], allow_pickle=False) as arrays:
        for name, each in document["filters"].items():
            assert arrays[f"filters_{name}_node_msd"].tolist() == each["node_msd"]
            assert arrays[f"filters_{name}_history_msd"].tolist() == each["history"]["msd"]
            by_node = arrays[f"filters_{name}_history_node_msd"]
            assert by_node.shape == (5, 1 if name in CENTRALISED else 4)
            assert by_node.mean(axis=1).tolist() == each["history"]["msd"]
            assert arrays[f"filters_{name}_reason"] == ""
    markdown = paths[".md"].read_text()
    assert document["problem"]["sha256"] in markdown
    assert f"| RKFDNU | {document['filters']['RKFDNU']['msd_db']:.4f} |" in markdown
    assert not list(tmp_path.glob(".tolnet*"))


@pytest.mark.parametrize(("suffix", "horizon"), [(".png", 4), (".svg", None), (".pdf", 4)])
def test_pictures(suffix: str, horizon: int | None, tolnet: Tolnet, small: Path, folded: Path, tmp_path: Path):
    more = [] if horizon is None else ["--horizon", horizon]
    for problem, code in ((small, 0), (folded, 4)):
        path = tmp_path / f"{problem.stem}{suffix}"
        assert tolnet("performance", problem, "--plot", path, "--quiet", *more).code == code
        assert path.stat().st_size > 5_000


@pytest.mark.parametrize("command", ["performance", "simulate"])
def test_other_divergences_are_refused(command: str, tolnet: Tolnet, small: Path):
    text = small.read_text()
    assert "tau = 0.0" in text
    small.write_text(text.replace("tau = 0.0", "tau = 0.5"))
    ran = tolnet(command, small)
    assert (ran.code, ran.out) == (2, "")
    assert "the least favourable model is defined for tau = 0 only, and ambiguity.tau is 0.5" in ran.err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--horizon", "0"], "--horizon"),
        (["--method", "guess"], "--method"),
        (["--tau", "0.5"], "--tau"),
        (["--tolerance", "-1"], "--tolerance is -1.0; a finite number >= 0 was expected"),
        (["-o", "p.h"], "p.h: has the suffix '.h'; .json or .csv or .npz or .md was expected"),
        (["-o", "small.toml"], "small.toml: has the suffix '.toml'"),
        (["--plot", "p.bmp"], "p.bmp: has the suffix '.bmp'; .png or .svg or .pdf was expected"),
        (["-o", "nowhere/p.json"], "nowhere does not exist"),
    ],
)
def test_bad_options_are_refused_before_anything_is_computed(
    options: list[str], said: str, tolnet: Tolnet, small: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(small.parent)
    monkeypatch.setattr("tolnet.design.choose_tolerances", pytest.fail)
    ran = tolnet("performance", small, *options)
    assert (ran.code, ran.out) == (2, "")
    assert said in ran.err
    assert [path.name for path in small.parent.iterdir()] == ["small.toml"]
