"""Write the built-in problem `projectile` again: python scripts/make_projectile.py"""

from __future__ import annotations

from pathlib import Path

from tolnet import model
from tolnet.model.examples import projectile

TARGET = Path(__file__).parents[1] / "src/tolnet/model/examples/projectile.toml"

if __name__ == "__main__":
    for path in model.save(projectile(), TARGET, arrays=False):
        print(path)
