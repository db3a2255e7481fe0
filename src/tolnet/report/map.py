"""A map of the network: nodes coloured by their tolerance, links beneath them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.model import SensorNetwork, ToleranceTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAMES_UP_TO = 60
"""Nodes are labelled in networks of at most this size."""
STRESSED_UP_TO = 300
"""Up to this size a network without positions is laid out by distances along links; beyond, by slow directions."""
MANY = 5_000
"""Above this size the nodes of a vector drawing are one picture."""
INK, LINKS, NO_ANSWER = "#1f2933", "#8d99a6", "#d64545"


def tolerance_map(table: ToleranceTable, *, seed: int = 0) -> Figure:
    """Draw the network with every node coloured by c_k, in the table's convention, and sized by its degree.

    Nodes stand at their positions (the first two coordinates), or where a layout drawn with `seed` puts them. A node
    without an answer is a red cross. Works for any size: names up to NAMES_UP_TO nodes, links as one collection.
    """
    from matplotlib.figure import Figure

    network = table.network
    xy = node_positions(network, seed)
    figure = Figure(figsize=(8.4, 6.6), dpi=150, layout="constrained", facecolor="white")
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.set_aspect("equal")
    _draw_links(axes, network, xy)
    _draw_nodes(figure, axes, table, xy)
    if network.N <= NAMES_UP_TO:
        draw_names(axes, network, xy)
    axes.margins(0.06)
    name = (network.name or "sensor network").replace("$", r"\$")
    c = f"c = {table.tolerance:g} ({table.convention})"
    axes.set_title(f"{name}: local tolerances $c_k$ for {c}", color=INK, fontsize=13)
    return figure


def _draw_links(axes: Axes, network: SensorNetwork, xy: Float[ndarray, "N 2"]) -> None:
    from matplotlib.collections import LineCollection

    l, k = _links(network)
    crowd = max(len(l) / 150, 1.0) ** 0.3
    lines = LineCollection(
        list(np.stack([xy[l], xy[k]], axis=1)),
        colors=LINKS,
        linewidths=1.2 / crowd,
        alpha=max(0.85 / crowd, 0.3),
        zorder=1,
        rasterized=len(l) > 20_000,
    )
    axes.add_collection(lines)


def _links(network: SensorNetwork) -> tuple[Int[ndarray, " E"], Int[ndarray, " E"]]:
    """The ends of every link, each link once."""
    upper = sparse.triu(network.adjacency + network.adjacency.T, k=1).tocoo()
    return upper.row, upper.col


def _draw_nodes(figure: Figure, axes: Axes, table: ToleranceTable, xy: Float[ndarray, "N 2"]) -> None:
    network, c = table.network, table.tolerances
    answered = table.local.settles & np.isfinite(c)
    size = _areas(network)
    order = np.flatnonzero(answered)
    order = order[np.argsort(-size[order], kind="stable")]  # small nodes stay visible on large ones
    if order.size:
        dots = axes.scatter(
            *xy[order].T,
            c=c[order],
            s=size[order],
            cmap="viridis",
            linewidths=0.0 if network.N > MANY else 0.9,
            edgecolors="white",
            zorder=2,
            rasterized=network.N > MANY,
        )
        bar = figure.colorbar(dots, ax=axes, shrink=0.82, pad=0.02, aspect=28)
        bar.set_label(f"local tolerance $c_k$ ({table.convention})", color=INK)
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    if not answered.all():
        count = int((~answered).sum())
        axes.scatter(
            *xy[~answered].T,
            marker="X",
            s=np.maximum(size[~answered], 14.0),
            c=NO_ANSWER,
            linewidths=0.6,
            edgecolors="white",
            zorder=3,
            label=f"no answer: {count:,} node{'' if count == 1 else 's'}",
        )
        axes.legend(loc="lower left", frameon=True, framealpha=0.9, edgecolor="none")


def _areas(network: SensorNetwork) -> Float[ndarray, " N"]:
    """Marker areas in square points: proportional to the degree, the whole within what N nodes have room for."""
    room = float(np.clip(60_000 / network.N, 1.5, 330.0))
    relative = network.degree / network.degree.max()
    return room * (0.3 + 0.7 * relative)


def draw_names(axes: Axes, network: SensorNetwork, xy: Float[ndarray, "N 2"]) -> None:
    """Names above the nodes; mere numbers inside them."""
    from matplotlib import patheffects

    above = network.names is not None
    halo = [patheffects.withStroke(linewidth=2.4, foreground="white" if above else "#0008")]
    radius = np.sqrt(_areas(network) / math.pi)
    for k in range(network.N):
        axes.annotate(
            network.label(k),
            (float(xy[k, 0]), float(xy[k, 1])),
            xytext=(0.0, float(radius[k]) + 2.0 if above else 0.0),
            textcoords="offset points",
            ha="center",
            va="bottom" if above else "center_baseline",
            fontsize=8.0 if above else 7.0,
            color=INK if above else "white",
            path_effects=halo,
            parse_math=False,
            zorder=4,
        )


def node_positions(network: SensorNetwork, seed: int = 0) -> Float[ndarray, "N 2"]:
    """Where the nodes are drawn, (N, 2)."""
    if network.positions is not None:
        given = network.positions
        return np.column_stack([given[:, 0], given[:, 1] if given.shape[1] > 1 else np.zeros(network.N)])
    if network.N <= 2:
        return np.column_stack([np.arange(network.N, dtype=float), np.zeros(network.N)])
    return _stressed(network, seed) if network.N <= STRESSED_UP_TO else _spectral(network, seed)


def _stressed(network: SensorNetwork, seed: int) -> Float[ndarray, "N 2"]:
    """Distances on paper like distances along links (Kamada and Kawai); parts that no link joins hang together.

    Starts from the slow directions of the graph, which untangles it.
    """
    import networkx

    graph = networkx.Graph()
    graph.add_nodes_from(range(network.N))
    graph.add_edges_from(np.stack(_links(network), axis=1).tolist())
    parts = sorted(networkx.connected_components(graph), key=len, reverse=True)
    graph.add_edges_from((min(parts[0]), min(part)) for part in parts[1:])
    start = dict(enumerate(_spectral(network, seed)))
    drawn = networkx.kamada_kawai_layout(graph, pos=start)
    return np.array([drawn[k] for k in range(network.N)])


def _spectral(network: SensorNetwork, seed: int) -> Float[ndarray, "N 2"]:
    """Two slow directions of a lazy random walk on the links, by power iteration, spread evenly by rank.

    Neighbours end near each other; it need not converge to do so, and costs one sparse product a step.
    """
    N = network.N
    J = (network.adjacency + network.adjacency.T).astype(float)
    degree = np.asarray(J.sum(axis=0)).ravel()
    x = np.random.default_rng(seed).normal(size=(N, 2))
    for _ in range(400):
        x = (x + J @ x / degree[:, None]) / 2
        x -= degree @ x / degree.sum()
        x[:, 1] -= x[:, 0] * (x[:, 0] * degree @ x[:, 1]) / (x[:, 0] * degree @ x[:, 0])
        x /= np.abs(x).max(axis=0)
    return np.argsort(np.argsort(x, axis=0), axis=0) / N
