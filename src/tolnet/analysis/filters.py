"""The six filters of the literature under one least favourable model: in the steady state, and over time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.analysis.error_dynamics import error_dynamics, filter_errors
from tolnet.analysis.fixed_point import Inflated, inflate_covariance, predict
from tolnet.analysis.least_favourable import least_favourable_model
from tolnet.analysis.local_tolerance import seen_tolerances
from tolnet.analysis.lyapunov import Method, solve_lyapunov
from tolnet.analysis.steady_state import solve_local_steady_states, solve_steady_state
from tolnet.model import SensorNetwork, Status, SteadyState, ToleranceTable, UnsupportedError
from tolnet.model.dynamics import LeastFavourableModel, Performance
from tolnet.model.history import FILTERS, FilterHistory, FilterKind

Progress = Callable[[int, int], None]


def kinds(names: Iterable[str] | None) -> list[FilterKind]:
    """The filters of these names in the literature's order; all six without names. Raises UnsupportedError."""
    if names is None:
        return list(FILTERS.values())
    wanted = list(names)
    strangers = [name for name in wanted if name not in FILTERS]
    if strangers:
        raise UnsupportedError(f"there is no filter {strangers[0]!r}; the filters are {', '.join(FILTERS)}")
    return [kind for name, kind in FILTERS.items() if name in wanted]


def evaluate_filters(
    table: ToleranceTable,
    W: sparse.csr_array,
    *,
    filters: Iterable[str] | None = None,
    method: Method = "auto",
    progress: Progress | None = None,
) -> dict[str, Performance]:
    """Steady performance of each filter under the least favourable model of the centre at the table's tolerance.

    All filters face the same model; they differ in their gains: from c = 0 (KFC, KFD), from c everywhere (RKFC,
    RKFDU) and from the table's c_k (RKFDNU2; RKFDNU, whose c_k,t converge to them, shares its numbers). `method`
    goes to `solve_lyapunov`. A filter without an answer carries its status and reason.
    Raises UnsupportedError for tau != 0 or an unknown filter.
    Source: eqs. (34)-(41); docs/mathematics.md, sections 7 and 8.
    """
    network, chosen = table.network, kinds(filters)
    model = least_favourable_model(network, table.central)
    found: dict[str, Performance] = {}
    for done, kind in enumerate(chosen):
        if kind.name == "RKFDNU2" and "RKFDNU" in found:
            found[kind.name] = found["RKFDNU"]
        else:
            steady = steady_filter(table, kind)
            dynamics = error_dynamics(network, steady, None if kind.centralised else W, model)
            found[kind.name] = solve_lyapunov(dynamics, method=method)
        if progress is not None:
            progress(done + 1, len(chosen))
    return found


def steady_filter(table: ToleranceTable, kind: FilterKind) -> SteadyState:
    """The steady states whose gains a filter uses: without a stack for a centralised filter, else a stack of N."""
    network, c = table.network, float(table.central.tolerance)
    if kind.centralised:
        return table.central if kind.ball == "c" else solve_steady_state(network, 0.0)
    if kind.ball in ("c_k", "c_k,t"):
        return table.local
    return solve_local_steady_states(network, np.full(network.N, c if kind.ball == "c" else 0.0))


def follow_filters(
    table: ToleranceTable,
    W: sparse.csr_array,
    horizon: int,
    *,
    filters: Iterable[str] | None = None,
    progress: Progress | None = None,
) -> dict[str, FilterHistory]:
    """Each filter from V_0 over `horizon` steps, under the time-varying least favourable model of that horizon.

        Q_{t+1} = F_t Q_t F_t' + G_t G_t',  Q_0 = 1 1' (x) V_0,                                  eqs. (36)-(40)

    Every filter starts from the network's initial mean, with V_{k,0} = V_0. Covers filters that never settle. The
    covariance of all errors is formed: (N + 1)^2 n^2 numbers.
    Raises UnsupportedError for tau != 0 or an unknown filter, ValueError for a horizon below 1.
    """
    chosen = kinds(filters)
    model = least_favourable_model(table.network, table.central, horizon)
    found: dict[str, FilterHistory] = {}
    for number, kind in enumerate(chosen):

        def step_done(t: int, before: int = number * horizon) -> None:
            if progress is not None:
                progress(before + t, len(chosen) * horizon)

        found[kind.name] = _history(table, W, model, kind, horizon, step_done)
    return found


class Gains(NamedTuple):
    """What the nodes of one filter use in one step: V_{k,t}, and what leads from it to the next."""

    at: Inflated
    tolerance: Float[ndarray, " K"]
    following: Inflated


class Hearing(NamedTuple):
    """Whom the K nodes of a filter hear, what information that is, and how they mix."""

    S: Float[ndarray, "K n n"]
    heard: sparse.csr_array
    """(K, N)."""
    mixing: sparse.csr_array
    """W', K x K."""


def hearing(network: SensorNetwork, W: sparse.csr_array, kind: FilterKind) -> Hearing:
    """A centralised filter is one node that hears everybody and mixes with nobody."""
    if kind.centralised:
        everybody = sparse.csr_array(np.ones((1, network.N)))
        return Hearing(network.total_information[None], everybody, sparse.csr_array(np.ones((1, 1))))
    heard = sparse.csr_array(network.adjacency.T.astype(float))
    return Hearing(network.information, heard, sparse.csr_array(W.T))


def follow_gains(table: ToleranceTable, kind: FilterKind, S: Float[ndarray, "K n n"], T: int) -> Iterator[Gains]:
    """The covariance recursion of every node from V_0, eqs. (12), (32), (44), step by step; it needs no data."""
    network, c = table.network, float(table.central.tolerance)
    A, Q, V0, K = network.A, network.Q, network.initial_covariance, len(S)
    at = inflate_covariance(np.broadcast_to(V0, (K, *V0.shape)), np.zeros(K))
    centre = inflate_covariance(V0[None], np.zeros(1))
    for _ in range(T):
        tolerance = np.full(K, c if kind.ball == "c" else 0.0)
        if kind.ball == "c_k":
            tolerance = np.asarray(table.local.tolerance)
        if kind.ball == "c_k,t":
            ahead = inflate_covariance(predict(A, Q, network.total_information[None], centre), np.array([c]))
            tolerance = seen_tolerances(network, c, now=centre, following=ahead)
            centre = ahead
        following = inflate_covariance(predict(A, Q, S, at), tolerance)
        yield Gains(at, tolerance, following)
        at = following


def _history(
    table: ToleranceTable,
    W: sparse.csr_array,
    model: LeastFavourableModel,
    kind: FilterKind,
    T: int,
    step_done: Callable[[int], None],
) -> FilterHistory:
    network, n = table.network, table.network.n
    S, heard, mixing = hearing(network, W, kind)
    K = len(S)
    node_msd = np.full((T + 1, K), np.nan)
    theta, tolerance = np.full((T, K), np.nan), np.full((T, K), np.nan)
    status, reason = model.status, model.reason
    if kind.ball == "c_k" and not np.isfinite(table.local.tolerance).all():
        status, reason = Status(str(table.central.status)), "the centralised filter has no steady state, hence no c_k"
    if not model.exists or status != model.status:
        return FilterHistory(kind, node_msd, theta, tolerance, status, reason)
    Q = np.tile(network.initial_covariance, (K + 1, K + 1))
    node_msd[0] = np.trace(network.initial_covariance)
    blocks = (K + 1, n, (K + 1) * n)
    for t, gains in enumerate(follow_gains(table, kind, S, T)):
        dynamics = filter_errors(model[t], gains.at.V, S, heard, mixing)
        if not dynamics.exists:
            node_msd[:], theta[:], tolerance[:] = np.nan, np.nan, np.nan
            status, reason = dynamics.status, f"at step {t} {dynamics.reason}"
            break
        FQ = dynamics.step(Q.reshape(blocks)).reshape(Q.shape)
        Q = dynamics.step(FQ.T.reshape(blocks)).reshape(Q.shape)
        Q = (Q + Q.T) / 2 + dynamics.noise_matrix()
        node_msd[t + 1] = np.einsum("kiki->k", Q.reshape(K + 1, n, K + 1, n))[:K]
        theta[t], tolerance[t] = gains.following.theta, gains.tolerance
        step_done(t + 1)
    return FilterHistory(kind, node_msd, theta, tolerance, status, reason)
