"""Write the built-in problems `field` and `field-50` again: python scripts/make_field.py"""

from __future__ import annotations

from pathlib import Path

from tolnet import model
from tolnet.model.examples import field, field_50

FOLDER = Path(__file__).parents[1] / "src/tolnet/model/examples"

if __name__ == "__main__":
    for network in (field(), field_50()):
        for path in model.save(network, FOLDER / f"{network.name}.toml", arrays=False):
            print(path)
