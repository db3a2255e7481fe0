"""`tolnet performance`: how well will each filter estimate, under the least favourable model?"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.documents import REPORT_SUFFIXES, render, write_report
from tolnet.cli.options import (
    AsJson,
    Filters,
    Outputs,
    Plot,
    Problem,
    Quiet,
    Rule,
    Tolerance,
    Unit,
    check_outputs,
    choose_filters,
    open_problem,
    repeated,
)
from tolnet.cli.solving import prepare_filters, save_figure

if TYPE_CHECKING:
    from tolnet.report.filters import FilterReport

NO_ANSWER = 4


def performance(
    problem: Problem,
    tolerance: Tolerance = None,
    convention: Unit = None,
    filters: Filters = None,
    method: Annotated[
        Literal["auto", "projected", "smith", "scipy", "slycot"],
        typer.Option(help="How the Lyapunov equation is solved."),
    ] = "auto",
    horizon: Annotated[
        int | None,
        typer.Option(min=1, metavar="T", help="Follow the filters over T steps from the initial covariance too."),
    ] = None,
    diffusion: Rule = None,
    plot: Plot = None,
    output: Outputs = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """How well will each filter estimate, under the least favourable model? Mean square deviation, node by node.

    -o takes .json, .csv (a row a node), .npz and .md. --plot draws the nodes and, with --horizon, the MSD, the
    tolerances and the thetas over time. Exit code 4: some filter has no answer.
    """
    console = Console(json=json, quiet=quiet)
    outputs = output or []
    check_outputs(outputs, REPORT_SUFFIXES, inputs=[problem], plot=plot)
    names = choose_filters(filters)
    network = open_problem(problem, console)
    table, W, rule = prepare_filters(network, tolerance, convention, diffusion, console)

    from tolnet import analysis
    from tolnet.report.performance import performance_report, performance_view

    with console.progress("Lyapunov equations") as progress:
        steady = analysis.evaluate_filters(table, W, filters=names, method=method, progress=progress)
    histories = {}
    if horizon is not None:
        with console.progress(f"{horizon:,} steps") as progress:
            histories = analysis.follow_filters(table, W, horizon, filters=names, progress=progress)
    report = performance_report(table, rule, steady, histories)
    for path in outputs:
        with console.progress(f"writing {path}"):
            write_report(report, path)
    if plot is not None:
        from tolnet.report.charts import performance_figure

        with console.progress(f"drawing {plot}"):
            save_figure(performance_figure(table, steady, histories), plot)
    if json:
        console.document([render(report.document())])
    console.show(*performance_view(report, histories))
    console.wrote([*outputs, *([plot] if plot else [])])
    options = repeated(tolerance=tolerance, convention=convention, filters=filters, diffusion=diffusion)
    console.suggest(*_next_commands(shlex.quote(problem), options, report, horizon, bool(outputs)))
    if not report.ok:
        complain(report.complaints(), "no answer")
        if horizon is None:
            console.note("over a finite horizon there is one: --horizon T gives the transient")
        raise typer.Exit(NO_ANSWER)


def _next_commands(
    problem: str, options: str, report: FilterReport, horizon: int | None, written: bool
) -> Iterator[str]:
    if horizon is None:
        yield f"tolnet performance {problem}{options} --horizon 50 --plot performance.png"
    elif not written:
        yield f"tolnet performance {problem}{options} --horizon {horizon} -o performance.json"
    yield f"tolnet simulate {problem}{options} --runs 500 --steps {horizon or 100}"
    if not report.ok:
        yield f"tolnet table {problem} --limits"
