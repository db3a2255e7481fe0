"""What a plant of doubles hides exactly: the unobservable subspace in rational arithmetic, and its eigenvalues.

    N = ker [C; C A; ...; C A^(n-1)],   A X = X A_N   for a basis X of N

Doubles are rational numbers, so N, A_N and its characteristic polynomial are exact; its roots come in balls that
are proved to hold one each (FLINT; F. Johansson, IEEE Trans. Computers 66, 2017).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.linalg import eig

from tolnet.analysis.state_units import UNIT, components, rounding, state_units

if TYPE_CHECKING:
    from flint import fmpq_mat as Rational
    from flint import fmpz_poly as Polynomial

_PRIMES = (2**61 - 1, 2**62 - 57, 2**63 - 25)
"""A rank modulo a prime is at most the rank; it is less for one prime in about 1e18, and then the next is taken."""
_ROOT_BITS = 160
_ROWS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Eigenvalue:
    """An eigenvalue of a rational matrix, one of the roots of an irreducible factor of its polynomial."""

    value: complex
    excess: float
    """|lambda| - 1, of full relative accuracy next to the circle, where that of `value` has none."""
    margin: float
    """How far the rounding of the matrix may have moved |lambda|."""
    factor: Polynomial
    multiplicity: int
    """How often the factor divides the characteristic polynomial of the whole matrix."""


@dataclass(frozen=True, eq=False)
class ExactSubspace:
    """An invariant subspace in echelon form: x = X z has x_free = z and x_rest = Z z."""

    free: Int[ndarray, " r"]
    rest: Int[ndarray, " s"]
    Z: Rational
    A_N: Rational

    @property
    def X(self) -> Float[ndarray, "n r"]:
        """The basis in doubles."""
        return self.lifted(_identity(len(self.free)))

    def lifted(self, basis: Rational) -> Float[ndarray, "n m"]:
        """Vectors of the subspace, columns of coordinates z, as vectors of states in doubles."""
        X = np.zeros((len(self.free) + len(self.rest), basis.ncols()))
        X[self.free] = to_doubles(basis)
        X[self.rest] = to_doubles(self.Z * basis)
        return X

    def quotient(self, A: Float[ndarray, "n n"]) -> Float[ndarray, "s s"]:
        """A modulo the subspace, on y = x_rest - Z x_free: exact but for the last rounding."""
        own, above = (rational(A[np.ix_(rows, self.rest)]) for rows in (self.rest, self.free))
        return to_doubles(own - self.Z * above)


def unobservable(A: Float[ndarray, "n n"], C: Float[ndarray, "p n"]) -> ExactSubspace | None:
    """The exact unobservable subspace of (A, C); None where there is none but zero. Assumes finite entries."""
    n = len(A)
    C = np.unique(C[C.any(axis=1)], axis=0)
    plant, rows = integers(A)[0], [integers(row[None])[0][0] for row in C]
    for prime in _PRIMES:
        chosen = _independent_rows(rows, n, prime)
        if _observability_rank(plant, [rows[i] for i in chosen], prime) == n:
            return None
        found = _kernel(A, plant, rows, chosen, prime)
        if found is not None:
            return found
    raise ArithmeticError("three primes in a row divide minors of one observability matrix")


def eigenvalues(M: Rational) -> list[Eigenvalue]:
    """The distinct eigenvalues of a rational matrix, each of a conjugate pair once, largest modulus first."""
    table = M.table()
    label = components(np.array([[entry != 0 for entry in row] for row in table]).reshape(len(table), len(table)))
    found: dict[tuple[str, int], Eigenvalue] = {}
    for J in range(int(label.max(initial=-1)) + 1):
        own = np.flatnonzero(label == J)
        block = _from_rows([[table[i][j] for j in own] for i in own], len(own))
        factors = block.charpoly().numer().factor()[1]
        roots = [(factor, power, *root) for factor, power in factors for root in enumerate(_roots(factor))]
        conditions = _Conditions(to_doubles(block), [value for _, _, _, (value, _) in roots])
        for factor, power, i, (value, excess) in roots:
            known = found.get((str(factor), i))
            found[str(factor), i] = Eigenvalue(
                value,
                excess,
                max(conditions.margin(value, power == 1), known.margin if known else 0.0),
                factor,
                power + (known.multiplicity if known else 0),
            )
    return sorted((root for root in found.values() if root.value.imag >= 0), key=lambda root: -root.excess)


def _roots(factor: Polynomial) -> list[tuple[complex, float]]:
    """All roots lambda of an irreducible polynomial, and |lambda| - 1."""
    from flint import ctx

    before = ctx.prec
    try:
        ctx.prec = _ROOT_BITS
        balls: Any = factor.complex_roots()  # each with its multiplicity, which is one
        return [
            (complex(float(root.real.mid()), float(root.imag.mid())), float((abs(root) - 1).mid()))
            for root, _ in balls
        ]
    finally:
        ctx.prec = before


class _Conditions:
    """How far rounding moves the eigenvalues of an irreducible matrix."""

    def __init__(self, B: Float[ndarray, "m m"], values: list[complex]) -> None:
        self._values = np.array(values)
        self._rounding = rounding(len(B))
        if len(B) > 1:
            d = state_units(B, np.empty((0, len(B))))
            B = B * (d / d[:, None])
            parts: Any = eig(B, left=True)
            self._found, left, right = parts
            # Columns have length one: a change of size one moves the eigenvalue by 1 / |w* x| to first order.
            moved = np.abs((left.conj() * right).sum(axis=0))
            self._moves = np.linalg.norm(B) / np.maximum(moved, UNIT)

    def margin(self, value: complex, simple: bool) -> float:
        """What rounding moves it by; where that is no small share of the distance to the next, it counts as exact.

        A number that rounds to one is still taken for one.
        """
        if not simple or len(self._values) == 1:
            return self._rounding
        moved = float(self._rounding * self._moves[np.abs(self._found - value).argmin()])
        gap = np.partition(np.abs(self._values - value), 1)[1]
        return max(moved, self._rounding) if moved < gap / 2 else self._rounding


def eigenspace(M: Rational, root: Eigenvalue) -> Rational:
    """A basis of ker f(M) for the factor f of an eigenvalue: columns, in echelon form."""
    return _basis_of_kernel(_at(root.factor, M))


def generalised_eigenspace(M: Rational, root: Eigenvalue) -> Rational:
    """A basis of ker f(M)^m for the factor f of an eigenvalue and its multiplicity m: columns, in echelon form."""
    if root.factor.degree() * root.multiplicity == M.nrows():
        return _identity(M.nrows())
    return _basis_of_kernel(_at(root.factor**root.multiplicity, M))


def _at(polynomial: Polynomial, M: Rational) -> Rational:
    """The polynomial of a matrix (Horner)."""
    value = _identity(M.nrows()) * 0
    for coefficient in reversed(polynomial.coeffs()):
        value = value * M + _identity(M.nrows()) * coefficient
    return value


def _basis_of_kernel(M: Rational) -> Rational:
    free, rest, Z = _kernel_of(M)
    where = {int(row): i for i, row in enumerate(rest)} | {int(row): -1 - i for i, row in enumerate(free)}
    own, others = _identity(len(free)).table(), Z.table()
    rows = [others[where[i]] if where[i] >= 0 else own[-1 - where[i]] for i in range(M.nrows())]
    return _from_rows(rows, len(free))


def integers(M: Float[ndarray, "p n"]) -> tuple[list[list[int]], int]:
    """Whole numbers m and one exponent e with M = m 2^e exactly."""
    ratios = [[entry.as_integer_ratio() for entry in row] for row in M.tolist()]
    bits = max((below.bit_length() - 1 for row in ratios for _, below in row), default=0)
    return [[above << (bits - below.bit_length() + 1) for above, below in row] for row in ratios], -bits


def rational(M: Float[ndarray, "p n"]) -> Rational:
    """A matrix of doubles as the rational numbers that they are."""
    from flint import fmpq, fmpq_mat

    p, n = M.shape
    return fmpq_mat(p, n, [fmpq(*entry.as_integer_ratio()) for entry in M.ravel().tolist()])


def to_doubles(M: Rational) -> Float[ndarray, "p n"]:
    """The nearest doubles."""
    entries = [float(Fraction(int(entry.p), int(entry.q))) for entry in M.entries()]
    return np.array(entries, dtype=float).reshape(M.nrows(), M.ncols())


def _independent_rows(rows: list[list[int]], n: int, prime: int) -> list[int]:
    """Which rows to keep so that the others depend on them modulo the prime."""
    from flint import nmod_mat

    chosen: list[int] = []
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        tried = [*chosen, *range(start, min(start + _ROWS_AT_ONCE, len(rows)))]
        columns = [entry % prime for j in range(n) for entry in (rows[i][j] for i in tried)]
        chosen = [tried[pivot] for pivot in _pivots(nmod_mat(n, len(tried), columns, prime))]
        if len(chosen) == n:
            break
    return chosen


def _pivots(M: Any) -> list[int]:
    """The columns of the pivots of the reduced echelon form."""
    reduced, rank = M.rref()
    table, found, j = reduced.table(), [], 0
    for i in range(rank):
        while table[i][j] == 0:
            j += 1
        found.append(j)
    return found


def _observability_rank(plant: list[list[int]], rows: list[list[int]], prime: int) -> int:
    """The rank of [C; C A; ...] modulo the prime. Powers of two that scale A or a row change nothing."""
    from flint import nmod_mat

    n = len(plant)
    A = nmod_mat(n, n, [entry % prime for row in plant for entry in row], prime)
    V, rank = nmod_mat(len(rows), n, [entry % prime for row in rows for entry in row], prime), len(rows)
    while 0 < rank < n:
        both = V.table() + (V * A).table()
        reduced, following = nmod_mat(len(both), n, [int(entry) for row in both for entry in row], prime).rref()
        if following == rank:
            break
        rank = following
        V = nmod_mat(rank, n, [int(entry) for row in reduced.table()[:rank] for entry in row], prime)
    return rank


def _kernel(
    A: Float[ndarray, "n n"], plant: list[list[int]], rows: list[list[int]], chosen: list[int], prime: int
) -> ExactSubspace | None:
    """The kernel of the rows C A^j that are independent modulo the prime, where A maps it into itself and C to zero.

    Those rows are independent, so the kernel holds N; and a space that A maps into itself and C to zero lies in N.
    """
    from flint import fmpq_mat, fmpz_mat

    n = len(plant)
    whole = fmpz_mat(n, n, [entry for row in plant for entry in row])
    kept = [rows[i] for i in chosen]
    frontier = list(kept)
    while frontier and len(kept) < n:
        following = (fmpz_mat(len(frontier), n, [entry for row in frontier for entry in row]) * whole).table()
        candidates = [*kept, *([int(entry) for entry in row] for row in following)]
        independent = _independent_rows(candidates, n, prime)
        frontier = [_primitive(candidates[i]) for i in independent if i >= len(kept)]
        kept += frontier
    free, rest, Z = _kernel_of(fmpq_mat(len(kept), n, [entry for row in kept for entry in row]))
    own, on = rational(A[free]), rational(A[rest])
    A_N = _columns(own, free) + _columns(own, rest) * Z
    if _columns(on, free) + _columns(on, rest) * Z != Z * A_N:
        return None
    C = fmpq_mat(len(rows), n, [entry for row in rows for entry in row])
    seen = _columns(C, free) + _columns(C, rest) * Z
    return None if any(entry != 0 for entry in seen.entries()) else ExactSubspace(free, rest, Z, A_N)


def _primitive(row: list[int]) -> list[int]:
    divisor = math.gcd(*row) or 1
    return [entry // divisor for entry in row]


def _kernel_of(M: Rational) -> tuple[Int[ndarray, " r"], Int[ndarray, " s"], Rational]:
    """The kernel in echelon form: its free coordinates, the others, and Z with x_others = Z x_free."""
    reduced, rank = M.rref()
    rest = np.array(_pivots(M), dtype=np.int64)
    free = np.setdiff1d(np.arange(M.ncols()), rest)
    table = reduced.table()
    return free, rest, _from_rows([[-table[i][j] for j in free] for i in range(rank)], len(free))


def _columns(M: Rational, which: Int[ndarray, " k"]) -> Rational:
    return _from_rows([[row[j] for j in which] for row in M.table()], len(which))


def _from_rows(rows: list[list[Any]], columns: int) -> Rational:
    from flint import fmpq_mat

    return fmpq_mat(len(rows), columns, [entry for row in rows for entry in row])


def _identity(n: int) -> Rational:
    return _from_rows([[int(i == j) for j in range(n)] for i in range(n)], n)
