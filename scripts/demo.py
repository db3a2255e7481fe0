"""The projectile network: problem file, tolerance table, performance and certificate; `make demo`, or any folder."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from tolnet.cli import main


def demo(folder: Path) -> int:
    """Run the command line as a visitor would, in `folder`, and say what was written and what to try next."""
    folder.mkdir(parents=True, exist_ok=True)
    names = ("projectile.toml", "table.json", "table.csv", "map.png", "performance.json", "performance.png")
    problem, table, rows, drawing, numbers, picture, proof = files = [
        str(folder / name) for name in (*names, "certificate.json")
    ]
    steps = [
        ["example", "projectile", "-o", problem, "--quiet"],
        ["table", problem, "-o", table, "-o", rows, "--plot", drawing],
        ["performance", problem, "--horizon", "100", "-o", numbers, "--plot", picture],
        ["certify", problem, "-o", proof],
    ]
    for step in steps:
        print(f"$ tolnet {shlex.join(step)}", flush=True)
        code = main(step)
        if code:
            return code
    print("\nwritten:", *(f"  {path}" for path in files), sep="\n")
    command, here = Path(sys.executable).with_name("tolnet"), Path.cwd()
    tolnet = shlex.quote(str(command.relative_to(here) if command.is_relative_to(here) else command))
    print(
        "\ntry next:",
        f"  {tolnet} table {shlex.quote(problem)} --limits",
        f"  {tolnet} table {shlex.quote(problem)} --tolerance 0.06 -o {shlex.quote(str(folder / 'table.h'))}",
        f"  {tolnet} diff {shlex.quote(table)} {shlex.quote(problem)} --tolerance 0.06",
        f"  {tolnet} simulate {shlex.quote(problem)} --runs 200 --steps 60",
        f"  {tolnet} check {shlex.quote(proof)} --problem {shlex.quote(problem)}",
        f"  {tolnet} diffusion {shlex.quote(problem)} --plot {shlex.quote(str(folder / 'weights.png'))}",
        f"  {tolnet} example",
        sep="\n",
    )
    return 0


if __name__ == "__main__":
    sys.exit(demo(Path(sys.argv[1] if len(sys.argv) > 1 else "demo")))
