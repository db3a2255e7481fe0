"""That the filter started at V_0 reaches its steady state: a validated orbit into a region of contraction.

The region is E = {P: |P - P*|_Y <= rho} with |D|_Y^2 = D' Y D in the coordinates D_ii, sqrt(2) D_ij. Where
J' Y J < rate^2 Y for the derivative J at every P of E, the step T maps E into itself and |T(P) - P*|_Y <=
rate |P - P*|_Y: from there the filter converges, by that factor a step. docs/mathematics.md, section 11.8.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import balls
from tolnet.certificates.attraction import balanced, contracts, lyapunov, spectral_radius
from tolnet.certificates.balls import BallMatrix, NotProved
from tolnet.certificates.exact_filter import (
    ExactFilter,
    congruence_matrix,
    coordinates_of,
    frobenius_weights,
    matrix_from,
)
from tolnet.certificates.fixed_point import Box, Enclosure, enclose
from tolnet.certificates.numerals import number_text, symmetric_matrix, symmetric_text
from tolnet.certificates.recursion import first_covariance, step

MOST_STEPS = 5000
MOST_BITS = 2**12
MOST_WORK = 2**21
"""Steps times bits of an orbit."""
_HALVINGS = 40
_SHARE = 0.8
"""Of the way from the radius of J to 1: where the Lyapunov matrix is taken; the region is largest there."""
_LEFT = 0.02
"""Of that way, left between the rate and 1."""


def region_contracts(at: Enclosure, Y: Float[ndarray, "d d"], rate: float, radius: float) -> bool:
    """Whether J' Y J < rate^2 Y was shown at every P with |P - P*|_Y <= radius, and that 0 < P, theta P < I there.

    Seen from X with P = L X L', L a Cholesky factor near that of P*, so that X* is near the identity; the ellipsoid
    is enclosed in a box. theta of every P: along the segment from P*, |dtheta| is at most theta |pull D| / swing, and
    as long as that bound, taken over an interval around theta*, is shorter than the interval, theta stays in it.
    """
    n = at.equations.n
    weights = frobenius_weights(n)
    try:
        L = balls.matrix(np.linalg.cholesky(balls.midpoints(at.P)))
        equations = at.equations.seen_from(L)
        back = L.inv()
        change = congruence_matrix(L, weights)
        metric = balls.congruence(change.transpose(), balls.matrix(Y))
        if not balls.is_positive(metric):
            return False
        inverse = metric.inv()
        reach = [balls.ball(0, (inverse[i, i].sqrt() * radius).upper()) for i in range(len(weights))]
        X = balls.congruence(back, at.P) + matrix_from(reach, weights, n)
        if not balls.is_positive(X):
            return False
        theta = at.theta
        for widening in (1.0, 1.5, 3.0):
            point = equations.at(X, theta, wide=True)
            slope = equations.derivative(point, weights)
            if slope.pull is None:
                return contracts(slope.of_the_recursion(), metric, rate)
            move = (slope.pull * inverse * slope.pull.transpose())[0, 0].sqrt() * radius * theta / slope.swing
            if not move.is_finite():
                return False
            if abs(move).upper() < theta.rad() - at.theta.rad():
                return contracts(slope.of_the_recursion(), metric, rate)
            theta = balls.ball(at.theta.mid(), at.theta.rad() + abs(move).upper() * 1.1 * widening)
    except (ZeroDivisionError, np.linalg.LinAlgError):
        return False
    return False


@dataclass(frozen=True, eq=False)
class Region:
    """All P with |P - P*|_Y <= radius, on which a step contracts by `rate`."""

    Y: Float[ndarray, "d d"]
    rate: float
    radius: float

    @classmethod
    def read(cls, proof: dict[str, Any]) -> Region:
        """The region of a certificate. Raises ValueError where a text is no number or no matrix."""
        return cls(symmetric_matrix(proof["Y"]), float.fromhex(proof["rate"]), float.fromhex(proof["radius"]))

    def text(self) -> dict[str, str]:
        """The region as a certificate holds it."""
        return {"Y": symmetric_text(self.Y), "rate": number_text(self.rate), "radius": number_text(self.radius)}

    def distance(self, P: Float[ndarray, "n n"], centre: Float[ndarray, "n n"]) -> float:
        """|P - P*|_Y in floating point."""
        i, j = np.triu_indices(len(P))
        u = (P - centre)[i, j] * np.where(i == j, 1.0, np.sqrt(2.0))
        return float(np.sqrt(u @ self.Y @ u))

    def complaint(self, at: Enclosure) -> str | None:
        """Why this is no region of contraction as far as can be shown; None where it is one."""
        d = len(frobenius_weights(at.equations.n))
        if self.Y.shape != (d, d) or not np.isfinite(self.Y).all():
            return f"Y is no finite symmetric {d} x {d} matrix"
        if not 0 < self.rate < 1 or not 0 < self.radius < np.inf:
            return "the rate does not lie between 0 and 1, or the radius is not above 0"
        if not region_contracts(at, self.Y, self.rate, self.radius):
            return "the recursion was not shown to contract on the region"
        return None

    def holds(self, at: Enclosure, P: BallMatrix) -> bool:
        """Whether every symmetric matrix in P was shown to lie in the region."""
        u = balls.column(coordinates_of(balls.symmetric_part(P - at.P), frobenius_weights(at.equations.n)))
        return (u.transpose() * balls.matrix(self.Y) * u)[0, 0] <= balls.ball(self.radius) ** 2


def find_region(at: Enclosure) -> Region | NotProved:
    """A region of contraction as large as halving its radius finds. Assumes the working precision of `at`.

    Y is a Lyapunov matrix of J seen from coordinates in which P* is near the identity.
    """
    weights = frobenius_weights(at.equations.n)
    try:
        L = balls.matrix(np.linalg.cholesky(balls.midpoints(at.P)))
        back = L.inv()
        equations = at.equations.seen_from(L)
        X = balls.congruence(back, at.P)
        J = balls.midpoints(equations.derivative(equations.at(X, at.theta), weights).of_the_recursion())
        seen = balls.midpoints(congruence_matrix(back, weights))
    except (ZeroDivisionError, np.linalg.LinAlgError):
        return NotProved("the steady state is too near singular for a region around it to be found")
    own = spectral_radius(J)
    if not own < 1:
        return NotProved(f"the spectral radius of the derivative is about {own:.6g}")
    s = balanced(J)
    Y = lyapunov(J * s / s[:, None], own + _SHARE * (1 - own))
    if Y is None:
        return NotProved("no Lyapunov matrix was found for the derivative")
    Y = Y / s / s[:, None]
    # In units in which X* = I, entries may move by a half: |D_i| <= radius sqrt((Y^-1)_ii), and Y >= diag(s)^-2.
    radius = 0.5 / float(s.max())
    Y = seen.T @ Y @ seen
    for _ in range(_HALVINGS):
        region = Region((Y + Y.T) / 2, 1 - _LEFT * (1 - own), radius)
        if region.complaint(at) is None:
            return region
        radius /= 2
    return NotProved("no region around the steady state was shown to contract")


def prove_convergence(exact: ExactFilter, box: Box, start: Float[ndarray, "n n"]) -> dict[str, Any] | NotProved:
    """Keys of a proved `convergence` claim from V_0 = `start`: `c`, `start`, `proof`; `box` is one of `find_box`."""
    found = enclose(exact, box)
    if isinstance(found, NotProved):
        return found
    with balls.working_precision(found.bits):
        region = find_region(found)
    if isinstance(region, NotProved):
        return region
    reason, bits = "", balls.BITS
    while bits <= MOST_BITS:
        with balls.working_precision(bits):
            arrived = _arrival(exact, found, region, start, MOST_WORK // bits)
        if not isinstance(arrived, NotProved):
            break
        reason, bits = arrived.reason, 2 * bits
    else:
        return NotProved(reason)
    keys = {
        "c": number_text(exact.c),
        "start": symmetric_text(start),
        "proof": {"box": box.text(), **region.text(), "steps": arrived, "bits": bits},
    }
    complaint = verify_convergence(exact, keys)
    return keys if complaint is None else NotProved(complaint)


def _arrival(
    exact: ExactFilter, at: Enclosure, region: Region, start: Float[ndarray, "n n"], most: int
) -> int | NotProved:
    """The first step at which the orbit from V_0 was shown to be in the region."""
    centre = balls.midpoints(at.P)
    try:
        for steps, P in zip(range(1, min(most, MOST_STEPS) + 1), _orbit(exact, start), strict=False):
            if isinstance(P, NotProved):
                return NotProved(f"step {steps - 1} of the orbit: {P.reason}")
            if region.distance(balls.midpoints(P), centre) <= 2 * region.radius and region.holds(at, P):
                return steps
    except ZeroDivisionError:
        return NotProved("the orbit was not enclosed: a matrix that must be inverted may be singular")
    return NotProved("followed as far as is tried, the orbit had not reached the region around the steady state")


def verify_convergence(exact: ExactFilter, claim: dict[str, Any]) -> str | None:
    """Why a `convergence` claim does not hold as far as can be shown; None where it does."""
    proof, start = claim["proof"], symmetric_matrix(claim["start"])
    steps, bits = proof["steps"], proof["bits"]
    if not (1 <= steps <= MOST_STEPS and 64 <= bits <= MOST_BITS and steps * bits <= MOST_WORK):
        return "so many steps or bits are not tried"
    if start.shape != exact.A.shape or not np.isfinite(start).all():
        return f"the start is no finite symmetric {len(exact.A)} x {len(exact.A)} matrix"
    found = enclose(exact, Box.read(proof["box"]))
    if isinstance(found, NotProved):
        return found.reason
    region = Region.read(proof)
    with balls.working_precision(found.bits):
        complaint = region.complaint(found)
    if complaint is not None:
        return complaint
    with balls.working_precision(bits):
        try:
            end = NotProved("the orbit was not enclosed")
            for end in itertools.islice(_orbit(exact, start), steps):
                if isinstance(end, NotProved):
                    return end.reason
        except ZeroDivisionError:
            return "the orbit was not enclosed: a matrix that must be inverted may be singular"
        if isinstance(end, NotProved) or not region.holds(found, end):
            return f"the orbit was not shown to be in the region after {steps} steps"
    return None


def _orbit(exact: ExactFilter, start: Float[ndarray, "n n"]) -> Iterator[BallMatrix | NotProved]:
    """P_1, P_2, ... from V_0 > 0, in balls of the working precision, until one cannot be enclosed."""
    V = balls.matrix(start)
    if not balls.is_positive(V):
        yield NotProved("the start was not shown to be positive definite")
        return
    equations = exact.equations()
    P: BallMatrix | NotProved = first_covariance(equations, V)
    while not isinstance(P, NotProved):
        yield P
        P = step(equations, P, exact.c)
    yield P
