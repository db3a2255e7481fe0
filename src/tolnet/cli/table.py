"""`tolnet table`: how much model error may each node assume?"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.options import (
    AsJson,
    Outputs,
    Problem,
    Quiet,
    Tau,
    Tolerance,
    Uniform,
    Unit,
    check_family,
    check_outputs,
    choose_ambiguity,
    open_problem,
    repeated,
)
from tolnet.cli.solving import save_figure, solve_table

if TYPE_CHECKING:
    from tolnet.model import Ambiguity, SensorNetwork, ToleranceTable

NO_ANSWER = 4


def table(
    problem: Problem,
    tolerance: Tolerance = None,
    convention: Unit = None,
    tau: Tau = None,
    uniform: Uniform = False,
    data: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Estimate the tolerance from recorded x, y and u (.npz)."),
    ] = None,
    data_method: Annotated[
        Literal["divergence", "likelihood"] | None,
        typer.Option(help="How: divergence from the nominal model (the default), or its negative log-likelihood."),
    ] = None,
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
    _check_files([problem, *([str(data)] if data else [])], outputs, plot)
    _check_sources(tolerance, data, data_method)
    network = open_problem(problem, console)
    ambiguity, estimate = None, None
    if data is None:
        ambiguity = choose_ambiguity(network, tolerance, convention, tau)
    else:
        from tolnet.cli.data import data_view, estimate_tolerance

        ambiguity, estimate = estimate_tolerance(network, data, data_method or "divergence", convention, tau, console)
        console.show(*data_view(estimate, ambiguity.convention))
    _check_limits(ambiguity, uniform=uniform, limits=limits)
    answer = _solve(network, ambiguity, uniform, console)
    _tell(answer, estimate, console, outputs, plot, limits=limits, full=full)
    options = repeated(
        tolerance=tolerance, convention=convention, tau=tau, uniform=uniform, data=data, data_method=data_method
    )
    level = repeated(tolerance=tolerance if data is None else answer.tolerance, convention=convention)
    written = [*outputs, *([plot] if plot else [])]
    console.wrote(written)
    smaller, performing = _smaller(answer, uniform, console)
    advice = _next_commands(shlex.quote(problem), options, level, answer, written, limits, smaller, performing)
    console.suggest(*advice)
    if not answer.ok:
        from tolnet.design.export import Reasons

        complain(Reasons(answer).offenders(), "no answer")
        raise typer.Exit(NO_ANSWER)


def _check_files(inputs: list[str], outputs: list[Path], plot: Path | None) -> None:
    from tolnet.design.export import TABLE_SUFFIXES, check_table_path

    check_outputs(outputs, TABLE_SUFFIXES, inputs=inputs, plot=plot)
    for path in outputs:
        check_table_path(path)


def _check_sources(tolerance: float | None, data: Path | None, method: str | None) -> None:
    """Refuse two tolerances, and a method for nothing."""
    from tolnet.model import InputError

    if data is not None and tolerance is not None:
        raise InputError("--tolerance and --data are given; one of them was expected, since --data estimates c")
    if data is None and method is not None:
        raise InputError("--data-method is given without --data")


def _check_limits(ambiguity: Ambiguity, *, uniform: bool, limits: bool) -> None:
    """Refuse what is defined for Kullback-Leibler balls only, with the way out."""
    from tolnet.model import UnsupportedError

    check_family(ambiguity, uniform=uniform)
    if ambiguity.tau != 0 and limits:
        raise UnsupportedError(f"--limits are defined for tau = 0 only (tau is {ambiguity.tau:g}); leave it out")


def _solve(network: SensorNetwork, ambiguity: Ambiguity, uniform: bool, console: Console) -> ToleranceTable:
    from tolnet.design.diffusion import check_rule

    if isinstance(network.diffusion, str):  # a rule that this graph refuses is bad input: say so before computing
        check_rule(network, network.diffusion)
    return solve_table(network, ambiguity, console, uniform=uniform)


def _tell(
    answer: ToleranceTable,
    estimate: dict[str, Any] | None,
    console: Console,
    outputs: list[Path],
    plot: Path | None,
    *,
    limits: bool,
    full: bool,
) -> None:
    """Write, draw and print the table."""
    from tolnet import analysis
    from tolnet.design import export
    from tolnet.report.table import table_view

    limited = None
    if limits:
        with console.progress("limits") as progress:
            limited = analysis.tolerance_limits(answer.network, progress=progress)
    for path in outputs:
        with console.progress(f"writing {path}"):
            export.export_table(answer, path, limits=limited, full=full, data=estimate)
    if plot is not None:
        from tolnet.report.map import tolerance_map

        with console.progress(f"drawing {plot}"):
            save_figure(tolerance_map(answer), plot)
    if console.json:
        console.document(export.table_json(answer, limits=limited, full=full, data=estimate))
    else:
        console.show(*table_view(export.TableRecord.of(answer, limited)))


def _smaller(answer: ToleranceTable, uniform: bool, console: Console) -> tuple[float | None, float | None]:
    """Smaller tolerances, if any help: one at which more filters settle, and one at which `performance` answers."""
    from tolnet import analysis
    from tolnet.design.smaller_tolerance import performing_tolerance, settling_tolerance

    smaller = performing = None
    with console.progress("smaller tolerances"):
        if not answer.ok:
            smaller = settling_tolerance(answer, uniform=uniform)
        if answer.tau == 0:
            performing = performing_tolerance(answer)
    if performing is not None:
        reason = analysis.least_favourable_model(answer.network, answer.central).reason
        console.note(f"`tolnet performance` and `tolnet diffusion` have no answer here: {reason}")
    return smaller, performing


def _next_commands(
    problem: str,
    options: str,
    level: str,
    answer: ToleranceTable,
    written: list[Path],
    limits: bool,
    smaller: float | None,
    performing: float | None,
) -> Iterator[str]:
    """What to try after a table; `options` are those that it was made with, `level` is its tolerance among them.

    Nothing that has no answer is suggested, nor a smaller tolerance where none helps.
    """
    family = repeated(tau=answer.tau or None, uniform=answer.tau != 0)
    tables = [path for path in written if path.suffix.lower() in (".json", ".csv", ".npz")]
    if tables and answer.network.ambiguity is not None:
        yield f"tolnet diff {shlex.quote(str(tables[0]))} {problem}{family}"
    elif answer.ok and not tables:
        yield f"tolnet table {problem}{options} -o table.json -o table.h --plot map.png"
    if smaller is not None:
        yield f"tolnet table {problem}{repeated(tolerance=f'{smaller:g}', convention=answer.convention)}{family}"
    if performing is not None:
        below = repeated(tolerance=f"{performing:g}", convention=answer.convention)
        yield f"tolnet performance {problem}{below}"
    elif answer.tau == 0 and answer.ok:
        yield f"tolnet performance {problem}{level}"
    if answer.tau == 0 and not limits and (answer.ok or smaller is not None):
        yield f"tolnet table {problem}{options} --limits"
