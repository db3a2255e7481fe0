"""Check a certificate (docs/certificate.md) and trust nothing else: one file, the Python standard library alone.

    python check.py certificate.json

Every number of a proof is a double, m 2^e, and every condition is a sum of products of such numbers that must be
positive or positive definite: whole numbers decide it. Floating point occurs once, as a guess that is then verified
(`_guess`). Nothing is shared with the program that wrote the certificate, nothing that is read is ever executed, and
whatever is not shown is `invalid`: a checker may decline what is true, it must never accept what is not.

Read in this order: exact matrices, definiteness, the conditions (a function each), the claims, reading, the command.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import re
import sys
from collections import ChainMap
from collections.abc import Callable, Iterable, Iterator, MutableMapping
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import combinations, pairwise
from operator import mul
from typing import Any, NoReturn, TypeVar

SCHEMA = "tolnet.certificate/1"
LARGEST_FILE = 2**30  # bytes
LONGEST_NUMBER = 40  # characters of a number in JSON; a double needs 24
WIDEST_RANGE = 1024  # bits that the numbers of one text may span
LARGEST_MATRIX = 800  # rows of a matrix that speaks of all nodes at once
MOST_WORK = 10**9  # multiplications that a claim may cost, roughly
LAST_ZEROS = re.compile(r"\.?0+p")  # of the fraction of a hexadecimal number: they may be left out
SMALL = 12  # rows up to which elimination decides definiteness


class Refused(Exception):
    """The file is no certificate, or too large to be checked."""


class Declined(Exception):
    """The claim may well be true, but is not checked here."""


class Wrong(Exception):
    """A condition does not hold, or what should hold it is malformed."""


# -------------------- Exact matrices --------------------------------------------------------------------------


@dataclass(slots=True)
class Matrix:
    """The matrix rows * 2**exponent, with whole numbers in its rows."""

    rows: list[list[int]]
    exponent: int

    @staticmethod
    def zero(height: int, width: int) -> Matrix:
        return Matrix([[0] * width for _ in range(height)], 0)

    @staticmethod
    def unit(n: int) -> Matrix:
        return Matrix([[int(i == j) for j in range(n)] for i in range(n)], 0)

    @property
    def T(self) -> Matrix:
        return Matrix([list(column) for column in zip(*self.rows, strict=True)], self.exponent)

    def plus(self, other: Matrix, sign: int) -> Matrix:
        exponent = min(self.exponent, other.exponent)
        p, q = 1 << (self.exponent - exponent), sign << (other.exponent - exponent)
        rows = [
            [p * x + q * y for x, y in zip(a, b, strict=True)] for a, b in zip(self.rows, other.rows, strict=True)
        ]
        return Matrix(rows, exponent)

    def __add__(self, other: Matrix) -> Matrix:
        return self.plus(other, 1)

    def __sub__(self, other: Matrix) -> Matrix:
        return self.plus(other, -1)

    def __rmul__(self, scalar: Fraction | int) -> Matrix:
        """A dyadic number times the matrix."""
        c = scalar.numerator
        return Matrix([[c * x for x in row] for row in self.rows], self.exponent - _log2(scalar.denominator))

    def by(self, other: Matrix) -> Matrix:
        """P Q', which skips the zeros of Q."""
        sparse = [[(j, y) for j, y in enumerate(row) if y] for row in other.rows]
        rows = [[sum([row[j] * y for j, y in other_row]) for other_row in sparse] for row in self.rows]
        return Matrix(rows, self.exponent + other.exponent)

    def __matmul__(self, other: Matrix) -> Matrix:
        return self.by(other.T)

    def value(self, i: int, j: int) -> Fraction:
        return _scaled(self.rows[i][j], self.exponent)

    def trace(self) -> Fraction:
        return _scaled(sum(row[i] for i, row in enumerate(self.rows)), self.exponent)

    def part(self, start: int, stop: int, first: int, last: int) -> Matrix:
        return Matrix([row[first:last] for row in self.rows[start:stop]], self.exponent)


def _log2(power: int) -> int:
    if power & (power - 1):
        raise ArithmeticError("no power of two")
    return power.bit_length() - 1


def _scaled(whole: int, exponent: int) -> Fraction:
    return Fraction(whole << exponent) if exponent >= 0 else Fraction(whole, 1 << -exponent)


def _congruence(P: Matrix, S: Matrix) -> Matrix:
    """P S P' for a symmetric S."""
    return S.by(P).T.by(P)


def _combination(terms: Iterable[tuple[Fraction | int, Matrix]], n: int) -> Matrix:
    """The sum of dyadic numbers times matrices n x n."""
    given = [(c.numerator, P.exponent - _log2(c.denominator), P.rows) for c, P in terms]
    if not given:
        return Matrix.zero(n, n)
    exponent = min(e for _, e, _ in given)
    scale = [c << (e - exponent) for c, e, _ in given]
    by_row = zip(*(rows for _, _, rows in given), strict=True)
    rows = [[sum(map(mul, scale, entries)) for entries in zip(*same, strict=True)] for same in by_row]
    return Matrix(rows, exponent)


def _beside(parts: list[Matrix]) -> Matrix:
    """[P, Q, ...], matrices of the same height in a row."""
    exponent = min(part.exponent for part in parts)
    heights = range(len(parts[0].rows))
    return Matrix([[x << (p.exponent - exponent) for p in parts for x in p.rows[i]] for i in heights], exponent)


def _assemble(blocks: dict[tuple[int, int], Matrix], count: int, n: int) -> Matrix:
    """The matrix of count x count blocks n x n; what is not given is zero."""
    exponent = min((block.exponent for block in blocks.values()), default=0)
    whole = Matrix([[0] * (count * n) for _ in range(count * n)], exponent)
    for (k, l), block in blocks.items():
        for i, row in enumerate(block.rows):
            whole.rows[k * n + i][l * n : (l + 1) * n] = [x << (block.exponent - exponent) for x in row]
    return whole


# -------------------- Definiteness ----------------------------------------------------------------------------


def is_positive_definite(S: Matrix) -> bool:
    """Whether the symmetric S was shown to be positive definite; for more than SMALL rows, False may mean not shown.

    Small: every leading principal minor is positive. Large: G S G' is strictly diagonally dominant with a positive
    diagonal for some G (which is then non-singular, or x' G S G' x = 0 for some x != 0). The guess is the inverse of
    a floating-point Cholesky factor, rounded to whole numbers; a nearly singular S takes a few rounds.
    """
    rows = S.rows
    if len(rows) <= SMALL:
        return _minors_are_positive(rows)
    for _ in range(4):
        if any(row[i] <= 0 for i, row in enumerate(rows)):
            return False
        if all(2 * row[i] > sum(map(abs, row)) for i, row in enumerate(rows)):
            return True
        G = _guess(rows)
        if G is None:
            return False
        rows = _congruence(Matrix(G, 0), Matrix(rows, 0)).rows
    bits = max(x.bit_length() for row in S.rows for x in row)
    return len(S.rows) ** 4 * bits <= 20 * MOST_WORK and _minors_are_positive(S.rows)


def _minors_are_positive(rows: list[list[int]], semidefinite: bool = False) -> bool:
    """Fraction-free elimination (Bareiss): the pivots are the leading principal minors; every division is exact.

    A row and column of zeros keep a matrix from being definite, and may be left out to see that it is semidefinite.
    """
    rows, previous = [list(row) for row in rows], 1
    for j, pivot_row in enumerate(rows):
        pivot = pivot_row[j]
        if semidefinite and not any(pivot_row[j:]):
            continue
        if pivot <= 0:
            return False
        for i in range(j + 1, len(rows)):
            factor, row = pivot_row[i], rows[i]
            for k in range(i, len(rows)):
                row[k] = (row[k] * pivot - factor * pivot_row[k]) // previous
        previous = pivot
    return True


def _guess(rows: list[list[int]]) -> list[list[int]] | None:
    """G with G S G' near a multiple of I, for S with a positive diagonal; None where S is clearly not definite.

    S is scaled by powers of two to a diagonal in [1/2, 2); its Cholesky factor C is inverted as it is made. A pivot
    lost to rounding is replaced by a small one, so that the next round starts from a better conditioned matrix.
    """
    size = len(rows)
    half = [row[i].bit_length() // 2 for i, row in enumerate(rows)]
    factor: list[list[float]] = []
    inverse: list[list[float]] = [[] for _ in range(size)]  # its columns, from the diagonal down
    for i, row in enumerate(rows):
        if any(abs(row[j]) >> (half[i] + half[j] + 1) for j in range(i)):
            return None  # an entry beyond the geometric mean of its diagonal entries
        c: list[float] = []
        for j in range(i):
            c.append((row[j] / (1 << (half[i] + half[j])) - sum(map(mul, c, factor[j]))) / factor[j][j])
        pivot = row[i] / (1 << (2 * half[i])) - sum(map(mul, c, c))
        if not pivot > -(2.0**-30):
            return None
        root = math.sqrt(max(pivot, 2.0**-48))
        for j in range(i):
            inverse[j].append(-sum(map(mul, c[j:], inverse[j])) / root)
        inverse[i].append(1.0 / root)
        factor.append([*c, root])
    top = max(half)
    G = [[0] * size for _ in range(size)]
    for j, column in enumerate(inverse):
        for i, x in enumerate(column, start=j):
            if not abs(x) < 2.0**900:
                return None
            G[i][j] = round(math.ldexp(x, 54)) << (top - half[j])
    return G


def _require_definite(S: Matrix, what: str) -> None:
    if not is_positive_definite(S):
        raise Wrong(f"{what} is not shown to be positive definite")


def _require(condition: bool, complaint: str) -> None:
    if not condition:
        raise Wrong(complaint)


def _afford(work: int, most: int, what: str) -> None:
    if work > most:
        raise Declined(f"{what}: too large to be checked here")


# -------------------- The deployment, and what is derived from it ---------------------------------------------

Watch = Callable[[str, int], Iterator[int]]  # range(count), with a label to show meanwhile


def unwatched(label: str, count: int) -> Iterator[int]:
    """No progress to see."""
    return iter(range(count))


@dataclass(frozen=True)
class Network:
    """What a condition on the network speaks of: w[k][l] = w_lk where it is not zero, sigma_k, M_k; who hears l."""

    n: int
    weights: MutableMapping[int, dict[int, Fraction]]
    sigma: dict[int, Fraction]
    loops: MutableMapping[int, Matrix]
    hearers: list[list[int]]
    watch: Watch

    def __len__(self) -> int:
        return len(self.hearers)

    @cached_property
    def whole(self) -> Matrix:
        """The network block, whose block (k, l) is w_lk M_l."""
        _afford(len(self) * self.n, LARGEST_MATRIX, "the network in one matrix")
        blocks = {(k, l): w * self.loops[l] for k, row in self.weights.items() for l, w in row.items()}
        return _assemble(blocks, len(self), self.n)


@dataclass(frozen=True)
class Deployment:
    """The numbers of `data`. The matrices C_l are kept transposed, n x p_l."""

    n: int
    A: Matrix
    Q: Matrix
    C: list[Matrix]
    R: list[Matrix]
    directed: bool
    neighbours: list[list[int]]
    weights: list[dict[int, Fraction]]
    gains: list[Matrix]
    centre_gains: list[Matrix] | None
    tilt: Matrix  # a factor of T
    watch: Watch

    def gain(self, k: int, l: int) -> Matrix:
        """G_{k,l}: the columns of G_k for sensor l."""
        first = sum(len(self.C[j].rows[0]) for j in self.neighbours[k] if j < l)
        return self.gains[k].part(0, self.n, first, first + len(self.C[l].rows[0]))

    def loop(self, k: int, gain: Matrix) -> Matrix:
        """M_k = A - G_k C_k^loc."""
        return self.A - gain.by(_beside([self.C[l] for l in self.neighbours[k]]))

    @cached_property
    def network(self) -> Network:
        loops = {k: self.loop(k, self.gains[k]) for k in self.watch("closed loops", len(self.C))}
        hearers: list[list[int]] = [[] for _ in self.C]
        for k, heard in enumerate(self.neighbours):
            for l in heard:
                hearers[l].append(k)
        weights = dict(enumerate(self.weights))
        return Network(self.n, weights, _sigma(weights), loops, hearers, self.watch)

    @property
    def centre(self) -> list[Matrix]:
        """The centre's gains G_l."""
        if self.centre_gains is None:
            raise Wrong("the claim needs data.centre")
        return self.centre_gains

    @cached_property
    def centre_noise(self) -> Matrix:
        """N = Q + G R G'."""
        return sum((G.by(R).by(G) for G, R in zip(self.centre, self.R, strict=True)), self.Q)

    @cached_property
    def tilted_loop(self) -> Matrix:
        """T F_0."""
        return self.tilt.by(self.tilt) @ self.centre_loop

    @cached_property
    def centre_loop(self) -> Matrix:
        """F_0 = A - G C."""
        return self.A - _beside(self.centre).by(_beside(self.C))

    @cached_property
    def centre_block(self) -> Matrix:
        """F_e = F_0 + N T F_0."""
        return self.centre_loop + self.centre_noise @ self.tilted_loop

    def cross_noise(self, k: int) -> Matrix:
        """E_k = Q + sum_l G_{k,l} R_l G_{.,l}', for l heard by k."""
        terms = (self.gain(k, l).by(self.R[l]).by(self.centre[l]) for l in self.neighbours[k])
        return sum(terms, self.Q)


@dataclass(frozen=True)
class Channels:
    """The numbers of `data` of a network with corrupted channels, each over a period of its own."""

    n: int
    A: list[Matrix]
    F: list[Matrix]
    Q: list[Matrix]
    mu: list[Fraction]
    C: list[list[Matrix]]  # p x n
    R: list[list[Matrix]]
    tau: list[list[Fraction]]
    phi: list[list[Fraction]]
    start: Matrix

    @property
    def period(self) -> int:
        """After how many instants everything repeats."""
        return math.lcm(*(len(x) for x in (self.A, self.F, self.Q, self.mu, self.C, self.R, self.tau, self.phi)))

    def step(self, k: int, X: Matrix) -> Matrix:
        """A X A' + mu F X F' + Q at instant k."""
        noise = _at(self.mu, k) * _congruence(_at(self.F, k), X) + _at(self.Q, k)
        return _congruence(_at(self.A, k), X) + noise

    def information(self, k: int, gains: list[Matrix], X: Matrix | None, sharp: bool) -> Matrix:
        """sum_i tau^2 (C'K + K'C - K' Rt K), Rt = R + phi C X C', over the sensors whose K is not zero."""
        terms: list[tuple[Fraction | int, Matrix]] = []
        for i, K in enumerate(gains):
            if not any(map(any, K.rows)):
                continue
            tau, phi = (_at(self.tau, k)[i], _at(self.phi, k)[i]) if sharp else (1, 0)
            seen = _at(self.C, k)[i].T @ K
            terms += [(tau**2, seen + seen.T), (-(tau**2), _congruence(K.T, _at(self.R, k)[i]))]
            if phi:
                if X is None:
                    raise Wrong(f"proof.gains: sensor {i} fades, and there are no moments")
                terms.append((-phi * tau**2, _congruence(seen.T, X)))
        return _combination(terms, self.n)


Item = TypeVar("Item")


def _at(period: list[Item], k: int) -> Item:
    return period[k % len(period)]


def _sigma(weights: dict[int, dict[int, Fraction]]) -> dict[int, Fraction]:
    return {k: sum(map(abs, row.values()), Fraction(0)) for k, row in weights.items()}


# -------------------- Stability, a function a method; s stands for (1 - delta) r^2 ----------------------------


def primal(network: Network, X: list[Matrix], s: Fraction) -> None:
    """s X_k - sigma_k sum_l |w_lk| M_l X_l M_l' > 0."""
    moved = [_congruence(network.loops[l], X[l]) for l in network.watch("M X M'", len(network))]
    for k in network.watch("primal conditions", len(network)):
        total = _combination(((abs(w), moved[l]) for l, w in network.weights[k].items()), network.n)
        _require_definite(s * X[k] - network.sigma[k] * total, f"the primal condition of node {k}")


def dual(network: Network, Y: list[Matrix], s: Fraction, nodes: Iterable[int], suffix: str = "") -> None:
    """s Y_l - M_l' (sum_k sigma_k |w_lk| Y_k) M_l > 0 for these l."""
    for l in nodes:
        heard = ((k, network.weights[k].get(l)) for k in network.hearers[l])
        S = _combination(((network.sigma[k] * abs(w), Y[k]) for k, w in heard if w), network.n)
        _require_definite(s * Y[l] - _congruence(network.loops[l].T, S), f"the dual condition of node {l}{suffix}")


def definite(network: Network, name: str, matrices: list[Matrix]) -> None:
    """X_k > 0 for every k."""
    for k in network.watch(f"{name} > 0", len(network)):
        _require_definite(matrices[k], f"{name}[{k}]")


def power(network: Network, j: int, X: list[Matrix], shares: Any, rate: Fraction, margin: Fraction) -> None:
    """(1 - delta) r^2j X_k - sum_l (A^j)_kl X_l (A^j)_kl' / p_kl > 0, sum_l p_kl <= 1, for A the network block."""
    s = (1 - margin) * rate ** (2 * j)
    work = 0
    for k in network.watch(f"paths of {j} links", len(network)):
        blocks = {k: Matrix.unit(network.n)}  # (A^i)_kl by l; that of i + 1 is (sum_m w_lm (A^i)_km) M_l
        for _ in range(j):
            reached: dict[int, list[tuple[Fraction, Matrix]]] = {}
            for m, block in blocks.items():
                for l, w in network.weights[m].items():
                    reached.setdefault(l, []).append((w, block))
                work += len(network.weights[m]) * network.n**2
            work += len(reached) * network.n**3
            _afford(work, MOST_WORK, f"paths of {j} links")
            blocks = {l: _combination(terms, network.n) @ network.loops[l] for l, terms in reached.items()}
        p = _doubles(shares[k], len(blocks), f"proof.shares[{k}]")
        _require(all(share > 0 for share in p), f"a share of node {k} is not positive")
        _require(sum(map(Fraction, p)) <= 1, f"the shares of node {k} exceed one")
        moved = (
            (_above_inverse(share), _congruence(blocks[l], X[l])) for l, share in zip(sorted(blocks), p, strict=True)
        )
        total = _combination(moved, network.n)
        _require_definite(s * X[k] - total, f"the condition of node {k} on paths of {j} links")


def _above_inverse(share: float) -> Fraction:
    """A dyadic number that is at least 1/p, and above it by less than one part in 2^100."""
    return Fraction(math.ceil(2**100 / Fraction(share)), 2**100)


def full(block: Matrix, X: Matrix, s: Fraction, what: str) -> None:
    """X > 0 and s X - F X F' > 0."""
    _require_definite(X, what)
    _require_definite(s * X - _congruence(block, X), f"the condition of {what}")


def stable(claim: dict[str, Any], at: Deployment) -> None:
    """`schur-stability` and `decay-rate`, proved."""
    rate = Fraction(_rate(claim)) if "rate" in claim else Fraction(1)
    margin = _margin(claim)
    s, n, network = (1 - margin) * rate**2, at.n, at.network
    keys = {"primal": ("X",), "dual": ("Y",), "power": ("X", "power", "shares"), "full": ("X",)}
    method = claim["proof"].get("method") if isinstance(claim["proof"], dict) else None
    if not isinstance(method, str) or method not in keys:
        raise Wrong("proof.method: expected primal, dual, power or full")
    of_centre = ("centre",) if claim["block"] == "F" else ()
    proof = _object(claim["proof"], "proof", "method", *keys[method], *of_centre)
    if method == "full":
        whole = network.whole
        full(whole, _symmetric(proof["X"], len(whole.rows), "proof.X"), s, "proof.X")
    else:
        name = keys[method][0]
        matrices = _symmetric_list(proof[name], len(network), n, f"proof.{name}")
        definite(network, name, matrices)
        if method == "primal":
            primal(network, matrices, s)
        elif method == "dual":
            dual(network, matrices, s, network.watch("dual conditions", len(network)))
        else:
            shares = _list(proof["shares"], len(network), "proof.shares")
            power(network, _whole(proof["power"], 2, 64, "proof.power"), matrices, shares, rate, margin)
    if claim["block"] == "F":
        full(at.centre_block, _symmetric(proof["centre"], n, "proof.centre"), s, "proof.centre")


def unstable(claim: dict[str, Any], at: Deployment) -> None:
    """`schur-stability`, refuted: some eigenvalue lies outside the unit circle."""
    of, method = claim["witness"]["of"], claim["witness"].get("method")
    block = at.network.whole if of == "network" else at.centre_block
    if method == "lyapunov":
        witness = _object(claim["witness"], "witness", "of", "method", "X", "v")
        X = _symmetric(witness["X"], len(block.rows), "witness.X")
        v = _matrix(witness["v"], 1, len(block.rows), "witness.v")
        _require(v.by(X).by(v).value(0, 0) > 0, "v' X v is not positive")
        _require_definite(_congruence(block.T, X) - X, "the Lyapunov difference of the witness")
    elif method == "eigenpair":
        keys = ("eigenvalue", "vector", "pivot", "radius")
        eigenpair(_object(claim["witness"], "witness", "of", "method", *keys, optional=("inverse",)), block)
    else:
        raise Wrong("witness.method: expected lyapunov or eigenpair")


def eigenpair(witness: dict[str, Any], block: Matrix) -> None:
    """|B f| + |I - B J| rho + |B| rho^2 < rho and |lambda| - rho > 1, for f = [block z - lambda z; 0]."""
    d = len(block.rows)
    a, b = map(Fraction, _doubles(witness["eigenvalue"], 2, "witness.eigenvalue"))
    pair = _matrix(witness["vector"], 2, d, "witness.vector")
    x, y = pair.part(0, 1, 0, d), pair.part(1, 2, 0, d)
    pivot = _whole(witness["pivot"], 0, d - 1, "witness.pivot")
    rho = Fraction(_doubles(witness["radius"], 1, "witness.radius")[0])
    _require(rho > 0, "witness.radius is not positive")

    corner = Matrix.zero(1, 1)
    selection = Matrix([[int(j == pivot)] for j in range(d)], 0)
    f, g = _beside([x.by(block) - a * x + b * y, corner]), _beside([y.by(block) - a * y - b * x, corner])
    Jx = _bordered(block - a * Matrix.unit(d), x, selection)  # the Jacobian is Jx + i Jy
    Jy = _bordered(-b * Matrix.unit(d), y, Matrix.zero(d, 1))
    if "inverse" in witness:
        both = _matrix(witness["inverse"], 2 * (d + 1), d + 1, "witness.inverse")
    else:
        both = _guess_inverse(Jx, Jy)
    B, D = both.part(0, d + 1, 0, d + 1), both.part(d + 1, 2 * (d + 1), 0, d + 1)  # the inverse is B + iD
    residual = _norm((f.by(B) - g.by(D)).T, (g.by(B) + f.by(D)).T)
    defect = _norm(Matrix.unit(d + 1) - (B @ Jx - D @ Jy), B @ Jy + D @ Jx)
    _require(residual + defect * rho + _norm(B, D) * rho**2 < rho, "the Newton step leaves the ball of the witness")
    _require(a**2 + b**2 > (1 + rho) ** 2, "the ball of the witness reaches the unit disc")


def _bordered(P: Matrix, z: Matrix, selection: Matrix) -> Matrix:
    """[[P, -z], [selection', 0]]."""
    return _beside([_beside([P.T, selection]).T, _beside([-1 * z, Matrix.zero(1, 1)]).T])


def _guess_inverse(re: Matrix, im: Matrix) -> Matrix:
    """[B; D] with B + iD near the inverse of re + i im: Gauss-Jordan elimination in floating point."""
    size = len(re.rows)
    try:
        parts = [[[float(_scaled(x, P.exponent)) for x in row] for row in P.rows] for P in (re, im)]
        rows = [list(map(complex, a, b)) + [0j] * size for a, b in zip(*parts, strict=True)]
        for j in range(size):
            rows[j][size + j] = 1 + 0j
        for j in range(size):
            best = max(range(j, size), key=lambda i: abs(rows[i][j]))
            rows[j], rows[best] = rows[best], rows[j]
            pivot = rows[j] = [x / rows[j][j] for x in rows[j]]
            for i in range(size):
                if i != j and rows[i][j]:
                    factor = rows[i][j]
                    rows[i] = [x - factor * y for x, y in zip(rows[i], pivot, strict=True)]
        inverse = [row[size:] for row in rows]
        scale = 80 - math.frexp(max(abs(x) for row in inverse for x in row))[1]
        real = [[round(math.ldexp(x.real, scale)) for x in row] for row in inverse]
        return Matrix(real + [[round(math.ldexp(x.imag, scale)) for x in row] for row in inverse], -scale)
    except (ArithmeticError, ValueError):
        raise Declined("the eigenpair: its Jacobian could not be inverted here") from None


def _norm(re: Matrix, im: Matrix) -> Fraction:
    """A bound of the largest row sum of moduli."""
    rows = zip(re.rows, im.rows, strict=True)
    return max(_scaled(sum(map(abs, r)), re.exponent) + _scaled(sum(map(abs, i)), im.exponent) for r, i in rows)


# -------------------- Switching -------------------------------------------------------------------------------


def switching(claim: dict[str, Any], at: Deployment) -> None:
    """One dual Y for the nominal network and for every scenario."""
    network, s = at.network, 1 - _margin(claim)
    proof = _object(claim["proof"], "proof", "Y")
    Y = _symmetric_list(proof["Y"], len(network), at.n, "proof.Y")
    definite(network, "Y", Y)
    if "drop" in claim:
        for l in network.watch("links that drop", len(network)):
            _drop_links_of(l, _whole(claim["drop"], 1, 10**6, "drop"), at, Y, s)
        return
    dual(network, Y, s, network.watch("dual conditions", len(network)))
    for i, scenario in enumerate(_list(claim["scenarios"], None, "scenarios")):
        where = f"scenarios[{i}]"
        if isinstance(scenario, dict) and "drop" in scenario:
            variant, touched = _without(at, _list(_object(scenario, where, "drop")["drop"], None, where), where)
            dual(variant, Y, s, touched, f" in {where}")
        elif _object(scenario, where, optional=("weights", "gains")):
            variant = _changed(at, scenario, where)
            dual(variant, Y, s, network.watch(where, len(network)), f" in {where}")


def _drop_links_of(l: int, most: int, at: Deployment, Y: list[Matrix], s: Fraction) -> None:
    """The dual condition of l for every set of at most so many links at l (into l, in a directed network)."""
    network, own = at.network, at.network.weights[l]
    others = [j for j in at.neighbours[l] if j != l]
    sets = 0
    for size in range(min(most, len(others)) + 1):
        sets += math.comb(len(others), size)
        _afford(sets * len(network) * at.n**3, 10 * MOST_WORK, f"every set of links at node {l}")
    _require(min(own.values(), default=0) >= 0, f"a link drops at node {l}, which has a negative weight")
    terms = {k: (network.sigma[k] * abs(network.weights[k].get(l, 0)), Y[k]) for k in network.hearers[l]}
    lost = {j: at.gain(l, j).by(at.C[j]) for j in others}
    for size in range(min(most, len(others)) + 1):
        for gone in combinations(others, size):
            kept = [term for k, term in terms.items() if k != l and (at.directed or k not in gone)]
            alone = own.get(l, Fraction(0)) + sum(own.get(j, Fraction(0)) for j in gone)
            S = _combination([*kept, (network.sigma[l] * alone, Y[l])], at.n)
            M = sum((lost[j] for j in gone), network.loops[l])
            _require_definite(
                s * Y[l] - _congruence(M.T, S), f"the dual condition of node {l} without links to {gone}"
            )


def _without(at: Deployment, links: list[Any], where: str) -> tuple[Network, list[int]]:
    """The network without these links, and the nodes whose dual condition that changes."""
    network = at.network
    weights, loops, dropped = dict[int, dict[int, Fraction]](), dict[int, Matrix](), set[tuple[int, int]]()
    for i, link in enumerate(links):
        l, k = (
            _whole(end, 0, len(network) - 1, f"{where}.drop[{i}]") for end in _list(link, 2, f"{where}.drop[{i}]")
        )
        for j, hearer in [(l, k)] if at.directed else [(l, k), (k, l)]:
            _require(j != hearer and j in at.neighbours[hearer], f"{where}.drop[{i}]: no such link")
            _require((j, hearer) not in dropped, f"{where}.drop[{i}] drops a link twice")
            dropped.add((j, hearer))
            row = weights.setdefault(hearer, dict(network.weights[hearer]))
            _require(min(row.values(), default=0) >= 0, f"a link drops at node {hearer}, which has a negative weight")
            row[hearer] = row.get(hearer, Fraction(0)) + row.pop(j, Fraction(0))  # so that sigma stays
            loops[hearer] = loops.get(hearer, network.loops[hearer]) + at.gain(hearer, j).by(at.C[j])
    variant = replace(network, weights=ChainMap(weights, network.weights), loops=ChainMap(loops, network.loops))
    return variant, sorted({end for pair in dropped for end in pair})


def _changed(at: Deployment, scenario: dict[str, Any], where: str) -> Network:
    """The network with other weights, other gains, or both."""
    network = at.network
    if "weights" in scenario:
        weights = dict(enumerate(_weights(scenario["weights"], at.neighbours, f"{where}.weights")))
        network = replace(network, weights=weights, sigma=_sigma(weights))
    if "gains" in scenario:
        gains = _gains(scenario["gains"], at.n, at.neighbours, at.C, f"{where}.gains")
        network = replace(network, loops={k: at.loop(k, gain) for k, gain in enumerate(gains)})
    return network


# -------------------- Performance -----------------------------------------------------------------------------


def performance(claim: dict[str, Any], at: Deployment) -> None:
    """Every trace of a diagonal block of the solution of Q = F Q F' + G G' lies in its interval."""
    network, n, last = at.network, at.n, len(at.network)
    proof = _object(claim["proof"], "proof", "method", "Q", "X", "epsilon", "delta", "share")
    _require(proof["method"] == "blocks", "proof.method: expected blocks")
    _afford((last + 1) * n, LARGEST_MATRIX, "the network in one matrix")
    epsilon, delta, share = (
        Fraction(_doubles(proof[name], 1, f"proof.{name}")[0]) for name in ("epsilon", "delta", "share")
    )
    _require(epsilon > 0 and 0 < delta < 1 and 0 < share < 1, "proof: epsilon, delta or share out of range")
    for l in range(last):
        _require_definite(at.R[l], f"R[{l}]")
    Q = _symmetric(proof["Q"], (last + 1) * n, "proof.Q")
    X = _symmetric_list(proof["X"], last + 1, n, "proof.X")

    cross = [at.cross_noise(k) for k in range(last)]  # E_k
    coupling = [E @ at.tilted_loop for E in cross]  # E_k T F_0
    Z = _step(at, Q, cross, coupling) - Q
    bound = _diagonal_bound(Z, Q)
    for k in range(last + 1):
        block = Matrix(
            [[bound.rows[0][k * n + i] if i == j else 0 for j in range(n)] for i in range(n)], bound.exponent
        )
        _require_definite(X[k], f"X[{k}]")
        _require_definite(epsilon * X[k] - block, f"the bound of the residual at block {k}")

    moved = [_congruence(network.loops[l], X[l]) for l in range(last)]
    for k, row in network.weights.items():
        # The condition of the node, times pi (1 - pi).
        own = network.sigma[k] * _combination(((abs(w), moved[l]) for l, w in row.items()), n)
        coupled = _congruence(_combination(((w, coupling[l]) for l, w in row.items()), n), X[last])
        gap = share * (1 - share) * (1 - delta) * X[k] - share * own - (1 - share) * coupled
        _require_definite(gap, f"the contraction of node {k}")
    full(at.centre_block, X[last], 1 - delta, "the centre's X")

    traces = [Q.part(k * n, (k + 1) * n, k * n, (k + 1) * n).trace() for k in range(last + 1)]
    errors = [epsilon / delta * X[k].trace() for k in range(last + 1)]
    intervals = _list(claim["nodes"], last, "nodes")
    for k in range(last):
        _contains(intervals[k], traces[k], errors[k], f"nodes[{k}]")
    _contains(claim["centre"], traces[last], errors[last], "centre")
    _contains(
        claim["network"], sum(traces[:last], Fraction(0)) / last, sum(errors[:last], Fraction(0)) / last, "network"
    )


def _step(at: Deployment, Q: Matrix, cross: list[Matrix], coupling: list[Matrix]) -> Matrix:
    """F Q F' + G G', as mixing (by W) of what the filters do before they mix."""
    network, n, last = at.network, at.n, len(at.network)
    tilted = [E @ at.tilt for E in [*cross, at.centre_noise]]  # E_k Y, T = Y Y'
    gains = [{l: at.gain(k, l) for l in heard} for k, heard in enumerate(at.neighbours)]
    gains.append(dict(enumerate(at.centre)))
    noise = {}
    for k in range(last + 1):
        for l in range(last + 1):
            shared = (gains[k][j].by(at.R[j]).by(gains[l][j]) for j in gains[k] if j in gains[l])
            noise[k, l] = sum(shared, at.Q + tilted[k].by(tilted[l]))
    loops = {(k, k): network.loops[k] for k in range(last)} | {(k, last): coupling[k] for k in range(last)}
    filters = _assemble(loops | {(last, last): at.centre_block}, last + 1, n)
    weights = {(k, l): w * Matrix.unit(n) for k, row in network.weights.items() for l, w in row.items()}
    mixing = _assemble(weights | {(last, last): Matrix.unit(n)}, last + 1, n)
    return _congruence(mixing, _congruence(filters, Q) + _assemble(noise, last + 1, n))


def _diagonal_bound(Z: Matrix, Q: Matrix) -> Matrix:
    """The row of sum_j |Z_ij| t_j / t_i, t_i a power of two near Q_ii^(-1/2): a diagonal matrix above +-Z."""
    half = [abs(row[i]).bit_length() // 2 for i, row in enumerate(Q.rows)]
    top = max(half)
    sums = [sum(abs(z) << (top + half[i] - half[j]) for j, z in enumerate(row) if z) for i, row in enumerate(Z.rows)]
    return Matrix([sums], Z.exponent - top)


def _contains(interval: Any, middle: Fraction, error: Fraction, where: str) -> None:
    low, high = map(Fraction, _doubles(interval, 2, where))
    _require(low <= middle - error and middle + error <= high, f"{where}: the proof does not reach this interval")


# -------------------- Observability ---------------------------------------------------------------------------


def _windows(claim: dict[str, Any]) -> tuple[int, int | None, bool]:
    """The length of the windows, the last instant that they may reach (None: any), and whether channels fade."""
    L, H = _whole(claim["window"], 1, 10**6, "window"), claim["horizon"]
    _require(H is None or _whole(H, 0, 10**6, "horizon") >= L - 1, "window: longer than the horizon")
    _require(claim["form"] in ("sharp", "classical"), "form: expected sharp or classical")
    return L, H, claim["form"] == "sharp"


def observable(claim: dict[str, Any], at: Channels) -> None:
    """sum_j Phi' S_{k+j} Phi - alpha I > 0 for the windows from every k, S_s below sum_i tau^2 C' Rt^-1 C."""
    L, H, sharp = _windows(claim)
    proof = _object(claim["proof"], "proof", "loop", "moments", "gains")
    n, m = at.n, len(_list(proof["gains"], None, "proof.gains"))
    loop = _whole(proof["loop"], 0, m, "proof.loop")
    _require(loop % at.period == 0, "proof.loop: expected a multiple of the period of the data")
    _require(loop > 0 or (H is not None and m > H), "proof: the gains end before the claim does")
    _afford(m * L * L * n**3 + m * len(at.tau[0]) * n**3, MOST_WORK, "every window")

    def following(k: int) -> int:
        return k + 1 if k + 1 < m else m - loop

    X = None if proof["moments"] is None else _symmetric_list(proof["moments"], m, n, "proof.moments")
    if X is not None:
        _require_definite(X[0] - at.start, "moments[0] less the initial second moment")
        for k in range(m if loop else m - 1):
            _require_definite(X[following(k)] - at.step(k, X[k]), f"the bound of the second moment after {k}")
    S = []
    for k, texts in enumerate(proof["gains"]):
        outputs, where = _at(at.C, k), f"proof.gains[{k}]"
        K = [
            _matrix(text, len(C.rows), n, where)
            for text, C in zip(_list(texts, len(outputs), where), outputs, strict=True)
        ]
        S.append(at.information(k, K, None if X is None else X[k], sharp))
    G = S
    for _ in range(L - 1):
        G = [S[k] + _congruence(_at(at.A, k).T, G[following(k)]) for k in range(m if loop else len(G) - 1)]
    least = _positive(claim, "alpha") * Matrix.unit(n)
    for k, seen in enumerate(G if H is None else G[: H - L + 2]):
        _require_definite(seen - least, f"the Gramian of the window from {k}, less alpha I,")


def unobservable(claim: dict[str, Any], at: Channels) -> None:
    """C Phi v = 0 for every sensor, at every instant of one window."""
    L, H, _ = _windows(claim)
    witness = _object(claim["witness"], "witness", "start", "vector")
    start = _whole(witness["start"], 0, 10**6 if H is None else H - L + 1, "witness.start")
    v = _matrix(witness["vector"], 1, at.n, "witness.vector")
    _require(any(v.rows[0]), "witness.vector: expected another vector than zero")
    _afford(L * L * (at.n**2 + at.n * sum(len(C.rows) for C in at.C[0])), MOST_WORK, "the window of the witness")
    for k in range(start, start + L):
        for i, C in enumerate(_at(at.C, k)):
            _require(not any(v.by(C).rows[0]), f"sensor {i} sees the vector of the witness at {k}")
        v = v.by(_at(at.A, k))


# -------------------- Claims: their keys, their sentences, what verifies them ---------------------------------


@dataclass(frozen=True)
class Finding:
    """What the checker says of one claim; `result` is valid, invalid, not checked here or undecided."""

    claim: str
    node: int | str | None
    verdict: str
    result: str
    statement: str
    reason: str | None


Verify = Callable[[dict[str, Any], Any], None]  # the last is a Deployment or, for observability, Channels


def _block(claim: dict[str, Any]) -> str:
    blocks = {"F": "the network's error dynamics F", "network": "the network block of the error dynamics"}
    if claim["block"] not in ("F", "network"):
        raise Wrong("block: expected F or network")
    return blocks[claim["block"]]


def _rate(claim: dict[str, Any]) -> float:
    return float(_positive(claim, "rate"))


def _positive(claim: dict[str, Any], key: str) -> Fraction:
    number = Fraction(_doubles(claim[key], 1, key)[0])
    _require(number > 0, f"{key}: expected a positive number")
    return number


def _margin(claim: dict[str, Any]) -> Fraction:
    margin = claim["margin"]
    if type(margin) not in (int, float) or not 0 <= margin < 1:
        raise Wrong("margin: expected a number from 0 to 1, below 1")
    return Fraction(float(margin))


def sentence(claim: dict[str, Any]) -> str:
    """The only statement that the claim may make."""
    name, block = claim["claim"], _block(claim) if "block" in claim else ""
    if name == "observability":
        L, H, sharp = _windows(claim)
        windows = f"window of {L} instant{'s' * (L > 1)}" + ("" if H is None else f" within k = 0..{H}")
        gramian = f"the {'robust' if sharp else 'classical'} Gramian"
        if claim["verdict"] == "refuted":
            return f"Over some {windows} no sensor sees a certain direction at all: {gramian} is singular."
        return f"Over every {windows} {gramian} exceeds {float(_positive(claim, 'alpha'))!r} I."
    if claim["verdict"] == "refuted":
        of = claim["witness"].get("of") if isinstance(claim["witness"], dict) else None
        if of != "network" and (of != "centre" or claim["block"] != "F"):
            raise Wrong("witness.of: expected network, or centre for a claim about F")
        which = "network" if of == "network" else "least favourable"
        return (
            f"Some eigenvalue of the {which} block of the error dynamics lies outside the unit circle: errors grow."
        )
    if name == "schur-stability":
        return f"Every eigenvalue of {block} lies inside the unit circle: errors die out."
    if name == "decay-rate":
        return f"Every eigenvalue of {block} lies inside the circle of radius {_rate(claim)!r}."
    if name == "switching":
        if "drop" in claim:
            how = f"links drop and return, at most {_whole(claim['drop'], 1, 10**6, 'drop')} at once"
        else:
            how = f"the nominal network and {len(_list(claim['scenarios'], None, 'scenarios'))} scenarios alternate"
        return f"The network block of the error dynamics stays stable however {how}."
    low, high = _doubles(claim["network"], 2, "network")
    return (
        "Under the stated least favourable model the mean square deviation of the network lies in "
        f"[{low!r}, {high!r}], and that of every node in its interval."
    )


RULES: dict[tuple[str, str], tuple[tuple[str, ...], Verify | None]] = {  # keys of its own, and what verifies it
    ("schur-stability", "proved"): (("block",), stable),
    ("schur-stability", "refuted"): (("block",), unstable),
    ("decay-rate", "proved"): (("block", "rate"), stable),
    ("switching", "proved"): (("drop|scenarios",), switching),
    ("performance", "proved"): (("nodes", "centre", "network"), performance),
    ("observability", "proved"): (("alpha", "window", "form", "horizon"), observable),
    ("observability", "refuted"): (("window", "form", "horizon"), unobservable),
    ("steady-state", "proved"): (("node", "c", "gain_error"), None),
    ("attraction", "proved"): (("node", "c", "rate"), None),
    ("attraction", "refuted"): (("node", "c"), None),
    ("tolerance", "proved"): (("node", "c", "interval"), None),
    ("convergence", "proved"): (("node", "c", "start"), None),
    ("convergence-all", "proved"): (("node", "c"), None),
}
COMMON = ("claim", "verdict", "statement", "margin", "reason")
EVIDENCE = {"proved": "proof", "refuted": "witness"}


def examine(claim: Any, at: Deployment | Channels) -> Finding:
    """What is to be said of one claim."""
    given = claim if isinstance(claim, dict) else {}
    texts = (given.get(key) for key in ("claim", "verdict", "statement"))
    name, verdict, statement = (text[:300] if isinstance(text, str) else "" for text in texts)
    node = given.get("node")

    def finding(result: str, reason: str | None) -> Finding:
        return Finding(name, node if type(node) in (int, str) else None, verdict, result, statement, reason)

    try:
        if verdict == "undecided":
            return finding("undecided", _what_was_tried(given, name))
        if (name, verdict) not in RULES:
            raise Wrong("no such claim, or none that can have this verdict")
        own, verify = RULES[name, verdict]
        keys = [("drop" if "drop" in given else "scenarios") if key == "drop|scenarios" else key for key in own]
        _object(given, "the claim", *COMMON, EVIDENCE[verdict], *keys)
        _require(given["reason"] is None, "reason: expected null for a claim that is decided")
        of_channels = name == "observability"
        _require(of_channels == isinstance(at, Channels), "the claim speaks of another kind of data")
        if verify is None:
            raise Declined("it needs a logarithm, which tolnet check takes in ball arithmetic")
        if of_channels or verify in (unstable, performance):
            _require(given["margin"] is None, "margin: expected null")
        _require(given["statement"] == sentence(given), "the statement is not the one that this claim can make")
        verify(given, at)
    except Wrong as wrong:
        return finding("invalid", str(wrong))
    except Declined as declined:
        return finding("not checked here", str(declined))
    return finding("valid", None)


def _what_was_tried(claim: dict[str, Any], name: str) -> str:
    own = {
        part for (known, _), (keys, _) in RULES.items() if known == name for key in keys for part in key.split("|")
    }
    _require(bool(own), "no such claim")
    _object(claim, "the claim", *COMMON, optional=own)
    _require(claim["margin"] is None, "margin: expected null")
    if not isinstance(claim["reason"], str) or not claim["reason"]:
        raise Wrong("reason: expected a text that says what was tried")
    return claim["reason"][:300]


def check(document: Any, watch: Watch = unwatched) -> list[Finding]:
    """A finding for every claim of the document, as `load` returns it; Refused where it is no certificate."""
    try:
        labels = ("schema", "tolnet", "problem", "convention", "tau", "tolerance", "status")
        _object(document, "the document", *labels, "data", "claims")
        _require(document["schema"] == SCHEMA, f"schema: expected {SCHEMA}")
        claims = _list(document["claims"], None, "claims")
        _require(bool(claims), "claims: the certificate claims nothing")
        data = document["data"]
        channels = isinstance(data, dict) and "kind" in data
        deployment = _channels(data) if channels else _deployment(data, watch)
    except Wrong as wrong:
        raise Refused(str(wrong)) from None
    return [examine(claim, deployment) for claim in claims]


# -------------------- Reading ---------------------------------------------------------------------------------


def load(path: str, largest: int = LARGEST_FILE) -> Any:
    """The JSON document in a file; Refused where it is too large, nested too deeply, or no plain JSON."""
    content = bytearray()
    try:
        with open(path, "rb") as file:  # noqa: PTH123
            while part := file.read(2**20):
                content += part
                if len(content) > largest:
                    raise Refused(f"{path}: larger than {largest} bytes")
    except OSError as error:
        raise Refused(f"{path}: {error.strerror}") from None
    try:
        return json.loads(
            content.decode(),
            object_pairs_hook=_distinct,
            parse_constant=_no_number,
            parse_int=_json_int,
            parse_float=_json_float,
        )
    except Wrong as wrong:
        raise Refused(f"{path}: {wrong}") from None
    except RecursionError:
        raise Refused(f"{path}: nested too deeply") from None
    except ValueError as error:
        raise Refused(f"{path}: no JSON document: {error}") from None


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise Wrong("an object has a key twice")
    return found


def _no_number(text: str) -> NoReturn:
    raise Wrong(f"{text[:LONGEST_NUMBER]} is no finite double")


def _json_int(text: str) -> int:
    return int(text) if len(text) <= 16 else _no_number(text)


def _json_float(text: str) -> float:
    value = float(text) if len(text) <= LONGEST_NUMBER else math.inf
    return value if math.isfinite(value) else _no_number(text)


def _object(thing: Any, where: str, *required: str, optional: Iterable[str] = ()) -> dict[str, Any]:
    if not isinstance(thing, dict):
        raise Wrong(f"{where}: expected an object")
    for key in required:
        _require(key in thing, f"{where}: {key} is missing")
    for key in thing:
        _require(key in required or key in optional, f"{where}: unknown key {ascii(key)[:60]}")
    return thing


def _list(thing: Any, count: int | None, where: str) -> list[Any]:
    if not isinstance(thing, list) or (count is not None and len(thing) != count):
        raise Wrong(f"{where}: expected a list" + ("" if count is None else f" of {count}"))
    return thing


def _whole(thing: Any, low: int, high: int, where: str) -> int:
    if type(thing) is not int or not low <= thing <= high:
        raise Wrong(f"{where}: expected a whole number from {low} to {high}")
    return thing


def _doubles(text: Any, count: int, where: str) -> list[float]:
    """So many doubles, written as float.hex writes them, one space between two."""
    if not isinstance(text, str) or len(text) > 25 * count or text.count(" ") + (text != "") != count:
        raise Wrong(f"{where}: expected {count} hexadecimal numbers in a text")
    words = text.split(" ") if text else []
    try:
        values = list(map(float.fromhex, words))
    except (ValueError, OverflowError):
        raise Wrong(f"{where}: no hexadecimal number, or one that is no double") from None
    canonical = " ".join(map(float.hex, values))
    if text not in (canonical, LAST_ZEROS.sub("p", canonical)) or not all(map(math.isfinite, values)):
        raise Wrong(f"{where}: expected {count} finite doubles, written as float.hex writes them")
    return values


def _matrix(text: Any, height: int, width: int, where: str) -> Matrix:
    """A matrix, row by row."""
    ratios = [x.as_integer_ratio() for x in _doubles(text, height * width, where)]
    scale = max((q for _, q in ratios), default=1)
    whole = [p * (scale // q) for p, q in ratios]
    if max((abs(x) for x in whole), default=0).bit_length() > WIDEST_RANGE:
        raise Wrong(f"{where}: numbers that span more than {WIDEST_RANGE} bits")
    return Matrix([whole[i * width : (i + 1) * width] for i in range(height)], -_log2(scale))


def _symmetric(text: Any, n: int, where: str) -> Matrix:
    """A symmetric matrix from its upper triangle, row by row."""
    triangle = _matrix(text, 1, n * (n + 1) // 2, where)
    entries = iter(triangle.rows[0])
    rows: list[list[int]] = []
    for i in range(n):
        rows.append([row[i] for row in rows] + [next(entries) for _ in range(i, n)])
    return Matrix(rows, triangle.exponent)


def _symmetric_list(thing: Any, count: int, n: int, where: str) -> list[Matrix]:
    return [_symmetric(text, n, f"{where}[{k}]") for k, text in enumerate(_list(thing, count, where))]


def _covariance(thing: Any, where: str, n: int, full: str, factor: str, *columns: str) -> Matrix:
    """S from {full: S}, or F F' from {factor: F}; without columns the factor is square."""
    if isinstance(thing, dict) and full in thing:
        S = _matrix(_object(thing, where, full)[full], n, n, f"{where}.{full}")
        _require(S.rows == S.T.rows, f"{where}.{full}: expected a symmetric matrix")
        return S
    _object(thing, where, factor, *columns)
    width = _whole(thing["columns"], 0, 10**8, f"{where}.columns") if columns else n
    F = _matrix(thing[factor], n, width, f"{where}.{factor}")
    return F.by(F)


def _weights(thing: Any, neighbours: list[list[int]], where: str) -> list[dict[int, Fraction]]:
    found = []
    for k, text in enumerate(_list(thing, len(neighbours), where)):
        values = _doubles(text, len(neighbours[k]), f"{where}[{k}]")
        found.append({l: Fraction(w) for l, w in zip(neighbours[k], values, strict=True) if w})
    return found


def _gains(thing: Any, n: int, neighbours: list[list[int]], C: list[Matrix], where: str) -> list[Matrix]:
    texts = _list(thing, len(neighbours), where)
    widths = [sum(len(C[l].rows[0]) for l in heard) for heard in neighbours]
    return [_matrix(text, n, widths[k], f"{where}[{k}]") for k, text in enumerate(texts)]


def _neighbours(thing: Any, nodes: int, directed: bool) -> list[list[int]]:
    found = []
    for k, heard in enumerate(_list(thing, nodes, "data.neighbours")):
        where = f"data.neighbours[{k}]"
        for l in _list(heard, None, where):
            _whole(l, 0, nodes - 1, where)
        _require(all(a < b for a, b in pairwise(heard)), f"{where}: expected rising numbers")
        _require(k in heard, f"{where}: expected the node itself among them")
        found.append(heard)
    if not directed:
        links = {(k, l) for k, heard in enumerate(found) for l in heard}
        _require(all((l, k) in links for k, l in links), "data.neighbours: a link runs one way only")
    return found


def _deployment(data: Any, watch: Watch) -> Deployment:
    keys = ("n", "nodes", "A", "process", "C", "noise", "directed", "neighbours", "weights", "gains", "centre")
    _object(data, "data", *keys)
    nodes = _whole(data["nodes"], 1, 10**8, "data.nodes")
    n = _whole(data["n"], 1, LARGEST_MATRIX, "data.n")
    directed = data["directed"]
    if not isinstance(directed, bool):
        raise Wrong("data.directed: expected true or false")
    neighbours = _neighbours(data["neighbours"], nodes, directed)
    work = sum(n**3 + len(heard) * n**2 for heard in neighbours)
    _require(work <= MOST_WORK, "data: a network too large to be checked here")
    C, R = [], []
    noise = _list(data["noise"], nodes, "data.noise")
    for k, text in enumerate(_list(data["C"], nodes, "data.C")):
        p = (text.count(" ") + 1) // n if isinstance(text, str) and text else 0
        rows = _matrix(text, p, n, f"data.C[{k}]")
        C.append(Matrix([[row[i] for row in rows.rows] for i in range(n)], rows.exponent))
        where = f"data.noise[{k}]"
        R.append(_covariance(noise[k], where, p, "R", "D") if p or _object(noise[k], where) else Matrix([], 0))
    centre_gains, tilt = None, Matrix.zero(n, 0)
    if data["centre"] is not None:
        centre = _object(data["centre"], "data.centre", "gain", "tilt", "columns")
        texts = _list(centre["gain"], nodes, "data.centre.gain")
        centre_gains = [_matrix(text, n, len(C[l].rows[0]), f"data.centre.gain[{l}]") for l, text in enumerate(texts)]
        tilt = _matrix(
            centre["tilt"], n, _whole(centre["columns"], 0, 10**8, "data.centre.columns"), "data.centre.tilt"
        )
    return Deployment(
        n=n,
        A=_matrix(data["A"], n, n, "data.A"),
        Q=_covariance(data["process"], "data.process", n, "Q", "B", "columns"),
        C=C,
        R=R,
        directed=directed,
        neighbours=neighbours,
        weights=_weights(data["weights"], neighbours, "data.weights"),
        gains=_gains(data["gains"], n, neighbours, C, "data.gains"),
        centre_gains=centre_gains,
        tilt=tilt,
        watch=watch,
    )


def _channels(data: Any) -> Channels:
    letters = ("A", "F", "Q", "mu", "C", "R", "tau", "phi")
    _object(data, "data", "kind", "n", "nodes", *letters, "initial_second_moment")
    _require(data["kind"] == "corrupted-channels", "data.kind: expected corrupted-channels, or no such key")
    nodes, n = _whole(data["nodes"], 1, 10**8, "data.nodes"), _whole(data["n"], 1, LARGEST_MATRIX, "data.n")
    for key in letters:
        _require(bool(_list(data[key], None, f"data.{key}")), f"data.{key}: expected one period")

    def over(key: str, read: Callable[[Any, str], Item]) -> list[Item]:
        return [read(text, f"data.{key}[{t}]") for t, text in enumerate(data[key])]

    def square(text: Any, where: str) -> Matrix:
        return _matrix(text, n, n, where)

    def numbers(text: Any, where: str) -> list[Fraction]:
        return list(map(Fraction, _doubles(text, nodes, where)))

    def outputs(texts: Any, where: str) -> list[Matrix]:
        p = [
            (text.count(" ") + 1) // n if isinstance(text, str) and text else 0 for text in _list(texts, nodes, where)
        ]
        return [_matrix(text, p[i], n, f"{where}[{i}]") for i, text in enumerate(texts)]

    C, width = over("C", outputs), range(nodes)
    p = [len(each.rows) for each in C[0]]
    _require(
        all(len(at[i].rows) == p[i] for at in C for i in width), "data.C: a sensor changes its number of outputs"
    )

    def noise(texts: Any, where: str) -> list[Matrix]:
        return [_matrix(text, p[i], p[i], f"{where}[{i}]") for i, text in enumerate(_list(texts, nodes, where))]

    found = Channels(
        n=n,
        A=over("A", square),
        F=over("F", square),
        Q=over("Q", square),
        mu=over("mu", lambda text, where: Fraction(_doubles(text, 1, where)[0])),
        C=C,
        R=over("R", noise),
        tau=over("tau", numbers),
        phi=over("phi", numbers),
        start=_symmetric(data["initial_second_moment"], n, "data.initial_second_moment"),
    )
    _require(min(found.mu) >= 0, "data.mu: expected variances")
    _require(min(min(each) for each in found.phi) >= 0, "data.phi: expected variances")
    R = [R for each in found.R for R in each]
    work = sum(len(S.rows) ** 3 for S in [*found.Q, *R])
    _require(work <= MOST_WORK, "data: a network too large to be checked here")
    _require(all(S.rows == S.T.rows for S in [*found.Q, *R]), "data: a covariance is not symmetric")
    _require(all(map(is_positive_definite, R)), "data.R: expected positive definite matrices")
    for S in [*found.Q, found.start]:
        semidefinite = is_positive_definite(S) or (n <= SMALL and _minors_are_positive(S.rows, semidefinite=True))
        _require(semidefinite, "data: a second moment is not shown to be semidefinite")
    return found


# -------------------- The command -----------------------------------------------------------------------------


def exit_code(findings: list[Finding]) -> int:
    """0: every claim valid; 1: some claim invalid; 3: nothing invalid, something not checked here or undecided."""
    results = {finding.result for finding in findings}
    return 1 if "invalid" in results else 0 if results == {"valid"} else 3


def _watched(label: str, count: int) -> Iterator[int]:
    """range(count), with a line on standard error that is wiped at the end."""
    for i in range(count):
        if i % 1000 == 999:
            print(f"\r{label}: {i + 1:,} of {count:,}", end="\x1b[K", file=sys.stderr, flush=True)
        yield i
    if count >= 1000:
        print("\r", end="\x1b[K", file=sys.stderr, flush=True)


def _line(finding: Finding) -> str:
    who = "" if finding.node is None else f" of {'node ' * isinstance(finding.node, int)}{finding.node}"
    text = finding.statement if finding.result in ("valid", "not checked here") else finding.reason
    return ascii(f"{finding.result}: {finding.claim}{who}, {finding.verdict}: {text}")[1:-1]


def main(arguments: list[str] | None = None) -> int:
    """Check the certificate that the command line names."""
    parser = argparse.ArgumentParser(description="Check a certificate in exact arithmetic.", epilog=exit_code.__doc__)
    parser.add_argument("certificate", help="the JSON file")
    parser.add_argument("--json", action="store_true", help="findings as JSON on standard output")
    parser.add_argument("--quiet", action="store_true", help="the exit code alone")
    parser.add_argument("--largest", type=int, default=LARGEST_FILE, metavar="BYTES", help="refuse a larger file")
    options = parser.parse_args(arguments)
    watch = _watched if sys.stderr.isatty() and not (options.quiet or options.json) else unwatched
    gc.disable()  # nothing here is cyclic, and a large certificate is millions of small objects
    try:
        findings = check(load(options.certificate, options.largest), watch)
    except (Refused, MemoryError) as refusal:
        print(ascii(str(refusal) or "out of memory")[1:-1], file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    if options.json:
        print(
            json.dumps({"schema": "tolnet.check/1", "findings": [asdict(finding) for finding in findings]}, indent=1)
        )
    elif not options.quiet:
        print("\n".join(map(_line, findings)))
    return exit_code(findings)


if __name__ == "__main__":
    sys.exit(main())
