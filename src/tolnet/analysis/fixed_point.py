"""The covariance recursion as a map P -> T_c(P), its derivative, and Newton's method on P = T_c(P).

1.  P = U diag(lambda) U',  V = U diag(v) U',  v_i = lambda_i (1 + mu_i) with mu from gamma(P, theta) = c
2.  Z = (V^-1 + S)^-1 = U diag(w)^1/2 (I + diag(w)^1/2 offdiag(U'SU) diag(w)^1/2)^-1 diag(w)^1/2 U',
    w_i = 1 / (1 / v_i + (U'SU)_ii): no large number is ever subtracted from another, however large V
3.  T_c(P) = A Z A' + Q
4.  dT = A Z (-d V^-1) Z A',  with E = U' dP U:  (U' (-d V^-1) U)_ij = q_ij E_ij + [i = j] t_i dtheta,
    tau = 0: q_ij = 1 / (lambda_i lambda_j), t = 1;  else divided differences of -1 / v, t = (1 + mu)^-tau
5.  dtheta = -sum_i a_i E_ii from d gamma = 0,  a_i = theta h_i / sum_j h_j lambda_j,  h_i = d gamma / d s_i
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.analysis import stacked
from tolnet.analysis.divergence import inflate

DENSE_UP_TO = 12
"""States up to which the derivative is formed as a matrix on symmetric matrices, n (n + 1) / 2 square."""

_EPS = np.finfo(float).eps
_NO_VARIANCE = 1e-80
_SINGULAR = 1e-12  # how far below zero rounding may take the least eigenvalue of a covariance of unit diagonal


@dataclass(frozen=True, eq=False)
class Recursion:
    """A stack of covariance recursions that share A, Q: node's information S and tolerance c."""

    A: Float[ndarray, "n n"]
    Q: Float[ndarray, "n n"]
    S: Float[ndarray, "K n n"]
    tolerance: Float[ndarray, " K"]
    tau: float = 0.0
    undriven: bool = False
    """Whether A has modes outside the unit circle that Q does not drive."""

    @property
    def start(self) -> Float[ndarray, "n n"] | None:
        """From where doubling reaches the stabilising solution: zero (None) where Q drives all that grows."""
        return np.eye(len(self.A)) if self.undriven else None

    def part(self, index: ndarray) -> Recursion:
        """The members at `index`."""
        return replace(self, S=self.S[index], tolerance=self.tolerance[index])

    def at(self, tolerance: Float[ndarray, " K"]) -> Recursion:
        """The same recursions at other tolerances."""
        return replace(self, tolerance=tolerance)


class Inflated(NamedTuple):
    """V = U diag(lambda (1 + mu)) U' of P = U diag(lambda) U', kept in the eigenbasis (line 1)."""

    eigenvalues: Float[ndarray, "K n"]
    U: Float[ndarray, "K n n"]
    theta: Float[ndarray, " K"]
    excess: Float[ndarray, "K n"]

    @property
    def V(self) -> Float[ndarray, "K n n"]:
        """V itself."""
        v = self.eigenvalues * (1 + self.excess)
        return stacked.symmetric_part((self.U * v[:, None, :]) @ self.U.mT)


def inflate_covariance(P: Float[ndarray, "K n n"], tolerance: Float[ndarray, " K"], tau: float = 0.0) -> Inflated:
    """V from gamma(P, theta) = c (line 1); c = 0 leaves V = P."""
    eigenvalues, U = stacked.symmetric_eigen(P)
    # A singular P is carried as one whose null eigenvalues are a hair above zero: too little to change any sum.
    eigenvalues = np.maximum(eigenvalues, 1e-100 * np.abs(eigenvalues[:, -1:]) + 1e-150)
    theta, excess = inflate(eigenvalues, tolerance, tau)
    return Inflated(eigenvalues, U, theta, excess)


class Filtered(NamedTuple):
    """Z = (V^-1 + S)^-1 in the eigenbasis of V (line 2); one V may serve a stack of S."""

    Z: Float[ndarray, "K n n"]
    """U' Z U."""
    AU: Float[ndarray, "#K n n"]
    AZ: Float[ndarray, "K n n"]
    """A Z U: maps the eigenbasis into the state."""

    def part(self, index: ndarray) -> Filtered:
        """The members at `index`."""
        return Filtered(*(value[index] for value in self))


def filter_information(A: Float[ndarray, "n n"], S: Float[ndarray, "K n n"], at: Inflated) -> Filtered:
    """Z, and A U and A Z U, so that A Z A' is the product of the latter (line 2)."""
    AU = A @ at.U
    information = at.U.mT @ S @ at.U
    diagonal = np.einsum("kii->ki", information)
    w = np.sqrt(1.0 / (1.0 / (at.eigenvalues * (1 + at.excess)) + diagonal))
    unit = w[:, :, None] * information * w[:, None, :]
    np.einsum("kii->ki", unit)[...] = 1.0
    Z = w[:, :, None] * stacked.solve(unit, np.eye(len(A)) * w[:, None, :])
    return Filtered(Z, AU, AU @ Z)


def predict(
    A: Float[ndarray, "n n"], Q: Float[ndarray, "n n"], S: Float[ndarray, "K n n"], at: Inflated
) -> Float[ndarray, "K n n"]:
    """A (V^-1 + S)^-1 A' + Q (line 3)."""
    filtered = filter_information(A, S, at)
    return stacked.symmetric_part(filtered.AZ @ filtered.AU.mT) + Q


class Step(NamedTuple):
    """One step of the recursion from P, with all that its derivative needs (lines 1 to 3)."""

    following: Float[ndarray, "K n n"]
    at: Inflated
    filtered: Filtered

    def part(self, index: ndarray) -> Step:
        """The members at `index`."""
        at = Inflated(*(value[index] for value in self.at))
        return Step(self.following[index], at, self.filtered.part(index))


def step(recursion: Recursion, P: Float[ndarray, "K n n"]) -> Step:
    """T_c(P) = A (V^-1 + S)^-1 A' + Q with V from gamma(P, theta) = c (lines 1 to 3)."""
    at = inflate_covariance(P, recursion.tolerance, recursion.tau)
    filtered = filter_information(recursion.A, recursion.S, at)
    return Step(stacked.symmetric_part(filtered.AZ @ filtered.AU.mT) + recursion.Q, at, filtered)


class Derivative(NamedTuple):
    """dT = K (q * E) K' + thrust dtheta,  dtheta = -sum a_i E_ii, in coordinates in which P = I (lines 4, 5).

    dP = basis E basis', basis = U r^1/2 with r_i = lambda_i; where lambda_i is less than the rounding of P, r_i is
    that. So no unit of a state and no direction in which P is small outweighs the others.
    """

    U: Float[ndarray, "K n n"]
    root: Float[ndarray, "K n"]
    """r^1/2."""
    loop: Float[ndarray, "K n n"]
    """K = A Z P^-1 in these coordinates: the loop at fixed theta (tau = 0)."""
    q: Float[ndarray, "K n n"]
    """1 for tau = 0, where the derivative is K dP K' plus rank one; near 1 else."""
    thrust: Float[ndarray, "K n n"]
    a: Float[ndarray, "K n"]
    separable: bool
    """Whether q is 1."""

    def part(self, index: ndarray) -> Derivative:
        """The members at `index`."""
        return Derivative(*(value[index] for value in self[:-1]), separable=self.separable)

    def into(self, dP: Float[ndarray, "K n n"]) -> Float[ndarray, "K n n"]:
        """E of dP."""
        return (self.U.mT @ dP @ self.U) / (self.root[:, :, None] * self.root[:, None, :])

    def out_of(self, E: Float[ndarray, "K n n"]) -> Float[ndarray, "K n n"]:
        """dP of E."""
        basis = self.U * self.root[:, None, :]
        return basis @ E @ basis.mT

    def dtheta(self, E: Float[ndarray, "K n n"]) -> Float[ndarray, " K"]:
        """What theta does when P moves by E at a fixed tolerance."""
        return -np.einsum("ki,kii->k", self.a, E)

    def apply(self, E: Float[ndarray, "K n n"]) -> Float[ndarray, "K n n"]:
        """The derivative in the direction E."""
        return self.loop @ (self.q * E) @ self.loop.mT + self.dtheta(E)[:, None, None] * self.thrust

    def matrix(self) -> Float[ndarray, "K d d"]:
        """The derivative as a matrix on symmetric matrices, d = n (n + 1) / 2.

        Coordinates E_ii and sqrt(2) E_ij (i < j), so that the Euclidean norm is the Frobenius norm.
        """
        L = self.loop
        n = L.shape[-1]
        i, j = np.triu_indices(n)
        root = np.where(i == j, 1.0, np.sqrt(2.0))
        left, right = L[:, i[:, None], i], L[:, j[:, None], j]
        crossed = L[:, i[:, None], j] * L[:, j[:, None], i]
        half = np.where(i == j, 0.5, 1.0)
        full = (left * right + crossed) * (half * root[:, None] / root) * self.q[:, i, j][:, None, :]
        diagonal = np.flatnonzero(i == j)
        full[:, :, diagonal] -= (self.thrust[:, i, j] * root)[:, :, None] * self.a[:, None, :]
        return full


def derivative(recursion: Recursion, taken: Step) -> Derivative:
    """The derivative of T_c at the point of a step (lines 4 and 5)."""
    at, tau = taken.at, recursion.tau
    lam, kappa = at.eigenvalues, 1 + at.excess
    theta = at.theta[:, None]
    h = at.excess * kappa if tau == 0 else kappa ** (2 - tau) * _log_ratio(kappa, tau)
    h = h / np.maximum(h.max(axis=-1, keepdims=True), np.finfo(float).tiny)
    weight = (h * lam).sum(axis=-1, keepdims=True)
    a = np.where(theta > 0, theta * h / np.where(weight > 0, weight, 1.0), 0.0)
    q = np.ones_like(at.U)
    t = np.ones_like(lam)
    if tau != 0:
        t = kappa**-tau
        inverse, slope = 1.0 / (lam * kappa), 1.0 / (lam**2 * kappa) + theta * t / lam
        distance = lam[:, :, None] - lam[:, None, :]
        near = np.abs(distance) <= 1e-5 * (lam[:, :, None] + lam[:, None, :])
        quotient = (inverse[:, None, :] - inverse[:, :, None]) / np.where(near, 1.0, distance)
        q = np.where(near, (slope[:, :, None] + slope[:, None, :]) / 2, quotient)
        q = q * lam[:, :, None] * lam[:, None, :]
    r = np.maximum(lam, _EPS * uncancelled(at))
    root = np.sqrt(r)
    L = (at.U.mT @ taken.filtered.AZ) / root[:, :, None]
    loop = L * (root / lam)[:, None, :]
    return Derivative(at.U, root, loop, q, (L * t[:, None, :]) @ L.mT, a * r, separable=tau == 0)


def uncancelled(at: Inflated) -> Float[ndarray, "K n"]:
    """(|U|' p)_i^2 with p the standard deviations of the states under P: lambda_i if nothing cancelled in U' P U."""
    variance = np.einsum("kij,kj,kij->ki", at.U, at.eigenvalues, at.U)
    return np.einsum("kji,kj->ki", np.abs(at.U), np.sqrt(np.maximum(variance, 0.0))) ** 2


def _log_ratio(kappa: ndarray, tau: float) -> ndarray:
    """(1 - kappa^(tau - 1)) / (1 - tau), log kappa at tau = 1: d gamma / d kappa of one eigenvalue."""
    return np.log(kappa) if tau == 1 else -np.expm1((tau - 1) * np.log(kappa)) / (1 - tau)


def newton_direction(slope: Derivative, defect: Float[ndarray, "K n n"]) -> Float[ndarray, "K n n"]:
    """Solve dP - T'(dP) = defect for symmetric dP."""
    return slope.out_of(resolve(slope, slope.into(defect)))


def resolve(slope: Derivative, right: Float[ndarray, "K n n"]) -> Float[ndarray, "K n n"]:
    """Solve E - T'(E) = right for symmetric E, in the coordinates of the derivative.

    As a matrix for few states. For more, through the Stein equation of the loop K (line 4 with tau = 0):
    X - K X K' = right and Y - K Y K' = thrust, then E = X + dtheta Y with dtheta = -a(X) / (1 + a(Y)).
    """
    n = right.shape[-1]
    if n <= DENSE_UP_TO or not slope.separable:
        i, j = np.triu_indices(n)
        root = np.where(i == j, 1.0, np.sqrt(2.0))
        e = stacked.solve(np.eye(len(i)) - slope.matrix(), (right[:, i, j] * root)[:, :, None])[:, :, 0] / root
        E = np.empty_like(right)
        E[:, i, j] = E[:, j, i] = e
        return E
    X, Y = _stein(slope.loop, right), _stein(slope.loop, slope.thrust)
    pull_X, pull_Y = slope.dtheta(X), slope.dtheta(Y)
    return X + (pull_X / (1 - pull_Y))[:, None, None] * Y


def _stein(K: Float[ndarray, "K n n"], R: Float[ndarray, "K n n"]) -> Float[ndarray, "K n n"]:
    """Solve X - K X K' = R through the eigenvectors of K, Schur or not (Newton forgives their rounding)."""
    finite = stacked.finite_members(K)
    d, T = np.linalg.eig(np.where(finite[:, None, None], K, 0.0))
    inner = stacked.solve(T, stacked.solve(T, R.astype(T.dtype)).conj().mT).conj().mT
    X = (T @ (inner / (1 - d[:, :, None] * d.conj()[:, None, :])) @ T.conj().mT).real
    return np.where(finite[:, None, None], stacked.symmetric_part(X), np.nan)


class Converged(NamedTuple):
    """Where Newton's method ended: the best P seen, its defect |T_c(P) - P| / |P|, and the steps taken."""

    P: Float[ndarray, "K n n"]
    residual: Float[ndarray, " K"]
    steps: Int[ndarray, " K"]


def newton(recursion: Recursion, P: Float[ndarray, "K n n"], *, most: int = 30) -> Converged:
    """Newton's method for P = T_c(P) from P, for every member of the stack until its defect stops falling.

    A step that would leave the covariances is replaced by a step of the recursion itself.
    """
    K, n, _ = P.shape
    best, residual = P.copy(), np.full(K, np.inf)
    steps = np.zeros(K, dtype=np.int64)
    todo, stalls = np.arange(K), np.zeros(K, dtype=np.int64)
    floor = 2 * n * _EPS
    with np.errstate(all="ignore"):
        for _ in range(most):
            part = recursion.part(todo)
            taken = step(part, P)
            defect = taken.following - P
            relative = relative_defect(part, defect, P)
            better = relative < residual[todo]
            stalls = np.where(relative < 0.5 * residual[todo], 0, stalls + 1)
            best[todo[better]], residual[todo[better]] = P[better], relative[better]
            steps[todo] += 1
            hopeless = ~np.isfinite(relative)
            stays = ~hopeless & (relative > floor) & ~((residual[todo] < 1e-9) & (stalls >= 2))
            if not stays.any():
                break
            todo, stalls = todo[stays], stalls[stays]
            taken = taken.part(stays)
            slope = derivative(recursion.part(todo), taken)
            proposed = P[stays] + newton_direction(slope, defect[stays])
            inside = stacked.smallest_unit_eigenvalue(proposed) >= -_SINGULAR
            P = np.where(inside[:, None, None], proposed, taken.following)
    return Converged(best, residual, steps)


def relative_defect(
    recursion: Recursion, defect: Float[ndarray, "K n n"], P: Float[ndarray, "K n n"]
) -> Float[ndarray, " K"]:
    """max |T_c(P) - P|_ij / sqrt(P_ii P_jj), in the units of each state; NaN where P is no matrix of numbers.

    A variance below 1e-80 of the largest is none: a state that is known exactly, carried as 1e-100. 0 for the Kalman
    filter of a plant without noise, whose P = 0 is exact; inf for a P = 0 at any other tolerance.
    """
    variance = np.einsum("kii->ki", P)
    largest = variance.max(axis=-1, keepdims=True)
    scale = np.sqrt(np.maximum(variance, _NO_VARIANCE * largest))
    nothing = (largest == 0)[:, :, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(defect) / np.where(nothing, 1.0, scale[:, :, None] * scale[:, None, :])
    exact = (recursion.tolerance == 0)[:, None, None] & (defect == 0)
    return np.where(nothing, np.where(exact, 0.0, np.inf), ratio).max(axis=(-1, -2))


def attraction(slope: Derivative) -> Float[ndarray, " K"]:
    """Spectral radius of the derivative of the covariance recursion: below 1, the filter settles.

    The derivative of V_t -> V_{t+1} and that of P_t -> P_{t+1} have the same non-zero eigenvalues.
    """
    n = slope.U.shape[-1]
    if n <= DENSE_UP_TO:
        return stacked.spectral_radius(slope.matrix())
    radius = np.full(len(slope.loop), np.nan)
    finite = stacked.finite_members(slope.loop) & stacked.finite_members(slope.thrust)
    plain = finite & slope.separable & (slope.a == 0).all(axis=-1)
    radius[plain] = stacked.spectral_radius(slope.loop[plain]) ** 2  # at c = 0 the derivative is K dP K'
    d = n * (n + 1) // 2
    todo = np.flatnonzero(finite & ~plain)
    for order in (min(d, 30), min(d, 80)):
        if todo.size:
            radius[todo], error = _arnoldi_radius(slope.part(todo), order)
            todo = todo[~(error <= 1e-9 * radius[todo])]
    if todo.size:
        radius[todo] = stacked.spectral_radius(slope.part(todo).matrix())
    return radius


def _arnoldi_radius(slope: Derivative, order: int) -> tuple[Float[ndarray, " K"], Float[ndarray, " K"]]:
    """Largest Ritz value of the derivative in a Krylov space of this order, and the residual of its Ritz pair."""
    K, n, _ = slope.U.shape
    start = np.random.default_rng(0).standard_normal((n, n))
    basis = np.zeros((K, order + 1, n * n))
    basis[:, 0] = (start @ start.T).ravel() / np.linalg.norm(start @ start.T)
    H = np.zeros((K, order + 1, order))
    for j in range(order):
        # Rounding is not symmetric, and K E K' may die out more slowly on what is antisymmetric.
        w = stacked.symmetric_part(slope.apply(basis[:, j].reshape(K, n, n))).reshape(K, n * n, 1)
        known = basis[:, : j + 1]
        for _ in range(2):  # twice is enough
            h = known @ w
            H[:, : j + 1, j] += h[:, :, 0]
            w = w - known.mT @ h
        H[:, j + 1, j] = np.linalg.norm(w[:, :, 0], axis=1)
        basis[:, j + 1] = w[:, :, 0] / np.where(H[:, j + 1, j] > 0, H[:, j + 1, j], 1.0)[:, None]
    values, vectors = np.linalg.eig(H[:, :order])
    largest = np.abs(values).argmax(axis=-1)
    last = np.take_along_axis(vectors[:, -1, :], largest[:, None], axis=-1)[:, 0]
    radius = np.take_along_axis(np.abs(values), largest[:, None], axis=-1)[:, 0]
    return radius, np.abs(last) * H[:, order, order - 1]
