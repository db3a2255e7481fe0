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

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.analysis import stacked
from tolnet.analysis.divergence import inflate

DENSE_UP_TO = 12
"""States up to which the derivative is formed as a matrix on symmetric matrices, n (n + 1) / 2 square."""

_EPS = np.finfo(float).eps


@dataclass(frozen=True, eq=False)
class Recursion:
    """A stack of covariance recursions that share A, Q: node's information S and tolerance c."""

    A: Float[ndarray, "n n"]
    Q: Float[ndarray, "n n"]
    S: Float[ndarray, "K n n"]
    tolerance: Float[ndarray, " K"]
    tau: float = 0.0

    def part(self, index: ndarray) -> Recursion:
        """The members at `index`."""
        return Recursion(self.A, self.Q, self.S[index], self.tolerance[index], self.tau)

    def at(self, tolerance: Float[ndarray, " K"]) -> Recursion:
        """The same recursions at other tolerances."""
        return Recursion(self.A, self.Q, self.S, tolerance, self.tau)


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


def filter_gain(
    A: Float[ndarray, "n n"], S: Float[ndarray, "K n n"], at: Inflated
) -> tuple[Float[ndarray, "#K n n"], Float[ndarray, "K n n"]]:
    """A U and A Z U, so that A Z A' is their product (line 2); one V may serve a stack of S."""
    AU = A @ at.U
    information = at.U.mT @ S @ at.U
    diagonal = np.einsum("kii->ki", information)
    w = np.sqrt(1.0 / (1.0 / (at.eigenvalues * (1 + at.excess)) + diagonal))
    unit = w[:, :, None] * information * w[:, None, :]
    np.einsum("kii->ki", unit)[...] = 1.0
    return AU, (AU * w[:, None, :]) @ stacked.solve(unit, np.eye(len(A)) * w[:, None, :])


def predict(
    A: Float[ndarray, "n n"], Q: Float[ndarray, "n n"], S: Float[ndarray, "K n n"], at: Inflated
) -> Float[ndarray, "K n n"]:
    """A (V^-1 + S)^-1 A' + Q (line 3)."""
    AU, AZ = filter_gain(A, S, at)
    return stacked.symmetric_part(AZ @ AU.mT) + Q


class Step(NamedTuple):
    """One step of the recursion from P, with all that its derivative needs (lines 1 to 3)."""

    following: Float[ndarray, "K n n"]
    at: Inflated
    AZ: Float[ndarray, "K n n"]
    """A Z U: maps the eigenbasis into the state."""

    def part(self, index: ndarray) -> Step:
        """The members at `index`."""
        return Step(self.following[index], Inflated(*(value[index] for value in self.at)), self.AZ[index])


def step(recursion: Recursion, P: Float[ndarray, "K n n"]) -> Step:
    """T_c(P) = A (V^-1 + S)^-1 A' + Q with V from gamma(P, theta) = c (lines 1 to 3)."""
    at = inflate_covariance(P, recursion.tolerance, recursion.tau)
    AU, AZ = filter_gain(recursion.A, recursion.S, at)
    return Step(stacked.symmetric_part(AZ @ AU.mT) + recursion.Q, at, AZ)


class Derivative(NamedTuple):
    """dT = AZ (q * E + diag(t) dtheta) AZ',  dtheta = -sum a_i E_ii,  E = U' dP U (lines 4 and 5)."""

    U: Float[ndarray, "K n n"]
    AZ: Float[ndarray, "K n n"]
    q: Float[ndarray, "K n n"]
    t: Float[ndarray, "K n"]
    a: Float[ndarray, "K n"]
    separable: bool
    """Whether q_ij = 1 / (lambda_i lambda_j), so that the derivative is K dP K' plus rank one (tau = 0)."""

    def part(self, index: ndarray) -> Derivative:
        """The members at `index`."""
        return Derivative(*(value[index] for value in self[:-1]), separable=self.separable)

    def apply(self, dP: Float[ndarray, "K n n"]) -> Float[ndarray, "K n n"]:
        """The derivative in the direction dP."""
        E = self.U.mT @ dP @ self.U
        inner = self.q * E
        dtheta = -np.einsum("ki,kii->k", self.a, E)
        np.einsum("kii->ki", inner)[...] += dtheta[:, None] * self.t
        return self.AZ @ inner @ self.AZ.mT

    @property
    def loop(self) -> Float[ndarray, "K n n"]:
        """K = A Z P^-1, the closed loop at fixed theta (tau = 0 only)."""
        return (self.AZ * np.sqrt(np.einsum("kii->ki", self.q))[:, None, :]) @ self.U.mT

    def matrix(self) -> Float[ndarray, "K d d"]:
        """The derivative as a matrix on symmetric matrices in the eigenbasis, d = n (n + 1) / 2.

        Coordinates E_ii and sqrt(2) E_ij (i < j), so that the Euclidean norm is the Frobenius norm.
        """
        L = self.U.mT @ self.AZ
        n = L.shape[-1]
        i, j = np.triu_indices(n)
        root = np.where(i == j, 1.0, np.sqrt(2.0))
        left, right = L[:, i[:, None], i], L[:, j[:, None], j]
        crossed = L[:, i[:, None], j] * L[:, j[:, None], i]
        half = np.where(i == j, 0.5, 1.0)
        full = (left * right + crossed) * (half * root[:, None] / root) * self.q[:, i, j][:, None, :]
        diagonal = np.flatnonzero(i == j)
        thrust = np.einsum("kai,ki,kbi->kab", L, self.t, L)[:, i, j] * root
        full[:, :, diagonal] -= thrust[:, :, None] * self.a[:, None, :]
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
    q = 1.0 / (lam[:, :, None] * lam[:, None, :])
    t = np.ones_like(lam)
    if tau != 0:
        t = kappa**-tau
        inverse, slope = 1.0 / (lam * kappa), 1.0 / (lam**2 * kappa) + theta * t / lam
        distance = lam[:, :, None] - lam[:, None, :]
        near = np.abs(distance) <= 1e-5 * (lam[:, :, None] + lam[:, None, :])
        quotient = (inverse[:, None, :] - inverse[:, :, None]) / np.where(near, 1.0, distance)
        q = np.where(near, (slope[:, :, None] + slope[:, None, :]) / 2, quotient)
    return Derivative(at.U, taken.AZ, q, t, a, separable=tau == 0)


def _log_ratio(kappa: ndarray, tau: float) -> ndarray:
    """(1 - kappa^(tau - 1)) / (1 - tau), log kappa at tau = 1: d gamma / d kappa of one eigenvalue."""
    return np.log(kappa) if tau == 1 else -np.expm1((tau - 1) * np.log(kappa)) / (1 - tau)


def newton_direction(slope: Derivative, defect: Float[ndarray, "K n n"]) -> Float[ndarray, "K n n"]:
    """Solve dP - T'(dP) = defect for symmetric dP.

    As a matrix for few states. For more, through the Stein equation of the loop K (line 4 with tau = 0):
    X - K X K' = defect and Y - K Y K' = A Z Z A', then dP = X + dtheta Y with dtheta = -a(X) / (1 + a(Y)).
    """
    n = defect.shape[-1]
    if n <= DENSE_UP_TO or not slope.separable:
        i, j = np.triu_indices(n)
        root = np.where(i == j, 1.0, np.sqrt(2.0))
        U = slope.U
        right = (U.mT @ defect @ U)[:, i, j] * root
        e = stacked.solve(np.eye(len(i)) - slope.matrix(), right[:, :, None])[:, :, 0] / root
        E = np.empty_like(defect)
        E[:, i, j] = E[:, j, i] = e
        return U @ E @ U.mT
    thrust = slope.AZ @ slope.AZ.mT
    X, Y = _stein(slope.loop, defect), _stein(slope.loop, thrust)
    pull = [np.einsum("ki,kji,kjl,kli->k", slope.a, slope.U, W, slope.U) for W in (X, Y)]
    return X - (pull[0] / (1 + pull[1]))[:, None, None] * Y


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
            eigenvalues, _ = stacked.symmetric_eigen(proposed)
            inside = eigenvalues[:, 0] >= -1e-12 * eigenvalues[:, -1]
            P = np.where(inside[:, None, None], proposed, taken.following)
    return Converged(best, residual, steps)


def relative_defect(
    recursion: Recursion, defect: Float[ndarray, "K n n"], P: Float[ndarray, "K n n"]
) -> Float[ndarray, " K"]:
    """|T_c(P) - P| / |P|; 0 for the Kalman filter of a plant without noise, whose P = 0 is exact."""
    size = stacked.norm(P)
    nothing = (size == 0) & (recursion.tolerance == 0) & (stacked.norm(defect) == 0)
    return np.where(nothing, 0.0, stacked.norm(defect) / np.where(nothing, 1.0, size))


def attraction(slope: Derivative) -> Float[ndarray, " K"]:
    """Spectral radius of the derivative of the covariance recursion: below 1, the filter settles.

    The derivative of V_t -> V_{t+1} and that of P_t -> P_{t+1} have the same non-zero eigenvalues.
    """
    n = slope.U.shape[-1]
    if n <= DENSE_UP_TO:
        return stacked.spectral_radius(slope.matrix())
    d = n * (n + 1) // 2
    finite = stacked.finite_members(slope.AZ) & stacked.finite_members(slope.q)
    radius = np.full(len(finite), np.nan)
    todo = np.flatnonzero(finite)
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
        w = slope.apply(basis[:, j].reshape(K, n, n)).reshape(K, n * n, 1)
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
