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
from tolnet.analysis.fixed_point import Recursion, step
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
    size = max(1, 2**21 // (8 * network.n**2))
    parts = [_block(central, network.information[start : start + size]) for start in range(0, network.N, size)]
    found = np.concatenate(parts)
    # c_k <= c is a theorem; where the node hears everybody the two differ by rounding alone.
    return np.where(found <= c * (1 + _ROUNDING), np.minimum(found, c), found)


def _block(central: SteadyState, S: Float[ndarray, "K n n"]) -> Float[ndarray, " K"]:
    K, n, _ = S.shape
    A, Q = central.A, central.Q
    tolerance = np.full(K, float(central.tolerance))
    at = step(Recursion(A, Q, S, tolerance), np.broadcast_to(central.P, (K, n, n)))
    P_loc = at.following  # line 2: one step of the node's recursion from the central P
    scale = np.sqrt(np.einsum("kii->ki", P_loc))
    scale = np.where(scale > 0, scale, 1.0)
    eigenvalues, U = stacked.symmetric_eigen(P_loc / scale[:, :, None] / scale[:, None, :])
    # X lives in the range of P, which is inside that of P_loc: null directions of P_loc carry nothing.
    inside = eigenvalues > 4 * n * np.finfo(float).eps * eigenvalues[:, -1:]
    inverse_root = np.where(inside, 1.0 / np.sqrt(np.where(inside, eigenvalues, 1.0)), 0.0)
    root_X = at.U * np.sqrt(at.eigenvalues * at.excess)[:, None, :] / scale[:, :, None]
    half = inverse_root[:, :, None] * (U.mT @ root_X)
    m = np.linalg.svd(half, compute_uv=False) ** 2
    return divergence(np.log1p(m)).sum(axis=-1)
