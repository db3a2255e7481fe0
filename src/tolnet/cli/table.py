"""`tolnet table`: how much model error may each node assume?"""

from __future__ import annotations

import shlex
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.options import AsJson, Outputs, Problem, Quiet, check_outputs, choose_ambiguity, open_problem

if TYPE_CHECKING:
    from tolnet.model import Ambiguity, SensorNetwork, ToleranceTable

NO_ANSWER = 4
PLOT_SUFFIXES = (".png", ".svg", ".pdf")


def table(
    problem: Problem,
    tolerance: Annotated[
        float | None,
        typer.Option("--tolerance", "-c", metavar="C", help="The network's tolerance, instead of the problem's."),
    ] = None,
    convention: Annotated[
        Literal["gamma", "nats"] | None,
        typer.Option(help="Unit of --tolerance and of the answer: gamma, or nats (half of gamma)."),
    ] = None,
    tau: Annotated[
        float | None,
        typer.Option(metavar="TAU", help="Member of the tau-divergence family, 0 to 1; 0 unless --uniform."),
    ] = None,
    uniform: Annotated[bool, typer.Option("--uniform", help="c_k = c at every node, instead of local ones.")] = False,
    limits: Annotated[
        bool, typer.Option("--limits", help="How large the tolerance of each filter may be, and why not larger.")
    ] = False,
    full: Annotated[bool, typer.Option("--full", help="JSON with all that is deployed.")] = False,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the network coloured by tolerance (.png, .svg, .pdf)."),
    ] = None,
    output: Outputs = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """How much model error may each node assume? One tolerance c_k a node, and the filter that it gives.

    -o takes .json, .csv, .npz, .parquet, .md and .h. Exit code 4: somewhere there is no answer.
    """
    console = Console(json=json, quiet=quiet)
    outputs = output or []
    _check_files(problem, outputs, plot)
    network = open_problem(problem, console)
    ambiguity = choose_ambiguity(network, tolerance, convention, tau)
    _check_family(ambiguity, uniform=uniform, limits=limits)
    answer = _solve(network, ambiguity, uniform, console)

    from tolnet import analysis
    from tolnet.design import export
    from tolnet.report.table import table_view

    limited = None
    if limits:
        with console.progress("limits") as progress:
            limited = analysis.tolerance_limits(network, progress=progress)
    for path in outputs:
        with console.progress(f"writing {path}"):
            export.export_table(answer, path, limits=limited, full=full)
    if plot is not None:
        with console.progress(f"drawing {plot}"):
            _draw(answer, plot)
    if json:
        console.document(export.table_json(answer, limits=limited, full=full))
    else:
        console.show(*table_view(export.TableRecord.of(answer, limited)))
        _say_what_next(console, problem, answer, [*outputs, *([plot] if plot else [])], limits)
    if not answer.ok:
        from tolnet.cli.reasons import offenders

        complain(offenders(answer), "no answer")
        raise typer.Exit(NO_ANSWER)


def _check_files(problem: str, outputs: list[Path], plot: Path | None) -> None:
    from tolnet.design.export import TABLE_SUFFIXES, check_table_path

    check_outputs(outputs, TABLE_SUFFIXES, inputs=[problem])
    for path in outputs:
        check_table_path(path)
    if plot is not None:
        check_outputs([plot], PLOT_SUFFIXES, inputs=[problem])


def _check_family(ambiguity: Ambiguity, *, uniform: bool, limits: bool) -> None:
    """Refuse what is defined for Kullback-Leibler balls only, with the way out."""
    from tolnet.model import UnsupportedError

    found = f"tau = 0 only (tau is {ambiguity.tau:g})"
    if ambiguity.tau != 0 and not uniform:
        raise UnsupportedError(f"local tolerances are defined for {found}; --uniform takes c_k = c at every node")
    if ambiguity.tau != 0 and limits:
        raise UnsupportedError(f"--limits are defined for {found}; leave it out")


def _solve(network: SensorNetwork, ambiguity: Ambiguity, uniform: bool, console: Console) -> ToleranceTable:
    from tolnet import design

    design.diffusion_matrix(network)  # a rule that this graph refuses is bad input: say so before computing
    with console.progress("steady states") as progress:
        return design.choose_tolerances(network, ambiguity, uniform=uniform, progress=progress)


def _draw(answer: ToleranceTable, path: Path) -> None:
    from tolnet.model import replacing
    from tolnet.report.map import tolerance_map

    figure = tolerance_map(answer)
    with replacing(path) as file, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # a letter that the font lacks is drawn as a box
        figure.savefig(file, format=path.suffix.lower().removeprefix("."))


def _say_what_next(console: Console, problem: str, answer: ToleranceTable, written: list[Path], limits: bool) -> None:
    name = shlex.quote(problem)
    if written:
        console.show(f"wrote {', '.join(map(str, written))}")
    tables = [path for path in written if path.suffix.lower() in (".json", ".csv", ".npz")]
    commands = [] if limits else [f"tolnet table {name} --limits"]
    if not answer.ok:
        commands.append(f"tolnet table {name} --tolerance {answer.tolerance / 2:g} --convention {answer.convention}")
    if tables:
        commands.append(f"tolnet diff {shlex.quote(str(tables[0]))} {name}")
    elif answer.ok:
        commands.insert(0, f"tolnet table {name} -o table.json -o table.h --plot map.png")
    console.suggest(*commands)
