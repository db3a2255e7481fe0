"""T_W, which moves bounds on the second moments of the errors one step on, and what is asked of it.

    T_W(X)_k = sigma_k sum_l w_lk M_l X_l M_l',  sigma_k = sum_l |w_lk|

is linear and positive: its spectral radius is an eigenvalue, with eigenvectors X, Y >= 0 on either side (Krein and
Rutman), and d rho = <Y, dT(X)> / <Y, X> where it is simple. Where it is not dense, T_W acts on svec X, in which
sqrt(2) X_ij, i < j, stand for both halves of X, so that the inner product is that of matrices and T_W* the transpose.
Source: docs/mathematics.md, sections 11.2 and 12.3.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.analysis.curvature import Columns

_DENSE_UP_TO = 120
"""Unknowns up to which all eigenvalues are computed, or a linear equation is solved at once."""
_ARNOLDI_FROM, _EQUATIONS_UP_TO = 300, 1500
"""Unknowns for which Arnoldi's method is tried first, and for which dense equations answer where it fails."""
_ALIKE = 1e-12
"""Cosine of X and Y below which rounding leaves nothing of the slope."""
_POWERS = 20
_FIRST = 1.05
"""The first s, relative to what powers say of the radius."""
_STEPS = 60
_SETTLED = 1e-11
"""A relative step in s below which it is the radius."""
_BEYOND = 0.999
"""Part of a Newton step that is taken, so that s stays above the radius."""


class Perron(NamedTuple):
    """The spectral radius of T_W, and matrices X_k, Y_k near its eigenvectors, T(X) = rho X and T*(Y) = rho Y."""

    radius: float
    X: Float[ndarray, "N n n"]
    Y: Float[ndarray, "N n n"]


class SecondMoments:
    """T_W and its adjoint: diagonal blocks of the errors' second moments, bounded by Cauchy-Schwarz."""

    def __init__(self, columns: Columns, loops: Float[ndarray, "N n n"]) -> None:
        self.columns, self.M = columns, loops
        self.shape = loops.shape
        self.size = loops.size

    @property
    def unknowns(self) -> int:
        """N n (n + 1) / 2: numbers in one X."""
        N, n, _ = self.shape
        return N * n * (n + 1) // 2

    def weighing(self, w: Float[ndarray, " L"]) -> sparse.csr_array:
        """sigma_k w_lk as a matrix, node k's row holding what it weighs."""
        sums = self.columns.sums(np.abs(w))
        N = self.columns.nodes
        scaled = np.abs(w) * sums[self.columns.hearer]
        return sparse.csr_array((scaled, (self.columns.hearer, self.columns.sender)), shape=(N, N))

    def apply(self, weighing: sparse.csr_array, X: Float[ndarray, "N n n"]) -> Float[ndarray, "N n n"]:
        """T_W(X)."""
        moved = self.M @ X @ self.M.mT
        return (weighing @ moved.reshape(len(X), -1)).reshape(self.shape)

    def adjoint(self, weighing: sparse.csr_array, Y: Float[ndarray, "N n n"]) -> Float[ndarray, "N n n"]:
        """T_W*(Y)_l = M_l' (sum_k sigma_k w_lk Y_k) M_l."""
        gathered = (weighing.T @ Y.reshape(len(Y), -1)).reshape(self.shape)
        return self.M.mT @ gathered @ self.M

    def radius(self, w: Float[ndarray, " L"]) -> float:
        """The spectral radius of T_W: r^2 of the best certificate with these weights."""
        from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

        weighing = self.weighing(w)
        if self.unknowns <= _DENSE_UP_TO:
            return float(np.abs(np.linalg.eigvals(self.dense(weighing))).max())
        kind: Any = LinearOperator
        solve: Any = eigs
        operator = kind(
            shape=(self.size, self.size),
            matvec=lambda x: self.apply(weighing, x.reshape(self.shape)).ravel(),
            dtype=np.float64,
        )
        start = np.tile(np.eye(self.shape[1]), (self.shape[0], 1, 1)).ravel()
        try:
            found = solve(operator, k=1, v0=start, ncv=30, maxiter=300, tol=1e-9, return_eigenvectors=False)
        except ArpackNoConvergence:
            return self._by_powers(weighing)
        return float(np.abs(found).max())

    def slope(self, at: Perron) -> Float[ndarray, " L"]:
        """d rho / d w_lk = tr (Y_k M_l X_l M_l') / sum_j tr (Y_j X_j), for columns that sum to one."""
        moved = self.M @ at.X @ self.M.mT
        gained = np.einsum("eij,eij->e", at.Y[self.columns.hearer], moved[self.columns.sender])
        return gained / float(np.vdot(at.X, at.Y))

    def perron(self, w: Float[ndarray, " L"]) -> Perron | None:
        """The spectral radius with both eigenvectors, by Arnoldi's method if that is cheaper; or None."""
        weighing = self.weighing(w)
        found = self._by_arnoldi(weighing) if self.unknowns > _ARNOLDI_FROM else None
        if found is None and self.unknowns <= _EQUATIONS_UP_TO:
            return self._by_equations(weighing)
        return found

    def _by_arnoldi(self, weighing: sparse.csr_array) -> Perron | None:
        """None where it does not converge, or not to matrices of one sign."""
        from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

        kind: Any = LinearOperator
        solve: Any = eigs
        one = np.tile(np.eye(self.shape[1]), (self.shape[0], 1, 1)).ravel()
        radius, sides = 0.0, []
        for apply in (self.apply, self.adjoint):
            operator = kind(
                shape=(self.size, self.size),
                matvec=lambda x, apply=apply: apply(weighing, x.reshape(self.shape)).ravel(),
                dtype=np.float64,
            )
            try:
                values, vectors = solve(operator, k=1, v0=one, ncv=30, maxiter=30, tol=1e-10)
            except ArpackNoConvergence:
                return None
            X = np.real(vectors[:, 0] / np.vdot(one, vectors[:, 0])).reshape(self.shape)
            radius = float(np.abs(values[0]))
            sides.append((X + X.mT) / 2)
        X, Y = sides
        alike = np.vdot(X, Y) > _ALIKE * np.linalg.norm(X) * np.linalg.norm(Y)
        return Perron(radius, X, Y) if alike else None

    def _by_equations(self, weighing: sparse.csr_array) -> Perron | None:
        """By dense linear equations.

            X = (s - T)^-1 I,  Y = (s - T*)^-1 I,  phi(s) = <I, X>,  phi'(s) = -<Y, X>

        X >= 0 exactly where s is above the radius, at which 1 / phi has its zero: Newton's method from above, with
        steps halved that overshoot, from where s was above. X and Y tend to the eigenvectors. None where rounding
        forbids it.
        """
        T = self.dense(weighing)
        one = np.broadcast_to(np.eye(self.shape[1]), self.shape)
        X, grown = one, 0.0
        for _ in range(_POWERS):
            following = self.apply(weighing, X)
            grown = float(np.linalg.norm(following) / np.linalg.norm(X))
            X = following / max(float(np.linalg.norm(following)), np.finfo(float).tiny)
        s, above, step, best = _FIRST * grown, 0.0, 0.0, None
        for _ in range(_STEPS):
            found = self._resolvents(T, s)
            if found is None and best is not None:
                step /= 2
                s = above - step
            elif found is None:
                s *= 2
            else:
                whole = float(np.trace(found[0], axis1=1, axis2=2).sum() / np.vdot(*found))
                best, step = Perron(s - whole, *found), _BEYOND * whole
                above, s = s, s - step
            if best is not None and not step > _SETTLED * above:
                break
            if not 0 < s < np.inf:
                return None
        return best

    def _resolvents(self, T: Float[ndarray, "d d"], s: float) -> tuple[ndarray, ndarray] | None:
        """X and Y at s; None where X is not positive semidefinite: s is not above the radius."""
        from scipy.linalg import get_lapack_funcs

        factor: Any
        solve: Any
        factor, solve = get_lapack_funcs(("getrf", "getrs"), (T,))
        one = self._packed(np.broadcast_to(np.eye(self.shape[1]), self.shape))
        lu, pivots, info = factor(s * np.eye(len(T)) - T)
        if info:
            return None
        X, Y = (self._unpacked(solve(lu, pivots, one, trans=which)[0]) for which in (0, 1))
        if not (np.isfinite(X).all() and np.isfinite(Y).all()):
            return None
        return (X, Y) if min(np.linalg.eigvalsh(X).min(), np.linalg.eigvalsh(Y).min()) > 0 else None

    def resolvent(self, w: Float[ndarray, " L"], s: float, *, adjoint: bool = False) -> Float[ndarray, "N n n"]:
        """X = sum_j T^j(I) / s^j, the least X with X - T(X) / s >= I; for s above the spectral radius.

        NaN where floating point finds none, as at the radius 0.
        """
        from scipy.sparse.linalg import LinearOperator, gmres

        weighing, one = self.weighing(w), np.broadcast_to(np.eye(self.shape[1]), self.shape)
        apply = self.adjoint if adjoint else self.apply
        if not s > 0:
            return np.full(self.shape, np.nan)
        if self.unknowns <= _DENSE_UP_TO:
            T = self.dense(weighing)
            try:
                x = np.linalg.solve(np.eye(len(T)) - (T.T if adjoint else T) / s, self._packed(one))
            except np.linalg.LinAlgError:
                return np.full(self.shape, np.nan)
            return self._unpacked(x)
        kind: Any = LinearOperator
        operator = kind(
            shape=(self.size, self.size),
            matvec=lambda x: x - apply(weighing, x.reshape(self.shape)).ravel() / s,
            dtype=np.float64,
        )
        X, _ = gmres(operator, one.ravel(), rtol=1e-9, restart=80, maxiter=40)
        X = X.reshape(self.shape)
        return (X + X.mT) / 2  # rounding only

    def dense(self, weighing: sparse.csr_array) -> Float[ndarray, "d d"]:
        """T_W as a matrix on svec X, one node after the other."""
        N, d = self.shape[0], self.unknowns
        full = weighing.toarray()[:, None, :, None] * self._moves.transpose(1, 0, 2)[None]
        return full.reshape(d, d) if N else full.reshape(0, 0)

    @cached_property
    def _half(self) -> tuple[ndarray, ndarray, ndarray]:
        """Rows, columns and scales of svec."""
        i, j = np.triu_indices(self.shape[1])
        return i, j, np.where(i == j, 1.0, np.sqrt(2.0))

    @cached_property
    def _moves(self) -> Float[ndarray, "N m m"]:
        """X -> M_l X M_l' on svec X, for every node."""
        i, j, scale = self._half
        units = np.zeros((len(i), *self.shape[1:]))
        units[np.arange(len(i)), i, j] = units[np.arange(len(i)), j, i] = 1 / scale
        moved = self.M[:, None] @ units @ self.M[:, None].mT
        return np.moveaxis(moved[:, :, i, j] * scale, 1, 2)

    def _packed(self, X: Float[ndarray, "N n n"]) -> Float[ndarray, " d"]:
        i, j, scale = self._half
        return (X[:, i, j] * scale).ravel()

    def _unpacked(self, x: Float[ndarray, " d"]) -> Float[ndarray, "N n n"]:
        i, j, scale = self._half
        X = np.empty(self.shape)
        X[:, i, j] = X[:, j, i] = x.reshape(len(X), -1) / scale
        return X

    def _by_powers(self, weighing: sparse.csr_array) -> float:
        X = np.tile(np.eye(self.shape[1]), (self.shape[0], 1, 1))
        grown = np.inf
        for _ in range(2000):
            following = self.apply(weighing, X)
            size = float(np.linalg.norm(following))
            grown = size / float(np.linalg.norm(X))
            if not size > 0:
                break
            X = following / size
        return grown
