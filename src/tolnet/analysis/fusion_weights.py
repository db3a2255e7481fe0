"""Covariance-intersection weights without an SDP solver, many problems at once: the front door and the frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.fusion_newton import BOLD, CAREFUL, Haste, Solution, minimise
from tolnet.analysis.stacked import cholesky, finite_members, inverse, symmetric_part
from tolnet.model import InputError, ShapeError
from tolnet.model.fusion_weights import FusionWeights

BLOCK = 512
"""Problems that are solved together: their arrays stay in the cache."""
_ASYMMETRY = 1e-8
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
    Assumes that Omega(a) > 0, or the mean of the Omega_j where there is no a. Newton's method on the optimality
    conditions of the logarithmic barrier, with the multipliers beside the weights, until the relative `gap` of the
    certificate is reached; statuses and residuals of the result are recomputed from the answer. Nothing else than the
    reference weights is returned where they are optimal themselves.
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
    found = Solution(np.empty((count, J)), np.empty((count, n, n)), np.empty(count, dtype=int))
    for start in range(0, count, BLOCK):
        some = slice(start, start + BLOCK)
        solved = _solve_block(Omega[some], None if a is None else a[some], gap)
        for whole, part in zip(found, solved, strict=True):
            whole[some] = part
        if progress is not None:
            progress(min(start + BLOCK, count), count)
    return FusionWeights(
        information=information,
        reference=reference,
        weights=found.weights.reshape(*stack, J),
        multiplier=found.multiplier.reshape(*stack, n, n),
        iterations=found.iterations.reshape(stack),
        method="newton",
    )


class Frame(NamedTuple):
    """The problem in the coordinates x = T y in which Omega of the start is the identity, eq. (13.6.2).

    There tr P is tr(M P), M = T' T, which is divided by its trace: the objective starts at 1.
    """

    T: Float[ndarray, "B n n"]
    Omega: Float[ndarray, "B J n n"]
    M: Float[ndarray, "B n n"]
    scale: Float[ndarray, " B"]
    """tr P at the start."""


def frame(information: Float[ndarray, "B J n n"], start: Float[ndarray, "B J"]) -> Frame:
    """Change the coordinates; NaN where Omega(start) is not positive definite."""
    T = inverse(cholesky(np.einsum("bj,bjkl->bkl", start, information))).mT
    Omega = symmetric_part(T.mT[:, None] @ information @ T[:, None])
    M = T.mT @ T
    scale = np.trace(M, axis1=1, axis2=2)
    return Frame(T, Omega, M / scale[:, None, None], scale)


def check_problems(information: Float[ndarray, "*B J n n"], reference: Float[ndarray, "*B J"] | None) -> None:
    """Refuse what is no stack of problems. Raises InputError or ShapeError, with the index of the first culprit."""
    if information.ndim < 3 or information.shape[-1] != information.shape[-2] or 0 in information.shape[-3:]:
        raise ShapeError(f"information has shape {information.shape}; (..., J, n, n) was expected, J and n at least 1")
    scale = np.sqrt(np.einsum("...ii->...i", np.abs(information)))
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
        raise InputError(f"reference{_place(off[..., None, None])} is no set of weights >= 0 that sum to one")


def _place(culprits: ndarray) -> str:
    """The index of the first culprit, without the two axes of its matrix."""
    return "".join(f"[{i}]" for i in np.argwhere(culprits)[0][:-2])


def _solve_block(Omega: Float[ndarray, "B J n n"], a: Float[ndarray, "B J"] | None, gap: float) -> Solution:
    """Boldly, then carefully where that failed; the reference weights where they are optimal."""
    solution = _minimise(Omega, a, gap, BOLD)
    found = _judged(Omega, a, solution)
    again = np.flatnonzero(~found.ok & np.isfinite(found.trace))
    if again.size:
        careful = _minimise(Omega[again], None if a is None else a[again], gap, CAREFUL)
        for whole, part in zip(solution, careful, strict=True):
            whole[again] = part
        found = _judged(Omega, a, solution)
    if a is None:
        return solution
    # feasible without rounding, and nothing new to tell anybody
    same = _judged(Omega, a, solution._replace(weights=a))
    prefer = same.ok & (same.trace <= found.trace * (1 + _SAME))
    return solution._replace(weights=np.where(prefer[:, None], a, solution.weights))


def _judged(Omega: Float[ndarray, "B J n n"], a: Float[ndarray, "B J"] | None, solution: Solution) -> FusionWeights:
    return FusionWeights(Omega, a, solution.weights, solution.multiplier, solution.iterations, "newton")


def _minimise(
    information: Float[ndarray, "B J n n"], reference: Float[ndarray, "B J"] | None, gap: float, haste: Haste
) -> Solution:
    """Solve in the frame of the start, and bring the multipliers back."""
    B, J, n, _ = information.shape
    start = np.full((B, J), 1 / J) if reference is None else reference
    finite = np.isfinite(information).all(axis=(1, 2, 3))
    within = frame(np.where(finite[:, None, None, None], information, 0.0), start)
    usable = np.flatnonzero(finite & finite_members(within.T))
    weights, multiplier, iterations = np.array(start), np.zeros((B, n, n)), np.zeros(B, dtype=int)
    if usable.size:
        found = minimise(
            within.Omega[usable], within.M[usable], constrained=reference is not None, gap=gap, haste=haste
        )
        weights[usable], iterations[usable] = without_empty(found.weights, information[usable]), found.iterations
        T, scale = within.T[usable], within.scale[usable, None, None]
        multiplier[usable] = symmetric_part(T @ (scale * found.multiplier) @ T.mT)
    return Solution(weights, multiplier, iterations)


def without_empty(weights: Float[ndarray, "B J"], information: Float[ndarray, "B J n n"]) -> Float[ndarray, "B J"]:
    """Nothing for slots without a pair: what a barrier left there only dilutes the others."""
    kept = np.where((information != 0).any(axis=(-1, -2)), weights, 0.0)
    return kept / kept.sum(axis=-1, keepdims=True)
