"""What Monte Carlo makes of each filter, as documents and for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tolnet.model import Status, ToleranceTable
from tolnet.model.simulation import Simulation
from tolnet.report.filters import FilterReport, decibels, headline, number, words_of

if TYPE_CHECKING:
    from rich.console import RenderableType


def simulation_report(table: ToleranceTable, diffusion: str, found: Mapping[str, Simulation]) -> FilterReport:
    """The document `tolnet.simulation/1` and its table, from what analysis.simulate_filters found.

    A filter of which runs left the range of doubles diverges, whatever the others did. An archive of arrays holds the
    predicted deviations and the consistency node by node too.
    """
    columns, by_node = {"t": np.arange(_first(found).steps + 1)}, {}
    for name, each in found.items():
        low, high = each.interval.T
        over_time = {"mse": each.mse, "low": low, "high": high, "bound": each.bound, "consistency": each.consistency}
        columns |= {f"{name}_{key}": values for key, values in over_time.items()}
        by_node[f"filters_{name}_node_bound"] = each.node_bound
        by_node[f"filters_{name}_node_consistency"] = each.node_consistency
    return FilterReport(
        schema="tolnet.simulation/1",
        title="Simulation",
        table=table,
        about={"diffusion": diffusion},
        filters={name: _entry(each) for name, each in found.items()},
        shown=_shown(found),
        columns=columns,
        arrays_only=by_node,
    )


def simulation_view(report: FilterReport, found: Mapping[str, Simulation]) -> Iterator[RenderableType]:
    """The filters side by side after the last step, measured beside predicted."""
    one = _first(found)
    yield headline(report)
    yield (
        f"{one.runs:,} runs of {one.steps:,} steps of the least favourable model, seed {one.seed}: mean square error"
        f" after step {one.steps:,}, and the share of errors within the 95 % ellipsoid of the filter's own V"
    )
    yield report.view()


def standing(found: Simulation) -> tuple[Status, str]:
    """How a filter came through: its status, or that runs diverged."""
    if found.status == Status.OK and found.diverged:
        return Status.DIVERGES, (
            f"{found.diverged:,} of {found.runs:,} runs left the range of doubles, and are not among the numbers"
        )
    return found.status, found.reason


def _first(found: Mapping[str, Simulation]) -> Simulation:
    """One of them, for what all of them share."""
    return next(iter(found.values()))


def _entry(found: Simulation) -> dict[str, Any]:
    return {
        "mse": found.mse,
        "interval": found.interval,
        "bound": found.bound,
        "consistency": found.consistency,
        "node_mse": found.node_mse,
        "diverged": found.diverged,
        "runs": found.runs,
        "steps": found.steps,
        "seed": found.seed,
        **words_of(*standing(found)),
    }


def _shown(found: Mapping[str, Simulation]) -> dict[str, list[str]]:
    last = {name: (each.mse[-1], *each.interval[-1], each.bound[-1]) for name, each in found.items()}
    return {
        "filter": list(found),
        "MSE [dB]": [number(decibels(mse), ".4f") for mse, *_ in last.values()],
        "MSE": [number(mse, ".5g") for mse, *_ in last.values()],
        "95 % interval": [_interval(low, high) for _, low, high, _ in last.values()],
        "predicted MSD": [number(bound, ".5g") for *_, bound in last.values()],
        "consistency": [number(each.consistency[-1], ".4f") for each in found.values()],
        "diverged": [f"{each.diverged:,}" for each in found.values()],
        "status": [str(standing(each)[0]) for each in found.values()],
    }


def _interval(low: float, high: float) -> str:
    return "-" if np.isnan(low) else f"{low:.5g} to {high:.5g}"
