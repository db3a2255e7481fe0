"""The published covariance recursion, eq. (8), one filter at a time and as printed.

Explicit inverses, and bisection for theta down to neighbouring doubles. Good for 1e-4 < c < 100: below, gamma as
printed cancels; above, 1 - theta lambda_max does.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from typing import Literal

import numpy as np
from numpy import ndarray
from numpy.linalg import eigvalsh, inv, norm

Verdict = Literal["settles", "oscillates", "diverges", "undecided"]


def gamma(P: ndarray, theta: float) -> float:
    """log det(I - theta P) + tr((I - theta P)^-1 - I), eq. (4), through the eigenvalues of P."""
    return _gamma(eigvalsh(P).tolist(), theta)


def _gamma(eigenvalues: list[float], theta: float) -> float:
    return sum(log(1 - theta * x) + 1 / (1 - theta * x) - 1 for x in eigenvalues)


def find_theta(P: ndarray, c: float) -> float:
    """The root of gamma(P, theta) = c in (0, 1 / lambda_max(P)), bisected until two neighbouring doubles are left."""
    eigenvalues = eigvalsh(P).tolist()
    if c == 0:
        return 0.0
    low, high = 0.0, 1 / max(eigenvalues)
    while low < (middle := (low + high) / 2) < high:
        if middle * max(eigenvalues) < 1 and _gamma(eigenvalues, middle) < c:
            low = middle
        else:
            high = middle
    return low


def step(A: ndarray, Q: ndarray, S: ndarray, c: float, V: ndarray) -> tuple[ndarray, float, ndarray]:
    """P_{t+1}, theta_t and V_{t+1} from V_t: the three covariance lines of eq. (8)."""
    P = A @ inv(inv(V) + S) @ A.T + Q
    P = (P + P.T) / 2
    theta = find_theta(P, c)
    V = inv(inv(P) - theta * np.eye(len(P)))
    return P, theta, (V + V.T) / 2


@dataclass(frozen=True)
class Run:
    """Where the recursion was when it was stopped, and what it seemed to be doing."""

    verdict: Verdict
    steps: int
    P: ndarray
    V: ndarray
    theta: float


def run(
    A: ndarray,
    Q: ndarray,
    S: ndarray,
    c: float,
    V0: ndarray | None = None,
    *,
    steps: int = 3000,
) -> Run:
    """Iterate from V0 (the identity) until 20 steps in a row move V by less than 1e-13 of its norm.

    `settles`: so it did, or the last quarter of the steps moved by rounding only. `diverges`: V passed 1e30 times its
    start. `oscillates`: the moves of the last quarter are no rounding, and the largest is hardly smaller than that of
    the quarter before. `undecided`: none of these, slow convergence for instance: nobody should draw a conclusion.
    """
    V = np.eye(len(A)) if V0 is None else V0
    start, moves = norm(V), []
    P, theta, t = V, 0.0, 0
    for t in range(1, steps + 1):
        P, theta, V_next = step(A, Q, S, c, V)
        moves.append(norm(V_next - V) / norm(V_next))
        V = V_next
        if max(moves[-20:]) < 1e-13 and t >= 20:
            return Run("settles", t, P, V, theta)
        if norm(V) > 1e30 * start:
            return Run("diverges", t, P, V, theta)
    quarter = steps // 4
    late, earlier = max(moves[-quarter:]), max(moves[-2 * quarter : -quarter])
    if late < 1e-10:
        return Run("settles", t, P, V, theta)
    return Run("oscillates" if late > max(0.95 * earlier, 1e-6) else "undecided", t, P, V, theta)
