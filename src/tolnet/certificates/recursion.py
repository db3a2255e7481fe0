"""The covariance recursion, step by step, in balls.

theta_t is enclosed by one step of the interval Newton method on gamma(P, theta) = c: with dgamma/dtheta =
theta tr((HP)^2) over an interval X around an approximate root t, t - (gamma(P, t) - c) / dgamma/dtheta inside X
proves that the root of every P in the enclosure lies there; theta P < I on X says that it is the root that is meant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import balls
from tolnet.certificates.balls import Ball, BallMatrix, NotProved
from tolnet.certificates.clock import check_clock
from tolnet.certificates.exact_filter import Equations, Point

_NEWTON_STEPS = 100
_WIDENINGS = 4


def approximate_excess(eigenvalues: Float[ndarray, " n"], c: float) -> Float[ndarray, " n"]:
    """mu_i = v_i / lambda_i - 1 of V with gamma(P, theta) = c, in floating point; NaN where there is none.

    Newton's method on the largest, mu: mu_i = r_i mu / (1 + (1 - r_i) mu), r_i = lambda_i / lambda_1
    (docs/mathematics.md, (2.3)). Assumes rising order.
    """
    if not eigenvalues[-1] > 0 or not np.isfinite(eigenvalues).all():
        return np.full_like(eigenvalues, 0.0 if c == 0 else np.nan)
    if c == 0:
        return np.zeros_like(eigenvalues)
    r = np.maximum(eigenvalues / eigenvalues[-1], 0.0)
    mu = np.sqrt(2 * c / (r @ r)) + c / len(r)
    for _ in range(_NEWTON_STEPS):
        below = 1 + (1 - r) * mu
        excess = r * mu / below
        value = _divergence(excess).sum()
        slope = (excess / (1 + excess) * r / below**2).sum() * mu
        move = np.log(value / c) * value / slope
        mu *= np.exp(-np.clip(move, -5, 5))
        if abs(move) < 1e-13:
            break
    return r * mu / (1 + (1 - r) * mu)


def approximate_theta(P: Float[ndarray, "n n"], c: float) -> float:
    """theta with gamma(P, theta) = c in floating point; NaN where there is none."""
    if not np.isfinite(P).all():
        return np.nan
    eigenvalues = np.linalg.eigvalsh(P)
    mu = float(approximate_excess(eigenvalues, c)[-1])
    return 0.0 if c == 0 else mu / (1 + mu) / float(eigenvalues[-1])


def _divergence(excess: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """mu - log(1 + mu), by its series where that would cancel."""
    series = excess**2 * (0.5 - excess * (1 / 3 - excess * (0.25 - excess * 0.2)))
    return np.where(excess < 1e-3, series, excess - np.log1p(excess))


class Around(NamedTuple):
    """Every symmetric P with -spread <= P - middle <= spread, in the order of definiteness; the middle is exact."""

    middle: BallMatrix
    spread: BallMatrix

    @classmethod
    def of(cls, M: BallMatrix, spread: BallMatrix | None = None) -> Around:
        """What lies around some matrix in M."""
        n = M.nrows()
        M = balls.symmetric_part(M)
        rows = M.tolist()
        radii = [sum((x.rad() for x in row), balls.ball(0)).upper() for row in rows]
        shift = balls.matrix_of(n, n, [radii[i] if i == j else balls.ball(0) for i in range(n) for j in range(n)])
        return cls(M.mid(), shift if spread is None else balls.outward(spread + shift, 1))

    def hull(self) -> BallMatrix:
        """All of it, entry by entry: |P - middle|_ij <= sqrt(spread_ii spread_jj)."""
        n = self.middle.nrows()
        root = [abs(self.spread[i, i]).upper().sqrt() for i in range(n)]
        return self.middle + balls.matrix_of(n, n, [balls.ball(0, (x * y).upper()) for x in root for y in root])


def first_covariance(equations: Equations, V: BallMatrix) -> Around:
    """P_1 = A (V_0^-1 + S)^-1 A' + Q."""
    return Around.of(equations.following(equations.at(V, balls.ball(0))))


def step(equations: Equations, P: Around, c: float) -> Around | NotProved:
    """P_{t+1} for every P_t around a middle. `c` is the tolerance, once more, as a double. Raises ZeroDivisionError.

    The middle is stepped as tightly as the precision allows. A deviation E, -W <= E <= W, becomes K E K' + dtheta M
    with M = A Z Z A' and |dtheta| <= theta tr(N W) / tr(N P), at some point of the segment; so the spread becomes
    K W K' + |dtheta| M, which grows far more slowly than radii of entries do.
    """
    theta = enclose_theta(equations, P.middle, c)
    if isinstance(theta, NotProved):
        return theta
    following = equations.following(_without_H(equations, P.middle, theta))
    hull, reach, room = P.hull(), theta, balls.ball(0)
    for _ in range(_WIDENINGS):
        at = equations.at(hull, reach)
        AZ, loop = equations.A * at.Z, equations.A * at.W
        if at.H is None:
            return Around.of(following, balls.congruence(loop, P.spread))
        N = balls.congruence(at.H, hull)
        move = abs(reach * (N * P.spread).trace() / (N * hull).trace()).upper()
        if not move.is_finite():
            break
        if move < room:
            spread = balls.congruence(loop, P.spread) + AZ * AZ.transpose() * move
            return Around.of(following, spread)
        room = move * 1.25 + theta.rad() * 2.0**-20
        reach = balls.ball(theta.mid(), (theta.rad() + room).upper())
    return NotProved("theta was not enclosed")


def _without_H(equations: Equations, P: BallMatrix, theta: Ball) -> Point:
    """The point (P, theta), where only the recursion is wanted."""
    W = (balls.identity(equations.n) + P * (equations.S - equations.metric * theta)).inv()
    return Point(P, theta, W, balls.symmetric_part(W * P), None)


def enclose_theta(equations: Equations, P: BallMatrix, c: float) -> Ball | NotProved:
    """The theta with gamma(P, theta) = c of every P in an enclosure. Assumes Pi = I."""
    from flint import ctx

    check_clock()
    if c == 0:
        return balls.ball(0)
    near = approximate_theta(balls.midpoints(P), c)
    if not 0 < near < np.inf:
        return NotProved("theta has no value in floating point to begin with")
    theta = balls.ball(near)
    middle = P.mid()
    for _ in range(max(1, ctx.prec // 40).bit_length() + 1):
        value, slope = _gamma(middle, theta)
        theta = (theta - (value - equations.c) / slope).mid()
    value, slope = _gamma(P, theta)
    newton = (value - equations.c) / slope
    unit = theta * balls.ball(2) ** (4 - ctx.prec)  # the root itself is rounded to the working precision
    X = balls.ball(theta, (abs(newton) * 2 + unit).upper())
    _, slope = _gamma(P, X)
    root = theta - (value - equations.c) / slope
    if not (X > 0 and X.contains_interior(root) and equations.is_inside(P, X)):
        return NotProved("theta was not enclosed")
    return root


def _gamma(P: BallMatrix, theta: Ball) -> tuple[Ball, Ball]:
    """gamma and its derivative in theta: log det(I - theta P) + theta tr(HP), and theta tr((HP)^2)."""
    inflated = balls.identity(P.nrows()) - P * theta
    V = inflated.inv() * P
    return inflated.det().log() + theta * V.trace(), theta * (V * V).trace()
