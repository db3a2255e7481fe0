"""Check the claims about filters, which need a logarithm, with the Python standard library alone.

    python check_filters.py certificate.json        # every claim: those of check.py, which lies beside it, too

It needs check.py and check_arithmetic.py in its own directory, and nothing else. Every number is enclosed, so that a
comparison that is true was proved, and `invalid` means not shown. Nothing is shared with the program that wrote the
certificate: docs/certificate.md and docs/mathematics.md, 11.4 to 11.9, say what is verified and why.

Read in this order: the equations of a filter, its steady state, the covariance recursion, the region of contraction,
the brackets, the filters of a deployment, the claims.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from time import process_time
from types import ModuleType
from typing import Any, NamedTuple

if not __package__ and "tolnet" not in sys.modules:
    # Run as a file: its directory stands for the package, whose own beginning would need more than the library. It
    # is no entry of sys.path, so that nothing that lies there takes the place of a module of the library.
    for _name in ("tolnet", "tolnet.certificates"):
        sys.modules[_name] = ModuleType(_name)
        sys.modules[_name].__path__ = [str(Path(__file__).parent)]

from tolnet.certificates import check
from tolnet.certificates.check import Clock, Declined, Deployment, Matrix
from tolnet.certificates.check_arithmetic import (
    PRECISIONS,
    Balls,
    Interval,
    NotShown,
    Precision,
    above,
    assemble,
    at_some,
    below,
    column,
    congruence,
    coordinates,
    diagonal,
    digits_of,
    exact,
    exactly,
    from_coordinates,
    inverse,
    is_positive,
    largest,
    log_det,
    near_inverse,
    plus_minus,
    require_shown,
    scalar,
    slack,
    squared,
    symmetric,
    twice_off_the_diagonal,
    unit,
    upper,
)

MOST_STATES = 30
MOST_STEPS, MOST_BITS, MOST_WORK = 5000, 2**12, 2**21  # of an orbit; work is steps times bits
MOST_BLOCKS, MOST_DOUBLINGS = 64, 40
REFINEMENTS, WIDENINGS = 8, 4
LONGEST = 600  # seconds of processor time that a claim may cost, of those that check.py gives the document
KEPT = Fraction(
    1, 2**12
)  # of the way that the ends of a bracket go in a block, not taken: it stays mapped into itself


# -------------------- The equations of a filter ---------------------------------------------------------------


class Point(NamedTuple):
    """What the recursion and its derivative share at (P, theta)."""

    P: Balls
    theta: Interval
    W: Balls
    Z: Balls
    H: Balls | None  # None for theta = 0


class Slope(NamedTuple):
    """In the coordinates u of symmetric matrices: du -> loop du + thrust dtheta, and what ties dtheta to du."""

    loop: Balls
    thrust: Balls  # a column
    pull: Balls | None  # a row: d gamma = theta (theta pull du + swing dtheta); None for theta = 0
    swing: Interval
    theta: Interval

    def of_the_recursion(self) -> Balls:
        """J of P_t -> P_{t+1} with gamma kept at c: dtheta = -theta pull du / swing."""
        if self.pull is None:
            return self.loop
        return self.loop - (self.thrust @ self.pull).times(self.theta / self.swing)


@dataclass(frozen=True)
class Equations:
    """Of a filter, in any coordinates of the state; the metric Pi is the identity in those of the problem.

    W = (I + P (S - theta Pi))^-1,  Z = W P,  K = A W,    T(P, theta) = A Z A' + Q
    H = (I - theta P Pi)^-1,  N = Pi H P H' Pi,           gamma = log det(I - theta P Pi) + tr(H - I)
    dT = K dP K' + dtheta A Z Pi Z A',                    dgamma = theta (theta tr(N dP) + tr(N P) dtheta)
    """

    A: Balls
    Q: Balls
    S: Balls
    metric: Balls
    c: Fraction

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.A.middle.rows)

    def seen_from(self, L: Balls) -> Equations:
        """The equations of X where P = L X L'."""
        back, over = inverse(L), L.T
        S, metric = congruence(over, self.S), congruence(over, self.metric)
        return Equations(back @ self.A @ L, congruence(back, self.Q), S, metric, self.c)

    def at(self, P: Balls, theta: Interval, *, stretched: bool = True) -> Point:
        """The point (P, theta); without H where only the recursion is wanted."""
        one, tilted = unit(self.n), self.metric.times(theta)
        W = inverse(one + P @ (self.S - tilted))
        H = inverse(one - P @ tilted) if stretched and theta.size else None
        return Point(P, theta, W, symmetric(W @ P), H)

    def following(self, at: Point) -> Balls:
        """T(P, theta)."""
        return congruence(self.A, at.Z) + self.Q

    def gamma(self, at: Point) -> Interval:
        """gamma(P, theta), on the branch theta P < I."""
        if at.H is None:
            return exactly(0)
        inflated = unit(self.n) - at.P @ self.metric.times(at.theta)
        return log_det(inflated, at.H) + at.H.trace() - exactly(self.n)

    def is_inside(self, P: Balls, theta: Interval) -> bool:
        """Whether theta P Pi < I was shown, by its symmetric equivalent Pi - theta Pi P Pi > 0."""
        return is_positive(self.metric - congruence(self.metric, P).times(theta))

    def stretch(self, at: Point) -> Balls:
        """N. Assumes theta > 0."""
        assert at.H is not None
        return congruence(self.metric, congruence(at.H, at.P))

    def slope(self, at: Point) -> Slope:
        """The derivative in the coordinates P_ij, i <= j."""
        loop = squared(self.A @ at.W)
        thrust = coordinates(congruence(self.A @ at.Z, self.metric))
        if at.H is None:
            return Slope(loop, thrust, None, exactly(0), at.theta)
        N = self.stretch(at)
        return Slope(loop, thrust, twice_off_the_diagonal(N), (N @ at.P).trace(), at.theta)


# -------------------- The steady state ------------------------------------------------------------------------


class Box(NamedTuple):
    """All (P', theta') with |P'_ij - P_ij| <= radius sqrt(P_ii P_jj) and |theta' - theta| <= radius theta."""

    P: Matrix
    theta: Fraction
    radius: Fraction


class Enclosure(NamedTuple):
    """The one steady state of a box, with 0 < P and theta P < I."""

    equations: Equations
    P: Balls
    theta: Interval


class Krawczyk:
    """g = [P - T(P, theta); gamma(P, theta) - c] of steps from the middle of a box, and its derivative.

    For any matrix B: m - B g(m) + (I - B g'(X)) (X - m), inside X, proves exactly one zero of g in X, and holds it
    (R. Krawczyk, Computing 4, 1969). Steps are the coordinates of P, then theta; theta and gamma are scaled by
    powers of two.
    """

    def __init__(self, equations: Equations, box: Box) -> None:
        self.equations, self.P, self.theta = equations, exact(box.P), exactly(box.theta)
        self.unit, self.scale = _power_near(box.theta), 1 / _power_near(equations.c)

    def at(self, steps: Balls) -> Point:
        """The point that these steps lead to."""
        d, theta = len(upper(self.equations.n)), self.theta
        if theta.size:
            theta = theta + exactly(self.unit) * steps.entry(d, 0)
        return self.equations.at(self.P + from_coordinates(steps, self.equations.n), theta)

    def defect(self, steps: Balls) -> Balls:
        """g."""
        at = self.at(steps)
        g = coordinates(at.P - self.equations.following(at))
        if at.H is None:
            return g
        last = (self.equations.gamma(at) - exactly(self.equations.c)) * exactly(self.scale)
        d = len(g.middle.rows)
        return assemble([(0, 0, g), (d, 0, scalar(last))], d + 1, 1)

    def slope(self, steps: Balls) -> Balls:
        """g'."""
        slope = self.equations.slope(self.at(steps))
        d, theta = len(slope.loop.middle.rows), slope.theta
        loop = unit(d) - slope.loop
        if slope.pull is None:
            return loop
        pull = slope.pull.times(theta * theta * exactly(self.scale))
        swing = slope.swing * theta * exactly(self.unit * self.scale)
        thrust = slope.thrust.times(exactly(-self.unit))
        return assemble([(0, 0, loop), (0, d, thrust), (d, 0, pull), (d, d, scalar(swing))], d + 1, d + 1)

    def image(self, steps: Balls, B: Balls) -> Balls:
        """The operator's image of a box of steps."""
        middle = exact(steps.middle)
        contraction = unit(len(steps.middle.rows)) - B @ self.slope(steps)
        return middle - B @ self.defect(middle) + contraction @ (steps - middle)


def _power_near(x: Fraction) -> Fraction:
    return Fraction(2) ** (x.numerator.bit_length() - x.denominator.bit_length()) if x else Fraction(1)


def enclose(equations: Equations, box: Box) -> Enclosure:
    """The one steady state in the box."""
    test, P = Krawczyk(equations, box), box.P
    sizes = [check.scaled(row[i], P.exponent) for i, row in enumerate(P.rows)]
    reach = [(exactly(sizes[i]) * exactly(sizes[j])).sqrt() for i, j in upper(len(sizes))]
    reach += [exactly(box.theta / test.unit)] if box.theta else []
    radii = [x * exactly(box.radius) for x in reach]
    steps = column([Interval(-x.high, x.high) for x in radii])
    B = exact(near_inverse(test.slope(exact(steps.middle)).middle))
    image = test.image(steps, B)
    inside = (image.entry(i, 0).is_inside(Interval(-x.low, x.low)) for i, x in enumerate(radii))
    require_shown(all(inside), f"Krawczyk's test fails on the box of relative radius {float(box.radius):.1e}")
    tight = Fraction(1, 2**128) / max(Fraction(1), equations.c) ** 3
    for _ in range(REFINEMENTS):
        if all(image.entry(i, 0).radius <= tight * x.low for i, x in enumerate(reach)):
            break
        image = test.image(image, B)
    found = test.at(image)
    require_shown(
        is_positive(found.P) and equations.is_inside(found.P, found.theta), "0 < P, theta P < I were not shown"
    )
    return Enclosure(equations, found.P, found.theta)


# -------------------- The covariance recursion ----------------------------------------------------------------


class Around(NamedTuple):
    """Every symmetric P with -spread <= P - middle <= spread, in the order of definiteness."""

    middle: Matrix
    spread: Matrix

    @classmethod
    def of(cls, M: Balls, spread: Balls | None = None) -> Around:
        """What lies that far around some matrix in M."""
        M = symmetric(M)
        shift = slack(M)
        return cls(M.middle, shift if spread is None else above(spread + exact(shift)))

    def hull(self) -> Balls:
        """All of it, entry by entry: |P - middle|_ij <= sqrt(spread_ii spread_jj)."""
        diagonal = (check.scaled(row[i], self.spread.exponent) for i, row in enumerate(self.spread.rows))
        roots = column([exactly(exactly(x).sqrt().high) for x in diagonal])
        return Balls(self.middle, roots.by(roots).size)


def step(equations: Equations, P: Around) -> Around:
    """P_{t+1} for every P_t around a middle.

    A deviation E, -W <= E <= W, becomes K E K' + dtheta M with M = A Z Z A' and |dtheta| <= theta tr(N W) / tr(N P),
    at some point of the segment; so the spread becomes K W K' + |dtheta| M.
    """
    theta = enclose_theta(equations, exact(P.middle))
    following = equations.following(equations.at(exact(P.middle), theta, stretched=False))
    hull, spread, reach, room = P.hull(), exact(P.spread), theta, Fraction(0)
    for _ in range(WIDENINGS):
        at = equations.at(hull, reach)
        carried = congruence(equations.A @ at.W, spread)
        if at.H is None:
            return Around.of(following, carried)
        N, AZ = equations.stretch(at), equations.A @ at.Z
        move = (reach * (N @ spread).trace() / (N @ hull).trace()).size
        if move < room:
            return Around.of(following, carried + AZ.by(AZ).times(exactly(move)))
        room = move * Fraction(5, 4) + theta.radius / 2**20
        reach = plus_minus(theta.middle, theta.radius + room)
    raise NotShown("theta was not enclosed")


def enclose_theta(equations: Equations, P: Balls) -> Interval:
    """The theta with gamma(P, theta) = c of every P in an enclosure. Assumes Pi = I.

    By the interval Newton method: with dgamma/dtheta over an interval X around an approximate root t,
    t - (gamma(P, t) - c) / dgamma/dtheta, inside X, holds the root of every P; theta P < I on X says which root.
    """
    c = exactly(equations.c)
    if not equations.c:
        return c
    t, middle = near_theta(P.middle, float(equations.c)), exact(P.middle)
    for _ in range((Precision.bits // 50).bit_length() - 1):  # 50 digits, then twice as many each time
        value, slope = _gamma(middle, exactly(t))
        t = (exactly(t) - (value - c) / slope).middle
    value, slope = _gamma(P, exactly(t))
    X = plus_minus(t, 2 * ((value - c) / slope).size + t * Fraction(16, 2**Precision.bits))
    root = exactly(t) - (value - c) / _gamma(P, X)[1]
    require_shown(X.low > 0 and root.is_inside(X) and equations.is_inside(P, X), "theta was not enclosed")
    return root


def _gamma(P: Balls, theta: Interval) -> tuple[Interval, Interval]:
    """gamma and its derivative in theta: log det(I - theta P) + theta tr(H P), and theta tr((H P)^2)."""
    inflated = unit(len(P.middle.rows)) - P.times(theta)
    H = inverse(inflated)
    V = H @ P
    return log_det(inflated, H) + theta * V.trace(), theta * (V @ V).trace()


def near_theta(P: Matrix, c: float) -> Fraction:
    """theta with gamma(P, theta) = c > 0, in floating point: mu / (1 + mu) over the largest eigenvalue."""
    most = digits_of(P)
    values = eigenvalues([[math.ldexp(check.shifted(x, 900 - most), -900) for x in row] for row in P.rows])
    largest = max(values)
    require_shown(largest > 0, "a covariance is not positive")
    mu = near_excess([max(x / largest, 0.0) for x in values], c)
    return Fraction(mu / (1 + mu) / largest) / Fraction(2) ** (most + P.exponent)


def eigenvalues(S: list[list[float]]) -> list[float]:
    """Of a symmetric matrix, in floating point, by Jacobi's method."""
    n = len(S)
    for _ in range(30):
        if sum(S[i][j] ** 2 for i, j in combinations(range(n), 2)) <= 1e-32 * sum(S[i][i] ** 2 for i in range(n)):
            break
        for p, q in combinations(range(n), 2):
            if S[p][q] == 0:
                continue
            ratio = (S[q][q] - S[p][p]) / (2 * S[p][q])
            t = math.copysign(1, ratio) / (abs(ratio) + math.hypot(1, ratio))
            cos = 1 / math.hypot(1, t)
            sin = t * cos
            for row in S:
                row[p], row[q] = cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]
            x, y = S[p], S[q]
            S[p] = [cos * a - sin * b for a, b in zip(x, y, strict=True)]
            S[q] = [sin * a + cos * b for a, b in zip(x, y, strict=True)]
    return [S[i][i] for i in range(n)]


def near_excess(r: Sequence[float], c: float) -> float:
    """mu > 0 with sum_i (m_i - log(1 + m_i)) = c, m_i = r_i mu / (1 + (1 - r_i) mu), by Newton's method on log mu.

    Of the eigenvalues r_i of P over the largest: 1 + m_i are those of V over those of P. In floating point.
    """
    mu = math.sqrt(2 * c / sum(x * x for x in r)) + c / len(r)
    for _ in range(100):
        excess = [x * mu / (1 + (1 - x) * mu) for x in r]
        value = sum(m - math.log1p(m) if m > 1e-3 else m * m * (0.5 - m * (1 / 3 - m / 4)) for m in excess)
        slope = sum(m / (1 + m) * x * mu / (1 + (1 - x) * mu) ** 2 for m, x in zip(excess, r, strict=True))
        if not value > 0 or not slope > 0:
            break
        move = math.log(value / c) * value / slope
        mu *= math.exp(-min(max(move, -5.0), 5.0))
        if abs(move) < 1e-13:
            break
    return mu


# -------------------- A region of contraction -----------------------------------------------------------------


class Region(NamedTuple):
    """All P = P* + L D L' with D' Y D <= radius^2, on which a step contracts by `rate` in that norm."""

    L: Matrix
    Y: Matrix  # in the coordinates D_ii, sqrt(2) D_ij
    rate: Fraction
    radius: Fraction

    def require_contraction(self, at: Enclosure) -> None:
        """J' Y J < rate^2 Y, 0 < P and theta P < I at every P of the region, which is enclosed in a box.

        theta of every P: along the segment from P*, |dtheta| is at most theta |pull D| / swing, and as long as that
        bound, taken over an interval around theta*, is shorter than the interval, theta stays in it.
        """
        n, L, Y = at.equations.n, exact(self.L), weighed(self.Y, at.equations.n)
        require_shown(is_positive(Y), "Y > 0 was not shown")
        equations, back = at.equations.seen_from(L), inverse(Y)
        reach = [(back.entry(i, i).sqrt() * exactly(self.radius)).high for i in range(len(upper(n)))]
        X = congruence(inverse(L), at.P) + from_coordinates(column([Interval(-x, x) for x in reach]), n)
        require_shown(is_positive(X), "0 < P was not shown on the region")
        theta, room = at.theta, Fraction(0)
        for _ in range(WIDENINGS):
            slope = equations.slope(equations.at(X, theta))
            if slope.pull is None:
                return require_decrease(slope.of_the_recursion(), Y, self.rate)
            spread = congruence(slope.pull, back).entry(0, 0).sqrt() * exactly(self.radius)
            move = (spread * theta / slope.swing).size
            if move < room:
                return require_decrease(slope.of_the_recursion(), Y, self.rate)
            room = move * Fraction(5, 4) + at.theta.radius / 2**20
            theta = plus_minus(at.theta.middle, at.theta.radius + room)
        raise NotShown("theta was not enclosed on the region")

    def seen(self, at: Enclosure, P: Balls) -> Balls:
        """D with P = P* + L D L'."""
        return congruence(inverse(exact(self.L)), symmetric(P - at.P))

    def require_inside(self, at: Enclosure, D: Balls) -> None:
        """Every symmetric matrix in D, such as `seen` gives, lies in the region."""
        norm = congruence(coordinates(D).T, weighed(self.Y, at.equations.n)).entry(0, 0)
        require_shown(norm.high <= self.radius**2, "it does not end in the region of contraction")


def weighed(Y: Matrix, n: int) -> Balls:
    """Y, given in the coordinates D_ii and sqrt(2) D_ij, in the coordinates D_ij."""
    root = exactly(2).sqrt()
    return congruence(diagonal([exactly(1) if i == j else root for i, j in upper(n)]), exact(Y))


def require_decrease(J: Balls, Y: Balls, rate: Fraction) -> None:
    """Y > 0 and rate^2 Y - J' Y J > 0."""
    require_shown(is_positive(Y), "Y > 0 was not shown")
    left = Y.times(exactly(rate**2)) - congruence(J.T, Y)
    require_shown(is_positive(left), "r^2 Y - J' Y J > 0 was not shown")


# -------------------- Brackets: around every orbit, and around one ---------------------------------------------


class Bracket(NamedTuple):
    """All P between the ends, in the order of definiteness, and by how many doublings each block pushes them on."""

    lower: Matrix
    upper: Matrix
    blocks: list[int]


def bracket(equations: Equations, low: Matrix, high: Matrix, steps: int) -> tuple[Balls, Balls]:
    """L and U, so many steps on, between which every orbit lies in the end.

    With kappa - 1 - log kappa >= c, T_0(P) = A (P^-1 + S)^-1 A' + Q and T_+(P) = A ((kappa P)^-1 + S)^-1 A' + Q:
    0 < L < T_0(L) and U > T_+(U) > 0 hold every orbit; gamma rises with P, so theta(U) <= theta_t <= theta(L), and
    the next P lies between T(L, theta(U)) and T(U, theta(L)), or T_+(U).
    """
    under, over = enclosed_factors(equations.c)  # with one state V = kappa P itself, and theta is not needed
    L, U = exact(low), exact(high)
    require_shown(is_positive(L) and is_positive(U), "the bracket does not begin with positive definite matrices")
    require_shown(is_positive(_push(equations, L, Fraction(1)) - L), "0 < L < T_0(L) was not shown")
    require_shown(is_positive(U - _push(equations, U, over)), "U > T_+(U) was not shown")
    for _ in range(steps):
        if equations.n == 1:
            L, U = exact(below(_push(equations, L, under))), exact(above(_push(equations, U, over)))
            continue
        least, most = enclose_theta(equations, U), enclose_theta(equations, L)
        end = _push(equations, U, over)
        if equations.is_inside(U, most):
            by_theta = equations.following(equations.at(U, most, stretched=False))
            end = min(by_theta, end, key=lambda P: P.trace().middle)
        L = exact(below(equations.following(equations.at(L, least, stretched=False))))
        U = exact(above(end))
        require_shown(is_positive(L), "the lower end of the bracket was not shown to be positive definite")
    return L, U


def enclosed_factors(c: Fraction) -> tuple[Fraction, Fraction]:
    """A hair below and above the root kappa >= 1 of kappa - 1 - log kappa = c; in floating point first."""
    if not c:
        return Fraction(1), Fraction(1)
    excess = Fraction(near_excess([1.0], float(c)))
    found = 1 + excess * (1 - Fraction(1, 2**35)), 1 + excess * (1 + Fraction(1, 2**35))
    low, high = (exactly(kappa - 1) - exactly(kappa).log() for kappa in found)
    require_shown(low.high <= c <= high.low, "the factor kappa of the tolerance was not enclosed")
    return found


def _push(equations: Equations, P: Balls, kappa: Fraction) -> Balls:
    """A ((kappa P)^-1 + S)^-1 A' + Q."""
    return equations.following(equations.at(P.times(exactly(kappa)), exactly(0)))


def by_blocks(equations: Equations, P: Balls, way: Bracket) -> tuple[Balls, Balls]:
    """L and U between which the orbit from P stays from some step on, pushed on by many steps at once.

    T(P, theta) rises with both, and gamma with P. Let L < P < U, a <= theta(U), b >= theta(L), U^-1 - b I + S > 0,
    L < T(L, a) and T(U, b) < U. Then P_t stays between L and U, theta_t between a and b, T(., a)^j L rises with j,
    T(., b)^j U falls, and they hold P_t from step j on. At j = 2^k they cost k doublings, however slow the filter is.
    """
    L, U = exact(way.lower), exact(way.upper)
    between_them = is_positive(L) and is_positive(P - L) and is_positive(U - P)
    require_shown(between_them, "the orbit was not shown to lie between the ends of the bracket")
    for k in way.blocks:
        (under, a), (over, b) = bounds(equations, L, U)
        lowest, highest = many_steps(under, a, L, k), many_steps(over, b, U, k)
        L = exact(below(lowest - (lowest - L).times(exactly(KEPT))))
        U = exact(above(highest + (U - highest).times(exactly(KEPT))))
    return L, U


Bound = tuple[Equations, Interval]  # T(., theta), below or above every step of the recursion in a bracket


def bounds(equations: Equations, L: Balls, U: Balls) -> tuple[Bound, Bound]:
    """Such bounds, by which the bracket was shown to be mapped into itself; with one state, V = kappa P instead."""
    if equations.n == 1:
        under, over = (inflated(equations, kappa) for kappa in enclosed_factors(equations.c))
        a = b = exactly(0)
    else:
        under = over = equations
        a, b = exactly(enclose_theta(equations, U).low), exactly(enclose_theta(equations, L).high)
    # U (U^-1 - b I + S) U > 0
    inside = is_positive(U + congruence(U, over.S - over.metric.times(b)))
    require_shown(inside, "U^-1 - theta(L) I + S > 0 was not shown")
    rises = is_positive(under.following(under.at(L, a, stretched=False)) - L)
    require_shown(rises, "L < T(L, theta(U)) was not shown")
    falls = is_positive(U - over.following(over.at(U, b, stretched=False)))
    require_shown(falls, "T(U, theta(L)) < U was not shown")
    return (under, a), (over, b)


def inflated(equations: Equations, kappa: Fraction) -> Equations:
    """A ((kappa P)^-1 + S)^-1 A' = kappa A (P^-1 + kappa S)^-1 A' as equations at theta = 0."""
    x = exactly(kappa)
    return replace(equations, A=equations.A.times(x.sqrt()), S=equations.S.times(x))


def many_steps(equations: Equations, theta: Interval, P: Balls, doublings: int) -> Balls:
    """T(., theta)^m P = H + F' P (I + G P)^-1 F for m = 2^doublings; m = 1 has F = A', G = S - theta Pi and H = Q.

    From m to 2 m, with W = (I + G H)^-1: F W F, G + F W G F', H + F' H W F.
    """
    one, F, G, H = unit(equations.n), equations.A.T, equations.S - equations.metric.times(theta), equations.Q
    least = Fraction(1, 2 ** (8 * Precision.bits))
    nothing = [[0] * equations.n for _ in range(equations.n)]
    for _ in range(doublings):
        W = inverse(one + G @ H)
        FW = F @ W
        G = symmetric(G + (FW @ G).by(F))
        H = symmetric(H + F.T @ H @ W @ F)
        F = FW @ F
        if largest(F.size) <= least:  # it goes to zero like rho^m: no number needs exponents of that size
            F = Balls(Matrix(nothing), least * Matrix([[1] * equations.n for _ in nothing]))
    return symmetric(H + F.T @ P @ inverse(one + G @ P) @ F)


def between(L: Balls, U: Balls) -> Balls:
    """Every symmetric P with L <= P <= U: |P - (L + U) / 2|_ij <= sqrt(W_ii W_jj) with W = (U - L) / 2."""
    half = exactly(Fraction(1, 2))
    W = (U - L).times(half)
    middle = (L + U).times(half)
    roots = column([exactly(exactly(W.entry(i, i).size).sqrt().high) for i in range(len(W.middle.rows))])
    return Balls(middle.middle, middle.radius + roots.by(roots).size)


# -------------------- The filters of a deployment -------------------------------------------------------------

Node = int | str  # a node by its number, or "centre"


class Filters:
    """The filters of a deployment; what several claims need is computed once."""

    def __init__(self, at: Deployment) -> None:
        self.at = at
        self.prepared: dict[tuple[int, int], tuple[Balls, Balls]] = {}
        self.enclosed: dict[Any, Enclosure | NotShown] = {}

    def heard(self, node: Node) -> list[int]:
        """The sensors that a node hears, or all for the centre, without relays."""
        heard = range(len(self.at)) if isinstance(node, str) else self.at.neighbours[node]
        return [l for l in heard if self.at.p[l]]

    def gain(self, node: Node) -> dict[int, Matrix] | None:
        """The stated gain by sensor; None where none is stated."""
        if isinstance(node, str):
            return None if self.at.stated is None else self.at.stated[0]
        return self.at.gains[node]

    def sensor(self, l: int) -> tuple[Balls, Balls]:
        """C' R^-1 and C' R^-1 C."""
        key = l, Precision.bits
        if key not in self.prepared:
            C, R = exact(self.at.C[l]), exact(self.at.R[l])
            require_shown(is_positive(R), f"R[{l}] was not shown to be positive definite")
            weighted = C @ inverse(R)
            self.prepared[key] = weighted, symmetric(weighted.by(C))
        return self.prepared[key]

    def information(self, node: Node) -> Balls:
        """S = sum of C' R^-1 C."""
        n = self.at.n
        S = exact(Matrix([[0] * n for _ in range(n)]))
        for l in self.heard(node):
            S = S + self.sensor(l)[1]
        return S

    def equations(self, node: Node, c: Fraction) -> Equations:
        """Of a filter at a tolerance."""
        A, Q = exact(self.at.A), exact(self.at.Q)
        return Equations(A, Q, self.information(node), unit(self.at.n), c)

    def enclosure(self, node: Node, c: Fraction, box: Box) -> Enclosure:
        """The steady state in a box."""
        key = node, c, box.theta, box.radius, box.P.exponent, tuple(map(tuple, box.P.rows)), Precision.bits
        if key not in self.enclosed:
            try:
                self.enclosed[key] = enclose(self.equations(node, c), box)
            except NotShown as wrong:
                self.enclosed[key] = wrong
        found = self.enclosed[key]
        if isinstance(found, NotShown):
            raise found
        return found


filters_of = lru_cache(maxsize=1)(Filters)


# -------------------- The claims ------------------------------------------------------------------------------


def steady_state(claim: dict[str, Any], at: Deployment) -> str:
    """`steady-state`: exactly one in the box, and no entry of the stated gain is further off than `gain_error`."""
    filters, node, c, proof = _opened(claim, at, "proof", "box")
    box, error = _box(proof["box"], at.n, c), _number(claim, "gain_error")

    def show() -> None:
        found, stated = filters.enclosure(node, c, box), filters.gain(node)
        if stated is not None:
            require_gain(filters, found, stated, Fraction(error))

    at_some(PRECISIONS, show)
    return (
        f"An exact steady state of {_who(node, c)} lies within {float(box.radius)!r} of the stated one, relative to"
        f" sqrt(P_ii P_jj) and to theta, and its gain within {error!r} of the stated one, relative to the largest"
        " entry."
    )


def require_gain(filters: Filters, found: Enclosure, stated: dict[int, Matrix], error: Fraction) -> None:
    """|stated - A Z C_l' R_l^-1| <= error max |stated|, entry by entry, for every sensor l."""
    equations = found.equations
    AZ = equations.A @ equations.at(found.P, found.theta, stretched=False).Z
    size = max((largest(G) for G in stated.values()), default=Fraction(0))
    for l, G in stated.items():
        if filters.at.p[l]:
            away = largest((AZ @ filters.sensor(l)[0] - exact(G)).size)
            require_shown(away <= error * size, "the stated gain may be further from the exact one than is claimed")


def derivative(found: Enclosure) -> Balls:
    """J at the steady state, in the coordinates P_ij."""
    equations = found.equations
    return equations.slope(equations.at(found.P, found.theta)).of_the_recursion()


def attracting(claim: dict[str, Any], at: Deployment) -> str:
    """`attraction`: rho(J) < rate at the steady state."""
    filters, node, c, proof = _opened(claim, at, "proof", "box", "Y")
    box, rate, d = _box(proof["box"], at.n, c), Fraction(_number(claim, "rate")), len(upper(at.n))
    check.require(0 < rate < 1, "rate: expected a number between 0 and 1")
    Y = check.symmetric(proof["Y"], d, "proof.Y")
    at_some(PRECISIONS, lambda: require_decrease(derivative(filters.enclosure(node, c, box)), weighed(Y, at.n), rate))
    return (
        f"The steady state of {_who(node, c)} attracts locally: covariances that start near it approach it, in the"
        f" end by a factor of at most {float(rate)!r} a step."
    )


def repelling(claim: dict[str, Any], at: Deployment) -> str:
    """`attraction`, refuted: J' X J - X > 0 and v' X v > 0, so that rho(J) > 1."""
    filters, node, c, witness = _opened(claim, at, "witness", "box", "X", "v")
    box, d = _box(witness["box"], at.n, c), len(upper(at.n))
    X, v = check.symmetric(witness["X"], d, "witness.X"), check.matrix(witness["v"], 1, d, "witness.v")
    check.require(v.by(X).by(v).rows[0][0] > 0, "v' X v is not positive")

    def show() -> None:
        J, weighted = derivative(filters.enclosure(node, c, box)), weighed(X, at.n)
        require_shown(is_positive(congruence(J.T, weighted) - weighted), "J' X J - X > 0 was not shown")

    at_some(PRECISIONS, show)
    return (
        f"The steady state of {_who(node, c)} does not attract: some covariances that start as near to it as you like"
        " move away."
    )


def tolerance(claim: dict[str, Any], at: Deployment) -> str:
    """`tolerance`: c_k of a node, from the centre's steady state, lies in the interval."""
    filters, node, c, proof = _opened(claim, at, "proof", "box")
    check.require(node != "centre", "the centre has no local tolerance")
    box = _box(proof["box"], at.n, c)
    low, high = check.doubles(claim["interval"], 2, "interval")

    def show() -> None:
        found = local_tolerance(filters.enclosure("centre", c, box), filters.information(node))
        # c_k is never negative, so that 0 is always a lower bound
        require_shown(
            (low <= 0 or found.low >= low) and found.high <= high, "the tolerance may lie outside the interval"
        )

    at_some(PRECISIONS, show)
    return (
        f"The tolerance of node {node} that follows from the centre's steady state at {float(c)!r} (gamma) lies in"
        f" [{low!r}, {high!r}]."
    )


def local_tolerance(centre: Enclosure, S: Balls) -> Interval:
    """c_k = tr M - log det(I + M), M = P_k^-1 (V - P), P_k = A (V^-1 + S_k)^-1 A' + Q, of the centre's V and P."""
    equations, one = centre.equations, unit(centre.equations.n)
    if not centre.theta.size:
        return exactly(0)  # V = P
    H = inverse(one - centre.P.times(centre.theta))
    V = symmetric(H @ centre.P)
    Z = inverse(one + V @ S) @ V
    P = congruence(equations.A, Z) + equations.Q
    M = inverse(P) @ congruence(centre.P, H).times(centre.theta)  # V - P = theta P H P
    return M.trace() - log_det(one + M, inverse(one + M))


def converging(claim: dict[str, Any], at: Deployment) -> str:
    """`convergence`: the orbit from V_0, step by step, ends in a region of contraction, or in a bracket that does."""
    keys = "box", "factor", "Y", "rate", "radius", "steps", "bits"
    blocks = tuple(Bracket._fields) if _has_some(claim["proof"], Bracket._fields) else ()
    filters, node, c, proof = _opened(claim, at, "proof", *keys, *blocks)
    box, region = _box(proof["box"], at.n, c), _region(proof, at.n)
    start = check.symmetric(claim["start"], at.n, "start")
    steps, bits = check.whole(proof, "proof.steps", 1, MOST_STEPS), check.whole(proof, "proof.bits", 64, MOST_BITS)
    check.require(steps * bits <= MOST_WORK, "so many steps and bits are not tried")
    way = _bracket(proof, at.n) if blocks else None

    def contracting() -> Enclosure:
        found = filters.enclosure(node, c, box)
        region.require_contraction(found)
        return found

    found = at_some(PRECISIONS, contracting)

    def arriving() -> None:
        equations = filters.equations(node, c)
        end = orbit(equations, start, steps)
        if way is None:
            region.require_inside(found, region.seen(found, end))
        else:
            ends = by_blocks(equations, end, way)
            region.require_inside(found, between(*(region.seen(found, M) for M in ends)))

    at_some((bits, 2 * bits), arriving)
    return (
        f"The covariances of the filter of {_who(node, c)}, started at the stated one, converge to its steady state."
    )


def orbit(equations: Equations, start: Matrix, steps: int) -> Balls:
    """P_steps, from V_0 = start and P_1 = A (V_0^-1 + S)^-1 A' + Q."""
    V = exact(start)
    require_shown(is_positive(V), "the start was not shown to be positive definite")
    P = Around.of(equations.following(equations.at(V, exactly(0))))
    for _ in range(steps - 1):
        Clock.check()
        P = step(equations, P)
    return P.hull()


def converging_for_all(claim: dict[str, Any], at: Deployment) -> str:
    """`convergence-all`: a bracket around every orbit ends in a region of contraction."""
    keys = "lower", "upper", "steps", "box", "factor", "Y", "rate", "radius"
    filters, node, c, proof = _opened(claim, at, "proof", *keys)
    box, region = _box(proof["box"], at.n, c), _region(proof, at.n)
    low, high = (check.symmetric(proof[key], at.n, f"proof.{key}") for key in ("lower", "upper"))
    steps = check.whole(proof, "proof.steps", 0, MOST_STEPS + 1)
    check.require(check.is_positive_definite(at.Q) or check.is_semidefinite(at.Q), "Q is not positive semidefinite")

    def show() -> None:
        found = filters.enclosure(node, c, box)
        region.require_contraction(found)
        L, U = bracket(found.equations, low, high, steps)
        region.require_inside(found, between(region.seen(found, L), region.seen(found, U)))

    at_some(PRECISIONS, show)
    return f"The covariances of the filter of {_who(node, c)} converge to one steady state from every start."


def in_time(verify: Callable[[dict[str, Any], Deployment], str]) -> Callable[[dict[str, Any], Deployment], str]:
    """The same, but declined where it takes too long: the claims after it have their turn."""

    def within(claim: dict[str, Any], at: Deployment) -> str:
        whole, Clock.end = Clock.end, min(Clock.end, process_time() + LONGEST)
        try:
            return verify(claim, at)
        except Declined as declined:
            if process_time() > whole:
                raise
            raise Declined(f"the claim takes more than {LONGEST} seconds") from declined
        finally:
            Clock.end = whole

    return within


VERIFIERS = {  # as the rules of check.py: keys of its own, and what verifies it
    ("steady-state", "proved"): (("node", "c", "gain_error"), steady_state),
    ("attraction", "proved"): (("node", "c", "rate"), attracting),
    ("attraction", "refuted"): (("node", "c"), repelling),
    ("tolerance", "proved"): (("node", "c", "interval"), tolerance),
    ("convergence", "proved"): (("node", "c", "start"), converging),
    ("convergence-all", "proved"): (("node", "c"), converging_for_all),
}


RULES = {key: (own, in_time(verify)) for key, (own, verify) in VERIFIERS.items()}


def _opened(claim: dict[str, Any], at: Deployment, evidence: str, *keys: str) -> tuple[Filters, Node, Fraction, Any]:
    """The filters, the node, its tolerance, and the proof or witness with these keys."""
    node = claim["node"]
    known = (type(node) is int and 0 <= node < len(at)) or node == "centre"
    check.require(known, "node: expected a node of the network, or centre")
    check.require(at.n <= MOST_STATES, f"filters of more than {MOST_STATES} states are not tried")
    c = _number(claim, "c")
    return filters_of(at), node, Fraction(c), check.object_of(claim[evidence], evidence, *keys)


def _number(thing: dict[str, Any], key: str) -> float:
    """A number that is not negative."""
    x = check.doubles(thing[key], 1, key)[0]
    check.require(x >= 0, f"{key}: expected a number that is not negative")
    return x


def _box(thing: Any, n: int, c: Fraction) -> Box:
    check.object_of(thing, "box", "P", "theta", "radius")
    P, theta, radius = check.symmetric(thing["P"], n, "box.P"), _number(thing, "theta"), _number(thing, "radius")
    check.require(all(row[i] > 0 for i, row in enumerate(P.rows)) and 0 < radius < 1, "box: empty, or too wide")
    check.require((theta > 0) == (c > 0), "box.theta: expected a number above 0 for c > 0, and 0 for c = 0")
    return Box(P, Fraction(theta), Fraction(radius))


def _region(proof: dict[str, Any], n: int) -> Region:
    L, Y = check.matrix(proof["factor"], n, n, "proof.factor"), check.symmetric(proof["Y"], len(upper(n)), "proof.Y")
    rate, radius = _number(proof, "rate"), _number(proof, "radius")
    check.require(0 < rate < 1 and radius > 0, "proof: expected a rate between 0 and 1, and a radius above 0")
    return Region(L, Y, Fraction(rate), Fraction(radius))


def _has_some(thing: Any, keys: Sequence[str]) -> bool:
    return isinstance(thing, dict) and any(key in thing for key in keys)


def _bracket(proof: dict[str, Any], n: int) -> Bracket:
    low, high = (check.symmetric(proof[key], n, f"proof.{key}") for key in ("lower", "upper"))
    blocks = proof["blocks"]
    known = isinstance(blocks, list) and all(type(k) is int and 0 <= k <= MOST_DOUBLINGS for k in blocks)
    check.require(known, f"proof.blocks: expected whole numbers from 0 to {MOST_DOUBLINGS}")
    check.require(len(blocks) <= MOST_BLOCKS, f"proof.blocks: more than {MOST_BLOCKS} are not tried")
    return Bracket(low, high, blocks)


def _who(node: Node, c: Fraction) -> str:
    name = "the centre" if node == "centre" else f"node {node}"
    return f"{name} at the tolerance {float(c)!r} (gamma)"


if __name__ == "__main__":
    sys.exit(check.main(more=RULES))
