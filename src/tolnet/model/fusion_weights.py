"""Fusion weights of covariance intersection, with the evidence that they are the best ones."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from tolnet.model.covariances import psd_factor
from tolnet.model.results import _ReadOnly
from tolnet.model.status import Status

GAP = 1e-4
"""A relative gap up to which weights are accepted. Whatever it is they are safe; a general solver proves no more."""
VIOLATION = 1e-9
"""How far P <= P_0 may fail, in parts of P_0; rounding in the recursion of the covariances is about as large."""
_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False, repr=False)
class FusionWeights(_ReadOnly):
    """Weights delta of one fusion, or of a stack of them (leading axes), from the solver that `method` names.

        min tr P,   P = Omega(delta)^-1,   Omega(delta) = sum_j delta_j Omega_j,   delta >= 0,   sum_j delta_j = 1,
        and, where there are reference weights a,   P <= P_0 = Omega(a)^-1                              eq. (17)

    `bound` is below the least trace, rounding included, and below that of any weights that break P <= P_0 no more
    than these do: proved by multipliers (`lower_bound`). What weights reach is recomputed here; a bound above it is
    none, and nothing that rests on it is `ok`.
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
    def rounding(self) -> Float[ndarray, "*B"]:
        """How far `trace` can be from tr P of these weights divided by their sum, relative to it."""
        return _trace_rounding(self.weights, self.information, self.covariance)

    @cached_property
    def gap(self) -> Float[ndarray, "*B"]:
        """By how much, relative to tr P, the least trace can be below this one at most, rounding included.

        Never negative where `bound` is one.
        """
        return np.asarray(1 - self.bound / (self.trace * (1 + self.rounding)))

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
        return np.asarray(simplex & (self.gap >= 0) & (self.gap <= GAP) & (self.violation <= VIOLATION))

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
    Z: Float[ndarray, "*B n n"] | None,
    weights: Float[ndarray, "*B J"] | None = None,
) -> Float[ndarray, "*B"]:
    """2 tr V - max_j tr(Omega_j (V V' + Z)) + (1 - v) tr(Z Omega(a)), for any V and Z >= 0: below tr P.

    v is how far P <= P_0 is broken: not at all (allowed weights only), or as far as `weights` do, whose trace it is
    then below as well.

    Proof: tr P >= 2 tr V - tr(V' Omega V) for P = Omega^-1, since (P - V)' Omega (P - V) >= 0; then
    tr(Z (Omega(delta) - (1 - v) Omega(a))) >= 0, and a mean over j is at most the largest. Equality at the optimum,
    with V = P and Z the multiplier of P <= P_0; without reference weights and Z, trace less bound is the Frank-Wolfe
    gap.

    Rounding is taken off. With Z = G G' for the G that was computed, so that Z >= 0 is exact, every term is a sum of
    products of doubles; a sum of m of them in any order is wrong by m eps/2 times the sum of their sizes at most
    (Higham, Accuracy and Stability, section 3.1; m eps covers the rounding of this correction too). Weights count as
    what they are divided by their sum. Barring underflow.
    """
    n, J = information.shape[-1], information.shape[-3]
    G = np.zeros_like(V) if Z is None or reference is None else _psd_root(Z)
    seen, seen_size = _inner_sum(information, V)
    pulled, pulled_size = _inner_sum(information, G)
    floor = floor_size = np.zeros(V.shape[:-2])
    if reference is not None:
        share = reference / reference.sum(axis=-1, keepdims=True)
        floor, floor_size = (share * pulled).sum(axis=-1), (share * pulled_size).sum(axis=-1)
    most = (seen + pulled - floor[..., None]).max(axis=-1)
    diagonal = np.diagonal(V, axis1=-2, axis2=-1)
    size = 2 * np.abs(diagonal).sum(axis=-1) + (seen_size + pulled_size).max(axis=-1) + floor_size
    rounding = (n * n + 2 * n + 2 * J + 10) * _EPS * size
    broken = np.zeros(V.shape[:-2])
    if reference is not None and weights is not None:
        moved = (weights != reference).any(axis=-1)
        broken[moved] = _most_violation(information[moved], reference[moved], weights[moved])
    return np.asarray(2 * diagonal.sum(axis=-1) - most - rounding - broken * (floor + floor_size * _EPS * n * n))


def _inner_sum(
    information: Float[ndarray, "*B J n n"], G: Float[ndarray, "*B n n"]
) -> tuple[Float[ndarray, "*B J"], Float[ndarray, "*B J"]]:
    """<Omega_j, G G'> of every j, and the sum of the sizes of all products in it."""
    size = np.abs(G)
    return (
        np.einsum("...jkl,...kl->...j", information, G @ G.mT),
        np.einsum("...jkl,...kl->...j", np.abs(information), size @ size.mT),
    )


def _psd_root(Z: Float[ndarray, "*B n n"]) -> Float[ndarray, "*B n n"]:
    """G with G G' = Z up to rounding, NaN where Z is: Cholesky's factor, or eigenvectors where Z >= 0 is singular."""
    try:
        return np.linalg.cholesky(Z)
    except np.linalg.LinAlgError:
        finite = np.asarray(np.isfinite(Z).all(axis=(-1, -2)))[..., None, None]
        return np.where(finite, psd_factor(np.where(finite, Z, 0.0)), np.nan)


def _trace_rounding(
    weights: Float[ndarray, "*B J"], information: Float[ndarray, "*B J n n"], P: Float[ndarray, "*B n n"]
) -> Float[ndarray, "*B"]:
    """How far tr P can be from that of the exact inverse of Omega(weights), relative to it, however P was computed.

        N >= |I - P Omega|,   Omega^-1 = sum_k (I - P Omega)^k P,   |P| <= s s',   s_k^2 = P_kk:
        |d tr P| <= 2 s' N s   where N s <= s / 2,   since then   N^k s s' <= 2^(1 - k) N s s'

    N is the residual as computed and (n + J + 4) eps |P| sum_j delta_j |Omega_j| for its rounding and that of Omega;
    infinite where it is too large for this. To it, what the sum of the weights is off one.
    """
    J, n = information.shape[-3:-1]
    rounding = (n + J + 4) * _EPS
    with np.errstate(invalid="ignore"):  # what is not finite stays so
        Omega, size = _combine(weights, information), _combine(np.abs(weights), np.abs(information))
        N = np.abs(np.eye(n) - P @ Omega) + rounding * (np.abs(P) @ size)
        s = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
        Ns = (N @ s[..., None])[..., 0]
        off = 2 * (s * Ns).sum(axis=-1) / (s * s).sum(axis=-1) + np.abs(weights.sum(axis=-1) - 1) + rounding
        return np.where((Ns <= s / 2).all(axis=-1), off, np.where(np.isnan(off), np.nan, np.inf))


def _violation(
    information: Float[ndarray, "K J n n"], reference: Float[ndarray, "K J"], weights: Float[ndarray, "K J"]
) -> Float[ndarray, " K"]:
    root = _whitener(_combine(reference, information))
    return _shortfall(root.mT @ _combine(weights - reference, information) @ root)


def _most_violation(
    information: Float[ndarray, "K J n n"], reference: Float[ndarray, "K J"], weights: Float[ndarray, "K J"]
) -> Float[ndarray, " K"]:
    """The violation and what rounding may have hidden of it.

    With T' Omega(a) T = I + F and W = T' (Omega(delta) - Omega(a)) T + E, the least v is (v(W) + |E|) / (1 - |F|) at
    most; |E|, and what F was computed with, is up to (4 n + J + 4) eps | |T|' sum_j (delta_j + a_j) |Omega_j| |T| |.
    """
    J, n = information.shape[-3:-1]
    floor = _combine(reference, information)
    T = _whitener(floor)
    W = T.mT @ _combine(weights - reference, information) @ T
    part = (4 * n + J + 4) * _EPS + np.abs(weights.sum(axis=-1) - 1) + np.abs(reference.sum(axis=-1) - 1)
    size = np.abs(T).mT @ _combine(weights + reference, np.abs(information)) @ np.abs(T)
    E = part * np.linalg.norm(size, axis=(-1, -2))
    F = np.linalg.norm(T.mT @ floor @ T - np.eye(n), axis=(-1, -2)) + E
    return np.where(F <= 0.5, (_shortfall(W) + E) / (1 - F), np.where(np.isnan(F), np.nan, np.inf))


def _shortfall(white: Float[ndarray, "K n n"]) -> Float[ndarray, " K"]:
    """Minus the least eigenvalue, at least 0; NaN where one is not finite."""
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
