"""The equations of one steady state in extended precision: the recursion, its slope, doubling and Newton's method.

P = A Z A' + Q,   Z = P (I + (S - theta I) P)^-1,   gamma(P, theta) = c
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tolnet.analysis.extended_algebra import (
    Matrix,
    NoAnswer,
    distance,
    identity,
    inverse_units,
    middle,
    number,
    pivots,
    solve,
    symmetric,
    unpacked,
    upper_triangle,
)

MOST_DOUBLINGS = 96
MOST_NEWTON = 60
MOST_DENSE = 16
"""States up to which equations on symmetric matrices are solved as one dense system, n (n + 1) / 2 square."""
SETTLED = 2.0**-200
"""Relative change, in the units of each state, at which doubling and Newton's method stop."""
ACCEPT = 2.0**-120
"""Largest defect, in the units of each state and of gamma, of what is passed on."""


@dataclass(frozen=True)
class Plant:
    """A, Q and S of one filter as exact or nearly exact matrices; made inside `precision()`."""

    A: Matrix
    Q: Matrix
    S: Matrix
    weighted: Matrix | None = None
    """C' R^-1 of all that is heard, side by side, with S = C' R^-1 C; None where only S is known."""

    @property
    def n(self) -> int:
        """Number of states."""
        return self.A.nrows()


class Count:
    """Doubling solves and Newton steps so far."""

    total = 0


def doubling(plant: Plant, theta: Any, start: Matrix | None, count: Count) -> Matrix:
    """P = A P (I + G P)^-1 A' + Q with G = S - theta I, the limit of the recursion from `start` (zero without one).

    A start P_0 is a change of the unknown, X = P - P_0:  X = F X (I + (W G) X)^-1 F' + (A W'P_0 A' + Q - P_0),
    W = (I + G P_0)^-1, F = A W'.
    """
    eye = identity(plant.n)
    G = plant.S - eye * theta
    Aj, Gj, Hj = plant.A.transpose(), G, plant.Q
    if start is not None:
        W = solve(eye + G * start, eye)
        Aj = W * Aj
        Hj = symmetric(plant.A * W.transpose() * start * plant.A.transpose() + plant.Q - start)
        Gj = symmetric(W * G)
    for _ in range(MOST_DOUBLINGS):
        count.total += 1
        inner = eye + Gj * Hj
        WA, WG = solve(inner, Aj), solve(inner, Gj)
        growth = symmetric(Aj.transpose() * Hj * WA)
        Gj = symmetric(Gj + Aj * WG * Aj.transpose())
        Hj = middle(Hj + growth)
        Aj = middle(Aj * WA)
        total = Hj if start is None else Hj + start
        if distance(total, total - growth) <= SETTLED:
            P = symmetric(total)
            if distance(P, step(plant, P, theta)[0]) > ACCEPT:
                raise NoAnswer("doubling lost its digits")
            check_covariance(P)
            return P
        if not all(x.is_finite() for x in Hj.entries()):
            break
    raise NoAnswer(f"doubling did not settle in {MOST_DOUBLINGS} turns")


def step(plant: Plant, P: Matrix, theta: Any) -> tuple[Matrix, Matrix]:
    """A Z A' + Q and Z = P (I + (S - theta I) P)^-1."""
    eye = identity(plant.n)
    Z = symmetric(solve(eye + P * (plant.S - eye * theta), P))
    return symmetric(plant.A * Z * plant.A.transpose() + plant.Q), Z


def gamma_and_inverse(P: Matrix, theta: Any) -> tuple[Any, Matrix]:
    """gamma(P, theta) and M = (I - theta P)^-1. Raises NoAnswer unless theta P < I and P >= 0."""
    eye = identity(P.nrows())
    inner = eye - P * theta
    positive = pivots(inner)
    if positive is None:
        raise NoAnswer("theta is beyond 1 / lambda_max(P)")
    M = symmetric(solve(inner, eye))
    return (sum((x.log() for x in positive), M.trace()) - P.nrows()).mid(), M


def newton(
    plant: Plant, c: float, P: Matrix, theta: Any, count: Count, most: int = MOST_NEWTON
) -> tuple[Matrix, Any]:
    """Line 3, halving steps that leave theta > 0, theta P < I. At c = 0 on P alone."""
    goal = number(c)
    gamma, M = gamma_and_inverse(P, theta)
    moved = math.inf
    for _ in range(most):
        count.total += 1
        following, Z = step(plant, P, theta)
        defect = following - P
        slope = Slope.at(plant, P, theta, Z, M)
        X, Y = slope.resolve(defect)
        if c == 0:
            dtheta = number(0)
        else:
            # gamma_P dP + gamma_theta dtheta = gamma log(c / gamma)
            wanted = gamma * (goal / gamma).log()
            pull = slope.pull
            dtheta = (wanted - theta * (pull * X).trace()) / ((pull * P).trace() + theta * (pull * Y).trace())
        dP = symmetric(X + Y * dtheta)
        share = number(1)
        for _ in range(60):
            try:
                there, theta_there = middle(P + dP * share), (theta + dtheta * share).mid()
                if c > 0 and not theta_there > 0:
                    raise NoAnswer("theta is not positive")
                gamma, M = gamma_and_inverse(there, theta_there)
                break
            except NoAnswer:
                share = share / 2
        else:
            raise NoAnswer("every step of Newton's method leaves the covariances")
        moved, P, theta = distance(there, P), there, theta_there
        if moved <= SETTLED:
            break
    accept(plant, c, P, theta)
    return P, theta


def accept(plant: Plant, c: float, P: Matrix, theta: Any) -> tuple[float, float]:
    """The two residuals of a steady state. Raises NoAnswer unless they are tiny and P >= 0."""
    riccati = distance(P, step(plant, P, theta)[0])
    mismatch = 0.0 if c == 0 else abs(float((gamma_and_inverse(P, theta)[0] / number(c) - 1).mid()))
    if not (riccati <= ACCEPT and mismatch <= ACCEPT):
        raise NoAnswer(f"Newton's method did not settle in {MOST_NEWTON} steps")
    check_covariance(P)
    return riccati, mismatch


def check_covariance(P: Matrix) -> None:
    """Raises NoAnswer for a P with a negative eigenvalue; what is smaller than rounding is a singular P."""
    units, n = inverse_units(P), P.nrows()
    unit = np.array([[float((P[i, j] * units[i, j]).mid()) for j in range(n)] for i in range(n)])
    if not np.linalg.eigvalsh(unit)[0] >= -4 * n * np.finfo(float).eps:
        raise NoAnswer("the solution of the equations is no covariance")


@dataclass(frozen=True)
class Slope:
    """The derivative of the recursion at (P, theta): K dP K' + thrust dtheta, and that of gamma."""

    K: Matrix
    """A Z P^-1 = A (I + P (S - theta I))^-1."""
    thrust: Matrix
    """A Z Z A'."""
    pull: Matrix
    """M^2 - M: d gamma = tr(pull (theta dP + P dtheta))."""

    @classmethod
    def at(cls, plant: Plant, P: Matrix, theta: Any, Z: Matrix, M: Matrix) -> Slope:
        """From Z = (V^-1 + S)^-1 and M = (I - theta P)^-1."""
        eye = identity(plant.n)
        K = plant.A * solve(eye + P * (plant.S - eye * theta), eye)
        AZ = plant.A * Z
        return cls(middle(K), symmetric(AZ * AZ.transpose()), symmetric(M * M - M))

    def operator(self) -> list[list[Any]]:
        """dP -> K dP K' as a matrix on upper triangles."""
        K, upper = self.K.tolist(), upper_triangle(self.K.nrows())
        return [
            [K[i][k] * K[j][l] if k == l else K[i][k] * K[j][l] + K[i][l] * K[j][k] for k, l in upper]
            for i, j in upper
        ]

    def resolve(self, defect: Matrix) -> tuple[Matrix, Matrix]:
        """X and Y with X - K X K' = defect, Y - K Y K' = thrust."""
        from flint import arb_mat

        n = self.K.nrows()
        if n > MOST_DENSE:
            return self._doubled(defect), self._doubled(self.thrust)
        rows = [[(1 if a == b else 0) - x for b, x in enumerate(row)] for a, row in enumerate(self.operator())]
        right = [[defect[i, j], self.thrust[i, j]] for i, j in upper_triangle(n)]
        solution = solve(arb_mat(rows), arb_mat(right))
        return unpacked(solution, 0, n), unpacked(solution, 1, n)

    def _doubled(self, right: Matrix) -> Matrix:
        """sum_t K^t right K'^t by squaring (Smith's method), for a Schur K."""
        X, power = right, self.K
        for _ in range(MOST_DOUBLINGS):
            growth = power * X * power.transpose()
            X, power = symmetric(X + growth), middle(power * power)
            if max((abs(x) for x in power.entries()), default=0) < SETTLED:
                return X
        raise NoAnswer(f"the loop at fixed theta does not decay in 2^{MOST_DOUBLINGS} steps")
