"""`tolnet diff`: which nodes' tables changed between two tables or problems, and by how much?"""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tolnet.cli.console import Console
from tolnet.cli.documents import render, write
from tolnet.cli.options import AsJson, Outputs, Quiet, check_outputs, choose_ambiguity, open_problem

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
    tolerance: Annotated[
        float | None, typer.Option("--tolerance", "-c", metavar="C", help="Of the network, for problems.")
    ] = None,
    output: Outputs = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Which nodes' tables changed between two tables or problems, and by how much? Exit code 0 either way.

    Nodes are matched by name where both have names, else by index. -o takes .json and .csv.
    """
    from tolnet.model import InputError

    console = Console(json=json, quiet=quiet)
    if math.isnan(threshold):
        raise InputError("--threshold is nan; a number >= 0 was expected")
    check_outputs(output or [], [".json", ".csv"], inputs=[old, new])
    records = [_record(name, tolerance, console) for name in (old, new)]

    from tolnet.report.difference import compare_tables, difference_csv, difference_view

    difference = compare_tables(*records, threshold=threshold)
    text = render(difference.document())
    for path in output or []:
        write(path, text if path.suffix.lower() == ".json" else difference_csv(difference))
    console.document([text])
    console.show(*difference_view(difference))
    if not output:
        console.suggest(f"tolnet diff {shlex.quote(old)} {shlex.quote(new)} -o changes.csv")


def _record(name: str, tolerance: float | None, console: Console) -> TableRecord:
    from tolnet.design.export import TableRecord, read_table

    if Path(name).suffix.lower() in TABLES:
        return read_table(Path(name))
    from tolnet import design

    network = open_problem(name, console)
    with console.progress(f"steady states of {name}") as progress:
        table = design.choose_tolerances(network, choose_ambiguity(network, tolerance, None, None), progress=progress)
    return TableRecord.of(table)
