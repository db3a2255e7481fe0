"""What a certificate about corrupted channels proves, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tolnet.report.table import empty_table

if TYPE_CHECKING:
    from rich.console import RenderableType

    from tolnet.certificates.verdicts import Verdict
    from tolnet.model.observability import RobustObservability

_STYLES = {"refuted": "bold red", "undecided": "yellow"}
_NAMED_AT_MOST = 5


def channels_view(pairs: Sequence[tuple[Verdict, RobustObservability]]) -> Iterator[RenderableType]:
    """The claims side by side, each with what floating point found out about the same windows; then in words."""
    network = pairs[0][1].network
    nodes = f"{network.N:,} node{'' if network.N == 1 else 's'}"
    name = network.name or "unnamed problem"
    yield f"{name}: {nodes}, corrupted channels; claims on the exact numbers of the problem"
    table = empty_table(
        ["claim", "form", "windows", "verdict", "alpha"], words=("claim", "form", "windows", "verdict")
    )
    for verdict, _ in pairs:
        keys, word = verdict.keys, verdict.verdict
        windows = f"{keys['window']} long, " + ("all" if keys["horizon"] is None else f"in 0..{keys['horizon']}")
        alpha = f"{float.fromhex(keys['alpha']):.6g}" if "alpha" in keys else "-"
        table.add_row(verdict.claim, keys["form"], windows, word, alpha, style=_STYLES.get(word))
    yield table
    for verdict, found in pairs:
        yield f"- {verdict.verdict.capitalize()}: {verdict.statement} {_in_words(verdict, found)}"


def _in_words(verdict: Verdict, found: RobustObservability) -> str:
    """Where it is weakest, and what would have to change."""
    match verdict.verdict:
        case "proved":
            where = "for large k" if found.worst_start is None else f"from k = {found.worst_start}"
            weakest = _direction(found, found.weakest_direction)
            return f"The weakest window is that {where}, in the direction {weakest}. {_losses(found)}"
        case "refuted":
            from tolnet.certificates.numerals import vector

            witness = getattr(verdict, "witness", {})
            v = vector(witness["vector"])
            unseen = f"From k = {witness['start']} on nobody sees {_direction(found, v / np.linalg.norm(v))}."
            all_windows = found.horizon is None and verdict.keys["window"] >= found.network.n * (
                found.network.period or 1
            )
            return unseen + (" No longer window sees more." if all_windows else "") + _remedy(found)
        case _:
            return f"{getattr(verdict, 'reason', '')}.{_remedy(found)}"


def _direction(found: RobustObservability, v: np.ndarray) -> str:
    v = v * np.sign(v[np.argmax(np.abs(v))])
    return " ".join(f"{value:+.3g} {state}" for state, value in found.named(v))


def _losses(found: RobustObservability) -> str:
    """Whose loss would make the claim fail, or cost most."""
    without = found.alpha_without_node
    network, fatal = found.network, np.flatnonzero(without <= 0).tolist()
    if fatal:
        few = ", ".join(network.label(i) for i in fatal[:_NAMED_AT_MOST])
        more = f" and {len(fatal) - _NAMED_AT_MOST} more" if len(fatal) > _NAMED_AT_MOST else ""
        who = f"node {few} falls" if len(fatal) == 1 else f"any of the nodes {few}{more} falls"
        return f"It fails for windows of this length if {who} silent."
    i = int(np.argmin(without))
    return f"No single node can make it fail; the loss of node {network.label(i)} costs most, alpha {without[i]:.4g}."


def _remedy(found: RobustObservability) -> str:
    """The state that one more sensor should measure."""
    j = int(np.argmax(found.alpha_with_state))
    if found.holds or not found.alpha_with_state[j] > 0:
        return ""
    return (
        f" One more sensor of {found.state_names[j]} that does not fade (variance {found.added_variance:.3g}) would"
        f" make it hold, with alpha {found.alpha_with_state[j]:.4g}."
    )
