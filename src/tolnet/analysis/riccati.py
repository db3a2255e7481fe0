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


def solve_riccati(A: Float[ndarray, "n n"], Q: Float[ndarray, "n n"], G: Float[ndarray, "K n n"]) -> RiccatiSolution:
    """Solve P = A P (I + G P)^-1 A' + Q for the stabilising P, with symmetric G = S - theta I that may be indefinite.

    Structured doubling from A_0 = A', G_0 = G, H_0 = Q:

        W = (I + G H)^-1,  A+ = A W A,  G+ = G + A W G A',  H+ = H + A' H W A,   H -> P quadratically.

    Assumes (A, Q) stabilisable and, for theta = 0, (A, S) detectable: without them it converges to a solution that
    is not the one wanted, so test first. For theta > 0 a breakdown shows as a NaN or large `residual`, and says that
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
        for step in range(1, MAX_DOUBLINGS + 1):
            WAG = stacked.solve(eye + Gj @ Hj, np.concatenate([Aj, Gj], axis=-1))
            WA, WG = WAG[..., :n], WAG[..., n:]
            growth = stacked.symmetric_part(Aj.mT @ (Hj @ WA))
            Gj = stacked.symmetric_part(Gj + Aj @ WG @ Aj.mT)
            Hj = Hj + growth
            Aj = Aj @ WA
            size, change = np.abs(Hj).max(axis=(-1, -2)), np.abs(growth).max(axis=(-1, -2))
            settled = change <= 1e-15 * size
            leaves = settled | ~np.isfinite(size) | (step == MAX_DOUBLINGS)
            if leaves.any():
                P[todo[leaves]], doublings[todo[leaves]] = Hj[leaves], step
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
    eigenvalues, _ = stacked.symmetric_eigen(P)
    with np.errstate(invalid="ignore"):
        nonnegative = eigenvalues[:, 0] >= -1e-10 * eigenvalues[:, -1]
        return nonnegative & (theta * eigenvalues[:, -1] < 1) & (residual < 1e-6)
