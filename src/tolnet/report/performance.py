"""How well each filter estimates under the least favourable model, as documents and for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tolnet.analysis.filters import steady_filter
from tolnet.model import Performance, Status, ToleranceTable, gamma_per
from tolnet.model.history import FILTERS, FilterHistory, FilterKind
from tolnet.report.filters import FilterReport, decibels, headline, number, per_node, words_of
from tolnet.report.table import empty_table

if TYPE_CHECKING:
    from rich.console import RenderableType

_INSTANTS = 11
"""Rows of the history that people are shown."""


def performance_report(
    table: ToleranceTable, diffusion: str, steady: Mapping[str, Performance], histories: Mapping[str, FilterHistory]
) -> FilterReport:
    """The document `tolnet.performance/1` and its table.

    `steady` is what analysis.evaluate_filters found with weights by the rule `diffusion`, and `histories` what
    analysis.follow_filters found, if anything; an archive of arrays holds them node by node.
    """
    scale = gamma_per(table.convention)
    entries = {name: _entry(table, found, FILTERS[name]) for name, found in steady.items()}
    by_node = {}
    for name, history in histories.items():
        entries[name]["history"] = {
            "msd": history.msd,
            "tolerance": history.tolerance.mean(axis=1) / scale,
            "theta": history.theta.mean(axis=1),
            **words_of(history.status, history.reason),
        }
        each = {"msd": history.node_msd, "tolerance": history.tolerance / scale, "theta": history.theta}
        by_node |= {f"filters_{name}_history_node_{key}": values for key, values in each.items()}
    horizon = {} if not histories else {"horizon": _horizon(histories)}
    return FilterReport(
        schema="tolnet.performance/1",
        title="Performance",
        table=table,
        about={"diffusion": diffusion, **horizon},
        filters=entries,
        shown=_shown(table, steady, entries),
        columns=per_node(table.network, {name: found.node_msd for name, found in steady.items()}),
        arrays_only=by_node,
    )


def performance_view(report: FilterReport, histories: Mapping[str, FilterHistory]) -> Iterator[RenderableType]:
    """The filters side by side and, where they were followed over time, their MSD at some instants."""
    yield headline(report)
    yield "mean square deviation in the steady state, under the least favourable model of the centre"
    yield report.view()
    if any(entry["status"] == Status.OSCILLATES for entry in report.filters.values()):
        yield "what oscillates has the numbers of gains frozen at its steady state, on which it never settles"
    if histories:
        T = _horizon(histories)
        yield f"MSD [dB] over {T:,} steps from the initial covariance, under the model that is worst for these steps"
        table = empty_table(["t", *histories], words=())
        for t in np.unique(np.linspace(0, T, _INSTANTS).round().astype(int)).tolist():
            values = (decibels(float(history.msd[t])) for history in histories.values())
            table.add_row(f"{t:,}", *(number(value, ".4f") for value in values))
        yield table


def _horizon(histories: Mapping[str, FilterHistory]) -> int:
    """The number of steps, which all of them share."""
    return len(next(iter(histories.values())).theta)


def _entry(table: ToleranceTable, found: Performance, kind: FilterKind) -> dict[str, Any]:
    tolerance, theta = _means(table, kind)
    return {
        "msd": found.msd,
        "msd_db": decibels(found.msd),
        "spectral_radius": found.spectral_radius,
        "blocks": {"network": found.network_radius, "least_favourable": found.least_favourable_radius},
        "node_msd": found.node_msd,
        "mean_tolerance": tolerance / gamma_per(table.convention),
        "mean_theta": theta,
        "messages": kind.messages,
        "method": found.method,
        "residual": found.residual,
        "error_estimate": found.error_estimate,
        **words_of(found.status, found.reason),
    }


def _means(table: ToleranceTable, kind: FilterKind) -> tuple[float, float]:
    """The mean tolerance and theta of a filter's nodes; a plain Kalman filter has none to solve for."""
    if kind.ball == "none":
        return 0.0, 0.0
    gains = steady_filter(table, kind)
    return float(gains.tolerance.mean()), float(gains.theta.mean())


def _shown(
    table: ToleranceTable, steady: Mapping[str, Performance], entries: Mapping[str, Mapping[str, Any]]
) -> dict[str, list[str]]:
    def column(key: str, digits: str) -> list[str]:
        return [number(entry[key], digits) for entry in entries.values()]

    return {
        "filter": list(entries),
        "MSD [dB]": column("msd_db", ".4f"),
        "MSD": column("msd", ".5g"),
        "worst node": [_worst(table, found) for found in steady.values()],
        "rho(F)": column("spectral_radius", ".6f"),
        "mean c_k": column("mean_tolerance", ".5g"),
        "mean theta_k": column("mean_theta", ".5g"),
        "messages from the centre": [entry["messages"] for entry in entries.values()],
        "status": [entry["status"] for entry in entries.values()],
    }


def _worst(table: ToleranceTable, found: Performance) -> str:
    """The node that estimates worst, and its MSD."""
    msd = found.node_msd
    if len(msd) == 1 or np.isnan(msd).any():
        return "-"
    k = int(np.argmax(msd))
    return f"{table.network.label(k)}: {msd[k]:.5g}"
