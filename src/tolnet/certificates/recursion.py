"""The covariance recursion, step by step, in balls.

theta_t is enclosed by one step of the interval Newton method on gamma(P, theta) = c: with dgamma/dtheta =
theta tr((HP)^2) over an interval X around an approximate root t, t - (gamma(P, t) - c) / dgamma/dtheta inside X
proves that the root of every P in the enclosure lies there; theta P < I on X says that it is the root that is meant.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import balls
from tolnet.certificates.balls import Ball, BallMatrix, NotProved
from tolnet.certificates.exact_filter import Equations, Point

_NEWTON_STEPS = 100


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


def first_covariance(equations: Equations, V: BallMatrix) -> BallMatrix:
    """P_1 = A (V_0^-1 + S)^-1 A' + Q."""
    return equations.following(equations.at(V, balls.ball(0)))


def step(equations: Equations, P: BallMatrix, c: float) -> BallMatrix | NotProved:
    """P_{t+1} for every P_t in P. `c` is the tolerance, once more, as a double. Raises ZeroDivisionError."""
    theta = enclose_theta(equations, P, c)
    if isinstance(theta, NotProved):
        return theta
    return equations.following(_without_H(equations, P, theta))


def _without_H(equations: Equations, P: BallMatrix, theta: Ball) -> Point:
    """The point (P, theta), where only the recursion is wanted."""
    W = (balls.identity(equations.n) + P * (equations.S - equations.metric * theta)).inv()
    return Point(P, theta, W, balls.symmetric_part(W * P), None)


def enclose_theta(equations: Equations, P: BallMatrix, c: float) -> Ball | NotProved:
    """The theta with gamma(P, theta) = c of every P in an enclosure. Assumes Pi = I."""
    from flint import ctx

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
    X = balls.ball(theta, abs(newton).upper() * 2)
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
