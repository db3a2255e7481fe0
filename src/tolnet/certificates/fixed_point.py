"""Exact steady states: that one exists in a box, where exactly it lies, and how far a stated gain is from its gain.

Krawczyk's test on x = (P, theta): with m the middle of the box X, g(x) = [P - T(P, theta); gamma(P, theta) - c] and
any matrix B,

    m - B g(m) + (I - B g'(X)) (X - m)  inside X     proves exactly one zero of g in X, and it lies in the left-hand
                                                     side (R. Krawczyk, Computing 4, 1969)

Repeated from its own result, it encloses that zero as tightly as the working precision allows. docs/mathematics.md,
section 11.5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import balls
from tolnet.certificates.balls import Ball, BallMatrix, NotProved
from tolnet.certificates.clock import check_clock
from tolnet.certificates.exact_filter import Equations, ExactFilter, coordinates_of, matrix_from, upper
from tolnet.certificates.numerals import number_text, symmetric_matrix, symmetric_text

MOST_STATES = 30
"""The derivative is a matrix of n (n + 1) / 2 rows."""
_NEWTON_STEPS = 12
_PRECISIONS = (balls.BITS, 2 * balls.BITS, 6 * balls.BITS)
_MOST_REFINEMENTS = 8
_TIGHT = 2.0**-128
"""Relative radius at which an enclosure serves formulas in which half of the digits cancel; for large c, where
(I - theta P)^-1 is as large as c and enters several times, less."""


@dataclass(frozen=True, eq=False)
class Box:
    """All (P', theta') with |P'_ij - P_ij| <= radius sqrt(P_ii P_jj) and |theta' - theta| <= radius theta."""

    P: Float[ndarray, "n n"]
    theta: float
    radius: float

    @classmethod
    def read(cls, box: dict[str, str]) -> Box:
        """The box of a certificate. Raises ValueError where a text is no number or no matrix."""
        return cls(symmetric_matrix(box["P"]), float.fromhex(box["theta"]), float.fromhex(box["radius"]))

    def text(self) -> dict[str, str]:
        """The box as a certificate holds it."""
        return {
            "P": symmetric_text(self.P),
            "theta": number_text(self.theta),
            "radius": number_text(self.radius),
        }


@dataclass(frozen=True, eq=False)
class Enclosure:
    """The one steady state of a box, in balls of the precision `bits`, with 0 < P and theta P < I."""

    equations: Equations
    P: BallMatrix
    theta: Ball
    bits: int


class _Krawczyk:
    """g, g' and the operator, in coordinates u, P_ij = sqrt(P_ii P_jj) u_ij, and theta / |theta at the centre|."""

    def __init__(self, equations: Equations, P: BallMatrix, theta: Ball):
        self.equations = equations
        self.centre = P, theta
        roots = [P[i, i].sqrt() for i in range(equations.n)]
        self.weights = [roots[i] * roots[j] for i, j in upper(equations.n)]
        self.unit = theta

    def defect(self, P: BallMatrix, theta: Ball) -> BallMatrix:
        """g, the second part divided by c."""
        at = self.equations.at(P, theta)
        g = coordinates_of(P - self.equations.following(at), self.weights)
        if at.H is not None:
            g.append((self.equations.gamma(at) - self.equations.c) / self.equations.c)
        return balls.column(g)

    def slope(self, P: BallMatrix, theta: Ball) -> BallMatrix:
        """g'."""
        check_clock()
        at = self.equations.at(P, theta)
        change = self.equations.derivative(at, self.weights)
        d = change.loop.nrows()
        loop = balls.identity(d) - change.loop
        if change.pull is None:
            return loop
        push = (change.thrust * (-self.unit)).entries()
        rows = [[*row, last] for row, last in zip(loop.tolist(), push, strict=True)]
        scale = theta / self.equations.c
        rows.append([x * (theta * scale) for x in change.pull.entries()] + [change.swing * (scale * self.unit)])
        return balls.matrix_of(d + 1, d + 1, [x for row in rows for x in row])

    def moved(self, P: BallMatrix, theta: Ball, step: BallMatrix) -> tuple[BallMatrix, Ball]:
        """(P, theta) plus a step in the coordinates."""
        steps = step.entries()
        d = len(self.weights)
        P = P + matrix_from(steps[:d], self.weights, self.equations.n)
        return P, theta + self.unit * steps[d] if len(steps) > d else theta

    def image(self, steps: BallMatrix, B: BallMatrix) -> BallMatrix:
        """The operator's image of a box of steps from the centre, as such steps."""
        P, theta = self.centre
        middle = steps.mid()
        contraction = balls.identity(B.nrows()) - B * self.slope(*self.moved(P, theta, steps))
        return middle - B * self.defect(*self.moved(P, theta, middle)) + contraction * (steps - middle)


def find_box(exact: ExactFilter, P: Float[ndarray, "n n"], theta: float) -> Box | NotProved:
    """A box that `enclose` accepts, from a steady state in floating point: Newton's method, then a radius.

    `theta` must be 0 exactly where c = 0. NotProved where Newton's method does not settle, or no radius serves.
    """
    if len(P) > MOST_STATES:
        return NotProved(f"more than {MOST_STATES} states are not tried")
    if not (np.isfinite(P).all() and np.isfinite(theta) and (np.diag(P) > 0).all() and (theta > 0) == (exact.c > 0)):
        return NotProved("there is no steady state in floating point to begin with")
    for bits in _PRECISIONS:
        with balls.working_precision(bits):
            try:
                centre = _polished(exact.equations(), P, theta)
                if centre is None:
                    continue
                for radius in (2.0**-51, 2.0**-49, 2.0**-46, 2.0**-42, 2.0**-36):
                    box = Box(*centre, radius)
                    if isinstance(_enclose(exact, box), Enclosure):
                        return box
            except (ZeroDivisionError, ValueError, OverflowError):
                continue
    return NotProved("no box around the steady state in floating point passes Krawczyk's test")


def _polished(equations: Equations, P: ndarray, theta: float) -> tuple[ndarray, float] | None:
    """The doubles next to the zero that Newton's method finds from (P, theta)."""
    here, at = balls.matrix((P + P.T) / 2), balls.ball(theta)
    newton = _Krawczyk(equations, here, at)
    for _ in range(_NEWTON_STEPS):
        step = newton.slope(here, at).mid().inv() * newton.defect(here, at) * balls.ball(-1)
        here, at = newton.moved(here, at, step)
        here, at = balls.symmetric_part(here.mid()).mid(), at.mid()
        if balls.row_sum_norm(step) < 2.0**-60:
            rounded = balls.midpoints(here)
            return (rounded + rounded.T) / 2, float(at)
    return None


def enclose(exact: ExactFilter, box: Box) -> Enclosure | NotProved:
    """The one steady state in the box, or why that was not shown. Three precisions are tried."""
    complaint = _complaint(exact, box)
    if complaint is not None:
        return NotProved(complaint)
    reason = NotProved("")
    for bits in _PRECISIONS:
        with balls.working_precision(bits):
            try:
                found = _enclose(exact, box)
            except (ZeroDivisionError, ValueError, OverflowError):
                found = NotProved("a matrix that must be inverted may be singular in the box")
        if isinstance(found, Enclosure):
            return found
        reason = found
    return reason


def _complaint(exact: ExactFilter, box: Box) -> str | None:
    """What makes a filter or a box meaningless."""
    n = len(exact.A)
    if n > MOST_STATES:
        return f"more than {MOST_STATES} states are not tried"
    if box.P.shape != (n, n) or not np.array_equal(box.P, box.P.T):
        return f"the box is no symmetric {n} x {n} matrix"
    if not (np.isfinite(box.P).all() and math.isfinite(box.theta) and math.isfinite(exact.c)):
        return "the box or the tolerance is not finite"
    if not (np.diag(box.P) > 0).all() or not 0 < box.radius < 1:
        return "the box is empty, or as wide as the steady state"
    if exact.c < 0 or (box.theta > 0) != (exact.c > 0) or box.theta < 0:
        return "theta must be above 0 for c > 0, and 0 for c = 0"
    if not exact.process.is_symmetric:
        return "Q is not symmetric"
    return None


def _enclose(exact: ExactFilter, box: Box) -> Enclosure | NotProved:
    from flint import ctx

    equations = exact.equations()
    P, theta = balls.matrix(box.P), balls.ball(box.theta)
    test = _Krawczyk(equations, P, theta)
    size = len(test.weights) + (box.theta > 0)
    radii = balls.column([balls.ball(0, box.radius)] * size)
    B = test.slope(P, theta).mid().inv().mid()
    image = test.image(radii, B)
    if not all(r.contains_interior(x) for r, x in zip(radii.entries(), image.entries(), strict=True)):
        return NotProved(f"Krawczyk's test fails on the box of relative radius {box.radius:.1e}")
    tight = _TIGHT / max(1.0, exact.c) ** 3
    for _ in range(_MOST_REFINEMENTS):
        if balls.row_sum_norm(balls.column([x.rad() for x in image.entries()])) < tight:
            break
        tighter = test.image(image, B)
        image = balls.column([x.intersection(y) for x, y in zip(image.entries(), tighter.entries(), strict=True)])
    P, theta = test.moved(P, theta, image)
    if not equations.is_covariance(P, theta):
        return NotProved("0 < P and theta P < I were not shown")
    return Enclosure(equations, P, theta, ctx.prec)


def prove_steady_state(
    exact: ExactFilter, box: Box, gain: Sequence[Float[ndarray, "n _p"]] | None = None
) -> dict[str, Any] | NotProved:
    """Keys of a proved `steady-state` claim: `c`, `gain_error`, `proof`; `box` is one of `find_box`.

    `gain` is the stated gain, a matrix per sensor in the filter's order.
    """
    found = enclose(exact, box)
    if isinstance(found, NotProved):
        return found
    with balls.working_precision(found.bits):
        error = _gain_error(exact, found, gain or [])
    if error is None:
        return NotProved("the stated gain is zero, and the exact one is not, or it does not fit the sensors")
    keys = {"c": number_text(exact.c), "gain_error": number_text(error), "proof": {"box": box.text()}}
    reason = verify_steady_state(exact, keys, gain)
    return keys if reason is None else NotProved(reason)


def verify_steady_state(
    exact: ExactFilter, claim: dict[str, Any], gain: Sequence[Float[ndarray, "n _p"]] | None = None
) -> str | None:
    """Why a `steady-state` claim does not hold as far as can be shown; None where it does."""
    found = enclose(exact, Box.read(claim["proof"]["box"]))
    if isinstance(found, NotProved):
        return found.reason
    with balls.working_precision(found.bits):
        error = _gain_error(exact, found, gain or [])
    stated = float.fromhex(claim["gain_error"])
    if error is None or not error <= stated:
        return f"the stated gain may be further from the exact one than {stated:.2e} of its largest entry"
    return None


def gain_distance(exact: ExactFilter, box: Box, gain: Sequence[Float[ndarray, "n _p"]]) -> float | None:
    """How far a stated gain is from that of the steady state in the box, in units of states and outputs.

    The largest |entry_ij of stated - exact| sqrt(Sigma_jj / U_ii), Sigma = C V C' + R the covariance of innovations
    and U = A V A' + Q that of the prediction without them; None where no bound was found. Exact entries are at most 1
    in these units, since G Sigma G' <= A V A'; beside the largest entry, those of states in small units would vanish.
    """
    found = enclose(exact, box)
    if isinstance(found, NotProved) or len(gain) != len(exact.sensors):
        return None
    with balls.working_precision(found.bits):
        equations = found.equations
        at = equations.at(found.P, found.theta)
        V = found.P if at.H is None else balls.symmetric_part(at.H * found.P)
        prior = balls.congruence(equations.A, V) + equations.Q
        AZ, worst = equations.A * at.Z, balls.ball(0)
        for sensor, stated in zip(exact.sensors, gain, strict=True):
            if stated.shape != (equations.n, len(sensor.C)) or not np.isfinite(stated).all():
                return None
            innovation = balls.congruence(balls.matrix(sensor.C), V) + sensor.noise.balls()
            off = AZ * sensor.balls()[0] - balls.matrix(stated)
            for i in range(off.nrows()):
                for j in range(off.ncols()):
                    worst = worst.max((abs(off[i, j]) * (innovation[j, j] / prior[i, i]).sqrt()).upper())
        return balls.above(worst) if worst.is_finite() else None


def _gain_error(exact: ExactFilter, at: Enclosure, gain: Sequence[ndarray]) -> float | None:
    """An upper bound on the largest |entry of stated - exact gain| over the largest |stated entry|.

    The exact gain for sensor l is A (V^-1 + S)^-1 C_l' R_l^-1 = A Z C_l' R_l^-1.
    """
    if not gain:
        return 0.0
    n = len(exact.A)
    if len(gain) != len(exact.sensors):
        return None
    AZ = at.equations.A * at.equations.at(at.P, at.theta).Z
    worst, largest = balls.ball(0), max((float(np.abs(G).max(initial=0.0)) for G in gain), default=0.0)
    for sensor, stated in zip(exact.sensors, gain, strict=True):
        if stated.shape != (n, len(sensor.C)) or not np.isfinite(stated).all():
            return None
        for x in (AZ * sensor.balls()[0] - balls.matrix(stated)).entries():
            worst = worst.max(abs(x).upper())
    if worst.is_zero():
        return 0.0
    return balls.above(worst / largest) if largest > 0 else None
