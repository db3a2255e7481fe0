"""Do the sdist and the wheel hold the whole program? `make packages`.

Builds both, installs each into an empty virtual environment outside the repository, with the locked versions of what
tolnet needs at run time, and runs the command line there as a visitor would.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
LOCK = ROOT / "requirements" / "lock.txt"
ENTRY = re.compile(r"^([\w.-]+)(?:\[[^]]*\])?==.*(?:\n[ \t]+.*)*", re.MULTILINE)
"""A distribution in the lock file: its name, version and marker, and the lines of its hashes."""
STEPS = (
    ["--version"],
    ["example", "projectile", "-o", "projectile.toml"],
    ["table", "projectile.toml", "-o", "table.json"],
    ["certify", "projectile.toml", "-o", "certificate.json"],
    ["check", "certificate.json", "--problem", "projectile.toml"],
)


def check_packages(folder: Path) -> None:
    """Build, install and run in `folder`; raises CalledProcessError, or says with SystemExit what is missing."""
    built = folder / "dist"
    run(sys.executable, "-m", "hatchling", "build", "-d", str(built), cwd=ROOT)
    needed = locked(closure(["tolnet", "hatchling"]))
    for pattern in ("*.whl", "*.tar.gz"):
        (package,) = built.glob(pattern)
        place = folder / package.suffix.strip(".")
        print(f"== {package.name}", flush=True)
        python = installed(package, needed, place)
        compare_files(python)
        for step in STEPS:
            print(f"$ tolnet {' '.join(step)}", flush=True)
            run(str(python.with_name("tolnet")), *step, cwd=place)


def installed(package: Path, needed: str, place: Path) -> Path:
    """The Python of a new environment in `place` that holds the package and what it needs, and nothing else."""
    venv.create(place / "venv", with_pip=True)
    python, lock = place / "venv" / "bin" / "python", place / "lock.txt"
    lock.write_text(needed, encoding="utf-8")
    pip = [str(python), "-m", "pip", "--quiet", "--disable-pip-version-check", "install"]
    run(*pip, "--require-hashes", "-r", str(lock), cwd=place)
    run(*pip, "--no-deps", "--no-build-isolation", str(package), cwd=place)
    return python


def closure(names: Iterable[str]) -> set[str]:
    """Those distributions and all that they need at run time, as the metadata of this environment tell; no extras."""
    found: set[str] = set()
    waiting = [(canonicalize_name(name), "") for name in names]
    seen: set[tuple[str, str]] = set()
    while waiting:
        name, extra = waiting.pop()
        if (name, extra) in seen:
            continue
        seen.add((name, extra))
        found.add(name)
        for line in metadata.requires(name) or ():
            need = Requirement(line)
            if need.marker is None or need.marker.evaluate({"extra": extra}):
                waiting += [(canonicalize_name(need.name), more) for more in ("", *need.extras)]
    return found - {"tolnet"}


def locked(names: set[str]) -> str:
    """The entries of the lock file, with their hashes, for those distributions. SystemExit where one has none."""
    text = LOCK.read_text(encoding="utf-8")
    entries = [(canonicalize_name(found[1]), found[0]) for found in ENTRY.finditer(text)]
    missing = names - {name for name, _ in entries}
    if missing:
        sys.exit(f"not in {LOCK.name}: {', '.join(sorted(missing))}; run `make lock`")
    return "".join(f"{entry}\n" for name, entry in entries if name in names)


def compare_files(python: Path) -> None:
    """SystemExit unless the environment imports its own copy, which has every file of the source."""
    program = "import pathlib, tolnet; print(pathlib.Path(tolnet.__file__).parent)"
    where = Path(run(str(python), "-c", program, cwd=python.parent, quiet=True).strip())
    if not where.is_relative_to(python.parent.parent):
        sys.exit(f"{python} imports {where}")
    missing = set(files(ROOT / "src" / "tolnet")) - set(files(where))
    if missing:
        sys.exit(f"not installed: {', '.join(sorted(missing))}")


def files(folder: Path) -> Iterator[str]:
    """The files of the program below a folder, without what Python compiled."""
    for path in folder.rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts:
            yield path.relative_to(folder).as_posix()


def run(*command: str, cwd: Path, quiet: bool = False) -> str:
    """Run a command in `cwd`, with no path to the sources; its standard output where it is to be `quiet`."""
    own = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    ran = subprocess.run(command, cwd=cwd, env=own, check=True, text=True, stdout=subprocess.PIPE if quiet else None)
    return ran.stdout or ""


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="tolnet-packages-") as folder:
        check_packages(Path(folder))
