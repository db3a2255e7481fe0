"""What Monte Carlo makes of filters over corrupted channels, as documents and for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tolnet.model import CorruptedNetwork
from tolnet.model.corrupted_simulation import CorruptedSimulation
from tolnet.report.filters import FilterReport, headline, number, words_of

if TYPE_CHECKING:
    from rich.console import RenderableType


def channel_report(network: CorruptedNetwork, found: Mapping[str, CorruptedSimulation]) -> FilterReport:
    """The document `tolnet.simulation/1` and its table, from what analysis.simulate_corrupted found.

    A filter of which runs diverged has that status, whatever the others did. An archive of arrays holds bounds,
    sample covariances and consistency node by node too.
    """
    one = next(iter(found.values()))
    columns, by_node = {"t": np.arange(one.steps + 1)}, {}
    for name, each in found.items():
        low, high = each.interval.T
        over_time = {
            "mse": each.mse,
            "low": low,
            "high": high,
            "bound": each.bound,
            "consistency": each.consistency,
            "nees": each.nees,
        }
        columns |= {f"{name}_{key}": values for key, values in over_time.items()}
        for key in ("node_P", "node_error", "node_consistency", "node_nees"):
            by_node[f"filters_{name}_{key}"] = getattr(each, key)
    return FilterReport(
        schema="tolnet.simulation/1",
        title="Simulation",
        table=network,
        about={"shared_path": one.shared, "beyond_bounds": one.beyond_bounds or None},
        filters={name: _entry(each) for name, each in found.items()},
        shown=_shown(found),
        columns=columns,
        arrays_only=by_node,
    )


def channel_view(report: FilterReport, found: Mapping[str, CorruptedSimulation]) -> Iterator[RenderableType]:
    """The filters side by side after the last step, measured beside what each believes, and what to make of it."""
    one = next(iter(found.values()))
    yield headline(report)
    paths = "one path of noise on matrices for all" if one.shared else "each with its own noise on matrices"
    yield (
        f"{one.runs:,} runs of {one.steps:,} steps, {paths}, seed {one.seed}: mean square error after step"
        f" {one.steps:,} beside tr P, and the share of errors within the 95 % ellipsoid of the filter's own P"
    )
    yield report.view()
    growing = [name for name, each in found.items() if each.grows]
    if growing:
        rates = ", ".join(f"{name} ({100 * (found[name].growth - 1):.1f} % a step)" for name in growing)
        yield f"errors still grow at the end of the runs: {rates}"
    over = [f"{name} ({np.nanmax(each.excess):.3g})" for name, each in found.items() if each.overconfident]
    if over:
        yield (
            f"sample covariance above the filter's own P somewhere, by more than chance allows: {', '.join(over)}"
            " times P"
        )
    for name, each in found.items():
        if each.fallbacks:
            yield f"{name}: {each.fallbacks:,} of {each.solves:,} fusions fell back on the weights of Algorithm 1"
    yield from (f"beyond what the filters know: {line}" for line in one.beyond_bounds)


def _entry(found: CorruptedSimulation) -> dict[str, Any]:
    bounded = bool(np.isfinite(found.excess).any())
    fusion = {"solves": found.solves, "fallbacks": found.fallbacks} if found.solves else {}
    return {
        "mse": found.mse,
        "interval": found.interval,
        "bound": found.bound,
        "consistency": found.consistency,
        "nees": found.nees,
        "node_mse": found.node_mse,
        "node_bound": found.node_bound,
        "excess": float(np.nanmax(found.excess)) if bounded else np.nan,
        "overconfident": found.overconfident if bounded else None,
        "growth": found.growth,
        "diverged": found.diverged,
        **fusion,
        "runs": found.runs,
        "steps": found.steps,
        "seed": found.seed,
        **words_of(found.status, found.reason),
    }


def _shown(found: Mapping[str, CorruptedSimulation]) -> dict[str, list[str]]:
    last = {name: (each.mse[-1], *each.interval[-1]) for name, each in found.items()}
    each = list(found.values())
    return {
        "filter": list(found),
        "MSE": [number(mse, ".5g") for mse, *_ in last.values()],
        "95 % interval": ["-" if np.isnan(low) else f"{low:.5g} to {high:.5g}" for _, low, high in last.values()],
        "tr P": [number(one.bound[-1], ".5g") for one in each],
        "within 95 %": [number(one.consistency[-1], ".4f") for one in each],
        "NEES / n": [number(one.nees[-1], ".4g") for one in each],
        "error": [f"grows {100 * (one.growth - 1):.1f} %" if one.grows else "steady" for one in each],
        "diverged": [f"{one.diverged:,}" for one in each],
        "status": [str(one.status) for one in each],
    }
