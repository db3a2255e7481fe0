"""What a certificate proves, in words: a row a claim, the margin, and what would have to change for it to fail."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tolnet.report.table import empty_table

if TYPE_CHECKING:
    from rich.console import RenderableType

    from tolnet.analysis.stability_candidates import Growth
    from tolnet.certificates.deployed import Deployed
    from tolnet.certificates.verdicts import Verdict
    from tolnet.design.stabilise import StableWeights
    from tolnet.model import Ambiguity

_STYLES = {"refuted": "bold red", "undecided": "yellow"}
_NAMED_AT_MOST = 5


def certificate_view(
    deployed: Deployed,
    ambiguity: Ambiguity,
    verdicts: Sequence[Verdict],
    published: float | None,
    largest: float | None = None,
) -> Iterator[RenderableType]:
    """The claims side by side, then each in words.

    `published` is the published bound on c of the centre, `largest` the largest c for which it was proved to converge
    from every start; both on the gamma scale, where they are to be told.
    """
    network = deployed.network
    nodes = f"{network.N:,} node{'' if network.N == 1 else 's'}"
    yield (
        f"{network.name or 'unnamed problem'}: {nodes}, c = {ambiguity.tolerance:.6g} ({ambiguity.convention});"
        " claims on the exact numbers that are deployed"
    )
    table = empty_table(["claim", "of", "verdict", "margin"], words=("claim", "of", "verdict"))
    for group in _groups(verdicts):
        for verdict, members in _by_verdict(group):
            table.add_row(members[0].claim, _subjects(members), verdict, _margin(members), style=_STYLES.get(verdict))
    yield table
    for group in _groups(verdicts):
        yield from _words(group)
    if largest is not None:
        yield (
            "- The largest tolerance for which the centre was proved to converge from every start is"
            f" {largest:.3g} (gamma)."
        )
    if published is not None:
        covers = "covers" if published >= ambiguity.gamma else "does not cover"
        yield (
            f"- For comparison, the published block-contraction bound for the centre is c = {published:.3g} (gamma):"
            f" it {covers} this tolerance."
        )


def _groups(verdicts: Sequence[Verdict]) -> list[list[Verdict]]:
    """The verdicts on one claim together, in their order."""
    groups: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        groups.setdefault(verdict.claim, []).append(verdict)
    return list(groups.values())


def _by_verdict(group: Sequence[Verdict]) -> Iterator[tuple[str, list[Verdict]]]:
    for word in ("refuted", "undecided", "proved"):
        members = [verdict for verdict in group if verdict.verdict == word]
        if members:
            yield word, members


def _subjects(members: Sequence[Verdict]) -> str:
    nodes = [verdict.node for verdict in members if verdict.node is not None]
    if not nodes:
        return {"F": "F", "network": "network block"}.get(str(members[0].keys.get("block")), "network")
    counted = [node for node in nodes if node != "centre"]
    named = [str(node) for node in counted[:_NAMED_AT_MOST]]
    few = f"node{'' if len(counted) == 1 else 's'} {', '.join(named)}" if len(counted) <= _NAMED_AT_MOST else ""
    parts = ["centre"] * ("centre" in nodes) + ([few or f"{len(counted):,} nodes"] if counted else [])
    return " and ".join(parts)


def _margin(members: Sequence[Verdict]) -> str:
    margins = [m for verdict in members if (m := getattr(verdict, "margin", None)) is not None]
    return f"{min(margins):.3g}" if margins else "-"


def _words(group: Sequence[Verdict]) -> Iterator[str]:
    """One claim in words, worst first."""
    for word, members in _by_verdict(group):
        first = members[0]
        if first.node is None and len(members) > 1:
            for member in members:
                yield from _words([member])
            continue
        more = f" (and {len(members) - 1:,} more)" if len(members) > 1 else ""
        match word:
            case "proved":
                yield f"- Proved{more}: {first.statement}{_what_if(members)}"
            case "refuted":
                yield f"- Refuted{more}: {first.statement}"
            case _:
                yield f"- Undecided{more}: {first.statement} Why: {getattr(first, 'reason', '')}"


def _what_if(members: Sequence[Verdict]) -> str:
    """What would have to change for a proved claim to fail."""
    margins = [m for verdict in members if (m := getattr(verdict, "margin", None)) is not None]
    match members[0].claim:
        case "schur-stability" | "decay-rate" | "switching" if margins:
            grows = (1 / np.sqrt(1 - min(margins)) - 1) * 100
            return f" It stays true as long as the error loops M_k grow by less than {grows:.2g} % together."
        case "attraction":
            worst = max(members, key=lambda verdict: float.fromhex(verdict.keys["rate"]))
            rate = float.fromhex(worst.keys["rate"])
            where = "the centre" if worst.node == "centre" else f"node {worst.node}"
            return (
                f" The slowest is {where}, {rate:.4g}; `tolnet table --limits` tells at which tolerance it reaches 1."
            )
        case "steady-state":
            error = max(float.fromhex(verdict.keys["gain_error"]) for verdict in members)
            return f" No deployed gain is further than {error:.1e} from the exact one, relative to its largest entry."
        case "tolerance":
            intervals = [list(map(float.fromhex, verdict.keys["interval"].split(" "))) for verdict in members]
            widest = max(((high - low) / 2 / high for low, high in intervals if high > 0), default=0.0)
            return f" No interval is wider than +-{widest:.1e} of its c_k."
    return ""


def instability_view(
    deployed: Deployed, growth: tuple[str, Growth] | None, repaired: StableWeights | None, *, written: bool
) -> Iterator[RenderableType]:
    """Which nodes carry the unstable mode, and which weights nearby are proved stable (`written` or not)."""
    network = deployed.network
    if growth is not None and growth[0] == "network":
        found = growth[1]
        share = np.linalg.norm(np.reshape(found.mode, (deployed.N, deployed.n)), axis=1)
        share = share / share.sum()
        order = np.argsort(-share, kind="stable")[:_NAMED_AT_MOST].tolist()
        carriers = ", ".join(f"{network.label(k)} ({100 * share[k]:.0f} %)" for k in order if share[k] >= 0.01)
        yield f"The mode grows by a factor of {abs(found.eigenvalue):.4g} a step; these nodes carry it: {carriers}."
    if repaired is None:
        yield "No weights nearby were found that could be proved stable; --diffusion none keeps every node to itself."
        return
    if repaired.own_only:
        yield "Only W = I was found to be stable: every node keeps its own estimate. That is the last resort."
    W, w = repaired.W.toarray(), deployed.mixing.toarray().T
    moved = np.abs(W - w).sum(axis=0) / 2
    changed = np.flatnonzero(moved > 1e-9).tolist()
    yield (
        f"Weights nearby are proved stable, with a margin of {repaired.margin:.3g}: they differ by"
        f" {np.linalg.norm(W - w):.3g} in the Frobenius norm, at {len(changed)} of {deployed.N} nodes."
    )
    for k in changed[:_NAMED_AT_MOST]:
        heard = np.flatnonzero((w[:, k] > 0) | (W[:, k] > 0)).tolist()
        weights = ", ".join(f"{network.label(l)}: {w[l, k]:.3g} -> {W[l, k]:.3g}" for l in heard)
        yield f"  node {network.label(k)} weighs {weights}"
    if len(changed) > _NAMED_AT_MOST:
        yield f"  ... and {len(changed) - _NAMED_AT_MOST} more nodes"
    if not written:
        yield "  --stable-weights FILE.toml writes the problem with them"
