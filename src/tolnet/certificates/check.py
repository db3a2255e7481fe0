"""Check a certificate (docs/certificate.md) and trust nothing else: one file, the Python standard library alone.

    python check.py certificate.json

Every number of a proof is a double, m 2^e, and every condition is a sum of products of such numbers that must be
positive or positive definite: whole numbers decide it, and no floating point. Nothing is shared with the program that
wrote the certificate, nothing that is read is ever executed, and whatever is not shown is `invalid`: a checker may
decline what is true, it must never accept what is not.

Read in this order: exact matrices, definiteness, the deployment, the claims (a function each, which returns the only
sentence that it has shown), reading, the command.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import re
import sys
from collections import ChainMap, Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from functools import cache, cached_property
from itertools import accumulate, combinations, pairwise
from operator import mul
from time import process_time
from typing import Any

SCHEMA = "tolnet.certificate/1"
LARGEST_FILE = 2**30  # bytes
MOST_VALUES, MOST_OBJECTS = 3 * 10**7, 5 * 10**6  # of a file; of one that is small, fewer
MOST_CLAIMS = 10**5  # and ten more for every node
LONGEST_NUMBER = 40  # characters of a number in JSON; a double needs 24
LARGEST_MATRIX = 1500  # rows of a matrix that speaks of all nodes at once
LONGEST_PATH = 1000  # links
LONGEST = 1800  # seconds of processor time that a document may cost
LAST_ZEROS = re.compile(r"\.?0+p")  # of the fraction of a hexadecimal number: they may be left out


class Refused(Exception):
    """The file is no certificate, or too large to be checked."""


class Declined(Exception):
    """The claim may well be true, but is not checked here."""


class Wrong(Exception):
    """A condition does not hold, or what should hold it is malformed."""


def _require(condition: bool, complaint: str) -> None:
    if not condition:
        raise Wrong(complaint)


class Clock:
    """Processor time: what cannot be bounded beforehand ends here."""

    end = math.inf

    @classmethod
    def check(cls) -> None:
        if process_time() > cls.end:
            raise Declined(f"the document takes more than {LONGEST} seconds")


# -------------------- Exact matrices --------------------------------------------------------------------------


@dataclass(slots=True)
class Matrix:
    """The matrix rows * 2**exponent, with whole numbers in its rows."""

    rows: list[list[int]]
    exponent: int = 0

    @property
    def T(self) -> Matrix:
        return Matrix([list(column) for column in zip(*self.rows, strict=True)], self.exponent)

    def __add__(self, other: Matrix) -> Matrix:
        return _sum([(1, self), (1, other)])

    def __sub__(self, other: Matrix) -> Matrix:
        return _sum([(1, self), (-1, other)])

    def __rmul__(self, scalar: Fraction | int) -> Matrix:
        return _sum([(scalar, self)])

    def __matmul__(self, other: Matrix) -> Matrix:
        return self.by(other.T)

    def by(self, other: Matrix) -> Matrix:
        """P Q', which skips the zeros of Q."""
        sparse = [[(j, y) for j, y in enumerate(row) if y] for row in other.rows]
        rows = []
        for row in self.rows:
            Clock.check()
            rows.append([sum([row[j] * y for j, y in other_row]) for other_row in sparse])
        return Matrix(rows, self.exponent + other.exponent)


def _log2(power: int) -> int:
    if power & (power - 1):
        raise ArithmeticError("no power of two")
    return power.bit_length() - 1


def _scaled(whole: int, exponent: int) -> Fraction:
    return Fraction(whole) * Fraction(2) ** exponent


def _sum(terms: Iterable[tuple[Fraction | int, Matrix]], n: int = 0) -> Matrix:
    """The sum of dyadic numbers times matrices of one shape; zero, n x n, if there are none."""
    given = [(c.numerator, P.exponent - _log2(c.denominator), P.rows) for c, P in terms]
    if not given:
        return Matrix([[0] * n for _ in range(n)])
    exponent = min(e for _, e, _ in given)
    scale = [c << (e - exponent) for c, e, _ in given]
    by_row = zip(*(rows for _, _, rows in given), strict=True)
    rows = [[sum(map(mul, scale, entries)) for entries in zip(*same, strict=True)] for same in by_row]
    return Matrix(rows, exponent)


def _unit(n: int) -> Matrix:
    return Matrix([[int(i == j) for j in range(n)] for i in range(n)])


def _congruence(P: Matrix, S: Matrix) -> Matrix:
    """P S P' for a symmetric S."""
    return S.by(P).T.by(P)


def _trace(P: Matrix, indices: range) -> Fraction:
    return _scaled(sum(P.rows[i][i] for i in indices), P.exponent)


def _assemble(blocks: Iterable[tuple[int, int, Matrix]], height: int, width: int) -> Matrix:
    """The matrix height x width of blocks, given with the row and the column where each begins."""
    blocks = list(blocks)
    exponent = min((block.exponent for _, _, block in blocks), default=0)
    rows = [[0] * width for _ in range(height)]
    for top, left, block in blocks:
        for i, row in enumerate(block.rows, start=top):
            rows[i][left : left + len(row)] = [x << (block.exponent - exponent) for x in row]
    return Matrix(rows, exponent)


# -------------------- Definiteness ----------------------------------------------------------------------------


def is_positive_definite(S: Matrix) -> bool:
    """Whether the symmetric S was shown to be positive definite; False may mean not shown.

    D S D = L L' + n 2^bits I + E, exactly, for D = diag(2^lift) and a triangular L of whole numbers, which is rounded
    down: E is symmetric, E_ii >= 0 and 0 <= E_ij < 2^bits, so that n 2^bits I + E > 0 (Gershgorin), and S > 0.
    """
    diagonal = [row[i] for i, row in enumerate(S.rows)]
    if min(diagonal, default=1) <= 0:
        return False
    sizes = [(x.bit_length() + 1) // 2 for x in diagonal]
    return any(_has_factor(S.rows, [bits - size for size in sizes], bits) for bits in (60, 240, 960))


def _has_factor(rows: list[list[int]], lift: list[int], bits: int) -> bool:
    """Cholesky's method on D S D - n 2^bits I, whose diagonal is below 4^bits: so is every L_jj^2."""
    L: list[list[int]] = []
    for i, row in enumerate(rows):
        Clock.check()
        c: list[int] = []
        for j, above in enumerate(L):
            c.append((_shifted(row[j], lift[i] + lift[j]) - sum(map(mul, c, above))) // above[j])
        pivot = _shifted(row[i], 2 * lift[i]) - (len(rows) << bits) - sum(map(mul, c, c))
        if pivot <= 0:
            return False
        L.append([*c, math.isqrt(pivot)])
    return True


def _shifted(x: int, by: int) -> int:
    """x 2^by, rounded down."""
    return x << by if by >= 0 else x >> -by


def is_semidefinite(S: Matrix) -> bool:
    """By fraction-free elimination: no pivot is negative, and beside a pivot of zero there are only zeros."""
    rows, previous = S.rows, 1
    while rows:
        (pivot, *rest), *below = rows
        if pivot < 0 or (pivot == 0 and any(rest)):
            return False
        rows, scale = [], pivot or previous
        for head, *row in below:
            Clock.check()
            rows.append([(x * scale - head * y) // previous for x, y in zip(row, rest, strict=True)])
        previous = scale
    return True


def _require_definite(S: Matrix, what: str) -> None:
    _require(is_positive_definite(S), f"{what} is not shown to be positive definite")


# -------------------- The deployment, and what is derived from it ---------------------------------------------

Weights = Mapping[int, dict[int, Fraction]]
Loop = Callable[[int], Matrix]  # M_k of node k
Watch = Callable[[str, int], Iterator[int]]  # range(count), with a label to show meanwhile


def _pull(row: dict[int, Fraction]) -> dict[int, Fraction]:
    """sigma_k |w_lk| by l, sigma_k = sum_l |w_lk|: all that the block conditions ask of the weights of k."""
    sigma = sum(map(abs, row.values()), Fraction(0))
    return {l: sigma * abs(w) for l, w in row.items()}


def unmixed(weights: Weights, where: str) -> str | None:
    """Which column of W does not sum to one, as far as the rounding of its weights lets it; None where all do.

    Errors obey F only then: whatever a column lacks of one, or has too much, multiplies the state itself. A column of
    m weights w >= 0, divided by its sum in doubles, sums to one within m 2^-52: one ulp a weight, of which division
    and sum take half. Weights that all are numbers of single precision were rounded once more, by 2^-24 together.
    """
    single = all(w.numerator.bit_length() <= 24 for row in weights.values() for w in row.values())
    for k, row in weights.items():
        total = sum(row.values(), Fraction(0))
        if abs(total - 1) > Fraction(len(row) + single * 2**28, 2**52):
            return f"{where}[{k}]: the weights sum to {float(total)!r} instead of one, so that F is no error dynamics"
    return None


def watched(label: str, count: int) -> Iterator[int]:
    """range(count), with a line now and then for people at a terminal."""
    for i in range(count):
        if i % 10_000 == 9_999 and sys.stderr.isatty():
            print(f"{label}: {i + 1:,} of {count:,}", file=sys.stderr)
        yield i


class Deployment:
    """The numbers of `data`. C_l is kept transposed, n x p_l; weights[k][l] is w_lk where it is not zero."""

    def __init__(self, data: Any, watch: Watch) -> None:
        self.rules: Rules = {}
        keys = ("n", "nodes", "A", "process", "C", "noise", "directed", "neighbours", "weights", "gains", "centre")
        _object(data, "data", *keys)
        nodes, n = _whole(data, "data.nodes", 1), _whole(data, "data.n", 1, LARGEST_MATRIX)
        _require(isinstance(data["directed"], bool), "data.directed: expected true or false")
        self.n, self.directed, self.watch = n, data["directed"], watch
        self.neighbours, self.hearers = _neighbours(data["neighbours"], nodes, self.directed)
        self.A = _matrix(data["A"], n, n, "data.A")
        self.Q = _covariance(data["process"], "data.process", n, "Q", "B", "columns")
        self.C = [_sensor(text, n, f"data.C[{k}]") for k, text in enumerate(_list(data["C"], nodes, "data.C"))]
        self.p = [len(C.rows[0]) for C in self.C]
        noise = enumerate(_list(data["noise"], nodes, "data.noise"))
        self.R = [_covariance(thing, f"data.noise[{k}]", self.p[k], "R", "D") for k, thing in noise]
        self.weights = self.read_weights(data["weights"], "data.weights")
        self.gains = self.read_gains(data["gains"], "data.gains")
        self.unmixed = unmixed(self.weights, "data.weights")
        self.pull = {k: _pull(row) for k, row in self.weights.items()}
        self.loop = cache(lambda k: self.closed_loop(self.gains[k]))
        self.stated = None  # the centre's gains by sensor, and a factor of T
        if data["centre"] is not None:
            centre = _object(data["centre"], "data.centre", "gain", "tilt", "columns")
            texts = zip(_list(centre["gain"], nodes, "data.centre.gain"), self.p, strict=True)
            gains = {l: _matrix(text, n, p, "data.centre.gain") for l, (text, p) in enumerate(texts)}
            self.stated = (
                gains,
                _matrix(centre["tilt"], n, _whole(centre, "data.centre.columns", 0), "data.centre.tilt"),
            )

    def read_weights(self, thing: Any, where: str) -> dict[int, dict[int, Fraction]]:
        """A text per node, for whom it hears in rising order."""
        found = {}
        for k, (heard, text) in enumerate(zip(self.neighbours, _list(thing, len(self), where), strict=True)):
            values = zip(heard, _doubles(text, len(heard), f"{where}[{k}]"), strict=True)
            found[k] = {l: Fraction(w) for l, w in values if w}
        return found

    def read_gains(self, thing: Any, where: str) -> list[dict[int, Matrix]]:
        """G_{k,l}, the columns of G_k for sensor l, by l, for every node."""
        found = []
        for k, (heard, text) in enumerate(zip(self.neighbours, _list(thing, len(self), where), strict=True)):
            ends = [*accumulate((self.p[l] for l in heard), initial=0)]
            G, parts = _matrix(text, self.n, ends[-1], f"{where}[{k}]"), zip(heard, pairwise(ends), strict=True)
            found.append({l: Matrix([row[i:j] for row in G.rows], G.exponent) for l, (i, j) in parts})
        return found

    def __len__(self) -> int:
        return len(self.neighbours)

    def closed_loop(self, G: dict[int, Matrix]) -> Matrix:
        """M_k = A - G_k C_k^loc."""
        return _sum([(1, self.A), *((-1, part.by(self.C[l])) for l, part in G.items())])

    def cross(self, G: dict[int, Matrix], H: dict[int, Matrix]) -> Matrix:
        """Q + sum_l G_l R_l H_l'."""
        return _sum([(1, self.Q), *((1, part.by(self.R[l]).by(H[l])) for l, part in G.items())])

    @cached_property
    def block(self) -> Matrix:
        """The network block, whose block (k, l) is w_lk M_l."""
        n, size = self.n, len(self) * self.n
        _fits(size)
        blocks = ((k * n, l * n, w * self.loop(l)) for k, row in self.weights.items() for l, w in row.items())
        return _assemble(blocks, size, size)

    @cached_property
    def centre(self) -> tuple[dict[int, Matrix], Matrix, Matrix, Matrix]:
        """The centre's gains G_l, T, T F_0 with F_0 = A - G C, and F_e = F_0 + (Q + G R G') T F_0."""
        if self.stated is None:
            raise Wrong("the claim needs data.centre")
        G, tilt = self.stated
        loop, T = self.closed_loop(G), tilt.by(tilt)
        return G, T, T @ loop, loop + self.cross(G, G) @ T @ loop


# -------------------- Stability; s stands for (1 - delta) r^2 -------------------------------------------------


def primal(at: Deployment, X: list[Matrix], s: Fraction) -> None:
    """s X_k - sigma_k sum_l |w_lk| M_l X_l M_l' > 0."""
    moved = [_congruence(at.loop(l), X[l]) for l in at.watch("M X M'", len(at))]
    for k in at.watch("primal conditions", len(at)):
        total = _sum(((c, moved[l]) for l, c in at.pull[k].items()), at.n)
        _require_definite(s * X[k] - total, f"the primal condition of node {k}")


def dual(
    at: Deployment, pull: Weights, loop: Loop, Y: list[Matrix], s: Fraction, nodes: Iterable[int], suffix: str = ""
) -> None:
    """s Y_l - M_l' (sum_k sigma_k |w_lk| Y_k) M_l > 0 for these l, w and M."""
    for l in nodes:
        S = _sum(((pull[k][l], Y[k]) for k in at.hearers[l] if l in pull[k]), at.n)
        _require_definite(s * Y[l] - _congruence(loop(l).T, S), f"the dual condition of node {l}{suffix}")


def power(at: Deployment, j: int, X: list[Matrix], shares: list[Any], s: Fraction) -> None:
    """s X_k - sum_l (A^j)_kl X_l (A^j)_kl' / p_kl > 0, sum_l p_kl <= 1, for A the network block."""
    for k in at.watch(f"paths of {j} links", len(at)):
        blocks = {k: _unit(at.n)}  # (A^i)_kl by l; that of i + 1 is (sum_m w_lm (A^i)_km) M_l
        for _ in range(j):
            Clock.check()
            reached: dict[int, list[tuple[Fraction, Matrix]]] = {}
            for m, block in blocks.items():
                for l, w in at.weights[m].items():
                    reached.setdefault(l, []).append((w, block))
            blocks = {l: _sum(terms) @ at.loop(l) for l, terms in reached.items()}
        p = _doubles(shares[k], len(blocks), f"proof.shares[{k}]")
        _require(all(share > 0 for share in p), f"a share of node {k} is not positive")
        _require(sum(map(Fraction, p)) <= 1, f"the shares of node {k} exceed one")
        # a dyadic number that is at least 1 / p_kl, and above it by less than one part in 2^100
        inverses = [Fraction(math.ceil(2**100 / Fraction(share)), 2**100) for share in p]
        total = _sum(((q, _congruence(blocks[l], X[l])) for l, q in zip(sorted(blocks), inverses, strict=True)), at.n)
        _require_definite(s * X[k] - total, f"the condition of node {k} on paths of {j} links")


def full(block: Matrix, X: Matrix, s: Fraction, what: str) -> None:
    """X > 0 and s X - F X F' > 0."""
    _require_definite(X, what)
    _require_definite(s * X - _congruence(block, X), f"the condition of {what}")


def _definite(at: Deployment, proof: dict[str, Any], name: str) -> list[Matrix]:
    """The matrices of this name, one per node, each shown to be positive definite."""
    matrices = _symmetric_list(proof[name], len(at), at.n, f"proof.{name}")
    for k in at.watch(f"{name} > 0", len(at)):
        _require_definite(matrices[k], f"{name}[{k}]")
    return matrices


def stable(claim: dict[str, Any], at: Deployment) -> str:
    """`schur-stability` and `decay-rate`, proved."""
    names = {
        "F": "the network's error dynamics F under the stated least favourable model",
        "network": "the network block of the error dynamics",
    }
    keys = {"primal": ("X",), "dual": ("Y",), "power": ("X", "power", "shares"), "full": ("X",)}
    block, kept = _one_of(names, claim, "block"), 1 - _margin(claim)
    rate = _positive(claim, "rate") if "rate" in claim else Fraction(1)
    method = _one_of(keys, claim["proof"], "proof.method")
    proof = _object(claim["proof"], "proof", "method", *keys[method], *(("centre",) if block == "F" else ()))
    s = kept * rate**2
    if method == "full":
        full(at.block, _symmetric(proof["X"], len(at.block.rows), "proof.X"), s, "proof.X")
    elif method == "primal":
        primal(at, _definite(at, proof, "X"), s)
    elif method == "dual":
        dual(at, at.pull, at.loop, _definite(at, proof, "Y"), s, at.watch("dual conditions", len(at)))
    else:
        j, shares = _whole(proof, "proof.power", 2), _list(proof["shares"], len(at), "proof.shares")
        if j > LONGEST_PATH:
            raise Declined(f"paths of more than {LONGEST_PATH} links")
        power(at, j, _definite(at, proof, "X"), shares, kept * rate ** (2 * j))
    if block == "F":
        full(at.centre[-1], _symmetric(proof["centre"], at.n, "proof.centre"), s, "proof.centre")
    where = f"circle of radius {float(rate)!r}." if "rate" in claim else "unit circle: errors die out."
    return f"With the stated weights and constant gains, every eigenvalue of {names[block]} lies inside the {where}"


def unstable(claim: dict[str, Any], at: Deployment) -> str:
    """`schur-stability`, refuted: some eigenvalue lies outside the unit circle."""
    witness, names = claim["witness"], {"network": "network", "centre": "least favourable"}
    of, whole = _one_of(names, witness, "witness.of"), _one_of(("F", "network"), claim, "block") == "F"
    _require(whole or of == "network", "witness.of: the claim does not speak of the centre")
    block = at.block if of == "network" else at.centre[-1]
    if _one_of(("lyapunov", "eigenpair"), witness, "witness.method") == "eigenpair":
        raise Declined("an eigenvalue is enclosed by tolnet check, in floating point with bounds on its rounding")
    _object(witness, "witness", "of", "method", "X", "v")
    X = _symmetric(witness["X"], len(block.rows), "witness.X")
    v = _matrix(witness["v"], 1, len(block.rows), "witness.v")
    _require(v.by(X).by(v).rows[0][0] > 0, "v' X v is not positive")
    _require_definite(_congruence(block.T, X) - X, "the Lyapunov difference of the witness")
    which = f"the {names[of]} block of the error dynamics"
    how = "With the stated weights and constant gains, some eigenvalue of"
    return f"{how} {which} lies outside the unit circle: errors grow."


# -------------------- Switching -------------------------------------------------------------------------------


def switching(claim: dict[str, Any], at: Deployment) -> str:
    """One dual Y for the nominal network and for every scenario."""
    _require(("drop" in claim) != ("scenarios" in claim), "the claim: expected either drop or scenarios")
    s, Y = 1 - _margin(claim), _definite(at, _object(claim["proof"], "proof", "Y"), "Y")
    dual(at, at.pull, at.loop, Y, s, at.watch("dual conditions", len(at)))
    if "drop" in claim:
        most = _whole(claim, "drop", 1)
        for l in at.watch("links that drop", len(at)):
            others = [j for j in at.neighbours[l] if j != l]
            for gone in (gone for i in range(min(most, len(others))) for gone in combinations(others, i + 1)):
                pull, loop = _without(at, [(j, l) for j in gone], f"node {l}")
                dual(at, pull, loop, Y, s, [l], f" without links to {gone}")
        how = f"links drop and return, at most {most} at once, each losing estimate and measurement together"
    else:
        scenarios = _list(claim["scenarios"], None, "scenarios")
        for i, scenario in enumerate(scenarios):
            pull, loop, nodes = _changed(at, scenario, f"scenarios[{i}]")
            dual(at, pull, loop, Y, s, nodes, f" in scenarios[{i}]")
        how = f"the nominal network and {len(scenarios)} scenarios alternate (a link that drops loses both"
        how += " estimate and measurement)"
    return f"With constant gains in each state, the network block of the error dynamics stays stable however {how}."


def _without(at: Deployment, links: Iterable[Sequence[int]], where: str) -> tuple[Weights, Loop]:
    """The network without these links: a lost neighbour's weight goes to the node itself, so that sigma stays."""
    weights, loops, dropped = dict[int, dict[int, Fraction]](), dict[int, Matrix](), set[tuple[int, int]]()
    for l, k in links:
        for j, hearer in [(l, k)] if at.directed else [(l, k), (k, l)]:
            _require(j != hearer and j in at.neighbours[hearer], f"{where}: no such link")
            _require((j, hearer) not in dropped, f"{where}: a link drops twice")
            dropped.add((j, hearer))
            row = weights.setdefault(hearer, dict(at.weights[hearer]))
            _require(min(row.values(), default=0) >= 0, f"{where}: node {hearer} has a negative weight")
            row[hearer] = row.get(hearer, Fraction(0)) + row.pop(j, Fraction(0))
            loops[hearer] = loops.get(hearer, at.loop(hearer)) + at.gains[hearer][j].by(at.C[j])
    pull = {k: _pull(row) for k, row in weights.items()}
    return ChainMap(pull, at.pull), lambda k: loops[k] if k in loops else at.loop(k)


def _changed(at: Deployment, scenario: Any, where: str) -> tuple[Weights, Loop, Iterable[int]]:
    """The weights and the loops of a scenario, and the nodes whose dual condition it changes."""
    given = _object(scenario, where, optional=("drop", "weights", "gains"))
    if "drop" in given:
        _object(given, where, "drop")
        links = _list(given["drop"], None, f"{where}.drop")
        for link in links:
            ends = [type(end) is int and 0 <= end < len(at) for end in _list(link, 2, f"{where}.drop")]
            _require(all(ends), f"{where}.drop: expected pairs of nodes")
        return *_without(at, links, where), sorted({end for link in links for end in link})
    weights = at.read_weights(given["weights"], f"{where}.weights") if "weights" in given else None
    if complaint := unmixed(weights or {}, f"{where}.weights"):
        raise Wrong(complaint)
    pull = at.pull if weights is None else {k: _pull(row) for k, row in weights.items()}
    gains = at.read_gains(given["gains"], f"{where}.gains") if "gains" in given else None
    loop = at.loop if gains is None else cache(lambda k: at.closed_loop(gains[k]))
    return pull, loop, at.watch(where, len(at) if given else 0)


# -------------------- Performance -----------------------------------------------------------------------------


def performance(claim: dict[str, Any], at: Deployment) -> str:
    """Every tr Q_kk of the solution of Q = F Q F' + G G' is within tr(Y D) / delta of the stated one.

    Y_k > I, Y - F' Y F > delta Y, and D = diag(sum_j |Z_ij| y_j / y_i) is above +-Z, the residual, for any y > 0.
    With y_i^2 just above Y_ii, tr(Y D) is at most sum_ij |Z_ij| y_i y_j.
    """
    n, N = at.n, len(at)
    proof, size = _object(claim["proof"], "proof", "Q", "Y", "delta"), (N + 1) * n
    _fits(size)
    delta = _positive(proof, "proof.delta")
    _require(delta < 1, "proof.delta: expected a number below 1")
    for l, R in enumerate(at.R):
        _require_definite(R, f"R[{l}]")
    _require(
        is_positive_definite(at.Q) or is_semidefinite(at.Q), "data.process: Q is not semidefinite; a factor B is"
    )
    Q, Y = _symmetric(proof["Q"], size, "proof.Q"), _symmetric_list(proof["Y"], N + 1, n, "proof.Y")
    for k, Y_k in enumerate(Y):
        _require_definite(Y_k - _unit(n), f"Y[{k}] - I")

    centre, T, tilted, centre_block = at.centre
    gains, mixing = [*at.gains, centre], {**at.weights, N: {N: Fraction(1)}}  # the centre is the last filter
    E = [at.cross(G, centre) for G in gains]
    # F, whose blocks (k, N) are sum_l w_lk E_l T F_0, and below them F_e
    last = [_sum(((w, E[l] @ tilted) for l, w in at.weights[k].items()), n) for k in range(N)] + [centre_block]
    F = _assemble([(0, 0, at.block), *((k * n, N * n, P) for k, P in enumerate(last))], size, size)
    dual(at, at.pull, at.loop, Y, (1 - delta) ** 2, range(N))
    reached = [_congruence(P.T, Y_k) for P, Y_k in zip(last, Y, strict=True)]
    gap = delta * ((1 - delta) * Y[N] - reached.pop()) - _sum([(1, P) for P in reached])
    _require_definite(gap, "the contraction of the centre")
    # G = W (x) I times what drives each filter before it mixes: the plant, its sensors, and the tilt, of covariance S
    starts = [0, *accumulate(at.p, initial=n)]
    width = starts[-1] + n
    S = _assemble([(i, i, P) for i, P in zip(starts, [at.Q, *at.R, T], strict=True)], width, width)
    driving = [(k * n, 0, _unit(n)) for k in range(N + 1)] + [(k * n, starts[-1], P) for k, P in enumerate(E)]
    driving += [(k * n, starts[l + 1], P) for k, parts in enumerate(gains) for l, P in parts.items()]
    weights = [(k * n, l * n, w * _unit(n)) for k, row in mixing.items() for l, w in row.items()]
    G = _assemble(weights, size, size) @ _assemble(driving, size, width)
    Z = _congruence(F, Q) + _congruence(G, S) - Q
    y = [math.isqrt(math.floor(2**80 * _trace(Y_k, range(i, i + 1)))) + 1 for Y_k in Y for i in range(n)]
    total = sum(y_i * sum(map(mul, map(abs, row), y)) for y_i, row in zip(y, Z.rows, strict=True))
    error = _scaled(total, Z.exponent - 80) / delta
    for k, interval in enumerate([*_list(claim["nodes"], N, "nodes"), claim["centre"]]):
        own = range(k * n, (k + 1) * n)
        _contains(interval, _trace(Q, own), error, f"nodes[{k}]" if k < N else "centre")
    low, high = _contains(claim["network"], _trace(Q, range(N * n)) / N, error / N, "network")
    return (
        "With the stated weights and constant gains, under the stated least favourable model, the steady mean square "
        f"deviation of the network lies in [{low!r}, {high!r}], and that of every node in its interval."
    )


def _contains(interval: Any, middle: Fraction, error: Fraction, where: str) -> list[float]:
    low, high = ends = _doubles(interval, 2, where)
    inside = Fraction(low) <= middle - error and middle + error <= Fraction(high)
    _require(inside, f"{where}: the proof does not reach this interval")
    return ends


# -------------------- Observability over corrupted channels ---------------------------------------------------


class Channels:
    """The numbers of `data`, each over a period of its own."""

    def __init__(self, data: Any) -> None:
        self.rules: Rules = {}
        periodic = ("A", "F", "Q", "mu", "C", "R", "tau", "phi")
        _object(data, "data", "kind", "n", "nodes", *periodic, "initial_second_moment")
        _one_of(("corrupted-channels",), data, "data.kind")
        nodes, n = _whole(data, "data.nodes", 1), _whole(data, "data.n", 1, LARGEST_MATRIX)
        for key in periodic:
            _require(bool(_list(data[key], None, f"data.{key}")), f"data.{key}: expected one period")
        self.n = n
        self.A, self.F, self.Q = ([_matrix(x, n, n, f"data.{key}") for x in data[key]] for key in ("A", "F", "Q"))
        self.mu = [_numbers(text, 1, "data.mu") for text in data["mu"]]
        self.tau, self.phi = ([_numbers(x, nodes, f"data.{key}") for x in data[key]] for key in ("tau", "phi"))
        self.C = [[_sensor(text, n, "data.C") for text in _list(texts, nodes, "data.C")] for texts in data["C"]]
        p = [len(C.rows[0]) for C in self.C[0]]
        constant = all([len(C.rows[0]) for C in at] == p for at in self.C)
        _require(constant, "data.C: a sensor changes its number of outputs")
        given = [zip(_list(texts, nodes, "data.R"), p, strict=True) for texts in data["R"]]
        self.R = [[_matrix(text, p_i, p_i, "data.R") for text, p_i in pairs] for pairs in given]
        self.start = _symmetric(data["initial_second_moment"], n, "data.initial_second_moment")
        self.period = math.lcm(*(len(data[key]) for key in periodic))  # after it everything repeats
        R = [R for at in self.R for R in at]
        _require(all(S.rows == S.T.rows for S in [*self.Q, *R]), "data: a covariance is not symmetric")
        _require(all(map(is_positive_definite, R)), "data.R: expected positive definite matrices")
        _require(all(map(is_semidefinite, [*self.Q, self.start])), "data: a second moment is not semidefinite")

    def step(self, k: int, X: Matrix) -> Matrix:
        """A X A' + mu F X F' + Q at instant k."""
        noise = _at(self.mu, k)[0] * _congruence(_at(self.F, k), X)
        return _congruence(_at(self.A, k), X) + noise + _at(self.Q, k)

    def information(self, k: int, gains: list[Matrix], X: Matrix | None, sharp: bool) -> Matrix:
        """sum_i tau^2 (C'K + K'C - K' Rt K), Rt = R + phi C X C', over the sensors whose K is not zero."""
        terms: list[tuple[Fraction | int, Matrix]] = []
        for i, K in enumerate(gains):
            if not any(map(any, K.rows)):
                continue
            tau, phi = (_at(self.tau, k)[i], _at(self.phi, k)[i]) if sharp else (1, 0)
            C, R = _at(self.C, k)[i], _at(self.R, k)[i]
            if phi:
                if X is None:
                    raise Wrong(f"proof.gains: sensor {i} fades, and there are no moments")
                R += phi * _congruence(C.T, X)
            seen = C @ K
            terms += [(tau**2, seen + seen.T), (-(tau**2), _congruence(K.T, R))]
        return _sum(terms, self.n)


def _at(period: list[Any], k: int) -> Any:
    return period[k % len(period)]


def _windows(claim: dict[str, Any]) -> tuple[int, int | None, str, str]:
    """The length of the windows, the last instant that they may reach (None: any), and both in words."""
    L, H = _whole(claim, "window", 1), claim["horizon"]
    _require(H is None or _whole(claim, "horizon", 0) >= L - 1, "window: longer than the horizon")
    form = {"sharp": "robust", "classical": "classical"}[_one_of(("sharp", "classical"), claim, "form")]
    within = "" if H is None else f" within k = 0..{H}"
    return L, H, f"window of {L} instant{'s' * (L > 1)}{within}", f"the {form} Gramian"


def observable(claim: dict[str, Any], at: Channels) -> str:
    """sum_j Phi' S_{k+j} Phi - alpha I > 0 for the windows from every k, S_s below sum_i tau^2 C' Rt^-1 C."""
    L, H, windows, gramian = _windows(claim)
    proof = _object(claim["proof"], "proof", "loop", "moments", "gains")
    n, m, alpha = at.n, len(_list(proof["gains"], None, "proof.gains")), _positive(claim, "alpha")
    loop = _whole(proof, "proof.loop", 0, m)
    _require(loop % at.period == 0, "proof.loop: expected a multiple of the period of the data")
    _require(loop > 0 or (H is not None and m > H), "proof: the gains end before the claim does")
    following = [*range(1, m), *([m - loop] if loop else [])]  # the instant after k, as far as there is one
    X = None if proof["moments"] is None else _symmetric_list(proof["moments"], m, n, "proof.moments")
    if X is not None:
        _require_definite(X[0] - at.start, "moments[0] less the initial second moment")
        for k, after in enumerate(following):
            _require_definite(X[after] - at.step(k, X[k]), f"the bound of the second moment after {k}")
    S = []
    for k, texts in enumerate(proof["gains"]):
        outputs, where = _at(at.C, k), f"proof.gains[{k}]"
        given = zip(_list(texts, len(outputs), where), outputs, strict=True)
        K = [_matrix(text, len(C.rows[0]), n, where) for text, C in given]
        S.append(at.information(k, K, None if X is None else X[k], claim["form"] == "sharp"))
    G = S
    for _ in range(L - 1):
        G = [S[k] + _congruence(_at(at.A, k).T, G[after]) for k, after in enumerate(following) if after < len(G)]
    for k, seen in enumerate(G if H is None else G[: H - L + 2]):
        _require_definite(seen - alpha * _unit(n), f"the Gramian of the window from {k}, less alpha I,")
    return f"Over every {windows} {gramian} exceeds {float(alpha)!r} I."


def unobservable(claim: dict[str, Any], at: Channels) -> str:
    """C Phi v = 0 for every sensor, at every instant of one window."""
    L, H, windows, gramian = _windows(claim)
    witness = _object(claim["witness"], "witness", "start", "vector")
    start = _whole(witness, "witness.start", 0, 10**16 if H is None else H - L + 1)
    v = _matrix(witness["vector"], 1, at.n, "witness.vector")
    _require(any(v.rows[0]), "witness.vector: expected another vector than zero")
    for k in range(start, start + L):
        Clock.check()
        for i, C in enumerate(_at(at.C, k)):
            _require(not any((v @ C).rows[0]), f"sensor {i} sees the vector of the witness at {k}")
        v = v.by(_at(at.A, k))
    return f"Over some {windows} no sensor sees a certain direction at all: {gramian} is singular."


# -------------------- Claims ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Finding:
    """What the checker says of one claim; `result` is valid, invalid, not checked here or undecided."""

    claim: str
    node: int | str | None
    verdict: str
    result: str
    statement: str
    reason: str | None


Verify = Callable[[dict[str, Any], Any], str]  # of a claim and its Deployment or Channels: the sentence that is shown
Rules = Mapping[tuple[str, str], tuple[tuple[str, ...], Verify]]
RULES: Rules = {  # keys of its own, and what verifies it
    ("schur-stability", "proved"): (("block",), stable),
    ("schur-stability", "refuted"): (("block",), unstable),
    ("decay-rate", "proved"): (("block", "rate"), stable),
    ("switching", "proved"): ((), switching),
    ("performance", "proved"): (("nodes", "centre", "network"), performance),
    ("observability", "proved"): (("alpha", "window", "form", "horizon"), observable),
    ("observability", "refuted"): (("window", "form", "horizon"), unobservable),
}
LOGARITHMIC = ("steady-state", "attraction", "tolerance", "convergence", "convergence-all")
COMMON = ("claim", "verdict", "statement", "margin", "reason")
EVIDENCE = {"proved": "proof", "refuted": "witness"}


def examine(claim: Any, at: Deployment | Channels, told: set[str]) -> Finding:
    """What is to be said of one claim, and not of one that was told before."""
    given = claim if isinstance(claim, dict) else {}
    texts = map(given.get, ("claim", "verdict", "statement", "reason", "node"))
    name, verdict, statement, reason, who = (_shown(text) if isinstance(text, str) else "" for text in texts)
    node = given["node"] if type(given.get("node")) is int else who or None
    try:
        result, reason = ("undecided", reason) if verdict == "undecided" else _judge(given, name, verdict, at)
    except Wrong as wrong:
        result, reason = "invalid", str(wrong)
    except Declined as declined:
        result, reason = "not checked here", str(declined)
    if result in ("valid", "not checked here"):
        subject = _subject(given, name, verdict, node)
        if subject in told:
            result, reason = "invalid", "an earlier claim speaks of the same already: it would be counted twice"
        told.add(subject)
    return Finding(name, node, verdict, result, statement, reason)


def _subject(claim: dict[str, Any], name: str, verdict: str, node: int | str | None) -> str:
    """What a claim speaks of: whatever it says, it is counted once. Of a filter, or of performance, there is one."""
    own, verify = RULES.get((name, verdict), ((), None))
    own = () if verify is performance else (*own, "drop", "scenarios")
    return repr((name, node, [(key, claim[key]) for key in own if key in claim] if name not in LOGARITHMIC else []))


def _shown(text: str) -> str:
    return text if len(text) <= 500 else f"{text[:497]}..."


def _judge(claim: dict[str, Any], name: str, verdict: str, at: Deployment | Channels) -> tuple[str, str | None]:
    Clock.check()
    if name in LOGARITHMIC and verdict in EVIDENCE and all(name != known for known, _ in at.rules):
        raise Declined(
            "it needs a logarithm, which check_filters.py takes, run in the place of this file, or tolnet check"
        )
    _require((name, verdict) in at.rules, "no such claim, or none that can have this verdict")
    own, verify = at.rules[name, verdict]
    either = ("drop", "scenarios") if verify is switching else ()
    _object(claim, "the claim", *COMMON, EVIDENCE[verdict], *own, optional=either)
    _require(claim["reason"] is None, "reason: expected null for a claim that is decided")
    _require((name == "observability") == isinstance(at, Channels), "the claim speaks of another kind of data")
    _require(claim["margin"] is None or verify in (stable, switching), "margin: expected null")
    if isinstance(at, Deployment) and at.unmixed and name not in LOGARITHMIC:
        raise Wrong(at.unmixed)
    shown = verify(claim, at)
    _require(claim["statement"] == shown, "the statement is not the one that this claim can make")
    return "valid", None


def check(
    document: Any, watch: Watch = watched, *, rules: Rules = RULES, names: Iterable[str] | None = None
) -> list[Finding]:
    """A finding for every claim of the document, as `load` returns it; Refused where it is no certificate.

    `rules` may know more claims than this file; of `names`, only claims that are called so are checked.
    """
    Clock.end = process_time() + LONGEST
    try:
        labels = ("schema", "tolnet", "problem", "convention", "tau", "tolerance", "status")
        _object(document, "the document", *labels, "data", "claims")
        _require(document["schema"] == SCHEMA, f"schema: expected {SCHEMA}")
        claims, data = _list(document["claims"], None, "claims"), document["data"]
        _require(bool(claims), "claims: the certificate claims nothing")
        nodes = data.get("nodes") if isinstance(data, dict) else None
        most = MOST_CLAIMS + 10 * (nodes if type(nodes) is int else 0)
        _require(len(claims) <= most, f"claims: more than {most} are not checked")
        at = Channels(data) if isinstance(data, dict) and "kind" in data else Deployment(data, watch)
    except (Wrong, Declined) as problem:
        raise Refused(str(problem)) from None
    at.rules = rules
    if names is not None:
        wanted = list(names)
        claims = [claim for claim in claims if isinstance(claim, dict) and claim.get("claim") in wanted]
    told: set[str] = set()
    return [examine(claim, at, told) for claim in claims]


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
        # what is read takes 40 bytes a value and 240 an object or list: an honest file has far fewer of them
        values, objects = content.count(b","), content.count(b"{") + content.count(b"[")
        size = len(content)
        if values > min(MOST_VALUES, 10**6 + size // 4) or objects > min(MOST_OBJECTS, 10**5 + size // 16):
            raise Refused(f"{path}: more numbers, lists or objects than a certificate of {size} bytes can have")
        hooks: dict[str, Any] = dict.fromkeys(("parse_constant", "parse_int", "parse_float"), _number)
        return json.loads(content.decode(), object_pairs_hook=_distinct, **hooks)
    except OSError as error:
        raise Refused(f"{path}: {error.strerror}") from None
    except (Wrong, ValueError, RecursionError) as error:
        complaint = "nested too deeply" if isinstance(error, RecursionError) else error
        raise Refused(f"{path}: no JSON document: {complaint}") from None


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    _require(len(found) == len(pairs), "an object has a key twice")
    return found


def _number(text: str) -> int | float:
    value = float(text) if len(text) <= LONGEST_NUMBER else math.inf
    _require(math.isfinite(value), f"{text[:LONGEST_NUMBER]} is no finite double")
    return int(text) if text.lstrip("-").isdigit() and len(text) <= 16 else value


def _object(thing: Any, where: str, *required: str, optional: Iterable[str] = ()) -> dict[str, Any]:
    """An object with these keys, and no others but the optional ones."""
    _require(isinstance(thing, dict), f"{where}: expected an object")
    for key in required:
        _require(key in thing, f"{where}: {key} is missing")
    for key in thing:
        _require(key in required or key in optional, f"{where}: unknown key {ascii(key)[:60]}")
    return thing


def _list(thing: Any, count: int | None, where: str) -> list[Any]:
    fits = isinstance(thing, list) and (count is None or len(thing) == count)
    _require(fits, f"{where}: expected a list" + ("" if count is None else f" of {count}"))
    return thing


def _one_of(names: Iterable[str], thing: Any, where: str) -> str:
    """The entry that the last part of `where` names."""
    found = thing.get(where.rpartition(".")[2]) if isinstance(thing, dict) else None
    if not isinstance(found, str) or found not in names:
        raise Wrong(f"{where}: expected {' or '.join(names)}")
    return found


def _whole(thing: dict[str, Any], where: str, low: int, high: int = 10**16) -> int:
    found = thing[where.rpartition(".")[2]]
    _require(type(found) is int and low <= found <= high, f"{where}: expected a whole number from {low} to {high}")
    return found


def _fits(size: int) -> None:
    if size > LARGEST_MATRIX:
        raise Declined("the network in one matrix: too large to be checked here")


def _positive(thing: dict[str, Any], where: str) -> Fraction:
    number = Fraction(_doubles(thing[where.rpartition(".")[2]], 1, where)[0])
    _require(number > 0, f"{where}: expected a positive number")
    return number


def _margin(claim: dict[str, Any]) -> Fraction:
    margin = claim["margin"]
    _require(type(margin) in (int, float) and 0 <= margin < 1, "margin: expected a number from 0 to 1, below 1")
    return Fraction(margin)


def _doubles(text: Any, count: int, where: str) -> list[float]:
    """So many doubles, written as float.hex writes them, one space between two."""
    if not isinstance(text, str) or len(text) > 25 * count or text.count(" ") + (text != "") != count:
        raise Wrong(f"{where}: expected {count} hexadecimal numbers in a text")
    try:
        values = list(map(float.fromhex, text.split(" "))) if text else []
    except (ValueError, OverflowError):
        raise Wrong(f"{where}: no hexadecimal number, or one that is no double") from None
    canonical = " ".join(map(float.hex, values))
    exact = text in (canonical, LAST_ZEROS.sub("p", canonical)) and all(map(math.isfinite, values))
    _require(exact, f"{where}: expected {count} finite doubles, written as float.hex writes them")
    return values


def _matrix(text: Any, height: int, width: int, where: str) -> Matrix:
    """A matrix, row by row."""
    ratios = [x.as_integer_ratio() for x in _doubles(text, height * width, where)]
    scale = max((q for _, q in ratios), default=1)
    whole = [p * (scale // q) for p, q in ratios]
    return Matrix([whole[i * width : (i + 1) * width] for i in range(height)], -_log2(scale))


def _numbers(text: Any, count: int, where: str) -> list[Fraction]:
    """Numbers that are not negative."""
    values = list(map(Fraction, _doubles(text, count, where)))
    _require(min(values) >= 0, f"{where}: a number is negative")
    return values


def _sensor(text: Any, n: int, where: str) -> Matrix:
    """C_k', with as many columns as there are rows of numbers."""
    p = (text.count(" ") + 1) // n if isinstance(text, str) and text else 0
    rows = _matrix(text, p, n, where)
    return rows.T if p else Matrix([[] for _ in range(n)])


def _symmetric(text: Any, n: int, where: str) -> Matrix:
    """A symmetric matrix from its upper triangle, row by row."""
    triangle = _matrix(text, 1, n * (n + 1) // 2, where)
    entries, rows = iter(triangle.rows[0]), list[list[int]]()
    for i in range(n):
        rows.append([row[i] for row in rows] + [next(entries) for _ in range(i, n)])
    return Matrix(rows, triangle.exponent)


def _symmetric_list(thing: Any, count: int, n: int, where: str) -> list[Matrix]:
    return [_symmetric(text, n, f"{where}[{k}]") for k, text in enumerate(_list(thing, count, where))]


def _covariance(thing: Any, where: str, n: int, full: str, factor: str, *columns: str) -> Matrix:
    """S from {full: S}, or F F' from {factor: F}; without columns the factor is square; {} of a relay."""
    if n == 0 and not _object(thing, where):
        return Matrix([])
    if isinstance(thing, dict) and full in thing:
        S = _matrix(_object(thing, where, full)[full], n, n, f"{where}.{full}")
        _require(S.rows == S.T.rows, f"{where}.{full}: expected a symmetric matrix")
        return S
    _object(thing, where, factor, *columns)
    width = _whole(thing, f"{where}.columns", 0) if columns else n
    F = _matrix(thing[factor], n, width, f"{where}.{factor}")
    return F.by(F)


def _neighbours(thing: Any, nodes: int, directed: bool) -> tuple[list[list[int]], list[list[int]]]:
    """Whom every node hears, and who hears it."""
    for k, heard in enumerate(_list(thing, nodes, "data.neighbours")):
        where = f"data.neighbours[{k}]"
        for l in _list(heard, None, where):
            _require(type(l) is int and 0 <= l < nodes, f"{where}: expected numbers of nodes")
        _require(all(a < b for a, b in pairwise(heard)), f"{where}: expected rising numbers")
        _require(k in heard, f"{where}: expected the node itself among them")
    hearers: list[list[int]] = [[] for _ in thing]
    for k, heard in enumerate(thing):
        for l in heard:
            hearers[l].append(k)
    _require(directed or thing == hearers, "data.neighbours: a link runs one way only")
    return thing, hearers


# What the file beside this one, check_filters.py, shares of the above, by names that are not private.
require, object_of, whole, doubles, matrix, symmetric = _require, _object, _whole, _doubles, _matrix, _symmetric
scaled, shifted, unit, assemble, trace = _scaled, _shifted, _unit, _assemble, _trace


# -------------------- The command -----------------------------------------------------------------------------


def exit_code(findings: list[Finding]) -> int:
    """0: every claim valid; 1: some claim invalid; 3: nothing invalid, something not checked here or undecided."""
    results = {finding.result for finding in findings}
    return 1 if "invalid" in results else 0 if results == {"valid"} else 3


def _line(finding: Finding) -> str:
    who = "" if finding.node is None else f" of {'node ' * isinstance(finding.node, int)}{finding.node}"
    text = finding.statement if finding.result == "valid" else finding.reason
    return ascii(f"{finding.result}: {finding.claim}{who}, {finding.verdict}: {text}")[1:-1]


def counts(findings: list[Finding]) -> dict[str, int]:
    """How many claims there are of each result; those that are valid by their verdict."""
    kinds = ("valid, proved", "valid, refuted", "invalid", "undecided", "not checked here")
    found = Counter(f"valid, {each.verdict}" if each.result == "valid" else each.result for each in findings)
    return {kind: found[kind] for kind in kinds}


def summary(findings: list[Finding]) -> Iterator[str]:
    """What they come to: a line for all, for each kind of claim and result, for each reason to go elsewhere."""
    found = ", ".join(f"{number} {kind}" for kind, number in counts(findings).items())
    yield f"summary: {len(findings)} claims: {found}"
    kinds: dict[tuple[str, str, str], list[Finding]] = {}
    for each in findings:
        kinds.setdefault((each.claim, each.result, each.verdict), []).append(each)
    for (claim, result, verdict), alike in kinds.items():
        nodes = {each.node for each in alike if isinstance(each.node, int)}
        of = [f"{len(nodes)} distinct nodes"] * bool(nodes) + ["the centre"] * any(e.node == "centre" for e in alike)
        said = result if result == "undecided" else f"{verdict}, {result}"
        yield f"  {claim}: {len(alike)} {said}" + (f", of {' and '.join(of)}" if of else "")
    for reason, number in Counter(each.reason for each in findings if each.result == "not checked here").items():
        yield f"  {number} need tolnet check: {reason}"


def main(arguments: list[str] | None = None, more: Rules | None = None) -> int:
    """Check the certificate that the command line names; `more` are rules of another file."""
    rules = {**RULES, **(more or {})}
    known = dict.fromkeys([*(name for name, _ in RULES), *LOGARITHMIC])
    parser = argparse.ArgumentParser(
        description="Check a certificate, and trust nothing else.", epilog=exit_code.__doc__
    )
    parser.add_argument("certificate", help="the JSON file")
    parser.add_argument("--claims", metavar="A,B", help=f"check these only, of {', '.join(known)}")
    parser.add_argument("--json", action="store_true", help="findings as JSON on standard output")
    options = parser.parse_args(arguments)
    names = None if options.claims is None else options.claims.split(",")
    if unknown := set(names or ()) - known.keys():
        parser.error(f"--claims: expected some of {', '.join(known)}, not {ascii(min(unknown))[:60]}")
    gc.disable()  # nothing here is cyclic, and a large certificate is millions of small objects
    try:
        findings = check(load(options.certificate), rules=rules, names=names)
    except (Refused, MemoryError) as refusal:
        print(ascii(str(refusal) or "out of memory")[1:-1], file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    report = {"schema": "tolnet.check/1", "summary": counts(findings), "findings": list(map(asdict, findings))}
    text = [*map(_line, findings), *(ascii(line)[1:-1] for line in summary(findings))]
    print(json.dumps(report, indent=1) if options.json else "\n".join(text))
    return exit_code(findings)


if __name__ == "__main__":
    sys.exit(main())
