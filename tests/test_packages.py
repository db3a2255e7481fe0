"""What is packed: every room once, and nothing that is not the project's."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

ROOT = Path(__file__).resolve().parent.parent
BESIDE = {"PKG-INFO", "pyproject.toml", "README.md", "LICENSE", ".gitignore", "CHANGELOG.md", "Makefile"}
FOLDERS = {"src", "tests", "docs", "notebooks", "benchmarks", "scripts", "requirements"}


def source() -> set[str]:
    """The files of the program, from the folder that holds `tolnet`."""
    found = (path for path in (ROOT / "src" / "tolnet").rglob("*") if path.is_file())
    return {path.relative_to(ROOT / "src").as_posix() for path in found if "__pycache__" not in path.parts}


def packed(builder: SdistBuilder | WheelBuilder) -> list[str]:
    return [str(file.distribution_path) for file in builder.recurse_included_files()]


def test_the_wheel_is_the_program():
    files = packed(WheelBuilder(str(ROOT)))
    assert len(files) == len(set(files))
    assert set(files) == source()


def test_the_sdist_is_the_project():
    files = packed(SdistBuilder(str(ROOT)))
    assert len(files) == len(set(files))
    assert {file.removeprefix("src/") for file in files if file.startswith("src/")} == source()
    assert {file.partition("/")[0] for file in files if "/" in file} == FOLDERS
    assert {file for file in files if "/" not in file} <= BESIDE
    assert {"README.md", "pyproject.toml"} <= BESIDE


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no repository: an unpacked sdist")
def test_the_sdist_holds_what_is_committed_and_nothing_else():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    committed = {file for file in listed.splitlines() if file.partition("/")[0] in FOLDERS}
    ours = {file for file in packed(SdistBuilder(str(ROOT))) if file.partition("/")[0] in FOLDERS}
    untracked = subprocess.run(
        ["git", "ls-files", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert ours - set(untracked) == committed
