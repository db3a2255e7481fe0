"""That the filter converges from every V_0 > 0: a two-sided bracket around all limit points that ends in a region of
contraction (docs/mathematics.md, sections 6.1 and 11.9).

With kappa - 1 - log kappa >= c, T_0(P) = A (P^-1 + S)^-1 A' + Q and T_+(P) = A ((kappa P)^-1 + S)^-1 A' + Q:

1.  0 < L < T_0(L) and U > T_+(U) > 0 put every orbit eventually between L and U, from every V_0 > 0.
2.  gamma rises with P, so theta(U) <= theta_t <= theta(L) from then on, and P_{t+1} lies eventually between
    T(L, theta(U)) and T(U, theta(L)), or T_+(U) where theta(L) U < I does not hold. Repeat. (With one state,
    V = kappa P exactly, and P_{t+1} lies between T_+(L) and T_+(U).)
3.  Once [L, U] lies in the region, so does every orbit.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import balls
from tolnet.certificates.balls import BallMatrix, NotProved
from tolnet.certificates.blocks import between
from tolnet.certificates.convergence import Region, find_region
from tolnet.certificates.exact import Exact, is_semidefinite
from tolnet.certificates.exact_filter import Covariance, Equations, ExactFilter
from tolnet.certificates.fixed_point import Box, enclose, find_box
from tolnet.certificates.numerals import number_text, symmetric_matrix, symmetric_text
from tolnet.certificates.recursion import approximate_excess, approximate_theta, enclose_theta

MOST_STEPS = 5000
_DOUBLINGS = 60
_LEAST, _MOST = 1e-8, 1e8
_CLOSED = 1e-9
_PATIENCE = 250
"""Steps in which a bracket that will close has moved by a thousandth."""
_MARGINS = (1e-3, 1e-5, 1e-7)


def prove_convergence_for_all(exact: ExactFilter) -> dict[str, Any] | NotProved:
    """Keys of a proved `convergence-all` claim: `c`, `proof`. The bracket itself leads to the steady state."""
    with balls.working_precision(balls.BITS):
        try:
            equations = exact.equations()
        except ZeroDivisionError as error:
            return NotProved(str(error))
        A, Q, S = (balls.midpoints(M) for M in (equations.A, equations.Q, equations.S))
    kappa = _factor(exact.c)
    low, high = _riccati(A, Q, S), _riccati(np.sqrt(kappa) * A, Q, kappa * S)
    if low is None or high is None:
        return NotProved("the Kalman filter, or the one inflated by kappa at every step, has no steady state")
    ahead = _Floating(A, Q, S, exact.c, kappa)
    closed = ahead.close(low, high, None, low)
    if isinstance(closed, NotProved):
        return closed
    middle, _ = closed
    box = find_box(exact, middle, approximate_theta(middle, exact.c))
    found = box if isinstance(box, NotProved) else enclose(exact, box)
    if isinstance(box, NotProved) or isinstance(found, NotProved):
        return found if isinstance(found, NotProved) else NotProved("no steady state was enclosed")
    with balls.working_precision(found.bits):
        region = find_region(found)
    if isinstance(region, NotProved):
        return region
    reason = ""
    for margin in _MARGINS:
        lower = low - _spread(A, S, low, margin)
        upper = high + _spread(np.sqrt(kappa) * A, kappa * S, high, margin)
        ended = ahead.close(lower, upper, region, balls.midpoints(found.P))
        if isinstance(ended, NotProved):
            reason = ended.reason
            continue
        keys = {
            "c": number_text(exact.c),
            "proof": {
                "lower": symmetric_text(lower),
                "upper": symmetric_text(upper),
                "steps": ended[1],
                "box": box.text(),
                **region.text(),
            },
        }
        complaint = verify_convergence_for_all(exact, keys)
        if complaint is None:
            return keys
        reason = complaint
    return NotProved(reason)


def verify_convergence_for_all(exact: ExactFilter, claim: dict[str, Any]) -> str | None:
    """Why a `convergence-all` claim does not hold as far as can be shown; None where it does."""
    proof = claim["proof"]
    lower, upper, steps = symmetric_matrix(proof["lower"]), symmetric_matrix(proof["upper"]), proof["steps"]
    if not 0 <= steps <= MOST_STEPS + 1:
        return f"more than {MOST_STEPS} steps are not tried"
    if not (lower.shape == upper.shape == exact.A.shape and np.isfinite(lower).all() and np.isfinite(upper).all()):
        return f"the bracket is no pair of finite symmetric {len(exact.A)} x {len(exact.A)} matrices"
    if not is_nonnegative(exact.process):
        return "Q is not positive semidefinite"
    found = enclose(exact, Box.read(proof["box"]))
    if isinstance(found, NotProved):
        return found.reason
    region = Region.read(proof)
    with balls.working_precision(found.bits):
        complaint = region.complaint(found)
        if complaint is not None:
            return complaint
        try:
            ends = _bracket(found.equations, exact.c, balls.matrix(lower), balls.matrix(upper), steps)
        except ZeroDivisionError:
            return "the bracket was not enclosed: a matrix that must be inverted may be singular"
        if isinstance(ends, NotProved):
            return ends.reason
        if not region.holds(found, between(*(region.seen(found, end) for end in ends))):
            return f"the bracket does not lie in the region after {steps} steps"
    return None


def largest_tolerance_for_all(exact: ExactFilter, *, within: float = 1.01) -> dict[str, Any] | NotProved:
    """The `convergence-all` claim of the largest c for which it was proved, found by bisection to a factor `within`.

    The `c` of `exact` is not used. Nothing is said of larger c.
    """
    least, claim = _LEAST, prove_convergence_for_all(replace(exact, c=_LEAST))
    if isinstance(claim, NotProved):
        return claim
    most = least
    while most == least and least < _MOST:
        most = least * 10
        better = prove_convergence_for_all(replace(exact, c=most))
        if isinstance(better, dict):
            least, claim = most, better
    while most / least > within:
        middle = float(np.sqrt(least * most))
        better = prove_convergence_for_all(replace(exact, c=middle))
        if isinstance(better, dict):
            least, claim = middle, better
        else:
            most = middle
    return claim


def _bracket(
    equations: Equations, c: float, L: BallMatrix, U: BallMatrix, steps: int
) -> tuple[BallMatrix, BallMatrix] | NotProved:
    """The bracket after so many steps from an exact L and U."""
    kappa = balls.ball(_factor(c))
    if not (kappa >= 1 and (c == 0 or kappa - 1 - kappa.log() >= equations.c)):
        return NotProved("the factor kappa of the tolerance was not enclosed")
    if not (balls.is_positive(L) and balls.is_positive(U)):
        return NotProved("the bracket does not begin with positive definite matrices")
    if not balls.is_positive(_push(equations, L, balls.ball(1)) - L):
        return NotProved("0 < L < T_0(L) was not shown")
    if not balls.is_positive(U - _push(equations, U, kappa)):
        return NotProved("U > T_+(U) was not shown")
    if equations.n == 1:
        return _scalar_bracket(equations, c, L, U, steps)
    for j in range(steps):
        least, most = enclose_theta(equations, U, c), enclose_theta(equations, L, c)
        if isinstance(least, NotProved) or isinstance(most, NotProved):
            return NotProved(f"step {j + 1} of the bracket: theta was not enclosed")
        by_kappa = _push(equations, U, kappa)
        if equations.is_inside(U, most):
            by_theta = equations.following(equations.at(U, most))
            above = by_theta if by_theta.trace() < by_kappa.trace() else by_kappa
        else:
            above = by_kappa
        L = balls.outward(equations.following(equations.at(L, least)), -1)
        U = balls.outward(above, 1)
        if not balls.is_positive(L):
            return NotProved(f"step {j + 1} of the bracket: its lower end was not shown to be positive definite")
    return L, U


def _scalar_bracket(
    equations: Equations, c: float, L: BallMatrix, U: BallMatrix, steps: int
) -> tuple[BallMatrix, BallMatrix] | NotProved:
    """The same for one state, where V = kappa P for the root kappa itself, and theta is not needed."""
    above = balls.ball(_factor(c))
    below = (above * (1 - balls.ball(2) ** -35)).mid() if c else above
    if not (below >= 1 and (c == 0 or below - 1 - below.log() <= equations.c)):
        return NotProved("the factor kappa of the tolerance was not enclosed")
    for _ in range(steps):
        L, U = balls.outward(_push(equations, L, below), -1), balls.outward(_push(equations, U, above), 1)
    return L, U


def _push(equations: Equations, P: BallMatrix, kappa: Any) -> BallMatrix:
    """A ((kappa P)^-1 + S)^-1 A' + Q."""
    return equations.following(equations.at(P * kappa, balls.ball(0)))


def is_nonnegative(covariance: Covariance) -> bool:
    """Whether a covariance is positive semidefinite, exactly: B B' is."""
    if covariance.is_factor:
        return True
    return covariance.is_symmetric and is_semidefinite(Exact.of(covariance.matrix))


def _factor(c: float) -> float:
    """A double a hair above the root kappa > 1 of kappa - 1 - log kappa = c; 1 for c = 0."""
    if c == 0:
        return 1.0
    return float((1 + approximate_excess(np.ones(1), c)[0]) * (1 + 1e-12))


def _riccati(A: Float[ndarray, "n n"], Q: Float[ndarray, "n n"], S: Float[ndarray, "n n"]) -> ndarray | None:
    """P = A (P^-1 + S)^-1 A' + Q by doubling, in floating point; None where it does not settle."""
    n = len(A)
    F, G, P = A.T, S, Q
    with np.errstate(all="ignore"):
        for _ in range(_DOUBLINGS):
            try:
                W = np.linalg.inv(np.eye(n) + G @ P)
            except np.linalg.LinAlgError:
                return None
            growth = F.T @ P @ W @ F
            F, G, P = F @ W @ F, G + F @ W @ G @ F.T, P + (growth + growth.T) / 2
            G = (G + G.T) / 2
            if not np.isfinite(P).all():
                return None
            if np.abs(growth).max() <= 1e-15 * np.abs(P).max():
                return P
    return None


def _spread(A: Float[ndarray, "n n"], S: Float[ndarray, "n n"], P: Float[ndarray, "n n"], margin: float) -> ndarray:
    """D = sum K^i E K'^i with the loop K of P: moving P by D leaves about E = margin P between it and its own step.

    Margin and sum are taken relative to P; D is never more than half of it.
    """
    K = A @ np.linalg.inv(np.eye(len(A)) + P @ S)
    D, power = P.copy(), K
    for _ in range(_DOUBLINGS):
        growth = power @ D @ power.T
        D, power = D + growth, power @ power
        if np.abs(growth).max() <= 1e-12 * np.abs(D).max():
            break
    size = float(np.abs(np.linalg.eigvals(np.linalg.solve(P, D))).max())
    return (D + D.T) / 2 * min(margin, 0.5 / size)


_Closed = tuple[ndarray, int]


class _Floating:
    """The bracket in floating point, to look ahead."""

    def __init__(self, A: ndarray, Q: ndarray, S: ndarray, c: float, kappa: float):
        self.A, self.Q, self.S, self.c, self.kappa = A, Q, S, c, kappa

    def next(self, L: ndarray, U: ndarray) -> tuple[ndarray, ndarray]:
        """The bracket one step on."""
        above = self._push(self.kappa * U, 0.0)
        if len(L) == 1:
            return self._push(self.kappa * L, 0.0), above
        least, most = approximate_theta(U, self.c), approximate_theta(L, self.c)
        if most * float(np.linalg.eigvalsh(U)[-1]) < 1:
            by_theta = self._push(U, most)
            above = by_theta if np.trace(by_theta) < np.trace(above) else above
        return self._push(L, least), above

    def _push(self, P: ndarray, theta: float) -> ndarray:
        n = len(P)
        M = self.A @ np.linalg.solve(np.eye(n) + P @ (self.S - theta * np.eye(n)), P) @ self.A.T + self.Q
        return (M + M.T) / 2

    def close(
        self, L: ndarray, U: ndarray, region: Region | None, centre: ndarray
    ) -> tuple[ndarray, int] | NotProved:
        """The middle and the number of steps once the bracket has closed, or lies well inside a region."""
        try:
            with np.errstate(all="ignore"):
                return self._close(L, U, region, centre)
        except np.linalg.LinAlgError:
            return NotProved("the bracket has no numbers in floating point")

    def _close(
        self, L: ndarray, U: ndarray, region: Region | None, centre: ndarray
    ) -> tuple[ndarray, int] | NotProved:
        before = np.inf
        for steps in range(MOST_STEPS):
            gap = float(np.trace(U - L) / np.trace(U))
            if region is None and gap < _CLOSED:
                return (L + U) / 2, steps
            if region is not None and self._distance(L, U, region, centre) <= 0.9 * region.radius:
                return (L + U) / 2, steps
            if steps % _PATIENCE == 0:
                if gap > (1 - 1e-3) * before:
                    break
                before = gap
            L, U = self.next(L, U)
            if not (np.isfinite(L).all() and np.isfinite(U).all()):
                return NotProved("the bracket has no numbers in floating point")
        least, most = approximate_theta(U, self.c), approximate_theta(L, self.c)
        return NotProved(f"the bracket does not close: theta stays between {least:.4g} and {most:.4g}")

    @staticmethod
    def _distance(L: ndarray, U: ndarray, region: Region, centre: ndarray) -> float:
        """An upper bound on the distance of [L, U], as `Region.holds` finds it."""
        i, j = np.triu_indices(len(L))
        back = np.linalg.inv(region.L)
        middle, half = back @ ((L + U) / 2 - centre) @ back.T, np.diag(back @ (U - L) @ back.T) / 2
        root = np.sqrt(np.maximum(half, 0.0))
        size = (np.abs(middle) + np.outer(root, root))[i, j] * np.where(i == j, 1.0, np.sqrt(2.0))
        return float(np.sqrt(size @ np.abs(region.Y) @ size))
