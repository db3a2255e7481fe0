"""Steady states of the robust filter, one or a million (Algorithm 3 and the central filter)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis import stacked
from tolnet.analysis.accuracy import error_loop, estimated_error
from tolnet.analysis.continuation import ACCEPT, FixedPoints, find_wanderers, settle, solve_fixed_points
from tolnet.analysis.detectability import detectability
from tolnet.analysis.divergence import divergence, gamma
from tolnet.analysis.extended import Extended
from tolnet.analysis.extended_algebra import NoAnswer
from tolnet.analysis.fixed_point import Recursion, attraction, derivative, inflate_covariance, relative_defect, step
from tolnet.analysis.riccati import solve_riccati
from tolnet.analysis.sources import Sources
from tolnet.model import Ambiguity, Complaint, InputError, SensorNetwork, Status, SteadyState
from tolnet.model.covariances import condition

Progress = Callable[[int, int], None]
"""Called with how many filters are done, and how many there are."""

VOUCHED = 1e-7
"""Largest estimated relative error of what doubles are trusted with; six digits with one in hand."""
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
        undriven=seen.undriven_outside,
        sources=Sources.of_centre(network),
    )[0]


def solve_local_steady_states(
    network: SensorNetwork,
    tolerances: Float[ndarray, " N"],
    *,
    tau: float = 0.0,
    refused: ndarray | None = None,
    refine: Callable[[int], float] | None = None,
    progress: Progress | None = None,
) -> SteadyState:
    """The steady states of every node's filter at its own tolerance (gamma scale): a stack of N, eqs. (12), (44).

    Nodes that miss a mode which does not decay come back `undetectable`, and all as `unstabilisable` where the noise
    misses one on the unit circle; `refused` (N,) holds further statuses known beforehand. `refine` gives the
    tolerance of a node that is solved in extended precision, to its last digit.
    """
    seen = detectability(network)
    status = np.array([_status_before(seen.stabilisable, bool(good)) for good in seen.detectable], dtype="U16")
    if refused is not None:
        status = np.where(status == Status.OK.value, refused, status)
    return solve_steady_states(
        network.A,
        network.Q,
        network.information,
        tolerances,
        tau=tau,
        refused=status,
        undriven=seen.undriven_outside,
        sources=Sources.of_nodes(network),
        refine=refine,
        progress=progress,
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
    posterior = condition(V, S)
    riccati = A @ posterior.covariance @ A.T + Q - P
    exact = Recursion(A, Q, S[None], np.asarray([float(tolerance)]))
    mismatch = abs(float(gamma(P, theta)) - tolerance) / tolerance if tolerance > 0 else 0.0
    return SteadyState(
        A=A,
        Q=Q,
        S=S,
        tolerance=np.asarray(float(tolerance)),
        tau=0.0,
        spectral_radius=np.asarray(np.nan),
        attraction=np.asarray(np.nan),
        riccati_residual=np.asarray(relative_defect(exact, riccati[None], P[None])[0]),
        tolerance_residual=np.asarray(mismatch),
        error=np.asarray(np.nan),
        iterations=np.asarray(0),
        filtered=posterior.covariance,
        gains={},
        status=np.asarray(Status.OK.value),
        reason=np.asarray("", dtype=object),
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
    undriven: bool = False,
    sources: Sources | None = None,
    refine: Callable[[int], float] | None = None,
    progress: Progress | None = None,
) -> SteadyState:
    """Solve P = A (V^-1 + S_k)^-1 A' + Q, gamma(P, theta) = c_k for a stack of K filters that share A and Q.

    Structured doubling at fixed theta inside a bracketed search in theta, then Newton's method on P, in doubles and
    in stacks; blocks of filters run on all cores. What doubles cannot vouch for, and what lies past the fold, is
    solved one by one in extended precision (tau = 0), from `sources`, which knows Q and S before rounding; without it
    from Q and S. `refused` (K,) holds statuses known beforehand, such as `undetectable`: filters whose entry is not
    `ok` are not solved. `refine` gives the exact c_k of those that are solved one by one. `undriven` says that A has
    modes outside the unit circle that Q does not drive. A NaN tolerance gives `no-steady-state`. Raises InputError
    for a negative tolerance. Accepted is what has an estimated error below 1e-7 in P and V (in the units of each
    state), theta, the gain and both radii. Assumes A, Q, S finite; no undriven mode on the unit circle and (A, S_k)
    detectable where `refused` does not say otherwise.
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
    values: dict[str, ndarray] = {name: np.full((K, n, n), np.nan) for name in ("P", "V", "filtered")}
    values |= {name: np.full(K, np.nan) for name in _NUMBERS}
    values |= {"iterations": np.zeros(K, dtype=np.int64), "reason": np.full(K, "", dtype=object)}
    recursion = Recursion(A, Q, S, tolerance, tau, undriven)
    doubt: list[ndarray] = []
    gains: dict[int, ndarray] = {}
    blocks = list(_blocks(todo, n))
    done = 0
    for block, part in zip(blocks, _map(recursion, blocks), strict=True):
        doubt.append(block[part.pop("doubt")])
        status[block] = part.pop("status")
        for name, value in part.items():
            values[name][block] = value
        done += len(block) - len(doubt[-1])
        if progress is not None:
            progress(done, len(todo))
    if any(map(len, doubt)):
        left = np.concatenate(doubt)
        if refine is not None:
            tolerance = tolerance.copy()
            exact = np.array([refine(k) for k in left.tolist()])
            tolerance[left] = np.where(np.isfinite(exact), exact, tolerance[left])
            recursion = recursion.at(tolerance)
        one_by_one = _OneByOne(recursion, sources or Sources.of_matrices(A, Q, S), values, status, gains)
        before = len(todo) - len(left)
        one_by_one.solve(left, (lambda turn: progress(before + turn, len(todo))) if progress else (lambda turn: None))
    return SteadyState(A=A, Q=Q, S=S, tolerance=tolerance, tau=tau, status=status, gains=gains, **values)


_NUMBERS = ("theta", "spectral_radius", "attraction", "riccati_residual", "tolerance_residual", "error")


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
    """Everything that a SteadyState holds, for one block; residuals recomputed from the P and V that are returned.

    `doubt` marks those that doubles cannot vouch for; their numbers are the best attempt.
    """
    c, tau = recursion.tolerance, recursion.tau
    with np.errstate(all="ignore"):
        points = solve_fixed_points(recursion)
        found, P, iterations = points.found, points.P, points.iterations
        attracts = _attraction_at(recursion, P, found)
        restless = np.flatnonzero(found & (attracts >= 1))
        if restless.size:
            rest = _settled(recursion.part(restless))
            P[restless[rest.found]] = rest.P[rest.found]
            iterations[restless] += rest.iterations
            attracts = _attraction_at(recursion, P, found)
        # What was not found may be no matrix of numbers at all, and LAPACK would give up on the whole stack for it.
        finite = stacked.finite_members(P)
        P = stacked.symmetric_part(np.where(finite[:, None, None], P, np.eye(len(recursion.A))))
        taken = step(recursion, P)
        at, V = taken.at, taken.at.V
        M = error_loop(taken)
        defect = relative_defect(recursion, taken.following - P, P)
        divergence_now = np.where(c < 1, gamma(P, at.theta, tau), _divergence_of(P, V, tau))
        mismatch = np.where(c > 0, np.abs(divergence_now - c) / np.where(c > 0, c, 1.0), 0.0)
        # The solver's word is not taken for it.
        sure = found & (defect <= ACCEPT) & (mismatch <= ACCEPT) & np.isfinite(attracts)
        error = estimated_error(recursion, P, taken, derivative(recursion, taken), attracts)
        sure &= error <= VOUCHED
        if recursion.undriven:
            sure &= stacked.spectral_radius(M) < 1  # else it is the solution that the modes not driven leave alone
        ZU = at.U @ taken.filtered.Z
        values = {
            "P": P,
            "V": V,
            "filtered": stacked.symmetric_part(ZU @ at.U.mT),
            "theta": at.theta,
            "spectral_radius": stacked.spectral_radius(M),
            "attraction": attracts,
            "riccati_residual": defect,
            "tolerance_residual": mismatch,
            "error": error,
        }
        status = np.where(attracts < 1, Status.OK.value, Status.OSCILLATES.value).astype("U16")
        status[~sure] = Status.NO_STEADY_STATE.value
    return values | {"iterations": iterations, "status": status, "doubt": ~sure}


def _settled(recursion: Recursion) -> FixedPoints:
    """Where the recursion comes to rest from the Kalman filter, if it does."""
    return settle(recursion, solve_riccati(recursion.A, recursion.Q, recursion.S, recursion.start).P)


@dataclass(frozen=True, eq=False)
class _OneByOne:
    """Filters that are solved in extended precision, and where their answers are written."""

    recursion: Recursion
    sources: Sources
    values: dict[str, ndarray]
    status: ndarray
    gains: dict[int, ndarray]

    def solve(self, doubt: ndarray, done: Callable[[int], None]) -> None:
        """Solve the filters of `doubt`; those that are on no path from the Kalman filter are looked for at last."""
        failed: list[int] = []
        for turn, k in enumerate(doubt.tolist()):
            try:
                if self.recursion.tau != 0:
                    raise NoAnswer("rounding leaves less than six digits of it")
                # Not from the doubles' P: a millionth away there may be another steady state, on no path from c = 0.
                self._write(k, self.sources.solve(k, float(self.recursion.tolerance[k]), self.recursion.undriven))
            except NoAnswer as end:
                failed.append(k)
                self._write_nothing(k, str(end))
            done(turn + 1)
        restless = doubt[self.status[doubt] == Status.OSCILLATES.value]
        if restless.size:
            self._settle(restless)
        if failed and self.recursion.tau == 0:
            self._catch(np.array(failed))

    def _settle(self, restless: ndarray) -> None:
        """Where the recursion comes to rest elsewhere, that steady state in place of the one that repels."""
        part = self.recursion.part(restless)
        with np.errstate(all="ignore"):
            rest = _settled(part)
            thetas = inflate_covariance(rest.P, part.tolerance).theta
        for i in np.flatnonzero(rest.found & np.isfinite(thetas)).tolist():
            self._try(int(restless[i]), (rest.P[i], float(thetas[i])))

    def _catch(self, failed: ndarray) -> None:
        """Look for steady states where the filters themselves go; `diverges` where they go away."""
        part = self.recursion.part(failed)
        with np.errstate(all="ignore"):
            wanderers = find_wanderers(part)
            thetas = [inflate_covariance(guess, part.tolerance).theta for guess in wanderers.guesses]
        for i, k in enumerate(failed.tolist()):
            self.values["iterations"][k] += wanderers.steps
            if wanderers.diverges[i]:
                self.status[k], self.values["reason"][k] = Status.DIVERGES.value, ""
                continue
            for guess, theta in zip(wanderers.guesses, thetas, strict=True):
                if np.isfinite(theta[i]) and self._try(k, (guess[i], float(theta[i]))):
                    break

    def _try(self, k: int, near: tuple[Float[ndarray, "n n"], float]) -> bool:
        """Newton's method in extended precision from this guess alone; written where it settles."""
        c, undriven = float(self.recursion.tolerance[k]), self.recursion.undriven
        try:
            found = self.sources.solve(k, c, undriven, near, only_near=True)
        except NoAnswer:
            return False
        self._write(k, found)
        return True

    def _write(self, k: int, state: Extended) -> None:
        for name in ("P", "V", "filtered", *_NUMBERS):
            self.values[name][k] = getattr(state, name)
        if np.isnan(state.attraction):
            one = self.recursion.part(np.array([k]))
            with np.errstate(all="ignore"):
                self.values["attraction"][k] = _attraction_at(one, state.P[None], np.ones(1, dtype=bool))[0]
        self.values["iterations"][k] += state.iterations
        self.values["reason"][k] = ""
        settles = self.values["attraction"][k] < 1
        self.status[k] = Status.OK.value if settles else Status.OSCILLATES.value
        if state.gain is not None:
            self.gains[k] = state.gain

    def _write_nothing(self, k: int, reason: str) -> None:
        for name in ("P", "V", "filtered", *_NUMBERS):
            self.values[name][k] = np.nan
        self.values["reason"][k], self.status[k] = reason, Status.NO_STEADY_STATE.value


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
