"""`tolnet window`: which fusion weights, window length and interval?"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tolnet.cli.console import Console
from tolnet.cli.documents import render, write
from tolnet.cli.options import AsJson, Outputs, Plot, Problem, Quiet, check_outputs, nearest, open_corrupted, repeated
from tolnet.cli.solving import save_figure

if TYPE_CHECKING:
    from tolnet.model.window_choice import WindowChoice

WINDOWS, INTERVALS, STEPS = "1,2,3", "1,2,5,10", 60
SUFFIXES = (".json", ".csv", ".md", ".toml")


def window(
    problem: Problem,
    budget: Annotated[
        list[str] | None,
        typer.Option(
            metavar="WHAT=X",
            help="solves=X (a second at a node; a step without plant.dt) or bytes=X (a link and step). Repeatable.",
        ),
    ] = None,
    windows: Annotated[str, typer.Option(metavar="L,L", help="Window lengths to try.")] = WINDOWS,
    intervals: Annotated[str, typer.Option(metavar="D,D", help="Intervals to try, in steps.")] = INTERVALS,
    steps: Annotated[int, typer.Option(min=2, metavar="T", help="Steps to follow; the second half counts.")] = STEPS,
    plot: Plot = None,
    output: Outputs = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Which fusion weights, window length and interval? A Pareto front of tr P against cost, and a choice a node.

    Nodes are credited with what their own solves bring: of what is within the budget and as good at every node as the
    best, the cheapest, where only some nodes may solve. -o takes .json, .csv (a
    row a node), .md and .toml, the problem with the choice in it: a file has one window for all nodes, which then
    differ in their intervals only.
    """
    console = Console(json=json, quiet=quiet)
    outputs = output or []
    check_outputs(outputs, SUFFIXES, inputs=[problem], plot=plot)
    limits = _budget(budget or [])
    lengths, every = _numbers("--windows", windows), _numbers("--intervals", intervals)
    designed = next((path for path in outputs if path.suffix.lower() == ".toml"), None)
    network = open_corrupted(problem, console)

    from tolnet import design
    from tolnet.report.window import window_document, window_view

    with console.progress("windows") as progress:
        choice = design.choose_window(
            network,
            limits,
            windows=lengths,
            intervals=every,
            steps=steps,
            common_window=designed is not None,
            progress=progress,
        )
    for path in outputs:
        _write(choice, path)
    if plot is not None:
        from tolnet.report.window_chart import window_figure

        with console.progress(f"drawing {plot}"):
            save_figure(window_figure(choice), plot)
    if json:
        console.document([render(window_document(choice))])
    console.show(*window_view(choice))
    console.wrote([*outputs, *([plot] if plot else [])])
    quoted = shlex.quote(problem)
    if designed is not None:
        console.suggest(f"tolnet simulate {shlex.quote(str(designed))} --filters DRKF,DRKF-SWF,CRKF")
        return
    given = "".join(f" --budget {shlex.quote(text)}" for text in budget or [])
    given += repeated(windows=windows if windows != WINDOWS else None)
    given += repeated(intervals=intervals if intervals != INTERVALS else None)
    given += repeated(steps=steps if steps != STEPS else None)
    console.suggest(
        *([] if plot else [f"tolnet window {quoted}{given} --plot window.png"]),
        f"tolnet window {quoted}{given} -o designed.toml",
    )


def _write(choice: WindowChoice, path: Path) -> None:
    from tolnet import model
    from tolnet.report.window import window_csv, window_document, window_markdown

    match path.suffix.lower():
        case ".csv":
            write(path, window_csv(choice))
        case ".md":
            write(path, window_markdown(choice))
        case ".toml":
            model.save(choice.designed(), path)
        case _:
            write(path, [render(window_document(choice))])


def _budget(given: list[str]) -> dict[str, float]:
    """`solves=0.5` and `bytes=300` as numbers."""
    from tolnet.model import InputError

    limits: dict[str, float] = {}
    for text in given:
        key, _, value = text.partition("=")
        key = key.strip().lower()
        if key not in ("solves", "bytes"):
            raise InputError(
                f"--budget names {key!r}; solves=X or bytes=X was expected{nearest(key, ['solves', 'bytes'])}"
            )
        try:
            limits[key] = float(value)
        except ValueError:
            raise InputError(f"--budget {key} is {value!r}; a number was expected") from None
    return limits


def _numbers(option: str, text: str) -> list[int]:
    from tolnet.model import InputError

    words = [word.strip() for word in text.split(",")]
    if not all(word.isdecimal() and int(word) >= 1 for word in words):
        raise InputError(f"{option} is {text!r}; whole numbers of at least 1, with commas between, were expected")
    return [int(word) for word in words]
