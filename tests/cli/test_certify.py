"""`tolnet certify` and `tolnet check`: what is proved, refuted, compared; and every kind of bad input."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.conftest import Tolnet

import tolnet.certificates
from tolnet import design, model

CHECKER = Path(tolnet.certificates.__file__).with_name("check.py")
UNSTABLE = ("unstable-path", "unstable-ring", "unstable-metropolis")


def stand_alone(path: Path) -> subprocess.CompletedProcess[str]:
    """check.py as a plain file with nothing beside it, without site packages."""
    alone = Path(shutil.copy(CHECKER, path.with_name("alone.py")))
    return subprocess.run(
        [sys.executable, "-I", "-S", str(alone), str(path)], capture_output=True, text=True, check=False
    )


def verdicts(document: dict[str, Any]) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for claim in document["claims"]:
        found.setdefault(claim["claim"], set()).add(claim["verdict"])
    return found


@pytest.fixture
def certificate(tolnet: Tolnet, small: Path, tmp_path: Path) -> Path:
    path = tmp_path / "certificate.json"
    assert tolnet("certify", small, "-o", path).code == 0
    return path


SLOW = """schema = "tolnet.problem/1"
[plant]
A = [[0.999, 0.02, 0.0], [0.0, 0.9, 0.1], [0.0, 0.0, 0.5]]
B = [[1e-4, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.3]]
[network]
nodes = 2
edges = [[0, 1]]
[[sensors]]
C = [[0.01, 1.0, 0.3]]
R = [[0.04]]
[[sensors]]
C = [[0.0, 0.2, 1.0]]
R = [[1.0]]
[ambiguity]
tolerance = 1e-8
"""


def test_what_is_proved_of_slow_filters_is_checked(tolnet: Tolnet, tmp_path: Path):
    """By a bracket, whose keys other proofs of convergence do not have."""
    problem, path = tmp_path / "slow.toml", tmp_path / "slow.json"
    problem.write_text(SLOW)
    assert tolnet("certify", problem, "-o", path).code == 0
    assert any("blocks" in claim["proof"] for claim in json.loads(path.read_text())["claims"])
    assert tolnet("check", path, "--problem", problem).code == 0


def change(path: Path, **changes: Any) -> Path:
    document = json.loads(path.read_text()) | changes
    path.write_text(json.dumps(document))
    return path


HARDLY_DRIVEN = """schema = "tolnet.problem/1"
[plant]
A = [
    [0.14341763334473295, -0.22330091900258917, -0.21382626914323358, 0.27676812651786],
    [-0.04949229251784883, -0.33447107199750337, -0.29713301329150127, 0.15995227625930147],
    [0.1106615383825485, 0.08633866275745199, -0.5399195698275043, -0.005445440969385936],
    [-0.06990626958703698, -0.06297889293117823, 0.2639325130767843, -0.17614490364458307],
]
B = [
    [-0.05511885483795887, 0.8612115810456307, 0.24828481121740134, -0.09964429992500763],
    [-0.02846475516527937, 0.4447511994155208, 0.12822048617704643, -0.0514588086043605],
    [0.006105799782170252, -0.09540084725495812, -0.02750378870396461, 0.011038112857758239],
    [0.04694201817656774, -0.7334515540783126, -0.21145196452761875, 0.08486215033338194],
]
[network]
nodes = 1
edges = []
[[sensors]]
C = [[-0.16226859621481027, -0.6420645377937738, 0.4769803584185425, 1.195782089087315]]
R = [[0.14839708994977419]]
[ambiguity]
tolerance = 1.4032226786645505
"""


def test_a_tilt_is_compared_where_it_moves_something(tolnet: Tolnet, tmp_path: Path):
    """The noise hardly drives some directions: there T has six digits, and nothing rests on the rest."""
    problem, path = tmp_path / "p.toml", tmp_path / "c.json"
    problem.write_text(HARDLY_DRIVEN)
    assert tolnet("certify", problem, "-o", path).code == 0
    assert tolnet("check", path, "--problem", problem).code == 0
    document = json.loads(path.read_text())
    centre = document["data"]["centre"]
    centre["tilt"] = " ".join((float.fromhex(entry) * (1 + 1e-8)).hex() for entry in centre["tilt"].split())
    altered = tolnet("check", change(path, data=document["data"]), "--problem", problem)
    assert altered.code == 1
    assert "differs in its tilt" in altered.err


@pytest.mark.parametrize("c", [0.02, 0.06])
def test_the_published_examples_are_fully_proved(tolnet: Tolnet, tmp_path: Path, c: float):
    path = tmp_path / "c.json"
    ran = tolnet("certify", "projectile", "--tolerance", c, "-o", path)
    assert ran.code == 0
    assert "published block-contraction bound" in ran.out
    assert "does not cover" in ran.out
    document = json.loads(path.read_text())
    assert verdicts(document) == {
        claim: {"proved"}
        for claim in ("schur-stability", "steady-state", "attraction", "tolerance", "convergence", "performance")
    }
    for claim in document["claims"]:
        if claim["claim"] == "tolerance":
            low, high = map(float.fromhex, claim["interval"].split(" "))
            assert (high - low) / 2 <= 1e-10 * c
    checked = tolnet("check", path, "--json")
    assert checked.code == 0
    assert {finding["result"] for finding in checked.document["findings"]} == {"valid"}
    alone = stand_alone(path)
    assert alone.returncode == 3
    said = [line.partition(":")[0] for line in alone.stdout.splitlines()]
    assert "invalid" not in said
    assert said.count("not checked here") == 21 * 3 + 20
    assert f"{21 * 3 + 20} need tolnet check: it needs a logarithm" in alone.stdout


@pytest.mark.parametrize("name", UNSTABLE)
def test_counter_examples_are_refuted_and_mended(tolnet: Tolnet, tmp_path: Path, name: str):
    path, mended = tmp_path / "c.json", tmp_path / "mended.toml"
    ran = tolnet("certify", name, "--claims", "schur-stability", "-o", path, "--stable-weights", mended)
    assert ran.code == 1
    assert "these nodes carry it" in ran.out
    assert tolnet("check", path).code == 0  # the refutation is valid
    assert stand_alone(path).returncode == 0
    assert tolnet("certify", mended, "--claims", "schur-stability").code == 0
    proposed, repaired = model.example(name), model.load(mended)
    assert isinstance(proposed, model.SensorNetwork)
    W, w = (design.diffusion_matrix(network).toarray() for network in (repaired, proposed))
    assert 0 < np.linalg.norm(W - w) < np.linalg.norm(np.eye(len(w)) - w)
    assert tolnet("certify", name, "--diffusion", "none", "--claims", "schur-stability").code == 0


def test_a_certificate_speaks_of_one_deployment(tolnet: Tolnet, small: Path, certificate: Path, tmp_path: Path):
    table, other = tmp_path / "t.npz", tmp_path / "other.toml"
    full = tmp_path / "t.json"
    assert tolnet("table", small, "-o", table, "-o", full, "--full").code == 0
    for against in ([], ["--table", table], ["--table", full]):
        ran = tolnet("check", certificate, "--problem", small, *against)
        assert (ran.code, "differs" in ran.out) == (0, False)
    network = model.load(small)
    changed = model.SensorNetwork(
        A=network.A, B=network.B, C=network.C, rows=network.rows, R=network.R * np.nextafter(1, 2),
        edges=network.links, name="small", ambiguity=network.ambiguity,
    )  # fmt: skip
    model.save(changed, other)
    ran = tolnet("check", certificate, "--problem", other)
    assert ran.code == 1
    assert "noise[0]" in ran.err
    assert tolnet("table", small, "--tolerance", 0.03, "-o", table).code == 0
    ran = tolnet("check", certificate, "--problem", small, "--table", table)
    assert ran.code == 1
    assert "gains" in ran.err
    assert "claims[1].c" in ran.err
    ran = tolnet("check", certificate, "--problem", small, "--diffusion", "uniform")
    assert (ran.code, "weights" in ran.err) == (1, True)


def suggested(ran: Any) -> list[list[str]]:
    """The commands after "next:", as words."""
    lines = ran.out.partition("next:\n")[2].splitlines()
    return [shlex.split(line)[1:] for line in lines if line.startswith("  tolnet ")]


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--tolerance", "0.05"],
        ["--tolerance", "0"],
        ["--tolerance", "0.01", "--convention", "nats"],
        ["--diffusion", "uniform"],
        ["--precision", "float32"],
        ["--claims", "performance"],
        ["--claims", "switching", "--drop-links", "1"],
    ],
)
def test_the_next_command_succeeds(tolnet: Tolnet, small: Path, tmp_path: Path, options: list[str]):
    path = tmp_path / "c.json"
    without = suggested(tolnet("certify", small, *options))[0]
    assert without[:2] == ["certify", str(small)]
    ran = tolnet(*without[:-1], path)
    assert ran.code == 0
    assert verdicts(json.loads(path.read_text())) == verdicts(tolnet("certify", small, *options, "--json").document)
    for command in suggested(ran)[:1]:
        assert command[0] == "check"
        assert tolnet(*command).code == 0, command


def test_the_next_command_of_a_refuted_network_mends_it(tolnet: Tolnet, tmp_path: Path):
    mended = tmp_path / "mended.toml"
    ran = tolnet("certify", "unstable-path")
    command = suggested(ran)[1]
    assert command[-2:] == ["--stable-weights", "mended.toml"]
    ran = tolnet(*command[:-1], mended)
    assert "writes the problem with them" not in ran.out
    margin = float(re.findall(r"with a margin of ([0-9.e-]+):", ran.out)[0])
    again = tolnet(*suggested(ran)[1], "--json")
    assert again.code == 0
    stability = next(claim for claim in again.document["claims"] if claim["claim"] == "schur-stability")
    assert stability["margin"] == pytest.approx(margin, rel=0.02)


def test_stable_weights_that_nobody_needs_are_named(tolnet: Tolnet, small: Path, tmp_path: Path):
    mended = tmp_path / "mended.csv"
    ran = tolnet("certify", small, "--claims", "schur-stability", "--stable-weights", mended)
    assert ran.code == 0
    assert "mended.csv is not written" in ran.out + ran.err
    assert not mended.exists()


def test_a_model_that_was_not_compared_is_not_said_to_be(tolnet: Tolnet, small: Path, tmp_path: Path):
    """Performance at another tolerance: nothing in the certificate ties its model to the problem."""
    path = tmp_path / "c.json"
    assert tolnet("certify", small, "-c", "0.0001", "--claims", "performance", "-o", path).code == 0
    for own, label in (([], "not checked here"), (["-c", "0.0001"], "valid")):
        ran = tolnet("check", path, "--problem", small, *own, "--json")
        assert ran.code == 3
        found = {row["claim"]: row["result"] for row in ran.document["findings"]}
        assert found["least favourable model"] == "not checked here"
        assert found["label"] == label
    assert "claims" not in found


def test_the_tolerance_of_a_certificate_is_compared(tolnet: Tolnet, small: Path, tmp_path: Path):
    path = tmp_path / "c.json"
    assert tolnet("certify", small, "-c", "0.05", "-o", path).code == 0
    assert tolnet("check", path, "--problem", small, "-c", "0.05").code == 0
    for other in (["-c", "0.06"], []):
        ran = tolnet("check", path, "--problem", small, *other)
        assert (ran.code, "claims[1].c" in ran.err) == (1, True)
    ran = tolnet("check", path, "-c", "0.05")
    assert (ran.code, "--problem" in ran.err) == (2, True)
    table = tmp_path / "t.npz"
    assert tolnet("table", small, "-o", table).code == 0
    ran = tolnet("check", path, "--problem", small, "--table", table, "-c", "0.05")
    assert (ran.code, "--tolerance" in ran.err) == (2, True)


def test_gains_of_a_problem_alone_are_not_compared(tolnet: Tolnet, small: Path, tmp_path: Path):
    path = tmp_path / "c.json"
    assert tolnet("certify", small, "--claims", "schur-stability", "-o", path).code == 0
    ran = tolnet("check", path, "--problem", small)
    assert (ran.code, "--table FILE" in ran.out) == (3, True)


def test_single_precision_is_what_is_certified(tolnet: Tolnet, small: Path, tmp_path: Path):
    path, table = tmp_path / "c.json", tmp_path / "t.npz"
    assert tolnet("table", small, "-o", table).code == 0
    ran = tolnet("certify", small, "--table", table, "--precision", "float32", "-o", path)
    assert ran.code == 0
    data = json.loads(path.read_text())["data"]
    for text in [*data["gains"], *data["weights"]]:
        values = [float.fromhex(word) for word in text.split(" ")]
        assert values == [float(np.float32(value)) for value in values]
    options = ["--problem", small, "--table", table]
    assert tolnet("check", path, *options, "--precision", "float32").code == 0
    assert tolnet("check", path, *options).code == 1


def test_links_that_drop_and_scenarios(tolnet: Tolnet, small: Path, tmp_path: Path):
    path, file = tmp_path / "c.json", tmp_path / "s.json"
    table = tmp_path / "t.npz"
    assert tolnet("table", small, "--tolerance", 0.01, "-o", table).code == 0
    W = np.eye(4).tolist()
    file.write_text(
        json.dumps({"scenarios": [{"drop": [[0, 1]]}, {"weights": W}, {"triples": [[k, k, 1.0] for k in range(4)]},
                                  {"table": "t.npz"}, {"drop": [[2, 1], [2, 3]]}]})
    )  # fmt: skip
    ran = tolnet("certify", small, "--claims", "schur-stability", "--scenarios", file, "--drop-links", 2, "-o", path)
    assert ran.code == 0
    document = json.loads(path.read_text())
    assert [claim["claim"] for claim in document["claims"]] == ["schur-stability", "switching", "switching"]
    assert tolnet("check", path).code == 0


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("", "is no JSON"),
        ("{}", "scenarios"),
        ('{"scenarios": []}', "scenarios"),
        ('{"scenarios": [{}]}', "scenarios[0]"),
        ('{"scenarios": [{"drop": [[0, 3]]}]}', "scenarios[0].drop[0]"),
        ('{"scenarios": [{"drop": [[0, 0]]}]}', "scenarios[0].drop[0]"),
        ('{"scenarios": [{"drop": 3}]}', "scenarios[0].drop[0]"),
        ('{"scenarios": [{"weights": [[1]]}]}', "scenarios[0].weights"),
        ('{"scenarios": [{"triples": [[0, 9, 1]]}]}', "scenarios[0].triples"),
        ('{"scenarios": [{"weights": "x"}]}', "scenarios[0].weights"),
        ('{"scenarios": [{"table": "none.npz"}]}', "none.npz"),
        ('{"scenarios": [{"table": 3}]}', "scenarios[0].table"),
        ('{"scenarios": [{"dropp": []}]}', "scenarios[0]"),
        ('{"scenarios": [{"drop": [[0, 1]], "table": "t.npz"}]}', "scenarios[0]"),
    ],
)
def test_bad_scenarios_are_named(tolnet: Tolnet, small: Path, tmp_path: Path, text: str, where: str):
    file = tmp_path / "s.json"
    file.write_text(text)
    ran = tolnet("certify", small, "--claims", "schur-stability", "--scenarios", file)
    assert (ran.code, where in ran.err) == (2, True)


@pytest.mark.parametrize(
    ("options", "where"),
    [
        (["--claims", "stability"], "did you mean"),
        (["--claims", "switching"], "--scenarios"),
        (["--rate", "0"], "--rate"),
        (["--rate", "nan"], "--rate"),
        (["-o", "c.csv"], ".json"),
        (["--stable-weights", "w.npz"], ".csv"),
        (["--table", "missing.npz"], "missing.npz"),
        (["--diffusion", "unifrom"], "did you mean"),
    ],
)
def test_bad_options_are_refused(tolnet: Tolnet, small: Path, options: list[str], where: str):
    ran = tolnet("certify", small, *options)
    assert (ran.code, where in ran.err) == (2, True)


def test_a_rate_below_the_truth_is_undecided_and_never_refuted(tolnet: Tolnet, small: Path):
    ran = tolnet("certify", small, "--claims", "decay-rate", "--rate", 0.1, "--json")
    assert ran.code == 3
    assert verdicts(ran.document) == {"decay-rate": {"undecided"}}
    assert tolnet("certify", small, "--claims", "decay-rate", "--rate", 0.999).code == 0


def test_a_filter_that_oscillates_is_refuted_with_a_witness(tolnet: Tolnet, tmp_path: Path):
    rng = np.random.default_rng(5)
    path, written = tmp_path / "p.toml", tmp_path / "c.json"
    network = model.SensorNetwork(
        A=[[0.95, 0.2], [0.0, 0.9]], Q=0.01 * np.eye(2), C=rng.standard_normal((3, 1, 2)), R=np.ones((3, 1, 1)),
        edges=[[0, 1], [1, 2]], name="restless", ambiguity=model.Ambiguity(20.0),
    )  # fmt: skip
    model.save(network, path)
    assert tolnet("table", path).code == 4
    ran = tolnet("certify", path, "--claims", "attraction", "-o", written)
    assert ran.code == 1
    assert "refuted" in verdicts(json.loads(written.read_text()))["attraction"]
    assert tolnet("check", written).code in (0, 3)
    assert "invalid" not in tolnet("check", written).out.lower()


def test_a_network_without_filters_has_nothing_to_certify(tolnet: Tolnet, blind: Path):
    ran = tolnet("certify", blind)
    assert (ran.code, "hill" in ran.err) == (4, True)


def test_a_table_of_another_graph_is_refused(tolnet: Tolnet, small: Path, ring: Path, tmp_path: Path):
    table, short = tmp_path / "t.npz", tmp_path / "t.json"
    assert tolnet("table", ring, "-o", table, "-o", short).code == 0
    ran = tolnet("certify", small, "--table", table)
    assert (ran.code, "t.npz" in ran.err) == (2, True)
    ran = tolnet("certify", ring, "--table", short)
    assert (ran.code, "--full" in ran.err) == (2, True)
    ran = tolnet("certify", small, "--table", table, "--tolerance", 0.1)
    assert ran.code == 2


def test_what_is_no_certificate_is_refused(tolnet: Tolnet, certificate: Path, tmp_path: Path, small: Path):
    for content in ("", "[]", "{}", '{"schema": "tolnet.table/1"}', "[" * 100_000):
        path = tmp_path / "bad.json"
        path.write_text(content)
        ran = tolnet("check", path)
        assert (ran.code, "bad.json" in ran.err) == (2, True)
    assert tolnet("check", tmp_path / "missing.json").code == 2
    assert tolnet("check", certificate, "--table", tmp_path / "t.npz").code == 2
    change(certificate, claims=[])
    assert tolnet("check", certificate).code == 2


@pytest.mark.parametrize("claim", ["steady-state", "attraction", "tolerance", "convergence"])
def test_altered_claims_on_filters_are_invalid(tolnet: Tolnet, certificate: Path, claim: str):
    document = json.loads(certificate.read_text())
    entry = next(entry for entry in document["claims"] if entry["claim"] == claim and entry["node"] != "centre")
    entry["c"] = (2 * float.fromhex(entry["c"])).hex()
    certificate.write_text(json.dumps(document))
    ran = tolnet("check", certificate)
    assert (ran.code, claim in ran.err) == (1, True)


def test_another_node_is_not_the_same_claim(tolnet: Tolnet, certificate: Path):
    document = json.loads(certificate.read_text())
    entry = next(e for e in document["claims"] if e["claim"] == "steady-state" and e["node"] == 0)
    for node in (1, 7, -1, "0", None, True, 0.0):
        entry["node"] = node
        entry["statement"] = entry["statement"].replace("node 0", f"node {node}")
        certificate.write_text(json.dumps(document))
        assert tolnet("check", certificate).code == 1


def test_convergence_from_every_start_at_small_tolerances(tolnet: Tolnet, small: Path, tmp_path: Path):
    path = tmp_path / "c.json"
    ran = tolnet("certify", small, "--tolerance", 1e-4, "--claims", "convergence-all", "-o", path)
    assert ran.code == 0
    assert "largest tolerance" in ran.out
    assert tolnet("check", path).code == 0


def test_the_json_document_is_the_certificate(tolnet: Tolnet, small: Path, tmp_path: Path):
    path = tmp_path / "c.json"
    ran = tolnet("certify", small, "--claims", "schur-stability,performance", "--json", "-o", path)
    assert ran.document == json.loads(path.read_text())
    assert ran.document["schema"] == "tolnet.certificate/1"
    assert ran.document["problem"]["sha256"] == model.load(small).digest


def test_a_table_for_a_problem_without_a_tolerance_is_checked_at_the_one_that_is_meant(
    tolnet: Tolnet, small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    silent, text = Path("silent.toml"), small.read_text()
    start = text.index("[ambiguity]")
    end = text.find("\n[", start + 1)
    silent.write_text(text[:start] + (text[end:] if end > 0 else ""))
    path, table = Path("c.json"), Path("t.npz")
    assert tolnet("table", silent, "-c", "0.01", "-o", table).code == 0
    ran = tolnet("certify", silent, "--table", table, "--claims", "steady-state,tolerance", "-o", path)
    assert ran.code == 0
    command = suggested(ran)[0]
    assert tolnet(*command).code == 0, command
    ran = tolnet("check", path, "--problem", silent, "--table", table)
    assert (ran.code, "the problem has no tolerance" in ran.err) == (1, True)
