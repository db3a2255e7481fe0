"""Robust observability in pictures: over time, by direction, by node, and what the filter settles on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tolnet.model import Status
from tolnet.report.charts import dress
from tolnet.report.map import INK, LINKS
from tolnet.report.observability import ObservabilityReport, Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {"sharp": "#00798c", "stated": "#edae49", "classical": "#9aa5b1"}
CHANNELS = {"worst": "#d1495b", "best": "#00798c", "clean": "#9aa5b1"}
WORDS = {"worst": "worst channels", "best": "no matrices sent", "clean": "no matrix noise"}
SWEEPS = ("#1f2933", "#d1495b", "#00798c", "#edae49", "#66c2a5")
ONE_BY_ONE_UP_TO = 60
"""Up to this size every node has a bar; beyond, they are curves, sorted."""
_LEAST = 1e-8
"""Values of alpha below this share of the largest are drawn there: on a logarithmic scale zero has no place."""


def observability_figure(report: ObservabilityReport) -> Figure:
    """alpha over time in every form, the weakest direction, what each node changes, and tr P; sweeps below.

    Where the condition fails in the long run, directions and nodes are those of the finite horizon.
    """
    from matplotlib.figure import Figure

    rows = 3 if report.sweeps else 2
    figure = Figure(figsize=(13.2, 4.6 * rows), dpi=150, layout="constrained", facecolor="white")
    grid = figure.add_gridspec(rows, 2)
    _over_time(figure.add_subplot(grid[0, 0]), report)
    _direction(figure.add_subplot(grid[0, 1]), report)
    _nodes(figure.add_subplot(grid[1, 0]), report)
    _traces(figure.add_subplot(grid[1, 1]), report)
    if report.sweeps:
        _sweeps(figure.add_subplot(grid[2, :]), report.sweeps)
    verdict = "holds" if report.main.holds else "does not hold"
    scope = "every k" if report.main.horizon is None else f"k = 0..{report.main.horizon}"
    name = (report.network.name or "sensor network").replace("$", r"\$")
    title = f"{name}: robust collective observability ({report.main.form} form) {verdict} for {scope}"
    figure.suptitle(title, color=INK, fontsize=13)
    return figure


def _over_time(axes: Axes, report: ObservabilityReport) -> None:
    """alpha of each form by the start of the window; dots at the right are the limit, empty ones are zero."""
    largest = max(float(found.alpha_over_time.max(initial=0.0)) for found in report.forms.values())
    floor = max(largest, 1e-300) * _LEAST
    for form, found in report.forms.items():
        alpha = found.alpha_over_time
        if len(alpha) == 1:
            axes.axhline(max(float(alpha[0]), floor), color=COLOURS[form], linewidth=2.2, label=form)
            continue
        axes.plot(
            np.maximum(alpha, floor), color=COLOURS[form], linewidth=2.2, label=f"{form}, window {found.window}"
        )
        if found.alpha_limit is not None:
            limit = float(found.alpha_limit.min())
            axes.plot(
                len(alpha) * 1.02,
                max(limit, floor),
                "o",
                color=COLOURS[form],
                markerfacecolor=COLOURS[form] if limit > 0 else "white",
                markersize=8,
            )
    if largest > 0:
        axes.set_yscale("log")
    dress(axes, "what a window says at least (dot: every later one; empty: nothing)", "first instant k", r"$\alpha$")
    axes.legend(frameon=False, labelcolor=INK)


def _direction(axes: Axes, report: ObservabilityReport) -> None:
    """Components of the weakest direction, and alpha with one more sensor of each state."""
    found = report.ranked
    order = np.argsort(-np.abs(found.weakest_direction), kind="stable")[:20]
    names = [found.state_names[j] for j in order]
    place = np.arange(len(order))
    axes.bar(place - 0.2, np.abs(found.weakest_direction[order]), 0.38, color=COLOURS["sharp"], label="|component|")
    axes.set_xticks(place, names, parse_math=False)
    axes.set_ylim(0, 1.05)
    scope = "every k" if found.horizon is None else f"k = 0..{found.horizon}"
    dress(axes, f"weakest direction ({scope}), and what one more sensor of a state gives", "state", "|component|")
    other = axes.twinx()
    other.bar(place + 0.2, found.alpha_with_state[order], 0.38, color=COLOURS["stated"], label="one more sensor")
    other.axhline(found.alpha, color=INK, linewidth=1.0, linestyle="--", label="as it is")
    other.set_ylabel(r"$\alpha$", color=INK)
    other.spines[["top", "left"]].set_visible(False)
    other.tick_params(colors=INK, labelsize=9)
    other.margins(y=0.25)
    handles = [*axes.get_legend_handles_labels()[0], *other.get_legend_handles_labels()[0]]
    other.legend(handles=handles, frameon=False, labelcolor=INK, loc="upper right", ncols=3, fontsize=9)


def _nodes(axes: Axes, report: ObservabilityReport) -> None:
    """alpha without each node, alone, and with one more like it."""
    found, network = report.ranked, report.network
    series = {
        "without it": (found.alpha_without_node, "#d1495b"),
        "with one more like it": (found.alpha_with_copy, "#66c2a5"),
        "alone": (found.alpha_of_node, "#9aa5b1"),
    }
    place = np.arange(network.N)
    if network.N <= ONE_BY_ONE_UP_TO:
        for number, (label, (values, colour)) in enumerate(series.items()):
            axes.bar(place + 0.27 * (number - 1), values, 0.25, color=colour, label=label)
        small = 9 if network.N <= 20 else 6
        tilt = 60 if network.names else 0 if network.N <= 20 else 90
        axes.set_xticks(
            place, [network.label(i) for i in range(network.N)], fontsize=small, parse_math=False, rotation=tilt
        )
    else:
        for label, (values, colour) in series.items():
            axes.plot(np.sort(values), color=colour, linewidth=2, label=label)
    axes.axhline(found.alpha, color=INK, linewidth=1.0, linestyle="--", label="the network as it is")
    top = max(float(np.max(values)) for values, _ in series.values())
    axes.set_ylim(0, 1.3 * max(top, found.alpha) or 1.0)
    across = "node" if network.N <= ONE_BY_ONE_UP_TO else "nodes, sorted"
    dress(axes, f"which nodes matter (window {found.window})", across, r"$\alpha$")
    axes.legend(frameon=False, labelcolor=INK, ncols=2, loc="upper right", fontsize=9)


def _traces(axes: Axes, report: ObservabilityReport) -> None:
    """tr P of every node in the steady state; bars span its phases where it is periodic."""
    network = report.network
    answered = {channel: each for channel, each in report.steady.items() if each.status == Status.OK}
    place = np.arange(network.N)
    for channel, each in answered.items():
        trace = each.trace
        order = place if network.N <= ONE_BY_ONE_UP_TO else np.argsort(trace.mean(axis=0))
        mean, low, high = trace.mean(axis=0)[order], trace.min(axis=0)[order], trace.max(axis=0)[order]
        style = "o" if network.N <= ONE_BY_ONE_UP_TO else "-"
        axes.plot(place, mean, style, color=CHANNELS[channel], label=WORDS[channel], markersize=6)
        axes.vlines(place, low, high, color=CHANNELS[channel], linewidth=2, alpha=0.5)
    if answered:
        axes.set_ylim(bottom=0)
        axes.legend(frameon=False, labelcolor=INK)
    else:
        why = next((f"{each.status}" for each in report.steady.values()), "functions of k")
        axes.text(0.5, 0.5, f"no steady state: {why}", ha="center", transform=axes.transAxes, color=INK)
        axes.set_yticks([])
        axes.set_xlim(0, max(network.N - 1, 1))
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    across = "node" if network.N <= ONE_BY_ONE_UP_TO else "nodes, sorted"
    dress(axes, "what the filter settles on: bound on the error variance", across, r"tr $P_i$")


def _sweeps(axes: Axes, sweeps: Sequence[Sweep]) -> None:
    """Mean tr P over each sweep, the parameter scaled to the largest value where several are drawn."""
    several = len(sweeps) > 1
    for sweep, colour in zip(sweeps, SWEEPS * 3, strict=False):
        values = np.array(sweep.values)
        scale = np.abs(values).max() or 1.0
        label = f"{sweep.parameter}{' times' if sweep.relative else ''}"
        label += f" (to {scale:g})" if several else ""
        axes.plot(values / scale if several else values, sweep.trace, "o-", color=colour, label=label, linewidth=2)
    across = "share of the largest value" if several else "value"
    dress(axes, "what the filter settles on, worst channels (gaps: on nothing)", across, "mean tr $P$")
    axes.legend(frameon=False, labelcolor=INK)
    axes.spines[["left", "bottom"]].set_color(LINKS)
