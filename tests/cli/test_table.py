"""`tolnet table`: what it prints and writes, in which convention, and what it says where there is no answer."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import Tolnet
from tests.instances_random import random_network

from tolnet import __version__, model
from tolnet.design import choose_tolerances
from tolnet.model import Ambiguity


def test_json_is_the_contract_and_nothing_else_is_on_standard_output(tolnet: Tolnet, ring: Path):
    ran = tolnet("table", ring, "--json")
    assert ran.code == 0
    assert ran.err == ""
    document = ran.document
    assert document["schema"] == "tolnet.table/1"
    assert document["tolnet"] == __version__
    assert document["problem"] == {
        "name": "ring-projectile",
        "sha256": hashlib.sha256(ring.read_bytes()).hexdigest(),
    }
    assert (document["convention"], document["tau"], document["tolerance"]) == ("gamma", 0.0, 0.02)
    assert document["status"] == "ok"
    assert [node["node"] for node in document["nodes"]] == list(range(20))
    assert set(document["nodes"][0]) == {
        "node", "degree", "tolerance", "theta", "trace_P", "trace_V", "spectral_radius", "attraction", "status",
        "reason",
    }  # fmt: skip


def test_the_numbers_are_those_of_the_library_to_the_last_bit(tolnet: Tolnet, ring: Path):
    table = choose_tolerances(model.load(ring))
    nodes = tolnet("table", ring, "--json").document["nodes"]
    for key in ("theta", "trace_P", "trace_V", "spectral_radius", "attraction"):
        assert [node[key] for node in nodes] == getattr(table.local, key).tolist()
    assert [node["tolerance"] for node in nodes] == table.tolerances.tolist()


def test_the_numbers_are_the_published_ones(tolnet: Tolnet, ring: Path):
    document = tolnet("table", ring, "--json").document
    c = [node["tolerance"] for node in document["nodes"]]
    assert np.mean(c) == pytest.approx(0.014796, abs=5e-7)
    assert [c[0], c[9], c[19]] == pytest.approx([0.015165, 0.014791, 0.014898], abs=5e-7)
    assert document["central"]["theta"] == pytest.approx(1.375649, abs=5e-7)
    assert document["central"]["trace_V"] == pytest.approx(0.281739, abs=5e-7)


def test_a_person_gets_every_row_a_summary_and_the_next_command(tolnet: Tolnet, ring: Path):
    ran = tolnet("table", ring)
    assert ran.code == 0
    lines = ran.out.splitlines()
    assert lines[0] == "ring-projectile: 20 nodes, c = 0.02 (gamma)"
    rows = [line.split() for line in lines if line.strip().endswith("ok") and line.split()[0].isdigit()]
    assert [int(row[0]) for row in rows if len(row) > 3 and row[1] == "5"] == list(range(20))
    assert "20 of 20 nodes ok; c_k from 0.0140317 (node 14) to 0.0157872 (node 3), mean 0.0147962" in ran.out
    assert f"tolnet table {ring} --limits" in lines[-1]


def test_a_large_network_shows_its_ends_and_its_worst(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "many.toml"
    model.save(model.example("random", 500, 3), path)
    ran = tolnet("table", path)
    assert ran.code in (0, 4)
    first = [line.split()[0] for line in ran.out.splitlines() if line.split()]
    assert first.count("...") >= 2
    shown = [int(word) for word in first if word.isdigit()]
    assert len(shown) <= 17
    assert {0, 1, 2, 3, 4, 495, 496, 497, 498, 499} <= set(shown)
    V = choose_tolerances(model.load(path)).local.trace_V
    assert int(np.nanargmax(V)) in shown


def test_quiet_says_nothing(tolnet: Tolnet, ring: Path, tmp_path: Path):
    ran = tolnet("table", ring, "--quiet", "-o", tmp_path / "t.csv")
    assert (ran.code, ran.out, ran.err) == (0, "", "")
    assert (tmp_path / "t.csv").exists()


def test_every_format_and_the_map_at_once(tolnet: Tolnet, ring: Path, tmp_path: Path):
    paths = [tmp_path / f"t{suffix}" for suffix in (".json", ".csv", ".npz", ".parquet", ".md", ".h")]
    outputs = [word for path in paths for word in ("-o", path)]
    ran = tolnet("table", ring, *outputs, "--plot", tmp_path / "map.png", "--json")
    assert ran.code == 0
    assert all(path.stat().st_size > 500 for path in paths)
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads(paths[0].read_text()) == ran.document
    assert not list(tmp_path.glob(".tolnet*"))


def test_full_adds_what_is_deployed(tolnet: Tolnet, ring: Path, tmp_path: Path):
    ran = tolnet("table", ring, "--json", "--full", "-o", tmp_path / "t.json")
    node = ran.document["nodes"][7]
    assert np.shape(node["P"]) == np.shape(node["V"]) == (6, 6)
    assert np.shape(node["gain"]) == (6, 15)
    assert [link["node"] for link in node["neighbours"]] == [5, 6, 7, 8, 9]
    assert [link["weight"] for link in node["neighbours"]] == [0.2] * 5
    assert json.loads((tmp_path / "t.json").read_text()) == ran.document


def test_nats_are_half_of_gamma_and_the_filters_are_the_same(tolnet: Tolnet, ring: Path):
    gamma = tolnet("table", ring, "--json").document
    nats = tolnet("table", ring, "--json", "--convention", "nats").document
    assert (nats["convention"], nats["tolerance"]) == ("nats", 0.01)
    for a, b in zip(gamma["nodes"], nats["nodes"], strict=True):
        assert b["tolerance"] == a["tolerance"] / 2
        assert b["theta"] == a["theta"]
        assert b["trace_V"] == a["trace_V"]


def test_a_tolerance_overrides_the_problems_in_the_unit_asked_for(tolnet: Tolnet, ring: Path):
    expected = choose_tolerances(model.load(ring), Ambiguity(0.06)).tolerances
    in_gamma = tolnet("table", ring, "--json", "--tolerance", 0.06).document
    assert [node["tolerance"] for node in in_gamma["nodes"]] == expected.tolist()
    in_nats = tolnet("table", ring, "--json", "--tolerance", 0.03, "--convention", "nats").document
    assert [2 * node["tolerance"] for node in in_nats["nodes"]] == expected.tolist()


def test_a_problem_without_ambiguity_takes_a_tolerance(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "plain.toml"
    network = model.SensorNetwork(A=[[0.9]], B=[[1.0]], C=[[[1.0]]], R=[[[1.0]]], edges=[], name="plain")
    model.save(network, path)
    refused = tolnet("table", path)
    assert refused.code == 2
    assert "--tolerance is missing" in refused.err
    assert tolnet("table", path, "-c", 0.1, "--json").document["nodes"][0]["tolerance"] == pytest.approx(0.1)


def test_uniform_gives_everybody_c(tolnet: Tolnet, ring: Path):
    nodes = tolnet("table", ring, "--uniform", "--json").document["nodes"]
    assert {node["tolerance"] for node in nodes} == {0.02}


def test_tau_takes_uniform_tolerances_only(tolnet: Tolnet, ring: Path):
    refused = tolnet("table", ring, "--tau", 0.5)
    assert refused.code == 2
    assert "--uniform" in refused.err
    limits = tolnet("table", ring, "--tau", 0.5, "--uniform", "--limits")
    assert (limits.code, limits.out) == (2, "")
    assert "--limits are defined for tau = 0 only" in limits.err
    document = tolnet("table", ring, "--tau", 0.5, "--uniform", "--json").document
    assert document["tau"] == 0.5
    assert {node["status"] for node in document["nodes"]} == {"ok"}
    in_nats = tolnet("table", ring, "--tau", 0.5, "--uniform", "--convention", "nats")
    assert in_nats.code == 2
    assert "--convention is 'nats', which only tau = 0 has" in in_nats.err


def test_limits_are_shown_and_written_in_the_convention(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "fold.toml"
    network = model.SensorNetwork(
        A=[[0.9]], B=[[1.0]], C=[[[0.1]]], R=[[[1.0]]], edges=[], name="fold", ambiguity=Ambiguity(0.02)
    )
    model.save(network, path)
    ran = tolnet("table", path, "--limits", "-o", tmp_path / "t.csv", "-o", tmp_path / "t.json")
    assert "settles below" in ran.out
    assert "limits_published" in (tmp_path / "t.csv").read_text()
    gamma = json.loads((tmp_path / "t.json").read_text())
    assert gamma["central"]["limits"]["fold"] == pytest.approx(0.0269, abs=5e-5)
    nats = tolnet("table", path, "--limits", "--json", "--convention", "nats").document
    for a, b in zip([gamma["central"], *gamma["nodes"]], [nats["central"], *nats["nodes"]], strict=True):
        assert list(a["limits"]) == ["fold", "attracts", "exists", "published"]
        for key, value in a["limits"].items():
            assert b["limits"][key] == (value / 2 if isinstance(value, float) else value)


def test_no_answer_at_one_node_leaves_the_others_theirs(tolnet: Tolnet, blind: Path, tmp_path: Path):
    ran = tolnet("table", blind, "--json", "-o", tmp_path / "t.json")
    assert ran.code == 4
    document = ran.document
    assert document["status"] == "undetectable"
    assert document["central"]["status"] == "ok"
    assert [node["status"] for node in document["nodes"]] == ["ok", "ok", "undetectable"]
    assert [node["reason"] for node in document["nodes"][:2]] == [None, None]
    assert document["nodes"][2]["reason"].endswith("sees all of the mode 1.1 of A, which does not decay")
    assert document["central"]["reason"] is None
    assert document["nodes"][2]["theta"] is None
    assert document["nodes"][0]["trace_V"] > 0
    assert json.loads((tmp_path / "t.json").read_text()) == document
    assert "node 2 (hill): undetectable" in ran.err
    assert "(node 2) sees all of the mode 1.1 of A" in ran.err
    assert "node 0" not in ran.err


def test_a_person_sees_the_row_without_an_answer_and_why(tolnet: Tolnet, blind: Path):
    ran = tolnet("table", blind)
    assert ran.code == 4
    row = next(line.split() for line in ran.out.splitlines() if "undetectable" in line)
    assert row[:2] == ["2", "hill"]
    assert row.count("-") == 5
    assert "2 of 3 nodes ok" in ran.out


def test_a_mode_that_no_noise_drives_is_named(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "undriven.toml"
    network = model.SensorNetwork(
        A=np.diag([1.0, 0.5]), B=[[0.0], [1.0]], C=np.ones((1, 1, 2)), R=[[[1.0]]], edges=[], name="undriven",
        ambiguity=Ambiguity(0.01), states=["bias", "level"],
    )  # fmt: skip
    model.save(network, path)
    ran = tolnet("table", path, "--json")
    assert ran.code == 4
    assert ran.document["central"]["theta"] is None
    assert ran.document["nodes"][0]["tolerance"] is None
    assert tolnet("table", path, "-o", tmp_path / "t.h").code == 4
    assert "NAN" in (tmp_path / "t.h").read_text()
    said = "central filter: unstabilisable: the process noise does not drive all of the mode 1 (bias) of A"
    assert said in ran.err


def test_a_filter_that_oscillates_is_said_to(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "large.toml"
    model.save(random_network(np.random.default_rng(31), 4, 8, radius=1.02, relays=0.9), path)
    ran = tolnet("table", path, "--tolerance", 1.0, "--json")
    assert ran.code == 4
    assert ran.document["central"]["status"] == "oscillates"
    assert ran.document["central"]["attraction"] >= 1
    assert ran.document["central"]["trace_V"] > 0
    assert "central filter: oscillates: a steady state exists, but the filter never settles on it" in ran.err


def test_a_built_in_problem_serves_where_there_is_no_such_file(
    tolnet: Tolnet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    ran = tolnet("table", "projectile", "--json")
    assert ran.code == 0
    assert ran.document["problem"]["name"] == "projectile"
    assert "no file projectile here: taking the built-in problem" in ran.err
    model.save(model.example("random", 4, 1), tmp_path / "other.toml")
    (tmp_path / "other.toml").rename(tmp_path / "projectile")
    assert tolnet("table", "projectile", "--json").document["problem"]["name"] == "random"


def test_the_side_archive_of_the_problem_is_never_overwritten(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "large.toml"
    model.save(model.example("random", 30, 1), path, arrays=True)
    before = (tmp_path / "large.npz").read_bytes()
    ran = tolnet("table", path, "-o", tmp_path / "large.npz")
    assert ran.code == 2
    assert "large.npz: cannot be written: it is an input of this command" in ran.err
    assert (tmp_path / "large.npz").read_bytes() == before


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_plots(suffix: str, tolnet: Tolnet, ring: Path, tmp_path: Path):
    assert tolnet("table", ring, "--quiet", "--plot", tmp_path / f"map{suffix}").code == 0
    assert (tmp_path / f"map{suffix}").stat().st_size > 5_000
