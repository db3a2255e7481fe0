"""Whatever `tolnet check` is given to read: exit code 1, 2 or 3, a line that says why, and no traceback."""

from __future__ import annotations

import json
import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.certificates.deployments import deployment_of, document
from tests.certificates.malformed import labels, spoilt
from tests.cli.conftest import Tolnet

import tolnet.cli.check as command
from tolnet import model
from tolnet.certificates.eigenpair import refute_by_eigenpair
from tolnet.certificates.filter_claims import SteadyStates, decide, find_centre
from tolnet.certificates.verdicts import Proved, Refuted
from tolnet.cli.evidence import Evidence
from tolnet.design import choose_tolerances

RANDOM = 1_000 if os.environ.get("TOLNET_STUDY") == "full" else 150
BATCH = 25


def pair() -> model.SensorNetwork:
    """Two nodes with two states."""
    return model.SensorNetwork(
        A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.1, 0.0], [0.0, 0.2]], C=[[[1.0, 0.0]], [[0.0, 1.0]]],
        R=[[[0.5]], [[0.4]]], edges=[[0, 1]], name="pair", ambiguity=model.Ambiguity(0.01),
    )  # fmt: skip


@pytest.fixture(scope="module")
def intact() -> dict[str, dict[str, Any]]:
    """Certificates of one or two claims each, of every kind."""
    network = pair()
    table, deployed = choose_tolerances(network), deployment_of(network)
    local, central = table.local, table.central
    centre = find_centre(deployed, float(central.tolerance), central.P, float(central.theta))
    states = SteadyStates([1], [float(local.tolerance[1])], [local.P[1]], [float(local.theta[1])], centre)
    claims = ("steady-state", "attraction", "tolerance", "convergence", "convergence-all")
    about_filters = decide(states, deployed, claims)
    assert all(isinstance(verdict, Proved) for verdict in about_filters)
    evidence = Evidence(deployed)
    found = {verdict.claim: document(deployed, verdict) for verdict in about_filters}
    found["stability"] = document(deployed, evidence.stability(), evidence.performance())
    unstable = model.SensorNetwork(
        A=1.5 * np.eye(1), Q=np.eye(1), C=[[[1.0]], [[1.0]]], R=np.ones((2, 1, 1)), edges=[[0, 1]],
        ambiguity=model.Ambiguity(0.01),
    )  # fmt: skip
    without = deployment_of(unstable, centre=False)
    restless = type(without)(
        unstable, without.offsets, without.neighbours, without.weights, without.columns, 0 * without.gains
    )
    refuted = refute_by_eigenpair(restless, 1.5 + 0j, np.ones(2, dtype=complex))
    assert isinstance(refuted, Refuted)
    found["eigenpair"] = document(restless, refuted)
    found["followed"] = json.loads(json.dumps(found["stability"]))
    followed = found["followed"]["claims"][1]
    followed["proof"]["Q"] = None
    return found


def test_what_is_spoilt_is_intact_before(tolnet: Tolnet, intact: dict[str, dict[str, Any]], tmp_path: Path):
    for name, certificate in intact.items():
        path = tmp_path / "c.json"
        path.write_text(json.dumps(certificate))
        assert tolnet("check", path, "--quiet").code == (1 if name == "followed" else 0), name


@pytest.mark.parametrize("batch", range(RANDOM // BATCH))
def test_a_malformed_certificate_is_no_traceback(
    tolnet: Tolnet, intact: dict[str, dict[str, Any]], tmp_path: Path, batch: int
):
    rng = random.Random(batch)
    path, problem = tmp_path / "c.json", tmp_path / "pair.toml"
    model.save(pair(), problem)
    for _ in range(BATCH):
        name = rng.choice(list(intact))
        what, content = spoilt(intact[name], rng)
        path.write_bytes(content)
        options = [
            *rng.choice(([], ["--problem", problem])),
            *rng.choice(([], ["--json"], ["--require", "attraction"])),
        ]
        ran = tolnet("check", path, *options)
        assert ran.code in (1, 2, 3), (name, what, options)
        assert ran.err, (name, what)
        assert "\x1b" not in ran.out + ran.err
        assert len(ran.err) < 10_000


def test_labels_of_any_kind_are_no_traceback(tolnet: Tolnet, intact: dict[str, dict[str, Any]], tmp_path: Path):
    path, problem = tmp_path / "c.json", tmp_path / "pair.toml"
    model.save(pair(), problem)
    chosen = random.Random(0).sample(list(labels(intact["tolerance"])), 30)
    for what, changed in chosen:
        path.write_text(json.dumps(changed))
        ran = tolnet("check", path, "--problem", problem, "--json")
        assert ran.code == 3, what  # of one node's tolerance, gains are not compared
        head = {key: ran.document[key] for key in ("convention", "tau", "tolerance")}
        assert head == {
            "convention": "gamma",
            "tau": 0.0,
            "tolerance": 0.01,
        }  # the problem's, whatever the labels say
        assert ran.document["problem"] == {"name": "pair", "sha256": model.load(problem).digest}
        said = {row["claim"]: row["result"] for row in ran.document["findings"]}
        key = what.rpartition(" ")[2]
        assert said["label"] == ("not checked here" if key in ("convention", "tau", "tolerance") else "valid"), what


def test_what_is_no_file_is_refused_at_once(tolnet: Tolnet, tmp_path: Path):
    pipe, loop = tmp_path / "pipe", tmp_path / "loop"
    os.mkfifo(pipe)  # which nobody ever writes to
    loop.symlink_to(loop)
    for path in (pipe, loop, tmp_path, tmp_path / "missing", Path("/dev/zero")):
        ran = tolnet("check", path)
        assert (ran.code, len(ran.err.splitlines())) == (2, 1), path


def test_ball_arithmetic_ends_when_its_time_is_over(
    tolnet: Tolnet, intact: dict[str, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(command, "LONGEST", -1_000)
    path = tmp_path / "c.json"
    for name in ("steady-state", "convergence", "convergence-all"):
        path.write_text(json.dumps(intact[name]))
        ran = tolnet("check", path)
        assert (ran.code, "it takes too long" in ran.out) == (3, True), name


def test_what_is_invalid_is_said_in_few_lines(tolnet: Tolnet, intact: dict[str, dict[str, Any]], tmp_path: Path):
    path = tmp_path / "c.json"
    path.write_text(json.dumps({**intact["tolerance"], "claims": [7] * 5_000}))
    ran = tolnet("check", path)
    assert (ran.code, len(ran.err.splitlines())) == (1, 22)
    assert "4,980 more" in ran.err
