"""Values of other libraries at the door: python-control plants and networkx graphs."""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.model._checks import Complaints
from tolnet.model.errors import InputError

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


def read_graphml(data: bytes) -> networkx.Graph:
    """The graph of a GraphML file, its nodes in the order of the file.

    Raises InputError for what is no GraphML, for a graph without nodes, and for an edge to a node that is not there.
    """
    from xml.etree import ElementTree

    import networkx

    malformed = (ElementTree.ParseError, networkx.NetworkXException, *_MALFORMED)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about attributes of no type and ports, of which nothing is read here
            graph = networkx.read_graphml(io.BytesIO(data))
        elements = ElementTree.fromstring(data).iter()
        declared = {element.get("id") for element in elements if str(element.tag).endswith("}node")}
    except malformed as error:
        raise InputError(f"is no GraphML: {error or type(error).__name__}") from None
    strangers = [node for node in graph if node not in declared]
    if strangers:
        raise InputError(f"has an edge to the node {strangers[0]!r}, which it does not have")
    if not len(graph):
        raise InputError("has no nodes")
    return graph


_MALFORMED = (AttributeError, LookupError, RecursionError, TypeError, ValueError)
"""What networkx raises on bytes that are no GraphML: it looks into elements without asking whether they are there."""


def links_of_graph(graph: networkx.Graph) -> Int[ndarray, "E 2"]:
    """The edges of a networkx graph as pairs of places in the order of its nodes; edge attributes are not read."""
    place = {node: i for i, node in enumerate(graph)}
    pairs = [(place[u], place[v]) for u, v in graph.edges()]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def positions_of_graph(graph: networkx.Graph) -> Float[ndarray, "N d"] | None:
    """Where the nodes are, from the attribute `pos` or from two attributes; None unless every node says so.

    The two are `x` and `y`, or `longitude` and `latitude`, whatever the case.
    """
    attributes = [{k.lower(): v for k, v in data.items() if isinstance(k, str)} for _, data in graph.nodes(data=True)]
    candidates = [[own.get("pos") for own in attributes]]
    candidates += [[[own.get(x), own.get(y)] for own in attributes] for x, y in _COORDINATES]
    for points in candidates:
        rows = [_point(point) for point in points]
        if all(rows) and len({len(row) for row in rows}) == 1:
            return np.array(rows)
    return None


_COORDINATES = (("x", "y"), ("longitude", "latitude"))


def names_of_graph(graph: networkx.Graph) -> tuple[str, ...] | None:
    """What the nodes are called: their attribute `name` or `label`, else themselves where they are text.

    None where neither is so for every node, or where the text is only the node's place.
    """
    for key in ("name", "label"):
        found = [data.get(key) for _, data in graph.nodes(data=True)]
        names = tuple(name for name in found if isinstance(name, str) and name)
        if len(names) == len(found):
            return names
    names = tuple(node for node in graph if isinstance(node, str))
    said = len(names) == len(graph) and any(node != str(i) for i, node in enumerate(names))
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
