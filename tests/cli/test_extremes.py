"""Valid problems at the ends of what is valid: every command has an answer or a status."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.conftest import Tolnet
from tests.study import sized

from tolnet import model
from tolnet.model import InputError, SensorNetwork

RANDOM = sized(range(1), range(200))
COMMANDS = (
    ("table",),
    ("performance",),
    ("performance", "--horizon", "3"),
    ("certify", "--claims", "schur-stability,attraction,convergence,performance"),
    ("diffusion",),
    ("diffusion", "--objective", "decay"),
    ("diffusion", "--objective", "mixing"),
    ("simulate", "--runs", "2", "--steps", "3"),
)
MORE = (
    ("table", "--limits"),
    ("certify", "--claims", "convergence-all,decay-rate", "--drop-links", "1"),
    ("diffusion", "--objective", "worst"),
    ("diffusion", "--objective", "robust"),
    ("diffusion", "--with-gains"),
    ("diffusion", "--compare"),
)
NO_TOLERANCE = sized((("validate",),), (("validate",), ("observability",)))


def pair(**keys: Any) -> SensorNetwork:
    """Two nodes that hear each other, with two states, both seen by both; some keys are replaced."""
    given = {
        "A": np.array([[0.9, 0.2], [0.0, 0.7]]),
        "Q": np.eye(2),
        "C": [np.eye(2), np.eye(2)],
        "R": [np.eye(2), np.eye(2)],
        "adjacency": np.ones((2, 2)),
    }
    return SensorNetwork(**given | keys)


def hardly_seen() -> SensorNetwork:
    """One node that sees three unstable states through gains of a millionth: beside the fold, rounding decides."""
    A = [
        [-1.09399977, -0.28261492, -1.85875487],
        [-0.15182755, -0.76938020, 0.71823788],
        [0.76907318, 1.11903804, 0.61685989],
    ]
    B = [
        [-0.28746764, 4.66083304, 8.16102043],
        [-3.54305221, 3.30833535, -0.23132935],
        [7.80614615, -4.53670066, -1.63464553],
    ]
    C = [[9.73768858e-07, -6.18512153e-06, 1.35875242e-06], [-4.47054551e-07, -9.04493231e-07, -5.85904326e-07]]
    return SensorNetwork(
        A=np.array(A), B=np.array(B), C=[np.array(C)], R=[np.diag([0.6118, 1.7118])], adjacency=np.ones((1, 1))
    )


def cancelling() -> SensorNetwork:
    """Three nodes whose loops, of entries around 1, are nearly nilpotent; the plant is almost singular."""
    A = np.array([[-36.184346742417546, 14.333197653883147], [24.979753607700232, -9.88769202660625]])
    B = np.array([[0.12268508168298257, 0.07151382607424729], [-0.11238726168163628, -0.245778663898259]])
    C = [
        [[-0.0476322372, 2.5223274107]],
        [[0.8262182492, 0.2777805270], [-0.6574310585, 1.3924692044]],
        [[-0.5062891145, 1.5699491322]],
    ]
    R = [np.eye(1) * 0.36265564294, np.diag([3.67430656653, 9.45108118517]), np.eye(1) * 9.38592541]
    return SensorNetwork(A=A, B=B, C=[np.array(c) for c in C], R=R, adjacency=np.ones((3, 3)))


NAMED = {
    "nothing moves": (pair(A=np.zeros((2, 2)), Q=np.zeros((2, 2))), 0.0),
    "nothing is known": (pair(C=[np.zeros((0, 2))] * 2, R=[np.zeros((0, 0))] * 2), 0.0),
    "sensors of zeros": (pair(C=[np.zeros((1, 2))] * 2, R=[np.eye(1)] * 2), 0.01),
    "forgotten at once": (pair(A=np.array([[0.0, 1.0], [0.0, 0.0]])), 0.01),
    "on the circle": (pair(A=np.eye(2), Q=np.diag([1.0, 0.0])), 0.0),
    "one axis driven": (pair(Q=np.diag([1.0, 0.0])), 0.3),
    "no link": (pair(adjacency=np.eye(2)), 1e-12),
    "far units": (
        pair(A=np.array([[0.9, 2e15], [0.0, 0.7]]), Q=np.diag([1e16, 1e-14]), C=[np.diag([1e-8, 1e8])] * 2),
        0.0,
    ),
    "hardly seen": (hardly_seen(), 0.22976013967),
    "cancelling": (cancelling(), 4.479610017),
}


def random_extreme(seed: int) -> tuple[SensorNetwork, float] | None:
    """A valid network with singular, tiny, huge, missing parts, and a tolerance; None where it is refused."""
    rng = np.random.default_rng(seed)
    n, N = int(rng.integers(1, 4)), int(rng.integers(1, 5))
    A = rng.normal(size=(n, n))
    A = {
        "stable": A * 0.95 / np.abs(np.linalg.eigvals(A)).max(),
        "unstable": A * 3 / np.abs(np.linalg.eigvals(A)).max(),
        "marginal": np.linalg.qr(A)[0],
        "zero": np.zeros((n, n)),
        "chain": np.eye(n) + np.eye(n, k=1),
        "tiny": A * 1e-8,
    }[rng.choice(["stable", "unstable", "marginal", "zero", "chain", "tiny"])]
    B = rng.normal(size=(n, n)) * np.array(
        {"full": 1.0, "some": rng.random(n) < 0.5, "none": 0.0, "tiny": 1e-9, "huge": 1e6}[
            rng.choice(["full", "some", "none", "tiny", "huge"])
        ]
    )
    unit = 10.0 ** rng.uniform(-8, 8, n) if rng.random() < 0.3 else np.ones(n)
    C, R = [], []
    for p in rng.integers(0, 3, N):
        D = rng.normal(size=(p, p)) + 2 * np.eye(p)
        C.append(rng.normal(size=(p, n)) * rng.choice([1.0, 1.0, 1e-6, 1e5, 0.0]) / unit)
        R.append(D @ D.T * rng.choice([1.0, 1e-8, 1e6]))
    heard = np.triu(rng.random((N, N)) < rng.choice([0.0, 0.4, 1.0]), 1)
    c = float(rng.choice([0.0, 0.0, 1e-12, 1e-6, 1e-2, 0.3, 5.0]))
    try:
        return SensorNetwork(
            A=A * (unit[:, None] / unit), B=B * unit[:, None], C=C, R=R, adjacency=np.eye(N) + heard + heard.T
        ), c
    except InputError:
        return None


def every_command(tolnet: Tolnet, network: SensorNetwork, c: float, commands: tuple, where: Path) -> None:
    """Run them all; warnings are errors here, and an exception ends the test."""
    file = where / "problem.toml"
    model.save(network, file)
    for command, *options in (*commands, *NO_TOLERANCE):
        level = [] if (command, *options) in NO_TOLERANCE else ["--tolerance", repr(c)]
        ran = tolnet(command, file, *options, *level, "--json")
        assert ran.code in (0, 1, 2, 3, 4), (command, ran.err)
        if ran.code == 2:
            assert ran.err.startswith("error: "), (command, ran.err)
        else:
            assert isinstance(ran.document, dict), command


@pytest.mark.parametrize("name", NAMED)
def test_the_ends_of_what_is_valid_have_an_answer_or_a_status(name: str, tolnet: Tolnet, tmp_path: Path):
    network, c = NAMED[name]
    every_command(tolnet, network, c, COMMANDS, tmp_path)


@pytest.mark.parametrize("seed", RANDOM)
def test_random_extremes_have_an_answer_or_a_status(seed: int, tolnet: Tolnet, tmp_path: Path):
    found = random_extreme(seed)
    if found is not None:
        every_command(tolnet, *found, (*COMMANDS, *MORE), tmp_path)


def test_beside_the_fold_the_status_says_that_rounding_decides(tolnet: Tolnet, tmp_path: Path):
    file = tmp_path / "problem.toml"
    model.save(hardly_seen(), file)
    ran = tolnet("performance", file, "--tolerance", "0.22976013967", "--json")
    assert ran.code == 4
    assert {found["status"] for found in ran.document["filters"].values()} == {"not-converged"}
