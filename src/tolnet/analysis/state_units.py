"""Which states act on which, and units in which a plant's couplings are of size one.

The strong components of a matrix are the diagonal blocks of its block triangular form: its eigenvalues are theirs,
whatever stands between them. Only zeros make a component, so this is structure and not rounding.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import sparse
from scipy.linalg import matrix_balance
from scipy.sparse.csgraph import connected_components

UNIT = float(np.finfo(float).eps / 2)
_FARTHEST = 400  # powers of two between units beyond which products of scaled numbers could leave the doubles


def rounding(n: int) -> float:
    """What rounding does to an n x n matrix whose basis is turned, relative to its Frobenius norm: 4 n^1.5 u.

    T A T' has two products, each off by n u |X| |Y| (Higham, 2002, eq. 3.13), that is by n u sqrt(n) |A| where T is
    orthogonal; and T itself is orthogonal to as much, on either side.
    """
    return 4 * n**1.5 * UNIT


def components(A: ndarray) -> Int[ndarray, " n"]:
    """The strong component of every state in the graph of the entries of A other than zero."""
    return connected_components(sparse.csr_array(A != 0), connection="strong")[1].astype(np.int64)


def reachable(A: ndarray) -> Bool[ndarray, "n n"]:
    """Whether state j comes to act on state i after any number of steps, none included: at [i, j]."""
    reach = (A != 0) | np.eye(len(A), dtype=bool)
    while (further := reach @ reach).sum() > reach.sum():
        reach = further
    return reach


def unit_rows(M: Float[ndarray, "p n"]) -> Float[ndarray, "p n"]:
    """Every row with length one, a row of zeros as it is; no square leaves the doubles."""
    largest = np.abs(M).max(axis=1, initial=0.0, keepdims=True)
    M = M / np.where(largest > 0, largest, 1.0)
    return M / np.where(largest > 0, np.linalg.norm(M, axis=1, keepdims=True), 1.0)


def block_norms(M: Float[ndarray, "p n"], label: Int[ndarray, " n"]) -> Float[ndarray, "p J"]:
    """Euclidean norms of the piece of every row that belongs to each component."""
    largest = np.abs(M).max(axis=1, initial=0.0, keepdims=True)
    largest[largest == 0] = 1.0
    inside = label[:, None] == np.arange(label.max(initial=-1) + 1)
    pieces = np.where(inside, np.abs(M / largest)[:, :, None], 0.0)
    return largest * np.linalg.norm(pieces, axis=1)


def state_units(A: Float[ndarray, "n n"], C: Float[ndarray, "p n"]) -> Float[ndarray, " n"]:
    """Powers of two d for which d_j A_ij / d_i and, up to a factor a row, d_j C_ij are about of size one.

    Within a component the norms of rows and columns are balanced (Parlett and Reinsch, 1969); the units of the
    components against each other fit the logarithms of all couplings and rows by least squares. In whatever units A
    and C are given, the scaled matrices are the same up to the rounding to powers of two.
    """
    label = components(A)
    count, n = int(label.max(initial=-1)) + 1, len(A)
    d = np.ones(n)
    for J in range(count):
        own = np.flatnonzero(label == J)
        if len(own) > 1:
            d[own] = matrix_balance(A[np.ix_(own, own)], permute=False, separate=True)[1][0]
    couplings = np.zeros((count, count))
    np.maximum.at(couplings, label, block_norms(A * (d / d[:, None]), label))
    np.fill_diagonal(couplings, 0.0)
    rows = block_norms(C * d, label)
    # One unknown for a component and one for a row: log2 of what brings each coupling and each piece of a row to 1.
    sizes = np.concatenate([couplings, rows])
    to, of = np.nonzero(sizes)
    equations = np.zeros((len(to), count + len(C)))
    at = np.arange(len(to))
    equations[at, of] = 1.0
    equations[at, to] = -1.0
    fitted = np.linalg.lstsq(equations, -np.log2(sizes[to, of]), rcond=None)[0][:count]
    whole = np.clip(np.round(fitted), -_FARTHEST, _FARTHEST).astype(int)
    return np.ldexp(d, whole[label]) if len(to) else d
