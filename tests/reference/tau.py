"""The robust recursion with tau-divergence balls, from matrix functions of scipy; tau = 0 is Kullback-Leibler.

With P = L L': V = L (I - (1 - tau) theta L'L)^(1 / (tau - 1)) L', and V = L exp(theta L'L) L' for tau = 1.
"""

from __future__ import annotations

from math import exp, log

import numpy as np
from numpy import ndarray
from numpy.linalg import cholesky, eigvalsh, inv, norm
from scipy.linalg import expm, fractional_matrix_power


def gamma(P: ndarray, theta: float, tau: float) -> float:
    """The divergence at theta, summed over s = theta times the eigenvalues of P."""
    total = 0.0
    for s in (theta * eigvalsh(P)).tolist():
        if tau == 1:
            total += exp(s) * (s - 1) + 1
        elif tau == 0:
            total += log(1 - s) + 1 / (1 - s) - 1
        else:
            x = 1 - (1 - tau) * s
            total += -(x ** (tau / (tau - 1))) / (tau * (1 - tau)) + x ** (1 / (tau - 1)) / (1 - tau) + 1 / tau
    return total


def find_theta(P: ndarray, c: float, tau: float) -> float:
    """The root of gamma = c by bisection; below 1 / ((1 - tau) lambda_max) for tau < 1."""
    largest = eigvalsh(P)[-1]
    low, high = 0.0, 1 / largest if tau == 1 else float(1 / ((1 - tau) * largest))
    while tau == 1 and gamma(P, high, tau) < c:
        high *= 2
    while low < (middle := (low + high) / 2) < high:
        within = tau == 1 or (1 - tau) * middle * largest < 1
        low, high = (middle, high) if within and gamma(P, middle, tau) < c else (low, middle)
    return low


def inflate(P: ndarray, theta: float, tau: float) -> ndarray:
    """V from P and theta."""
    L = cholesky(P)
    if tau == 1:
        return L @ expm(theta * L.T @ L) @ L.T
    core = np.eye(len(P)) - (1 - tau) * theta * L.T @ L
    return L @ fractional_matrix_power(core, 1 / (tau - 1)) @ L.T


def steady_state(
    A: ndarray, Q: ndarray, S: ndarray, c: float, tau: float, steps: int = 2000
) -> tuple[ndarray, ndarray, float]:
    """P, V and theta after V has stood still for a step; RuntimeError where it never does."""
    V = np.eye(len(A))
    for _ in range(steps):
        P = A @ inv(inv(V) + S) @ A.T + Q
        theta = find_theta(P, c, tau)
        V, before = inflate(P, theta, tau), V
        if norm(V - before) < 1e-13 * norm(V):
            return P, V, theta
    raise RuntimeError(f"no steady state after {steps} steps")
