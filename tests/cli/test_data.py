"""`tolnet table --data`: the tolerance comes from a record, is told with its interval, and bad records are named."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.conftest import Tolnet

from tolnet import model
from tolnet.analysis.data import Record, tolerance_from_data
from tolnet.design import choose_tolerances
from tolnet.model import Ambiguity


def network(**more: Any) -> model.SensorNetwork:
    """Two nodes, of which each sees one state."""
    return model.SensorNetwork(
        A=[[0.9, 0.1], [0.0, 0.8]], B=np.eye(2), C=[[[1.0, 0.0]], [[0.0, 1.0]]], R=[[[1.0]]] * 2, edges=[[0, 1]],
        name="two", **more,
    )  # fmt: skip


def record(steps: int = 150, spread: float = 1.3) -> dict[str, np.ndarray]:
    """What the plant does when its noise is `spread` times as large as the model says."""
    generator = np.random.default_rng(8)
    plant, x, y = network(), np.zeros((steps + 1, 2)), np.empty((steps, 2))
    for t in range(steps):
        y[t] = plant.C @ x[t] + generator.normal(size=2)
        x[t + 1] = plant.A @ x[t] + spread * generator.normal(size=2)
    return {"x": x, "y": y}


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    path = tmp_path / "two.toml"
    model.save(network(), path)
    return path


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    path = tmp_path / "recorded.npz"
    np.savez(path, **record())  # pyright: ignore[reportArgumentType]
    return path


def test_the_estimate_is_the_tolerance_and_documents_say_where_it_comes_from(
    tolnet: Tolnet, problem: Path, recorded: Path
):
    estimate = tolerance_from_data(network(), Record(**record()))
    assert estimate.tolerance > 0
    document = tolnet("table", problem, "--data", recorded, "--json").document
    assert document["data"] == {
        "file": "recorded.npz",
        "sha256": hashlib.sha256(recorded.read_bytes()).hexdigest(),
        "tolerance": estimate.tolerance,
        "interval": list(estimate.interval),
        "level": 0.95,
        "observed": estimate.observed,
        "bias": estimate.bias,
        "steps": 150,
        "resamples": estimate.resamples,
        "method": "divergence",
    }
    assert document["tolerance"] == estimate.tolerance
    table = choose_tolerances(network(), estimate.tolerance)
    assert [node["tolerance"] for node in document["nodes"]] == table.tolerances.tolist()


def test_a_person_reads_the_interval_and_the_bias(tolnet: Tolnet, problem: Path, recorded: Path):
    ran = tolnet("table", problem, "--data", recorded)
    estimate = tolerance_from_data(network(), Record(**record()))
    first, second = ran.out.splitlines()[:2]
    low, high = estimate.interval
    assert f"c = {estimate.tolerance:.6g} (gamma), 95% interval {low:.6g} to {high:.6g}" in first
    assert f"observed {estimate.observed:.6g}, of which {estimate.bias:.6g} is bias" in first
    assert second == f"two: 2 nodes, c = {estimate.tolerance:.6g} (gamma)"
    assert f"tolnet table {problem} --data {recorded} --limits" in ran.out
    assert f"tolnet performance {problem} --tolerance {estimate.tolerance}" in ran.out


def test_in_nats_everything_is_half(tolnet: Tolnet, problem: Path, recorded: Path):
    gamma = tolnet("table", problem, "--data", recorded, "--json").document["data"]
    nats = tolnet("table", problem, "--data", recorded, "--json", "--convention", "nats").document
    assert nats["convention"] == "nats"
    for key in ("tolerance", "observed", "bias"):
        assert nats["data"][key] == gamma[key] / 2
    assert nats["data"]["interval"] == [bound / 2 for bound in gamma["interval"]]
    assert nats["tolerance"] == nats["data"]["tolerance"]


def test_the_likelihood_is_offered_too(tolnet: Tolnet, problem: Path, recorded: Path):
    document = tolnet("table", problem, "--data", recorded, "--data-method", "likelihood", "--json").document
    expected = tolerance_from_data(network(), Record(**record()), method="likelihood")
    assert (document["tolerance"], document["data"]["method"]) == (expected.tolerance, "likelihood")


def test_every_format_says_what_was_estimated(tolnet: Tolnet, problem: Path, recorded: Path, tmp_path: Path):
    paths = [tmp_path / f"t{suffix}" for suffix in (".csv", ".md", ".npz", ".parquet")]
    ran = tolnet("table", problem, "--data", recorded, "--json", *(w for path in paths for w in ("-o", path)))
    digest = ran.document["data"]["sha256"]
    for path in paths[:2]:
        assert digest in path.read_text()
    with np.load(paths[2]) as arrays:
        assert arrays["data_sha256"] == digest
        assert arrays["data_interval"].tolist() == ran.document["data"]["interval"]
    import pyarrow.parquet

    metadata = json.loads(pyarrow.parquet.read_schema(paths[3]).metadata[b"tolnet"])
    assert metadata["data"] == ran.document["data"]


def test_data_that_fit_the_model_ask_for_the_plain_kalman_filter(tolnet: Tolnet, problem: Path, tmp_path: Path):
    np.savez(tmp_path / "nominal.npz", **record(40, spread=1.0))  # pyright: ignore[reportArgumentType]
    ran = tolnet("table", problem, "--data", tmp_path / "nominal.npz")
    assert ran.code == 0
    assert "c = 0 (gamma)" in ran.out
    assert "the data cannot be told from the nominal model" in ran.out


DAMAGES: dict[str, tuple[dict[str, Any], str]] = {
    "missing": ({"y": None}, "y is missing; the outputs y_0 to y_{T-1} of all nodes, one a row, were expected"),
    "unknown": ({"yy": np.ones(3)}, "yy is not expected; the arrays are x, y, u; did you mean 'y'?"),
    "texts": ({"x": np.array(["a"])}, "x is of type <U1; numbers were expected"),
    "truths": ({"u": np.array([True])}, "u is of type bool; numbers were expected"),
    "objects": ({"x": np.array([object()])}, "holds 'x' as pickled objects, which are never read"),
    "shape": ({"y": np.zeros((150, 3))}, "y has shape (150, 3); 150 x 2 was expected"),
    "no rows": ({"x": np.zeros(2)}, "x has shape (2,); T + 1 states of 2 numbers were expected"),
    "inputs": ({"u": np.zeros((3, 2))}, "u has shape (3, 2); 150 x 2 was expected"),
    "not finite": ({"x": np.full((151, 2), np.nan)}, "x has a value that is not finite"),
    "too large": ({"y": np.full((150, 2), 1e300)}, "y is so far from the model that its squares overflow"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_bad_record_is_refused_with_its_array(damage: str, tolnet: Tolnet, problem: Path, tmp_path: Path):
    change, said = DAMAGES[damage]
    arrays = {key: value for key, value in {**record(), **change}.items() if value is not None}
    path = tmp_path / "bad.npz"
    np.savez(path, **arrays)
    ran = tolnet("table", problem, "--data", path)
    assert (ran.code, ran.out) == (2, "")
    assert f"error: {path}: {said}" in ran.err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--data", "nowhere.npz"], "nowhere.npz: does not exist"),
        (["--data", "junk.npz"], "junk.npz: is no archive of arrays (.npz)"),
        (["--data", "recorded.npz", "-c", "0.1"], "--tolerance and --data are given; one of them was expected"),
        (["--data", "recorded.npz", "-o", "recorded.npz"], "it is an input of this command"),
        (["--data", "recorded.npz", "--tau", "0.5", "--uniform"], "for tau = 0 only (tau is 0.5)"),
        (["--data-method", "likelihood"], "--data-method is given without --data"),
        (["--data", "recorded.npz", "--data-method", "guess"], "--data-method"),
    ],
)
def test_bad_options_are_refused(
    options: list[str], said: str, tolnet: Tolnet, problem: Path, recorded: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(recorded.parent)
    Path("junk.npz").write_bytes(b"junk")
    ran = tolnet("table", problem, *options)
    assert (ran.code, ran.out) == (2, "")
    assert said in ran.err


def test_a_plant_whose_divergence_is_infinite_is_refused(tolnet: Tolnet, problem: Path, recorded: Path):
    text = problem.read_text()
    problem.write_text(text.replace("B = ", "Q = ").replace("[0.0, 1.0]", "[0.0, 0.0]", 1))
    ran = tolnet("table", problem, "--data", recorded)
    assert ran.code == 2
    assert "plant.Q is singular" in ran.err


def test_a_problem_of_another_family_takes_data_only_for_tau_zero(tolnet: Tolnet, problem: Path, recorded: Path):
    model.save(network(ambiguity=Ambiguity(0.1, tau=0.5)), problem)
    refused = tolnet("table", problem, "--data", recorded)
    assert refused.code == 2
    assert "add --tau 0" in refused.err
    assert tolnet("table", problem, "--data", recorded, "--tau", 0, "--json").document["tau"] == 0.0
