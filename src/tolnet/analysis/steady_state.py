"""Steady states of the robust filter, one or a million (Algorithm 3 and the central filter)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis import stacked
from tolnet.analysis.continuation import ACCEPT, settle, solve_fixed_points
from tolnet.analysis.detectability import detectability
from tolnet.analysis.divergence import divergence, gamma
from tolnet.analysis.fixed_point import Recursion, attraction, derivative, relative_defect, step
from tolnet.analysis.riccati import solve_riccati
from tolnet.model import Ambiguity, Complaint, InputError, SensorNetwork, Status, SteadyState
from tolnet.model.covariances import SIX_DIGITS, condition

Progress = Callable[[int, int], None]
"""Called with how many filters are done, and how many there are."""

_BLOCK_BYTES = 2**24  # of the largest temporary array: small enough to stay in cache, large enough to amortise calls


def solve_steady_state(network: SensorNetwork, tolerance: float | Ambiguity | None = None) -> SteadyState:
    """The centralised robust filter's steady state, eq. (4):

        P = A (V^-1 + S_tot)^-1 A' + Q,   gamma(P, theta) = c,   V = (P^-1 - theta I)^-1.

    `tolerance` is c on the gamma scale, or an Ambiguity (which may be in nats, or of the tau family); without it the
    network's own is used. c = 0 gives the Kalman filter. No answer is a status (`undetectable`, `unstabilisable`,
    `diverges`, `no-steady-state`), with NaN for numbers; `oscillates` comes with numbers.
    Raises InputError where neither the call nor the network gives a tolerance, or where it is negative or no number.
    """
    ambiguity = resolve_ambiguity(network, tolerance)
    seen = detectability(network)
    status = np.array([_status_before(seen.stabilisable, seen.centre_detectable)])
    return solve_steady_states(
        network.A,
        network.Q,
        network.total_information[None],
        np.array([ambiguity.gamma]),
        tau=ambiguity.tau,
        refused=status,
    )[0]


def solve_local_steady_states(
    network: SensorNetwork,
    tolerances: Float[ndarray, " N"],
    *,
    tau: float = 0.0,
    refused: ndarray | None = None,
    progress: Progress | None = None,
) -> SteadyState:
    """The steady states of every node's filter at its own tolerance (gamma scale): a stack of N, eqs. (12), (44).

    Nodes that miss a mode which does not decay come back `undetectable`, and all as `unstabilisable` where the noise
    misses one on the unit circle; `refused` (N,) holds further statuses known beforehand.
    """
    seen = detectability(network)
    status = np.array([_status_before(seen.stabilisable, bool(good)) for good in seen.detectable], dtype="U16")
    if refused is not None:
        status = np.where(status == Status.OK.value, refused, status)
    return solve_steady_states(
        network.A, network.Q, network.information, tolerances, tau=tau, refused=status, progress=progress
    )


def restore_steady_state(
    network: SensorNetwork,
    tolerance: float,
    P: Float[ndarray, "n n"],
    V: Float[ndarray, "n n"],
    theta: float,
) -> SteadyState:
    """The centre's steady state from stored numbers; nothing is solved, and its residuals say how good it is.

    Radii and iterations, which are not stored, are NaN and 0. Tau is 0.
    """
    central = {"P": P, "V": V, "theta": np.asarray(theta)}
    A, Q, S = network.A, network.Q, network.total_information
    eye = np.eye(network.n)
    riccati = A @ np.linalg.solve(eye + V @ S, V) @ A.T + Q - P
    mismatch = abs(float(gamma(P, theta)) - tolerance) / tolerance if tolerance > 0 else 0.0
    return SteadyState(
        A=A,
        Q=Q,
        S=S,
        tolerance=np.asarray(float(tolerance)),
        tau=0.0,
        spectral_radius=np.asarray(np.nan),
        attraction=np.asarray(np.nan),
        riccati_residual=np.asarray(np.linalg.norm(riccati) / np.linalg.norm(P)),
        tolerance_residual=np.asarray(mismatch),
        iterations=np.asarray(0),
        status=np.asarray(Status.OK.value),
        **central,
    )


def resolve_ambiguity(network: SensorNetwork, tolerance: float | Ambiguity | None) -> Ambiguity:
    """The ambiguity that a call means: its own, or else the network's."""
    if isinstance(tolerance, Ambiguity):
        return tolerance
    if tolerance is not None:
        return Ambiguity(float(tolerance))
    if network.ambiguity is None:
        raise InputError("the network carries no [ambiguity]; give a tolerance")
    return network.ambiguity


def _status_before(stabilisable: bool, detectable: bool) -> str:
    if not stabilisable:
        return Status.UNSTABILISABLE.value
    return Status.OK.value if detectable else Status.UNDETECTABLE.value


def solve_steady_states(
    A: Float[ndarray, "n n"],
    Q: Float[ndarray, "n n"],
    S: Float[ndarray, "K n n"],
    tolerance: Float[ndarray, " K"],
    *,
    tau: float = 0.0,
    refused: ndarray | None = None,
    progress: Progress | None = None,
) -> SteadyState:
    """Solve P = A (V^-1 + S_k)^-1 A' + Q, gamma(P, theta) = c_k for a stack of K filters that share A and Q.

    Structured doubling at fixed theta inside a bracketed search in theta, then Newton's method on P; past the fold
    a path in c. Blocks of filters run on all cores. `refused` (K,) holds statuses known beforehand, such as
    `undetectable`: filters whose entry is not `ok` are not solved. A NaN tolerance gives `no-steady-state`.
    Raises InputError for a negative tolerance.
    Assumes A, Q, S finite; (A, Q) stabilisable and (A, S_k) detectable where `refused` does not say otherwise.
    Source: eqs. (4), (8); docs/mathematics.md, section 4.
    """
    K, n, _ = S.shape
    tolerance = np.asarray(tolerance, dtype=float)
    if (tolerance < 0).any():
        k = int(np.flatnonzero(tolerance < 0)[0])
        raise InputError([Complaint(f"tolerance[{k}]", f"is {float(tolerance[k])}; a number >= 0 was expected")])
    status = np.full(K, Status.OK.value, dtype="U16") if refused is None else refused.astype("U16")
    status[(status == Status.OK.value) & ~np.isfinite(tolerance)] = Status.NO_STEADY_STATE.value
    todo = np.flatnonzero(status == Status.OK.value)
    values = {
        "P": np.full((K, n, n), np.nan),
        "V": np.full((K, n, n), np.nan),
        "iterations": np.zeros(K, dtype=np.int64),
    } | {
        name: np.full(K, np.nan)
        for name in ("theta", "spectral_radius", "attraction", "riccati_residual", "tolerance_residual")
    }
    blocks = list(_blocks(todo, n))
    done = 0
    for block, part in zip(blocks, _map(Recursion(A, Q, S, tolerance, tau), blocks), strict=True):
        status[block] = part.pop("status")
        for name, value in part.items():
            values[name][block] = value
        done += len(block)
        if progress is not None:
            progress(done, len(todo))
    return SteadyState(A=A, Q=Q, S=S, tolerance=tolerance, tau=tau, status=status, **values)


def _blocks(index: ndarray, n: int) -> Iterator[ndarray]:
    """Pieces of an index, such that the temporaries of a piece fit the cache."""
    d = n * (n + 1) // 2 if n <= 12 else n
    size = max(1, min(2048, _BLOCK_BYTES // (8 * d * d)))
    return (index[start : start + size] for start in range(0, len(index), size))


def _map(recursion: Recursion, blocks: list[ndarray]) -> Iterator[dict[str, ndarray]]:
    """Solve block after block, on all cores where there are several."""
    if len(blocks) <= 1:
        return (_solve_block(recursion.part(block)) for block in blocks)
    import joblib

    parallel: Any = joblib.Parallel(n_jobs=-1, backend="threading", return_as="generator")
    return parallel(joblib.delayed(_solve_block)(recursion.part(block)) for block in blocks)


def _solve_block(recursion: Recursion) -> dict[str, ndarray]:
    """Everything that a SteadyState holds, for one block; residuals recomputed from the P and V that are returned."""
    A, c, tau = recursion.A, recursion.tolerance, recursion.tau
    with np.errstate(all="ignore"):
        points = solve_fixed_points(recursion)
        found, P, iterations = points.found, points.P, points.iterations
        attracts = _attraction_at(recursion, P, found)
        restless = np.flatnonzero(found & (attracts >= 1))
        if restless.size:
            kalman = solve_riccati(A, recursion.Q, recursion.S[restless])
            rest = settle(recursion.part(restless), kalman.P)
            P[restless[rest.found]] = rest.P[rest.found]
            iterations[restless] += rest.iterations
            attracts = _attraction_at(recursion, P, found)
        # What was not found may be no matrix of numbers at all, and LAPACK would give up on the whole stack for it.
        P = np.where(found[:, None, None], P, np.eye(len(A)))
        taken = step(recursion, P)
        at, V = taken.at, taken.at.V
        v = at.eigenvalues * (1 + at.excess)
        M = (taken.AZ / v[:, None, :]) @ at.U.mT
        defect = relative_defect(recursion, taken.following - P, P)
        found = found & (defect <= ACCEPT) & np.isfinite(attracts)  # the solver's word is not taken for it
        found = found & (condition(V, recursion.S).error <= SIX_DIGITS)
        divergence_now = np.where(c < 1, gamma(P, at.theta, tau), _divergence_of(P, V, tau))
        mismatch = np.where(c > 0, np.abs(divergence_now - c) / np.where(c > 0, c, 1.0), 0.0)
        values = {
            "P": P,
            "V": V,
            "theta": at.theta,
            "spectral_radius": stacked.spectral_radius(M),
            "attraction": attracts,
            "riccati_residual": defect,
            "tolerance_residual": mismatch,
        }
        for value in values.values():
            value[~found] = np.nan
        status = np.where(attracts < 1, Status.OK.value, Status.OSCILLATES.value).astype("U16")
        status[~found] = np.where(points.diverges[~found], Status.DIVERGES.value, Status.NO_STEADY_STATE.value)
    return values | {"iterations": iterations, "status": status}


def _attraction_at(recursion: Recursion, P: Float[ndarray, "K n n"], found: ndarray) -> Float[ndarray, " K"]:
    """The attraction of each P that was found."""
    safe = np.where(found[:, None, None], P, np.eye(len(recursion.A)))
    return attraction(derivative(recursion, step(recursion, safe)))


def _divergence_of(P: ndarray, V: ndarray, tau: float) -> ndarray:
    """gamma as a divergence of V from P, from the eigenvalues of P^-1 V: well conditioned where theta is not."""
    eigenvalues, U = stacked.symmetric_eigen(P)
    half = U / np.sqrt(np.maximum(eigenvalues, 1e-100 * eigenvalues[:, -1:] + 1e-150))[:, None, :]
    inflation = np.linalg.eigvalsh(np.nan_to_num(half.mT @ V @ half))
    return divergence(np.log(np.maximum(inflation, 1.0)), tau).sum(axis=-1)
