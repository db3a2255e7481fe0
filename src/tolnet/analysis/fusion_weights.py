"""Covariance-intersection weights without an SDP solver, many problems at once: the front door."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.analysis.fusion_frame import frame
from tolnet.analysis.fusion_newton import BOLD, CAREFUL, Haste, minimise
from tolnet.analysis.fusion_room import prove_no_room
from tolnet.analysis.stacked import finite_members
from tolnet.model import FusionWeights, InputError, ShapeError
from tolnet.model.fusion_weights import lower_bound

BLOCK = 384
"""Problems that are solved together: their arrays stay in the cache."""
_ASYMMETRY = 1e-8
_WANTED = 1e-6
"""A gap above this is worth a second try."""
_SAME = 1e-8
"""Reference weights count as optimal where nothing is better by this part."""

Progress = Callable[[int, int], None]


def solve_fusion_weights(
    information: Float[ndarray, "*B J n n"],
    reference: Float[ndarray, "*B J"] | None = None,
    *,
    gap: float = 1e-8,
    progress: Progress | None = None,
) -> FusionWeights:
    """Minimise tr P over the weights of a covariance intersection, eq. (17), for every member of a stack.

        P = (sum_j delta_j Omega_j)^-1,   delta >= 0,   sum_j delta_j = 1;   with `reference` a:   P <= Omega(a)^-1

    Omega_j >= 0 is the inverse of the j-th covariance; a slot without a pair is a zero matrix and gets no weight.
    Assumes that Omega(a) > 0, or the mean of the Omega_j where there is no a. Where a short proof says that P = P_0
    is all that is allowed, the reference weights are the answer, and one pair alone where that is optimal, both after
    no iterations; else Newton's method on the optimality conditions of the logarithmic barrier, with the multipliers
    beside the weights, until the relative `gap` of the certificate is reached. Statuses and residuals of the result
    are recomputed from the answer. Nothing else than the reference weights is returned where they are optimal
    themselves.
    Shapes: (*stack, J, n, n) and (*stack, J). `progress(done, total)` counts problems.
    Raises InputError for matrices that are not symmetric and for reference weights that are no weights, ShapeError
    where shapes do not fit.
    Source: docs/mathematics.md, section 13.6.
    """
    check_problems(information, reference)
    *stack, J, n, _ = information.shape
    count = int(np.prod(stack))
    Omega = information.reshape(count, J, n, n)
    a = None if reference is None else reference.reshape(count, J)
    weights = np.full((count, J), 1 / J) if a is None else np.array(a)
    bound, iterations = np.full(count, np.nan), np.zeros(count, dtype=int)
    finite = np.flatnonzero(np.isfinite(Omega).all(axis=(1, 2, 3)))
    settled = np.zeros(count, dtype=bool)
    if a is not None:
        for some in _blocks(finite):
            bound[some], settled[some] = prove_no_room(Omega[some], a[some], gap)
    rest = finite[~settled[finite]]
    done = count - len(rest)
    for some in _blocks(rest):
        if progress is not None:
            progress(done, count)
        found = _solve_block(Omega[some], None if a is None else a[some], bound[some], gap)
        weights[some], bound[some], iterations[some] = found.weights, found.bound, found.iterations
        done += len(some)
    if progress is not None:
        progress(count, count)
    return FusionWeights(
        information=information,
        reference=reference,
        weights=weights.reshape(*stack, J),
        bound=bound.reshape(stack),
        iterations=iterations.reshape(stack),
        method="newton",
    )


def check_problems(information: Float[ndarray, "*B J n n"], reference: Float[ndarray, "*B J"] | None) -> None:
    """Refuse what is no stack of problems. Raises InputError or ShapeError, with the index of the first culprit."""
    if information.ndim < 3 or information.shape[-1] != information.shape[-2] or 0 in information.shape[-3:]:
        raise ShapeError(
            f"information has shape {information.shape}; (..., J, n, n) was expected, J and n at least 1"
        )
    if (information != information.mT).any():  # mostly not, and then nothing large is allocated
        scale = np.sqrt(np.abs(np.einsum("...ii->...i", information)))
        with np.errstate(invalid="ignore"):
            skew = np.abs(information - information.mT) > _ASYMMETRY * scale[..., :, None] * scale[..., None, :]
        if skew.any():
            raise InputError(f"information{_place(skew)} is not symmetric")
    if reference is None:
        return
    if reference.shape != information.shape[:-2]:
        raise ShapeError(f"reference has shape {reference.shape}; {information.shape[:-2]} was expected")
    off = ~(reference >= 0) | (np.abs(reference.sum(axis=-1, keepdims=True) - 1) > 1e-9)
    if off.any():
        raise InputError(
            f"reference{_place(off.any(axis=-1)[..., None, None])} is no set of weights >= 0 that sum to one"
        )


def _place(culprits: ndarray) -> str:
    """The index of the first culprit, without the two axes of its matrix."""
    return "".join(f"[{i}]" for i in np.argwhere(culprits)[0][:-2])


def _blocks(members: Int[ndarray, " K"]) -> list[Int[ndarray, " k"]]:
    return [members[start : start + BLOCK] for start in range(0, len(members), BLOCK)]


def _solve_block(
    Omega: Float[ndarray, "B J n n"], a: Float[ndarray, "B J"] | None, known: Float[ndarray, " B"], gap: float
) -> FusionWeights:
    """One pair alone where that is it; else boldly, then carefully; the reference weights where they are optimal.

    `known` are bounds that the reference weights may be measured by as well; NaN where there is none.
    """
    found = _minimise(Omega, a, gap, BOLD) if a is None else _alone(Omega, a)
    for haste in (CAREFUL,) if a is None else (BOLD, CAREFUL):
        again = np.flatnonzero(~(found.ok & (found.gap <= _WANTED)) & np.isfinite(found.trace))
        if again.size:
            found = found.with_members(again, _minimise(Omega[again], None if a is None else a[again], gap, haste))
    if a is None:
        return found
    # feasible without rounding, and nothing new to tell anybody
    bound = np.fmax(found.bound, known)
    same = FusionWeights(Omega, a, a, bound, found.iterations, "newton")
    prefer = same.ok & (same.trace <= found.trace * (1 + _SAME)) | ~found.ok & (same.gap <= _WANTED)
    weights = np.where(prefer[:, None], a, found.weights)
    return FusionWeights(Omega, a, weights, np.where(prefer, bound, found.bound), found.iterations, "newton")


def _alone(Omega: Float[ndarray, "B J n n"], a: Float[ndarray, "B J"]) -> FusionWeights:
    """All weight on the pair by which tr P falls fastest from the reference weights, and what that proves without Z.

    Where that pair leaves no P, the reference weights.
    """
    nothing, none = np.full(len(a), np.nan), np.zeros(len(a), dtype=int)
    P = FusionWeights(Omega, a, a, nothing, none, "newton").covariance
    fastest = np.einsum("bjkl,bkl->bj", Omega, P @ P).argmax(axis=1)
    weights = np.eye(a.shape[1])[fastest]
    P = FusionWeights(Omega, a, weights, nothing, none, "newton").covariance
    exists = finite_members(P)
    weights = np.where(exists[:, None], weights, a)
    bound = np.where(exists, lower_bound(Omega, None, P, None), np.nan)
    return FusionWeights(Omega, a, weights, bound, none, "newton")


def _minimise(
    information: Float[ndarray, "B J n n"],
    reference: Float[ndarray, "B J"] | None,
    gap: float,
    haste: Haste,
) -> FusionWeights:
    """Solve in the frame of the start, and bring the multipliers back."""
    B, J, n, _ = information.shape
    start = np.full((B, J), 1 / J) if reference is None else reference
    within = frame(information, start)
    usable = np.flatnonzero(finite_members(within.T))
    weights, Z, iterations = np.array(start), np.zeros((B, n, n)), np.zeros(B, dtype=int)
    if usable.size:
        found = minimise(
            within.Omega[usable], within.M[usable], constrained=reference is not None, gap=gap, haste=haste
        )
        weights[usable], iterations[usable] = without_empty(found.weights, information[usable]), found.iterations
        Z[usable] = within.back(found.multiplier, usable)
    found = FusionWeights(information, reference, weights, np.full(B, np.nan), iterations, "newton")
    bound = lower_bound(information, reference, found.covariance, Z, found.weights)
    return FusionWeights(information, reference, weights, bound, iterations, "newton")


def without_empty(weights: Float[ndarray, "B J"], information: Float[ndarray, "B J n n"]) -> Float[ndarray, "B J"]:
    """Nothing for slots without a pair: what a barrier left there only dilutes the others."""
    kept = np.where((information != 0).any(axis=(-1, -2)), weights, 0.0)
    return kept / kept.sum(axis=-1, keepdims=True)
