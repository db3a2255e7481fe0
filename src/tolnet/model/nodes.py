"""What every network has, whatever its model: nodes, the graph over which they talk, names and places."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.model import _checks as checks
from tolnet.model._checks import Complaints, frozen
from tolnet.model.graph import links_of, parse_adjacency, read_only


class Nodes:
    """The part of a network that is about its nodes and links; the fields are those of the class that inherits it."""

    rows: Int[ndarray, " N1"]
    adjacency: sparse.csr_array
    directed: bool
    positions: Float[ndarray, "N d"] | None
    names: tuple[str, ...] | None

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Copies and unpickled networks are as read-only as the first."""
        for value in state.values():
            if isinstance(value, ndarray):
                frozen(value)
            elif sparse.issparse(value):
                read_only(value)
        self.__dict__.update(state)

    @property
    def N(self) -> int:
        """Number of nodes."""
        return len(self.rows) - 1

    @property
    def links(self) -> Int[ndarray, "E 2"]:
        """The links [from, to] without self-loops, sorted; each undirected one once, its smaller node first."""
        return links_of(self.adjacency, self.directed)

    @cached_property
    def degree(self) -> Int[ndarray, " N"]:
        """n_k = |N_k|: how many nodes each node hears, itself included."""
        return frozen(np.bincount(self.adjacency.indices, minlength=self.N))

    def neighbours(self, k: int) -> Int[ndarray, " d"]:
        """The nodes that node k hears, itself included, in rising order."""
        heard = self._heard
        return heard.indices[heard.indptr[k] : heard.indptr[k + 1]].astype(np.int64)

    @cached_property
    def _heard(self) -> sparse.csr_array:
        heard = self.adjacency.T.tocsr()
        heard.sort_indices()
        return heard

    def label(self, k: int) -> str:
        """A node as people call it: its name where it has one, else its index."""
        return self.names[k] if self.names else str(k)


def parse_nodes(
    adjacency: Any,
    edges: Any,
    directed: bool,
    positions: Any,
    names: Any,
    N: int,
    complaints: Complaints,
) -> dict[str, Any]:
    """The graph and what hangs on its nodes; a networkx graph brings positions and names where none are given."""
    if hasattr(adjacency, "is_directed"):
        from tolnet.model.convert import names_of_graph, positions_of_graph

        positions = positions_of_graph(adjacency) if positions is None else positions
        names = names_of_graph(adjacency) if names is None else names
    directed, graph = parse_adjacency(adjacency, edges, directed, N, complaints)
    if positions is not None:
        meant = f"{N} x 2 (or x 3), a point for each node,"
        positions = checks.shaped(positions, (N, None), "network.positions", meant, complaints)
        if positions is not None and positions.shape[1] not in (2, 3):
            complaints.add("network.positions", f"is {checks.by(positions.shape)}; {meant} was expected", shape=True)
    names = checks.labels(names, N, "network.names", checks.there_are(N, "node"), complaints)
    checks.distinct(names, "network.names", complaints)
    return {
        "directed": directed,
        "adjacency": graph,
        "positions": positions,
        "names": names,
    }
