"""Stacked linear algebra in which one bad matrix never spoils the others: it comes back as NaN."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Inexact
from numpy import ndarray

_ALIKE = 1e3  # ratio of variances up to which the order of the states does not matter


def solve(a: Inexact[ndarray, "K n n"], b: Inexact[ndarray, "K n m"]) -> Inexact[ndarray, "K n m"]:
    """Solve a x = b for every member of a stack; NaN where a is exactly singular.

    NumPy gives up on the whole stack for one singular member, so a stack that fails is halved until it is alone.
    """
    try:
        return np.linalg.solve(a, b)
    except np.linalg.LinAlgError:
        if len(a) == 1:
            return np.full(b.shape, np.nan)
        half = len(a) // 2
        return np.concatenate([solve(a[:half], b[:half]), solve(a[half:], b[half:])])


def inverse(a: Inexact[ndarray, "K n n"]) -> Inexact[ndarray, "K n n"]:
    """The inverse of every member of a stack; NaN where it is exactly singular."""
    return _one_by_one(np.linalg.inv, a)


def cholesky(a: Float[ndarray, "K n n"]) -> Float[ndarray, "K n n"]:
    """The lower triangular factor of every member of a stack; NaN where it is not positive definite."""
    return _one_by_one(np.linalg.cholesky, a)


def definite(X: Float[ndarray, "K n n"]) -> Bool[ndarray, " K"]:
    """Which symmetric members are positive definite: all pivots of an elimination without exchanges are positive."""
    rest = np.array(np.moveaxis(X, 0, 2))
    positive = rest[0, 0] > 0
    for k in range(len(rest) - 1):
        rest[k + 1 :, k + 1 :] -= rest[k + 1 :, k, None] * (rest[k, None, k + 1 :] / rest[k, k])
        positive &= rest[k + 1, k + 1] > 0  # False for what is not a number
    return positive


def _one_by_one(function: Callable[[ndarray], ndarray], a: Inexact[ndarray, "K n n"]) -> Inexact[ndarray, "K n n"]:
    """Halve a stack that fails until the culprit is alone."""
    try:
        return function(a)
    except np.linalg.LinAlgError:
        if len(a) == 1:
            return np.full(a.shape, np.nan)
        half = len(a) // 2
        return np.concatenate([_one_by_one(function, a[:half]), _one_by_one(function, a[half:])])


def finite_members(X: Inexact[ndarray, "*K n m"]) -> Bool[ndarray, "*K"]:
    """Which members have finite entries only."""
    return np.asarray(np.isfinite(X).all(axis=(-1, -2)))


def eigenvalues(X: Float[ndarray, "K n n"]) -> Float[ndarray, "K n"]:
    """Of symmetric members, in rising order; NaN where X is not finite."""
    finite = finite_members(X)
    values = np.linalg.eigvalsh(X if finite.all() else np.where(finite[:, None, None], X, 0.0))
    return np.where(finite[:, None], values, np.nan)


def symmetric_eigen(P: Float[ndarray, "K n n"]) -> tuple[Float[ndarray, "K n"], Float[ndarray, "K n n"]]:
    """Eigenvalues in rising order and orthonormal eigenvectors; NaN eigenvalues where P is not finite.

    Rows and columns are handed to LAPACK by falling diagonal: a positive definite P whose states are counted in very
    different units then keeps all digits of its small eigenvalues, instead of losing the ratio of the units.
    """
    finite = finite_members(P)
    safe = np.where(finite[:, None, None], P, np.eye(P.shape[-1]))
    diagonal = np.einsum("kii->ki", safe)
    if (diagonal.max(axis=-1, initial=0.0) <= _ALIKE * diagonal.min(axis=-1, initial=np.inf)).all():
        eigenvalues, U = np.linalg.eigh(safe)
        return np.where(finite[:, None], eigenvalues, np.nan), U
    order = np.argsort(-diagonal, axis=-1)
    sorted_rows = np.take_along_axis(safe, order[:, :, None], axis=1)
    eigenvalues, U = np.linalg.eigh(np.take_along_axis(sorted_rows, order[:, None, :], axis=2))
    U = np.take_along_axis(U, np.argsort(order, axis=-1)[:, :, None], axis=1)
    return np.where(finite[:, None], eigenvalues, np.nan), U


def smallest_unit_eigenvalue(P: Float[ndarray, "K n n"]) -> Float[ndarray, " K"]:
    """Of symmetric members scaled to a unit diagonal: the same in all units. -inf for a negative variance; NaN stays.

    A state with variance zero makes it 0 at most.
    """
    variance = np.einsum("kii->ki", P)
    unit = np.sqrt(np.where(variance > 0, variance, 1.0))
    scaled = P / (unit[:, :, None] * unit[:, None, :])
    return np.where((variance < 0).any(axis=-1), -np.inf, eigenvalues(scaled)[:, 0])


def spectral_radius(F: Float[ndarray, "*K n n"]) -> Float[ndarray, "*K"]:
    """Largest absolute value of an eigenvalue; NaN where F is not finite."""
    finite = finite_members(F)
    values = np.linalg.eigvals(np.where(finite[..., None, None], F, 0.0))
    return np.where(finite, np.abs(values).max(axis=-1), np.nan)


def norm(X: Float[ndarray, "*K n n"]) -> Float[ndarray, "*K"]:
    """Frobenius norm of every member."""
    return np.sqrt(np.einsum("...ij,...ij->...", X, X))


def symmetric_part(X: Float[ndarray, "*K n n"]) -> Float[ndarray, "*K n n"]:
    """(X + X') / 2, for products that are symmetric but for rounding."""
    return (X + X.mT) / 2
