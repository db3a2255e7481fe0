"""General constraints by IPOPT: the same objective and gradient, as callbacks of CasADi."""

from __future__ import annotations

import signal
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from types import FrameType
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.analysis.curvature import Columns
from tolnet.design.weights.admissible import Admissible
from tolnet.design.weights.msd import MsdObjective
from tolnet.design.weights.search import Search, Watch
from tolnet.model import Start

_TOLERANCE = 1e-7
_MOST = 400
_STARTS = 2
"""The best starts that IPOPT goes on from: it needs several times the gradients of the quasi-Newton method."""
_NEARLY = 1e-8
"""How far a point may break a bound and still be offered: the last step repairs that much."""
_INSIDE = 0.02
"""Starts are moved towards the uniform weights by this much: an interior-point method needs room."""


@dataclass(frozen=True, eq=False)
class _Unknowns:
    """w = base + map u with the rows of `limits` u within bounds, and u >= `least`."""

    base: Float[ndarray, " L"]
    map: sparse.csr_array
    limits: sparse.csr_array
    low: Float[ndarray, " m"]
    high: Float[ndarray, " m"]
    least: Float[ndarray, " u"]

    def weights(self, u: Float[ndarray, " u"]) -> Float[ndarray, " L"]:
        """Link by link."""
        return self.base + self.map @ u


def _columns_apart(among: Admissible) -> _Unknowns:
    """Every weight on its own, and the sums as equations."""
    columns = among.columns
    L, K = len(columns.sender), columns.nodes
    sums = sparse.csr_array((np.ones(L), (columns.hearer, np.arange(L))), shape=(K, L))
    least = np.zeros(L)
    least[columns.own] = among.lower
    one = np.ones(K)
    return _Unknowns(np.zeros(L), sparse.csr_array(sparse.eye_array(L)), sums, one, one, least)


def _symmetric(among: Admissible) -> _Unknowns:
    """One weight a link, w_kk what the others leave, and that at least its bound."""
    columns: Columns = among.columns
    once = np.flatnonzero(columns.sender < columns.hearer)
    number = {pair: e for e, pair in enumerate(zip(columns.sender[once], columns.hearer[once], strict=True))}
    L, E, K = len(columns.sender), len(once), columns.nodes
    rows, cols, values = [], [], []
    for i, (l, k) in enumerate(zip(columns.sender.tolist(), columns.hearer.tolist(), strict=True)):
        if l == k:
            continue
        e = number[min(l, k), max(l, k)]
        rows += [i, int(columns.own[k])]
        cols += [e, e]
        values += [1.0, -1.0]
    base = np.zeros(L)
    base[columns.own] = 1.0
    ends = np.concatenate([columns.sender[once], columns.hearer[once]])
    limits = sparse.csr_array((np.ones(2 * E), (ends, np.tile(np.arange(E), 2))), shape=(K, E))
    spread = sparse.csr_array((values, (rows, cols)), shape=(L, E))
    return _Unknowns(base, spread, limits, np.full(K, -np.inf), 1 - among.lower, np.zeros(E))


def search_general(
    objective: MsdObjective,
    among: Admissible,
    starts: Mapping[str, Float[ndarray, " L"]],
    *,
    symmetric: bool,
    most: int,
    watch: Watch,
) -> Search:
    """Minimise the criterion by IPOPT from the best starts, two or `most`, with symmetric weights where asked for.

    Hessians are of limited memory (IPOPT's own). Where W is unstable the callback has no number, and IPOPT shortens
    its step. KeyboardInterrupt ends the search with the best so far, once there is one.
    """
    unknowns = _symmetric(among) if symmetric else _columns_apart(among)
    found = Search()
    try:
        _search(objective, among, unknowns, starts, min(most, _STARTS), watch, found)
    except KeyboardInterrupt:
        if found.z is None:
            raise
        found.interrupted = True
    if found.z is not None and not symmetric:
        found.z = among.project(found.z)  # IPOPT keeps its bounds to 1e-8
    return found


def _search(
    objective: MsdObjective,
    among: Admissible,
    unknowns: _Unknowns,
    starts: Mapping[str, Float[ndarray, " L"]],
    most: int,
    watch: Watch,
    found: Search,
) -> None:
    ranked = []
    for name, w in starts.items():
        u = _nearest(unknowns, among, w)
        value = objective.exact(unknowns.weights(u))
        found.starts.append(Start(name, value, float("nan")))
        found.offer(name, unknowns.weights(u), value)
        ranked.append((value, name, u))
    ranked.sort(key=lambda each: each[0])
    usable = [each for each in ranked if np.isfinite(each[0])][:most]
    for number, (_, name, u) in enumerate(usable):
        label = f"IPOPT from {name} ({number + 1} of {len(usable)})"
        for stage in objective.stages:
            u, found.interrupted = _run(stage, unknowns, u, name, label, watch, found)
            if found.interrupted:
                return
        end = objective.exact(unknowns.weights(u))
        found.starts = [Start(s.name, s.value, end) if s.name == name else s for s in found.starts]


class _Interrupt:
    """Notes Ctrl-C instead of raising it: an exception must not cross the solver's own code."""

    def __init__(self) -> None:
        self.seen = False
        self._before: Any = None

    def __enter__(self) -> _Interrupt:
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.seen = True


def _nearest(unknowns: _Unknowns, among: Admissible, w: Float[ndarray, " L"]) -> Float[ndarray, " u"]:
    """Unknowns strictly inside whose weights are near w."""
    columns = among.columns
    if len(unknowns.least) == len(unknowns.base):
        uniform = among.project(np.zeros(len(w)) + 1 / columns.degree[columns.hearer])
        return (1 - _INSIDE) * among.project(w) + _INSIDE * uniform
    dense = sparse.csr_array(sparse.coo_array((w, (columns.sender, columns.hearer))))
    average = sparse.csr_array((dense + dense.T) / 2)
    once = np.flatnonzero(columns.sender < columns.hearer)
    u = np.maximum(np.asarray(average[columns.sender[once], columns.hearer[once]]).ravel(), 1e-4)
    crowded = float(np.max((unknowns.limits @ u) / np.maximum(unknowns.high, 1e-12), initial=0.0))
    return u * min(1.0, (1 - _INSIDE) / crowded) if crowded > 0 else u


def _run(
    objective: MsdObjective,
    unknowns: _Unknowns,
    u: Float[ndarray, " u"],
    name: str,
    label: str,
    watch: Watch,
    found: Search,
) -> tuple[Float[ndarray, " u"], bool]:
    """One run of IPOPT: where it ended, and whether it was interrupted."""
    import casadi

    size = len(u)
    scale, _ = objective.value(unknowns.weights(u))

    latest: list[tuple[ndarray, tuple[float, Any]]] = []

    def value_of(x: ndarray) -> tuple[float, Any]:
        if latest and np.array_equal(latest[0][0], x):  # the gradient is asked for where the value was
            return latest[0][1]
        latest[:] = [(x.copy(), evaluate(x))]
        return latest[0][1]

    def evaluate(x: ndarray) -> tuple[float, Any]:
        w = unknowns.weights(x)
        value, at = objective.value(w)
        found.evaluations += 1
        if (
            np.isfinite(value)
            and w.min() >= -_NEARLY
            and float((unknowns.limits @ x - unknowns.high).max()) <= _NEARLY
        ):
            found.offer(name, w, value if objective.plain else objective.exact(w))
            found.history.append(found.value)
            watch(label, found.value)
        return (value / scale if np.isfinite(value) else np.nan), at

    class Value(casadi.Callback):
        def __init__(self) -> None:
            casadi.Callback.__init__(self)
            self.construct("value", {"enable_fd": False})

        def get_n_in(self) -> int:
            return 1

        def get_n_out(self) -> int:
            return 1

        def get_sparsity_in(self, i: int) -> Any:
            return casadi.Sparsity.dense(size, 1)

        def eval(self, arg: Any) -> Any:
            return [value_of(np.asarray(arg[0]).ravel())[0]]

        def has_jacobian(self) -> bool:
            return True

        def get_jacobian(self, name: Any, inames: Any, onames: Any, opts: Any) -> Any:
            self.slope = Slope(name, opts)
            return self.slope

    class Slope(casadi.Callback):
        def __init__(self, name: str, options: Any) -> None:
            casadi.Callback.__init__(self)
            self.construct(name, options)

        def get_n_in(self) -> int:
            return 2

        def get_n_out(self) -> int:
            return 1

        def get_sparsity_in(self, i: int) -> Any:
            return casadi.Sparsity.dense(size, 1) if i == 0 else casadi.Sparsity.dense(1, 1)

        def get_sparsity_out(self, i: int) -> Any:
            return casadi.Sparsity.dense(1, size)

        def eval(self, arg: Any) -> Any:
            _, at = value_of(np.asarray(arg[0]).ravel())
            if at is None:
                return [casadi.DM(np.full((1, size), np.nan))]
            g, _ = objective.gradient(at)
            return [casadi.DM((unknowns.map.T @ g / scale)[None])]

    class Watcher(casadi.Callback):
        def __init__(self) -> None:
            casadi.Callback.__init__(self)
            self.construct("watcher", {})

        def get_n_in(self) -> int:
            return casadi.nlpsol_n_out()

        def get_n_out(self) -> int:
            return 1

        def get_sparsity_in(self, i: int) -> Any:
            rows = {"f": 1, "x": size, "lam_x": size, "g": limits, "lam_g": limits}.get(casadi.nlpsol_out(i), 0)
            return casadi.Sparsity.dense(rows, 1 if rows else 0)

        def eval(self, arg: Any) -> Any:
            return [int(interrupt.seen)]

    limits = len(unknowns.low)
    value, watcher = Value(), Watcher()
    x = casadi.MX.sym("x", size)
    A = casadi.DM(unknowns.limits.toarray())
    options = {
        "print_time": False,
        "iteration_callback": watcher,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.hessian_approximation": "limited-memory",
        "ipopt.tol": _TOLERANCE,
        "ipopt.max_iter": _MOST,
        "show_eval_warnings": False,
    }
    solver = casadi.nlpsol("solver", "ipopt", {"x": x, "f": value(x), "g": casadi.mtimes(A, x)}, options)
    with _Interrupt() as interrupt:
        answer = solver(x0=u, lbx=unknowns.least, ubx=np.ones(size), lbg=unknowns.low, ubg=unknowns.high)
    end = np.asarray(answer["x"]).ravel()
    if found.best_start == name:
        found.converged = bool(solver.stats()["success"])
    return (end if np.isfinite(end).all() else u), interrupt.seen
