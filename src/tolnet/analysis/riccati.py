"""The Riccati equation at fixed theta, by structured doubling (docs/mathematics.md, section 4)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from tolnet.analysis import stacked

MAX_DOUBLINGS = 64


class RiccatiSolution(NamedTuple):
    """P of every member of the stack, with its own relative residual."""

    P: Float[ndarray, "K n n"]
    residual: Float[ndarray, " K"]
    doublings: Int[ndarray, " K"]


def solve_riccati(
    A: Float[ndarray, "n n"],
    Q: Float[ndarray, "n n"],
    G: Float[ndarray, "K n n"],
    start: Float[ndarray, "n n"] | None = None,
) -> RiccatiSolution:
    """Solve P = A P (I + G P)^-1 A' + Q for the stabilising P, with symmetric G = S - theta I that may be indefinite.

    Structured doubling from A_0 = A', G_0 = G, H_0 = Q:

        W = (I + G H)^-1,  A+ = A W A,  G+ = G + A W G A',  H+ = H + A' H W A,   H -> P quadratically.

    H_j is the recursion after 2^j steps from P = 0. Another `start` P_0 > 0 is needed where modes outside the unit
    circle are not driven by Q, since they are never met from zero; the unknown is then X = P - P_0:

        X = F X (I + W G X)^-1 F' + (A W'P_0 A' + Q - P_0),   W = (I + G P_0)^-1,   F = A W'

    Assumes no undriven mode on the circle and, for theta = 0, (A, S) detectable: without them it converges to a
    solution that is not the one wanted, so test first. For theta > 0 a breakdown shows as a NaN or large `residual`, and says that
    theta is beyond what the branch allows. Residual: |right-hand side - P| / |P| in the Frobenius norm.
    Source: E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, Int. J. Control 77, 2004.
    """
    K, n = len(G), len(A)
    eye = np.eye(n)
    P = np.full((K, n, n), np.nan)
    doublings = np.zeros(K, dtype=np.int64)
    todo = np.arange(K)
    Aj, Gj = np.broadcast_to(A.T, (K, n, n)), G
    Hj = np.broadcast_to(Q, (K, n, n))
    with np.errstate(all="ignore"):
        if start is not None:
            W = stacked.solve(eye + G @ start, np.broadcast_to(eye, G.shape))
            Hj = stacked.symmetric_part(A @ W.mT @ start @ A.T + Q - start)
            Aj, Gj = W @ A.T, stacked.symmetric_part(W @ G)
        for step in range(1, MAX_DOUBLINGS + 1):
            WAG = stacked.solve(eye + Gj @ Hj, np.concatenate([Aj, Gj], axis=-1))
            WA, WG = WAG[..., :n], WAG[..., n:]
            growth = stacked.symmetric_part(Aj.mT @ (Hj @ WA))
            Gj = stacked.symmetric_part(Gj + Aj @ WG @ Aj.mT)
            Hj = Hj + growth
            Aj = Aj @ WA
            total = Hj if start is None else Hj + start
            size, change = np.abs(total).max(axis=(-1, -2)), np.abs(growth).max(axis=(-1, -2))
            settled = change <= 1e-15 * size
            leaves = settled | ~np.isfinite(size) | (step == MAX_DOUBLINGS)
            if leaves.any():
                P[todo[leaves]], doublings[todo[leaves]] = total[leaves], step
                stays = ~leaves
                todo, Aj, Gj, Hj = todo[stays], Aj[stays], Gj[stays], Hj[stays]
            if not todo.size:
                break
        residual = riccati_residual(A, Q, G, P)
    return RiccatiSolution(P, residual, doublings)


def riccati_residual(
    A: Float[ndarray, "n n"], Q: Float[ndarray, "n n"], G: Float[ndarray, "K n n"], P: Float[ndarray, "K n n"]
) -> Float[ndarray, " K"]:
    """|A P (I + G P)^-1 A' + Q - P| / |P|, inf where it cannot be formed."""
    right = A @ stacked.solve(np.eye(len(A)) + P @ G, P) @ A.T + Q
    size = stacked.norm(P)
    residual = stacked.norm(right - P) / np.where(size > 0, size, 1.0)
    return np.where(np.isfinite(residual), residual, np.inf)


def is_valid(
    P: Float[ndarray, "K n n"], theta: Float[ndarray, " K"], residual: Float[ndarray, " K"]
) -> Bool[ndarray, " K"]:
    """Whether P is a covariance on the wanted branch: an accurate solution, P >= 0 and theta lambda_max(P) < 1."""
    with np.errstate(invalid="ignore"):
        nonnegative = stacked.smallest_unit_eigenvalue(P) >= -1e-10
        return nonnegative & (theta * stacked.eigenvalues(P)[:, -1] < 1) & (residual < 1e-6)
