"""Is what a claim says true? Decided without its proof where that can be: in doubles, and exactly near a boundary.

Independent of the checker and of the prover: dense matrices, eigenvalues, every set of links written out.
"""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations
from typing import Any

import numpy as np
from mpmath import mp, mpf
from numpy import ndarray
from scipy.linalg import solve_discrete_lyapunov
from tests.reference.certificates import (
    Document,
    Numbers,
    said_performance,
    said_stable,
    said_switching,
    said_unstable,
)


def is_true(data: Document, claim: Document) -> bool:
    """Whether the claim's statement is the right one and holds, margin included; undecided claims are not asked."""
    at = Numbers(data, Fraction)
    name, refuted = claim["claim"], claim["verdict"] == "refuted"
    if not mixes(at.W):
        return False
    if refuted:
        of = claim["witness"]["of"]
        which = {"network": "network", "centre": "least favourable"}[of]
        block = at.network if of == "network" else at.Fe
        return claim["statement"] == said_unstable(which) and radius_is_below(block, Fraction(1)) == 1
    if name in ("schur-stability", "decay-rate"):
        rate = float.fromhex(claim["rate"]) if name == "decay-rate" else 1.0
        left, j = 1 - Fraction(float(claim["margin"])), claim["proof"].get("power", 1)
        steps = np.linalg.matrix_power(at.network, j) if j > 1 else at.network
        holds = radius_is_below(steps, left * Fraction(rate) ** (2 * j)) == -1
        if claim["block"] == "F":
            holds = holds and radius_is_below(at.Fe, left * Fraction(rate) ** 2) == -1
        return holds and claim["statement"] == said_stable(claim["block"], rate if name == "decay-rate" else None)
    if name == "switching":
        return _switches(at, claim)
    return _performs(at, claim)


def mixes(W: ndarray) -> bool:
    """Whether the columns of W sum to one: an ulp a weight, more where they were rounded to single precision."""
    doubles = W.astype(float)
    single = np.array_equal(doubles.astype(np.float32).astype(float), doubles)
    for column in W.T:
        slack = int(np.count_nonzero(column)) * Fraction(1, 2**52) + int(single) * Fraction(1, 2**24)
        if abs(sum(column) - 1) > slack:
            return False
    return True


def radius_is_below(F: ndarray, s: Fraction) -> int:
    """-1, 0 or 1 as the square of the spectral radius of F is below, at (to fifty digits) or above s."""
    radius = max(abs(np.linalg.eigvals(F.astype(float)))) ** 2
    if abs(radius - float(s)) > 1e-6 * (float(s) + radius):
        return -1 if radius < s else 1
    with mp.workdps(80):
        matrix = mp.matrix([[_mpf(x) for x in row] for row in F.tolist()])
        values = mp.eig(matrix, left=False, right=False)  # pyright: ignore[reportAttributeAccessIssue]
        exact = max(abs(value) ** 2 for value in values) - _mpf(s)
        return 0 if abs(exact) < mpf(10) ** -50 else 1 if exact > 0 else -1


def _mpf(x: Fraction | int) -> Any:
    x = Fraction(x)
    return mpf(x.numerator) / mpf(x.denominator)


def is_definite(S: ndarray) -> bool:
    """Whether the symmetric matrix of fractions is positive definite: by exact elimination where it is close."""
    assert (S == S.T).all()
    eigenvalues = np.linalg.eigvalsh(S.astype(float))
    if abs(eigenvalues[0]) > 1e-9 * abs(eigenvalues).max():
        return bool(eigenvalues[0] > 0)
    S = S.copy()
    for j in range(len(S)):
        if S[j, j] <= 0:
            return False
        S[j + 1 :, j + 1 :] = S[j + 1 :, j + 1 :] - np.outer(S[j + 1 :, j], S[j, j + 1 :]) / S[j, j]
    return True


def symmetric(words: str, n: int) -> ndarray:
    """A symmetric matrix of fractions from the text of its upper triangle."""
    entries = iter([Fraction(float.fromhex(word)) for word in words.split()])
    S = np.full((n, n), Fraction(0), dtype=object)
    for i in range(n):
        for j in range(i, n):
            S[i, j] = S[j, i] = next(entries)
    return S


def _switches(at: Numbers, claim: Document) -> bool:
    """The common Lyapunov function diag(Y) falls in every scenario; every set of links is written out."""
    Y = np.full((at.N * at.n, at.N * at.n), Fraction(0), dtype=object)
    for l, words in enumerate(claim["proof"]["Y"]):
        Y[l * at.n : (l + 1) * at.n, l * at.n : (l + 1) * at.n] = symmetric(words, at.n)
    s = 1 - Fraction(float(claim["margin"]))
    if "drop" in claim:
        links = [(l, k) for k, heard in enumerate(at.neighbours) for l in heard if l != k and (at.directed or l < k)]
        sizes = range(min(claim["drop"], len(links)) + 1)
        blocks = [without(at, gone) for size in sizes for gone in combinations(links, size)]
    else:
        blocks = [at.network]
        for scenario in claim["scenarios"]:
            if "drop" in scenario:
                blocks.append(without(at, scenario["drop"]))
            else:
                W = at.weights(scenario["weights"], at.read) if "weights" in scenario else at.W
                if not mixes(W):
                    return False
                M = at.loops(at.gains(scenario["gains"], at.read)) if "gains" in scenario else at.M
                blocks.append(at.block(W, M))
    return (
        claim["statement"] == said_switching(claim)
        and is_definite(Y)
        and all(is_definite(s * Y - B.T @ Y @ B) for B in blocks)
    )


def without(at: Numbers, links: Any) -> ndarray:
    """The network block without these links."""
    W, G = at.W.copy(), [dict(g) for g in at.G]
    for l, k in links:
        for j, hearer in [(l, k)] if at.directed else [(l, k), (k, l)]:
            W[hearer, hearer] += W[j, hearer]
            W[j, hearer] = Fraction(0)
            del G[hearer][j]
    return at.block(W, at.loops(G))


def mean_square_deviations(at: Numbers) -> list[Fraction]:
    """The traces of the diagonal blocks of Q = F Q F' + G G', refined with exact residuals far beyond a double."""
    F, noise, _ = at.whole()
    rounded = F.astype(float)
    Q = np.full(F.shape, Fraction(0), dtype=object)
    for _ in range(4):
        residual = F @ Q @ F.T + noise - Q
        step = solve_discrete_lyapunov(rounded, residual.astype(float))
        Q = Q + np.array([Fraction(float(x)) for x in np.ravel(step)], dtype=object).reshape(Q.shape)
    n = at.n
    return [sum((Q[i, i] for i in range(k * n, (k + 1) * n)), Fraction(0)) for k in range(at.N + 1)]


def _performs(at: Numbers, claim: Document) -> bool:
    if any(radius_is_below(block, Fraction(1)) != -1 for block in (at.network, at.Fe)):
        return False
    traces = mean_square_deviations(at)
    intervals = [*claim["nodes"], claim["centre"], claim["network"]]
    values = [*traces, sum(traces[:-1], Fraction(0)) / at.N]
    low, high = map(float.fromhex, claim["network"].split())
    return claim["statement"] == said_performance(low, high) and all(
        Fraction(float.fromhex(low)) <= value <= Fraction(float.fromhex(high))
        for (low, high), value in zip((text.split() for text in intervals), values, strict=True)
    )
