"""`tolnet diff`: which nodes' tables changed between two tables or problems, and by how much?"""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tolnet.cli.console import Console
from tolnet.cli.documents import render, write
from tolnet.cli.options import (
    AsJson,
    Outputs,
    Quiet,
    Tau,
    Tolerance,
    Uniform,
    check_family,
    check_outputs,
    choose_ambiguity,
    open_problem,
    repeated,
)
from tolnet.cli.solving import solve_table

if TYPE_CHECKING:
    from tolnet.design.export import TableRecord

TABLES = (".json", ".csv", ".npz")
_WHAT = "A table as `tolnet table -o` writes it (.json, .csv, .npz), or a problem, which is solved first."


def diff(
    old: Annotated[str, typer.Argument(metavar="OLD", help=_WHAT, show_default=False)],
    new: Annotated[str, typer.Argument(metavar="NEW", help="The same.", show_default=False)],
    threshold: Annotated[
        float, typer.Option(min=0.0, metavar="R", help="Relative changes up to this count as none.")
    ] = 1e-9,
    tolerance: Tolerance = None,
    tau: Tau = None,
    uniform: Uniform = False,
    output: Outputs = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Which nodes' tables changed between two tables or problems, and by how much? Exit code 0 either way.

    Nodes are matched by name where both have names, else by index. -o takes .json and .csv. --tolerance, --tau and
    --uniform are for problems; tables stay as they were written.
    """
    from tolnet.model import InputError

    console = Console(json=json, quiet=quiet)
    if math.isnan(threshold):
        raise InputError("--threshold is nan; a number >= 0 was expected")
    check_outputs(output or [], [".json", ".csv"], inputs=[old, new])
    records = [_record(name, tolerance, tau, uniform, console) for name in (old, new)]

    from tolnet.report.difference import compare_tables, difference_csv, difference_view

    difference = compare_tables(*records, threshold=threshold)
    text = render(difference.document())
    for path in output or []:
        write(path, [text if path.suffix.lower() == ".json" else difference_csv(difference)])
    console.document([text])
    console.show(*difference_view(difference))
    if not output:
        options = repeated(tolerance=tolerance, tau=tau, uniform=uniform)
        console.suggest(f"tolnet diff {shlex.quote(old)} {shlex.quote(new)}{options} -o changes.csv")


def _record(name: str, tolerance: float | None, tau: float | None, uniform: bool, console: Console) -> TableRecord:
    from tolnet.design.export import TableRecord, read_table

    if Path(name).suffix.lower() in TABLES:
        return read_table(Path(name))
    network = open_problem(name, console)
    ambiguity = choose_ambiguity(network, tolerance, None, tau)
    check_family(ambiguity, uniform=uniform)
    return TableRecord.of(solve_table(network, ambiguity, console, uniform=uniform))
