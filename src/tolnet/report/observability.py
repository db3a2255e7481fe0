"""Robust collective observability and what follows from it, as documents and for people."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray

from tolnet.design.export import csv_lines, flat, markdown_table, opening
from tolnet.model import CorruptedNetwork, Status
from tolnet.model.drkf import DrkfSteadyState
from tolnet.model.error_bound import ErrorBound, MultiplicativeNoise
from tolnet.model.observability import RobustObservability
from tolnet.report.filters import number
from tolnet.report.table import empty_table

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

SHOWN_NODES = 12
"""Rows of nodes that people are shown: those that matter most."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """Steady states for each value of one parameter."""

    parameter: str
    values: Sequence[float]
    relative: bool
    found: Sequence[DrkfSteadyState]

    @property
    def trace(self) -> list[float]:
        """Mean tr P over nodes and phases."""
        return [float(each.trace.mean()) for each in self.found]

    def document(self) -> dict[str, Any]:
        """What a document says of it."""
        return {
            "parameter": self.parameter,
            "relative": self.relative,
            "values": list(self.values),
            "mean_trace": self.trace,
            "worst": [each.worst for each in self.found],
            "status": [str(each.status) for each in self.found],
        }


@dataclass(frozen=True, eq=False)
class ObservabilityReport:
    """Everything that `tolnet observability` found."""

    network: CorruptedNetwork
    main: RobustObservability
    """In the form and over the instants that were asked for."""
    forms: Mapping[str, RobustObservability]
    """Every form over the same instants."""
    over_horizon: RobustObservability | None
    """The same form over finitely many instants, where the condition fails in the long run."""
    noise: MultiplicativeNoise
    bound: ErrorBound | None
    steady: Mapping[str, DrkfSteadyState]
    """By channel; nothing for functions of k."""
    sweeps: Sequence[Sweep] = ()
    full: bool = False

    @property
    def ranked(self) -> RobustObservability:
        """That by which nodes can be told apart."""
        return self.main if self.main.holds or self.over_horizon is None else self.over_horizon

    def document(self) -> dict[str, Any]:
        """`tolnet.observability/1`."""
        main = _found(self.main)
        forms = {form: {key: _found(each)[key] for key in _BRIEF} for form, each in self.forms.items()}
        return {
            **opening("tolnet.observability/1", self.network, str(Status.OK)),
            **main,
            "forms": forms,
            "over_horizon": None if self.over_horizon is None else _found(self.over_horizon),
            "multiplicative_noise": _noise(self.noise),
            "error_bound": None if self.bound is None else _bound(self.bound),
            "steady_state": {channel: self._steady(each) for channel, each in self.steady.items()},
            "sweeps": [sweep.document() for sweep in self.sweeps],
        }

    def _steady(self, found: DrkfSteadyState) -> dict[str, Any]:
        said: dict[str, Any] = {
            "status": str(found.status),
            "reason": found.reason or None,
            "mean_trace": float(found.trace.mean()),
            "worst": found.worst,
            "node_trace": found.trace.mean(axis=0),
            "error": found.error,
        }
        if self.full:
            said |= {"P": found.P, "K": found.K, "rows": self.network.rows, "pairs": self.network.pairs}
            said["weights"] = found.weights if found.status == Status.OK else None
        return said

    @cached_property
    def columns(self) -> dict[str, ndarray]:
        """A row a node."""
        names = {} if self.network.names is None else {"name": np.array(self.network.names)}
        ranked = self.ranked
        keys = ("alpha_without_node", "alpha_of_node", "alpha_with_copy")
        traces = {f"trace_P_{channel}": each.trace.mean(axis=0) for channel, each in self.steady.items()}
        tau, phi = self.network.tau(0), self.network.phi(0)
        return {
            "node": np.arange(self.network.N),
            **names,
            "fading_mean": tau,
            "fading_variance": phi,
            **{key: getattr(ranked, key) for key in keys},
            **traces,
        }

    def csv(self) -> Iterator[str]:
        """The columns, with all single numbers of the document in comment lines before them."""
        single = {key: value for key, value in flat(self.document()) if np.ndim(value) == 0}
        rows = zip(*(column.tolist() for column in self.columns.values()), strict=True)
        return csv_lines(single, self.columns, rows)

    def markdown(self) -> Iterator[str]:
        """The verdict and a row a node, rounded for reading."""
        yield f"# Robust observability of {self.network.name or 'an unnamed problem'}\n\n"
        yield f"- problem file: SHA-256 `{self.network.digest or 'none, it was not read from a file'}`\n"
        yield from (f"- {line.strip()}\n" for line in self.lines())
        yield "\n"
        rows = zip(*(column.tolist() for column in self.columns.values()), strict=True)
        yield from markdown_table(list(self.columns), rows, ("name",))

    def arrays(self) -> dict[str, Any]:
        """The document as arrays, with the gains, weights and covariances of every phase."""
        nested = (
            "weakest_direction",
            "lost_modes",
            "growing",
            "reason",
            "sweeps",
            "over_horizon",
            "alpha_with_state",
        )
        document = {key: value for key, value in self.document().items() if key not in nested}
        leaves = {key: "" if value is None else value for key, value in flat(document, "_")}
        arrays: dict[str, Any] = {**leaves, "weakest_direction": self.main.weakest_direction}
        arrays["alpha_with_state"] = self.main.alpha_with_state
        arrays |= {"rows": self.network.rows, "pairs": self.network.pairs}
        for channel, found in self.steady.items():
            each = {"P": found.P, "P_tilde": found.P_tilde, "K": found.K}
            if found.status == Status.OK:
                each["weights"] = found.weights
            arrays |= {f"steady_state_{channel}_{key}": value for key, value in each.items()}
        for sweep in self.sweeps:
            arrays |= {f"sweep_{sweep.parameter}_{key}": value for key, value in sweep.document().items()}
        return arrays

    def lines(self) -> Iterator[str]:
        """The verdict and what follows from it, for people."""
        network, main = self.network, self.main
        period = {None: "functions of k", 1: "constant"}.get(network.period, f"period {network.period}")
        yield f"{network.name or 'unnamed problem'}: {network.N:,} nodes, {network.n} states, {period}"
        yield _verdict(main)
        if main.reason:
            yield f"  why: {main.reason}"
        if self.over_horizon is not None:
            yield _verdict(self.over_horizon)
        yield f"  weakest direction: {_words(self.ranked, self.ranked.weakest_direction)}"
        yield _best_sensor(self.ranked)
        alone = np.flatnonzero(self.ranked.holds_of_node)
        yield f"  nodes that see everything alone: {_nodes(network, alone)}"
        yield from self._consequences()

    def _consequences(self) -> Iterator[str]:
        noise, bound = self.noise, self.bound
        verdict = "holds" if noise.holds else f"does not hold: {noise.reason}"
        yield f"multiplicative noise (Assumption 3.2): {verdict}"
        yield f"  sup mu |F Pi F'| = {noise.supremum:.4g}"
        if bound is not None and bound.applies:
            yield (
                f"error bound (Theorem 3.1): c_0 / alpha = {bound.bound:.4g} from k = {bound.start} on;"
                " a certificate, larger than the truth by orders"
            )
        elif bound is not None:
            yield "error bound (Theorem 3.1): none, since its assumptions fail"
        for channel, found in self.steady.items():
            what = _CHANNEL_WORDS[channel]
            if found.status == Status.OK:
                yield (
                    f"steady state, {what}: mean tr P = {found.trace.mean():.6g},"
                    f" error variance at most {found.worst:.6g} in any direction"
                )
            else:
                yield f"steady state, {what}: {found.status}: {found.reason}"

    def view(self) -> Iterator[RenderableType]:
        """For a terminal."""
        yield from self.lines()
        yield self._forms()
        scope = _scope(self.ranked)
        yield f"nodes, the most important first (alpha for {scope}, window {self.ranked.window})"
        yield self._nodes()
        for sweep in self.sweeps:
            yield _sweep_table(sweep)

    def _forms(self) -> Table:
        table = empty_table(["form", "holds", "window", "alpha", "alpha by window"], words=("form", "holds"))
        for form, found in self.forms.items():
            by_window = ", ".join(f"{alpha:.3g}" for alpha in found.alpha_by_window[:6])
            table.add_row(form, "yes" if found.holds else "no", str(found.window), f"{found.alpha:.6g}", by_window)
        return table

    def _nodes(self) -> Table:
        """The nodes whose loss costs most, and of those whose copy helps most."""
        ranked, columns = self.ranked, self.columns
        heads = {
            "node": "node",
            "fading_mean": "tau",
            "fading_variance": "phi",
            "alpha_without_node": "alpha without it",
            "alpha_of_node": "alone",
            "alpha_with_copy": "with one more",
            **{f"trace_P_{channel}": f"tr P, {channel}" for channel in self.steady},
        }
        table = empty_table(heads.values(), words=("node",))
        order = np.lexsort((-ranked.alpha_with_copy, ranked.alpha_without_node))
        for i in order[:SHOWN_NODES].tolist():
            cells = (number(float(columns[key][i]), ".5g") for key in list(heads)[1:])
            table.add_row(self.network.label(i), *cells)
        if self.network.N > SHOWN_NODES:
            table.add_row(f"... {self.network.N - SHOWN_NODES} more")
        return table


_BRIEF = ("holds", "alpha", "window", "worst_start", "alpha_by_window", "reason")
_CHANNEL_WORDS = {
    "worst": "worst channels",
    "clean": "no matrix noise",
    "best": "no matrices sent (table of gains)",
}


def _found(found: RobustObservability) -> dict[str, Any]:
    return {
        "form": found.form,
        "horizon": found.horizon,
        "holds": found.holds,
        "alpha": found.alpha,
        "window": found.window,
        "worst_start": found.worst_start,
        "reason": found.reason or None,
        "weakest_direction": _components(found, found.weakest_direction),
        "alpha_by_window": found.alpha_by_window,
        "alpha_over_time": found.alpha_over_time,
        "alpha_limit": found.alpha_limit,
        "alpha_without_node": found.alpha_without_node,
        "alpha_of_node": found.alpha_of_node,
        "alpha_with_copy": found.alpha_with_copy,
        "alpha_with_state": dict(zip(found.state_names, found.alpha_with_state.tolist(), strict=True)),
        "added_variance": found.added_variance,
        "growing": [_components(found, column) for column in found.growing.T],
        "lost_modes": [
            {
                "modulus": abs(mode.eigenvalue),
                "direction": _components(found, np.array(mode.direction)),
                "nodes": list(mode.nodes),
            }
            for mode in found.lost
        ],
    }


def _components(found: RobustObservability, direction: ndarray) -> list[dict[str, Any]]:
    return [{"state": state, "component": value} for state, value in found.named(direction)]


def _noise(found: MultiplicativeNoise) -> dict[str, Any]:
    keys = ("holds", "a_lower", "a_upper", "growth", "b_bar", "bound", "supremum")
    return {**{key: getattr(found, key) for key in keys}, "reason": found.reason or None}


def _bound(found: ErrorBound) -> dict[str, Any]:
    keys = (
        "applies",
        "bound",
        "computed",
        "start",
        "c0",
        "log10_c0",
        "p_min",
        "q_lower",
        "q_hat",
        "eta",
        "beta",
        "a_min",
    )
    return {**{key: getattr(found, key) for key in keys}, "reason": found.reason or None}


def _scope(found: RobustObservability) -> str:
    return "every k" if found.horizon is None else f"k = 0..{found.horizon}"


def _verdict(found: RobustObservability) -> str:
    head = f"robust collective observability ({found.form} form), {_scope(found)}:"
    if not found.holds:
        return f"{head} does not hold"
    where = "in the limit of large k" if found.worst_start is None else f"at k = {found.worst_start}"
    return f"{head} holds with a window of {found.window}; alpha = {found.alpha:.6g}, least {where}"


def _words(found: RobustObservability, direction: ndarray) -> str:
    return " ".join(f"{value:+.3g} {state}" for state, value in found.named(direction)[:6])


def _nodes(network: CorruptedNetwork, which: ndarray) -> str:
    if not which.size:
        return "none"
    names = ", ".join(network.label(int(i)) for i in which[:8])
    return names + (f" and {which.size - 8} more" if which.size > 8 else "")


def _best_sensor(found: RobustObservability) -> str:
    """Where one more sensor helps most: like an existing one, or of one state."""
    i, j = int(np.argmax(found.alpha_with_copy)), int(np.argmax(found.alpha_with_state))
    copy, state = float(found.alpha_with_copy[i]), float(found.alpha_with_state[j])
    if max(copy, state) <= found.alpha * (1 + 1e-9):
        return "  one more sensor of a single state does not raise alpha: two or more are needed"
    return (
        f"  one more sensor: of {found.state_names[j]}, without fading, with variance {found.added_variance:.4g}:"
        f" alpha = {state:.6g}; like node {found.network.label(i)}'s: {copy:.6g}"
    )


def _sweep_table(sweep: Sweep) -> Table:
    head = f"{sweep.parameter} times" if sweep.relative else sweep.parameter
    table = empty_table([head, "mean tr P", "largest eigenvalue", "status"], words=("status",))
    for value, found in zip(sweep.values, sweep.found, strict=True):
        trace = float(found.trace.mean())
        bad = not math.isfinite(trace)
        cells = (f"{value:.6g}", number(trace, ".6g"), number(found.worst, ".6g"), str(found.status))
        table.add_row(*cells, style="bold red" if bad else None)
    return table
