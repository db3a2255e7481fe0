"""Designed diffusion weights, as documents and for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from tolnet.design.export import csv_lines, opening
from tolnet.model import Ambiguity, Diffusion, Status, gamma_per
from tolnet.report.filters import decibels, number
from tolnet.report.table import empty_table

if TYPE_CHECKING:
    from rich.console import RenderableType

    from tolnet.design.weights.compare import Rival
    from tolnet.design.weights.topology import AddedLink

_HELD = "[dB]"
_ROWS = 12
"""Nodes shown of those whose MSD moves most."""


def diffusion_document(
    found: Diffusion, rivals: Sequence[Rival] = (), links: Sequence[AddedLink] = ()
) -> dict[str, Any]:
    """The document `tolnet.diffusion/1`. `value`, `baseline` and `bound` are in the units of the objective.

    `bound` and `gap_closed` are null where no bound is known.
    """
    own = found.W.tocoo()
    document: dict[str, Any] = {
        **_heading(found),
        "weights": [[int(l), int(k), float(w)] for l, k, w in zip(own.row, own.col, own.data, strict=True)],
        "node_msd": found.node_msd,
        "baseline_node_msd": found.baseline_node_msd,
        "starts": [{"name": s.name, "value": s.value, "found": s.found} for s in found.starts],
        "history": found.history,
        "elsewhere": _elsewhere(found),
        "gains": _gains(found),
        "certificate": _certificate(found),
        "links": [
            {"from": added.link[0], "to": added.link[1], "value": added.msd, "value_db": decibels(added.msd)}
            for added in links
        ],
    }
    if rivals:
        document["compare"] = [_rival(rival) for rival in rivals]
    return document


def _heading(found: Diffusion) -> dict[str, Any]:
    """Everything that is one number or one word."""
    table = found.table
    ambiguity = Ambiguity(table.tolerance, table.convention, table.tau)
    in_db = found.objective in ("msd", "worst", "robust")
    return {
        **opening("tolnet.diffusion/1", table.network, str(found.status), ambiguity),
        "reason": found.reason or None,
        "objective": found.objective,
        "constraints": dict(found.about),
        "value": found.value,
        "value_db": decibels(found.value) if in_db else None,
        "baseline": found.baseline,
        "baseline_rule": found.baseline_rule,
        "bound": found.bound,
        "gap_closed": found.gap_closed,
        "spectral_radius": found.spectral_radius,
        "blocks": {"network": found.network_radius, "least_favourable": found.least_favourable_radius},
        "msd": found.msd,
        "msd_db": decibels(found.msd),
        "baseline_msd": found.baseline_msd,
        "msd_bound": found.msd_bound,
        "best_start": found.best_start,
        "change": found.change,
        "residual": found.residual,
        "evaluations": found.evaluations,
        "converged": found.converged,
        "interrupted": found.interrupted,
    }


def _elsewhere(found: Diffusion) -> list[dict[str, Any]]:
    scale = gamma_per(found.table.convention)
    return [
        {
            "name": there.name,
            "tolerance": there.tolerance / scale,
            "baseline": there.baseline,
            "msd": there.msd,
            "bound": there.bound,
            "reason": there.reason or None,
        }
        for there in found.elsewhere
    ]


def _gains(found: Diffusion) -> list[dict[str, Any]] | None:
    if found.gains is None:
        return None
    gains, N = found.gains, found.table.network.N
    return [
        {
            "node": k,
            "neighbours": gains.neighbours[gains.offsets[k] : gains.offsets[k + 1]].tolist(),
            "gain": gains.gain(k).tolist(),
        }
        for k in range(N)
    ]


def _certificate(found: Diffusion) -> dict[str, Any] | None:
    if found.certificate is None:
        return None
    return {
        "rate": found.certificate.rate,
        "margin": found.certificate.margin,
        "X": found.certificate.X.tolist(),
        "loops": found.certificate.loops.tolist(),
    }


def _rival(rival: Rival) -> dict[str, Any]:
    return {
        "weights": rival.name,
        "msd": rival.msd,
        "msd_db": decibels(rival.msd),
        "worst": rival.worst,
        "spectral_radius": rival.radius,
        "rate": rival.rate,
        "mixing": rival.mixing,
        "gap_closed": rival.gap_closed,
        "status": rival.status,
    }


def diffusion_csv(found: Diffusion) -> Iterator[str]:
    """W as N lines of N numbers, [l][k] weighs neighbour l at node k, after comment lines that start with `#`."""
    yield from (line for line in csv_lines(_heading(found), [], []) if line.startswith("#"))
    for row in found.W.toarray():
        yield ",".join(map(repr, row.tolist())) + "\n"


def diffusion_arrays(found: Diffusion) -> dict[str, Any]:
    """W, the nodes before and after, gains packed as a tolerance table packs them, and the certificate."""
    heading = _heading(found)
    problem = heading.pop("problem")
    words = {key: "" if value is None else value for key, value in heading.items() if not isinstance(value, Mapping)}
    arrays: dict[str, Any] = {
        **words,
        "problem_name": problem["name"],
        "problem_sha256": problem["sha256"] or "",
        "W": found.W.toarray(),
        "node_msd": found.node_msd,
        "baseline_node_msd": found.baseline_node_msd,
        "history": found.history,
    }
    if found.gains is not None:
        arrays |= {
            "neighbour_offsets": found.gains.offsets,
            "neighbours": found.gains.neighbours,
            "gain_offsets": found.gains.columns,
            "gains": found.gains.gains,
        }
    if found.certificate is not None:
        arrays |= {"certificate_X": found.certificate.X, "certificate_rate": found.certificate.rate}
    return arrays


def diffusion_view(found: Diffusion) -> Iterator[RenderableType]:
    """What was found, beside the baseline and the bound; then elsewhere, and the nodes that it changes most."""
    network, table = found.table.network, found.table
    nodes = f"{network.N:,} node{'' if network.N == 1 else 's'}"
    asked = "".join(f", {key.replace('_', ' ')}: {value}" for key, value in found.about.items())
    yield (
        f"{network.name or 'unnamed problem'}: {nodes}, c = {table.tolerance:.6g} ({table.convention}),"
        f" objective: {found.objective}{asked}"
    )
    yield _values(found)
    yield "radii: network, of the block of F that W changes; least favourable, of the centre's, which it does not"
    if found.certificate is not None:
        yield "decay: certified rate of the network block; how much better another W may be is not known"
    if np.isfinite(found.value) and not np.isfinite(found.baseline):
        yield f"with {found.baseline_rule} weights the network is unstable: there is no gap to close"
    if found.elsewhere:
        yield "the same weights under other least favourable models (filters as they are)"
        yield _elsewhere_table(found)
    moved = _moved(found)
    if moved is not None:
        yield moved
    searches = sum(not np.isnan(s.found) for s in found.starts)
    how = f"best of {searches} searches, from {found.best_start}" if searches > 1 else f"from {found.best_start}"
    settled = "" if found.converged else "; it had not settled"
    tail = f"; the last step, which makes W exactly admissible, changed it by {found.change:.1g}"
    yield f"{how}, {found.evaluations:,} evaluations{settled}{tail}"
    if found.certificate is not None:
        yield (
            f"certificate candidate: errors decay like {found.certificate.rate:.6f}^t (network block),"
            f" margin {found.certificate.margin:.3g}"
        )


def _values(found: Diffusion) -> Table:
    in_db = found.objective in ("msd", "worst", "robust")
    apart = not np.isclose(found.value, found.msd, rtol=1e-12)  # the objective is another number than the mean MSD
    bounded = np.isfinite(found.bound)
    head = [found.objective, *([f"{found.objective} {_HELD}"] if in_db else []), *(["gap closed"] if bounded else [])]
    head += [*(["MSD [dB]"] if apart else []), "radius: network", "least favourable"]
    table = empty_table(["weights", *head], words=("weights",))
    before, fixed, nan = found.baseline_network_radius, found.least_favourable_radius, float("nan")
    designed = "optimised" + (" with gains" if found.gains is not None else "")
    rows = [
        (found.baseline_rule, found.baseline, 0.0 * found.baseline, found.baseline_msd, before),
        (designed, found.value, found.gap_closed, found.msd, found.network_radius),
        *([("bound", found.bound, 1.0, found.msd_bound, nan)] if bounded else []),
    ]
    for name, value, closed, msd, radius in rows:
        cells = [number(value, ".6g"), *([number(decibels(value), ".4f")] if in_db else [])]
        cells += [number(closed, ".1%")] if bounded else []
        cells += [*([number(decibels(msd), ".4f")] if apart else []), number(radius, ".6f")]
        cells += [number(nan if name == "bound" else fixed, ".6f")]
        table.add_row(name, *cells, style="bold" if name == designed else None)
    return table


def _elsewhere_table(found: Diffusion) -> Table:
    table = empty_table(["model", "c", found.baseline_rule, "optimised", "bound"], words=("model",))
    for there in found.elsewhere:
        cells = (number(decibels(value), ".4f") for value in (there.baseline, there.msd, there.bound))
        table.add_row(there.name, f"{there.tolerance / gamma_per(found.table.convention):.4g}", *cells)
    return table


def _moved(found: Diffusion) -> Table | None:
    """The nodes whose MSD changes most."""
    before, after = found.baseline_node_msd, found.node_msd
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        return None
    tiny = np.finfo(float).tiny  # a plant without noise has deviations of zero
    change = 10 * (np.log10(np.maximum(after, tiny)) - np.log10(np.maximum(before, tiny)))
    order = np.argsort(-np.abs(change), kind="stable")[:_ROWS]
    table = empty_table(
        ["node", "MSD before", "MSD after", "change [dB]", "own weight", "neighbours in use"], words=()
    )
    own = found.W.diagonal()
    used = np.diff(found.W.tocsc().indptr)
    degree = found.table.network.degree
    for k in np.sort(order).tolist():
        table.add_row(
            found.table.network.label(k),
            f"{before[k]:.5g}",
            f"{after[k]:.5g}",
            f"{change[k]:+.3f}",
            f"{own[k]:.3f}",
            f"{used[k]} of {degree[k]}",
        )
    return table


def compare_view(rivals: Sequence[Rival]) -> Table:
    """All rules and all objectives side by side."""
    heads = ["weights", "MSD [dB]", "gap closed", "worst node", "rho(F)", "certified rate (network block)"]
    heads += ["|W - 11'/N|", "status"]
    table = empty_table(heads, words=("weights", "status"))
    for rival in rivals:
        table.add_row(
            rival.name,
            number(decibels(rival.msd), ".4f"),
            number(rival.gap_closed, ".1%"),
            number(rival.worst, ".5g"),
            number(rival.radius, ".6f"),
            number(rival.rate, ".6f"),
            number(rival.mixing, ".4f"),
            rival.status,
            style="bold red" if rival.status != Status.OK else None,
        )
    return table


def links_view(found: Diffusion, links: Sequence[AddedLink]) -> Table:
    """Which links were added, in their order, and what the network is worth with each."""
    label = found.table.network.label
    table = empty_table(["link", "MSD [dB]", "better by [dB]", "MSD", "next best"], words=("next best",))
    before = found.value
    for added in links:
        runners = ", ".join(f"{label(l)}-{label(k)} ({decibels(msd):.4f})" for (l, k), msd in added.runners_up)
        table.add_row(
            f"{label(added.link[0])}-{label(added.link[1])}",
            f"{decibels(added.msd):.4f}",
            f"{decibels(before) - decibels(added.msd):.4f}",
            f"{added.msd:.6g}",
            runners,
        )
        before = added.msd
    return table
