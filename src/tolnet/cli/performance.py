"""`tolnet performance`: how well will each filter estimate, under the least favourable model?"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tolnet.cli.console import Console
from tolnet.cli.filters import Setting, answering, deliver, has_transient, prepare_filters
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
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tolnet.report.filters import FilterReport


_TRANSIENT = "--horizon T still gives the transient, which needs no steady state"


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
    at = prepare_filters(
        problem,
        tolerance=tolerance,
        convention=convention,
        filters=filters,
        diffusion=diffusion,
        outputs=outputs,
        plot=plot,
        console=console,
    )

    from tolnet import analysis
    from tolnet.report.performance import performance_report, performance_view

    with console.progress("Lyapunov equations") as progress:
        steady = analysis.evaluate_filters(at.table, at.W, filters=at.names, method=method, progress=progress)
    histories = {}
    if horizon is not None:
        with console.progress(f"{horizon:,} steps") as progress:
            histories = analysis.follow_filters(at.table, at.W, horizon, filters=at.names, progress=progress)
    report = performance_report(at.table, at.rule, steady, histories)

    def draw() -> Figure:
        from tolnet.report.charts import performance_figure

        return performance_figure(at.table, steady, histories)

    deliver(
        report,
        performance_view(report, histories),
        console,
        outputs=outputs,
        plot=plot,
        draw=draw,
        suggestions=_next_commands(shlex.quote(problem), at, report, horizon, bool(outputs), console),
        advice=None if horizon or not has_transient(report) else _TRANSIENT,
    )


def _next_commands(
    problem: str, at: Setting, report: FilterReport, horizon: int | None, written: bool, console: Console
) -> Iterator[str]:
    """What leads on; where something has no answer, what has one."""
    if any(entry["status"] == "unstable" for entry in report.filters.values()):
        yield f"tolnet diffusion {problem}{at.level} -o designed.toml"
    if not report.ok and (smaller := answering(at, report, console)) is not None:
        yield f"tolnet performance {problem}{smaller}"
    if not has_transient(report):
        return
    if horizon is None:
        yield f"tolnet performance {problem}{at.options} --horizon 50 --plot performance.png"
    elif not written:
        yield f"tolnet performance {problem}{at.options} --horizon {horizon} -o performance.json"
    yield f"tolnet simulate {problem}{at.options} --runs 500 --steps {horizon or 100}"
