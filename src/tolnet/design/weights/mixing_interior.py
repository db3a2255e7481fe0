"""Fastest mixing by a primal-dual interior-point method that knows its own matrices: for some hundred nodes.

    min t   subject to   S_i(x, t) = C_i + t I + sum_e x_e A_ie > 0,   G x >= h,   E x = E x_0

    1.  Z_i S_i = sigma mu I and z_j s_j = sigma mu, linearised: dZ = sigma mu P - Z - Z dS P, symmetrised, P = S^-1
    2.  M d - E'y = right-hand side,  M_ef = sum_i tr(A_ie Z_i A_if P_i) + (G' diag(z / s) G)_ef,  E dx = 0
    3.  a step of most of the way to the boundary, in (x, t) and in (Z, z) apart

A general solver forms S and its products as vectors of N^2 entries. Here every A_ie has two entries or is b_e b_e',
so that M is made of single entries of Z and P: a step costs a few inverses of S and one Cholesky factor of M.
Source: C. Helmberg, F. Rendl, R. J. Vanderbei, H. Wolkowicz, SIAM J. Optimization 6(2):342-361, 1996 (the direction);
docs/mathematics.md, section 12.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular

_MOST, _SHORTEST = 80, 1e-6
_GAP = 1e-8
"""The sum of all tr Z_i S_i and z's at which to stop: what t may be from the least, rounding apart."""
_SHORT_OF = 0.95
"""The part of the way to the boundary that a step goes."""
_DAMPING = (0.0, 1e-14, 1e-12, 1e-10)
"""Added to the scaled M where rounding has made it indefinite: the norm is flat in many weights."""
_REFINED = 2

Matrices = Sequence[Float[ndarray, "d d"]]
Watch = Callable[[str, float], None]


@runtime_checkable
class Program(Protocol):
    """S_i as a function of x and t, and what follows from its shape."""

    @property
    def G(self) -> Float[ndarray, "m x"]: ...
    @property
    def h(self) -> Float[ndarray, " m"]: ...
    @property
    def E(self) -> Float[ndarray, "k x"]: ...

    def matrices(self, x: Float[ndarray, " x"], t: float) -> Matrices:
        """S_i."""
        ...

    def moved(self, dx: Float[ndarray, " x"], dt: float) -> Matrices:
        """dS_i."""
        ...

    def along(self, V: Matrices) -> Float[ndarray, " x1"]:
        """sum_i tr(A_ie V_i) for every e, and sum_i tr V_i."""
        ...

    def normal(self, Z: Matrices, P: Matrices) -> Float[ndarray, "x1 x1"]:
        """sum_i tr(A_ie Z_i A_if P_i), the identity that belongs to t last."""
        ...


class ColumnProgram(NamedTuple):
    """W with columns that sum to one: S = [t I, X; X', t I], X = W - 11'/N, every weight one entry of X."""

    rest: Float[ndarray, "N N"]
    """X with the weights of x at zero."""
    row: Int[ndarray, " x"]
    column: Int[ndarray, " x"]
    h: Float[ndarray, " x"]
    E: Float[ndarray, "N x"]

    @property
    def G(self) -> Float[ndarray, "x x"]:
        """Every weight has its lower bound."""
        return np.eye(len(self.row))

    def matrices(self, x: Float[ndarray, " x"], t: float) -> Matrices:
        """The one matrix S."""
        return [self._joined(x, t, self.rest)]

    def moved(self, dx: Float[ndarray, " x"], dt: float) -> Matrices:
        """Its change."""
        return [self._joined(dx, dt, np.zeros_like(self.rest))]

    def _joined(self, x: Float[ndarray, " x"], t: float, rest: Float[ndarray, "N N"]) -> Float[ndarray, "d d"]:
        one, X = t * np.eye(len(rest)), rest.copy()
        X[self.row, self.column] += x
        return np.block([[one, X], [X.T, one]])

    def along(self, V: Matrices) -> Float[ndarray, " x1"]:
        """A_e = e_a e_b' + e_b e_a' with a the row and b = N + the column."""
        return np.append(2 * V[0][self.row, len(self.rest) + self.column], np.trace(V[0]))

    def normal(self, Z: Matrices, P: Matrices) -> Float[ndarray, "x1 x1"]:
        """tr(A_e Z A_f P) from four products of entries."""
        a, b = self.row, len(self.rest) + self.column
        (Z0,), (P0,) = Z, P
        M = Z0[np.ix_(b, b)] * P0[np.ix_(a, a)] + Z0[np.ix_(a, a)] * P0[np.ix_(b, b)]
        crossed = Z0[np.ix_(b, a)] * P0[np.ix_(a, b)]
        ZP = Z0 @ P0
        return _bordered(M + crossed + crossed.T, ZP[a, b] + ZP[b, a], np.trace(ZP))


class LinkProgram(NamedTuple):
    """Symmetric W = I - sum_e x_e b_e b_e': S_1 = t I - X, S_2 = t I + X, X = W - 11'/N."""

    difference: Float[ndarray, "N x"]
    """The columns b_e: +1 and -1 at the two ends of a link."""
    room: Float[ndarray, " N"]
    """What the links of a node may weigh together."""

    @property
    def G(self) -> Float[ndarray, "m x"]:
        """x >= 0, and at every node with links what is left of the room."""
        ends = np.abs(self.difference)
        return np.concatenate([np.eye(ends.shape[1]), -ends[ends.any(axis=1)]])

    @property
    def h(self) -> Float[ndarray, " m"]:
        """The right-hand sides."""
        return np.concatenate([np.zeros(self.difference.shape[1]), -self.room[self.difference.any(axis=1)]])

    @property
    def E(self) -> Float[ndarray, "k x"]:
        """Columns sum to one by themselves."""
        return np.zeros((0, self.difference.shape[1]))

    def matrices(self, x: Float[ndarray, " x"], t: float) -> Matrices:
        """t I - X and t I + X."""
        one, N = np.eye(len(self.room)), len(self.room)
        X = one - (self.difference * x) @ self.difference.T - 1 / N
        return [t * one - X, t * one + X]

    def moved(self, dx: Float[ndarray, " x"], dt: float) -> Matrices:
        """Their changes."""
        one, less = np.eye(len(self.room)), (self.difference * dx) @ self.difference.T
        return [dt * one + less, dt * one - less]

    def along(self, V: Matrices) -> Float[ndarray, " x1"]:
        """A_1e = b_e b_e' = -A_2e."""
        b = self.difference
        return np.append(np.einsum("ne,ne->e", b, (V[0] - V[1]) @ b), np.trace(V[0]) + np.trace(V[1]))

    def normal(self, Z: Matrices, P: Matrices) -> Float[ndarray, "x1 x1"]:
        """(b_e'Z b_f)(b_f'P b_e)."""
        b = self.difference
        ZP = [one @ other for one, other in zip(Z, P, strict=True)]
        M = sum(((b.T @ one @ b) * (b.T @ other @ b) for one, other in zip(Z, P, strict=True)), np.zeros(()))
        edge = np.einsum("ne,ne->e", b, (ZP[0] - ZP[1]) @ b)
        return _bordered(M, edge, np.trace(ZP[0]) + np.trace(ZP[1]))


def _bordered(M: Float[ndarray, "x x"], edge: Float[ndarray, " x"], corner: float) -> Float[ndarray, "x1 x1"]:
    return np.block([[M, edge[:, None]], [edge[None], np.full((1, 1), corner)]])


class _Point(NamedTuple):
    """Where the method is, or how that changes."""

    x: Float[ndarray, " x"]
    t: float
    S: Matrices
    s: Float[ndarray, " m"]
    Z: Matrices
    z: Float[ndarray, " m"]

    @property
    def gap(self) -> float:
        """sum_i tr Z_i S_i + z's."""
        return sum(float(np.vdot(Z, S)) for S, Z in zip(self.S, self.Z, strict=True)) + float(self.s @ self.z)

    def after(self, d: _Point, forward: float, dual: float) -> _Point:
        """A step along d, its length in (x, t) and that in (Z, z)."""
        S = [each + forward * change for each, change in zip(self.S, d.S, strict=True)]
        Z = [each + dual * change for each, change in zip(self.Z, d.Z, strict=True)]
        x, t = self.x + forward * d.x, self.t + forward * d.t
        return _Point(x, t, S, self.s + forward * d.s, Z, self.z + dual * d.z)

    def room(self, d: _Point) -> tuple[float, float]:
        """How long steps along d may be."""
        return _length(self.S, d.S, self.s, d.s), _length(self.Z, d.Z, self.z, d.z)


def solve_program_inside(
    program: Program, x: Float[ndarray, " x"], t: float, watch: Watch
) -> tuple[Float[ndarray, " x"], Matrices]:
    """x with the least t, and the dual matrices Z_i, from an (x, t) strictly inside.

    Ends at a gap of 1e-8, or as near as rounding lets it come: what has been reached is for the caller to recompute.
    """
    S, s = program.matrices(x, t), program.G @ x - program.h
    size = sum(map(len, S))
    at = _Point(x, t, S, s, [np.eye(len(each)) / size for each in S], t / size / s)
    for _ in range(_MOST):
        watch("interior points", at.t)
        if at.gap <= _GAP:
            break
        try:
            step = _step(program, at, size + len(s))
            lengths = at.room(step)
        except LinAlgError:  # as near as rounding lets it come
            break
        if max(lengths) < _SHORTEST:
            break
        at = at.after(step, *lengths)
    return at.x, at.Z


def _step(program: Program, at: _Point, degree: int) -> _Point:
    """Mehrotra's: where sigma = 0 leads says how much sigma must be, and what the linearisation leaves out."""
    P = [_inverse(S) for S in at.S]
    M = program.normal(at.Z, P)
    M[:-1, :-1] += (program.G.T * (at.z / at.s)) @ program.G
    solve = _solver(M, program.E)
    none = [np.zeros_like(S) for S in at.S]

    def direction(target: float, left_out: Matrices, left: Float[ndarray, " m"]) -> _Point:
        wanted = [target * p - extra for p, extra in zip(P, left_out, strict=True)]
        more = (target - left) / at.s
        right = program.along(wanted)
        right[:-1] += program.G.T @ more
        right[-1] -= 1.0
        d = solve(right)
        dS, ds = program.moved(d[:-1], float(d[-1])), program.G @ d[:-1]
        dZ = [w - Z - _symmetric(Z @ change @ p) for w, Z, change, p in zip(wanted, at.Z, dS, P, strict=True)]
        return _Point(d[:-1], float(d[-1]), dS, ds, dZ, more - at.z - at.z * ds / at.s)

    first = direction(0.0, none, np.zeros_like(at.s))
    reached = at.after(first, *at.room(first)).gap
    sigma = min(1.0, max(reached / at.gap, 0.0) ** 2)
    left_out = [_symmetric(dZ @ dS @ p) for dZ, dS, p in zip(first.Z, first.S, P, strict=True)]
    return direction(sigma * at.gap / degree, left_out, first.z * first.s)


def _solver(M: Float[ndarray, "x1 x1"], E: Float[ndarray, "k x"]) -> Callable[[ndarray], Float[ndarray, " x1"]]:
    """r -> d with M d - E'y = r and E d = 0, the unknowns scaled by the diagonal of M; refined once or twice.

    Raises LinAlgError where M is not numerically definite, even with a little added.
    """
    scale = 1 / np.sqrt(np.diagonal(M))
    scaled, factor = M * scale * scale[:, None], None
    for damping in _DAMPING:
        try:
            factor = cho_factor(scaled + damping * np.eye(len(M)), check_finite=False)
            break
        except LinAlgError:
            continue
    if factor is None:
        raise LinAlgError("not positive definite")
    rows = np.concatenate([E, np.zeros((len(E), 1))], axis=1) * scale
    through = cho_solve(factor, rows.T)
    small = rows @ through

    def once(r: Float[ndarray, " x1"], e: Float[ndarray, " k"]) -> tuple[ndarray, ndarray]:
        d = cho_solve(factor, r)
        y = np.linalg.solve(small, e - rows @ d) if len(E) else np.zeros(0)
        return d + through @ y, y

    def solve(right: Float[ndarray, " x1"]) -> Float[ndarray, " x1"]:
        r = right * scale
        d, y = once(r, np.zeros(len(E)))
        for _ in range(_REFINED):
            more, other = once(r - scaled @ d + rows.T @ y, -rows @ d)
            d, y = d + more, y + other
        return d * scale

    return solve


def _length(S: Matrices, dS: Matrices, s: Float[ndarray, " m"], ds: Float[ndarray, " m"]) -> float:
    """Most of the way to where S + length dS or s + length ds meets its boundary, at most 1."""
    most = float(np.min(np.where(ds < 0, -s / np.where(ds < 0, ds, -1.0), np.inf), initial=np.inf))
    for each, change in zip(S, dS, strict=True):
        factor = np.linalg.cholesky(each)
        half = solve_triangular(factor, change, lower=True, check_finite=False)
        seen = solve_triangular(factor, half.T, lower=True, check_finite=False)
        least = float(np.linalg.eigvalsh(_symmetric(seen))[0])
        most = min(most, -1 / least if least < 0 else np.inf)
    return min(1.0, _SHORT_OF * most)


def _inverse(S: Float[ndarray, "d d"]) -> Float[ndarray, "d d"]:
    return _symmetric(np.linalg.inv(S))


def _symmetric(X: Float[ndarray, "d d"]) -> Float[ndarray, "d d"]:
    """The symmetric part: of what is symmetric but for rounding, and of the direction, line 1."""
    return (X + X.T) / 2
