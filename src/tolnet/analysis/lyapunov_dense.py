"""The Lyapunov equation X = F X F' + D with dense matrices: squared Smith, and two peers behind the same door."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.model import UnsupportedError

_MOST_DOUBLINGS = 60
_POWER_STEPS = 12
_ROUNDINGS = 4
_SETTLED = 1e-12
"""Relative size of a doubling's terms at which to stop: the next ones are about its square."""


class DenseSolution(NamedTuple):
    """X, and how many doublings it took."""

    X: Float[ndarray, "d d"]
    doublings: int


def solve_smith(F: Float[ndarray, "d d"], D: Float[ndarray, "d d"]) -> DenseSolution:
    """Solve X = F X F' + D for X = sum_t F^t D F'^t by doubling the number of terms: X+ = X + A X A', A+ = A A.

    Assumes rho(F) < 1 and D symmetric; otherwise the sum grows until it overflows, and X is NaN.
    Source: R. A. Smith, SIAM J. Appl. Math. 16(1):198-201, 1968.
    """
    X, A, doublings = D, F, 0
    with np.errstate(over="ignore", invalid="ignore"):
        while doublings < _MOST_DOUBLINGS:
            doublings += 1
            more = A @ X @ A.T
            X = X + (more + more.T) / 2  # rounding only: the exact sum is symmetric
            size = np.linalg.norm(X)
            if not np.isfinite(size):
                return DenseSolution(np.full_like(D, np.nan), doublings)
            if np.linalg.norm(more) <= _SETTLED * size:
                break
            A = A @ A
    return DenseSolution(X, doublings)


def solve_scipy(F: Float[ndarray, "d d"], D: Float[ndarray, "d d"]) -> DenseSolution:
    """Solve X = F X F' + D by scipy.linalg.solve_discrete_lyapunov (bilinear transformation and Schur form)."""
    from scipy.linalg import solve_discrete_lyapunov

    return DenseSolution(np.asarray(solve_discrete_lyapunov(F, D)), 0)


def solve_slycot(F: Float[ndarray, "d d"], D: Float[ndarray, "d d"]) -> DenseSolution:
    """Solve X = F X F' + D by SLICOT's SB03MD (Barraud's method on the Schur form).

    Raises UnsupportedError where the optional package slycot is not installed.
    """
    try:
        from slycot import sb03md57
    except ImportError as missing:
        raise UnsupportedError(
            "method 'slycot' needs the optional package slycot: pip install 'tolnet[slycot]'"
        ) from missing
    # SB03MD solves op(A)' X op(A) - X = scale C; with op(A) = A' that is A X A' - X = scale C
    _, _, X, scale, *_ = sb03md57(np.array(F, order="F"), C=np.array(-D, order="F"), dico="D", trana="T")
    return DenseSolution(X / scale, 0)


def residual(F: Float[ndarray, "d d"], D: Float[ndarray, "d d"], X: Float[ndarray, "d d"]) -> Float[ndarray, "d d"]:
    """F X F' + D - X."""
    return F @ X @ F.T + D - X


def relative_size(part: ndarray, whole: ndarray) -> float:
    """|part| / |whole|, Frobenius norms; 0 where there is no part: a plant without noise has the covariance zero."""
    size = float(np.linalg.norm(part))
    return size / max(float(np.linalg.norm(whole)), np.finfo(float).tiny) if size else 0.0


def amplification(F: Float[ndarray, "d d"]) -> float:
    """|sum_t F^t F'^t| in the spectral norm: |X - X*| is at most that many times |residual|.

    By squared Smith with D = I; the norm by power steps, from below.
    """
    X = solve_smith(F, np.eye(len(F))).X
    v = np.random.default_rng(0).normal(size=len(F))
    for _ in range(_POWER_STEPS):
        v = X @ (v / np.linalg.norm(v))
    return float(np.linalg.norm(v))


def data_error(radius: float) -> float:
    """Relative error of X that rounding the entries of an F of that spectral radius makes, however X is solved."""
    return float(_ROUNDINGS * np.finfo(float).eps / (1 - radius**2)) if radius < 1 else np.inf
