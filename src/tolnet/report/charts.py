"""Filters side by side in pictures: node by node, over time, and what Monte Carlo makes of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.model import Performance, Status, ToleranceTable, gamma_per
from tolnet.model.history import FILTERS, FilterHistory
from tolnet.model.simulation import Simulation
from tolnet.report.map import INK, LINKS
from tolnet.report.simulation import standing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {
    "KFC": "#9aa5b1",
    "RKFC": "#1f2933",
    "KFD": "#d1495b",
    "RKFDU": "#edae49",
    "RKFDNU": "#00798c",
    "RKFDNU2": "#66c2a5",
}
"""One colour a filter in every picture; they differ in lightness too."""
WIDTHS = dict(zip(COLOURS, (3.8, 3.0, 3.0, 2.2, 2.0, 1.2), strict=True))
"""Filters often agree: later ones are thinner, so that those beneath are seen at both sides."""
ONE_BY_ONE_UP_TO = 120
"""Up to this size nodes stand in their order and have marks of their own; beyond, sorted, as a curve."""
NAMED_UP_TO = 40
"""Names stand under the nodes of networks of at most this size."""
_LOGARITHMIC = 10.0
"""Positive values are drawn on a logarithmic scale where the largest is more than this many times the smallest."""


def performance_figure(
    table: ToleranceTable, steady: Mapping[str, Performance], histories: Mapping[str, FilterHistory]
) -> Figure:
    """MSD of every node by filter and, where they were followed over time, MSD, tolerances and thetas over time.

    Lines over time are means over the nodes, bands reach from the least to the largest node; dotted is the steady
    state. Tolerances are in the table's convention.
    """
    from matplotlib.figure import Figure

    nodes = {name: found.node_msd for name, found in steady.items()}
    if not histories:
        figure = Figure(figsize=(9.6, 5.6), dpi=150, layout="constrained", facecolor="white")
        node = figure.add_subplot()
    else:
        figure = Figure(figsize=(13.2, 9.2), dpi=150, layout="constrained", facecolor="white")
        msd, node, tolerance, theta = figure.subplots(2, 2).flat
        for name, history in histories.items():
            _line(msd, name, _decibels(history.msd))
            _rest_at(msd, name, steady[name].msd, ":")
            if history.kind.ball != "none":
                _band(tolerance, name, history.tolerance / gamma_per(table.convention))
                _band(theta, name, history.theta)
        dress(msd, "mean over the nodes (dotted: steady state)", "step t", "MSD [dB]")
        dress(tolerance, "tolerances: mean and range over the nodes", "step t", f"$c_{{k,t}}$ ({table.convention})")
        dress(theta, "risk sensitivities: mean and range over the nodes", "step t", r"$\theta_{k,t}$")
        _scale(theta)
    _nodes(node, table, nodes)
    dress(node, "node by node, in the steady state (dashed: centralised)", _across(table), "MSD$_k$ [dB]")
    status = {name: found.status for name, found in steady.items()}
    _finish(figure, table, "mean square deviation under the least favourable model", status)
    return figure


def simulation_figure(table: ToleranceTable, found: Mapping[str, Simulation]) -> Figure:
    """What Monte Carlo measured beside what was predicted, over time and node by node, and how honest each V is.

    Bands are 95 % intervals; dotted is the prediction; the consistency would be 95 % (dashed) if each filter's errors
    were as large as it thinks.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.2, 9.2), dpi=150, layout="constrained", facecolor="white")
    mse, ratio, node, consistency = figure.subplots(2, 2).flat
    for name, each in found.items():
        _line(mse, name, _decibels(each.mse))
        mse.plot(_decibels(each.bound), color=COLOURS[name], linewidth=1.2, linestyle=":")
        predicted = np.where(each.bound > 0, each.bound, np.nan)
        _line(ratio, name, each.mse / predicted)
        low, high = (each.interval / predicted[:, None]).T
        ratio.fill_between(np.arange(len(low)), low, high, color=COLOURS[name], alpha=0.16, linewidth=0)
        _line(consistency, name, 100 * each.consistency)
    for axes, level in ((ratio, 1.0), (consistency, 95.0)):
        axes.axhline(level, color=INK, linewidth=1.0, linestyle="--", zorder=1)
    _nodes(node, table, {name: each.node_mse[-1] for name, each in found.items()})
    dress(mse, "mean over the nodes (dotted: predicted)", "step t", "MSE [dB]")
    dress(ratio, "measured over predicted, with 95 % intervals", "step t", "MSE / MSD")
    dress(node, "node by node, after the last step (dashed: centralised)", _across(table), "MSE$_k$ [dB]")
    dress(consistency, "errors within the 95 % ellipsoid of the filter's own V", "step t", "% of runs and nodes")
    one = next(iter(found.values()))
    status = {name: standing(each)[0] for name, each in found.items()}
    _finish(figure, table, f"{one.runs:,} runs under the least favourable model, seed {one.seed}", status)
    return figure


def _nodes(axes: Axes, table: ToleranceTable, nodes: Mapping[str, Float[ndarray, " K"]]) -> None:
    """What every node has of each filter; a centralised filter is a line, since it has one value for all."""
    network = table.network
    one_by_one = network.N <= ONE_BY_ONE_UP_TO
    for name, values in nodes.items():
        if FILTERS[name].centralised:
            _rest_at(axes, name, float(values[0]), "--")
        elif one_by_one:
            axes.plot(_decibels(values), "o-", color=COLOURS[name], linewidth=0.8, markersize=3 * WIDTHS[name])
        else:
            _line(axes, name, np.sort(_decibels(values)))
    if network.N <= NAMED_UP_TO:
        labels = [network.label(k) for k in range(network.N)]
        tilt = 0 if network.names is None else 60
        axes.set_xticks(range(network.N), labels, fontsize=8, parse_math=False, rotation=tilt)


def _line(axes: Axes, name: str, values: Float[ndarray, " T"], start: int = 0) -> None:
    """One filter in its colour."""
    t = np.arange(start, start + len(values))
    axes.plot(t, values, color=COLOURS[name], linewidth=WIDTHS[name], linestyle=_style(name))


def _style(name: str) -> Literal["-", "--"]:
    """RKFDNU2 joins RKFDNU: dashed, so that both are seen."""
    return "--" if name == "RKFDNU2" else "-"


def _decibels(values: ndarray) -> ndarray:
    """10 log10; nothing is drawn for zero."""
    return np.asarray(10 * np.log10(np.where(values > 0, values, np.nan)))


def dress(axes: Axes, title: str, x: str, y: str) -> None:
    """Titles, and lines that stay behind the data."""
    axes.set_title(title, color=INK, fontsize=11, loc="left")
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(LINKS)
    axes.tick_params(which="both", colors=INK, labelsize=9)
    axes.grid(axis="y", color=LINKS, alpha=0.25, linewidth=0.7)
    axes.set_axisbelow(True)


def _finish(figure: Figure, table: ToleranceTable, what: str, status: Mapping[str, Status]) -> None:
    """A title, and one legend for all that the figure holds."""
    from matplotlib.lines import Line2D

    problem = (table.network.name or "sensor network").replace("$", r"\$")
    figure.suptitle(f"{problem}: {what}, c = {table.tolerance:g} ({table.convention})", color=INK, fontsize=13)
    handles = [Line2D([], [], color=COLOURS[name], linewidth=2.6, linestyle=_style(name)) for name in status]
    labels = [name if how == Status.OK else f"{name} ({how})" for name, how in status.items()]
    figure.legend(
        handles, labels, loc="outside lower center", ncols=min(len(labels), 6), frameon=False, labelcolor=INK
    )


def _across(table: ToleranceTable) -> str:
    """What stands below nodes."""
    return "node" if table.network.N <= ONE_BY_ONE_UP_TO else "nodes, sorted for each filter"


def _rest_at(axes: Axes, name: str, value: float, style: Literal["--", ":"]) -> None:
    if value > 0:
        level = float(_decibels(np.array(value)))
        axes.axhline(level, color=COLOURS[name], linewidth=WIDTHS[name] / 1.8, linestyle=style, zorder=1)


def _band(axes: Axes, name: str, values: Float[ndarray, "T K"]) -> None:
    """The mean over the nodes, and their range around it."""
    _line(axes, name, values.mean(axis=1), start=1)
    if values.shape[1] > 1:
        t, low, high = np.arange(1, len(values) + 1), values.min(axis=1), values.max(axis=1)
        axes.fill_between(t, low, high, color=COLOURS[name], alpha=0.16, linewidth=0)


def _scale(axes: Axes) -> None:
    """A logarithmic scale where the values are positive and far apart."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    values = np.concatenate([np.empty(0), *(np.asarray(line.get_ydata(), dtype=float) for line in axes.lines)])
    values = values[np.isfinite(values)]
    if values.size and values.min() > 0 and values.max() > _LOGARITHMIC * values.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
