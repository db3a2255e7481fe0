"""Monte Carlo: the six filters run on trajectories sampled from the least favourable model.

The filters run as they would on the nodes, on outputs, eqs. (12)-(13): nothing of the error recursions of eqs.
(35)-(37) is used, so agreement with them is evidence. Plant and estimates are written relative to the state, which
changes no error, since all is linear and weights sum to one; the state of an unstable plant outgrows all digits.
Runs are drawn in batches of fixed size, each from its own child of the seed, and summed in order: the result does not
depend on the number of workers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.analysis.filters import FilterKind, Hearing, follow_filters, follow_gains, hearing, kinds
from tolnet.analysis.fixed_point import Inflated, filter_information
from tolnet.analysis.least_favourable import least_favourable_model
from tolnet.analysis.trajectories import Disturbance, disturb
from tolnet.model import SensorNetwork, ToleranceTable
from tolnet.model.simulation import Simulation
from tolnet.model.worst_case import LeastFavourableModel

BATCH = 50
"""Runs drawn from one child of the seed."""

Progress = Callable[[int, int], None]


def simulate_filters(
    table: ToleranceTable,
    W: sparse.csr_array,
    *,
    runs: int,
    steps: int,
    seed: int = 0,
    filters: Iterable[str] | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> dict[str, Simulation]:
    """Run filters on `runs` trajectories of the least favourable model, and judge them at 0, 1, ..., `steps`.

    Every filter sees the same trajectories, starts from the network's initial mean with V_{k,0} = V_0, and x_0 is
    drawn from N(mean, V_0). `progress(done, total)` counts runs.
    Raises UnsupportedError for tau != 0 or an unknown filter, ValueError for fewer than 2 runs or 1 step.
    Source: eqs. (12)-(13), (32)-(34), (44)-(45); docs/mathematics.md, sections 7 and 8.
    """
    if runs < 2 or steps < 1:
        raise ValueError(f"runs is {runs} and steps is {steps}; at least 2 runs of 1 step were expected")
    network, chosen = table.network, kinds(filters)
    horizon = steps + 1  # so that the last instant that is judged is one of the model's
    model = least_favourable_model(network, table.central, horizon)
    histories = follow_filters(table, W, horizon, filters=[kind.name for kind in chosen])
    running = [kind for kind in chosen if histories[kind.name].exists]
    schedules = [_schedule(table, W, kind, steps) for kind in running]
    sums: list[_Sums] | None = None
    done = 0
    for batch in _map(model, schedules, runs, seed, workers) if schedules else ():
        sums = batch if sums is None else [total.plus(more) for total, more in zip(sums, batch, strict=True)]
        done = min(done + BATCH, runs)
        if progress is not None:
            progress(done, runs)
    counted = {kind.name: total.summary() for kind, total in zip(running, sums or (), strict=True)}
    found = {}
    for kind in chosen:
        history = histories[kind.name]
        bound = np.array(history.node_msd[: steps + 1])
        nothing = np.full_like(bound, np.nan)
        node_mse, error, inside, diverged = counted.get(kind.name, (nothing, nothing[:, 0], nothing, 0))
        found[kind.name] = Simulation(
            kind=kind,
            node_mse=node_mse,
            standard_error=error,
            node_bound=bound,
            node_consistency=inside,
            diverged=diverged,
            runs=runs,
            steps=steps,
            seed=seed,
            status=history.status,
            reason=history.reason,
        )
    return found


class _Schedule(NamedTuple):
    """The gains of one filter over time, and who hears whom."""

    network: SensorNetwork
    side: Hearing
    AZ: Float[ndarray, "T K n n"]
    """A (V^-1 + S)^-1 of every node and step."""
    whitener: Float[ndarray, "T1 K n n"]
    """V_{k,t}^-1/2 up to a rotation."""


def _schedule(table: ToleranceTable, W: sparse.csr_array, kind: FilterKind, T: int) -> _Schedule:
    network, side = table.network, hearing(table.network, W, kind)
    gains = list(follow_gains(table, kind, side.S, T))
    AZ = np.stack([filter_information(network.A, side.S, step.at).AZ @ step.at.U.mT for step in gains])
    whitener = np.stack([_whitener(at) for at in [step.at for step in gains] + [gains[-1].following]])
    return _Schedule(network, side, AZ, whitener)


def _whitener(at: Inflated) -> Float[ndarray, "K n n"]:
    return at.U.mT / np.sqrt(at.eigenvalues * (1 + at.excess))[:, :, None]


class _Sums(NamedTuple):
    """What is added up over batches, for one filter; runs that diverged are counted and left out."""

    squares: Float[ndarray, "T1 K"]
    inside: Float[ndarray, "T1 K"]
    means: Float[ndarray, " T1"]
    squared_means: Float[ndarray, " T1"]
    runs: int
    diverged: int

    def plus(self, other: _Sums) -> _Sums:
        return _Sums(
            self.squares + other.squares,
            self.inside + other.inside,
            self.means + other.means,
            self.squared_means + other.squared_means,
            self.runs + other.runs,
            self.diverged + other.diverged,
        )

    def summary(self) -> tuple[ndarray, ndarray, ndarray, int]:
        """Mean square error and consistency per node, standard error of the network's mean, runs that diverged."""
        n = max(self.runs, 1)
        variance = np.maximum(self.squared_means / n - (self.means / n) ** 2, 0.0)
        return self.squares / n, np.sqrt(variance / max(n - 1, 1)), self.inside / n, self.diverged


def _map(
    model: LeastFavourableModel, schedules: list[_Schedule], runs: int, seed: int, workers: int
) -> Iterator[list[_Sums]]:
    """Batch after batch, in order, on as many processes as asked for."""
    sizes = [min(BATCH, runs - start) for start in range(0, runs, BATCH)]
    children = np.random.SeedSequence(seed).spawn(len(sizes))
    if workers == 1:
        return (_batch(model, schedules, size, child) for size, child in zip(sizes, children, strict=True))
    import joblib

    parallel: Any = joblib.Parallel(n_jobs=workers, return_as="generator")
    return parallel(
        joblib.delayed(_batch)(model, schedules, size, child) for size, child in zip(sizes, children, strict=True)
    )


def _batch(
    model: LeastFavourableModel, schedules: list[_Schedule], size: int, child: np.random.SeedSequence
) -> list[_Sums]:
    drawn = list(disturb(model, np.random.default_rng(child), runs=size))
    return [_run(schedule, drawn) for schedule in schedules]


def _run(schedule: _Schedule, drawn: Sequence[Disturbance]) -> _Sums:
    """One filter on every run of a batch: eqs. (12)-(13), (32)-(33), (44)-(45)."""
    network, side = schedule.network, schedule.side
    A, S, n = network.A, side.S, network.n
    (T, K), runs = schedule.AZ.shape[:2], len(drawn[0].e)
    weights, owner = _output_weights(network), _owner(network)
    error = np.broadcast_to(drawn[0].e.T, (K, n, runs))  # x_0 is the mean, from which all start, and e_0
    errors, distances = np.empty((T + 1, K, runs)), np.empty((T + 1, K, runs))
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(T + 1):
            errors[t] = (error**2).sum(axis=1)
            distances[t] = ((schedule.whitener[t] @ error) ** 2).sum(axis=1)
            if t == T:
                break
            estimate = -error  # relative to x_t, as the outputs are; psi is so to A x_t + r
            sent = (weights[:, :, None] * drawn[t].output.T[:, None, :]).reshape(len(weights), n * runs)
            sensed = (side.heard @ (owner @ sent)).reshape(K, n, runs)
            psi = A @ estimate + schedule.AZ[t] @ (sensed - S @ estimate)
            estimate = (side.mixing @ psi.reshape(K, n * runs)).reshape(K, n, runs)
            error = drawn[t].state.T - estimate
    alive = np.isfinite(errors).all(axis=(0, 1))
    errors, inside = errors[:, :, alive], distances[:, :, alive] <= _chi_square(n)
    each = errors.mean(axis=1)
    return _Sums(
        squares=errors.sum(axis=2),
        inside=inside.sum(axis=2).astype(float),
        means=each.sum(axis=1),
        squared_means=(each**2).sum(axis=1),
        runs=int(alive.sum()),
        diverged=int((~alive).sum()),
    )


def _output_weights(network: SensorNetwork) -> Float[ndarray, "M n"]:
    """R_l^-1 C_l, row by row: what each output adds to the information of those who hear it."""
    weights = np.zeros_like(network.C)
    for nodes, C, R in network.sensors.groups():
        weights[network.rows[nodes, None] + np.arange(C.shape[1])] = np.linalg.solve(R, C)
    return weights


def _owner(network: SensorNetwork) -> sparse.csr_array:
    """(N, M): sums what the outputs of each node add."""
    M = len(network.C)
    owner = np.repeat(np.arange(network.N), np.diff(network.rows))
    return sparse.csr_array((np.ones(M), (owner, np.arange(M))), shape=(network.N, M))


def _chi_square(n: int) -> float:
    """The 95 % point of the chi-square law with n degrees of freedom."""
    from scipy.special import chdtri

    return float(chdtri(n, 0.05))
