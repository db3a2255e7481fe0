"""The command line in this process: what it prints, apart by stream, and its exit code."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from tests.instances import ring_projectile

from tolnet import model
from tolnet.cli import main


@dataclass(frozen=True)
class Ran:
    """What one run of the command line left behind."""

    code: int
    out: str
    err: str

    @property
    def document(self) -> dict[str, Any]:
        """Standard output as the one JSON document that it must be."""
        return json.loads(self.out, parse_constant=pytest.fail)


Tolnet = Callable[..., Ran]


@pytest.fixture(autouse=True)
def heeds_interrupts() -> None:
    """Ctrl-C reaches the processes that tests start, also where the tests run in the background, which ignores it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def tolnet(capsys: pytest.CaptureFixture[str]) -> Tolnet:
    """Run `tolnet ARGUMENTS` here and now; whatever happens, no traceback may reach the user."""

    def run(*arguments: object) -> Ran:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.out + captured.err
        return Ran(code, captured.out, captured.err)

    return run


@pytest.fixture
def process() -> Tolnet:
    """Run `python -m tolnet ARGUMENTS` as people do; no traceback may reach them."""

    def run(*arguments: object, **options: Any) -> Ran:
        command = [sys.executable, "-m", "tolnet", *map(str, arguments)]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=120, **options)
        assert "Traceback" not in ran.stdout + ran.stderr
        return Ran(ran.returncode, ran.stdout, ran.stderr)

    return run


@pytest.fixture
def ring(tmp_path: Path) -> Path:
    """The ring projectile as a problem file."""
    path = tmp_path / "ring.toml"
    model.save(ring_projectile(), path)
    return path


@pytest.fixture
def blind(tmp_path: Path) -> Path:
    """Two states of which one is unstable: nodes 0 and 1 hear a sensor that sees it, node 2 does not."""
    path = tmp_path / "blind.toml"
    network = model.SensorNetwork(
        A=[[1.1, 0.0], [0.0, 0.5]],
        B=[[0.1, 0.0], [0.0, 0.1]],
        C=[[[1.0, 0.0]], [[0.0, 1.0]], [[0.0, 1.0]]],
        R=[[[0.1]], [[0.1]], [[0.1]]],
        edges=[[0, 1]],
        name="blind",
        names=["gate", "yard", "hill"],
        ambiguity=model.Ambiguity(0.01),
    )
    model.save(network, path)
    return path


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Four nodes in a row track two states."""
    path = tmp_path / "small.toml"
    network = model.SensorNetwork(
        A=[[0.9, 0.2], [0.0, 0.8]],
        B=[[1.0, 0.0], [0.0, 1.0]],
        C=[[[1.0, 0.1 * k]] for k in range(4)],
        R=[[[1.0 + k]] for k in range(4)],
        edges=[[0, 1], [1, 2], [2, 3]],
        name="small",
        ambiguity=model.Ambiguity(0.02),
    )
    model.save(network, path)
    return path


@pytest.fixture
def folded(tmp_path: Path) -> Path:
    """One badly seen state, at a tolerance beyond the fold of its filter."""
    path = tmp_path / "folded.toml"
    network = model.SensorNetwork(
        A=[[0.9]], B=[[1.0]], C=[[[0.1]]], R=[[[1.0]]], edges=[], name="folded", ambiguity=model.Ambiguity(0.1)
    )
    model.save(network, path)
    return path
