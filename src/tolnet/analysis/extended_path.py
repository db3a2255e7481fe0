"""The curve of steady states (P, theta, log c), followed by its length (docs/mathematics.md, 4.6)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tolnet.analysis.extended_algebra import (
    Matrix,
    NoAnswer,
    distance,
    inverse_units,
    middle,
    number,
    rounded,
    solve,
    unpacked,
    upper_triangle,
    zeros,
)
from tolnet.analysis.extended_equations import MOST_DENSE, Count, Plant, Slope, gamma_and_inverse, newton, step

MOST_STRIDES = 1000
_FARTHEST = 0.15  # relative change of P from a point between two of the path
_LONGEST = 0.7  # stride of the path: about a doubling of P
_RUN_OFF = 230.0  # growth of log tr P, a hundred decades, after which the path is taken to lead to infinity
_PATH_START = 1e-7


def follow(plant: Plant, c: float, P: Matrix, theta: Any, reached: float, count: Count) -> tuple[Matrix, Any]:
    """Line 4: strides along the curve (P, theta, log c) of steady states, until log c has come to its goal.

    The length of a stride counts P in the units of its states and log c; theta follows. So the path goes round
    turning points in theta and in c, and through the narrow ranges of c in which P grows by many decades.
    """
    n, goal = plant.n, math.log(c)
    if n > MOST_DENSE:
        raise NoAnswer(f"beyond the fold filters of up to {MOST_DENSE} states are followed")
    if reached == 0:
        reached = min(_PATH_START, c)
        theta = number(math.sqrt(2 * reached) / float(np.linalg.norm(rounded(P))))
    P, theta = newton(plant, reached, P, theta, count)
    first, at, stride = P.trace(), number(reached).log(), 0.25
    tangent = _Direction(zeros(n), number(0), number(1))
    for _ in range(MOST_STRIDES):
        system = _Bordered.at(plant, P, theta, at, tangent)
        ahead = system.solve(zeros(n), number(0), number(1))
        tangent = ahead.over(ahead.norm(system.units))
        while True:
            there = _correct(plant, P, theta, at, tangent, stride, count)
            if there is not None:
                break
            stride /= 3
            if stride < 1e-9:
                raise NoAnswer(f"the path of steady states ends at c = {float(at.exp()):.6g}")
        if float(there[2]) >= goal:
            share = (number(goal) - at) / (there[2] - at)
            between = (middle(P + (there[0] - P) * share), (theta + (there[1] - theta) * share).mid())
            try:
                last = newton(plant, c, *between, count)
                if distance(between[0], last[0]) <= _FARTHEST:
                    return last
            except (NoAnswer, ZeroDivisionError):
                pass
            if stride < 1e-6:
                raise NoAnswer("the path of steady states passes c too steeply to stop at it")
            stride /= 5  # the same stretch again, in smaller strides
            continue
        P, theta, at = there
        if float((P.trace() / first).log()) > _RUN_OFF:
            raise NoAnswer(f"the steady states grow without bound before c = {float(at.exp()):.6g}")
        stride = min(1.6 * stride, _LONGEST)
    raise NoAnswer(f"the path in c came to {float(at.exp()):.6g} in {MOST_STRIDES} strides")


def _correct(
    plant: Plant, P: Matrix, theta: Any, at: Any, tangent: _Direction, stride: float, count: Count
) -> tuple[Matrix, Any, Any] | None:
    """The steady state a stride ahead, by Newton's method across the tangent; None unless it settles nearby."""
    move = tangent.over(1 / number(stride))
    goal = (middle(P + move.P), theta + move.theta, at + move.log_c)
    there, moved = goal, math.inf
    try:
        for _ in range(8):
            count.total += 1
            system = _Bordered.at(plant, *there, tangent)
            change = system.solve(*system.defects(), number(0))
            there = (middle(there[0] + change.P), (there[1] + change.theta).mid(), (there[2] + change.log_c).mid())
            moved = float(change.norm(system.units))
            if not moved < 0.5 * stride:
                return None
            if moved < 1e-12:
                return there if there[1] > 0 else None
    except (NoAnswer, ZeroDivisionError):
        pass
    return None


@dataclass(frozen=True)
class _Direction:
    """A change of (P, theta, log c)."""

    P: Matrix
    theta: Any
    log_c: Any

    def over(self, size: Any) -> _Direction:
        """This direction divided by a number."""
        return _Direction(middle(self.P / size), (self.theta / size).mid(), (self.log_c / size).mid())

    def norm(self, units: Matrix) -> Any:
        """Of P in these units and of log c together."""
        n = units.nrows()
        parts = [(self.P[i, j] * units[i, j]) ** 2 for i in range(n) for j in range(n)]
        return (sum(parts, self.log_c**2)).sqrt().mid()


@dataclass(frozen=True)
class _Bordered:
    """The equations of a steady state at an open c, linearised, with the direction that is left free as last row."""

    matrix: Matrix
    units: Matrix
    """1 / sqrt(P_ii P_jj)."""
    defect: Matrix
    mismatch: Any

    @classmethod
    def at(cls, plant: Plant, P: Matrix, theta: Any, log_c: Any, tangent: _Direction) -> _Bordered:
        """Rows: dP - K dP K' - thrust dtheta; d log gamma - d log c; the component along the tangent."""
        from flint import arb_mat

        following, Z = step(plant, P, theta)
        gamma, M = gamma_and_inverse(P, theta)
        slope = Slope.at(plant, P, theta, Z, M)
        upper = upper_triangle(plant.n)
        units = inverse_units(P)
        rows = [
            [(1 if a == b else 0) - x for b, x in enumerate(row)] + [-slope.thrust[i, j], number(0)]
            for a, ((i, j), row) in enumerate(zip(upper, slope.operator(), strict=True))
        ]
        twice = [1 if i == j else 2 for i, j in upper]
        pull = [theta * m * slope.pull[i, j] / gamma for m, (i, j) in zip(twice, upper, strict=True)]
        rows.append([*pull, (slope.pull * P).trace() / gamma, number(-1)])
        along = [m * tangent.P[i, j] * units[i, j] ** 2 for m, (i, j) in zip(twice, upper, strict=True)]
        rows.append([*along, number(0), tangent.log_c])
        return cls(middle(arb_mat(rows)), units, following - P, log_c - gamma.log())

    def defects(self) -> tuple[Matrix, Any]:
        """What is missing in the two equations."""
        return self.defect, self.mismatch

    def solve(self, defect: Matrix, mismatch: Any, along: Any) -> _Direction:
        """The direction with these right-hand sides."""
        from flint import arb_mat

        n = self.units.nrows()
        right = [[defect[i, j]] for i, j in upper_triangle(n)] + [[mismatch], [along]]
        x = solve(self.matrix, arb_mat(right))
        d = len(right) - 2
        return _Direction(unpacked(x, 0, n), x[d, 0], x[d + 1, 0])
