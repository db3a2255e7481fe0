"""c_k by the determinants of eqs. (30)-(31): matrices of size n + p_k, p_k the outputs of the whole neighbourhood."""

from __future__ import annotations

import numpy as np
from numpy import ndarray
from numpy.linalg import inv, slogdet

from tolnet.model import SensorNetwork


def stacked(network: SensorNetwork, nodes: list[int]) -> tuple[ndarray, ndarray]:
    """C and R of several nodes, one under the other and block diagonal, eqs. (6), (9)."""
    C, R = np.zeros((0, network.n)), np.zeros((0, 0))
    for l in nodes:
        C_l, R_l = network.sensor(l)
        p, q = len(R), len(R_l)
        C = np.vstack([C, C_l])
        R = np.block([[R, np.zeros((p, q))], [np.zeros((q, p)), R_l]])
    return C, R


def hears(network: SensorNetwork, k: int) -> list[int]:
    """The neighbourhood of node k, itself included, read off the dense adjacency."""
    return [l for l in range(network.N) if l == k or network.adjacency.toarray()[l, k]]


def information(C: ndarray, R: ndarray) -> ndarray:
    """C' R^-1 C, without the rounding by which the product is not symmetric."""
    S = C.T @ inv(R) @ C
    return (S + S.T) / 2


def local_tolerance(
    A: ndarray, Q: ndarray, C: ndarray, R: ndarray, C_loc: ndarray, R_loc: ndarray, V: ndarray, V_next: ndarray
) -> float:
    """Eq. (31) with kappa = 1, from C, R of all sensors and of the neighbourhood, V_t and V_{t+1} of the centre."""
    K_x = A @ V @ A.T + Q
    K_xy, K_y = A @ V @ C.T, C @ V @ C.T + R
    tilde_K_x = V_next + K_xy @ inv(K_y) @ K_xy.T  # eq. (22): the global y
    K_xyk, K_yk = A @ V @ C_loc.T, C_loc @ V @ C_loc.T + R_loc
    K = np.block([[K_x, K_xyk], [K_xyk.T, K_yk]])  # eqs. (23)-(25)
    tilde_K = np.block([[tilde_K_x, K_xyk], [K_xyk.T, K_yk]])
    return float(slogdet(K)[1] - slogdet(tilde_K)[1] + np.trace(tilde_K @ inv(K)) - len(K))
