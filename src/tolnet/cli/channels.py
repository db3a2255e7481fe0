"""The half of `tolnet simulate` that is about corrupted channels."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from tolnet.cli.console import Console
from tolnet.cli.documents import REPORT_SUFFIXES
from tolnet.cli.filters import deliver
from tolnet.cli.options import check_outputs, nearest, repeated

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tolnet.model import CorruptedNetwork


def simulate_channels(
    problem: str,
    network: CorruptedNetwork,
    *,
    filters: str | None,
    runs: int,
    steps: int,
    seed: int,
    workers: int,
    shared_path: bool,
    window: int | None,
    interval: int | None,
    plot: Path | None,
    outputs: list[Path],
    console: Console,
) -> None:
    """Monte Carlo of filters over corrupted channels, told, written and drawn."""
    check_outputs(outputs, REPORT_SUFFIXES, inputs=[problem], plot=plot)

    from tolnet import analysis
    from tolnet.report.channels import channel_report, channel_view

    names = _choose(filters)
    with console.progress(f"{runs:,} runs") as progress:
        found = analysis.simulate_corrupted(
            network,
            runs=runs,
            steps=steps,
            seed=seed,
            filters=names,
            shared_path=shared_path,
            window=window,
            interval=interval,
            workers=workers,
            progress=progress,
        )
    report = channel_report(network, found)

    def draw() -> Figure:
        from tolnet.report.channel_charts import channel_figure

        return channel_figure(network, found)

    words = {"filters": filters, "window": window, "interval": interval, "shared-path": shared_path}
    options = repeated(**words, runs=runs, steps=steps, seed=seed or None)
    quoted = shlex.quote(problem)
    deliver(
        report,
        channel_view(report, found),
        console,
        outputs=outputs,
        plot=plot,
        draw=draw,
        suggestions=[
            *([] if plot else [f"tolnet simulate {quoted}{options} --plot simulation.png"]),
            f"tolnet window {quoted}",
        ],
        advice="a run diverges where an error exceeds a million times what the state can be",
    )


def _choose(text: str | None) -> list[str] | None:
    """The filters that a comma-separated list names, in any case of letters; None for all."""
    from tolnet.analysis import CHANNEL_FILTERS
    from tolnet.model import InputError

    if text is None or text.strip().lower() == "all":
        return None
    known = {name.upper(): name for name in CHANNEL_FILTERS}
    chosen = []
    for word in (word.strip().upper() for word in text.split(",")):
        if word not in known:
            hint = nearest(word, known)
            raise InputError(f"--filters names {word!r}; the filters are {', '.join(CHANNEL_FILTERS)}{hint}")
        chosen.append(known[word])
    return chosen
