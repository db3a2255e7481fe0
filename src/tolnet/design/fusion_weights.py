"""Fusion weights, eq. (17): one door for the fast method and for the solvers that it is measured against."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.fusion_frame import frame
from tolnet.analysis.fusion_weights import check_problems, solve_fusion_weights, without_empty
from tolnet.analysis.stacked import symmetric_part
from tolnet.design.fusion_sdp import solver_for
from tolnet.model import FusionWeights
from tolnet.model.fusion_weights import lower_bound

FusionMethod = Literal["auto", "newton", "clarabel", "cvxpy"]
Progress = Callable[[int, int], None]


def choose_fusion_weights(
    information: Float[ndarray, "*B J n n"],
    reference: Float[ndarray, "*B J"] | None = None,
    *,
    method: FusionMethod = "auto",
    progress: Progress | None = None,
) -> FusionWeights:
    """Choose the weights of a covariance intersection with the least trace, eq. (17), for every member of a stack.

        min tr P,   P = (sum_j delta_j Omega_j)^-1   over the simplex;   with `reference` a also   P <= Omega(a)^-1

    `newton` is the method of analysis.solve_fusion_weights; `clarabel` and `cvxpy` solve the semidefinite program,
    one problem after the other. `auto` is `newton`, and `clarabel` for members where that does not reach the
    certified gap. Whoever solved it: weights are clipped at zero and sum to one, and `status` says what the
    recomputed gap and violation of them say; `or_reference()` falls back on Algorithm 1, which is `reference`.
    Shapes: (*stack, J, n, n) and (*stack, J). Raises InputError and ShapeError as analysis.solve_fusion_weights does.
    Source: eqs. (15)-(18); docs/mathematics.md, section 13.6.
    """
    if method in ("clarabel", "cvxpy"):
        check_problems(information, reference)
        return _by_program(information, reference, method, progress)
    found = solve_fusion_weights(information, reference, progress=progress)
    again = ~found.ok & np.isfinite(found.trace)
    if method == "newton" or not again.any():
        return found
    slow = _by_program(information[again], None if reference is None else reference[again], "clarabel", None)
    return found.with_members(again, slow)


def _by_program(
    information: Float[ndarray, "*B J n n"],
    reference: Float[ndarray, "*B J"] | None,
    method: Literal["clarabel", "cvxpy"],
    progress: Progress | None,
) -> FusionWeights:
    *stack, J, n, _ = information.shape
    count = int(np.prod(stack))
    Omega = information.reshape(count, J, n, n)
    start = np.full((count, J), 1 / J) if reference is None else reference.reshape(count, J)
    weights, iterations = np.array(start), np.zeros(count, dtype=int)
    Z = np.zeros((count, n, n))
    finite = np.asarray(np.isfinite(Omega).all(axis=(1, 2, 3)))
    within = frame(np.where(finite[:, None, None, None], Omega, 0.0), start)
    program = solver_for(method, J, n, reference is not None)
    for b in np.flatnonzero(finite & np.isfinite(within.scale)):
        answer = program.solve(within.Omega[b], within.M[b])
        if answer is not None:
            weights[b], iterations[b] = np.maximum(answer.weights, 0.0), answer.iterations
            Z[b] = answer.Z
        if progress is not None:
            progress(int(b) + 1, count)
    weights = without_empty(weights, Omega)
    a = None if reference is None else start
    Z = within.back(_positive_part(Z), np.arange(count))
    P = FusionWeights(Omega, a, weights, np.zeros(count), iterations, method).covariance
    bound = lower_bound(Omega, a, P, Z, weights)
    return FusionWeights(
        information, reference, weights.reshape(*stack, J), bound.reshape(stack), iterations.reshape(stack), method
    )


def _positive_part(Z: Float[ndarray, "B n n"]) -> Float[ndarray, "B n n"]:
    """A solver's multiplier is positive semidefinite up to its accuracy; a bound needs one that is."""
    values, U = np.linalg.eigh(symmetric_part(Z))
    return U * np.maximum(values, 0.0)[:, None, :] @ U.mT
