"""`tolnet diffusion`: the contract, every format, certificates that check, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import Tolnet

from tolnet import design, model

DESIGNED = ("value", "baseline", "bound", "gap_closed", "msd", "baseline_msd", "spectral_radius", "evaluations")


@pytest.fixture
def loaded(small: Path) -> model.SensorNetwork:
    return model.load(small)


def test_json_is_the_contract_and_the_library(tolnet: Tolnet, small: Path, loaded: model.SensorNetwork):
    ran = tolnet("diffusion", small, "--json")
    assert (ran.code, ran.err) == (0, "")
    document = ran.document
    found = design.optimise_diffusion(loaded, design.choose_tolerances(loaded))
    assert document["schema"] == "tolnet.diffusion/1"
    assert (document["status"], document["objective"], document["baseline_rule"]) == ("ok", "msd", "relative-degree")
    for key in DESIGNED:
        assert document[key] == getattr(found, key), key
    W = np.zeros((4, 4))
    for l, k, w in document["weights"]:
        W[l, k] = w
    np.testing.assert_array_equal(W, found.W.toarray())
    assert document["value_db"] == pytest.approx(10 * np.log10(document["value"]))
    assert (document["certificate"], document["gains"], document["links"]) == (None, None, [])
    assert [there["name"] for there in document["elsewhere"]] == ["nominal", "half of c", "twice c"]


def test_every_format_holds_the_same_weights(tolnet: Tolnet, small: Path, tmp_path: Path):
    paths = {suffix: tmp_path / f"w{suffix}" for suffix in (".csv", ".json", ".npz", ".toml", ".png")}
    outputs = [word for suffix in (".csv", ".json", ".npz", ".toml") for word in ("-o", paths[suffix])]
    ran = tolnet("diffusion", small, *outputs, "--plot", paths[".png"])
    assert ran.code == 0
    assert "gap closed" in ran.out
    lines = paths[".csv"].read_text().splitlines()
    rows = [line for line in lines if not line.startswith("#")]
    W = np.array([[float(x) for x in row.split(",")] for row in rows])
    assert W.shape == (4, 4)
    assert '# objective: "msd"' in lines
    document = json.loads(paths[".json"].read_text())
    assert all(W[l, k] == w for l, k, w in document["weights"])
    assert len(document["weights"]) == np.count_nonzero(W)
    with np.load(paths[".npz"], allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["W"], W)
        assert arrays["value"] == document["value"]
    np.testing.assert_array_equal(model.load(paths[".toml"]).diffusion.toarray(), W)  # pyright: ignore
    assert paths[".png"].stat().st_size > 5_000
    performed = tolnet("performance", paths[".toml"], "--filters", "RKFDNU2", "--json").document
    assert performed["filters"]["RKFDNU2"]["msd"] == pytest.approx(document["value"], rel=1e-12)


@pytest.mark.parametrize("objective", ["decay", "msd"])
def test_the_certificate_is_accepted_by_the_checker(objective: str, tolnet: Tolnet, process: Tolnet, tmp_path: Path):
    """Also for a network that its own weights make unstable."""
    proof, designed = tmp_path / "proof.json", tmp_path / "designed.toml"
    ran = tolnet(
        "diffusion", "unstable-path", "--objective", objective, "--certificate", proof, "-o", designed, "--json"
    )
    assert ran.code == 0
    assert ran.document["spectral_radius"] < 1
    claims = {claim["claim"]: claim["verdict"] for claim in json.loads(proof.read_text())["claims"]}
    wanted = {"schur-stability": "proved"} | ({"decay-rate": "proved"} if objective == "decay" else {})
    assert claims == wanted
    checked = process("check", proof, "--json")
    assert checked.code == 0
    broken = proof.read_text().replace('"0x1.', '"0x1.8', 1)
    proof.write_text(broken)
    assert process("check", proof).code != 0
    assert set(ran.document["blocks"]) == {"network", "least_favourable"}
    assert max(ran.document["blocks"].values()) == ran.document["spectral_radius"]
    if objective == "decay":
        assert (ran.document["bound"], ran.document["gap_closed"]) == (None, None)
        certificate = ran.document["certificate"]
        assert np.array(certificate["X"]).shape[0] == len(ran.document["node_msd"])
        assert certificate["rate"] == ran.document["value"] < 1


def test_a_rate_without_a_bound_is_told_without_a_gap_and_with_its_block(tolnet: Tolnet):
    ran = tolnet("diffusion", "unstable-path", "--objective", "decay")
    assert "gap closed" not in ran.out
    assert not any(line.split()[:1] == ["bound"] for line in ran.out.splitlines())
    assert "certified rate of the network block" in ran.out
    head = next(line for line in ran.out.splitlines() if "weights" in line and "decay" in line)
    assert "radius: network" in head
    assert "least favourable" in head


def test_rules_and_objectives_side_by_side_and_links(tolnet: Tolnet, small: Path, tmp_path: Path):
    written = tmp_path / "all.json"
    ran = tolnet("diffusion", small, "--compare", "--add-links", "2", "-o", written)
    assert ran.code == 0
    document = json.loads(written.read_text())
    rows = {row["weights"]: row for row in document["compare"]}
    assert {"none", "metropolis", "optimised: msd", "optimised: decay", "optimised: mixing"} <= set(rows)
    assert rows["optimised: msd"]["msd"] == min(row["msd"] for row in rows.values())
    assert rows["optimised: mixing"]["mixing"] == min(row["mixing"] for row in rows.values())
    assert rows["optimised: worst"]["worst"] <= rows["optimised: msd"]["worst"]
    assert rows["relative-degree"]["gap_closed"] == 0
    links = document["links"]
    assert len(links) == 2
    assert links[1]["value"] < links[0]["value"] < document["value"]
    assert "optimised: worst" in ran.out
    assert f"{links[0]['from']}-{links[0]['to']}" in ran.out


def test_the_gain_table_is_what_certify_reads(
    tolnet: Tolnet, small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("tolnet.design.weights.search._STEPS_WITH_GAINS", 20)
    monkeypatch.setattr("tolnet.design.weights.search._RANDOM_WITH_GAINS", 0)
    table = tmp_path / "gains.npz"
    ran = tolnet("diffusion", small, "--with-gains", "--gain-table", table, "-o", tmp_path / "g.npz", "--json")
    assert ran.code == 0
    gains = ran.document["gains"]
    assert [len(node["neighbours"]) for node in gains] == [2, 3, 3, 2]
    assert np.array(gains[1]["gain"]).shape == (2, 3)
    with np.load(tmp_path / "g.npz", allow_pickle=False) as arrays:
        assert arrays["gains"].shape == (10, 2)
    certified = tolnet("certify", small, "--table", table, "--claims", "schur-stability,performance", "--json")
    claims = {claim["claim"]: claim for claim in certified.document["claims"]}
    assert claims["schur-stability"]["verdict"] == "proved"
    with np.load(table, allow_pickle=False) as arrays:
        W = np.zeros((4, 4))
        own = np.repeat(np.arange(4), np.diff(arrays["neighbour_offsets"]))
        W[arrays["neighbours"], own] = arrays["weights"]
    assert all(W[l, k] == w for l, k, w in ran.document["weights"])


def test_scenarios_and_constraints(tolnet: Tolnet, small: Path):
    plain = tolnet("diffusion", small, "--json").document
    robust = tolnet(
        "diffusion", small, "--objective", "robust", "--scenario-tolerance", "0.05", "--without-link", "1-2", "--json"
    ).document
    assert robust["value"] > plain["value"]
    few = tolnet("diffusion", small, "--max-neighbours", "2", "--own-weight", "0.2", "--json").document
    assert few["constraints"] == {"own_weight": "at least 0.2", "max_neighbours": "2"}
    assert len(few["weights"]) <= 8
    one = tolnet("diffusion", small, "--nodes", "3", "--json").document
    assert one["value"] == pytest.approx(one["node_msd"][3])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--max-neighbours", "0"], "--max-neighbours is 0; at least 1 was expected"),
        (["--own-weight", "1.5"], "--own-weight is 1.5 at node 0"),
        (["--nodes", "9"], "--nodes names '9', which is no node"),
        (["--objective", "best"], "--objective"),
        (["--without-link", "0-1"], "--without-link is given; the objective 'msd' has one scenario"),
        (["--objective", "robust", "--without-link", "0-3"], "there is no such link"),
        (["--add-links", "9"], "the graph lacks 3 links"),
        (["-o", "w.txt"], "w.txt: has the suffix '.txt'"),
        (["--certificate", "c.csv"], "c.csv: has the suffix '.csv'"),
        (["--with-gains", "--objective", "mixing"], "--with-gains cannot be combined with the objective 'mixing'"),
        (["--with-gains", "--symmetric"], "--with-gains cannot be combined with symmetric weights"),
        (["--method", "sdp"], "--method is 'sdp', which cannot be had for the objective 'msd'"),
        (["--own-weight", "-1"], "--own-weight is -1 at node 0: no lower bound on a weight; 0 to 1 was expected"),
        (["--max-neighbours", "2", "--objective", "decay"], "--max-neighbours cannot be combined with the objective"),
        (["--add-links", "1", "--with-gains"], "--add-links ranks links by what weights without constraints make"),
        (
            ["--add-links", "1", "--own-weight", "0.2"],
            "combined with --with-gains, --nodes, --symmetric",
        ),
        (["--add-links", "0"], "--add-links is 0; the graph lacks 3 links"),
    ],
)
def test_bad_options_are_refused(options: list[str], said: str, tolnet: Tolnet, small: Path, tmp_path: Path):
    os.chdir(tmp_path)
    ran = tolnet("diffusion", small, *options)
    assert (ran.code, ran.out) == (2, "")
    assert said in ran.err


def test_a_network_without_links_is_drawn(tolnet: Tolnet, tmp_path: Path):
    path, picture = tmp_path / "one.toml", tmp_path / "w.png"
    network = model.SensorNetwork(A=[[1.2]], Q=[[1.0]], C=[[[1.0]]], R=[[[1.0]]], ambiguity=model.Ambiguity(0.01))
    model.save(network, path)
    ran = tolnet("diffusion", path, "--plot", picture)
    assert (ran.code, picture.exists()) == (0, True)


def test_the_next_command_designs_the_same(tolnet: Tolnet, small: Path, tmp_path: Path):
    options = ["--symmetric", "--own-weight", "0.2", "--tolerance", "0.03"]
    ran = tolnet("diffusion", small, *options)
    command = next(line for line in ran.out.splitlines() if "-o designed.toml" in line)
    for option in ("--symmetric", "--own-weight 0.2", "--tolerance 0.03"):
        assert option in command
    ran = tolnet("diffusion", small, "--objective", "robust", "--without-link", "0-1", "--without-link", "1-2")
    command = next(line for line in ran.out.splitlines() if "-o designed.toml" in line)
    assert "--without-link 0-1 --without-link 1-2" in command


def test_a_graph_in_pieces_cannot_mix_and_a_blind_node_has_no_answer(tolnet: Tolnet, blind: Path):
    ran = tolnet("diffusion", blind, "--objective", "mixing")
    assert ran.code == 2
    assert "not connected: nodes gate and hill do not hear each other" in ran.err
    ran = tolnet("diffusion", blind, "--json")
    assert ran.code == 4
    assert (ran.document["status"], ran.document["value"]) == ("undetectable", None)
    assert "no answer: undetectable" in ran.err


def test_an_interrupt_keeps_the_best_weights_and_exits_0(tmp_path: Path):
    problem, csv = tmp_path / "many.toml", tmp_path / "w.csv"
    model.save(model.example("random", 60, 1), problem)
    program = (
        "import sys\nfrom tolnet.design.weights import search\nfrom tolnet.cli import main\n"
        "before = search.minimise\n"
        "def told(*a, **k):\n    print('searching', file=sys.stderr, flush=True)\n    return before(*a, **k)\n"
        "search.minimise = told\nsys.exit(main(sys.argv[1:]))\n"
    )
    command = [sys.executable, "-c", program, "diffusion", str(problem), "-o", str(csv)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == "searching\n"
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=300)
    assert process.returncode == 0
    assert "interrupted: these are the best weights so far" in err
    assert "Traceback" not in err
    assert "optimised" in out
    rows = [line for line in csv.read_text().splitlines() if not line.startswith("#")]
    assert len(rows) == 60
