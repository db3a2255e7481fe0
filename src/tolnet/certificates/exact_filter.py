"""One filter as an exact problem, and its equations in ball arithmetic.

A filter is A, Q, the sensors that it hears, S = sum C_l' R_l^-1 C_l, and a tolerance c; every double is the number
that it is. In balls, and in any coordinates of the state (Pi = I in the problem's own; docs/mathematics.md,
section 11.4):

    W = (I + P (S - theta Pi))^-1,  Z = W P,  K = A W,     T(P, theta) = A Z A' + Q
    H = (I - theta P Pi)^-1,                               gamma = log det(I - theta P Pi) + tr(H - I)
    N = Pi H P H' Pi
    dT = K dP K' + dtheta A Z Pi Z A',                     dgamma = theta (theta tr(N dP) + tr(N P) dtheta)

P need not be invertible, and P^-1 is never formed.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import balls
from tolnet.certificates.balls import Ball, BallMatrix


@dataclass(frozen=True, eq=False)
class Covariance:
    """A covariance X, given as it is or by a factor F with X = F F'."""

    matrix: Float[ndarray, "m k"]
    is_factor: bool = False

    def balls(self) -> BallMatrix:
        """X."""
        M = balls.matrix(self.matrix)
        return M * M.transpose() if self.is_factor else M

    @property
    def is_symmetric(self) -> bool:
        """Whether X is symmetric, exactly."""
        return self.is_factor or np.array_equal(self.matrix, self.matrix.T)


@dataclass(frozen=True, eq=False)
class Sensor:
    """y = C x + noise of covariance R; several filters may share one, which is then prepared once."""

    C: Float[ndarray, "p n"]
    noise: Covariance
    _prepared: dict[int, tuple[BallMatrix, BallMatrix]] = field(default_factory=dict, init=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Without what was prepared: balls do not travel between processes."""
        return {"C": self.C, "noise": self.noise, "_prepared": {}}

    def balls(self) -> tuple[BallMatrix, BallMatrix]:
        """C' R^-1 and C' R^-1 C. Raises ZeroDivisionError where R was not shown to be positive definite."""
        from flint import ctx

        if ctx.prec not in self._prepared:
            C, R = balls.matrix(self.C), self.noise.balls()
            if not (self.noise.is_symmetric and balls.is_positive(R)):
                raise ZeroDivisionError("the noise covariance of a sensor was not shown to be positive definite")
            weighted = C.transpose() * R.inv()
            self._prepared[ctx.prec] = weighted, balls.symmetric_part(weighted * C)
        return self._prepared[ctx.prec]


@dataclass(frozen=True, eq=False)
class ExactFilter:
    """A covariance recursion: P_{t+1} = A (V_t^-1 + S)^-1 A' + Q, gamma(P_{t+1}, theta_t) = c, eqs. (4), (8)."""

    A: Float[ndarray, "n n"]
    process: Covariance
    sensors: tuple[Sensor, ...]
    c: float
    """The tolerance, on the gamma scale."""

    def equations(self) -> Equations:
        """The same in balls of the working precision. Raises ZeroDivisionError where some R may be singular."""
        n = len(self.A)
        Q = self.process.balls()
        return Equations(balls.matrix(self.A), Q, information(self.sensors, n), balls.identity(n), balls.ball(self.c))


def information(sensors: tuple[Sensor, ...], n: int) -> BallMatrix:
    """S = sum of C' R^-1 C."""
    return sum((sensor.balls()[1] for sensor in sensors), balls.matrix(np.zeros((n, n))))


class Point(NamedTuple):
    """What the recursion and its derivative share at (P, theta)."""

    P: BallMatrix
    theta: Ball
    W: BallMatrix
    Z: BallMatrix
    H: BallMatrix | None
    """None for theta = 0."""


class Derivative(NamedTuple):
    """In coordinates u of symmetric matrices: du -> loop du + thrust dtheta, and what ties dtheta to du."""

    loop: BallMatrix
    thrust: BallMatrix
    """A column."""
    pull: BallMatrix | None
    """A row: d gamma = theta (theta pull du + swing dtheta). None for theta = 0."""
    swing: Ball
    theta: Ball

    def of_the_recursion(self) -> BallMatrix:
        """J of P_t -> P_{t+1} with gamma kept at c: dtheta = -theta pull du / swing."""
        if self.pull is None:
            return self.loop
        return self.loop - self.thrust * self.pull * (self.theta / self.swing)


@dataclass(frozen=True, eq=False)
class Equations:
    """A, Q, S, the metric Pi of the state's coordinates and c, all in balls."""

    A: BallMatrix
    Q: BallMatrix
    S: BallMatrix
    metric: BallMatrix
    c: Ball

    @property
    def n(self) -> int:
        """Number of states."""
        return self.A.nrows()

    def seen_from(self, L: BallMatrix) -> Equations:
        """The equations of X where P = L X L'."""
        back = L.inv()
        over = L.transpose()
        return Equations(
            back * self.A * L,
            balls.congruence(back, self.Q),
            balls.congruence(over, self.S),
            balls.congruence(over, self.metric),
            self.c,
        )

    def at(self, P: BallMatrix, theta: Ball, *, wide: bool = False) -> Point:
        """The point (P, theta). `wide` where the radii are no longer small. Raises ZeroDivisionError."""
        n = self.n
        one = balls.identity(n)
        inverse = balls.inverse_of_wide if wide else _inverse
        W = inverse(one + P * (self.S - self.metric * theta))
        H = None if theta.is_zero() else inverse(one - P * self.metric * theta)
        return Point(P, theta, W, balls.symmetric_part(W * P), H)

    def following(self, at: Point) -> BallMatrix:
        """T(P, theta)."""
        return balls.congruence(self.A, at.Z) + self.Q

    def gamma(self, at: Point) -> Ball:
        """gamma(P, theta), eq. (4), on the branch theta P < I."""
        if at.H is None:
            return balls.ball(0)
        one = balls.identity(self.n)
        return (one - at.P * self.metric * at.theta).det().log() + at.H.trace() - self.n

    def is_covariance(self, P: BallMatrix, theta: Ball) -> bool:
        """Whether 0 < P and theta P < I were shown."""
        return balls.is_positive(P) and self.is_inside(P, theta)

    def is_inside(self, P: BallMatrix, theta: Ball) -> bool:
        """Whether theta P Pi < I was shown, by its symmetric equivalent Pi - theta Pi P Pi > 0."""
        return balls.is_positive(self.metric - balls.congruence(self.metric, P) * theta)

    def derivative(self, at: Point, weights: list[Ball]) -> Derivative:
        """The derivative in the coordinates u with P_ij = P_ji = weight_ij u_ij, i <= j."""
        pairs = upper(self.n)
        loop = congruence_matrix(self.A * at.W, weights)
        AZ = self.A * at.Z
        push = AZ * self.metric * AZ.transpose()
        thrust = balls.column([push[i, j] / w for (i, j), w in zip(pairs, weights, strict=True)])
        if at.H is None:
            return Derivative(loop, thrust, None, balls.ball(0), at.theta)
        N = balls.congruence(self.metric, balls.congruence(at.H, at.P))
        entries = [N[i, j] * w if i == j else 2 * N[i, j] * w for (i, j), w in zip(pairs, weights, strict=True)]
        pull = balls.matrix_of(1, len(pairs), entries)
        return Derivative(loop, thrust, pull, (N * at.P).trace(), at.theta)


def _inverse(M: BallMatrix) -> BallMatrix:
    return M.inv()


@lru_cache
def upper(n: int) -> list[tuple[int, int]]:
    """The index pairs i <= j, row by row."""
    return list(itertools.combinations_with_replacement(range(n), 2))


def congruence_matrix(K: BallMatrix, weights: list[Ball]) -> BallMatrix:
    """The matrix of dP -> K dP K' in the coordinates u with dP_ij = weight_ij u_ij, i <= j."""
    pairs = upper(K.nrows())
    rows = K.tolist()
    back = [1 / w for w in weights]
    entries = []
    for (a, b), scale in zip(pairs, back, strict=True):
        x, y = rows[a], rows[b]
        outer = [[p * q for q in y] for p in x]
        entries += [
            (outer[i][j] if i == j else outer[i][j] + outer[j][i]) * (scale * w)
            for (i, j), w in zip(pairs, weights, strict=True)
        ]
    return balls.matrix_of(len(pairs), len(pairs), entries)


def frobenius_weights(n: int) -> list[Ball]:
    """Of the coordinates P_ii and sqrt(2) P_ij, whose Euclidean norm is the Frobenius norm."""
    half = balls.ball(0.5).sqrt()
    return [balls.ball(1) if i == j else half for i, j in upper(n)]


def matrix_from(coordinates: list[Ball], weights: list[Ball], n: int) -> BallMatrix:
    """The symmetric matrix of coordinates."""
    entries = {pair: w * u for pair, w, u in zip(upper(n), weights, coordinates, strict=True)}
    return balls.matrix_of(n, n, [entries[min(i, j), max(i, j)] for i in range(n) for j in range(n)])


def coordinates_of(P: BallMatrix, weights: list[Ball]) -> list[Ball]:
    """The coordinates of a symmetric matrix."""
    return [P[i, j] / w for (i, j), w in zip(upper(P.nrows()), weights, strict=True)]
