"""One filter's steady state in extended precision, for those that doubles cannot decide (docs/mathematics.md, 4.8).

The data are doubles and exact; what rounding takes from the stacked solver (units that span twenty decades, one axis
seen a billion times more precisely than another, chains of integrators) comes out of a reserve of 300 bits. The same
equations, one filter at a time:

1.  S = sum C_l' R_l^-1 C_l over the rows that are heard, Q = B B' where B was given: never through rounded sums
2.  theta = 0, then theta in a bracket: P = A P (I + (S - theta I) P)^-1 A' + Q by doubling
3.  Newton's method on (P, theta) together:  dP - K dP K' - A Z Z A' dtheta = T - P,  d log gamma = log(c / gamma)
4.  past the fold a path in c, by line 3
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.divergence import inflate, scalar_excess
from tolnet.analysis.extended_algebra import (
    Matrix,
    NoAnswer,
    identity,
    inverse_units,
    matrix,
    middle,
    number,
    pivots,
    radius,
    radius_with_error,
    rounded,
    solve,
    symmetric,
    upper_triangle,
)
from tolnet.analysis.extended_equations import (
    MOST_DENSE,
    Count,
    Plant,
    Slope,
    accept,
    doubling,
    gamma_and_inverse,
    newton,
    step,
)
from tolnet.analysis.extended_path import follow

MOST_SEARCH = 80
_HAIR = 2.0**-133  # a relative change far below doubles and far above the working precision
_NEAR = 0.05


@dataclass(frozen=True)
class Extended:
    """A steady state, rounded to doubles once, at the end."""

    P: Float[ndarray, "n n"]
    V: Float[ndarray, "n n"]
    filtered: Float[ndarray, "n n"]
    """Z = (V^-1 + S)^-1."""
    gain: Float[ndarray, "n m"] | None
    """A Z C' R^-1, where C and R are known."""
    theta: float
    spectral_radius: float
    attraction: float
    """NaN at c > 0 for more than MOST_DENSE states: the derivative is left to Arnoldi's method in doubles."""
    riccati_residual: float
    tolerance_residual: float
    iterations: int
    error: float = float(np.finfo(float).eps)
    """What rounding to doubles leaves."""


def noise_covariance(B: Float[ndarray, "n m"] | None, Q: Float[ndarray, "n n"]) -> Matrix:
    """B B' where the factor was given, without its rounding; else Q."""
    if B is None:
        return matrix(Q)
    factor = matrix(B)
    return middle(factor * factor.transpose())


def information(n: int, sensors: Sequence[tuple[ndarray, ndarray]]) -> tuple[Matrix, Matrix]:
    """S = sum C' R^-1 C over (C, R), and all C' R^-1 side by side."""
    from flint import arb_mat

    S, columns = matrix(np.zeros((n, n))), []
    for C, R in sensors:
        if len(C):
            Y = matrix(C)
            weighted = solve(matrix(R), Y)
            S = S + Y.transpose() * weighted
            columns += weighted.tolist()
    return symmetric(S), arb_mat(columns).transpose() if columns else arb_mat(n, 0)


def solve_extended(
    plant: Plant,
    c: float,
    *,
    near: tuple[Float[ndarray, "n n"], float] | None = None,
    undriven: bool = False,
    only_near: bool = False,
) -> tuple[Extended, Matrix, Matrix]:
    """The steady state at tolerance c, gamma scale, with its P and V before rounding.

    `near` is a guess (P, theta) in doubles, `only_near` tries no other start. `undriven` says that modes outside the
    unit circle are not driven, so that the stabilising solution is not the one that is reached from P = 0. Raises
    NoAnswer. Kullback-Leibler balls only. Assumes detectability, and no undriven mode on the unit circle.
    """
    count = Count()
    if near is not None:
        try:
            return _finish(plant, c, *newton(plant, c, symmetric(matrix(near[0])), number(near[1]), count), count)
        except (NoAnswer, ZeroDivisionError) as end:
            if only_near:
                raise NoAnswer(str(end)) from None
    try:
        P, theta = _from_kalman(plant, c, undriven, count)
    except ZeroDivisionError:
        raise NoAnswer("a matrix of the recursion is singular") from None
    return _finish(plant, c, P, theta, count)


def seen_tolerance(plant: Plant, P: Matrix, V: Matrix) -> float:
    """c_k = tr(P_k^-1 X) - log det(I + P_k^-1 X), X = V - P, eqs. (30), (42): the centre's P, V, the node's S.

    P_k is singular where P is, in directions in which X is zero: a hair is added to it there. NaN where that fails.
    """
    n, A = plant.n, plant.A
    local = symmetric(A * solve(identity(n) + V * plant.S, V) * A.transpose() + plant.Q)
    for i in range(n):
        local[i, i] += local[i, i] * _HAIR if local[i, i] > 0 else number(1)
    X = symmetric(V - P)
    before, after = pivots(local), pivots(local + X)
    if before is None or after is None:
        return math.nan
    logarithm = sum(((b / a).log() for a, b in zip(before, after, strict=True)), number(0))
    return float((solve(local, X).trace() - logarithm).mid())


def _from_kalman(plant: Plant, c: float, undriven: bool, count: Count) -> tuple[Matrix, Any]:
    """Lines 2 to 4, from the Kalman filter's P."""
    start = identity(plant.n) if undriven else None
    kalman = doubling(plant, number(0), start, count)
    if c == 0:
        return kalman, number(0)
    if not rounded(kalman).any():
        raise NoAnswer("without process noise the covariance falls to zero")
    P, theta, reached = _search(plant, c, kalman, start, count)
    if reached == c:
        return P, theta
    try:
        return newton(plant, c, P, theta, count)
    except (NoAnswer, ZeroDivisionError):
        return follow(plant, c, P, theta, reached, count)


def _search(plant: Plant, c: float, kalman: Matrix, start: Matrix | None, count: Count) -> tuple[Matrix, Any, float]:
    """A steady state at fixed theta whose gamma is near c, or the largest below; as `continuation.search`."""
    wanted, values = _phi(c), np.linalg.eigvalsh(rounded(kalman))
    low, high = 0.0, float(inflate(np.maximum(values, 0.0)[None], np.array([c])).theta[0])
    P, at, reached = kalman, 0.0, 0.0
    before, psi_before = 0.0, 1.0 / float(np.linalg.norm(rounded(kalman)))
    theta = min(wanted * psi_before, high)
    for _ in range(MOST_SEARCH):
        try:
            solution = doubling(plant, number(theta), start, count)
            value = float(gamma_and_inverse(solution, number(theta))[0].mid())
        except (NoAnswer, ZeroDivisionError):
            solution, value = kalman, math.inf
        phi = _phi(value)
        near = math.isfinite(value) and abs(phi / wanted - 1) < _NEAR and abs(math.log(value / c)) < _NEAR**0.5
        if near or reached < value < c:
            P, at, reached = solution, theta, value
        if near:
            break
        low, high = (max(low, theta), high) if value < c else (low, min(high, theta))
        middle = (low + high) / 2
        if math.isfinite(value) and theta != before:
            psi = theta / phi
            rise = (psi - psi_before) / (theta - before)
            before, psi_before = theta, psi
            bend = 1 / wanted - rise
            secant = (psi - rise * theta) / bend if bend else middle
            theta = secant if low < secant < high else middle
        else:
            theta = middle
        if high - low <= 1e-9 * high:
            break
    return P, number(at), reached


def _phi(value: float) -> float:
    """s with gamma(1, s) = value, 1 where that is infinite."""
    if not math.isfinite(value):
        return 1.0
    excess = float(scalar_excess(np.array([value]))[0])
    return excess / (1 + excess)


def _finish(plant: Plant, c: float, P: Matrix, theta: Any, count: Count) -> tuple[Extended, Matrix, Matrix]:
    """Everything that a steady state holds, each rounded once."""
    riccati, mismatch = accept(plant, c, P, theta)
    eye = identity(plant.n)
    _, M = gamma_and_inverse(P, theta)
    V = symmetric(P * M)
    _, Z = step(plant, P, theta)
    loop = plant.A * solve(eye + V * plant.S, eye)  # A Z V^-1
    units = inverse_units(V)
    spectral_radius = _radius_in_units(loop, [units[i, i] for i in range(plant.n)])
    if c == 0 and not spectral_radius < 1:
        raise NoAnswer("rounding hides whether the Riccati solution stabilises")
    attraction = spectral_radius**2  # at c = 0 the derivative is M dP M'
    if c > 0:
        slope = Slope.at(plant, P, theta, Z, M)
        attraction = _attraction(slope, P, theta) if plant.n <= MOST_DENSE else math.nan
    state = Extended(
        P=rounded(P),
        V=rounded(V),
        filtered=rounded(Z),
        gain=None if plant.weighted is None else rounded(plant.A * Z * plant.weighted),
        theta=float(theta),
        spectral_radius=spectral_radius,
        attraction=attraction,
        riccati_residual=riccati,
        tolerance_residual=mismatch,
        iterations=count.total,
    )
    return state, P, V


def _attraction(slope: Slope, P: Matrix, theta: Any) -> float:
    """Spectral radius of dP -> K dP K' + thrust dtheta with dtheta = -theta tr(pull dP) / tr(pull P).

    In the units of P, where doubles usually do: eigenvalues come with their condition number.
    """
    from flint import arb_mat

    units, upper = inverse_units(P), upper_triangle(P.nrows())
    weight = (slope.pull * P).trace()
    factor = theta / weight if theta > 0 else number(0)
    pull = [factor * (1 if k == l else 2) * slope.pull[k, l] for k, l in upper]
    rows = [
        [
            (x - slope.thrust[i, j] * a) * units[i, j] / units[k, l]
            for x, a, (k, l) in zip(row, pull, upper, strict=True)
        ]
        for (i, j), row in zip(upper, slope.operator(), strict=True)
    ]
    whole = middle(arb_mat(rows))
    found, error = radius_with_error(rounded(whole))
    return radius(whole) if error > 1e-9 * found else found


def _radius_in_units(F: Matrix, inverse_variances: list[Any]) -> float:
    """Spectral radius: in doubles and in the units of the states where that keeps nine digits."""
    from flint import arb_mat

    n, inverse = F.nrows(), [x.sqrt() for x in inverse_variances]
    scaled = arb_mat([[F[i, j] * inverse[i] / inverse[j] for j in range(n)] for i in range(n)])
    found, error = radius_with_error(rounded(scaled))
    return found if error <= 1e-9 * found else radius(F)
