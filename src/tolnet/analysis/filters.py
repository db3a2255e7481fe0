"""The six filters of the literature under one least favourable model: in the steady state, and over time."""

from __future__ import annotations

from collections.abc import Callable, Iterable

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
from tolnet.model import SteadyState, ToleranceTable, UnsupportedError
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


def _history(
    table: ToleranceTable,
    W: sparse.csr_array,
    model: LeastFavourableModel,
    kind: FilterKind,
    T: int,
    step_done: Callable[[int], None],
) -> FilterHistory:
    network = table.network
    A, V0, n = network.A, network.initial_covariance, network.n
    if kind.centralised:
        S, heard = network.total_information[None], sparse.csr_array(np.ones((1, network.N)))
        mixing = sparse.csr_array(np.ones((1, 1)))
    else:
        S, heard = network.information, sparse.csr_array(network.adjacency.T.astype(float))
        mixing = sparse.csr_array(W.T)
    K = len(S)
    node_msd = np.full((T + 1, K), np.nan)
    theta, tolerance = np.full((T, K), np.nan), np.full((T, K), np.nan)
    if not model.exists:
        return FilterHistory(kind, node_msd, theta, tolerance, model.status, model.reason)
    at = inflate_covariance(np.broadcast_to(V0, (K, n, n)), np.zeros(K))
    centre = inflate_covariance(V0[None], np.zeros(1))
    c = float(table.central.tolerance)
    Q = np.tile(V0, (K + 1, K + 1))
    node_msd[0] = np.trace(V0)
    for t in range(T):
        dynamics = filter_errors(model[t], at.V, S, heard, mixing)
        blocks = (K + 1, n, (K + 1) * n)
        FQ = dynamics.step(Q.reshape(blocks)).reshape(Q.shape)
        Q = dynamics.step(FQ.T.reshape(blocks)).reshape(Q.shape)
        Q = (Q + Q.T) / 2 + dynamics.noise_matrix()
        node_msd[t + 1] = np.einsum("kiki->k", Q.reshape(K + 1, n, K + 1, n))[:K]
        following = inflate_covariance(predict(A, network.Q, network.total_information[None], centre), np.array([c]))
        tolerance[t] = _tolerance(table, kind, c, centre, following, K)
        centre = following
        at = inflate_covariance(predict(A, network.Q, S, at), tolerance[t])
        theta[t] = at.theta
        step_done(t + 1)
    return FilterHistory(kind, node_msd, theta, tolerance, model.status, model.reason)


def _tolerance(
    table: ToleranceTable, kind: FilterKind, c: float, now: Inflated, following: Inflated, K: int
) -> Float[ndarray, " K"]:
    """The tolerance of every node of a filter in one step."""
    if kind.ball == "c_k,t":
        return seen_tolerances(table.network, c, now=now, following=following)
    if kind.ball == "c_k":
        return np.asarray(table.local.tolerance)
    return np.full(K, c if kind.ball == "c" else 0.0)
