"""The least favourable model of the centre's ambiguity set, eq. (34), from n x n matrices alone.

With M = [B, -G D], N = M M' and F = A - G C = A (I + V S)^-1 at t, and P, V_+ = (P^-1 - theta I)^-1 at t + 1:

    1.  K = (I - M' X M)^-1 = I + M' T M,    T = (X^-1 - N)^-1,    X = Omega_+^-1 + theta I
    2.  H = K M' X F = M' T F,    Omega^-1 = F' X F + H' K^-1 H = F' T F,    A - G C + M H = (I + N T) F
    3.  X = P^-1 - R_+^-1, where R^-1 = V^-1 - Omega^-1 is the inverse covariance of e under the model
    4.  P = F V F' + N, so T^-1 = P Delta^-1 P + F V F' with Delta = R_+ - P, positive definite as it stands
    5.  line 2 turns into R = V + L Delta L', L = Z A' P^-1 (the gain of a smoother): linear in Delta
    6.  V_+ - P = theta V_+ P, so Delta_t = theta V P + L Delta_{t+1} L', a sum of positive terms without cancellation
    7.  e_t = L e_{t+1} + (noise) backwards, hence A - G C + M H = R_+ L' R^-1 and T F = P^-1 Delta L' R^-1 forwards

Hence over a finite horizon the model exists for every tolerance, and its steady state exists where rho(L) < 1. L has
the eigenvalues of A Z P^-1, which reach the unit circle at the fold: the same limit, from the other side.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis import stacked
from tolnet.analysis.divergence import gamma, inflate
from tolnet.analysis.lyapunov_dense import data_error, solve_smith
from tolnet.analysis.riccati import is_valid, solve_riccati
from tolnet.analysis.stacked import spectral_radius
from tolnet.model import LeastFavourableModel, SensorNetwork, Status, SteadyState, UnsupportedError
from tolnet.model.covariances import SIX_DIGITS, TOO_PRECISE, condition, psd_factor, standard_deviations

_GRID, _ROUNDS = 33, 6
"""The fold is bracketed in theta by grids of this many points, that many times over."""

_ON_THE_BRANCH = 1e-11
"""Residual of a Riccati solution; just beyond the fold doubling wanders about, and its residual with it."""


def least_favourable_model(
    network: SensorNetwork, central: SteadyState, horizon: int | None = None
) -> LeastFavourableModel:
    """Solve Omega^-1 = F' (X^-1 - N)^-1 F, X = Omega^-1 + theta I: the model that is worst for the centre, eq. (34).

    `central` is the centralised robust filter's steady state. With `horizon` T the model is time-varying: V_t and
    theta_t forwards from the network's initial covariance at the tolerance of `central`, t = 0..T-1, then Omega_t^-1
    backwards from Omega_T^-1 = 0; that exists for every tolerance. theta = 0 gives the nominal model. No model is a
    status with a reason: `fold` where c is at or beyond the centre's fold, `not-converged` where six digits are lost
    to rounding, or the centre's own where it has no steady state; `oscillates` is passed on, with numbers.
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
        status = Status(str(central.status))
        return _none(network, float(central.tolerance), status, "the centralised filter has no steady state")
    return _steady(network, central)


def _steady(network: SensorNetwork, central: SteadyState) -> LeastFavourableModel:
    c, P, V = float(central.tolerance), central.P, central.V
    if not condition(V, central.S).error <= SIX_DIGITS:
        return _none(network, c, Status.NOT_CONVERGED, TOO_PRECISE)
    if not spectral_radius(_loop_at_theta(network.A, central.S, V, central.theta)) < 1:
        reason = f"the tolerance {c:g} is not below the centre's fold, {fold_tolerance(network, c):.6g} (gamma scale)"
        return _none(network, c, Status.FOLD, reason)
    inverse = _inverse(P)
    L = _smoother_gain(network, central.filtered, P, inverse)
    Delta = solve_smith(L, _growth(central.theta, V, P)).X
    if not np.isfinite(Delta).all():  # so near the fold that the loop and the smoother's gain disagree about it
        reason = f"rounding left no covariance of e at the tolerance {c:g}"
        return _none(network, c, Status.NOT_CONVERGED, reason)
    R = P + Delta
    model = LeastFavourableModel(
        network=network,
        tolerance=c,
        theta=central.theta,
        V=V,
        error_covariance=R,
        tilt=_tilt(inverse, _loop(network, V), V, Delta),
        steering=inverse @ Delta @ L.T @ _inverse(R),
        status=Status(str(central.status)),
        reason="" if central.settles else "the centralised filter never settles on its steady state",
    )
    deviation, varies = standard_deviations(R)
    correction = np.diagonal(solve_smith(model.closed_loop, model.defect).X) / deviation**2
    error = float(np.max(np.abs(correction), where=varies, initial=0.0))
    error = max(error, data_error(float(spectral_radius(model.closed_loop))))
    if not error <= SIX_DIGITS:
        reason = f"the covariance of e has an estimated relative error of {error:.2g} at the tolerance {c:g}"
        return _none(network, c, Status.NOT_CONVERGED, reason)
    return model


def _none(network: SensorNetwork, c: float, status: Status, reason: str) -> LeastFavourableModel:
    nan = np.full((network.n, network.n), np.nan)
    return LeastFavourableModel(
        network=network,
        tolerance=c,
        theta=np.asarray(np.nan),
        V=nan,
        error_covariance=nan,
        tilt=nan,
        steering=nan,
        status=status,
        reason=reason,
    )


def _finite_horizon(network: SensorNetwork, c: float, T: int) -> LeastFavourableModel:
    n, A, Q, S = network.n, network.A, network.Q, network.total_information
    P, V, Z, F = np.full((T + 1, n, n), np.nan), np.empty((T + 1, n, n)), np.empty((T, n, n)), np.empty((T, n, n))
    theta = np.empty(T)
    V[0] = network.initial_covariance
    for t in range(T):  # eq. (4)
        Z[t], loop, error = condition(V[t], S)
        if not error <= SIX_DIGITS:
            return _none(network, c, Status.NOT_CONVERGED, f"at step {t} {TOO_PRECISE}")
        F[t] = A @ loop
        P[t + 1] = A @ Z[t] @ A.T + Q
        eigenvalues, U = np.linalg.eigh(P[t + 1])
        inflation = inflate(np.maximum(eigenvalues, 0)[None], np.array([c]))
        theta[t] = inflation.theta[0]
        V[t + 1] = (U * (eigenvalues * (1 + inflation.excess[0]))) @ U.T
    R, tilt, steering = np.empty((3, T, n, n))
    Delta = _growth(theta[T - 1], V[T], P[T])
    for t in reversed(range(T)):
        inverse = _inverse(P[t + 1])
        tilt[t] = _tilt(inverse, F[t], V[t], Delta)
        L = _smoother_gain(network, Z[t], P[t + 1], inverse)
        grown = L @ Delta @ L.T
        R[t] = V[t] + (grown + grown.T) / 2  # rounding only: the exact matrix is symmetric
        steering[t] = inverse @ Delta @ L.T @ _inverse(R[t])
        if t > 0:
            Delta = (grown + grown.T) / 2 + _growth(theta[t - 1], V[t], P[t])
    return LeastFavourableModel(
        network=network,
        tolerance=c,
        theta=theta,
        V=V[:T],
        error_covariance=R,
        tilt=tilt,
        steering=steering,
        status=Status.OK,
        reason="",
    )


def _loop(network: SensorNetwork, V: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    """F = A - G C = A (I + V S)^-1."""
    return network.A @ condition(V, network.total_information).loop


def _growth(theta: float | ndarray, V: Float[ndarray, "n n"], P: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    """V - P = theta V P, without the cancellation."""
    growth = theta * V @ P
    return (growth + growth.T) / 2


def _smoother_gain(
    network: SensorNetwork, Z: Float[ndarray, "n n"], P: Float[ndarray, "n n"], inverse: Float[ndarray, "n n"]
) -> Float[ndarray, "n n"]:
    """L = Z A' P^-1; states that are known exactly stay so, whatever rounding left in Z."""
    _, varies = standard_deviations(P)
    return np.where(varies[:, None], Z @ network.A.T @ inverse, 0.0)


def _inverse(P: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    """P^-1; on the range of P where it is singular, which says that a state is known exactly."""
    scale, _ = standard_deviations(P)
    scaled = P / (scale[:, None] * scale)
    eigenvalues, U = np.linalg.eigh(scaled)
    kept = eigenvalues > len(P) * np.finfo(float).eps * eigenvalues[-1]
    inverse = np.linalg.inv(scaled) if kept.all() else (U[:, kept] / eigenvalues[kept]) @ U[:, kept].T
    return inverse / (scale[:, None] * scale)


def _tilt(
    inverse: Float[ndarray, "n n"], F: Float[ndarray, "n n"], V: Float[ndarray, "n n"], Delta: Float[ndarray, "n n"]
) -> Float[ndarray, "n n"]:
    """T = (P Delta^-1 P + F V F')^-1 = P^-1 D (I + G G')^-1 D' P^-1 with Delta = D D', V = U U', G = D' P^-1 F U."""
    D = psd_factor(Delta)
    H, G = inverse @ D, D.T @ inverse @ F @ psd_factor(V)
    T = H @ np.linalg.solve(np.eye(len(V)) + G @ G.T, H.T)
    return (T + T.T) / 2  # rounding only: the exact matrix is symmetric


def fold_tolerance(network: SensorNetwork, above: float) -> float:
    """The smallest c <= `above` at which the closed loop at fixed theta has spectral radius 1: the centre's fold.

    Assumes that `above` is at or beyond the fold. gamma rises with theta along the stabilising branch of the Riccati
    equation and is c at its end: the largest theta with a stabilising solution, on ever finer grids below the theta
    at which the Kalman filter's P would spend `above`, which is no smaller. Gamma scale.
    Source: docs/mathematics.md, section 4.5.
    """
    A, Q, S = network.A, network.Q, network.total_information
    below: list[tuple[float, float]] = []  # 1 - rho and gamma
    with np.errstate(all="ignore"):
        kalman = np.linalg.eigvalsh(solve_riccati(A, Q, S[None]).P)
        theta, high = 0.0, float(inflate(kalman, np.array([above])).theta[0])
        for _ in range(_ROUNDS):
            if not theta < high < np.inf:
                break
            grid = np.linspace(theta, high, _GRID)[1:]
            G = S - grid[:, None, None] * np.eye(network.n)
            found = solve_riccati(A, Q, G)
            good = is_valid(found.P, grid, found.residual) & (found.residual < _ON_THE_BRANCH)
            loops = A @ stacked.inverse(np.eye(network.n) + np.where(good[:, None, None], found.P, 0.0) @ G)
            radius = spectral_radius(loops)
            good &= radius < 1
            last = len(grid) if good.all() else int(np.argmin(good))
            high = grid[min(last, len(grid) - 1)]
            if last:
                theta = float(grid[last - 1])
                below.append((1 - float(radius[last - 1]), float(gamma(found.P[last - 1], theta))))
    if len(below) < 2:
        return below[0][1] if below else 0.0
    # gamma and rho both go like the root of what theta lacks, so that gamma is straight in 1 - rho.
    (far, before), (near, now) = below[-2:]
    return min(now + (now - before) * near / (far - near) if far > near else now, above)


def _loop_at_theta(
    A: Float[ndarray, "n n"], S: Float[ndarray, "*K n n"], V: Float[ndarray, "*K n n"], theta: Float[ndarray, "*K"]
) -> Float[ndarray, "*K n n"]:
    """A Z P^-1 = A (I + V S)^-1 (I + theta V), the closed loop of the Riccati equation at fixed theta."""
    return A @ condition(V, S).loop @ (np.eye(len(A)) + theta[..., None, None] * V)
