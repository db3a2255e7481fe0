"""Performance in the steady state: the Lyapunov equation of the network's error dynamics, eq. (41)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis import lyapunov_dense as dense
from tolnet.analysis.lyapunov_projected import solve_projected
from tolnet.analysis.spectrum import Radii, spectral_radii
from tolnet.model import ErrorDynamics, Performance, Status, UnsupportedError
from tolnet.model.covariances import standard_deviations

Method = Literal["auto", "projected", "smith", "scipy", "slycot"]

_SMALL = 150
"""Up to this dimension squared Smith is the fastest."""
_LARGEST_DENSE = 2000
"""Where projection fails, `auto` goes on with squared Smith up to this dimension: some seconds."""
_MOST_BYTES = 2**31
"""Of the columns of the noise; with the subspace and what it is made from, about twice that is used."""
_WANTED = 1e-8
"""Estimated relative error of the worst MSD_k at which an iteration stops."""
_ACCEPTED = 1e-6
"""Beyond this there is no answer: six digits are promised."""
_SAFETY = 10
"""A correction is itself computed in doubles."""
_DENSE: dict[str, Callable[[ndarray, ndarray], dense.DenseSolution]] = {
    "smith": dense.solve_smith,
    "scipy": dense.solve_scipy,
    "slycot": dense.solve_slycot,
}


class _Answer(NamedTuple):
    blocks: Float[ndarray, "K1 n n"]
    residual: float
    error: float
    iterations: int
    rank: int
    Q: Float[ndarray, "d d"] | None
    why: str = ""
    """Why there is no answer, where that is not the error."""


def solve_lyapunov(dynamics: ErrorDynamics, method: Method | str = "auto") -> Performance:
    """Solve Q = F Q F' + G G' for the diagonal blocks of Q, whose traces are MSD_k, eqs. (40)-(41).

    `auto` takes squared Smith where F is small, and else propagates the noise and projects the slow remainder
    (`projected`, which never forms F or Q), with squared Smith again where that does not reach the accuracy and F is
    not too large. `smith`, `scipy` and `slycot` (optional package) form Q, which the result then carries.
    No answer is a status with a reason: `unstable` (with the spectral radius) where F is not Schur, `not-converged`
    where six digits cannot be vouched for, or that of the dynamics. The residual is recomputed at the end; the
    estimated error multiplies it by how far F amplifies it.
    Raises UnsupportedError for an unknown method, and for `slycot` where it is not installed.
    Source: eqs. (39)-(41); R. A. Smith, SIAM J. Appl. Math. 16(1), 1968; docs/decisions/0003-lyapunov.md.
    """
    if method not in ("auto", "projected", *_DENSE):
        raise UnsupportedError(f"method is {method!r}; expected 'auto', 'projected', {', '.join(map(repr, _DENSE))}")
    if not dynamics.exists:
        return _refuse(dynamics, method, Radii(np.nan, np.nan), dynamics.status, dynamics.reason)
    radii = spectral_radii(dynamics)
    if not np.isfinite(radii.network):
        return _refuse(dynamics, method, radii, Status.NOT_CONVERGED, "the spectral radius of F was not found")
    if not max(radii) < 1:
        return _refuse(dynamics, method, radii, Status.UNSTABLE, f"F has the spectral radius {shown(max(radii))}")
    unit = _units(dynamics)
    chosen, answer = _solve(dynamics.rescaled(unit), method)
    answer = answer._replace(error=max(answer.error, dense.data_error(max(radii))))
    if not answer.error <= _ACCEPTED:
        reason = answer.why or (
            f"the error of the worst MSD is estimated at {answer.error:.2g} of it, more than {_ACCEPTED:g}"
            f" (spectral radius {shown(max(radii))}, relative residual {answer.residual:.2g})"
        )
        return _refuse(dynamics, chosen, radii, Status.NOT_CONVERGED, reason, answer)
    back = unit * unit[:, None]
    return Performance(
        dynamics=dynamics,
        method=chosen,
        status=dynamics.status,
        reason=dynamics.reason,
        blocks=answer.blocks[:-1] * back,
        least_favourable_block=answer.blocks[-1] * back,
        network_radius=radii.network,
        least_favourable_radius=radii.least_favourable,
        residual=answer.residual,
        error_estimate=answer.error,
        iterations=answer.iterations,
        rank=answer.rank,
        Q=None
        if answer.Q is None
        else answer.Q * np.tile(unit, dynamics.filters + 1) * np.tile(unit, dynamics.filters + 1)[:, None],
    )


def _refuse(
    dynamics: ErrorDynamics, method: str, radii: Radii, status: Status, reason: str, answer: _Answer | None = None
) -> Performance:
    """A result without numbers, but for the spectral radii and what is known of the attempt."""
    nan = np.full((dynamics.filters + 1, dynamics.n, dynamics.n), np.nan)
    tried = answer or _Answer(nan, np.nan, np.nan, 0, 0, None)
    return Performance(
        dynamics=dynamics,
        method=method,
        status=status,
        reason=reason,
        blocks=nan[:-1],
        least_favourable_block=nan[-1],
        network_radius=radii.network,
        least_favourable_radius=radii.least_favourable,
        residual=tried.residual,
        error_estimate=tried.error,
        iterations=tried.iterations,
        rank=tried.rank,
        Q=None,
    )


def shown(radius: float) -> str:
    """A spectral radius in words; near 1, its distance from 1."""
    gap = 1 - radius
    return f"{radius:.6f}" if abs(gap) > 1e-4 else f"1 {'-' if gap >= 0 else '+'} {abs(gap):.3g}"


def _units(dynamics: ErrorDynamics) -> Float[ndarray, " n"]:
    """Powers of two near the standard deviations of the centre's errors: no state drowns in another's unit."""
    deviation, _ = standard_deviations(dynamics.model.V)
    return 2.0 ** np.round(np.log2(deviation))


def _solve(dynamics: ErrorDynamics, method: str) -> tuple[str, _Answer]:
    """The method that was chosen, and its answer; parts that nothing connects are solved apart."""
    islands = dynamics.islands() if method in ("auto", "projected") and dynamics.dimension > _SMALL else []
    if len(islands) <= 1:
        return _solve_connected(dynamics, method)
    blocks = np.zeros((dynamics.filters + 1, dynamics.n, dynamics.n))
    solved = [_solve_connected(island.dynamics, method) for island in islands]
    for island, (_, answer) in zip(islands, solved, strict=True):
        blocks[np.ix_(np.append(island.filters, dynamics.filters), island.states, island.states)] = answer.blocks
    name = "projected" if any(name == "projected" for name, _ in solved) else "smith"
    answers = [answer for _, answer in solved]
    return name, _Answer(
        blocks,
        residual=max(answer.residual for answer in answers),
        error=max(answer.error for answer in answers),
        iterations=max(answer.iterations for answer in answers),
        rank=max(answer.rank for answer in answers),
        Q=None,
        why=next((answer.why for answer in answers if answer.why), ""),
    )


def _solve_connected(dynamics: ErrorDynamics, method: str) -> tuple[str, _Answer]:
    if method == "projected" or (method == "auto" and dynamics.dimension > _SMALL):
        answer = _projected(dynamics)
        if method == "projected" or answer.error <= _WANTED or dynamics.dimension > _LARGEST_DENSE:
            return "projected", answer
    name = "smith" if method == "auto" else method
    return name, _dense(dynamics, name)


def _projected(dynamics: ErrorDynamics) -> _Answer:
    needed = 8 * dynamics.dimension * dynamics.columns
    if needed > _MOST_BYTES:
        nan = np.full((dynamics.filters + 1, dynamics.n, dynamics.n), np.nan)
        why = f"the noise of {dynamics.filters:,} filters takes {needed / 2**30:.1f} GiB; at most 2 are used"
        return _Answer(nan, np.nan, np.inf, 0, 0, None, why)
    found = solve_projected(dynamics, _WANTED)
    return _Answer(found.blocks, found.residual, found.error, found.steps, found.rank, None)


def _dense(dynamics: ErrorDynamics, method: str) -> _Answer:
    """A dense solution, and its error from the correction that its residual asks for.

    Squared Smith is refined by that correction until it shrinks no more; peers are left as they are.
    """
    F, D = dynamics.matrix(), dynamics.noise_matrix()
    X, doublings = _DENSE[method](F, D)
    defect = dense.residual(F, D, X)
    error = np.inf
    while np.isfinite(X).all():
        correction = dense.solve_smith(F, defect).X
        size = np.maximum(_traces(dynamics, X), np.finfo(float).tiny)
        before, error = error, _SAFETY * float(np.abs(_traces(dynamics, correction) / size).max())
        if method != "smith" or not error < 0.25 * before:
            break
        X = X + correction
        defect = dense.residual(F, D, X)
        if error <= _WANTED:
            break
    residual = dense.relative_size(defect, X)
    shape = (dynamics.filters + 1, dynamics.n)
    blocks = np.einsum("kikj->kij", X.reshape(*shape, *shape))
    return _Answer(blocks, residual, error, doublings, 0, X)


def _traces(dynamics: ErrorDynamics, X: Float[ndarray, "d d"]) -> Float[ndarray, " K1"]:
    return np.diagonal(X).reshape(dynamics.filters + 1, dynamics.n).sum(axis=1)
