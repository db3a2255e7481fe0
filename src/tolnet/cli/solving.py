"""What several commands compute first, and how they draw last, behind a progress bar."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from tolnet.cli.console import Console
from tolnet.cli.options import choose_ambiguity

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from scipy.sparse import csr_array

    from tolnet.model import Ambiguity, Convention, SensorNetwork, ToleranceTable


def solve_table(
    network: SensorNetwork, ambiguity: Ambiguity, console: Console, *, uniform: bool = False
) -> ToleranceTable:
    """The tolerance table of a network."""
    from tolnet import design

    with console.progress("steady states") as progress:
        return design.choose_tolerances(network, ambiguity, uniform=uniform, progress=progress)


def prepare_filters(
    network: SensorNetwork, tolerance: float | None, unit: Convention | None, rule: str | None, console: Console
) -> tuple[ToleranceTable, csr_array, str]:
    """What filters of a network are compared at: its table, W, and the name of W's rule.

    Raises InputError or UnsupportedError for an unknown rule, one that the graph refuses, or tau other than 0.
    """
    from tolnet.design import diffusion_matrix
    from tolnet.model import Complaint, InputError, UnsupportedError

    ambiguity = choose_ambiguity(network, tolerance, unit, None)
    if ambiguity.tau != 0:
        raise UnsupportedError(
            f"the least favourable model is defined for tau = 0 only, and ambiguity.tau is {ambiguity.tau:g}"
        )
    try:
        W = diffusion_matrix(network, rule)
    except InputError as error:
        raise InputError([Complaint("--diffusion", each.message) for each in error.complaints]) from None
    named = rule or (network.diffusion if isinstance(network.diffusion, str) else "weights")
    return solve_table(network, ambiguity, console), W, named


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format that the suffix names, whole or not at all."""
    from tolnet.model import replacing

    with replacing(path) as file, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # a letter that the font lacks is drawn as a box
        figure.savefig(file, format=path.suffix.lower().removeprefix("."))
