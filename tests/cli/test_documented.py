"""What the README and the demo tell a visitor to type works when typed."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from tests.cli.conftest import Tolnet

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_readme_opens_with_what_to_type():
    assert [line.split("#")[0].strip() for line in README.splitlines()[:2]] == ["make demo", "make test"]


def test_the_commands_of_the_readme_work_in_their_order(
    tolnet: Tolnet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^    tolnet (.*)$", README, flags=re.MULTILINE)
    assert len(commands) >= 12
    for command in commands:
        ran = tolnet(*shlex.split(command, comments=True))
        told = [line for line in ran.err.splitlines() if not re.fullmatch(r"[a-z]+: .*, \d+ s", line)]  # progress
        assert (ran.code, told) == (0, []), command


def test_the_python_of_the_readme_works(tolnet: Tolnet, tmp_path: Path):
    (program,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    tolnet("example", "projectile", "-o", tmp_path / "projectile.toml")
    subprocess.run([sys.executable, "-W", "error", "-c", program], cwd=tmp_path, check=True)
    assert (tmp_path / "table.h").exists()


def test_the_demo_writes_what_it_says_and_suggests_what_works(
    tolnet: Tolnet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    command = [sys.executable, "-W", "error", str(ROOT / "scripts" / "demo.py"), "demo"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    told = ran.stdout.split("\nwritten:\n")[1]
    written, suggested = told.split("\ntry next:\n")
    paths = [Path(line.strip()) for line in written.split()]
    assert [path.name for path in paths] == [
        "projectile.toml", "table.json", "table.csv", "map.png", "performance.json", "performance.png",
        "certificate.json",
    ]  # fmt: skip
    assert all((tmp_path / path).stat().st_size > 500 for path in paths)
    lines = [shlex.split(line) for line in suggested.splitlines()]
    assert len(lines) >= 5
    monkeypatch.chdir(tmp_path)
    for program, *arguments in lines:
        assert Path(program).name == "tolnet"
        assert tolnet(*arguments).code == 0
