"""Least-favourable performance as printed in eqs. (34)-(41): stacked outputs, explicit inverses, dense everything.

Matrices of size n + sum p_k throughout, the backward recursion iterated until it stands still, and scipy for the
Lyapunov equation. Good for networks of a few dozen nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from numpy.linalg import cholesky, eigvals, inv, norm
from scipy.linalg import block_diag, solve_discrete_lyapunov
from tests.reference import determinants, recursion

from tolnet.model import SensorNetwork


@dataclass(frozen=True)
class Stacked:
    """Eq. (6): Gamma_B, Gamma_D, C and R of the stacked model."""

    A: ndarray
    B: ndarray
    C: ndarray
    D: ndarray

    @property
    def Gamma_B(self) -> ndarray:
        return np.hstack([self.B, np.zeros((len(self.A), len(self.D)))])

    @property
    def Gamma_D(self) -> ndarray:
        return np.hstack([np.zeros((len(self.D), self.B.shape[1])), self.D])

    @property
    def R(self) -> ndarray:
        return self.D @ self.D.T


def stacked(network: SensorNetwork) -> Stacked:
    """The stacked model, with square roots where only Q or R was given."""
    B = network.B
    if B is None:
        eigenvalues, U = np.linalg.eigh(network.Q)
        B = U * np.sqrt(np.maximum(eigenvalues, 0))
    D = [cholesky(network.sensor(k)[1]) for k in range(network.N) if network.sensor(k)[1].size]
    return Stacked(network.A, B, network.C, np.asarray(block_diag(*D)) if D else np.empty((0, 0)))


@dataclass(frozen=True)
class Model:
    """Eq. (34) at one instant, or in the steady state."""

    G: ndarray
    Gamma_H: ndarray
    Gamma_L: ndarray
    K: ndarray
    inverse_Omega: ndarray


def gain(model: Stacked, V: ndarray) -> ndarray:
    """G of eq. (4)."""
    return model.A @ V @ model.C.T @ inv(model.C @ V @ model.C.T + model.R)


def backward_step(model: Stacked, V: ndarray, theta: float, inverse_Omega: ndarray) -> Model:
    """Omega_t^-1, K_t, Gamma_H and Gamma_L from Omega_{t+1}^-1, as printed above eq. (34)."""
    G = gain(model, V)
    M = model.Gamma_B - G @ model.Gamma_D
    X = inverse_Omega + theta * np.eye(len(model.A))
    K = inv(np.eye(M.shape[1]) - M.T @ X @ M)
    K = (K + K.T) / 2
    F = model.A - G @ model.C
    H = K @ M.T @ X @ F
    Omega = F.T @ X @ F + H.T @ inv(K) @ H
    return Model(G, H, cholesky(K), K, (Omega + Omega.T) / 2)


def steady_model(model: Stacked, V: ndarray, theta: float, steps: int = 20000) -> Model:
    """The backward recursion from Omega^-1 = 0 until it stands still."""
    at = backward_step(model, V, theta, np.zeros_like(model.A))
    for _ in range(steps):
        before, at = at, backward_step(model, V, theta, at.inverse_Omega)
        if norm(at.inverse_Omega - before.inverse_Omega) <= 1e-15 * norm(at.inverse_Omega):
            return at
    raise ArithmeticError(f"the backward recursion still moves after {steps} steps")


def dynamics(network: SensorNetwork, V: list[ndarray], W: ndarray, at: Model) -> tuple[ndarray, ndarray]:
    """F and G of eqs. (35)-(37) for node filters with the covariances V_k."""
    model = stacked(network)
    A, B, n, N = model.A, model.B, network.n, network.N
    m = B.shape[1]
    rows = network.rows
    C_diagonal = np.zeros((len(model.C), N * n))
    J = np.zeros((N, N))
    S = []
    for k in range(N):
        C_diagonal[rows[k] : rows[k + 1], k * n : (k + 1) * n] = model.C[rows[k] : rows[k + 1]]
        J[determinants.hears(network, k), k] = 1
        S.append(determinants.information(*determinants.stacked(network, determinants.hears(network, k))))
    inverse_V = np.asarray(block_diag(*[inv(V_k) for V_k in V]))
    eye = np.eye(n)
    front = np.kron(W.T, eye) @ np.kron(np.eye(N), A) @ inv(inverse_V + np.asarray(block_diag(*S)))
    sensed = front @ np.kron(J.T, eye) @ C_diagonal.T @ inv(model.R) @ model.D
    return _assemble(model, at, front @ inverse_V, sensed, np.kron(np.ones((N, 1)), B), m)


def central_dynamics(network: SensorNetwork, V: ndarray, at: Model) -> tuple[ndarray, ndarray]:
    """The same for one centralised filter with the covariance V."""
    model = stacked(network)
    S = model.C.T @ inv(model.R) @ model.C
    front = model.A @ inv(inv(V) + S)
    sensed = front @ model.C.T @ inv(model.R) @ model.D
    return _assemble(model, at, front @ inv(V), sensed, model.B, model.B.shape[1])


def _assemble(
    model: Stacked, at: Model, A: ndarray, sensed: ndarray, driven: ndarray, m: int
) -> tuple[ndarray, ndarray]:
    """Eqs. (35)-(37) from the block of F, the front of D L_t and H_t, and 1 (x) B."""
    M, H = at.Gamma_H[:m], at.Gamma_H[m:]
    N, L = at.Gamma_L[:m], at.Gamma_L[m:]
    M_loop = model.Gamma_B - at.G @ model.Gamma_D
    n = len(model.A)
    F = np.block(
        [[A, -sensed @ H + driven @ M], [np.zeros((n, len(A))), model.A - at.G @ model.C + M_loop @ at.Gamma_H]]
    )
    G = np.vstack([-sensed @ L + driven @ N, M_loop @ at.Gamma_L])
    return F, G


def node_msd(F: ndarray, G: ndarray, n: int) -> ndarray:
    """Traces of the diagonal blocks of Q = F Q F' + G G', eqs. (40)-(41); the last is that of e."""
    Q = solve_discrete_lyapunov(F, G @ G.T)
    return np.array([np.trace(Q[i : i + n, i : i + n]) for i in range(0, len(Q), n)])


def spectral_radius(F: ndarray) -> float:
    """Largest absolute value of an eigenvalue."""
    return float(np.abs(eigvals(F)).max())


def steady_covariance(A: ndarray, Q: ndarray, S: ndarray, c: float) -> tuple[ndarray, float]:
    """V and theta of one filter, by the published recursion."""
    run = recursion.run(A, Q, S, c)
    if run.verdict != "settles":
        raise ArithmeticError(f"the published recursion {run.verdict}")
    return run.V, run.theta
