"""What changed between two tolerance tables: which nodes, and by how much."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from tolnet.design.export import TableRecord, plain
from tolnet.model import gamma_per
from tolnet.report.table import empty_table

if TYPE_CHECKING:
    from rich.console import RenderableType

QUANTITIES = ("tolerance", "theta", "trace_V")
_ROWS_SHOWN = 20


@dataclass(frozen=True, eq=False)
class TableDifference:
    """The nodes of two tables, matched by name where all have names of their own, else by index; relative changes:

    (new - old) / |old| for c_k, theta_k and tr V_k, tolerances in the convention of `new`; 0 where both are equal or
    missing, infinite where an old zero became something, NaN where only one of them exists.
    """

    old: TableRecord
    new: TableRecord
    threshold: float
    in_old: Int[ndarray, " M"]
    """Rows of the nodes that both tables have, in `old`..."""
    in_new: Int[ndarray, " M"]
    """... and in `new`, where they are in rising order."""
    removed: Int[ndarray, " D"]
    """Rows of `old` that `new` has not."""
    added: Int[ndarray, " I"]
    """Rows of `new` that `old` has not."""
    relative: dict[str, Float[ndarray, " M"]]
    changed: Bool[ndarray, " M"]
    """Where a relative change is above the threshold or cannot be formed, or the status is another."""

    def rows(self) -> Iterator[dict[str, Any]]:
        """The changed nodes of both tables, those that changed most first."""
        largest = np.max([np.abs(change) for change in self.relative.values()], axis=0, initial=0.0)
        order = np.argsort(-np.where(np.isnan(largest), np.inf, largest), kind="stable")
        for i in order[self.changed[order]].tolist():
            before, after = int(self.in_old[i]), int(self.in_new[i])
            yield {
                **_identity(self.new, after),
                "old": _values(self.old, before, self._unit),
                "new": _values(self.new, after),
                "relative": {key: float(change[i]) for key, change in self.relative.items()},
            }

    def document(self) -> dict[str, Any]:
        """The keys of `tolnet.diff/1`; the document opens as the new table does."""
        heading = {**self.new.heading(), "schema": "tolnet.diff/1"}
        return {
            **heading,
            "old": {key: value for key, value in self.old.heading().items() if key != "schema"},
            "threshold": self.threshold,
            "central": {
                "old": {"theta": self.old.central["theta"], "trace_V": self.old.central["trace_V"]},
                "new": {"theta": self.new.central["theta"], "trace_V": self.new.central["trace_V"]},
            },
            "unchanged": int((~self.changed).sum()),
            "changed": list(self.rows()),
            "added": [_identity(self.new, k) for k in self.added.tolist()],
            "removed": [_identity(self.old, k) for k in self.removed.tolist()],
        }

    @property
    def _unit(self) -> float:
        return gamma_per(self.old.convention) / gamma_per(self.new.convention)


def compare_tables(old: TableRecord, new: TableRecord, threshold: float = 1e-9) -> TableDifference:
    """Match the nodes of two tables and take their relative changes; above `threshold` a node counts as changed."""
    key = "name" if _has_names(old) and _has_names(new) else "node"
    _, in_old, in_new = np.intersect1d(old.nodes[key], new.nodes[key], return_indices=True)
    order = np.argsort(in_new)
    in_old, in_new = in_old[order], in_new[order]
    unit = {"tolerance": gamma_per(old.convention) / gamma_per(new.convention)}
    relative = {
        name: _relative(old.nodes[name][in_old] * unit.get(name, 1.0), new.nodes[name][in_new]) for name in QUANTITIES
    }
    changed = old.nodes["status"][in_old] != new.nodes["status"][in_new]
    for change in relative.values():
        changed |= ~(np.abs(change) <= threshold)
    return TableDifference(
        old=old,
        new=new,
        threshold=threshold,
        in_old=in_old,
        in_new=in_new,
        removed=np.setdiff1d(np.arange(len(old.nodes["node"])), in_old),
        added=np.setdiff1d(np.arange(len(new.nodes["node"])), in_new),
        relative=relative,
        changed=changed,
    )


def _relative(old: Float[ndarray, " M"], new: Float[ndarray, " M"]) -> Float[ndarray, " M"]:
    same = (old == new) | (np.isnan(old) & np.isnan(new))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(same, 0.0, (new - old) / np.abs(old))


def _has_names(record: TableRecord) -> bool:
    """Whether every node can be told by its name."""
    return "name" in record.nodes and len(set(record.nodes["name"].tolist())) == len(record.nodes["name"])


def _identity(record: TableRecord, k: int) -> dict[str, Any]:
    names = {"name": str(record.nodes["name"][k])} if "name" in record.nodes else {}
    return {"node": int(record.nodes["node"][k]), **names}


def _values(record: TableRecord, k: int, unit: float = 1.0) -> dict[str, Any]:
    numbers = {key: float(record.nodes[key][k]) for key in QUANTITIES}
    return {**numbers, "tolerance": numbers["tolerance"] * unit, "status": str(record.nodes["status"][k])}


def difference_view(difference: TableDifference) -> Iterator[RenderableType]:
    """The difference as people read it: what is compared, the nodes that changed most, those that came and went."""
    old, new = difference.old, difference.new
    for sign, record in (("-", old), ("+", new)):
        digest = f", SHA-256 {record.sha256[:12]}..." if record.sha256 else ""
        c = f"c = {record.tolerance:.6g} ({record.convention}), tau = {record.tau:g}"
        yield f"{sign} {record.problem or 'unnamed problem'}: {len(record.nodes['node']):,} nodes, {c}{digest}"
    if old.tau != new.tau:
        yield "the tables belong to different divergences (tau): their tolerances are on different scales"
    rows = list(difference.rows())
    if rows:
        heads = ("node", "c_k", "change", "theta_k", "change", "tr V_k", "change", "status")
        table = empty_table(heads, words=("status",))
        for row in rows[:_ROWS_SHOWN]:
            cells = [text for key in QUANTITIES for text in (_cell(row["new"][key]), _percent(row["relative"][key]))]
            words = row["old"]["status"], row["new"]["status"]
            table.add_row(
                row.get("name", str(row["node"])), *cells, words[1] if len(set(words)) == 1 else " -> ".join(words)
            )
        yield table
    if len(rows) > _ROWS_SHOWN:
        yield f"... and {len(rows) - _ROWS_SHOWN:,} more nodes that changed less"
    for verb, record, which in (("added", new, difference.added), ("removed", old, difference.removed)):
        if which.size:
            names = [str(_identity(record, k).get("name", k)) for k in which[:_ROWS_SHOWN].tolist()]
            yield f"{verb}: {', '.join(names)}{', ...' if which.size > _ROWS_SHOWN else ''}"
    same = int((~difference.changed).sum())
    yield (
        f"{len(rows):,} changed by more than {difference.threshold:g} (relative) or in status, {same:,} did not,"
        f" {difference.added.size:,} added, {difference.removed.size:,} removed"
    )


def difference_csv(difference: TableDifference) -> str:
    """The changed nodes, a line each: every quantity before, after and as a relative change."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    quantities = [f"{key}_{when}" for key in QUANTITIES for when in ("old", "new", "relative")]
    writer.writerow(["node", "name", *quantities, "status_old", "status_new"])
    for row in difference.rows():
        old, new, relative = row["old"], row["new"], row["relative"]
        numbers = [value for key in QUANTITIES for value in (old[key], new[key], relative[key])]
        cells = ["" if value is None else value for value in map(plain, numbers)]
        writer.writerow([row["node"], row.get("name", ""), *cells, old["status"], new["status"]])
    return text.getvalue()


def _cell(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.5g}"


def _percent(change: float) -> str:
    return "-" if np.isnan(change) else f"{change:+.2%}" if abs(change) >= 1e-4 else f"{change:+.1e}"
