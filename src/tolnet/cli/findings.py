"""What `tolnet check` says: a row a claim or comparison, how many nodes are covered, what is required and missing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from tolnet.cli.certify import ATTEMPTED, FILTER_CLAIMS, ON_REQUEST
from tolnet.cli.certify_channels import CLAIM
from tolnet.cli.options import nearest

CLAIMS = (*ATTEMPTED, *ON_REQUEST, CLAIM)
VERDICTS = ("proved", "refuted", "undecided")
COMPARISON = ""
"""In the place of a verdict, where a row compares."""
_NAMED = 3
_STYLES = {"invalid": "bold red", "undecided": "yellow", "not checked here": "yellow"}


@dataclass(frozen=True)
class Row:
    """What is to be said of one claim, or of one part of a comparison."""

    claim: str
    of: str
    result: str
    """valid, invalid, not checked here or undecided"""
    text: str
    verdict: str = COMPARISON
    node: int | str | None = None
    """Of a claim about a filter."""
    index: int = -1
    """Among the claims."""
    entry: dict[str, Any] | None = None
    """The claim where it is valid, which says that its form is right; nothing else of a file is to be trusted."""

    def document(self) -> dict[str, Any]:
        """As JSON."""
        own = {} if self.verdict == COMPARISON else {"verdict": self.verdict, "node": self.node}
        return {"claim": self.claim, "of": self.of, **own, "result": self.result, "text": self.text}


def compared_row(claim: str, of: str, wrong: Sequence[str], right: str) -> Row:
    """Of a comparison: invalid where something differs."""
    some = ", ".join(wrong[:_NAMED]) + (f" and {len(wrong) - _NAMED} more" if len(wrong) > _NAMED else "")
    return Row(claim, of, "invalid" if wrong else "valid", f"differs in {some}" if wrong else right)


def not_compared(claim: str, of: str, why: str) -> Row:
    """Of a comparison that could not be made."""
    return Row(claim, of, "not checked here", f"not compared: {why}")


def valid(rows: Sequence[Row], claim: str, verdict: str = "proved") -> dict[int | str | None, dict[str, Any]]:
    """The valid claims of this name and verdict, by node."""
    found = (row for row in rows if row.claim == claim and row.verdict == verdict and row.result == "valid")
    return {row.node: row.entry for row in found if row.entry is not None}


def named(nodes: Sequence[int]) -> str:
    """Some nodes, the first few by number."""
    few = ", ".join(map(str, nodes[:_NAMED])) + (f" and {len(nodes) - _NAMED} more" if len(nodes) > _NAMED else "")
    return f"node{'' if len(nodes) == 1 else 's'} {few}"


# ---- Coverage ----


def coverage(rows: Sequence[Row], nodes: int) -> list[dict[str, Any]]:
    """For each claim about filters: of how many distinct nodes it is proved, refuted (validly) or undecided."""
    found = []
    for claim in FILTER_CLAIMS:
        told = {verdict: _told(rows, claim, verdict) for verdict in VERDICTS}
        if any(told.values()):
            centre = next((verdict for verdict in VERDICTS if "centre" in told[verdict]), None)
            counts = {verdict: len(who - {"centre"}) for verdict, who in told.items()}
            found.append({"claim": claim, "nodes": nodes, **counts, "centre": centre})
    return found


def _told(rows: Sequence[Row], claim: str, verdict: str) -> set[int | str]:
    result = "undecided" if verdict == "undecided" else "valid"
    return {
        row.node
        for row in rows
        if (row.claim, row.verdict, row.result) == (claim, verdict, result) and row.node is not None
    }


def coverage_lines(covered: Sequence[dict[str, Any]]) -> Iterator[str]:
    """One line a claim."""
    for each in covered:
        counts = [f"{each[word]} {word}" for word in VERDICTS[1:] if each[word]]
        centre = "" if each["centre"] is None else f"; the centre {each['centre']}"
        others = f" ({', '.join(counts)})" if counts else ""
        yield f"coverage: {each['claim']} proved for {each['proved']} of {each['nodes']} nodes{others}{centre}"


# ---- Requirements ----


def required_claims(text: str | None) -> list[str]:
    """The names in `--require`. Raises InputError for one that is no claim."""
    from tolnet.model import InputError

    words = [] if text is None else [word.strip() for word in text.split(",")]
    for word in words:
        if word not in CLAIMS:
            raise InputError(f"--require names {word!r}; the claims are {', '.join(CLAIMS)}{nearest(word, CLAIMS)}")
    return list(dict.fromkeys(words))


def requirements(rows: Sequence[Row], wanted: Sequence[str], nodes: int) -> Iterator[Row]:
    """A row for every claim that is required: of every node, where it speaks of filters."""
    for claim in wanted:
        proved = valid(rows, claim)
        if claim in FILTER_CLAIMS:
            missing = [k for k in range(nodes) if k not in proved]
            refuted = [k for k in missing if k in valid(rows, claim, "refuted")]
            more = f", and refuted for {named(refuted)}" if refuted else ""
            text = (
                f"not proved for {named(missing)}: {nodes - len(missing)} of {nodes} nodes{more}" if missing else ""
            )
        else:
            refuted = valid(rows, claim, "refuted")
            told = any(row.claim == claim for row in rows)
            text = "" if proved and not refuted else "refuted" if refuted else "not proved" if told else "missing"
        yield Row(
            "required", claim, "invalid" if text else "valid", text or "proved, for every node that it speaks of"
        )


# ---- What people see ----


def view(rows: Sequence[Row], covered: Sequence[dict[str, Any]], heading: str) -> Iterator[Any]:
    """The rows side by side, what is covered, then each kind of row in words."""
    from tolnet.report.table import empty_table

    yield plain(heading)
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.claim, row.verdict, row.result), []).append(row)
    table = empty_table(["claim", "verdict", "of", "result"], words=("claim", "verdict", "of", "result"))
    for (claim, verdict, result), members in groups.items():
        table.add_row(plain(claim), plain(verdict), plain(_subjects(members)), result, style=_STYLES.get(result))
    yield table
    yield from coverage_lines(covered)
    for (_, verdict, result), members in groups.items():
        others = len({row.node for row in members}) - 1 if members[0].node is not None else len(members) - 1
        more = f" (and {others:,} more)" if others else ""
        word = f", {verdict}" if verdict else ""
        yield plain(f"- {result.capitalize()}{word}{more}: {members[0].text}")


def _subjects(members: Sequence[Row]) -> str:
    """Whom a group of rows speaks of; a node that is told of twice counts once."""
    nodes = {row.node for row in members if row.node is not None}
    if not nodes:
        return members[0].of if len(members) == 1 else f"{len(members):,} claims"
    if len(nodes) == 1:
        return members[0].of
    centre = "the centre and " if "centre" in nodes else ""
    count = len(nodes - {"centre"})
    return f"{centre}{count:,} node{'' if count == 1 else 's'}"


def plain(text: str) -> str:
    """A text that may come from a stranger's file: what a terminal would obey is escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
