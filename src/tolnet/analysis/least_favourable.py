"""The least favourable model of the centre's ambiguity set, eq. (34), from n x n matrices alone.

With M = [B, -G D], N = M M' = Q + A Z S Z A' and F = A - G C = A (I + V S)^-1, where Z = (V^-1 + S)^-1:

    1.  K = (I - M' X M)^-1 = I + M' T M,    T = X + X N X + ... = X (I - N X)^-1
    2.  H = K M' X F = M' T F,               A - G C + M H = (I + N T) F,      M K M' = N + N T N
    3.  Omega^-1 = F' X F + H' K^-1 H = F' T F,    X_{t-1} = F' X_t (I - N X_t)^-1 F + theta I
    4.  K > 0  <=>  every eigenvalue of N^1/2 X N^1/2 is below 1

Line 3 is the Riccati equation of A' = F, G = -N, Q = theta I, so its steady state comes by doubling from zero, which
visits the iterates of the published recursion at 1, 2, 4, ... steps.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.divergence import inflate
from tolnet.analysis.riccati import solve_riccati
from tolnet.analysis.stacked import spectral_radius
from tolnet.analysis.steady_state import solve_steady_states
from tolnet.model import LeastFavourableModel, SensorNetwork, Status, SteadyState, UnsupportedError
from tolnet.model.worst_case import psd_factor

_ACCURATE = 1e-9
"""Largest relative residual of a backward recursion that counts as solved."""
_GRID, _ROUNDS = 32, 6
"""The fold is bracketed in c by grids of this many points, that many times over."""


def least_favourable_model(
    network: SensorNetwork, central: SteadyState, horizon: int | None = None
) -> LeastFavourableModel:
    """Solve Omega^-1 = F' X (I - N X)^-1 F, X = Omega^-1 + theta I: the model that is worst for the centre, eq. (34).

    `central` is the centralised robust filter's steady state. With `horizon` T the model is time-varying: V_t and
    theta_t forwards from the network's initial covariance at the tolerance of `central`, t = 0..T-1, then Omega_t^-1
    backwards from Omega_T^-1 = 0. theta = 0 gives the nominal model. No model is a status with a reason: `fold` where
    c is at or beyond the centre's fold, `no-model` where K_t or V_t^-1 - Omega_t^-1 is not positive definite,
    `not-converged`, or the centre's own where it has no steady state; `oscillates` is passed on, with numbers.
    Raises UnsupportedError for tau != 0, ValueError for a horizon below 1.
    Source: eq. (34) and the recursion above it; docs/mathematics.md, section 7.
    """
    if central.tau != 0:
        raise UnsupportedError(f"the least favourable model is defined for tau = 0 only (tau is {central.tau})")
    if horizon is not None:
        if horizon < 1:
            raise ValueError(f"horizon is {horizon}; at least one step was expected")
        return _finite_horizon(network, float(central.tolerance), horizon)
    if not central.exists:
        return _none(network, central, Status(str(central.status)), "the centralised filter has no steady state")
    return _steady(network, central)


def _steady(network: SensorNetwork, central: SteadyState) -> LeastFavourableModel:
    A, S, V, theta = network.A, central.S, central.V, float(central.theta)
    eye = np.eye(network.n)
    if not spectral_radius(_loop_at_theta(A, S, V, central.theta)) < 1:
        c = float(central.tolerance)
        reason = f"the tolerance {c:g} is not below the centre's fold, {fold_tolerance(network, c):.6g} (gamma scale)"
        return _none(network, central, Status.FOLD, reason)
    F = A @ np.linalg.solve(eye + V @ S, eye)
    N = _noise(network, V)
    X, residual = theta * eye, 0.0
    if theta > 0:
        solution = solve_riccati(F.T, theta * eye, -N[None])
        X, residual = solution.P[0], float(solution.residual[0])
    if not residual < _ACCURATE:
        reason = f"the backward recursion has no steady state: relative residual {residual:.3g}"
        return _none(network, central, Status.NOT_CONVERGED, reason)
    tilt = _tilt(X, N)
    backward = X - theta * eye
    missing = _why_missing(V, backward, X, N)
    if missing is not None:
        return _none(network, central, Status.NO_MODEL, missing)
    return LeastFavourableModel(
        network=network,
        tolerance=float(central.tolerance),
        theta=np.asarray(theta),
        V=V,
        backward=F.T @ tilt @ F,
        tilt=tilt,
        residual=residual,
        status=Status(str(central.status)),
        reason="" if central.settles else "the centralised filter never settles on its steady state",
    )


def _none(network: SensorNetwork, central: SteadyState, status: Status, reason: str) -> LeastFavourableModel:
    nan = np.full((network.n, network.n), np.nan)
    return LeastFavourableModel(
        network=network,
        tolerance=float(central.tolerance),
        theta=np.asarray(np.nan),
        V=nan,
        backward=nan,
        tilt=nan,
        residual=np.nan,
        status=status,
        reason=reason,
    )


def _noise(network: SensorNetwork, V: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    """N = Q + A Z S Z A'."""
    A, S = network.A, network.total_information
    Z = np.linalg.solve(np.eye(network.n) + V @ S, V)
    return network.Q + A @ Z @ S @ Z.T @ A.T


def _tilt(X: Float[ndarray, "n n"], N: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    """T = X (I - N X)^-1 = (I - X N)^-1 X, symmetric."""
    T = np.linalg.solve(np.eye(len(X)) - X @ N, X)
    return (T + T.T) / 2  # rounding only: the exact matrix is symmetric


def _why_missing(V: ndarray, backward: ndarray, X: ndarray, N: ndarray) -> str | None:
    """What is not positive definite, in words; None where the model exists."""
    largest = _largest_of_product(N, X)
    if not largest < 1:
        return f"K is not positive definite: M' X M has the eigenvalue {largest:.6g}, not below 1"
    largest = _largest_of_product(V, backward)
    if not largest < 1:
        return f"V^-1 - Omega^-1 is not positive definite: V Omega^-1 has the eigenvalue {largest:.6g}, not below 1"
    return None


def _largest_of_product(P: ndarray, X: ndarray) -> float:
    """Largest eigenvalue of P X, both symmetric and P positive semidefinite."""
    Y = psd_factor(P)
    return float(np.linalg.eigvalsh(Y.T @ X @ Y)[-1])


def fold_tolerance(network: SensorNetwork, above: float) -> float:
    """The smallest c <= `above` at which the closed loop at fixed theta has spectral radius 1: the centre's fold.

    Assumes that `above` is at or beyond the fold. Steady states on ever finer grids of c, the first one geometric.
    Gamma scale.
    """
    A, Q, S = network.A, network.Q, np.broadcast_to(network.total_information, (_GRID, network.n, network.n))
    grid = np.geomspace(1e-9 * above, above, _GRID)
    for _ in range(_ROUNDS):
        at = solve_steady_states(A, Q, S, grid)
        below = spectral_radius(_loop_at_theta(A, at.S, at.V, at.theta)) < 1
        last = int(np.argmin(below))
        grid = np.linspace(grid[max(last - 1, 0)], grid[last], _GRID)
    return float(grid[-1])


def _loop_at_theta(
    A: Float[ndarray, "n n"], S: Float[ndarray, "*K n n"], V: Float[ndarray, "*K n n"], theta: Float[ndarray, "*K"]
) -> Float[ndarray, "*K n n"]:
    """A Z P^-1 = A (I + V S)^-1 (I + theta V), the closed loop of the Riccati equation at fixed theta."""
    eye = np.eye(len(A))
    return A @ np.linalg.solve(eye + V @ S, eye + theta[..., None, None] * V)


def _finite_horizon(network: SensorNetwork, c: float, T: int) -> LeastFavourableModel:
    n, A, Q, S = network.n, network.A, network.Q, network.total_information
    eye = np.eye(n)
    V, theta = np.empty((T + 1, n, n)), np.empty(T)
    V[0] = network.initial_covariance
    for t in range(T):  # eq. (4)
        P = A @ np.linalg.solve(eye + V[t] @ S, V[t]) @ A.T + Q
        eigenvalues, U = np.linalg.eigh((P + P.T) / 2)
        inflation = inflate(np.maximum(eigenvalues, 0)[None], np.array([c]))
        theta[t] = inflation.theta[0]
        V[t + 1] = (U * (eigenvalues * (1 + inflation.excess[0]))) @ U.T
    backward, tilt = np.zeros((T + 1, n, n)), np.empty((T, n, n))
    for t in reversed(range(T)):
        F, N = A @ np.linalg.solve(eye + V[t] @ S, eye), _noise(network, V[t])
        X = backward[t + 1] + theta[t] * eye
        tilt[t] = _tilt(X, N)
        backward[t] = F.T @ tilt[t] @ F
        missing = _why_missing(V[t], backward[t], X, N)
        if missing is not None:
            return _no_horizon(network, c, T, f"at t = {t} of {T}, {missing}")
    return LeastFavourableModel(
        network=network,
        tolerance=c,
        theta=theta,
        V=V[:T],
        backward=backward[:T],
        tilt=tilt,
        residual=0.0,
        status=Status.OK,
        reason="",
    )


def _no_horizon(network: SensorNetwork, c: float, T: int, reason: str) -> LeastFavourableModel:
    nan = np.full((T, network.n, network.n), np.nan)
    return LeastFavourableModel(
        network=network,
        tolerance=c,
        theta=np.full(T, np.nan),
        V=nan,
        backward=nan,
        tilt=nan,
        residual=np.nan,
        status=Status.NO_MODEL,
        reason=reason,
    )
