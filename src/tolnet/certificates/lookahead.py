"""The covariance recursion and its brackets in floating point: what the proofs try is found here, nothing is claimed.

In coordinates of the state in which the steady state is near I, so that the units of the states do not matter. With
one state V = kappa P for a constant kappa, which A and S take in, and theta is 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import balls
from tolnet.certificates.blocks import MOST_BLOCKS, MOST_DOUBLINGS
from tolnet.certificates.fixed_point import Enclosure
from tolnet.certificates.recursion import approximate_excess, approximate_theta

_WIDEST, _NARROWEST = 2.0**20, 2.0**-30
_KEPT = 2.0**-12
_SETTLED = 1e-13
_STALLED = 0.9
_INSIDE = 1e-9
"""Of the width of a bracket: how far from its ends an orbit in floating point must be."""


class Lookahead:
    """X_{t+1} = T(X_t, theta_t) for P = L X L', and brackets of it around the steady state."""

    def __init__(self, at: Enclosure, L: Float[ndarray, "n n"]) -> None:
        factor = balls.matrix(L)
        equations = at.equations.seen_from(factor)
        parts = (equations.A, equations.Q, equations.S, equations.metric)
        self.A, self.Q, self.S, self.metric = (balls.midpoints(M) for M in parts)
        self.L, self.back, self.c = L, balls.midpoints(factor.inv()), float(at.equations.c)
        self.X, self.theta = balls.midpoints(balls.congruence(factor.inv(), at.P)), float(at.theta)
        self.kappa = 1.0
        if len(L) == 1 and self.c > 0:  # V = kappa P at every step
            self.kappa = 1 + float(approximate_excess(np.ones(1), self.c)[0])
            self.A, self.S, self.theta = self.A * np.sqrt(self.kappa), self.S * self.kappa, 0.0

    def orbit(self, start: Float[ndarray, "n n"]) -> Iterator[Float[ndarray, "n n"]]:
        """X_1, X_2, ... from V_0, for ever. Raises numpy.linalg.LinAlgError."""
        X = self.back @ start @ self.back.T / self.kappa
        X = self.following(X, 0.0)
        while True:
            yield X
            X = self.following(X, self.theta_of(X))

    def theta_of(self, X: Float[ndarray, "n n"]) -> float:
        """theta with gamma(P, theta) = c; 0 for one state, where it is in kappa."""
        return 0.0 if self.kappa > 1 else approximate_theta(self.L @ X @ self.L.T, self.c)

    def following(self, X: Float[ndarray, "n n"], theta: float) -> Float[ndarray, "n n"]:
        """T(X, theta)."""
        Z = np.linalg.solve(np.eye(len(X)) + X @ (self.S - theta * self.metric), X)
        M = self.A @ Z @ self.A.T + self.Q
        return (M + M.T) / 2

    def bracket(self) -> tuple[ndarray, ndarray] | None:
        """The widest (L, U) = X* -+ s D found with L < T(L, theta(U)) and T(U, theta(L)) < U; None where none is.

        D solves D - K D K' - theta tr(N D) / tr(N X*) A Z Pi Z A' = X*: both ends move by their own step and by what
        the other end's theta adds. It exists where the loop K is stable and the gain of theta on itself below 1.
        """
        n = len(self.X)
        W = np.linalg.inv(np.eye(n) + self.X @ (self.S - self.theta * self.metric))
        K, AZ = self.A @ W, self.A @ W @ self.X
        H = np.linalg.inv(np.eye(n) - self.theta * self.X @ self.metric)
        N = self.metric @ H @ self.X @ H.T @ self.metric
        own, moved = _gramian(K, self.X), _gramian(K, AZ @ self.metric @ AZ.T)
        if own is None or moved is None:  # the loop is stable only together with theta
            return None
        unit = self.theta / np.trace(N @ self.X)
        gain = unit * np.trace(N @ moved)
        if not gain < 1:
            return None
        D = own + moved * (unit * np.trace(N @ own) / (1 - gain))
        D = (D + D.T) / 2
        D = D / np.linalg.eigvalsh(D)[-1]
        s = _WIDEST
        while s > _NARROWEST:
            L, U = self.X - s / (1 + s) * D, self.X + s * D
            if self._holds(L, U):
                return L, U
            s /= 2
        return None

    def _holds(self, L: ndarray, U: ndarray) -> bool:
        if not np.linalg.eigvalsh(L)[0] > 0:
            return False
        least, most = self.theta_of(U), self.theta_of(L)
        if not np.linalg.eigvalsh(U + U @ (self.S - most * self.metric) @ U)[0] > 0:
            return False
        return contains(L, U, self.following(L, least)) and contains(L, U, self.following(U, most))

    def blocks(self, L: ndarray, U: ndarray, goal: Callable[[ndarray, ndarray], bool]) -> tuple[int, ...] | None:
        """Doublings by which to push a bracket on, block by block, until `goal(L, U)`; None where it stays open."""
        found, before = [], np.inf
        while not goal(L, U):
            gap = float(np.trace(U - L))
            if len(found) == MOST_BLOCKS or not gap < _STALLED * before:
                return None
            before = gap
            try:
                (below, k), (above, j) = self._pushed(L, self.theta_of(U)), self._pushed(U, self.theta_of(L))
            except np.linalg.LinAlgError:  # an unstable mode that no noise drives: F grows with every doubling
                return None
            found.append(max(j, k))
            L, U = below - _KEPT * (below - L), above + _KEPT * (U - above)
        return tuple(found)

    def _pushed(self, X: ndarray, theta: float) -> tuple[ndarray, int]:
        """T^m(X) for this theta at m = 2^k, with k from which on it hardly moves."""
        one = np.eye(len(X))
        F, G, H = self.A.T, self.S - theta * self.metric, self.Q
        k = 0
        while np.abs(F).max() ** 2 > _SETTLED and k < MOST_DOUBLINGS:
            k += 1
            W = np.linalg.inv(one + G @ H)
            F, G, H = F @ W @ F, G + F @ W @ G @ F.T, H + F.T @ H @ W @ F
        after = H + F.T @ X @ np.linalg.solve(one + G @ X, F)
        return (after + after.T) / 2, k


def contains(L: Float[ndarray, "n n"], U: Float[ndarray, "n n"], X: Float[ndarray, "n n"]) -> bool:
    """Whether L < X < U, by a billionth of the width."""
    least = _INSIDE * (U - L)
    return bool(np.linalg.eigvalsh(X - L - least)[0] > 0 and np.linalg.eigvalsh(U - X - least)[0] > 0)


def _gramian(K: ndarray, E: ndarray) -> ndarray | None:
    """D = sum K^i E K'^i by doubling; None where it does not settle."""
    D, power = E, K
    for _ in range(MOST_DOUBLINGS):
        growth = power @ D @ power.T
        D, power = D + growth, power @ power
        if not np.isfinite(D).all():
            return None
        if np.abs(growth).max() <= _SETTLED * np.abs(D).max():
            return D
    return None
