"""`tolnet simulate`: Monte Carlo of any filters, side by side."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Annotated

import typer

from tolnet.cli.console import Console
from tolnet.cli.filters import deliver, prepare_filters
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
    repeated,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def simulate(
    problem: Problem,
    runs: Annotated[int, typer.Option(min=2, metavar="M", help="Trajectories.")] = 500,
    steps: Annotated[int, typer.Option(min=1, metavar="T", help="Steps of each.")] = 100,
    seed: Annotated[int, typer.Option(min=0, metavar="S", help="The same seed gives the same numbers.")] = 0,
    workers: Annotated[int, typer.Option(min=1, metavar="P", help="Processes; the numbers do not depend on it.")] = 1,
    tolerance: Tolerance = None,
    convention: Unit = None,
    filters: Filters = None,
    diffusion: Rule = None,
    plot: Plot = None,
    output: Outputs = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Monte Carlo of any filters, side by side, on trajectories of the least favourable model.

    Every filter sees the same trajectories. -o takes .json, .csv (a row a step), .npz and .md. --plot draws errors
    and consistency over time and node by node. Exit code 4: some filter has no answer, or diverged.
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
    from tolnet.report.simulation import simulation_report, simulation_view

    with console.progress(f"{runs:,} runs") as progress:
        found = analysis.simulate_filters(
            at.table, at.W, runs=runs, steps=steps, seed=seed, filters=at.names, workers=workers, progress=progress
        )
    report = simulation_report(at.table, at.rule, found)

    def draw() -> Figure:
        from tolnet.report.charts import simulation_figure

        return simulation_figure(at.table, found)

    again = repeated(runs=runs, steps=steps, seed=seed or None)
    deliver(
        report,
        simulation_view(report, found),
        console,
        outputs=outputs,
        plot=plot,
        draw=draw,
        suggestions=[
            *([] if plot else [f"tolnet simulate {shlex.quote(problem)}{at.options}{again} --plot simulation.png"]),
            f"tolnet performance {shlex.quote(problem)}{at.options} --horizon {steps}",
        ],
    )
