"""Whether a claim of robust observability is true of the numbers of a certificate: fractions, and nothing clever.

The second moment is stepped, Rt is inverted by Cramer's rule, windows are summed, leading minors are determinants.
Without a horizon: one period where nothing fades, a formula for one state; otherwise a stretch of the first instants,
which can show that a claim is false.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

Grid = list[list[Fraction]]
STRETCH = 8
"""Instants that are looked at where neither a period nor a formula settles it."""


def grid(text: str, width: int) -> Grid:
    """A matrix from its text, row by row."""
    entries = [Fraction(float.fromhex(word)) for word in text.split()]
    return [entries[i : i + width] for i in range(0, len(entries), width)]


def times(P: Grid, Q: Grid) -> Grid:
    """P Q."""
    return [
        [sum((x * y for x, y in zip(row, column, strict=True)), Fraction(0)) for column in zip(*Q, strict=True)]
        for row in P
    ]


def plus(P: Grid, Q: Grid) -> Grid:
    """P + Q."""
    return [[x + y for x, y in zip(*rows, strict=True)] for rows in zip(P, Q, strict=True)]


def scaled(c: Fraction, P: Grid) -> Grid:
    """c P."""
    return [[c * x for x in row] for row in P]


def turned(P: Grid) -> Grid:
    """P'."""
    return [list(column) for column in zip(*P, strict=True)]


def determinant(P: Grid) -> Fraction:
    """By the first row."""
    if not P:
        return Fraction(1)
    return sum(
        ((-1) ** j * x * determinant([row[:j] + row[j + 1 :] for row in P[1:]]) for j, x in enumerate(P[0])),
        Fraction(0),
    )


def inverse(P: Grid) -> Grid:
    """By Cramer's rule."""
    d, size = determinant(P), range(len(P))
    minors = [[[r[:j] + r[j + 1 :] for k, r in enumerate(P) if k != i] for j in size] for i in size]
    return [[(-1) ** (i + j) * determinant(minors[j][i]) / d for j in size] for i in size]


def positive(P: Grid) -> bool:
    """Positive definite."""
    return all(determinant([row[:k] for row in P[:k]]) > 0 for k in range(1, len(P) + 1))


class Numbers:
    """The `data` of a certificate about corrupted channels."""

    def __init__(self, data: dict[str, Any]) -> None:
        n = self.n = data["n"]
        self.A, self.F, self.Q = ([grid(text, n) for text in data[key]] for key in ("A", "F", "Q"))
        self.mu = [Fraction(float.fromhex(text)) for text in data["mu"]]
        self.C = [[grid(text, n) for text in texts] for texts in data["C"]]
        self.R = [
            [grid(text, max(1, len(C))) for text, C in zip(texts, self.C[0], strict=True)] for texts in data["R"]
        ]
        self.tau, self.phi = (
            [[Fraction(float.fromhex(x)) for x in text.split()] for text in data[key]] for key in ("tau", "phi")
        )
        triangle = iter(grid(data["initial_second_moment"], 10**6)[0])
        self.start: Grid = []
        for i in range(n):
            self.start.append([row[i] for row in self.start] + [next(triangle) for _ in range(i, n)])
        self.period = math.lcm(*map(len, (self.A, self.F, self.Q, self.mu, self.C, self.R, self.tau, self.phi)))

    def moments(self, count: int) -> list[Grid]:
        """Pi_0, Pi_1, ..."""
        found = [self.start]
        for k in range(count - 1):
            A, F, Q = (x[k % len(x)] for x in (self.A, self.F, self.Q))
            mu = self.mu[k % len(self.mu)]
            Pi = found[-1]
            moved = plus(times(times(A, Pi), turned(A)), scaled(mu, times(times(F, Pi), turned(F))))
            found.append(plus(moved, Q))
        return found

    def information(self, k: int, Pi: Grid | None, sharp: bool) -> Grid:
        """sum_i tau^2 C' Rt^-1 C; without Pi, what fades counts for nothing."""
        total = [[Fraction(0)] * self.n for _ in range(self.n)]
        for i, C in enumerate(self.C[k % len(self.C)]):
            tau, phi = (x[k % len(x)][i] if sharp else Fraction(1 - j) for j, x in enumerate((self.tau, self.phi)))
            R = self.R[k % len(self.R)][i]
            if not C or (phi and Pi is None):
                continue
            if phi and Pi is not None:
                R = plus(R, scaled(phi, times(times(C, Pi), turned(C))))
            total = plus(total, scaled(tau**2, times(times(turned(C), inverse(R)), C)))
        return total

    def gramian(self, k: int, S: dict[int, Grid], L: int) -> Grid:
        """Of the window of L instants from k."""
        G = S[k + L - 1]
        for s in reversed(range(k, k + L - 1)):
            A = self.A[s % len(self.A)]
            G = plus(S[s], times(times(turned(A), G), A))
        return G


def gramians(data: dict[str, Any], window: int, form: str, horizon: int | None) -> list[Grid]:
    """Of the windows that are looked at; for one state and constant numbers the last is the limit."""
    at, sharp = Numbers(data), form == "sharp"
    fades = sharp and any(any(each) for each in at.phi)
    last = horizon if horizon is not None else (STRETCH if fades else at.period) + window - 2
    moments = at.moments(last + 1) if fades else [None] * (last + 1)
    S = {k: at.information(k, Pi, sharp) for k, Pi in enumerate(moments)}
    found = [at.gramian(k, S, window) for k in range(last - window + 2)]
    if fades and horizon is None and at.n == at.period == 1:
        kept = 1 - at.A[0][0][0] ** 2 - at.mu[0] * at.F[0][0][0] ** 2
        limit = at.information(0, [[at.Q[0][0][0] / kept]] if kept > 0 else None, sharp)
        found.append(at.gramian(0, dict.fromkeys(range(window), limit), window))
    return found


def exceeds(data: dict[str, Any], alpha: Fraction, window: int, form: str, horizon: int | None) -> bool:
    """Whether the Gramian of every window exceeds alpha I."""
    least = [[-alpha * (i == j) for j in range(data["n"])] for i in range(data["n"])]
    return all(positive(plus(G, least)) for G in gramians(data, window, form, horizon))


def is_true(data: dict[str, Any], claim: dict[str, Any]) -> bool:
    """Whether the claim holds (proved), or whether some window is singular (refuted)."""
    keys = (claim["window"], claim["form"], claim["horizon"])
    if claim["verdict"] == "refuted":
        return any(determinant(G) == 0 for G in gramians(data, *keys))
    alpha = Fraction(float.fromhex(claim["alpha"]))
    return alpha > 0 and exceeds(data, alpha, *keys)
