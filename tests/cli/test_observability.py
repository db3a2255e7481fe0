"""`tolnet observability`: the verdict, its document, its files, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import Tolnet
from tests.model.test_corrupted_files import BAD, GOOD

from tolnet import model
from tolnet.model import CorruptedNetwork


@pytest.fixture
def two(tmp_path: Path) -> Path:
    """The file of the contract."""
    path = tmp_path / "two.toml"
    path.write_text(GOOD)
    return path


@pytest.fixture
def lost(tmp_path: Path) -> Path:
    """An unstable mode that only a fading sensor sees."""
    path = tmp_path / "lost.toml"
    network = CorruptedNetwork(
        A=[[1.1, 0.0], [0.0, 0.5]],
        Q=np.eye(2),
        C=[[[1.0, 0.0]], [[0.0, 1.0]]],
        R=[[[1.0]], [[1.0]]],
        fading_mean=[0.9, 1.0],
        fading_variance=[0.01, 0.0],
        edges=[[0, 1]],
        states=["heat", "drift"],
        name="lost",
    )
    model.save(network, path)
    return path


def test_people_and_programs_are_told_the_same(two: Path, tolnet: Tolnet):
    ran = tolnet("observability", two)
    assert ran.code == 0
    document = tolnet("observability", two, "--json").document
    assert document["schema"] == "tolnet.observability/1"
    assert document["problem"]["sha256"] == model.load_corrupted(two).digest
    assert (document["status"], document["form"], document["holds"]) == ("ok", "sharp", True)
    assert document["alpha"] > 0
    assert document["alpha_by_window"][document["window"] - 1] == document["alpha"]
    assert {each["state"] for each in document["weakest_direction"]} <= {"x1", "x2"}
    assert len(document["alpha_without_node"]) == 2
    assert list(document["forms"]) == ["sharp", "stated", "classical"]
    assert document["error_bound"]["bound"] > document["error_bound"]["computed"]
    assert f"alpha = {document['alpha']:.6g}" in ran.out
    assert f"mean tr P = {document['steady_state']['worst']['mean_trace']:.6g}" in ran.out
    assert "tolnet observability" in ran.out.partition("next:")[2]


def test_a_form_a_window_and_a_horizon_can_be_asked_for(two: Path, tolnet: Tolnet):
    options = ("--form", "classical", "--window", 3, "--horizon", 10)
    document = tolnet("observability", two, *options, "--json").document
    assert (document["form"], document["window"], document["horizon"]) == ("classical", 3, 10)
    assert len(document["alpha_over_time"]) == 9  # 0..10 are 11 instants
    assert document["alpha_limit"] is None


def test_what_fails_in_the_long_run_is_explained(lost: Path, tolnet: Tolnet):
    ran = tolnet("observability", lost)
    assert ran.code == 4
    text = " ".join(ran.out.split())
    assert "every k: does not hold" in text
    assert "+1 heat does not decay and is seen only by fading sensors (node 0)" in text
    assert "k = 0..100: holds" in text
    assert "no answer: undetectable: the mode along +1 heat" in ran.err
    document = tolnet("observability", lost, "--json").document
    assert (document["holds"], document["alpha"]) == (False, 0.0)
    assert document["lost_modes"][0]["nodes"] == [0]
    assert document["over_horizon"]["holds"]
    assert document["steady_state"]["worst"]["status"] == "undetectable"
    assert document["steady_state"]["worst"]["mean_trace"] is None


def test_every_file(two: Path, tolnet: Tolnet, tmp_path: Path):
    files = [tmp_path / f"o.{suffix}" for suffix in ("json", "csv", "npz", "md")]
    outputs = [word for file in files for word in ("-o", file)]
    sweep = ("--sweep", "matrix_noise=x0:2:3", "--sweep", "fading_mean=0.5:1:2")
    ran = tolnet("observability", two, *outputs, "--plot", tmp_path / "o.png", *sweep, "--full", "--quiet")
    assert (ran.code, ran.out) == (0, "")
    assert "warning: --sweep fading_mean" in tolnet("observability", two, *sweep).err
    document = json.loads(files[0].read_text())
    assert [each["parameter"] for each in document["sweeps"]] == ["matrix_noise", "fading_mean"]
    traces = document["sweeps"][0]["mean_trace"]
    assert traces == sorted(traces)
    assert traces[1] == document["steady_state"]["worst"]["mean_trace"]
    assert np.shape(document["steady_state"]["best"]["K"]) == (1, 3, 2)
    lines = files[1].read_text().splitlines()
    assert sum(not line.startswith("#") for line in lines) == 3
    assert "alpha_without_node" in files[3].read_text()
    with np.load(files[2]) as archive:
        network = model.load_corrupted(two)
        P, weights = archive["steady_state_best_P"], archive["steady_state_best_weights"]
        assert archive["steady_state_best_K"].shape == (1, 3, 2)
        assert archive["rows"].tolist() == network.rows.tolist()
        assert P.tolist() == document["steady_state"]["best"]["P"]
        np.testing.assert_allclose(weights[0, :2].sum(axis=0), np.eye(2), atol=1e-12)
        assert archive["sweep_matrix_noise_mean_trace"].tolist() == traces
    assert (tmp_path / "o.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["field", "projectile"])
def test_built_in_problems(name: str, tolnet: Tolnet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    ran = tolnet("observability", name, "--json")
    assert ran.code == 0
    assert ran.document["problem"]["name"] == name
    assert ran.document["forms"]["classical"]["holds"]


@pytest.mark.parametrize("command", ["observability", "validate"])
@pytest.mark.parametrize("fault", ["rows", "tau", "phi", "mu", "A", "Q", "D", "window", "input"])
def test_a_wrong_file_is_refused_with_its_key_path(fault: str, command: str, tolnet: Tolnet, tmp_path: Path):
    right, wrong, key = BAD[fault]
    path = tmp_path / "wrong.toml"
    path.write_text(GOOD.replace(right, wrong, 1))
    ran = tolnet(command, path)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err.splitlines() == [ran.err.strip()]
    assert ran.err.startswith(f"error: {path}: {key}")


def test_a_graph_that_is_not_strongly_connected(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "apart.toml"
    text = GOOD.replace("edges = [[0, 1]]", "edges = [[0, 1]]\ndirected = true").replace("weights", "# weights")
    path.write_text(text)
    ran = tolnet("observability", path)
    assert ran.code == 2
    assert (
        "network.edges does not connect the nodes strongly: nothing that node 1 sends ever reaches node 0" in ran.err
    )


def test_a_loose_bound_is_a_warning(two: Path, tolnet: Tolnet):
    two.write_text(GOOD.replace("fading_variance = 0.003", "fading_variance = 0.3"))
    ran = tolnet("validate", two)
    assert ran.code == 0
    assert f"warning: {two}: sensors[0].fading_variance is 0.3" in ran.err
    assert "0.09" in ran.out


def test_commands_for_exact_channels_say_what_they_leave_out(two: Path, tolnet: Tolnet):
    ran = tolnet("table", two, "--tolerance", 0.01)
    assert ran.code == 0
    assert "answers for exact channels" in ran.err
    refused = tolnet("table", "field", "--tolerance", 0.01)
    assert refused.code == 2
    assert "field: has corrupted channels" in refused.err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--sweep", "noise=0:1:3"], "--sweep names 'noise'; fading_mean"),
        (["--sweep", "matrix_noise=0:1"], "is not NAME=LO:HI:COUNT"),
        (["--sweep", "matrix_noise=0:1:0"], "has no values"),
        (["--sweep", "matrix_noise=-1:1:3"], "channel.matrix_noise is -1"),
        (["--sweep", "matrix_noise=x-1:1:3"], "a factor >= 0 was expected"),
        (["--window", "0"], "--window"),
        (["--window", "9", "--horizon", "3"], "1 to 4 was expected"),
        (["-o", "o.txt"], "has the suffix '.txt'"),
        (["--plot", "o.gif"], "has the suffix '.gif'"),
        (["--form", "best"], "--form"),
    ],
)
def test_refusals(arguments: list[str], said: str, two: Path, tolnet: Tolnet):
    ran = tolnet("observability", two, *arguments)
    assert (ran.code, ran.out) == (2, "")
    assert said in " ".join(ran.err.split())


def test_no_file_and_no_such_problem(tolnet: Tolnet):
    ran = tolnet("observability", "feild")
    assert ran.code == 2
    assert "did you mean 'field'" in ran.err
