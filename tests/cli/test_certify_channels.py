"""`tolnet certify` and `tolnet check` for problems with corrupted channels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.conftest import Tolnet
from tests.cli.test_certify import stand_alone

from tolnet import model
from tolnet.model import CorruptedNetwork


def saved(path: Path, C: float = 1.0, **changes: Any) -> Path:
    """Two nodes that see one of two states each, the second through a fading channel."""
    given: dict[str, Any] = {
        "A": [[0.5, 0.25], [0.0, 0.75]],
        "Q": np.eye(2),
        "C": [[[1.0, 0.0]], [[0.0, C]]],
        "R": [[[1.0]], [[2.0]]],
        "fading_mean": [1.0, 0.5],
        "fading_variance": [0.0, 0.125],
        "edges": [[0, 1]],
        "states": ["depth", "speed"],
        "name": "pair",
    }
    return model.save(CorruptedNetwork(**(given | changes)), path)[0]


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    return saved(tmp_path / "pair.toml")


def test_a_network_is_proved_checked_and_compared(tolnet: Tolnet, pair: Path, tmp_path: Path):
    path = tmp_path / "certificate.json"
    ran = tolnet("certify", pair, "-o", path)
    assert ran.code == 0
    assert "The weakest window" in ran.out
    assert "It fails for windows of this length if any of the nodes 0, 1 falls silent." in ran.out
    (claim,) = json.loads(path.read_text())["claims"]
    assert (claim["claim"], claim["verdict"], claim["window"], claim["horizon"]) == (
        "observability",
        "proved",
        1,
        None,
    )
    assert stand_alone(path).returncode == 0
    ran = tolnet("check", path, "--problem", pair)
    assert ran.code == 0
    assert "plant, sensors and fading are the same" in ran.out

    other = saved(tmp_path / "other.toml", C=1 + 2.0**-52)
    ran = tolnet("check", path, "--problem", other)
    assert ran.code == 1
    assert "differs in C" in ran.err
    assert tolnet("check", path, "--problem", pair, "--table", "absent.npz").code == 2


def test_alpha_is_that_of_floating_point(tolnet: Tolnet, pair: Path):
    for options in ([], ["--window", 2], ["--horizon", 5], ["--form", "classical"]):
        claim = tolnet("certify", pair, "--json", *options).document["claims"][0]
        found = tolnet("observability", pair, "--json", *options).document
        assert float.fromhex(claim["alpha"]) == pytest.approx(found["alpha"], rel=2e-6)
        assert float.fromhex(claim["alpha"]) < found["alpha"]


def test_a_blind_network_is_refuted(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "certificate.json"
    blind = saved(tmp_path / "blind.toml", C=0.0, A=[[0.5, 0.0], [0.0, 0.75]])
    ran = tolnet("certify", blind, "-o", path)
    assert ran.code == 1
    assert "From k = 0 on nobody sees +1 speed. No longer window sees more." in ran.out
    assert "One more sensor of speed that does not fade" in ran.out
    assert stand_alone(path).returncode == 0
    assert tolnet("check", path, "--problem", blind).code == 0

    one = saved(tmp_path / "one.toml", C=0.0)  # seen by the first node, one instant later
    assert tolnet("certify", one, "--window", 1).code == 1
    assert tolnet("certify", one).code == 0


@pytest.mark.parametrize("name", ["field", "field-50"])
def test_a_field_is_proved_over_a_horizon_and_open_in_the_long_run(tolnet: Tolnet, tmp_path: Path, name: str):
    """The second moment grows, so that in the long run fading sensors say nothing, but never nothing at all."""
    path = tmp_path / "certificate.json"
    ran = tolnet("certify", name, "-o", path)
    assert ran.code == 3
    assert "grows without bound" in ran.out
    claims = json.loads(path.read_text())["claims"]
    assert [(claim["verdict"], claim["horizon"]) for claim in claims] == [("undecided", None), ("proved", 100)]
    assert stand_alone(path).returncode == 3
    assert tolnet("check", path, "--problem", name).code == 3


@pytest.mark.parametrize(
    ("problem", "options", "words"),
    [
        ("field", ["--claims", "performance"], "the claim for those is 'observability', not 'performance'"),
        ("field", ["--rate", "0.9"], "not 'decay-rate'"),
        ("field", ["--tolerance", "0.1"], "--tolerance means nothing"),
        ("field", ["--claims", "observability,performance"], "the other of exact ones"),
        ("field", ["--window", "5", "--horizon", "3"], "window is 5"),
        ("projectile", ["--claims", "observability"], "has no corrupted channels"),
        ("projectile", ["--horizon", "3"], "has no corrupted channels, of which --horizon speaks"),
    ],
)
def test_claims_that_do_not_fit_the_problem_are_refused(tolnet: Tolnet, problem: str, options: list[str], words: str):
    ran = tolnet("certify", problem, *options)
    assert ran.code == 2
    assert words in ran.err
    assert ran.out == ""


def test_a_file_with_a_tolerance_too_is_certified_for_exact_channels_by_name(tolnet: Tolnet, tmp_path: Path):
    file = saved(tmp_path / "both.toml")
    file.write_text(file.read_text() + "\n[ambiguity]\ntolerance = 0.01\n")
    assert tolnet("certify", file, "--claims", "schur-stability").code == 0
    assert "observability" in tolnet("certify", file).out


def test_windows_and_horizons_beyond_the_range_of_doubles(tolnet: Tolnet, tmp_path: Path):
    """3^700 is no double: a window that long is refused in a word, a horizon that far is no matter."""
    fast = saved(tmp_path / "fast.toml", A=[[3.0, 0.0], [0.0, 0.75]])
    ran = tolnet("certify", fast, "--window", 700)
    assert ran.code == 2
    assert "beyond the range of doubles" in ran.err
    assert tolnet("certify", fast, "--horizon", 800, "--form", "classical").code == 0
    assert tolnet("certify", saved(tmp_path / "a.toml", A=[[3.0, 0.0], [0.0, 4.0]]), "--horizon", 800).code == 3


@pytest.mark.parametrize("options", [["--claims", "performance"], ["--drop-links", "1"], ["--tolerance", "0.02"]])
def test_claims_of_constant_plants_are_not_for_moving_ones(tolnet: Tolnet, tmp_path: Path, options: list[str]):
    path = tmp_path / "moving.toml"
    moving = model.CorruptedNetwork(
        A=[[[0.5]], [[0.25]]], Q=[[1.0]], C=[[[1.0]], [[1.0]]], R=[[[1.0]], [[2.0]]], edges=[[0, 1]]
    )
    model.save(moving, path)
    ran = tolnet("certify", path, *options)
    assert ran.code == 2
    assert "varies with time (A)" in ran.err
    assert "observability" in ran.err
    assert tolnet("certify", path).code == 0
