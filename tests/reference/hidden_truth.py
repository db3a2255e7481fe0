"""What a plant of doubles hides, from the definition: fractions, the observability matrix, roots to 200 digits."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import mpmath
from numpy import ndarray

_DIGITS = 200

Matrix = list[list[Fraction]]


def exactly(M: ndarray) -> Matrix:
    """Doubles as fractions."""
    return [[Fraction(entry) for entry in row] for row in M.tolist()]


def product(X: Matrix, Y: Matrix) -> Matrix:
    """X Y."""
    return [[_dot(row, column) for column in zip(*Y, strict=True)] for row in X]


def _dot(row: Sequence[Fraction], column: Sequence[Fraction]) -> Fraction:
    return sum((a * b for a, b in zip(row, column, strict=True)), Fraction(0))


def kernel(M: Matrix, n: int) -> Matrix:
    """Vectors that span the kernel of the rows M of length n, each a list."""
    rows, pivots = [row[:] for row in M], []
    for j in range(n):
        i = len(pivots)
        at = next((k for k in range(i, len(rows)) if rows[k][j]), None)
        if at is None:
            continue
        rows[i], rows[at] = rows[at], rows[i]
        rows[i] = [x / rows[i][j] for x in rows[i]]
        for k in range(len(rows)):
            if k != i and rows[k][j]:
                rows[k] = [x - rows[k][j] * y for x, y in zip(rows[k], rows[i], strict=True)]
        pivots.append(j)
    found = []
    for free in sorted(set(range(n)) - set(pivots)):
        v = [Fraction(int(j == free)) for j in range(n)]
        for i, j in enumerate(pivots):
            v[j] = -rows[i][free]
        found.append(v)
    return found


def hidden_excesses(A: ndarray, C: ndarray) -> list[float]:
    """|lambda| - 1 of every eigenvalue of A on the kernel of [C; C A; ...; C A^(n-1)], repeated ones once.

    Zero below 1e-100.
    """
    n, plant, rows = len(A), exactly(A), exactly(C)
    stacked, last = [*rows], rows
    for _ in range(n - 1):
        last = product(last, plant) if last else []
        stacked += last
    basis = kernel(stacked, n)
    if not basis:
        return []
    # A v = sum_i w_i v_i: the w are the entries of A v where the v_i form an identity, their free coordinates.
    free = [max(j for j in range(n) if v[j] == 1 and all(w[j] == 0 for w in basis if w is not v)) for v in basis]
    images = [[_dot(row, v) for row in plant] for v in basis]
    restricted = [[image[j] for image in images] for j in free]
    with mpmath.workdps(_DIGITS):
        excesses = [abs(root) - 1 for root in _roots(_without_repeats(_characteristic(restricted)))]
        return sorted(float(e) if abs(e) > mpmath.mpf(10) ** (-_DIGITS // 2) else 0.0 for e in excesses)


def _characteristic(M: Matrix) -> list[Fraction]:
    """Coefficients of det(x I - M), highest first (Faddeev and LeVerrier)."""
    n = len(M)
    coefficients, N = [Fraction(1)], [[Fraction(0)] * n for _ in range(n)]
    for k in range(1, n + 1):
        N = [[N[i][j] + (coefficients[-1] if i == j else 0) for j in range(n)] for i in range(n)]
        N = product(M, N)
        coefficients.append(-sum((N[i][i] for i in range(n)), Fraction(0)) / k)
    return coefficients


def _divided(p: list[Fraction], q: list[Fraction]) -> tuple[list[Fraction], list[Fraction]]:
    quotient, rest = [], p[:]
    while len(rest) >= len(q):
        quotient.append(rest[0] / q[0])
        rest = [x - quotient[-1] * y for x, y in zip(rest, q + [Fraction(0)] * (len(rest) - len(q)), strict=True)][1:]
    while rest and rest[0] == 0:
        rest = rest[1:]
    return quotient, rest


def _without_repeats(p: list[Fraction]) -> list[Fraction]:
    a, b = p, [c * (len(p) - 1 - i) for i, c in enumerate(p[:-1])]
    while b:
        a, b = b, _divided(a, b)[1]
    return _divided(p, a)[0]


def _roots(p: list[Fraction]) -> list[mpmath.mpc]:
    """Eigenvalues of the companion matrix."""
    d = len(p) - 1
    companion = mpmath.matrix(d, d)
    for i in range(d):
        if i:
            companion[i, i - 1] = 1
        coefficient = p[d - i] / p[0]
        companion[i, d - 1] = -mpmath.mpf(coefficient.numerator) / coefficient.denominator
    return list(mpmath.eig(companion, left=False, right=False)) if d else []
