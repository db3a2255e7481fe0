"""What several commands compute first, and how they draw last, behind a progress bar."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from tolnet.cli.console import Console

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tolnet.model import Ambiguity, SensorNetwork, ToleranceTable


def solve_table(
    network: SensorNetwork, ambiguity: Ambiguity, console: Console, *, uniform: bool = False
) -> ToleranceTable:
    """The tolerance table of a network."""
    from tolnet import design

    with console.progress("steady states") as progress:
        return design.choose_tolerances(network, ambiguity, uniform=uniform, progress=progress)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format that the suffix names, whole or not at all."""
    from tolnet.model import replacing

    with replacing(path) as file, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # a letter that the font lacks is drawn as a box
        figure.savefig(file, format=path.suffix.lower().removeprefix("."))
