"""What is suggested after a status leads somewhere: the command that is suggested was run, and does better."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest
from tests.cli.conftest import Ran, Tolnet

from tolnet import analysis, design, model
from tolnet.design.smaller_tolerance import settling_tolerance
from tolnet.model import Ambiguity, SensorNetwork

EYE = np.eye(2)


def oscillating() -> SensorNetwork:
    """Node 0 never settles at c = 3."""
    rng = np.random.default_rng(73)
    A = rng.normal(size=(4, 4))
    A *= rng.uniform(0.9, 1.3) / np.abs(np.linalg.eigvals(A)).max()
    C = rng.normal(size=(8, 1, 4))
    edges = [[k, k + 1] for k in range(7)]
    return SensorNetwork(A=A, B=np.eye(4), C=C, R=[[[1.0]]] * 8, edges=edges, ambiguity=Ambiguity(3.0))


def diverging() -> SensorNetwork:
    """No sensor sees the first state, which decays too slowly for c = 5."""
    see = [[[0.0, 1.0]]] * 2
    return SensorNetwork(
        A=np.diag([0.9, 0.5]), B=EYE, C=see, R=[[[1.0]]] * 2, edges=[[0, 1]], ambiguity=Ambiguity(5.0, "nats")
    )


def folding() -> SensorNetwork:
    """Steady states go on beyond the centre's fold at 0.0269."""
    C = [[[0.1]], [[0.0]]]
    return SensorNetwork(A=[[0.9]], Q=[[1.0]], C=C, R=[[[1.0]]] * 2, edges=[[0, 1]], ambiguity=Ambiguity(0.1))


def hopeless(kind: str) -> SensorNetwork:
    """What no tolerance helps: node 2 does not see what grows; nothing drives what stays as it is."""
    if kind == "undetectable":
        A, Q, C = np.diag([1.1, 0.5]), EYE, [[[1.0, 0.0]], [[0.0, 1.0]], [[0.0, 1.0]]]
    else:
        A, Q, C = np.diag([1.0, 0.5]), np.diag([0.0, 1.0]), [[[1.0, 1.0]]] * 3
    return SensorNetwork(A=A, Q=Q, C=C, R=[[[1.0]]] * 3, edges=[[0, 1], [1, 2]], ambiguity=Ambiguity(0.02))


def saved(network: SensorNetwork, folder: Path) -> Path:
    path = folder / "problem.toml"
    model.save(network, path)
    return path


def suggested(ran: Ran) -> list[list[str]]:
    return [shlex.split(line)[1:] for line in ran.out.splitlines() if line.startswith("  tolnet ")]


def with_tolerance(ran: Ran) -> list[list[str]]:
    return [words for words in suggested(ran) if "--tolerance" in words]


@pytest.mark.parametrize("network", [oscillating, diverging])
def test_a_smaller_tolerance_that_is_suggested_has_an_answer(network, tolnet: Tolnet, tmp_path: Path):
    path = saved(network(), tmp_path)
    ran = tolnet("table", path)
    assert ran.code == 4
    assert "; at a smaller tolerance " in ran.err
    (words,) = with_tolerance(ran)
    assert tolnet(*words).code == 0


def test_it_lies_below_the_limits_that_are_printed():
    network = oscillating()
    smaller = settling_tolerance(design.choose_tolerances(network))
    assert smaller is not None
    centre, nodes = analysis.tolerance_limits(network)
    table = design.choose_tolerances(network, smaller)
    assert smaller < centre.attracts
    assert (table.local.tolerance < nodes.attracts).all()
    above = design.choose_tolerances(network, 2 * smaller)
    assert not (above.local.tolerance < nodes.attracts).all()  # it is not far below either


@pytest.mark.parametrize("kind", ["undetectable", "unstabilisable"])
@pytest.mark.parametrize("command", ["table", "performance", "diffusion"])
def test_nothing_is_suggested_that_does_not_help(command: str, kind: str, tolnet: Tolnet, tmp_path: Path):
    ran = tolnet(command, saved(hopeless(kind), tmp_path))
    assert ran.code == 4
    assert kind in ran.err
    assert suggested(ran) == []
    assert "next:" not in ran.out
    assert "smaller" not in ran.err


def test_a_table_beyond_the_fold_says_that_there_is_no_performance(tolnet: Tolnet, tmp_path: Path):
    path = saved(folding(), tmp_path)
    ran = tolnet("table", path)
    assert ran.code == 0
    assert "have no answer here" in ran.err
    assert "fold, 0.0268564" in ran.err
    (words,) = with_tolerance(ran)
    assert words[0] == "performance"
    assert 0.02 < float(words[words.index("--tolerance") + 1]) < 0.0268564
    assert tolnet(*words).code == 0
    below = tolnet("table", path, "--tolerance", 0.02)
    assert (below.code, below.err) == (0, "")


@pytest.mark.parametrize("command", ["performance", "diffusion"])
def test_below_the_fold_there_is_an_answer(command: str, tolnet: Tolnet, tmp_path: Path):
    ran = tolnet(command, saved(folding(), tmp_path))
    assert ran.code == 4
    (words,) = with_tolerance(ran)
    assert words[0] == command
    assert tolnet(*words).code == 0


def test_what_its_weights_make_unstable_leads_to_other_weights(tolnet: Tolnet, tmp_path: Path):
    ran = tolnet("performance", "unstable-path", "--filters", "RKFDNU2")
    assert ran.code == 4
    assert suggested(ran)[0] == ["diffusion", "unstable-path", "-o", "designed.toml"]
    assert with_tolerance(ran) == []
