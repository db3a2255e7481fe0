"""`tolnet simulate`: Monte Carlo of any filters, side by side."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Annotated

import typer

from tolnet.cli.console import Console
from tolnet.cli.filters import deliver, prepare_filters
from tolnet.cli.options import (
    AsJson,
    Outputs,
    Plot,
    Problem,
    Quiet,
    Rule,
    Tolerance,
    Unit,
    open_any,
    open_corrupted,
    open_problem,
    repeated,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tolnet.model import CorruptedNetwork, SensorNetwork


def simulate(
    problem: Problem,
    runs: Annotated[int, typer.Option(min=2, metavar="M", help="Trajectories.")] = 500,
    steps: Annotated[int, typer.Option(min=1, metavar="T", help="Steps of each.")] = 100,
    seed: Annotated[int, typer.Option(min=0, metavar="S", help="The same seed gives the same numbers.")] = 0,
    workers: Annotated[int, typer.Option(min=1, metavar="P", help="Processes; the numbers do not depend on it.")] = 1,
    tolerance: Tolerance = None,
    convention: Unit = None,
    filters: Annotated[
        str | None,
        typer.Option(
            "--filters",
            metavar="A,B",
            help="Some of KFC, RKFC, KFD, RKFDU, RKFDNU, RKFDNU2; over corrupted channels of DRKF, DRKF-SWF, CKF,"
            " CKF-tau, CRKF, CSGF, CSGF-tau, DSEA-CP; all without.",
        ),
    ] = None,
    diffusion: Rule = None,
    shared_path: Annotated[
        bool, typer.Option("--shared-path", help="Corrupted channels: one path of noise on matrices for all runs.")
    ] = False,
    window: Annotated[
        int | None, typer.Option(min=1, metavar="L", help="Corrupted channels: pairs that DRKF-SWF keeps.")
    ] = None,
    interval: Annotated[
        int | None, typer.Option(min=1, metavar="D", help="Corrupted channels: DRKF-SWF optimises every D steps.")
    ] = None,
    plot: Plot = None,
    output: Outputs = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Monte Carlo of any filters, side by side, on the same trajectories.

    These are of the least favourable model or, where the problem has corrupted channels, of that network. -o takes
    .json, .csv (a row a step), .npz and .md. --plot draws errors and consistency over time and node by node. Exit
    code 4: some filter has no answer, or diverged.
    """
    console = Console(json=json, quiet=quiet)
    outputs = output or []
    balls = {"tolerance": tolerance, "convention": convention, "diffusion": diffusion}
    channels = {"shared-path": shared_path or None, "window": window, "interval": interval}
    from tolnet.model import CorruptedNetwork

    network = _open(problem, filters, console)
    if isinstance(network, CorruptedNetwork):
        from tolnet.cli.channels import simulate_channels

        _refuse(balls, "is for problems without corrupted channels")
        simulate_channels(
            problem,
            network,
            filters=filters,
            runs=runs,
            steps=steps,
            seed=seed,
            workers=workers,
            shared_path=shared_path,
            window=window,
            interval=interval,
            plot=plot,
            outputs=outputs,
            console=console,
        )
        return
    _refuse(channels, "is for problems with corrupted channels")
    at = prepare_filters(
        problem,
        tolerance=tolerance,
        convention=convention,
        filters=filters,
        diffusion=diffusion,
        outputs=outputs,
        plot=plot,
        console=console,
        network=network,
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


def _open(problem: str, filters: str | None, console: Console) -> SensorNetwork | CorruptedNetwork:
    """The problem as the filters that are named see it; as what it is, where they do not tell."""
    from tolnet.analysis import CHANNEL_FILTERS
    from tolnet.model.history import FILTERS

    named = {word.strip().upper() for word in (filters or "").split(",")}
    if named & {name.upper() for name in FILTERS}:
        return open_problem(problem, console)
    if named & {name.upper() for name in CHANNEL_FILTERS}:
        return open_corrupted(problem, console)
    return open_any(problem, console)


def _refuse(options: dict[str, object], why: str) -> None:
    """Complain about options that mean nothing here."""
    from tolnet.model import Complaint, InputError

    given = [name for name, value in options.items() if value is not None]
    if given:
        raise InputError([Complaint(f"--{name}", why) for name in given])
