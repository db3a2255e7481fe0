"""What the commands that compare filters share: what they compare them at, and how they tell what came out."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.documents import REPORT_SUFFIXES, render, write_report
from tolnet.cli.options import check_outputs, choose_ambiguity, nearest, open_problem, repeated
from tolnet.cli.solving import save_figure, solve_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import RenderableType
    from scipy.sparse import csr_array

    from tolnet.model import Convention, SensorNetwork, ToleranceTable
    from tolnet.report.filters import FilterReport

NO_ANSWER = 4


class Setting(NamedTuple):
    """What filters of a network are compared at."""

    table: ToleranceTable
    W: csr_array
    rule: str
    """The name of W's rule, or `weights`."""
    names: list[str] | None
    """The filters that were asked for; None for all."""
    level: str
    """The options of the tolerance as they were given..."""
    options: str
    """... and all options that the setting was made with, to stand in a command that is suggested."""


def prepare_filters(
    problem: str,
    *,
    tolerance: float | None,
    convention: Convention | None,
    filters: str | None,
    diffusion: str | None,
    outputs: list[Path],
    plot: Path | None,
    console: Console,
    network: SensorNetwork | None = None,
) -> Setting:
    """Check everything that was given, and solve the table; `network` is the problem where it was read already.

    Raises InputError or UnsupportedError for files that cannot be written, an unknown filter, an unknown rule or one
    that the graph refuses, or tau other than 0.
    """
    from tolnet.design.diffusion import check_rule, diffusion_matrix
    from tolnet.model import Complaint, InputError, UnsupportedError

    check_outputs(outputs, REPORT_SUFFIXES, inputs=[problem], plot=plot)
    names = _choose_filters(filters)
    network = network or open_problem(problem, console)
    ambiguity = choose_ambiguity(network, tolerance, convention, None)
    if ambiguity.tau != 0:
        raise UnsupportedError(
            f"the least favourable model is defined for tau = 0 only, and ambiguity.tau is {ambiguity.tau:g}"
        )
    try:
        rule = diffusion or network.diffusion
        if isinstance(rule, str):
            check_rule(network, rule)
    except InputError as error:
        raise InputError([Complaint("--diffusion", each.message) for each in error.complaints]) from None
    own = network.diffusion if isinstance(network.diffusion, str) else "weights"
    level = repeated(tolerance=tolerance, convention=convention)
    options = level + repeated(filters=filters, diffusion=diffusion)
    table = solve_table(network, ambiguity, console)
    W = diffusion_matrix(network, diffusion, table)
    return Setting(table, W, diffusion or own, names, level, options)


def answering(at: Setting, report: FilterReport, console: Console) -> str | None:
    """Options with which filters answer that have no answer: a smaller tolerance, where one helps; else None.

    Error dynamics that are unstable are so for their weights.
    """
    from tolnet.design.smaller_tolerance import answering_tolerance

    if {entry["status"] for entry in report.filters.values()} <= {"ok", "unstable"}:
        return None
    with console.progress("smaller tolerances"):
        c = answering_tolerance(at.table, uniform="RKFDU" in report.filters)
    if c is None:
        return None
    return repeated(tolerance=f"{c:g}", convention=at.table.convention) + at.options.removeprefix(at.level)


def has_transient(report: FilterReport) -> bool:
    """Whether steps that are followed have numbers where steady states have none: not where no gain helps."""
    return {entry["status"] for entry in report.filters.values()} <= {"ok", "unstable", "oscillates", "fold"}


def _choose_filters(text: str | None) -> list[str] | None:
    """The filters that a comma-separated list names, in any case of letters; None without a list."""
    from tolnet.model import InputError
    from tolnet.model.history import FILTERS

    if text is None or text.strip().lower() == "all":
        return None
    words = [word.strip().upper() for word in text.split(",")]
    for word in words:
        if word not in FILTERS:
            known = ", ".join(FILTERS)
            raise InputError(f"--filters names {word!r}; the filters are {known}{nearest(word, FILTERS)}")
    return words


def deliver(
    report: FilterReport,
    view: Iterable[RenderableType],
    console: Console,
    *,
    outputs: list[Path],
    plot: Path | None,
    draw: Callable[[], Figure],
    suggestions: Iterable[str],
    advice: str | None = None,
) -> None:
    """Write, draw and print what came out; where a filter has no answer, say so with `advice` and end the command."""
    for path in outputs:
        with console.progress(f"writing {path}"):
            write_report(report, path)
    if plot is not None:
        with console.progress(f"drawing {plot}"):
            save_figure(draw(), plot)
    if console.json:
        console.document([render(report.document())])
    console.show(*view)
    console.wrote([*outputs, *([plot] if plot else [])])
    console.suggest(*suggestions)
    if not report.ok:
        complain(report.complaints(), "no answer")
        if advice is not None:
            console.note(advice)
        raise typer.Exit(NO_ANSWER)
