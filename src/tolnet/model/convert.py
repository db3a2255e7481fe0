"""Values of other libraries at the door: python-control plants and networkx graphs."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.model._checks import Complaints

if TYPE_CHECKING:
    import networkx


def plant_matrices(plant: Any, B: Any, Q: Any, dt: Any, complaints: Complaints) -> tuple[Any, Any, Any]:
    """A, B and dt of a discrete-time `control.StateSpace`; B, Q and dt given beside it come first.

    The plant's input matrix is taken for the factor B of the process noise. A plant in continuous time, or
    whose time base is not said, is refused, since only its user can say how it is sampled.
    """
    base = plant.dt
    if base == 0 and base is not False:
        complaints.add("plant", "is a continuous-time system; sample it first: plant.sample(dt)")
    elif base is None and dt is None:
        complaints.add("plant", "does not say whether its time is discrete; give it a sampling time, or dt beside it")
    if dt is None and not isinstance(base, bool) and base:
        dt = base
    factor = plant.B if B is None and Q is None else B
    return plant.A, factor, dt


def nodes_of_graph(graph: networkx.Graph) -> list[Any]:
    """The nodes of a networkx graph in the order of the sensors.

    Nodes that are whole numbers, or text that spells them, stand in rising order: networkx keeps them as its edges
    happened to name them, and node 3 is the fourth sensor all the same. All others stand as the graph has them.
    """
    numbers = {node: _whole_number(node) for node in graph}
    whole = {node: number for node, number in numbers.items() if number is not None}
    return sorted(whole, key=whole.__getitem__) if len(whole) == len(numbers) else list(graph)


def _whole_number(node: Any) -> int | None:
    """The number that a node is or spells, in the one way that whole numbers are written."""
    if isinstance(node, str):
        return int(node) if _CANONICAL.fullmatch(node) else None
    return int(node) if isinstance(node, int | np.integer) and not isinstance(node, bool) else None


_CANONICAL = re.compile("0|[1-9][0-9]{0,17}")


def links_of_graph(graph: networkx.Graph) -> Int[ndarray, "E 2"]:
    """The edges of a networkx graph as pairs of places among `nodes_of_graph`; edge attributes are not read."""
    place = {node: i for i, node in enumerate(nodes_of_graph(graph))}
    pairs = [(place[u], place[v]) for u, v in graph.edges()]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def positions_of_graph(graph: networkx.Graph) -> Float[ndarray, "N d"] | None:
    """Where the nodes are, from the attribute `pos` or from two attributes; None unless every node says so.

    The two are `x` and `y`, or `longitude` and `latitude`, whatever the case.
    """
    attributes = [
        {k.lower(): v for k, v in graph.nodes[node].items() if isinstance(k, str)} for node in nodes_of_graph(graph)
    ]
    candidates = [[own.get("pos") for own in attributes]]
    candidates += [[[own.get(x), own.get(y)] for own in attributes] for x, y in _COORDINATES]
    for points in candidates:
        rows = [_point(point) for point in points]
        if all(rows) and len({len(row) for row in rows}) == 1:
            return np.array(rows)
    return None


_COORDINATES = (("x", "y"), ("longitude", "latitude"))


def names_of_graph(graph: networkx.Graph) -> tuple[str, ...] | None:
    """What the nodes are called: their attribute `name` or `label`, else themselves where they are text or numbers.

    None where neither is so for every node, or where the number is only the node's place. Attributes that two nodes
    share, as the labels of a drawing may, are no names.
    """
    nodes = nodes_of_graph(graph)
    for key in ("name", "label"):
        names = {name: None for node in nodes if isinstance(name := graph.nodes[node].get(key), str) and name}
        if len(names) == len(nodes):
            return tuple(names)
    names = tuple(str(node) for node in nodes if isinstance(node, str) or _whole_number(node) is not None)
    said = len(names) == len(nodes) and any(name != str(i) for i, name in enumerate(names))
    return names if said else None


def _point(value: Any) -> list[float]:
    """Two or three coordinates; nothing where they are not that. Text counts, since yEd writes x and y so."""
    if not isinstance(value, tuple | list | ndarray) or len(value) not in (2, 3):
        return []
    try:
        point = [float(x) for x in value]
    except (TypeError, ValueError, OverflowError):
        return []
    return point if np.isfinite(point).all() else []
