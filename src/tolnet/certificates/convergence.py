"""That the filter started at V_0 reaches its steady state: a validated orbit into a region of contraction.

The region is E = {P* + L D L': |D|_Y <= rho} with |D|_Y^2 = D' Y D in the coordinates D_ii, sqrt(2) D_ij. Where
J' Y J < rate^2 Y for the derivative J of D_t -> D_{t+1} at every point of E, a step maps E into itself and makes
|D|_Y smaller by that factor: from there the filter converges. docs/mathematics.md, section 11.8.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import balls
from tolnet.certificates.attraction import contracts, lyapunov, spectral_radius
from tolnet.certificates.balls import BallMatrix, NotProved
from tolnet.certificates.exact_filter import ExactFilter, coordinates_of, frobenius_weights, matrix_from
from tolnet.certificates.fixed_point import Box, Enclosure, enclose
from tolnet.certificates.numerals import matrix_text, number_text, symmetric_matrix, symmetric_text, vector
from tolnet.certificates.recursion import Around, first_covariance, step

MOST_STEPS = 5000
MOST_BITS = 2**12
MOST_WORK = 2**21
"""Steps times bits of an orbit."""
_TOO_LONG = NotProved("followed as far as is tried, the orbit had not reached the region around the steady state")
_USUAL_HALVINGS, _MOST_HALVINGS = 6, 40
_WIDENINGS = 4
_SHARE = 0.8
"""Of the way from the radius of J to 1: where the Lyapunov matrix is taken; the region is largest there."""
_LEFT = 0.02
"""Of that way, left between the rate and 1."""


@dataclass(frozen=True, eq=False)
class Region:
    """All P = P* + L D L' with D' Y D <= radius^2, on which a step contracts by `rate` in that norm.

    L, near a Cholesky factor of P*, makes a region around the identity of it, whatever the units of the states are.
    """

    L: Float[ndarray, "n n"]
    Y: Float[ndarray, "d d"]
    rate: float
    radius: float

    @classmethod
    def read(cls, proof: dict[str, Any]) -> Region:
        """The region of a certificate. Raises ValueError where a text is no number or no matrix."""
        L = vector(proof["factor"])
        n = math.isqrt(L.size)
        Y, rate, radius = symmetric_matrix(proof["Y"]), float.fromhex(proof["rate"]), float.fromhex(proof["radius"])
        return cls(L.reshape(n, n), Y, rate, radius)

    def text(self) -> dict[str, str]:
        """The region as a certificate holds it."""
        return {
            "factor": matrix_text(self.L),
            "Y": symmetric_text(self.Y),
            "rate": number_text(self.rate),
            "radius": number_text(self.radius),
        }

    def complaint(self, at: Enclosure) -> str | None:
        """Why this is no region of contraction as far as can be shown; None where it is one."""
        n = at.equations.n
        d = n * (n + 1) // 2
        if self.Y.shape != (d, d) or not np.isfinite(self.Y).all():
            return f"Y is no finite symmetric {d} x {d} matrix"
        if self.L.shape != (n, n) or not np.isfinite(self.L).all():
            return f"the factor is no finite {n} x {n} matrix"
        if not 0 < self.rate < 1 or not 0 < self.radius < np.inf:
            return "the rate does not lie between 0 and 1, or the radius is not above 0"
        if not self._contracts(at):
            return "the recursion was not shown to contract on the region"
        return None

    def _contracts(self, at: Enclosure) -> bool:
        """Whether J' Y J < rate^2 Y, 0 < P and theta P < I were shown at every P of the region.

        The ellipsoid is enclosed in a box. theta of every P: along the segment from P*, |dtheta| is at most
        theta |pull D| / swing, and as long as that bound, taken over an interval around theta*, is shorter than the
        interval, theta stays in it.
        """
        n, Y = at.equations.n, balls.matrix(self.Y)
        weights = frobenius_weights(n)
        try:
            if not balls.is_positive(Y):
                return False
            L = balls.matrix(self.L)
            equations, inverse = at.equations.seen_from(L), Y.inv()
            reach = [balls.ball(0, (inverse[i, i].sqrt() * self.radius).upper()) for i in range(len(weights))]
            X = balls.congruence(L.inv(), at.P) + matrix_from(reach, weights, n)
            if not balls.is_positive(X):
                return False
            theta, room = at.theta, balls.ball(0)
            for _ in range(_WIDENINGS):
                slope = equations.derivative(equations.at(X, theta, wide=True), weights)
                if slope.pull is None:
                    return contracts(slope.of_the_recursion(), Y, self.rate)
                spread = (slope.pull * inverse * slope.pull.transpose())[0, 0].sqrt() * self.radius
                move = abs(spread * theta / slope.swing).upper()
                if not move.is_finite():
                    return False
                if move < room:
                    return contracts(slope.of_the_recursion(), Y, self.rate)
                room = move * 1.25 + at.theta.rad() * 2.0**-20
                theta = balls.ball(at.theta.mid(), (at.theta.rad() + room).upper())
        except ZeroDivisionError:
            return False
        return False

    def seen(self, at: Enclosure, P: BallMatrix) -> BallMatrix:
        """D with P = P* + L D L'. Raises ZeroDivisionError."""
        return balls.congruence(balls.matrix(self.L).inv(), balls.symmetric_part(P - at.P))

    def holds(self, at: Enclosure, D: BallMatrix) -> bool:
        """Whether every symmetric matrix in D, such as `seen` gives, was shown to lie in the region."""
        u = balls.column(coordinates_of(D, frobenius_weights(at.equations.n)))
        return (u.transpose() * balls.matrix(self.Y) * u)[0, 0] <= balls.ball(self.radius) ** 2


def find_region(at: Enclosure) -> Region | NotProved:
    """A region of contraction, to a factor of two as large as can be shown. Assumes the working precision of `at`.

    Y is a Lyapunov matrix of J, as it is in coordinates in which P* is near the identity.
    """
    weights = frobenius_weights(at.equations.n)
    try:
        L = np.linalg.cholesky(balls.midpoints(at.P))
        back = balls.matrix(L).inv()
        equations = at.equations.seen_from(balls.matrix(L))
        X = balls.congruence(back, at.P)
        J = balls.midpoints(equations.derivative(equations.at(X, at.theta), weights).of_the_recursion())
    except (ZeroDivisionError, np.linalg.LinAlgError):
        return NotProved("the steady state is too near singular for a region around it to be found")
    own = spectral_radius(J)
    if not own < 1:
        return NotProved(f"the spectral radius of the derivative is about {own:.6g}")
    Y = lyapunov(J, own + _SHARE * (1 - own))
    if Y is None:
        return NotProved("no Lyapunov matrix was found for the derivative")

    def region(halvings: int) -> Region | None:
        # At first, D may have entries of a half: |D_i| <= radius, since Y >= I.
        tried = Region(L, Y, 1 - _LEFT * (1 - own), 0.5 / 2**halvings)
        return tried if tried.complaint(at) is None else None

    halvings = _USUAL_HALVINGS
    found = region(halvings)
    while found is None and halvings < _MOST_HALVINGS:
        halvings += 2
        found = region(halvings)
    while found is not None and halvings > 0:
        halvings -= 1
        larger = region(halvings)
        if larger is None:
            break
        found = larger
    return found or NotProved("no region around the steady state was shown to contract")


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
        if arrived is _TOO_LONG:
            return arrived
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
    # |D|_F <= radius / sqrt(lambda_min(Y)), so that entries of P further off than this need no second look.
    size = np.linalg.norm(region.L, axis=1)
    near = 2 * region.radius / np.sqrt(max(np.linalg.eigvalsh(region.Y)[0], 1e-300)) * np.outer(size, size)
    try:
        for steps, P in zip(range(1, min(most, MOST_STEPS) + 1), _orbit(exact, start), strict=False):
            if isinstance(P, NotProved):
                return NotProved(f"step {steps - 1} of the orbit: {P.reason}")
            if not (np.abs(balls.midpoints(P.middle) - centre) <= near).all():
                continue
            if region.holds(at, region.seen(at, P.hull())):
                return steps
    except ZeroDivisionError:
        return NotProved("the orbit was not enclosed: a matrix that must be inverted may be singular")
    return _TOO_LONG


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
        if isinstance(end, NotProved) or not region.holds(found, region.seen(found, end.hull())):
            return f"the orbit was not shown to be in the region after {steps} steps"
    return None


def _orbit(exact: ExactFilter, start: Float[ndarray, "n n"]) -> Iterator[Around | NotProved]:
    """P_1, P_2, ... from V_0 > 0, in balls of the working precision, until one cannot be enclosed."""
    V = balls.matrix(start)
    if not balls.is_positive(V):
        yield NotProved("the start was not shown to be positive definite")
        return
    equations = exact.equations()
    P: Around | NotProved = first_covariance(equations, V)
    while not isinstance(P, NotProved):
        yield P
        P = step(equations, P, exact.c)
    yield P
