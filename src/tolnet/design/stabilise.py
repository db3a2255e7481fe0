"""Weights on the same graph that are stable, as near as can be found to proposed ones that are not.

    X_k - sum_l w_lk M_l X_l M_l' > 0 for every node k                                    (docs/mathematics.md, 11.2)

is linear in W for fixed X, and separates by node: the nearest admissible column is a small semidefinite program. It
is linear in X for fixed W. Alternating from W = I, which is always stable, never moves away from the proposal.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse
from scipy.sparse.linalg import norm

from tolnet.analysis.stability_candidates import block_candidate

_HALVINGS = 30
_ROUNDS = 12
_MARGIN = 0.01
_KEPT = 1e-3
"""Part of X_k that each semidefinite programme keeps free, so that the next X exists."""
_SETTLED = 1e-4
_ALTERNATES_UP_TO = 200
"""Nodes up to which semidefinite programmes are solved; beyond, the proposal is only mixed with I."""


class StableWeights(NamedTuple):
    """Weights near proposed ones that floating point finds stable, with what should prove it."""

    W: sparse.csr_array
    X: Float[ndarray, "N n n"]
    own_only: bool
    """Whether W = I, the last resort: no node listens to another's estimate."""
    margin: float
    """Of the inequality, as far as it was asked for or proved."""


def stabilise_weights(M: Float[ndarray, "N n n"], mixing: sparse.csr_array) -> StableWeights | None:
    """W near the proposed one (`mixing` is its transpose), and X that shows it stable block by block.

    The inequality keeps a margin of about 1 %: weights on the verge would be of no use to anybody.
    Assumes every M_k Schur and W nonnegative with columns that sum to one. None where nothing is proved even for I.
    """
    M = M * np.sqrt(1 + _MARGIN)
    N = len(M)
    proposed, eye = sparse.csr_array(mixing), sparse.csr_array(sparse.eye_array(N))

    def mixed(part: float) -> tuple[sparse.csr_array, Float[ndarray, "N n n"] | None]:
        W = sparse.csr_array(proposed * part + eye * (1 - part))
        return W, block_candidate(M, W)

    low, high = 0.0, 1.0
    best, X = mixed(0.0)
    if X is None:
        return None
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        W, found = mixed(middle)
        if found is None:
            high = middle
        else:
            low, best, X = middle, W, found
        if high - low < 1e-4 * high:
            break
    if N <= _ALTERNATES_UP_TO:
        starts = [(best, X)] + [(W, found) for W, found in map(mixed, (low / 2, low / 4, 0.0)) if found is not None]
        ends = [_alternated(M, proposed, W, start) for W, start in starts]
        best, X = min(ends, key=lambda end: _distance(end[0], proposed))
    apart = abs(best - eye)
    own_only = apart.nnz == 0 or bool(apart.max() < 1e-9)
    return StableWeights(sparse.csr_array(best.T), X, own_only, _MARGIN)


def _alternated(
    M: Float[ndarray, "N n n"], proposed: sparse.csr_array, W: sparse.csr_array, X: Float[ndarray, "N n n"]
) -> tuple[sparse.csr_array, Float[ndarray, "N n n"]]:
    """Nearest columns for fixed X, then X for these columns, as long as the distance shrinks."""
    distance = _distance(W, proposed)
    for _ in range(_ROUNDS):
        nearer = _nearest_columns(M, proposed, X)
        if nearer is None:
            break
        found = block_candidate(M, nearer)
        shrunk = _distance(nearer, proposed)
        if found is None or shrunk > distance:
            break
        done = distance - shrunk < _SETTLED * distance
        W, X, distance = nearer, found, shrunk
        if done:
            break
    return W, X


def _nearest_columns(
    M: Float[ndarray, "N n n"], proposed: sparse.csr_array, X: Float[ndarray, "N n n"]
) -> sparse.csr_array | None:
    """min |w - w0|^2 with w >= 0, sum w = 1, sum_l w_l M_l X_l M_l' <= (1 - kept) X_k, for every node k."""
    import cvxpy

    n = M.shape[1]
    moved = M @ X @ M.mT
    data = proposed.data.copy()
    for k in range(len(M)):
        own = slice(proposed.indptr[k], proposed.indptr[k + 1])
        l, w0 = proposed.indices[own], proposed.data[own]
        half = np.linalg.inv(np.linalg.cholesky(X[k]))
        images = half @ moved[l] @ half.T
        if np.linalg.eigvalsh(np.einsum("l,lij->ij", w0, images))[-1] <= 1 - _KEPT:
            continue
        w: Any = cvxpy.Variable(len(l), nonneg=True)
        total: Any = sum(w[i] * ((images[i] + images[i].T) / 2) for i in range(len(l)))
        constraints: Any = [cvxpy.sum(w) == 1, total << (1 - _KEPT) * np.eye(n)]
        problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(w - w0)), constraints)
        try:
            problem.solve(solver=cvxpy.CLARABEL)
        except cvxpy.SolverError:
            return None
        if w.value is None:
            return None
        column = np.maximum(w.value, 0.0)
        data[own] = column / column.sum()
    return sparse.csr_array((data, proposed.indices, proposed.indptr), shape=proposed.shape)


def _distance(W: sparse.csr_array, proposed: sparse.csr_array) -> float:
    return float(norm(W - proposed))
