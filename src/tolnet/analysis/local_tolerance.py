"""The local tolerance c_k: how much of the network's ambiguity a node sees through its own sensors (eqs. (30), (42)).

1.  only the state block of the least favourable covariance differs, by X = V - P >= 0
2.  P_k^loc = A (V^-1 + S_k)^-1 A' + Q, with the central V and the node's S_k
3.  c_k = tr(P_k^-1 X) - log det(I + P_k^-1 X) = sum_i (m_i - log(1 + m_i)),  m_i the eigenvalues of P_k^-1 X
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis import stacked
from tolnet.analysis.divergence import divergence
from tolnet.analysis.fixed_point import Inflated, inflate_covariance, predict
from tolnet.model import SensorNetwork, SteadyState, UnsupportedError

_ROUNDING = 1e-11


def local_tolerances(network: SensorNetwork, central: SteadyState) -> Float[ndarray, " N"]:
    """c_k of every node on the gamma scale, from the steady state of the central filter, eq. (42).

    Uses n x n matrices only, and no difference of large numbers: V - P and V^-1 + S_k are formed in the eigenbasis of
    the central P. 0 <= c_k <= c; a node that hears everybody has c_k = c. NaN where the centre has no steady state.
    Raises UnsupportedError for tau != 0: local tolerances are defined for Kullback-Leibler balls only.
    Source: eqs. (30), (31), (42); docs/mathematics.md, section 3.
    """
    if central.tau != 0:
        raise UnsupportedError(
            f"local tolerances are defined for tau = 0 only (tau is {central.tau}); use uniform tolerances c_k = c"
        )
    c = float(central.tolerance)
    if not central.exists:
        return np.full(network.N, np.nan)
    if c == 0:
        return np.zeros(network.N)
    at = inflate_covariance(central.P[None], np.array([c]))
    return seen_tolerances(network, c, now=at, following=at)


def seen_tolerances(network: SensorNetwork, c: float, *, now: Inflated, following: Inflated) -> Float[ndarray, " N"]:
    """c_{k,t} of eq. (30) from the centre's V_t (`now`) and its P_{t+1}, V_{t+1} (`following`), stacks of one.

    In the steady state the two are the same, eq. (42).
    """
    A, Q = network.A, network.Q
    root_X = following.U * np.sqrt(following.eigenvalues * following.excess)[:, None, :]
    size = max(1, 2**21 // (8 * network.n**2))
    parts = [
        _seen(predict(A, Q, network.information[start : start + size], now), root_X)
        for start in range(0, network.N, size)
    ]
    found = np.concatenate(parts)
    # c_k <= c is a theorem; where the node hears everybody the two differ by rounding alone.
    return np.where(found <= c * (1 + _ROUNDING), np.minimum(found, c), found)


def _seen(P_loc: Float[ndarray, "K n n"], root_X: Float[ndarray, "1 n n"]) -> Float[ndarray, " K"]:
    """Lines 2 and 3, with X = root_X root_X'; P_loc is scaled to a unit diagonal first."""
    n = P_loc.shape[-1]
    scale = np.sqrt(np.einsum("kii->ki", P_loc))
    scale = np.where(scale > 0, scale, 1.0)
    eigenvalues, U = stacked.symmetric_eigen(P_loc / scale[:, :, None] / scale[:, None, :])
    # X lives in the range of P, which is inside that of P_loc: null directions of P_loc carry nothing.
    inside = eigenvalues > 4 * n * np.finfo(float).eps * eigenvalues[:, -1:]
    inverse_root = np.where(inside, 1.0 / np.sqrt(np.where(inside, eigenvalues, 1.0)), 0.0)
    half = inverse_root[:, :, None] * (U.mT @ (root_X / scale[:, :, None]))
    m = np.linalg.svd(half, compute_uv=False) ** 2
    return divergence(np.log1p(m)).sum(axis=-1)
