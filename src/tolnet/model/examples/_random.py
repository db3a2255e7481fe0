"""Geometric networks of any size."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.model.ambiguity import Ambiguity
from tolnet.model.errors import InputError
from tolnet.model.network import SensorNetwork

NEAREST = 7
"""Each node is linked to so many nearest ones and to those that count it among theirs: about 8 in all."""
STEP = 0.1


def random_network(
    nodes: int, seed: int | np.random.Generator, n: int = 4, *, tolerance: float = 0.02
) -> SensorNetwork:
    """A moving target seen by any number of nodes, spread uniformly over the unit square.

        x = [p; v],  x+ = [I 0.1 I; 0 I] x + sqrt(0.001) w,  y_k = [U_k 0] x + v_k,  v_k ~ N(0, s_k^2 I)

    p has ceil(n / 2) axes; for odd n the last of them has no velocity. The rows of U_k are random directions, as
    many as let any neighbourhood see every axis (almost surely), so that every local pair is detectable; one row
    for n = 4 and at least 2 nodes. s_k is drawn log-uniform from 0.5 to 2. A node is linked to its 7 nearest; parts
    that are still apart are then joined by their shortest links to the largest, so the graph is connected.
    Units: metres, seconds. Time and memory grow as N log N and N.
    Raises InputError for less than one node or one state.
    """
    if nodes < 1 or n < 1:
        raise InputError(f"{nodes} nodes and {n} states were asked for; at least 1 of each was expected")
    generator = np.random.default_rng(seed)
    axes, moving = (n + 1) // 2, n // 2
    positions = _strip_by_strip(generator.random((nodes, 2)))
    edges = _links(positions)
    heard = min(nodes, NEAREST + 1)
    p = -(-axes // heard)
    directions = generator.standard_normal((nodes, p, axes))
    C = np.zeros((nodes, p, n))
    C[:, :, :axes] = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    deviation = np.exp(generator.uniform(np.log(0.5), np.log(2.0), nodes))
    A = np.eye(n)
    A[range(moving), range(axes, n)] = STEP
    return SensorNetwork(
        A=A,
        B=np.sqrt(0.001) * np.eye(n),
        C=C,
        R=deviation[:, None, None] ** 2 * np.eye(p),
        edges=edges,
        states=[f"p{i + 1}" for i in range(axes)] + [f"v{i + 1}" for i in range(moving)],
        dt=STEP,
        positions=positions,
        name="random",
        description=f"{nodes} random nodes track a target",
        ambiguity=Ambiguity(tolerance),
        diffusion="relative-degree",
    )


def _strip_by_strip(positions: Float[ndarray, "N 2"]) -> Float[ndarray, "N 2"]:
    """The same points in an order in which most neighbours are close: memory is read faster so."""
    strip = np.floor(positions[:, 1] * np.sqrt(len(positions) / NEAREST))
    return positions[np.lexsort((positions[:, 0], strip))]


def _links(positions: Float[ndarray, "N 2"]) -> Int[ndarray, "E 2"]:
    """Each node with its nearest ones, then the shortest links that join every part to the largest; sorted."""
    from scipy.spatial import KDTree

    N = len(positions)
    if N == 1:
        return np.empty((0, 2), dtype=np.int64)
    k = min(NEAREST, N - 1)
    _, near = KDTree(positions).query(positions, k=k + 1)
    own = np.repeat(np.arange(N), k)
    # Coincident points may come before the node itself, which then is not the first of its own list.
    others = np.where(near == np.arange(N)[:, None], -1, near)
    others = np.take_along_axis(others, np.argsort(others < 0, axis=1, kind="stable"), axis=1)[:, :k].ravel()
    code = np.sort(np.minimum(own, others) * N + np.maximum(own, others))  # np.unique hashes, which takes longer
    edges = np.stack(np.divmod(code[np.diff(code, prepend=-1) > 0], N), axis=1)
    return np.concatenate([edges, _joints(positions, edges)])


def _joints(positions: Float[ndarray, "N 2"], edges: Int[ndarray, "E 2"]) -> Int[ndarray, "J 2"]:
    """For each connected part but the largest, the shortest link to the largest."""
    from scipy.sparse import csgraph
    from scipy.spatial import KDTree

    N = len(positions)
    graph = sparse.coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(N, N))
    _, part = csgraph.connected_components(graph, directed=False)
    largest = np.bincount(part).argmax()
    inside, outside = np.flatnonzero(part == largest), np.flatnonzero(part != largest)
    if not outside.size:
        return np.empty((0, 2), dtype=np.int64)
    distance, nearest = map(np.asarray, KDTree(positions[inside]).query(positions[outside]))
    order = np.lexsort((distance, part[outside]))
    _, first = np.unique(part[outside][order], return_index=True)
    chosen = order[first]
    return np.stack([inside[nearest[chosen]], outside[chosen]], axis=1)
