"""The graph: who hears whom, as a sparse matrix with self-loops; and the diffusion matrix on it, eq. (11)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray
from scipy import sparse

from tolnet.model._checks import Complaints

COLUMN_SUM_TOLERANCE = 1e-9


def parse_adjacency(
    adjacency: Any, edges: Any, directed: bool, N: int, complaints: Complaints
) -> tuple[bool, sparse.csr_array]:
    """`directed`, and the N x N boolean adjacency with self-loops, from edges, a matrix or a networkx graph.

    [l, k] says that node k hears node l, so an edge [from, to] is the entry [from, to]. A matrix that is not
    symmetric makes the graph directed.
    """
    if adjacency is not None and edges is not None:
        complaints.add("network", "has both edges and adjacency; exactly one was expected")
    if edges is not None:
        return directed, adjacency_of_edges(edges, directed, N, complaints)
    if adjacency is None:
        complaints.add("network", "has no edges")
        return directed, with_self_loops(sparse.csr_array((N, N)))
    if hasattr(adjacency, "is_directed"):
        from tolnet.model.convert import adjacency_of_graph

        directed = adjacency.is_directed()
        adjacency = adjacency_of_graph(adjacency)
    try:
        matrix = sparse.csr_array(adjacency)
    except (TypeError, ValueError):
        complaints.add("network.adjacency", "is no matrix and no networkx graph")
        return directed, with_self_loops(sparse.csr_array((N, N)))
    if matrix.shape != (N, N):
        found = " x ".join(map(str, matrix.shape))
        complaints.add("network.adjacency", f"is {found}; there are {N} sensors", shape=True)
        return directed, with_self_loops(sparse.csr_array((N, N)))
    matrix = with_self_loops(matrix)
    return directed or bool((matrix != matrix.T).nnz), matrix


def adjacency_of_edges(edges: Any, directed: bool, N: int, complaints: Complaints) -> sparse.csr_array:
    """The adjacency of an (E, 2) list of links; complains about strangers and about links given twice."""
    key = "network.edges"
    pairs = np.asarray(edges) if np.size(edges) else np.empty((0, 2), dtype=np.int64)
    nothing = with_self_loops(sparse.csr_array((N, N)))
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype.kind not in "iu":
        complaints.add(key, "is not a list of pairs of node indices")
        return nothing
    pairs = pairs.astype(np.int64)
    strangers = np.flatnonzero(((pairs < 0) | (pairs >= N)).any(axis=1))
    for e in strangers:
        complaints.add(f"{key}[{e}]", f"is {pairs[e].tolist()}; nodes are numbered from 0 to {N - 1}")
    if strangers.size:
        return nothing
    sorted_pairs = pairs if directed else np.sort(pairs, axis=1)
    code = sorted_pairs[:, 0] * N + sorted_pairs[:, 1]
    _, first, inverse = np.unique(code, return_index=True, return_inverse=True)
    for e in np.flatnonzero(first[inverse] != np.arange(len(code))):
        complaints.add(f"{key}[{e}]", f"is {pairs[e].tolist()}, which edges[{first[inverse[e]]}] already gave")
    both = pairs if directed else np.concatenate([pairs, pairs[:, ::-1]])
    return with_self_loops(sparse.csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(N, N)))


def with_self_loops(matrix: sparse.csr_array) -> sparse.csr_array:
    """The boolean pattern of a matrix, its diagonal added, indices sorted, arrays read-only."""
    pattern = sparse.csr_array((matrix != 0).astype(np.int64) + sparse.eye_array(matrix.shape[0], dtype=np.int64))
    return _read_only(sparse.csr_array(pattern.astype(bool)))


def _read_only(matrix: sparse.csr_array) -> sparse.csr_array:
    matrix.sum_duplicates()
    matrix.sort_indices()
    for part in (matrix.data, matrix.indices, matrix.indptr):
        part.setflags(write=False)
    return matrix


def parse_diffusion(diffusion: Any, adjacency: sparse.csr_array, complaints: Complaints) -> str | sparse.csr_array:
    """The name of a rule as it is; a matrix W checked against the graph, eq. (11)."""
    if isinstance(diffusion, str):
        return diffusion
    key, N = "diffusion.weights", adjacency.shape[0]
    try:
        W = sparse.csr_array(diffusion, dtype=np.float64, copy=True)
    except (TypeError, ValueError):
        complaints.add(key, "is not an N x N matrix of numbers")
        return "relative-degree"
    if W.shape != (N, N):
        found = " x ".join(map(str, W.shape))
        complaints.add(key, f"is {found}; there are {N} nodes", shape=True)
        return "relative-degree"
    W.sum_duplicates()
    W.eliminate_zeros()
    coo = W.tocoo()
    at: ndarray = np.asarray(adjacency[coo.row, coo.col]).ravel().astype(bool)
    bad = ~np.isfinite(coo.data) | (coo.data < 0)
    for l, k, w in zip(coo.row[bad], coo.col[bad], coo.data[bad], strict=True):
        complaints.add(f"{key}[{l}][{k}]", f"is {w}; a finite number >= 0 was expected")
    for l, k in zip(coo.row[~at], coo.col[~at], strict=True):
        complaints.add(f"{key}[{l}][{k}]", f"weighs node {l} at node {k}, which does not hear it")
    if not bad.any():
        sums = np.asarray(W.sum(axis=0)).ravel()
        for k in np.flatnonzero(np.abs(sums - 1) > COLUMN_SUM_TOLERANCE):
            complaints.add(key, f"has column {k} summing to {float(sums[k])!r}; 1 was expected")
    return _read_only(W)
