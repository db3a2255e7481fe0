"""Whether a steady state that somebody reports is one, in 100 digits, for exactly the B, C and R of a network.

Newton's method (`fifty_digits`) from the reported P and theta: where it ends is a steady state; what was reported is
right as far as it agrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from mpmath import eig, matrix, mp, mpf
from numpy import ndarray
from tests.reference import fifty_digits
from tests.reference.exact import exact, eye, inverse, rounded, solve

from tolnet.model import SensorNetwork

DIGITS = 100


@dataclass(frozen=True)
class Filter:
    """A, Q and S of one filter, and C' R^-1 of all that it hears, as mpmath numbers."""

    A: ndarray
    Q: ndarray
    S: ndarray
    weighted: ndarray


@dataclass(frozen=True)
class Truth:
    """A steady state as doubles, and P and V before rounding."""

    P: ndarray
    V: ndarray
    theta: float
    gain: ndarray
    spectral_radius: float
    exact_P: ndarray
    exact_V: ndarray


def filter_of(network: SensorNetwork, heard: list[int]) -> Filter:
    """The filter that hears these nodes."""
    with mp.workdps(DIGITS):
        A = exact(network.A)
        B = exact(network.B)
        S, columns = A * mpf(0), []
        for C, R in map(network.sensor, heard):
            if len(C):
                weighted = solve(exact(R), exact(C)).T
                S, columns = S + weighted @ exact(C), [*columns, weighted]
        return Filter(A, B @ B.T, S, np.concatenate(columns, axis=1) if columns else exact(np.empty((len(A), 0))))


def polish(filter: Filter, c: Any, P: ndarray, theta: float) -> Truth:
    """The steady state to which Newton's method goes from there. Raises ArithmeticError where it goes nowhere."""
    with mp.workdps(DIGITS):
        A, Q, S, I = filter.A, filter.Q, filter.S, eye(len(filter.A))
        if c == 0:
            exact_P, exact_theta = fifty_digits.kalman(A, Q, S), mpf(0)
        else:
            exact_P, exact_theta = fifty_digits.newton(A, Q, S, mpf(c), exact(P), mpf(theta), DIGITS // 2)
        V = solve(I - exact_P * exact_theta, exact_P)
        loop = A @ inverse(I + V @ S)
        gain = A @ solve(I + V @ S, V) @ filter.weighted
        radius = max(abs(x) for x in eig(matrix(loop.tolist()), left=False, right=False))
        return Truth(rounded(exact_P), rounded(V), float(exact_theta), rounded(gain), float(radius), exact_P, V)


def local_tolerance(filter: Filter, truth: Truth) -> float:
    """c_k of the node with this filter, from the truth of its centre: eq. (30) by n x n matrices."""
    with mp.workdps(DIGITS):
        P, V, I = truth.exact_P, truth.exact_V, eye(len(filter.A))
        local = filter.A @ solve(I + V @ filter.S, V) @ filter.A.T + filter.Q
        ratio = solve(local, V - P)
        return float(sum(np.diag(ratio)) - mp.log(fifty_digits.determinant(I + ratio)))


def attraction(filter: Filter, c: float, truth: Truth) -> float:
    """Spectral radius of the derivative of the recursion there."""
    state = fifty_digits.Exact(truth.exact_P, truth.exact_V, mpf(truth.theta))
    return fifty_digits.attraction(filter.A, filter.Q, filter.S, c, state)
