"""Steady states in doubles without the recursion, so that they are found where the recursion oscillates as well.

The unknowns are V and theta. With them both equations are free of poles:

    P = (V^-1 + theta I)^-1 = A (V^-1 + S)^-1 A' + Q,      gamma = theta tr V - log det(I + theta V) = c.

(1 - s = 1 / (1 + theta mu) for the eigenvalues mu of V turns eq. (4) into the second.) scipy.optimize finds the root,
from the Kalman filter at a small c upwards in small steps of c. Good for 1e-4 < c < 1e4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from numpy.linalg import eigh, inv, slogdet
from scipy.linalg import solve_discrete_are
from scipy.optimize import root


@dataclass(frozen=True)
class Naive:
    """A steady state in doubles."""

    P: ndarray
    V: ndarray
    theta: float


def kalman(A: ndarray, Q: ndarray, S: ndarray) -> ndarray:
    """P at c = 0 from scipy, the sensors replaced by n whitened ones: S = L L', y = L' x + v."""
    values, vectors = eigh(S)
    L = vectors * np.sqrt(np.maximum(values, 0))
    return solve_discrete_are(A.T, L, Q, np.eye(len(A)))


def steady_state(A: ndarray, Q: ndarray, S: ndarray, c: float) -> Naive:
    """The steady state on the path in c that starts at the Kalman filter; RuntimeError where the path is lost."""
    P = kalman(A, Q, S)
    if c == 0:
        return Naive(P, P, 0.0)
    here, factor, found = min(c, 1e-3), 4.0, None
    while not found and here > 1e-9:
        found = _solve(A, Q, S, here, P, float(np.sqrt(2 * here) / np.linalg.norm(P)))
        here = here if found else here / 10
    while found and here < c:
        ahead = min(c, factor * here)
        next_found = _solve(A, Q, S, ahead, *found)
        if next_found:
            here, found = ahead, next_found
        elif (factor := np.sqrt(factor)) < 1.02:
            break
    if not found or here < c:
        raise RuntimeError(f"path lost at c = {here}")
    V, theta = found
    return Naive(V @ inv(np.eye(len(A)) + theta * V), V, theta)


def _solve(A: ndarray, Q: ndarray, S: ndarray, c: float, V: ndarray, theta: float) -> tuple[ndarray, float] | None:
    """V > 0 and theta > 0 from a start; None unless the equations hold to 1e-11 in units of V's diagonal."""
    I, upper, scale = np.eye(len(A)), np.triu_indices(len(A)), np.sqrt(np.diag(V))

    def unpack(x: ndarray) -> tuple[ndarray, float]:
        V = np.zeros_like(A)
        V[upper] = x[:-1]
        V = V + V.T - np.diag(np.diag(V))
        return V * np.outer(scale, scale), float(x[-1]) / float(scale @ scale)

    def equations(x: ndarray) -> ndarray:
        V, theta = unpack(x)
        riccati = V @ inv(I + theta * V) - A @ inv(I + V @ S) @ V @ A.T - Q
        gamma = theta * np.trace(V) - slogdet(I + theta * V)[1]
        return np.append((riccati / np.outer(scale, scale))[upper], gamma / c - 1)

    x = np.append((V / np.outer(scale, scale))[upper], theta * (scale @ scale))
    for _ in range(2):  # once more from its own answer: the first stop may be early
        x = root(equations, x, options={"xtol": 1e-15}).x
    V, theta = unpack(x)
    holds = np.abs(equations(x)).max() < 1e-11 and theta > 0 and eigh(V)[0][0] > 0
    return (V, theta) if holds else None
