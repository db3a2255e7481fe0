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
from tolnet.certificates.blocks import Bracket, between, end_of
from tolnet.certificates.exact_filter import ExactFilter, coordinates_of, frobenius_weights, matrix_from
from tolnet.certificates.fixed_point import Box, Enclosure, enclose
from tolnet.certificates.lookahead import Lookahead, contains
from tolnet.certificates.numerals import matrix_text, number_text, symmetric_matrix, symmetric_text, vector
from tolnet.certificates.recursion import Around, first_covariance, step

MOST_STEPS = 5000
MOST_BITS = 2**12
MOST_WORK = 2**21
"""Steps times bits of an orbit."""
_WELL_INSIDE = 0.9
"""Of the radius of the region: where an orbit in floating point counts as arrived."""
_WORTH = 50
"""Steps of an orbit that cost about as much as a bracket."""
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
    """Keys of a proved `convergence` claim from V_0 = `start`: `c`, `start`, `proof`; `box` is one of `find_box`.

    The way is looked for in floating point: so many steps into the region, or fewer into a bracket that closes.
    """
    found = enclose(exact, box)
    if isinstance(found, NotProved):
        return found
    with balls.working_precision(found.bits):
        region = find_region(found)
        if isinstance(region, NotProved):
            return region
        way = _find_way(found, region, start)
    if isinstance(way, NotProved):
        return way
    steps, bracket = way
    reason, bits = f"{steps} steps of the orbit are more than are tried", balls.BITS
    while bits <= MOST_BITS and steps * bits <= MOST_WORK:
        reason = _complaint_of_way(exact, found, region, start, steps, bracket, bits)
        if reason is None:
            held = {} if bracket is None else bracket.text()
            proof = {"box": box.text(), **region.text(), "steps": steps, "bits": bits, **held}
            return {"c": number_text(exact.c), "start": symmetric_text(start), "proof": proof}
        bits *= 2
    return NotProved(f"{reason}, with as many bits as are tried for so many steps")


def _find_way(at: Enclosure, region: Region, start: Float[ndarray, "n n"]) -> tuple[int, Bracket | None] | NotProved:
    """The number of steps to the region, or to a bracket that closes into it, whichever is less work."""
    look = Lookahead(at, region.L)
    i, j = np.triu_indices(at.equations.n)
    root = np.where(i == j, 1.0, np.sqrt(2.0))
    near = _WELL_INSIDE * region.radius

    def close(L: ndarray, U: ndarray) -> bool:
        middle, half = (L + U) / 2 - look.X, np.sqrt(np.maximum(np.diag(U - L) / 2, 0.0))
        size = (np.abs(middle) + np.outer(half, half))[i, j] * root
        return float(size @ np.abs(region.Y) @ size) <= near**2

    try:
        with np.errstate(all="ignore"):
            ends = look.bracket()
            blocks = None if ends is None else look.blocks(*ends, close)
            arrived: tuple[int, Bracket] | None = None
            for steps, X in enumerate(itertools.islice(look.orbit(start), MOST_STEPS), start=1):
                u = (X - look.X)[i, j] * root
                if u @ region.Y @ u <= near**2:
                    return steps, None
                if ends is not None and blocks is not None and arrived is None and contains(*ends, X):
                    lower, upper = (_symmetric(region.L @ M @ region.L.T) for M in ends)
                    arrived = steps, Bracket(lower, upper, blocks)
                if arrived is not None and steps - arrived[0] >= _WORTH:
                    return arrived
    except np.linalg.LinAlgError:
        return NotProved("the orbit has no numbers in floating point")
    return NotProved(f"the orbit is followed for {MOST_STEPS} steps, and was then not yet in the region around P*")


def _symmetric(M: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    """Symmetric as floating point does not leave it."""
    return (M + M.T) / 2


def verify_convergence(exact: ExactFilter, claim: dict[str, Any]) -> str | None:
    """Why a `convergence` claim does not hold as far as can be shown; None where it does."""
    proof, start = claim["proof"], symmetric_matrix(claim["start"])
    steps, bits = proof["steps"], proof["bits"]
    if not (1 <= steps <= MOST_STEPS and 64 <= bits <= MOST_BITS and steps * bits <= MOST_WORK):
        return "so many steps or bits are not tried"
    if start.shape != exact.A.shape or not np.isfinite(start).all():
        return f"the start is no finite symmetric {len(exact.A)} x {len(exact.A)} matrix"
    bracket = Bracket.read(proof) if any(key in proof for key in ("lower", "upper", "blocks")) else None
    complaint = None if bracket is None else bracket.complaint(len(exact.A))
    if complaint is not None:
        return complaint
    found = enclose(exact, Box.read(proof["box"]))
    if isinstance(found, NotProved):
        return found.reason
    region = Region.read(proof)
    with balls.working_precision(found.bits):
        complaint = region.complaint(found)
    return complaint or _complaint_of_way(exact, found, region, start, steps, bracket, bits)


def _complaint_of_way(
    exact: ExactFilter,
    at: Enclosure,
    region: Region,
    start: Float[ndarray, "n n"],
    steps: int,
    bracket: Bracket | None,
    bits: int,
) -> str | None:
    """Why the orbit from V_0 was not shown to reach the region, by so many steps and then by the bracket; or None."""
    with balls.working_precision(bits):
        try:
            end = NotProved("the orbit was not enclosed")
            for step_, end in enumerate(itertools.islice(_orbit(exact, start), steps)):
                if isinstance(end, NotProved):
                    return f"step {step_} of the orbit: {end.reason}"
            if isinstance(end, NotProved):
                return end.reason
            if bracket is None:
                inside = region.holds(at, region.seen(at, end.hull()))
                return None if inside else f"the orbit was not shown to be in the region after {steps} steps"
            ends = end_of(bracket, exact.equations(), exact.c, end.hull())
            if isinstance(ends, NotProved):
                return ends.reason
            if not region.holds(at, between(*(region.seen(at, M) for M in ends))):
                return f"the bracket does not lie in the region after {len(bracket.blocks)} blocks"
        except ZeroDivisionError:
            return "the orbit was not enclosed: a matrix that must be inverted may be singular"
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
