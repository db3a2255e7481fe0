"""Check the claims about filters, which need a logarithm, with the Python standard library alone.

    python check_filters.py certificate.json        # every claim: those of check.py, which lies beside it, too

Every number is enclosed: a scalar between two fractions that are rounded outward, a matrix between whole numbers,
middle and radius. What is computed holds for every number inside; a comparison that is true was proved, and one that
is false says nothing, so that `invalid` means not shown. Nothing is shared with the program that wrote the
certificate: docs/certificate.md and docs/mathematics.md, 11.4 to 11.9, say what is verified and why.

Read in this order: intervals, matrices in balls, inverses and definiteness, the equations of a filter, its steady
state, the covariance recursion, the region of contraction, the bracket, the filters of a deployment, the claims.
"""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import combinations, combinations_with_replacement
from operator import mul
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar


def _beside(name: str) -> Any:
    """The module in the file of this name beside this one, where `python -I` does not look."""
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


if TYPE_CHECKING or __package__:
    from tolnet.certificates import check
    from tolnet.certificates.check import Deployment, Matrix, Wrong
else:
    check = _beside("check")
    Deployment, Matrix, Wrong = check.Deployment, check.Matrix, check.Wrong

PRECISIONS = (256, 512, 1536)  # binary digits, one after the other until a claim is shown
COARSE = 120  # binary digits of radii
MOST_STATES = 30
MOST_STEPS, MOST_BITS, MOST_WORK = 5000, 2**12, 2**21  # of an orbit; work is steps times bits
REFINEMENTS, WIDENINGS, PERRON_STEPS = 8, 4, 20
LARGEST_EXPONENT = 2**16
GUARD = 32  # further digits inside a logarithm or an elimination
SINGULAR = "a matrix that must be inverted may be singular"
T = TypeVar("T")


class NotShown(Wrong):
    """Not shown at the working precision: a higher one may do."""


def _require(condition: bool, complaint: str) -> None:
    if not condition:
        raise NotShown(complaint)


class Precision:
    """The binary digits of middles and of ends of intervals."""

    bits = PRECISIONS[0]


@contextmanager
def precision(bits: int) -> Iterator[None]:
    """Work with so many binary digits."""
    before, Precision.bits = Precision.bits, bits
    try:
        yield
    finally:
        Precision.bits = before


def at_some(precisions: Iterable[int], attempt: Callable[[], T]) -> T:
    """What the attempt returns at the first of these precisions at which it shows something."""
    problem = NotShown("nothing was tried")
    for bits in precisions:
        with precision(bits):
            try:
                return attempt()
            except NotShown as wrong:
                problem = wrong
    raise problem


# -------------------- Intervals -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Interval:
    """All numbers from low to high; both are dyadic."""

    low: Fraction
    high: Fraction

    @classmethod
    def around(cls, low: Fraction, high: Fraction) -> Interval:
        """Low and high, rounded outward to the working precision."""
        return cls(-_rounded_up(-low), _rounded_up(high))

    @property
    def middle(self) -> Fraction:
        return (self.low + self.high) / 2

    @property
    def radius(self) -> Fraction:
        return (self.high - self.low) / 2

    @property
    def size(self) -> Fraction:
        """The largest modulus."""
        return max(-self.low, self.high)

    def __neg__(self) -> Interval:
        return Interval(-self.high, -self.low)

    def __add__(self, other: Interval) -> Interval:
        return Interval.around(self.low + other.low, self.high + other.high)

    def __sub__(self, other: Interval) -> Interval:
        return self + -other

    def __mul__(self, other: Interval) -> Interval:
        if self.low >= 0 and other.low >= 0:
            return Interval.around(self.low * other.low, self.high * other.high)
        ends = [x * y for x in (self.low, self.high) for y in (other.low, other.high)]
        return Interval.around(min(ends), max(ends))

    def __truediv__(self, other: Interval) -> Interval:
        _require(other.low > 0 or other.high < 0, "a divisor may be zero")
        ends = [x / y for x in (self.low, self.high) for y in (other.low, other.high)]
        return Interval.around(min(ends), max(ends))

    def sqrt(self) -> Interval:
        """Of the numbers that are not negative."""
        _require(self.low >= 0, "a root of a negative number")
        return Interval(_root(self.low)[0], _root(self.high)[1])

    def log(self) -> Interval:
        """The natural logarithm."""
        _require(self.low > 0, "a logarithm of a number that may not be positive")
        low = logarithm(self.low)
        return Interval.around(low.low, (low if self.high == self.low else logarithm(self.high)).high)

    def is_inside(self, other: Interval) -> bool:
        """Whether it lies inside, its ends too."""
        return other.low < self.low and self.high < other.high


def exactly(x: Fraction | int | float) -> Interval:
    """The dyadic number x."""
    return Interval(Fraction(x), Fraction(x))


def plus_minus(middle: Fraction, radius: Fraction) -> Interval:
    return Interval.around(middle - radius, middle + radius)


def _rounded_up(x: Fraction) -> Fraction:
    """A dyadic number at least as large as x, of the working precision."""
    shift = Precision.bits + x.denominator.bit_length() - x.numerator.bit_length()
    up, down = max(shift, 0), max(-shift, 0)
    return Fraction(-((-x.numerator << up) // (x.denominator << down)) << down, 1 << up)


def _root(x: Fraction) -> tuple[Fraction, Fraction]:
    """Dyadic numbers below and above the root of x, from whole numbers: s <= sqrt(4^k x) < s + 1."""
    k = max(0, Precision.bits + (x.denominator.bit_length() - x.numerator.bit_length()) // 2)
    scaled = x * 4**k
    low = math.isqrt(math.floor(scaled))
    return Fraction(low, 2**k), Fraction(low if low * low == scaled else low + 1, 2**k)


def logarithm(x: Fraction) -> Interval:
    """log x = k log 2 + 2 atanh((y - 1) / (y + 1)) for y = x / 2^k from 1 to 2; log 2 = 2 atanh(1/3)."""
    k = x.numerator.bit_length() - x.denominator.bit_length()
    k -= x < Fraction(2) ** k
    y = x / Fraction(2) ** k
    digits = Precision.bits + GUARD + abs(k).bit_length()
    (low, high), (low_2, high_2) = _atanh((y - 1) / (y + 1), digits), _atanh(Fraction(1, 3), digits)
    ends = (low_2, high_2) if k >= 0 else (high_2, low_2)
    unit = Fraction(2, 2**digits)
    return Interval.around((k * ends[0] + low) * unit, (k * ends[1] + high) * unit)


@lru_cache(maxsize=64)
def _atanh(z: Fraction, digits: int) -> tuple[int, int]:
    """2^digits atanh z = sum of t_i / (2 i + 1), t_i = 2^digits z^(2 i + 1), from below and above, 0 <= z <= 1/3.

    Rounded down, t_i is too small by less than 2: the error e of one gives e/9 + 1 + 1/3 of the next. With what the
    division loses, a term is too small by less than 3. Behind the last, t < 3, and the rest of the series is less
    than 3 (1 + 1/9 + ...) < 4.
    """
    square = (z.numerator**2 << digits) // z.denominator**2
    t = (z.numerator << digits) // z.denominator
    total = count = 0
    while t:
        total += t // (2 * count + 1)
        count += 1
        t = t * square >> digits
    return total, total + 3 * count + 4 * (z > 0)


# -------------------- Matrices in balls -----------------------------------------------------------------------


@dataclass(slots=True)
class Balls:
    """Every matrix whose entries are within `radius` of those of `middle`."""

    middle: Matrix
    radius: Matrix

    @property
    def T(self) -> Balls:
        return Balls(self.middle.T, self.radius.T)

    @property
    def size(self) -> Matrix:
        """The largest moduli of the entries, or a little more."""
        return _plus(_coarse(self.middle), self.radius)

    def __add__(self, other: Balls) -> Balls:
        return _rounded(_plus(self.middle, other.middle), _plus(self.radius, other.radius))

    def __sub__(self, other: Balls) -> Balls:
        return _rounded(_plus(self.middle, other.middle, -1), _plus(self.radius, other.radius))

    def __matmul__(self, other: Balls) -> Balls:
        return self.by(other.T)

    def by(self, other: Balls) -> Balls:
        """P Q': |P Q' - p q'| <= |p| s' + r (|q|' + s') for the middles p and q and the radii r and s."""
        radius = _plus(_coarse(self.middle).by(other.radius), self.radius.by(other.size))
        return _rounded(self.middle.by(other.middle), radius)

    def times(self, x: Interval) -> Balls:
        """x P: |x P - m p| <= |m| r + s (|p| + r) for the middle m and the radius s of x."""
        m, s = x.middle, x.radius
        return _rounded(_times(m, self.middle), _plus(_times(abs(m), self.radius), _times(s, self.size)))

    def entry(self, i: int, j: int) -> Interval:
        middle = check.scaled(self.middle.rows[i][j], self.middle.exponent)
        radius = check.scaled(self.radius.rows[i][j], self.radius.exponent)
        return Interval(middle - radius, middle + radius)

    def trace(self) -> Interval:
        """The sum of the diagonal."""
        middle, radius = (check.trace(M, range(len(M.rows))) for M in (self.middle, self.radius))
        return plus_minus(middle, radius)


def exact(M: Matrix) -> Balls:
    """M alone."""
    return Balls(M, Matrix([[0] * len(row) for row in M.rows]))


def _digits(M: Matrix) -> int:
    """Of the largest entry."""
    return max((max(max(row), -min(row)) for row in M.rows), default=0).bit_length()


def _times(c: Fraction, M: Matrix) -> Matrix:
    """c M for a dyadic c."""
    exponent = M.exponent + 1 - c.denominator.bit_length()
    return Matrix([[c.numerator * x for x in row] for row in M.rows], exponent)


def _plus(M: Matrix, other: Matrix, sign: int = 1) -> Matrix:
    """M + other, or M - other."""
    exponent = min(M.exponent, other.exponent)
    up, factor = M.exponent - exponent, sign << (other.exponent - exponent)
    rows = zip(M.rows, other.rows, strict=True)
    return Matrix([[(x << up) + factor * y for x, y in zip(*both, strict=True)] for both in rows], exponent)


def _coarse(M: Matrix) -> Matrix:
    """|M|, rounded up to fewer digits."""
    most = _digits(M) - COARSE
    if most <= 0:
        return Matrix([[abs(x) for x in row] for row in M.rows], M.exponent)
    return Matrix([[-(-abs(x) >> most) for x in row] for row in M.rows], M.exponent + most)


def _rounded(middle: Matrix, radius: Matrix) -> Balls:
    """What has these middles and radii, to the working precision: what rounding loses is added to the radii."""
    short = _shortened(middle)
    if short is not middle:
        radius = _plus(radius, Matrix([[1] * len(row) for row in short.rows], short.exponent))
    _require(abs(short.exponent) < LARGEST_EXPONENT, "numbers are too large or too small")
    return Balls(short, _coarse(radius))


def _shortened(M: Matrix) -> Matrix:
    """M, rounded down to the working precision."""
    most = _digits(M) - Precision.bits
    return M if most <= 0 else Matrix([[x >> most for x in row] for row in M.rows], M.exponent + most)


def unit(n: int) -> Balls:
    return exact(check.unit(n))


def diagonal(entries: Sequence[Interval]) -> Balls:
    """The diagonal matrix of these numbers."""
    n = len(entries)
    return assemble([(i, i, scalar(x)) for i, x in enumerate(entries)], n, n)


def scalar(x: Interval) -> Balls:
    """The matrix [x]."""
    one = Matrix([[1]])
    return Balls(x.middle * one, x.radius * one)


def assemble(blocks: Sequence[tuple[int, int, Balls]], height: int, width: int) -> Balls:
    """The matrix of blocks, given with the row and the column where each begins."""
    middles, radii = ([(i, j, getattr(M, part)) for i, j, M in blocks] for part in ("middle", "radius"))
    return Balls(check.assemble(middles, height, width), check.assemble(radii, height, width))


def symmetric(M: Balls) -> Balls:
    """(M + M') / 2, which encloses the same symmetric matrices as M does."""
    twice = M + M.T
    return Balls(*(Matrix(part.rows, part.exponent - 1) for part in (twice.middle, twice.radius)))


def congruence(K: Balls, S: Balls) -> Balls:
    """K S K' for a symmetric S."""
    return symmetric(K @ S.by(K))


@lru_cache
def upper(n: int) -> list[tuple[int, int]]:
    """The places i <= j of a symmetric matrix, row by row: its coordinates."""
    return list(combinations_with_replacement(range(n), 2))


def coordinates(S: Balls) -> Balls:
    """The column of the entries i <= j of a symmetric matrix."""
    pairs = upper(len(S.middle.rows))
    column = (Matrix([[M.rows[i][j]] for i, j in pairs], M.exponent) for M in (S.middle, S.radius))
    return Balls(*column)


def from_coordinates(column: Balls, n: int) -> Balls:
    """The symmetric matrix with these entries; what follows them is left out."""
    place = {pair: k for k, pair in enumerate(upper(n))}
    matrix = (
        Matrix([[M.rows[place[min(i, j), max(i, j)]][0] for j in range(n)] for i in range(n)], M.exponent)
        for M in (column.middle, column.radius)
    )
    return Balls(*matrix)


# -------------------- Inverses, determinants, definiteness ----------------------------------------------------


def near_inverse(M: Matrix) -> Matrix:
    """Near the inverse: elimination in fixed point, in place, with the largest pivot of a column."""
    n, digits = len(M.rows), Precision.bits + GUARD
    lift = digits - _digits(M)
    rows = [[check.shifted(x, lift) for x in row] for row in M.rows]
    order = list(range(n))
    for k in range(n):
        check.Clock.check()
        best = max(range(k, n), key=lambda i: abs(rows[i][k]))
        rows[k], rows[best], order[k], order[best] = rows[best], rows[k], order[best], order[k]
        pivot, rows[k][k] = rows[k][k], 1 << digits
        _require(pivot != 0, SINGULAR)
        top = rows[k] = [(x << digits) // pivot for x in rows[k]]
        for i, row in enumerate(rows):
            if i != k and (head := row[k]):
                row[k] = 0
                rows[i] = [x - (head * y >> digits) for x, y in zip(row, top, strict=True)]
    place = sorted(range(n), key=order.__getitem__)
    return _shortened(Matrix([[row[j] for j in place] for row in rows], lift - 2 * digits - M.exponent))


def inverse(M: Balls) -> Balls:
    """M^-1 = B + E (B + E M^-1) for B near the inverse of the middle and E = I - B M.

    Where |E| d <= q d, q < 1, for d = |B| (1, ..., 1)': M^-1 = B + E B + E^2 B + ..., whose entry (i, j) is at most
    d_i b_j / (1 - q) for the b_j with |B|_ij <= d_i b_j.
    """
    B = near_inverse(M.middle)
    E = unit(len(B.rows)) - exact(B) @ M
    d = [sum(map(abs, row)) for row in B.rows]
    _require(all(d), SINGULAR)
    q = contraction(E.size, d)
    sizes = [
        max(Fraction(abs(x), d_i) for x, d_i in zip(column, d, strict=True)) for column in zip(*B.rows, strict=True)
    ]
    bound = [[math.ceil(d_i * b / (1 - q)) for b in sizes] for d_i in d]
    rest = Balls(Matrix([[0] * len(d) for _ in d]), _coarse(Matrix(bound, B.exponent)))
    return exact(B) + E @ (exact(B) + E @ rest)


def contraction(size: Matrix, d: list[int]) -> Fraction:
    """The least q with |E| d <= q d. NotShown where it is not below one: then I - E may be singular."""
    sums = (sum(x * y for x, y in zip(row, d, strict=True)) for row in size.rows)
    q = max(Fraction(total, d_i) for total, d_i in zip(sums, d, strict=True)) * Fraction(2) ** size.exponent
    _require(q < 1, SINGULAR)
    return q


def determinant(M: Matrix) -> Fraction:
    """By fraction-free elimination."""
    rows, previous, sign = M.rows, 1, 1
    n = len(rows)
    while rows:
        best = next((i for i, row in enumerate(rows) if row[0]), None)
        if best is None:
            return Fraction(0)
        sign = -sign if best else sign
        (pivot, *rest), *below = [rows[best], *rows[1:best], *rows[:1], *rows[best + 1 :]] if best else rows
        rows = [[(x * pivot - head * y) // previous for x, y in zip(row, rest, strict=True)] for head, *row in below]
        previous = pivot
    return check.scaled(sign * previous, n * M.exponent)


def log_det(M: Balls, back: Balls) -> Interval:
    """log det of every matrix in M, whose inverses lie in `back`.

    det(m + R) = det m det(I + m^-1 R); where |m^-1| |R| d <= q d for some d > 0, the logarithm of the second is at
    most n (q + q^2 / 2 + ...).
    """
    relative = back.size @ M.radius
    q = contraction(relative, [sum(row) for row in back.size.rows]) if any(map(any, relative.rows)) else Fraction(0)
    det = determinant(M.middle)
    _require(det > 0, "a determinant may not be positive")
    return exactly(det).log() + plus_minus(Fraction(0), len(relative.rows) * q / (1 - q))


def slack(M: Balls) -> Matrix:
    """A diagonal matrix D with -D <= R <= D for every symmetric R within the radii of M.

    R <= diag(sum_j R_ij t_j / t_i) for any t > 0; here 1 / t_i is a power of two near the root of M_ii.
    """
    n = len(M.middle.rows)
    roots = [abs(row[i]).bit_length() // 2 for i, row in enumerate(M.middle.rows)]
    least = min(roots) - max(roots)
    shift = [[0] * n for _ in range(n)]
    for i, row in enumerate(M.radius.rows):
        shift[i][i] = sum(x << (roots[i] - b - least) for x, b in zip(row, roots, strict=True))
    return Matrix(shift, M.radius.exponent + least)


def below(M: Balls) -> Matrix:
    """An exact matrix below every symmetric matrix in M."""
    M = symmetric(M)
    return M.middle - slack(M)


def above(M: Balls) -> Matrix:
    """An exact matrix above every symmetric matrix in M."""
    M = symmetric(M)
    return M.middle + slack(M)


def is_positive(M: Balls) -> bool:
    """Whether every symmetric matrix in M was shown to be positive definite.

    Where the radii, moved to the diagonal, take too much: for X near the inverse of a Cholesky factor of the middle,
    X M X' is near the identity, and its diagonal may outweigh the rest. Last, by elimination in intervals.
    """
    if check.is_positive_definite(below(M)):
        return True
    X = near_inverse_factor(symmetric(M).middle) if any(map(any, M.radius.rows)) else None
    return X is not None and (outweighs(congruence(exact(X), M)) or has_positive_pivots(M))


def has_positive_pivots(M: Balls) -> bool:
    """Whether every pivot of the symmetric elimination is positive for all of M."""
    rows = [[M.entry(i, j) for j in range(i + 1)] for i in range(len(M.middle.rows))]
    while rows:
        check.Clock.check()
        (pivot,), *rows = rows
        if not pivot.low > 0:
            return False
        heads = [row[0] for row in rows]
        shares = [head / pivot for head in heads]
        rows = [[x - shares[i] * heads[j] for j, x in enumerate(row[1:])] for i, row in enumerate(rows)]
    return True


def outweighs(M: Balls) -> bool:
    """Whether M_ii d_i > sum |M_ij| d_j over the other j, for some d > 0: symmetric, M is then positive definite.

    That is Gershgorin's theorem for D^-1 M D. Among the d, one near the Perron vector of the moduli serves best.
    """
    n = len(M.middle.rows)
    least = [M.entry(i, i).low for i in range(n)]
    if min(least) <= 0:
        return False
    scale = 1 / max(least)
    rest = [[math.ceil(M.entry(i, j).size * scale * 2**60) * (i != j) for j in range(n)] for i in range(n)]
    diagonal = [math.floor(x * scale * 2**60) for x in least]
    d = [1 << 30] * n
    for _ in range(PERRON_STEPS):
        d = [sum(map(mul, row, d)) for row in rest]
        d = [(x << 30) // max(d) + 1 for x in d] if any(d) else [1] * n
        if all(sum(map(mul, row, d)) < x * y for row, x, y in zip(rest, diagonal, d, strict=True)):
            return True
    return False


def near_inverse_factor(S: Matrix) -> Matrix | None:
    """Near L^-1 for S = L L', in floating point: D S D with a diagonal near one, D = diag(2^lift). Or None."""
    n = len(S.rows)
    if min(row[i] for i, row in enumerate(S.rows)) <= 0:
        return None
    lift = [60 - (row[i].bit_length() + 1) // 2 for i, row in enumerate(S.rows)]
    X = [[0.0] * n for _ in range(n)]
    L: list[list[float]] = []
    for i, row in enumerate(S.rows):
        c: list[float] = []
        for j, above in enumerate(L):
            entry = math.ldexp(check.shifted(row[j], lift[i] + lift[j]), -120)
            c.append((entry - sum(x * y for x, y in zip(c, above, strict=False))) / above[j])
        pivot = math.ldexp(check.shifted(row[i], 2 * lift[i]), -120) - sum(x * x for x in c)
        if not pivot > 0:
            return None
        L.append([*c, math.sqrt(pivot)])
        X[i][i] = 1 / L[i][i]
        for j in range(i):
            X[i][j] = -sum(L[i][k] * X[k][j] for k in range(j, i)) / L[i][i]
    rows = [[round(math.ldexp(x, 60)) << (up - min(lift)) for x, up in zip(row, lift, strict=True)] for row in X]
    return Matrix(rows, min(lift))


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
        return Slope(loop, thrust, _twice_off_the_diagonal(N), (N @ at.P).trace(), at.theta)


def squared(K: Balls) -> Balls:
    """The matrix of E -> K E K' in the coordinates of E: |(k + r)(k + r) - k k| <= (|k| + r)(|k| + r) - |k| |k|."""
    least = _coarse(K.middle)
    return _rounded(_squared(K.middle), _squared(least + K.radius) - _squared(least))


def _squared(K: Matrix) -> Matrix:
    pairs = upper(len(K.rows))
    rows = [
        [x[i] * y[j] + (x[j] * y[i] if i != j else 0) for i, j in pairs]
        for x, y in ((K.rows[a], K.rows[b]) for a, b in pairs)
    ]
    return Matrix(rows, 2 * K.exponent)


def _twice_off_the_diagonal(N: Balls) -> Balls:
    """The row of dP -> tr(N dP)."""
    pairs = upper(len(N.middle.rows))
    parts = (Matrix([[M.rows[i][j] << (i != j) for i, j in pairs]], M.exponent) for M in (N.middle, N.radius))
    return Balls(*parts)


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
    _require(all(inside), f"Krawczyk's test fails on the box of relative radius {float(box.radius):.1e}")
    tight = Fraction(1, 2**128) / max(Fraction(1), equations.c) ** 3
    for _ in range(REFINEMENTS):
        if all(image.entry(i, 0).radius <= tight * x.low for i, x in enumerate(reach)):
            break
        image = test.image(image, B)
    found = test.at(image)
    _require(is_positive(found.P) and equations.is_inside(found.P, found.theta), "0 < P, theta P < I were not shown")
    return Enclosure(equations, found.P, found.theta)


def column(entries: Sequence[Interval]) -> Balls:
    """The column of these numbers."""
    whole = assemble([(i, 0, scalar(x)) for i, x in enumerate(entries)], len(entries), 1)
    return _rounded(whole.middle, whole.radius)


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
    _require(X.low > 0 and root.is_inside(X) and equations.is_inside(P, X), "theta was not enclosed")
    return root


def _gamma(P: Balls, theta: Interval) -> tuple[Interval, Interval]:
    """gamma and its derivative in theta: log det(I - theta P) + theta tr(H P), and theta tr((H P)^2)."""
    inflated = unit(len(P.middle.rows)) - P.times(theta)
    H = inverse(inflated)
    V = H @ P
    return log_det(inflated, H) + theta * V.trace(), theta * (V @ V).trace()


def near_theta(P: Matrix, c: float) -> Fraction:
    """theta with gamma(P, theta) = c > 0, in floating point: mu / (1 + mu) over the largest eigenvalue."""
    most = _digits(P)
    values = eigenvalues([[math.ldexp(check.shifted(x, 900 - most), -900) for x in row] for row in P.rows])
    largest = max(values)
    _require(largest > 0, "a covariance is not positive")
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
        _require(is_positive(Y), "Y > 0 was not shown")
        equations, back = at.equations.seen_from(L), inverse(Y)
        reach = [(back.entry(i, i).sqrt() * exactly(self.radius)).high for i in range(len(upper(n)))]
        X = congruence(inverse(L), at.P) + from_coordinates(column([Interval(-x, x) for x in reach]), n)
        _require(is_positive(X), "0 < P was not shown on the region")
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
        _require(norm.high <= self.radius**2, "it does not end in the region of contraction")


def weighed(Y: Matrix, n: int) -> Balls:
    """Y, given in the coordinates D_ii and sqrt(2) D_ij, in the coordinates D_ij."""
    root = exactly(2).sqrt()
    return congruence(diagonal([exactly(1) if i == j else root for i, j in upper(n)]), exact(Y))


def require_decrease(J: Balls, Y: Balls, rate: Fraction) -> None:
    """Y > 0 and rate^2 Y - J' Y J > 0."""
    _require(is_positive(Y), "Y > 0 was not shown")
    left = Y.times(exactly(rate**2)) - congruence(J.T, Y)
    _require(is_positive(left), "r^2 Y - J' Y J > 0 was not shown")


# -------------------- A bracket around every orbit ------------------------------------------------------------


def bracket(equations: Equations, low: Matrix, high: Matrix, steps: int) -> tuple[Balls, Balls]:
    """L and U, so many steps on, between which every orbit lies in the end.

    With kappa - 1 - log kappa >= c, T_0(P) = A (P^-1 + S)^-1 A' + Q and T_+(P) = A ((kappa P)^-1 + S)^-1 A' + Q:
    0 < L < T_0(L) and U > T_+(U) > 0 hold every orbit; gamma rises with P, so theta(U) <= theta_t <= theta(L), and
    the next P lies between T(L, theta(U)) and T(U, theta(L)), or T_+(U).
    """
    under, over = near_factors(float(equations.c))
    _require(_gain(over).low >= equations.c, "the factor kappa of the tolerance was not enclosed")
    L, U = exact(low), exact(high)
    _require(is_positive(L) and is_positive(U), "the bracket does not begin with positive definite matrices")
    _require(is_positive(_push(equations, L, Fraction(1)) - L), "0 < L < T_0(L) was not shown")
    _require(is_positive(U - _push(equations, U, over)), "U > T_+(U) was not shown")
    if equations.n == 1:  # V = kappa P for the root kappa itself, and theta is not needed
        _require(_gain(under).high <= equations.c, "the factor kappa of the tolerance was not enclosed")
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
        _require(is_positive(L), "the lower end of the bracket was not shown to be positive definite")
    return L, U


def near_factors(c: float) -> tuple[Fraction, Fraction]:
    """A hair below and above the root kappa >= 1 of kappa - 1 - log kappa = c."""
    excess = Fraction(near_excess([1.0], c)) if c else Fraction(0)
    return 1 + excess * (1 - Fraction(1, 2**35)), 1 + excess * (1 + Fraction(1, 2**35))


def _gain(kappa: Fraction) -> Interval:
    """kappa - 1 - log kappa."""
    return exactly(kappa - 1) - exactly(kappa).log()


def _push(equations: Equations, P: Balls, kappa: Fraction) -> Balls:
    """A ((kappa P)^-1 + S)^-1 A' + Q."""
    return equations.following(equations.at(P.times(exactly(kappa)), exactly(0)))


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
            _require(is_positive(R), f"R[{l}] was not shown to be positive definite")
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
    largest = max((_largest(G) for G in stated.values()), default=Fraction(0))
    for l, G in stated.items():
        if filters.at.p[l]:
            away = _largest((AZ @ filters.sensor(l)[0] - exact(G)).size)
            _require(away <= error * largest, "the stated gain may be further from the exact one than is claimed")


def _largest(M: Matrix) -> Fraction:
    return check.scaled(max((abs(x) for row in M.rows for x in row), default=0), M.exponent)


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
        _require(is_positive(congruence(J.T, weighted) - weighted), "J' X J - X > 0 was not shown")

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
        _require((low <= 0 or found.low >= low) and found.high <= high, "the tolerance may lie outside the interval")

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
    """`convergence`: the orbit from V_0, enclosed step by step, ends in a region of contraction."""
    filters, node, c, proof = _opened(claim, at, "proof", "box", "factor", "Y", "rate", "radius", "steps", "bits")
    box, region = _box(proof["box"], at.n, c), _region(proof, at.n)
    start = check.symmetric(claim["start"], at.n, "start")
    steps, bits = check.whole(proof, "proof.steps", 1, MOST_STEPS), check.whole(proof, "proof.bits", 64, MOST_BITS)
    check.require(steps * bits <= MOST_WORK, "so many steps and bits are not tried")

    def contracting() -> Enclosure:
        found = filters.enclosure(node, c, box)
        region.require_contraction(found)
        return found

    found = at_some(PRECISIONS, contracting)

    def arriving() -> None:
        end = orbit(filters.equations(node, c), start, steps)
        region.require_inside(found, region.seen(found, end))

    at_some((bits, 2 * bits), arriving)
    return (
        f"The covariances of the filter of {_who(node, c)}, started at the stated one, converge to its steady state."
    )


def orbit(equations: Equations, start: Matrix, steps: int) -> Balls:
    """P_steps, from V_0 = start and P_1 = A (V_0^-1 + S)^-1 A' + Q."""
    V = exact(start)
    _require(is_positive(V), "the start was not shown to be positive definite")
    P = Around.of(equations.following(equations.at(V, exactly(0))))
    for _ in range(steps - 1):
        check.Clock.check()
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


RULES = {  # as those of check.py: keys of its own, and what verifies it
    ("steady-state", "proved"): (("node", "c", "gain_error"), steady_state),
    ("attraction", "proved"): (("node", "c", "rate"), attracting),
    ("attraction", "refuted"): (("node", "c"), repelling),
    ("tolerance", "proved"): (("node", "c", "interval"), tolerance),
    ("convergence", "proved"): (("node", "c", "start"), converging),
    ("convergence-all", "proved"): (("node", "c"), converging_for_all),
}


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


def _who(node: Node, c: Fraction) -> str:
    name = "the centre" if node == "centre" else f"node {node}"
    return f"{name} at the tolerance {float(c)!r} (gamma)"


if __name__ == "__main__":
    sys.exit(check.main(more=RULES))
