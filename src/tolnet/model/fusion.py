"""The fusion weights a_ij: row i says how node i weighs the pairs that it receives, row sums are one."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from tolnet.model._checks import Complaints, by, nearest, numbers, shown
from tolnet.model.graph import read_only

FUSION_RULES = ("uniform", "metropolis")
"""The names that `fusion.rule` takes; the first is the default."""

ROW_SUM_TOLERANCE = 1e-9


def parse_fusion(fusion: Any, adjacency: sparse.csr_array, complaints: Complaints) -> sparse.csr_array:
    """a_ij of a rule, or a matrix of weights checked against the graph: positive exactly where i hears j.

        uniform      a_ij = 1 / |N_i|
        metropolis   a_ij = 1 / max(|N_i|, |N_j|) for j != i, and a_ii what is left

    `adjacency` [l, k] says that node k hears node l, so weights have the pattern of its transpose.
    """
    heard = sparse.csr_array(adjacency.T)
    if isinstance(fusion, str):
        if fusion not in FUSION_RULES:
            rules = ", ".join(FUSION_RULES)
            hint = f"did you mean {nearest(fusion, FUSION_RULES)!r}? The rules are {rules}"
            complaints.add("fusion.rule", f"is {shown(fusion)}; {hint}")
        return read_only(_by_rule(fusion, heard))
    key, N = "fusion.weights", len(adjacency.indptr) - 1
    if not sparse.issparse(fusion):
        fusion = numbers(fusion)
    if fusion.dtype.kind not in "iuf" or fusion.ndim != 2:
        complaints.add(key, "is not an N x N matrix of numbers")
    elif fusion.shape != (N, N):
        complaints.add(key, f"is {by(fusion.shape)}; there are {N} nodes", shape=True)
    else:
        weights = sparse.csr_array(fusion, dtype=np.float64, copy=True)
        weights.sum_duplicates()
        weights.eliminate_zeros()
        _check(weights, heard, key, complaints)
        return read_only(weights)
    return read_only(_by_rule(FUSION_RULES[0], heard))


def _by_rule(rule: str, heard: sparse.csr_array) -> sparse.csr_array:
    size = np.diff(heard.indptr)
    weights = sparse.coo_array(heard.astype(np.float64))
    i, j = weights.row, weights.col
    if rule == "metropolis":
        a = np.where(i == j, 0.0, 1.0 / np.maximum(size[i], size[j]))
        left = 1.0 - np.bincount(i, weights=a, minlength=len(size))
        a = np.where(i == j, left[i], a)
    else:
        a = 1.0 / size[i]
    return sparse.csr_array(sparse.coo_array((a, (i, j)), shape=heard.shape))


def _check(weights: sparse.csr_array, heard: sparse.csr_array, key: str, complaints: Complaints) -> None:
    """Complain about weights that are no numbers > 0 where a node hears, weigh a stranger, or do not sum to one."""
    own = weights.tocoo()
    bad = np.flatnonzero(~np.isfinite(own.data) | (own.data < 0))
    each = (
        (f"{key}[{own.row[e]}][{own.col[e]}]", f"is {float(own.data[e])}; a finite number >= 0 was expected")
        for e in bad
    )
    complaints.add_each(each, bad.size)
    given = sparse.csr_array((np.ones(weights.nnz, dtype=bool), weights.indices, weights.indptr), shape=weights.shape)
    strangers, missing = sparse.coo_array(given > heard), sparse.coo_array(heard > given)
    each = (
        (f"{key}[{i}][{j}]", f"weighs node {j} at node {i}, which does not hear it")
        for i, j in zip(strangers.row, strangers.col, strict=True)
    )
    complaints.add_each(each, strangers.nnz)
    each = (
        (
            f"{key}[{i}][{j}]",
            "is 0; a node weighs itself"
            if i == j
            else f"is 0; node {i} hears node {j}, so a number > 0 was expected",
        )
        for i, j in zip(missing.row, missing.col, strict=True)
    )
    complaints.add_each(each, missing.nnz)
    if not bad.size:
        sums = np.bincount(own.row, weights=own.data, minlength=len(weights.indptr) - 1)
        off = np.flatnonzero(np.abs(sums - 1) > ROW_SUM_TOLERANCE)
        each = ((f"{key}[{i}]", f"sums to {float(sums[i])!r}; 1 was expected") for i in off)
        complaints.add_each(each, off.size)
