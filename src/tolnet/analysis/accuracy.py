"""How many digits of a steady state rounding has left, in the units of each state (docs/mathematics.md, 4.8).

1.  T is evaluated with an error between -D and D in the Loewner order, for u = n eps
        D = u (n diag(q) + A Z diag(W) Z A' + c theta_c A Z^2 A') + (u + n e) K diag(p) K' + n d diag(p)
    q_i = (|A| z)_i^2 + Q_ii with z^2 = diag Z: the products A Z A'.   W_i = 1 / v_i + (|U|' s)_i^2 with s^2 = diag S:
    the rounding of S, of U'SU and of the solve.   theta_c = d theta / d c: the rounding of c.   p = diag P, and
    e = max |U diag(lambda) U' - P|_ij / sqrt(p_i p_j): the eigenvectors of P.   d = max |T - P|_ij / sqrt(p_i p_j)
    (|X_ij| <= eps x_i x_j gives X <= n eps diag(x^2); nothing here is a difference of large numbers)
2.  the fixed point moves by about E = (I - T')^-1 D; in the Kalman filter's case that is a bound
3.  P, V, the gain A Z C' R^-1/2 and the radii move with E by their own derivatives
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis import stacked
from tolnet.analysis.fixed_point import DENSE_UP_TO, Derivative, Filtered, Inflated, Recursion, Step, relative_defect, resolve, uncancelled

_EPS = np.finfo(float).eps
_SMALL = 1e-3  # an attraction below which its relative error is looked at apart
_SENSITIVE = 1e-10  # an error of the loop's spectral radius above which the attraction's is looked at, too


def relative_error(
    recursion: Recursion, P: Float[ndarray, "K n n"], taken: Step, slope: Derivative
) -> Float[ndarray, " K"]:
    """The largest relative error of P and V in the units of each state, of theta, and of the gain in those of its noise.

    `taken` is the step from the fixed point P and `slope` its derivative there. NaN or inf where nothing can be said.
    """
    n = len(recursion.A)
    at, (Z, _, AZ) = taken.at, taken.filtered
    U, root = at.U, slope.root
    v = at.eigenvalues * (1 + at.excess)
    # Line 1 in the coordinates of the derivative.
    u, e = n * _EPS, reconstruction(P, at)
    D = slope.into(step_rounding(recursion.A, recursion.Q, recursion.S, at, taken.filtered))
    defect = relative_defect(recursion, taken.following - P, P)
    np.einsum("kii->ki", D)[...] += (n * defect)[:, None] * uncancelled(at) / root**2
    D += (slope.loop * ((u + n * e)[:, None] * uncancelled(at) / root**2)[:, None, :]) @ slope.loop.mT
    D += (u * _rise(recursion, at))[:, None, None] * slope.thrust
    E = resolve(slope, D)
    # Line 3. -dV^-1 in the eigenbasis, as in lines 4 and 5 of `fixed_point`.
    dtheta = slope.dtheta(E)
    ratio = root / at.eigenvalues
    inverse = slope.q * E * ratio[:, :, None] * ratio[:, None, :]
    np.einsum("kii->ki", inverse)[...] += dtheta[:, None]
    dV = np.einsum("kai,kij,kaj->ka", U * v[:, None, :], inverse, U * v[:, None, :])
    V = np.einsum("kai,ki,kai->ka", U, v, U)
    variance = np.einsum("kii->ki", P)
    dP = np.einsum("kaa->ka", slope.out_of(E))
    np.einsum("kii->ki", inverse)[...] += u * _weights(recursion.S, at)
    gain = AZ @ (U.mT @ recursion.S @ U)
    error = AZ @ inverse @ Z
    moved = np.einsum("kai,kij,kaj->ka", error, U.mT @ recursion.S @ U, error)
    size = np.einsum("kai,kai->ka", gain, AZ)
    moved, size = moved / _positive(variance), size / _positive(variance)
    errors = [_largest(dP, variance), _largest(dV, V), np.sqrt(_share(moved, size)), n * e]
    errors.append(np.where(at.theta > 0, np.abs(dtheta) / _positive(at.theta), 0.0))
    return np.max(np.stack(errors), axis=0)


def step_rounding(
    A: Float[ndarray, "n n"], Q: Float[ndarray, "n n"], S: Float[ndarray, "K n n"], at: Inflated, filtered: Filtered
) -> Float[ndarray, "K n n"]:
    """D of line 1 for given V and S: what rounding does to A (V^-1 + S)^-1 A' + Q."""
    U, n = at.U, len(A)
    z = np.sqrt(np.maximum(np.einsum("kij,kij->ki", U @ filtered.Z, U), 0.0))
    D = (filtered.AZ * _weights(S, at)[:, None, :]) @ filtered.AZ.mT
    np.einsum("kii->ki", D)[...] += n * ((z @ np.abs(A).T) ** 2 + np.diagonal(Q))
    return n * _EPS * D


def _weights(S: Float[ndarray, "K n n"], at: Inflated) -> Float[ndarray, "K n"]:
    """W of line 1."""
    s = np.sqrt(np.einsum("kii->ki", S))
    return 1.0 / (at.eigenvalues * (1 + at.excess)) + np.einsum("kji,kj->ki", np.abs(at.U), s) ** 2


def reconstruction(P: Float[ndarray, "K n n"], at: Inflated) -> Float[ndarray, " K"]:
    """max |U diag(lambda) U' - P|_ij / sqrt(P_ii P_jj): LAPACK's eigenvectors may lose states of small variance."""
    scale = np.sqrt(_positive(np.einsum("kii->ki", P)))
    gap = (at.U * at.eigenvalues[:, None, :]) @ at.U.mT - P
    return np.abs(gap / scale[:, :, None] / scale[:, None, :]).max(axis=(-1, -2))


def _rise(recursion: Recursion, at: Inflated) -> Float[ndarray, " K"]:
    """c d theta / d c at fixed P: c / sum h_i lambda_i (tau = 0; near that for the others)."""
    h = at.excess * (1 + at.excess)
    weight = (h * at.eigenvalues).sum(axis=-1)
    return np.where(weight > 0, recursion.tolerance / _positive(weight), 0.0)


def _positive(x: ndarray) -> ndarray:
    return np.where(x > 0, x, 1.0)


def _largest(change: Float[ndarray, "K n"], size: Float[ndarray, "K n"]) -> Float[ndarray, " K"]:
    """The largest relative change of a variance that is not zero."""
    return (np.abs(change) / _positive(size) * (size > 0)).max(axis=-1)


def _share(change: Float[ndarray, "K n"], size: Float[ndarray, "K n"]) -> Float[ndarray, " K"]:
    """The largest change beside the largest size."""
    largest = size.max(axis=-1)
    return np.where(largest > 0, np.abs(change).max(axis=-1) / _positive(largest), 0.0)


def error_loop(taken: Step) -> Float[ndarray, "K n n"]:
    """M = A Z V^-1 in coordinates in which V is the identity: there |M| <= 1."""
    at, filtered = taken.at, taken.filtered
    v = at.eigenvalues * (1 + at.excess)
    M_U = at.U.mT @ filtered.AZ / v[:, None, :]
    root = np.sqrt(np.maximum(v, _EPS * uncancelled(at)))
    return M_U * root[:, None, :] / root[:, :, None]


def radius_error(F: Float[ndarray, "K d d"], error: Float[ndarray, " K"]) -> Float[ndarray, " K"]:
    """The relative error of the spectral radius of F under perturbations of relative norm d eps + `error`.

    First order, for the eigenvalue of largest modulus: |dF| / |y* x| with unit left and right eigenvectors.
    """
    finite = stacked.finite_members(F)
    values, X = np.linalg.eig(np.where(finite[:, None, None], F, 0.0))
    Y = stacked.inverse(X)
    largest = np.abs(values).argmax(axis=-1)
    k = np.arange(len(F))
    sensitivity = np.linalg.norm(X[k, :, largest], axis=-1) * np.linalg.norm(Y[k, largest, :], axis=-1)
    radius, size = np.abs(values[k, largest]), stacked.norm(F)
    relative = (F.shape[-1] * _EPS + error) * size * sensitivity / _positive(radius)
    return np.where(radius > 0, relative, np.where(size > 0, np.inf, 0.0))


def estimated_error(
    recursion: Recursion, P: Float[ndarray, "K n n"], taken: Step, slope: Derivative, attraction: Float[ndarray, " K"]
) -> Float[ndarray, " K"]:
    """The largest relative error of P, V, theta, the gain, the spectral radius of the loop and the attraction."""
    error = relative_error(recursion, P, taken, slope)
    loop_error = radius_error(error_loop(taken), error)
    largest = np.fmax(error, loop_error)
    largest[np.isnan(error) | np.isnan(loop_error)] = np.inf
    # Where the loop's eigenvalues are well conditioned so are their products; the feedback of theta is of rank one.
    look = np.flatnonzero((recursion.tolerance > 0) & ((attraction < _SMALL) | (loop_error > _SENSITIVE)))
    if look.size and slope.loop.shape[-1] <= DENSE_UP_TO:
        largest[look] = np.fmax(largest[look], radius_error(slope.part(look).matrix(), error[look]))
    return largest
