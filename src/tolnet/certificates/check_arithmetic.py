"""Numbers that are enclosed, with the standard library alone: what check_filters.py, beside this file, computes in.

A scalar is an interval between two fractions that are rounded outward, a matrix is two matrices of whole numbers,
middle and radius. What is computed holds for every number inside; a comparison that is true was proved, and one that
is false says nothing.

Read in this order: the precision, intervals, matrices in balls, inverses and definiteness. check_filters.py says how
this file is found where it is run without being installed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import combinations_with_replacement
from operator import mul
from typing import TypeVar

from tolnet.certificates import check
from tolnet.certificates.check import Matrix, Wrong

PRECISIONS = (256, 512, 1536)  # binary digits, one after the other until a claim is shown
COARSE = 120  # binary digits of radii
PERRON_STEPS = 20
LARGEST_EXPONENT = 2**16
GUARD = 32  # further digits inside a logarithm or an elimination
SINGULAR = "a matrix that must be inverted may be singular"
T = TypeVar("T")


class NotShown(Wrong):
    """Not shown at the working precision: a higher one may do."""


def require_shown(condition: bool, complaint: str) -> None:
    """NotShown where the condition was not shown."""
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
        require_shown(other.low > 0 or other.high < 0, "a divisor may be zero")
        ends = [x / y for x in (self.low, self.high) for y in (other.low, other.high)]
        return Interval.around(min(ends), max(ends))

    def sqrt(self) -> Interval:
        """Of the numbers that are not negative."""
        require_shown(self.low >= 0, "a root of a negative number")
        return Interval(_root(self.low)[0], _root(self.high)[1])

    def log(self) -> Interval:
        """The natural logarithm."""
        require_shown(self.low > 0, "a logarithm of a number that may not be positive")
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


def digits_of(M: Matrix) -> int:
    """Of the largest entry."""
    return max((max(max(row), -min(row)) for row in M.rows), default=0).bit_length()


def largest(M: Matrix) -> Fraction:
    """The largest modulus of the entries."""
    return check.scaled(max((abs(x) for row in M.rows for x in row), default=0), M.exponent)


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
    most = digits_of(M) - COARSE
    if most <= 0:
        return Matrix([[abs(x) for x in row] for row in M.rows], M.exponent)
    return Matrix([[-(-abs(x) >> most) for x in row] for row in M.rows], M.exponent + most)


def _rounded(middle: Matrix, radius: Matrix) -> Balls:
    """What has these middles and radii, to the working precision: what rounding loses is added to the radii."""
    short = _shortened(middle)
    if short is not middle:
        radius = _plus(radius, Matrix([[1] * len(row) for row in short.rows], short.exponent))
    require_shown(abs(short.exponent) < LARGEST_EXPONENT, "numbers are too large or too small")
    return Balls(short, _coarse(radius))


def _shortened(M: Matrix) -> Matrix:
    """M, rounded down to the working precision."""
    most = digits_of(M) - Precision.bits
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


def column(entries: Sequence[Interval]) -> Balls:
    """The column of these numbers."""
    whole = assemble([(i, 0, scalar(x)) for i, x in enumerate(entries)], len(entries), 1)
    return _rounded(whole.middle, whole.radius)


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


def twice_off_the_diagonal(N: Balls) -> Balls:
    """The row of dP -> tr(N dP)."""
    pairs = upper(len(N.middle.rows))
    parts = (Matrix([[M.rows[i][j] << (i != j) for i, j in pairs]], M.exponent) for M in (N.middle, N.radius))
    return Balls(*parts)


# -------------------- Inverses, determinants, definiteness ----------------------------------------------------


def near_inverse(M: Matrix) -> Matrix:
    """Near the inverse: elimination in fixed point, in place, with the largest pivot of a column."""
    n, digits = len(M.rows), Precision.bits + GUARD
    lift = digits - digits_of(M)
    rows = [[check.shifted(x, lift) for x in row] for row in M.rows]
    order = list(range(n))
    for k in range(n):
        check.Clock.check()
        best = max(range(k, n), key=lambda i: abs(rows[i][k]))
        rows[k], rows[best], order[k], order[best] = rows[best], rows[k], order[best], order[k]
        pivot, rows[k][k] = rows[k][k], 1 << digits
        require_shown(pivot != 0, SINGULAR)
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
    require_shown(all(d), SINGULAR)
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
    require_shown(q < 1, SINGULAR)
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
    require_shown(det > 0, "a determinant may not be positive")
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
