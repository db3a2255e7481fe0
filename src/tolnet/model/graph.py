"""The graph: who hears whom, as a sparse matrix with self-loops; and the diffusion matrix on it, eq. (11)."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Int
from numpy import ndarray
from scipy import sparse

from tolnet.model._checks import Complaints, by, counted, frozen, nearest, numbers, shown, there_are

DIFFUSION_RULES = (
    "relative-degree",
    "uniform",
    "metropolis",
    "laplacian",
    "none",
    "relative-variance",
    "covariance-intersection",
)
"""The names that `diffusion.rule` takes; the first is the default."""

COLUMN_SUM_TOLERANCE = 1e-9


def parse_adjacency(
    adjacency: Any, edges: Any, directed: bool, N: int, complaints: Complaints
) -> tuple[bool, sparse.csr_array | None]:
    """`directed`, and the N x N boolean adjacency with self-loops, from edges, a matrix or a networkx graph.

    [l, k] says that node k hears node l, so an edge [from, to] is the entry [from, to]. A matrix that is not
    symmetric makes the graph directed. Parallel edges of a networkx multigraph are one link; nodes that are whole
    numbers stand in rising order, others in the graph's own. None, with a complaint, for what is no graph of N nodes:
    nothing can be held against it then.
    """
    if adjacency is not None and edges is not None:
        complaints.add("network", "has both edges and adjacency; exactly one was expected")
    if edges is not None:
        return directed, adjacency_of_edges(edges, directed, N, complaints)
    if adjacency is None:
        if N > 1:
            complaints.add("network", "has neither edges nor a graph; exactly one was expected")
        return directed, _pattern(_NO_LINKS, N) if N == 1 else None
    if hasattr(adjacency, "is_directed"):
        from tolnet.model.convert import links_of_graph

        if len(adjacency) != N:
            complaints.add(
                "network", f"has a graph of {counted(len(adjacency), 'node')}; {there_are(N, 'sensor')}", shape=True
            )
            return directed, None
        directed = adjacency.is_directed()
        links = links_of_graph(adjacency)
        return directed, _pattern(links if directed else np.concatenate([links, links[:, ::-1]]), N)
    links = _links_of_matrix(adjacency, N, complaints)
    if links is None:
        return directed, None
    matrix = _pattern(links, N)
    return directed or bool((matrix != matrix.T).nnz), matrix


def _links_of_matrix(adjacency: Any, N: int, complaints: Complaints) -> Int[ndarray, "E 2"] | None:
    """Where a dense or sparse N x N matrix is not zero; None, with a complaint, if it is not that."""
    key = "network.adjacency"
    if not sparse.issparse(adjacency):
        adjacency = numbers(adjacency)
    if adjacency.dtype.kind not in "biuf" or adjacency.ndim != 2:
        complaints.add(key, "is no matrix of numbers and no networkx graph")
        return None
    if adjacency.shape != (N, N):
        complaints.add(key, f"is {by(adjacency.shape)}; {there_are(N, 'sensor')}", shape=True)
        return None
    entries = sparse.coo_array(adjacency)
    if not np.isfinite(entries.data).all():
        complaints.add(key, "has a value that is not a finite number")
        return None
    linked = entries.data != 0
    return np.stack([entries.row[linked], entries.col[linked]], axis=1).astype(np.int64)


def adjacency_of_edges(edges: Any, directed: bool, N: int, complaints: Complaints) -> sparse.csr_array | None:
    """The adjacency of an (E, 2) list of links; None, with complaints, about strangers, or if it is not that.

    Links that are given twice are complained about too.
    """
    key = "network.edges"
    pairs = numbers(edges)
    if pairs.size == 0 and pairs.dtype != object:
        pairs = _NO_LINKS
    if pairs.ndim != 2 or pairs.shape[-1] != 2 or pairs.dtype.kind not in "iu":
        complaints.add(key, "is not a list of pairs of node indices")
        return None
    strange = ((pairs < 0) | (pairs >= N)).any(axis=1)
    strangers, others = np.flatnonzero(strange), np.flatnonzero(~strange)
    if strangers.size:
        each = ((f"{key}[{e}]", f"is {pairs[e].tolist()}; nodes are numbered from 0 to {N - 1}") for e in strangers)
        complaints.add_each(each, strangers.size)
    pairs = pairs.astype(np.int64)
    links = pairs if directed else np.sort(pairs, axis=1)
    _check_repeats(links[others], others, pairs, N, complaints)
    if strangers.size:
        return None
    return _pattern(pairs if directed else np.concatenate([pairs, pairs[:, ::-1]]), N)


def _check_repeats(
    links: Int[ndarray, "F 2"], where: Int[ndarray, " F"], pairs: Int[ndarray, "E 2"], N: int, complaints: Complaints
) -> None:
    """Complain about each of `links`, found at `where` among `pairs`, that an earlier one gave."""
    code = links[:, 0] * N + links[:, 1]
    ordered = np.sort(code)
    if not (ordered[1:] == ordered[:-1]).any():
        return
    _, first, inverse = np.unique(code, return_index=True, return_inverse=True)
    repeats = np.flatnonzero(first[inverse] != np.arange(len(code)))
    each = (
        (
            f"network.edges[{where[i]}]",
            f"is {pairs[where[i]].tolist()}, which edges[{where[first[inverse[i]]]}] already gave",
        )
        for i in repeats
    )
    complaints.add_each(each, repeats.size)


_NO_LINKS = frozen(np.empty((0, 2), dtype=np.int64))


def _pattern(links: Int[ndarray, "E 2"], N: int) -> sparse.csr_array:
    """The boolean N x N matrix of links and self-loops, indices sorted, arrays read-only."""
    own = np.arange(N)
    row, column = np.concatenate([links[:, 0], own]), np.concatenate([links[:, 1], own])
    matrix = sparse.coo_array((np.ones(len(row), dtype=bool), (row, column)), shape=(N, N)).tocsr()
    return read_only(matrix)


def read_only(matrix: sparse.csr_array) -> sparse.csr_array:
    """The same matrix in canonical form, its arrays read-only from now on."""
    matrix.sum_duplicates()
    for part in (matrix.data, matrix.indices, matrix.indptr):
        part.setflags(write=False)
    return matrix


def links_of(adjacency: sparse.csr_array, directed: bool) -> Int[ndarray, "E 2"]:
    """The links [from, to] without self-loops, sorted; each undirected one once, its smaller node first."""
    own = adjacency.tocoo()
    wanted = own.row != own.col if directed else own.row < own.col
    return np.stack([own.row[wanted], own.col[wanted]], axis=1).astype(np.int64)


def parse_diffusion(
    diffusion: Any, adjacency: sparse.csr_array | None, N: int, complaints: Complaints
) -> str | sparse.csr_array:
    """The name of a rule, known to exist; or a matrix W checked against the graph, where there is one, eq. (11)."""
    default = DIFFUSION_RULES[0]
    if isinstance(diffusion, str):
        if diffusion not in DIFFUSION_RULES:
            rules = ", ".join(DIFFUSION_RULES)
            hint = f"did you mean {nearest(diffusion, DIFFUSION_RULES)!r}? The rules are {rules}"
            complaints.add("diffusion.rule", f"is {shown(diffusion)}; {hint}")
        return diffusion
    key = "diffusion.weights"
    if not sparse.issparse(diffusion):
        diffusion = numbers(diffusion)
    if diffusion.dtype.kind not in "iuf" or diffusion.ndim != 2:
        complaints.add(key, "is not an N x N matrix of numbers")
        return default
    if diffusion.shape != (N, N):
        complaints.add(key, f"is {by(diffusion.shape)}; {there_are(N, 'node')}", shape=True)
        return default
    W = sparse.csr_array(diffusion, dtype=np.float64, copy=True)
    W.sum_duplicates()
    W.eliminate_zeros()
    _check_weights(W, adjacency, key, complaints)
    return read_only(W)


def weights_of_triples(triples: ndarray, N: int, key: str, complaints: Complaints) -> sparse.csr_array | None:
    """W from an M x 3 array with one row `l, k, w` for each weight; None, with a complaint, if it is not that."""
    if triples.ndim != 2 or triples.shape[1] != 3 or triples.dtype.kind not in "iuf":
        complaints.add(key, "is no M x 3 array of numbers, a row `l, k, weight` for each")
        return None
    places = triples[:, :2]
    if not ((places >= 0) & (places < N) & (places == np.floor(places))).all():
        complaints.add(key, f"has a place that is no node; nodes are numbered from 0 to {N - 1}")
        return None
    l, k = places.T.astype(np.int64)
    if len(np.unique(l * N + k)) < len(triples):
        complaints.add(key, "gives a weight twice")
        return None
    return sparse.csr_array(sparse.coo_array((triples[:, 2].astype(float), (l, k)), shape=(N, N)))


def _check_weights(W: sparse.csr_array, adjacency: sparse.csr_array | None, key: str, complaints: Complaints) -> None:
    """Complain about weights that are no numbers >= 0, that weigh a stranger, or whose columns do not sum to one."""
    own = W.tocoo()
    bad = np.flatnonzero(~np.isfinite(own.data) | (own.data < 0))
    each = (
        (f"{key}[{own.row[i]}][{own.col[i]}]", f"is {float(own.data[i])}; a finite number >= 0 was expected")
        for i in bad
    )
    complaints.add_each(each, bad.size)
    if adjacency is not None:
        weighed = sparse.csr_array((np.ones(W.nnz, dtype=bool), W.indices, W.indptr), shape=W.shape)
        strangers = sparse.coo_array(weighed > adjacency)
        each = (
            (f"{key}[{l}][{k}]", f"weighs node {l} at node {k}, which does not hear it")
            for l, k in zip(strangers.row, strangers.col, strict=True)
        )
        complaints.add_each(each, strangers.nnz)
    if not bad.size:
        sums = np.bincount(own.col, weights=own.data, minlength=len(W.indptr) - 1)
        off = np.flatnonzero(np.abs(sums - 1) > COLUMN_SUM_TOLERANCE)
        each = ((key, f"has column {k} summing to {float(sums[k])!r}; 1 was expected") for k in off)
        complaints.add_each(each, off.size)
