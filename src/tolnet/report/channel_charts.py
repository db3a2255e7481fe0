"""Filters over corrupted channels in pictures: over time, node by node, and how honest each one's P is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.model import CorruptedNetwork, Status
from tolnet.model.corrupted_simulation import CorruptedSimulation
from tolnet.report.map import INK, LINKS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {
    "DRKF": "#0b6aa8",
    "DRKF-SWF": "#66b3dd",
    "CKF": "#d1495b",
    "CKF-tau": "#edae49",
    "CRKF": "#1f2933",
    "CSGF": "#3a9a6b",
    "CSGF-tau": "#9bd34b",
    "DSEA-CP": "#9a6bb0",
}
"""One colour a filter in every picture."""
ONE_BY_ONE_UP_TO = 120
"""Up to this size nodes stand in their order; beyond, sorted for each filter."""


def channel_figure(network: CorruptedNetwork, found: Mapping[str, CorruptedSimulation]) -> Figure:
    """Mean square errors over time and node by node, beside each filter's own bound, and what the bounds are worth.

    Bands are 95 % intervals; dotted is the mean of tr P; node by node everything is the mean over the last fifth.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.2, 9.2), dpi=150, layout="constrained", facecolor="white")
    mse, node, nees, consistency = figure.subplots(2, 2).flat
    one = next(iter(found.values()))
    for name, each in found.items():
        colour, t = COLOURS[name], np.arange(each.steps + 1)
        mse.plot(t, _decibels(each.mse), color=colour, linewidth=2.0)
        mse.fill_between(t, *_decibels(each.interval).T, color=colour, alpha=0.16, linewidth=0)
        mse.plot(t, _decibels(each.bound), color=colour, linewidth=1.2, linestyle=":")
        consistency.plot(t, 100 * each.consistency, color=colour, linewidth=1.8)
        nees.plot(t, np.where(each.nees < np.inf, each.nees, np.nan), color=colour, linewidth=1.8)
        late = slice(-max(each.steps // 5, 1), None)
        _nodes(node, network, each, each.node_mse[late].mean(axis=0), "o-")
        _nodes(node, network, each, each.node_bound[late].mean(axis=0), ":")
    consistency.axhline(95, color=INK, linewidth=1.0, linestyle="--", zorder=1)
    nees.axhline(1, color=INK, linewidth=1.0, linestyle="--", zorder=1)
    nees.set_yscale("log")
    # what is rare and huge is told by the numbers; here it would flatten everything else
    tops = [np.quantile(_decibels(each.mse), 0.9) for each in found.values() if np.isfinite(each.mse).all()]
    if tops:
        mse.set_ylim(top=float(max(tops)) + 4)
    across = "node" if network.N <= ONE_BY_ONE_UP_TO else "nodes, sorted for each filter"
    _dress(mse, "mean over the nodes (dotted: tr P)", "step k", "MSE [dB]")
    _dress(node, "node by node, last fifth (dotted: tr P; dashed: centralised)", across, "MSE [dB]")
    _dress(nees, "squared error in the measure of P (an exact P: 1, a bound: below)", "step k", "NEES / n")
    _dress(consistency, "errors within the 95 % ellipsoid of the filter's own P", "step k", "% of runs and nodes")
    _finish(figure, f"{network.name or 'sensor network'}: {one.runs:,} runs, seed {one.seed}", found)
    return figure


def _nodes(axes: Axes, network: CorruptedNetwork, each: CorruptedSimulation, values: ndarray, style: str) -> None:
    colour, dotted = COLOURS[each.name], style == ":"
    if not np.isfinite(values).any():
        return
    if each.centralised:
        if not dotted:
            axes.axhline(float(_decibels(values)[0]), color=colour, linewidth=1.6, linestyle="--", zorder=1)
        return
    shown = values if network.N <= ONE_BY_ONE_UP_TO else np.sort(values)
    size = 4.0 if network.N <= ONE_BY_ONE_UP_TO else 0.0
    axes.plot(_decibels(shown), style, color=colour, linewidth=1.2, markersize=size)
    if network.N <= 12:
        axes.set_xticks(range(network.N), [network.label(i) for i in range(network.N)], parse_math=False)


def _decibels(values: Float[ndarray, "*T"]) -> Float[ndarray, "*T"]:
    """10 log10; nothing is drawn where there is no positive number."""
    return np.asarray(10 * np.log10(np.where(values > 0, values, np.nan)))


def _dress(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, color=INK, fontsize=11, loc="left")
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(LINKS)
    axes.tick_params(which="both", colors=INK, labelsize=9)
    axes.grid(axis="y", color=LINKS, alpha=0.25, linewidth=0.7)
    axes.set_axisbelow(True)


def _finish(figure: Figure, title: str, found: Mapping[str, CorruptedSimulation]) -> None:
    """A title, and one legend that also says who grows or diverges."""
    from matplotlib.lines import Line2D

    figure.suptitle(title.replace("$", r"\$"), color=INK, fontsize=13)
    labels = []
    for name, each in found.items():
        note = "diverges" if each.status != Status.OK else "grows" if each.grows else ""
        labels.append(f"{name} ({note})" if note else name)
    handles = [Line2D([], [], color=COLOURS[name], linewidth=2.6) for name in found]
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=len(found) if len(found) <= 5 else 4,
        frameon=False,
        labelcolor=INK,
    )
