"""Fusion weights of covariance intersection, with the evidence that they are the best ones."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from tolnet.model.results import _ReadOnly
from tolnet.model.status import Status

GAP = 1e-4
"""A relative gap up to which weights are accepted. Whatever it is they are safe; a general solver proves no more."""
VIOLATION = 1e-9
"""How far P <= P_0 may fail, in parts of P_0; rounding in the recursion of the covariances is about as large."""


@dataclass(frozen=True, eq=False, repr=False)
class FusionWeights(_ReadOnly):
    """Weights delta of one fusion, or of a stack of them (leading axes), from the solver that `method` names.

        min tr P,   P = Omega(delta)^-1,   Omega(delta) = sum_j delta_j Omega_j,   delta >= 0,   sum_j delta_j = 1,
        and, where there are reference weights a,   P <= P_0 = Omega(a)^-1                              eq. (17)

    `bound` is below the least trace, proved by multipliers (`lower_bound`); what weights reach is recomputed here.
    Shapes: (*stack, J, n, n) for Omega, (*stack, J) for weights. Units: those of the state squared for P.
    """

    information: Float[ndarray, "*B J n n"]
    reference: Float[ndarray, "*B J"] | None
    weights: Float[ndarray, "*B J"]
    bound: Float[ndarray, "*B"]
    iterations: Int[ndarray, "*B"]
    method: str

    @cached_property
    def covariance(self) -> Float[ndarray, "*B n n"]:
        """P."""
        return _invert(_combine(self.weights, self.information))

    @cached_property
    def trace(self) -> Float[ndarray, "*B"]:
        """tr P."""
        return np.asarray(np.trace(self.covariance, axis1=-2, axis2=-1))

    @cached_property
    def gap(self) -> Float[ndarray, "*B"]:
        """By how much, relative to tr P, the least trace can be below this one at most."""
        return np.asarray(1 - self.bound / self.trace)

    @cached_property
    def violation(self) -> Float[ndarray, "*B"]:
        """The least v >= 0 with P <= (1 + v) P_0 to first order: minus the least eigenvalue of P_0 P^-1 - I."""
        if self.reference is None:
            return np.zeros(self.weights.shape[:-1])
        found = np.zeros(self.weights.shape[:-1])
        moved = (self.weights != self.reference).any(axis=-1)
        found[moved] = _violation(self.information[moved], self.reference[moved], self.weights[moved])
        return found

    @cached_property
    def ok(self) -> Bool[ndarray, "*B"]:
        """Where the weights are feasible and optimal as recomputed here, whatever the solver said."""
        simplex = (self.weights >= 0).all(axis=-1) & (np.abs(self.weights.sum(axis=-1) - 1) < 1e-12)
        return np.asarray(simplex & (self.gap <= GAP) & (self.violation <= VIOLATION))

    @cached_property
    def status(self) -> ndarray:
        """One of `Status` as text for each: `ok`, `not-converged`, or `singular` where no P exists."""
        exists = np.isfinite(self.trace) & np.isfinite(self.information).all(axis=(-1, -2, -3))
        return np.where(self.ok, str(Status.OK), np.where(exists, str(Status.NOT_CONVERGED), str(Status.SINGULAR)))

    def with_members(self, members: ndarray, other: FusionWeights) -> FusionWeights:
        """The same with some members (a mask or indices) solved anew."""
        parts = [np.array(part) for part in (self.weights, self.bound, self.iterations)]
        for whole, part in zip(parts, (other.weights, other.bound, other.iterations), strict=True):
            whole[members] = part
        weights, bound, iterations = parts
        method = self.method if other.method == self.method else f"{self.method}, {other.method}"
        return FusionWeights(self.information, self.reference, weights, bound, iterations, method)

    def or_reference(self) -> Float[ndarray, "*B J"]:
        """The weights where they are `ok`, and elsewhere those of Algorithm 1, the reference weights."""
        if self.reference is None:
            raise ValueError("there are no reference weights to fall back on")
        return np.where(self.ok[..., None], self.weights, self.reference)

    def __repr__(self) -> str:
        count, J = int(np.prod(self.weights.shape[:-1])), self.weights.shape[-1]
        return f"<FusionWeights ({self.method}): {count} of {J} pairs each, {int(self.ok.sum())} ok>"


def lower_bound(
    information: Float[ndarray, "*B J n n"],
    reference: Float[ndarray, "*B J"] | None,
    V: Float[ndarray, "*B n n"],
    Z: Float[ndarray, "*B n n"],
) -> Float[ndarray, "*B"]:
    """2 tr V - max_j tr(Omega_j (V V' + Z)) + tr(Z Omega(a)), for any V and Z >= 0: below tr P of allowed weights.

    Proof: tr P >= 2 tr V - tr(V' Omega V) for P = Omega^-1, since (P - V)' Omega (P - V) >= 0; then
    tr(Z (Omega(delta) - Omega(a))) >= 0, and a mean over j is at most the largest. Equality at the optimum, with
    V = P and Z the multiplier of P <= P_0; without reference weights and Z, trace less bound is the Frank-Wolfe gap.
    """
    most = np.einsum("...jkl,...kl->...j", information, V @ V.mT + Z).max(axis=-1)
    bound = 2 * np.trace(V, axis1=-2, axis2=-1) - most
    if reference is None:
        return np.asarray(bound)
    return np.asarray(bound + np.einsum("...ij,...ij->...", Z, _combine(reference, information)))


def _violation(
    information: Float[ndarray, "K J n n"], reference: Float[ndarray, "K J"], weights: Float[ndarray, "K J"]
) -> Float[ndarray, " K"]:
    root = _whitener(_combine(reference, information))
    white = root.mT @ _combine(weights - reference, information) @ root
    finite = np.asarray(np.isfinite(white).all(axis=(-1, -2)))
    least = np.linalg.eigvalsh(np.where(finite[:, None, None], white, 0.0))[:, 0]
    return np.where(finite, np.maximum(-least, 0.0), np.nan)


def _combine(weights: Float[ndarray, "*B J"], information: Float[ndarray, "*B J n n"]) -> Float[ndarray, "*B n n"]:
    return np.einsum("...j,...jkl->...kl", weights, information)


def _whitener(X: Float[ndarray, "*B n n"]) -> Float[ndarray, "*B n n"]:
    """T with T' X T = I; NaN where X is not positive definite."""
    return _factor(X).mT


def _invert(X: Float[ndarray, "*B n n"]) -> Float[ndarray, "*B n n"]:
    """By Cholesky's factor, which does not care about units; NaN where X is not positive definite."""
    root = _factor(X)
    return root.mT @ root


def _factor(X: Float[ndarray, "*B n n"]) -> Float[ndarray, "*B n n"]:
    """The inverse of Cholesky's factor, member by member where one of them has none."""
    try:
        return np.linalg.inv(np.linalg.cholesky(X))
    except np.linalg.LinAlgError:
        if X.ndim == 2:
            return np.full(X.shape, np.nan)
        return np.stack([_factor(each) for each in X])
