"""The three answers to a claim, and the entry that each becomes in a certificate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

Node = int | str
"""A node by its index, or "centre"."""


@dataclass(frozen=True, eq=False)
class _Answer:
    claim: str
    statement: str
    keys: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    """The claim's own keys, such as its rate."""
    node: Node | None = field(default=None, kw_only=True)

    verdict = ""

    def _entry(self, **rest: Any) -> dict[str, Any]:
        of_node = {} if self.node is None else {"node": self.node}
        opening = {"claim": self.claim, **of_node, "verdict": self.verdict, "statement": self.statement}
        return {**opening, **self.keys, **rest}


@dataclass(frozen=True, eq=False)
class Proved(_Answer):
    """The claim is true, and `proof` shows it to whoever checks."""

    proof: Mapping[str, Any]
    margin: float | None = None
    """How far the claim is from failing, where that is part of what was proved."""

    verdict = "proved"

    def entry(self) -> dict[str, Any]:
        """The claim as docs/certificate.md has it."""
        return self._entry(margin=self.margin, proof=dict(self.proof), reason=None)


@dataclass(frozen=True, eq=False)
class Refuted(_Answer):
    """The claim is false, and `witness` shows it to whoever checks."""

    witness: Mapping[str, Any]

    verdict = "refuted"

    def entry(self) -> dict[str, Any]:
        """The claim as docs/certificate.md has it."""
        return self._entry(margin=None, witness=dict(self.witness), reason=None)


@dataclass(frozen=True, eq=False)
class Undecided(_Answer):
    """Neither was shown. This says nothing about the truth of the claim; `reason` says what was tried."""

    reason: str

    verdict = "undecided"

    def entry(self) -> dict[str, Any]:
        """The claim as docs/certificate.md has it."""
        return self._entry(margin=None, reason=self.reason)


Verdict = Proved | Refuted | Undecided
