"""The published sufficient bound on c (Zorzi's maxtol): block contraction over a window.

Plain block Toeplitz matrices, latest sample first; bisection on theta down to neighbouring
doubles, so that no absolute tolerance can end it early.
"""

from __future__ import annotations

from math import inf

import numpy as np
from numpy import ndarray
from numpy.linalg import eigvalsh, inv, matrix_power
from tests.reference.recursion import gamma


def maxtol(A: ndarray, B: ndarray, C: ndarray, D: ndarray, P: ndarray, window: int) -> float:
    """c_N = gamma(P, phi_N); inf where phi_N >= 1 / lambda_max(P), 0 where no theta contracts.

    P is the Kalman filter's steady state. Assumes window >= n and D D' invertible.
    """
    n, m, p, N = len(A), B.shape[1], len(C), window
    O = np.vstack([C @ matrix_power(A, N - 1 - i) for i in range(N)])
    O_R = np.vstack([matrix_power(A, N - 1 - i) for i in range(N)])
    H, L = np.zeros((N * p, N * m)), np.zeros((N * n, N * m))
    for i in range(N):
        for j in range(i + 1, N):
            AB = matrix_power(A, j - i - 1) @ B
            H[i * p : (i + 1) * p, j * m : (j + 1) * m] = C @ AB
            L[i * n : (i + 1) * n, j * m : (j + 1) * m] = AB
    R = np.kron(np.eye(N), D @ D.T)
    weight = inv(R + H @ H.T)
    Omega = O.T @ weight @ O
    J = O_R - L @ H.T @ weight @ O
    M = L @ inv(np.eye(N * m) + H.T @ inv(R) @ H) @ L.T
    limit = 1 / eigvalsh(M)[-1]

    def contracts(theta: float) -> bool:
        return eigvalsh(Omega + theta * J.T @ inv(theta * M - np.eye(N * n)) @ J)[0] >= 0

    low, high = 0.0, float(limit)
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if contracts(middle) else (low, middle)
    return inf if low >= 1 / eigvalsh(P)[-1] else gamma(P, low)
