"""Designed weights in one picture: the network with its weights, and the MSD of every node before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.model import Diffusion
from tolnet.report.map import INK, LINKS, NAMES_UP_TO, draw_names, node_positions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, BOUND = "#9aa5b1", "#00798c", "#d1495b"
_ARROWS_UP_TO = 1500
_WIDEST = 4.5
_BEND = 0.16
_NEGLIGIBLE = 1e-3


def weights_figure(found: Diffusion) -> Figure:
    """Left: an arrow from l to k as wide as w_lk, nodes filled by w_kk; right: MSD_k before and after, and the bound.

    Links without weight are dotted. Above some thousand links arrows give way to lines.
    """
    from matplotlib.figure import Figure

    network = found.table.network
    figure = Figure(figsize=(13.6, 6.6), dpi=150, layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    xy = node_positions(network)
    left.set_axis_off()
    left.set_aspect("equal")
    _draw_weights(left, found, xy)
    own = found.W.diagonal()
    size = float(np.clip(60_000 / network.N, 4.0, 330.0))
    dots = left.scatter(
        *xy.T, c=own, s=size, cmap="viridis", vmin=0.0, vmax=1.0, edgecolors="white", linewidths=0.9, zorder=3
    )
    bar = figure.colorbar(dots, ax=left, shrink=0.75, pad=0.01, aspect=28)
    bar.set_label("own weight $w_{kk}$", color=INK)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    if network.N <= NAMES_UP_TO:
        draw_names(left, network, xy)
    left.margins(0.06)
    name = (network.name or "sensor network").replace("$", r"\$")
    left.set_title(f"{name}: weights $w_{{lk}}$, {found.objective} (arrow width)", color=INK, fontsize=12)
    _draw_nodes(right, found)
    return figure


def _draw_weights(axes: Axes, found: Diffusion, xy: Float[ndarray, "N 2"]) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.patches import FancyArrowPatch

    network = found.table.network
    J = network.adjacency.tocoo()
    links = J.row != J.col
    l, k = J.row[links], J.col[links]
    w = np.asarray(found.W[l, k]).ravel() if l.size else np.empty(0)
    idle = w < _NEGLIGIBLE
    unused = np.stack([xy[l[idle]], xy[k[idle]]], axis=1)
    axes.add_collection(
        LineCollection(list(unused), colors=LINKS, linewidths=0.7, linestyles=":", alpha=0.8, zorder=1)
    )
    if len(w) > _ARROWS_UP_TO:
        used = np.stack([xy[l[~idle]], xy[k[~idle]]], axis=1)
        axes.add_collection(
            LineCollection(
                list(used), colors=AFTER, linewidths=_WIDEST * w[~idle], alpha=0.5, zorder=2, rasterized=True
            )
        )
        return
    for weight, start, end in zip(w[~idle], xy[l[~idle]], xy[k[~idle]], strict=True):
        axes.add_patch(
            FancyArrowPatch(
                (float(start[0]), float(start[1])),
                (float(end[0]), float(end[1])),
                connectionstyle=f"arc3,rad={_BEND}",
                arrowstyle="-|>,head_length=3.2,head_width=1.6",
                shrinkA=7.0,
                shrinkB=7.0,
                linewidth=0.4 + _WIDEST * float(weight),
                color=AFTER,
                alpha=0.35 + 0.55 * float(weight),
                zorder=2,
            )
        )


def _draw_nodes(axes: Axes, found: Diffusion) -> None:
    """A bar from the MSD before to the MSD after for each node, worst first."""
    before, after = found.baseline_node_msd, found.node_msd
    network = found.table.network
    key = np.where(np.isfinite(before), before, after)
    order = np.argsort(-key, kind="stable")
    place = np.arange(network.N)
    with np.errstate(divide="ignore", invalid="ignore"):
        was, now, bound = (10 * np.log10(value) for value in (before[order], after[order], found.msd_bound))
    if np.isfinite(was).all() and np.isfinite(now).all():
        axes.vlines(place, was, now, colors=LINKS, linewidths=1.0, zorder=1)
    size = float(np.clip(1500 / network.N, 3.0, 40.0))
    axes.scatter(place, was, s=size, color=BEFORE, label=found.baseline_rule, zorder=2)
    designed = "optimised, with gains" if found.gains is not None else "optimised"
    axes.scatter(place, now, s=size, color=AFTER, label=designed, zorder=3)
    if np.isfinite(bound):
        axes.axhline(float(bound), color=BOUND, linewidth=1.2, label="centralised robust filter (bound)")
    if network.N <= NAMES_UP_TO:
        axes.set_xticks(place, labels=[network.label(k) for k in order.tolist()])
        axes.tick_params(axis="x", labelrotation=90, labelsize=7)
    axes.set_xlabel("node, worst before first")
    axes.set_ylabel("MSD [dB]")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#e4e7eb", linewidth=0.8)
    axes.set_axisbelow(True)
    told = found.objective in ("msd", "worst", "robust") and np.isfinite(found.gap_closed)  # else of another number
    closed = f", gap closed {found.gap_closed:.0%}" if told else ""
    axes.set_title(f"mean square deviation of every node{closed}", color=INK, fontsize=12)
    axes.figure.legend(loc="outside lower right", ncols=3, frameon=False, labelcolor=INK)
