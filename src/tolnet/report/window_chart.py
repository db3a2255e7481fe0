"""The choice of windows in a picture: trace against cost, and what every node gains."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tolnet.model.window_choice import WindowChoice
from tolnet.report.map import INK, LINKS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = ("#0b6aa8", "#e07b00", "#3a9a6b", "#9a6bb0", "#d1495b", "#edae49")
_NAMED_UP_TO = 60


def window_figure(choice: WindowChoice) -> Figure:
    """Left: mean tr P over solves, with all nodes alike one line a window length, node by node crosses; filled, or
    bold, where nothing cheaper is as good; a star is what was chosen. Right: tr P of every node, before and after.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.4, 5.2), dpi=150, layout="constrained", facecolor="white")
    front, node = figure.subplots(1, 2)
    _draw_front(front, choice)
    _draw_nodes(node, choice)
    name = (choice.network.name or "sensor network").replace("$", r"\$")
    budget = ", ".join(f"{key} ≤ {value:g}" for key, value in choice.budget.items()) or "no budget"
    figure.suptitle(
        f"{name}: windows for {budget}; {100 * choice.gain:.1f} % below Algorithm 1", color=INK, fontsize=13
    )
    return figure


def _draw_front(axes: Axes, choice: WindowChoice) -> None:
    lengths = sorted({point.window for point in choice.front if point.interval})
    for L, colour in zip(lengths, (*_COLOURS, *([LINKS] * len(lengths))), strict=False):
        points = sorted((p for p in choice.front if p.interval and p.window == L), key=lambda p: p.solves)
        x, y = [p.solves for p in points], [p.trace for p in points]
        label = f"L = {L} ({points[0].bytes:,} bytes per link)"
        axes.plot(x, y, color=colour, linewidth=5.0 / (1 + lengths.index(L)), label=label)
        faces = [colour if p.on_front else "white" for p in points]
        axes.scatter(x, y, c=faces, edgecolors=colour, s=42, zorder=3)
    _draw_mixtures(axes, choice)
    axes.axhline(choice.plain.trace, color=INK, linewidth=1.0, linestyle="--", label="Algorithm 1")
    chosen = [choice.rate], [choice.trace]
    axes.scatter(*chosen, marker="*", s=190, color="#d64545", zorder=4, label="chosen, node by node")
    costs = sorted({p.solves for p in choice.front if p.interval})
    least = min([p.solves for p in choice.mixtures if p.solving], default=costs[0])
    axes.set_xscale("symlog", linthresh=max(min(costs[0], least), 1e-12))
    axes.set_xticks(costs, [f"{cost:.3g}" for cost in costs])
    axes.minorticks_off()
    axes.legend(frameon=False, labelcolor=INK)
    per = "step" if choice.network.dt is None else "second"
    _dress(axes, "trace against cost (filled: on the front)", f"solves per {per} and node", "mean tr P")


def _draw_mixtures(axes: Axes, choice: WindowChoice) -> None:
    """What was tried node by node."""
    for on_front, alpha, label in ((False, 0.35, None), (True, 1.0, "node by node, on the front")):
        points = [p for p in choice.mixtures if p.on_front == on_front]
        x, y = [p.solves for p in points], [p.trace for p in points]
        axes.scatter(x, y, marker="x", s=26, linewidths=1.2, color=INK, alpha=alpha, zorder=3, label=label)


def _draw_nodes(axes: Axes, choice: WindowChoice) -> None:
    N = choice.network.N
    t = np.arange(N)
    order = t if N <= _NAMED_UP_TO else np.argsort(choice.plain.node_trace)
    style = "o" if N <= _NAMED_UP_TO else "-"
    before, after = choice.plain.node_trace[order], choice.node_trace[order]
    if N <= _NAMED_UP_TO:
        axes.vlines(t, after, before, color=LINKS, linewidth=1.2, zorder=1)
    axes.plot(t, before, style, color=INK, markersize=5, label="Algorithm 1")
    axes.plot(t, after, style, color="#d64545", markersize=5, label="chosen")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False, labelcolor=INK)
    across = "node" if N <= _NAMED_UP_TO else "nodes, sorted by Algorithm 1"
    _dress(axes, "node by node", across, "tr P")
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if N <= 12:
        axes.set_xticks(t, [choice.network.label(i) for i in range(N)], parse_math=False)


def _dress(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, color=INK, fontsize=11, loc="left")
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(LINKS)
    axes.tick_params(which="both", colors=INK, labelsize=9)
    axes.grid(axis="y", color=LINKS, alpha=0.25, linewidth=0.7)
    axes.set_axisbelow(True)
