"""Covariance matrices, singular or badly scaled: factors, and what measurements of information S leave of one.

With the standard deviations of V as units, V = U diag(v) U', w_i = 1 / (1 / v_i + (U'SU)_ii), and E the matrix
U'SU + diag(1 / v) scaled by w to a unit diagonal:

    (V^-1 + S)^-1 = U diag(w)^1/2 E^-1 diag(w)^1/2 U',   (I + V S)^-1 = (V^-1 + S)^-1 V^-1

so I + V S, whose rounding may leave nothing of the I, is never formed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

SIX_DIGITS = 1e-6
"""Relative error beyond which nothing is passed on as an answer."""
TOO_PRECISE = "the sensors are so precise beside the covariance that rounding leaves less than six digits"
"""Why that happens: S outweighs V^-1 by so much that the rounding of S hides it."""


class Posterior(NamedTuple):
    """NaN, with an infinite `error`, where V is not finite or where rounding leaves E singular."""

    covariance: Float[ndarray, "*K n n"]
    """Z = (V^-1 + S)^-1."""
    loop: Float[ndarray, "*K n n"]
    """Z V^-1 = (I + V S)^-1, so that A - G C = A Z V^-1."""
    error: Float[ndarray, "*K"]
    """What rounding S alone may do to Z in the units of V, relative: n eps |E^-1|."""


def condition(V: Float[ndarray, "*#K n n"], S: Float[ndarray, "*#K n n"]) -> Posterior:
    """(V^-1 + S)^-1 and (I + V S)^-1 of symmetric positive semidefinite V and S; V may be singular."""
    n = V.shape[-1]
    finite = np.asarray(np.isfinite(V).all(axis=(-1, -2)))
    V = np.where(finite[..., None, None], V, np.eye(n))
    unit, _ = standard_deviations(V)
    v, U = np.linalg.eigh(V / (unit[..., :, None] * unit[..., None, :]))
    v = np.maximum(v, 1e-150)  # too little above zero to change any sum
    information = U.mT @ (unit[..., :, None] * S * unit[..., None, :]) @ U
    root = np.sqrt(1.0 / (1.0 / v + np.diagonal(information, axis1=-2, axis2=-1)))
    E = root[..., :, None] * information * root[..., None, :]
    np.einsum("...ii->...i", E)[...] = 1.0
    rounding = n * np.finfo(float).eps
    least = np.linalg.eigvalsh(E)[..., 0]
    good = finite & (least > rounding)
    E = np.where(good[..., None, None], E, np.eye(n))
    left = unit[..., :, None] * U * root[..., None, :]
    behind = (root / v)[..., :, None] * U.mT / unit[..., None, :]
    ZU, MU = np.split(np.linalg.solve(E, np.concatenate([left.mT, behind], axis=-1)), 2, axis=-1)
    Z, loop = (np.where(good[..., None, None], left @ X, np.nan) for X in (ZU, MU))
    Z = (Z + Z.mT) / 2  # rounding only: the exact matrix is symmetric
    return Posterior(Z, loop, np.where(good, rounding / np.where(good, least, 1.0), np.inf))


def psd_factor(P: Float[ndarray, "*K n n"]) -> Float[ndarray, "*K n n"]:
    """Y with Y Y' = P for a symmetric positive semidefinite P, singular or badly scaled.

    From the eigenvectors of P with its diagonal scaled to one, so that small states keep their digits.
    """
    scale, varies = standard_deviations(P)
    eigenvalues, U = np.linalg.eigh(P / (scale[..., :, None] * scale[..., None, :]))
    return np.where(varies, scale, 0.0)[..., :, None] * U * np.sqrt(np.maximum(eigenvalues, 0.0))[..., None, :]


def standard_deviations(P: Float[ndarray, "*K n n"]) -> tuple[Float[ndarray, "*K n"], Bool[ndarray, "*K n"]]:
    """Roots of the diagonal, 1 in the place of zero, and where they are not zero.

    Zero is what is below 1e-90 of the largest: steady states have 1e-100 for the variance of a state known exactly.
    """
    variance = np.diagonal(P, axis1=-2, axis2=-1)
    varies = variance > 1e-90 * variance.max(axis=-1, keepdims=True, initial=0.0)
    return np.sqrt(np.where(varies, variance, 1.0)), varies
