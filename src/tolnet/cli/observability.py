"""`tolnet observability`: is the network (robustly) collectively observable, and where is it weak?"""

from __future__ import annotations

import shlex
import warnings
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.documents import REPORT_SUFFIXES, render, write_report
from tolnet.cli.options import AsJson, Outputs, Plot, Problem, Quiet, check_outputs, nearest, open_corrupted, repeated
from tolnet.cli.solving import save_figure

if TYPE_CHECKING:
    from tolnet.model import CorruptedNetwork
    from tolnet.model.drkf import Channel, DrkfSteadyState
    from tolnet.model.observability import Form, RobustObservability
    from tolnet.report.observability import ObservabilityReport, Sweep

FINITE = 100
"""The horizon that is looked at as well where the condition fails in the long run."""
NO_ANSWER = 4


def observability(
    problem: Problem,
    form: Annotated[
        Literal["sharp", "stated", "classical"],
        typer.Option(help="With the second moment (11), with its norm as stated (6), or without fading."),
    ] = "sharp",
    window: Annotated[
        int | None, typer.Option(min=1, metavar="L", help="Instants in a window; the smallest that does, without.")
    ] = None,
    horizon: Annotated[
        int | None, typer.Option(min=1, metavar="H", help="Windows within k = 0..H; every k without.")
    ] = None,
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=LO:HI:COUNT",
            help="tr P over a range of fading_mean, fading_variance, multiplicative_variance, estimate_noise or"
            " matrix_noise; xLO:HI multiplies what the problem has. Repeatable.",
        ),
    ] = None,
    full: Annotated[
        bool, typer.Option("--full", help="JSON with gains, weights and covariances of every node.")
    ] = False,
    plot: Plot = None,
    output: Outputs = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Is the network robustly collectively observable, where is it weak, and how well will its filter do?

    Tests the condition under which the filter over corrupted channels (DRKF) keeps its errors bounded, names the
    weakest direction and the nodes that matter, and computes what the filter settles on. -o takes .json, .csv (a row
    a node), .npz (with all gains) and .md. Exit code 4: the filter settles on nothing.
    """
    from tolnet.model import Status

    console = Console(json=json, quiet=quiet)
    outputs = output or []
    check_outputs(outputs, REPORT_SUFFIXES, inputs=[problem], plot=plot)
    ranges = [_range(text) for text in sweep or []]
    network = open_corrupted(problem, console)
    report = _look(network, form, window, horizon, ranges, full, console)
    for path in outputs:
        with console.progress(f"writing {path}"):
            write_report(report, path)
    if plot is not None:
        from tolnet.report.observability_figure import observability_figure

        with console.progress(f"drawing {plot}"):
            save_figure(observability_figure(report), plot)
    if console.json:
        console.document([render(report.document())])
    else:
        console.show(*report.view())
    console.wrote([*outputs, *([plot] if plot else [])])
    given = repeated(form=None if form == "sharp" else form, window=window, horizon=horizon)
    quoted = shlex.quote(problem)
    console.suggest(
        *([] if plot else [f"tolnet observability {quoted}{given} --plot observability.png -o gains.npz"]),
        *([] if ranges else [f"tolnet observability {quoted}{given} --sweep matrix_noise=x0:2:9"]),
    )
    bad = {found.reason: str(found.status) for found in report.steady.values() if found.status != Status.OK}
    if bad:
        complain((f"{status}: {reason}" for reason, status in bad.items()), "no answer")
        raise typer.Exit(NO_ANSWER)


def _look(
    network: CorruptedNetwork,
    form: Form,
    window: int | None,
    horizon: int | None,
    ranges: list[tuple[str, bool, list[float]]],
    full: bool,
    console: Console,
) -> ObservabilityReport:
    from tolnet import analysis
    from tolnet.analysis.error_bound import LARGEST
    from tolnet.report.observability import ObservabilityReport

    forms: dict[str, RobustObservability] = {}
    every: tuple[Form, ...] = ("sharp", "stated", "classical")
    for each in every:
        with console.progress(f"observability, {each} form") as progress:
            forms[each] = analysis.robust_observability(
                network, form=each, window=window, horizon=horizon, progress=progress
            )
    main, finite = forms[form], None
    if not main.holds and horizon is None:
        with console.progress(f"observability over {FINITE} steps") as progress:
            finite = analysis.robust_observability(
                network, form=form, window=window, horizon=max(FINITE, window or 1), progress=progress
            )
    steady: dict[str, DrkfSteadyState] = {}
    channels: tuple[Channel, ...] = ("worst", "best")
    for channel in channels if network.period is not None else ():
        with console.progress(f"steady state, {channel} channels") as progress:
            steady[channel] = analysis.solve_drkf(network, channel=channel, progress=progress)
    bound = None
    if network.N <= LARGEST:
        with console.progress("error bound"):
            bound = analysis.error_bound(
                network, horizon=horizon, observability=forms["sharp"], steady_state=steady.get("worst")
            )
        noise = bound.multiplicative_noise
    else:
        noise = analysis.multiplicative_noise_condition(network, horizon=horizon)
    return ObservabilityReport(
        network=network,
        main=main,
        forms=forms,
        over_horizon=finite,
        noise=noise,
        bound=bound,
        steady=steady,
        sweeps=[_swept(network, *each, console) for each in ranges],
        full=full,
    )


def _swept(network: CorruptedNetwork, name: str, relative: bool, values: list[float], console: Console) -> Sweep:
    from tolnet import analysis
    from tolnet.model import LooseBoundWarning
    from tolnet.report.observability import Sweep

    with console.progress(f"sweep of {name}") as progress, warnings.catch_warnings(record=True) as loose:
        warnings.simplefilter("always", LooseBoundWarning)
        found = analysis.sweep_drkf(network, name, values, relative=relative, progress=progress)
    if loose:
        console.note(
            f"warning: --sweep {name}: {loose[0].message}" + (" (and so elsewhere)" if len(loose) > 1 else "")
        )
    return Sweep(name, values, relative, found)


def _range(text: str) -> tuple[str, bool, list[float]]:
    """The parameter, whether the values multiply it, and the values of NAME=LO:HI:COUNT. Raises InputError."""
    import numpy as np

    from tolnet.analysis.drkf_steady_state import SWEPT
    from tolnet.model import InputError

    name, _, bounds = text.partition("=")
    if name not in SWEPT:
        raise InputError(f"--sweep names {name!r}; {', '.join(SWEPT)} can be swept{nearest(name, SWEPT)}")
    relative = bounds.startswith("x")
    try:
        low, high, count = bounds.removeprefix("x").split(":")
        values = np.linspace(float(low), float(high), int(count))
    except ValueError:
        raise InputError(f"--sweep {text!r} is not NAME=LO:HI:COUNT") from None
    if not values.size or not np.isfinite(values).all():
        raise InputError(f"--sweep {text!r} has no values; COUNT >= 1 and finite bounds were expected")
    return name, relative, values.tolist()
