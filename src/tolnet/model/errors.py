"""What tolnet raises: misuse and bad input. Numerical failure is a status in a result, never an exception."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass


class TolnetError(Exception):
    """Base of every exception that tolnet raises on purpose."""


@dataclass(frozen=True)
class Complaint:
    """One thing that is wrong with an input: where it stands, and what was expected there."""

    key: str
    """Key path in the vocabulary of the problem file, such as ``sensors[3].R``; empty for the whole."""
    message: str
    """What was found and what was expected, as a sentence without its subject."""

    def __str__(self) -> str:
        return f"{self.key} {self.message}" if self.key else self.message


class InputError(TolnetError, ValueError):
    """An input that cannot be used. Carries every complaint found, not only the first.

    ``source`` names the file, where there is one.
    """

    def __init__(self, complaints: Iterable[Complaint] | str, *, source: str | None = None) -> None:
        if isinstance(complaints, str):
            complaints = [Complaint("", complaints)]
        self.complaints: Sequence[Complaint] = tuple(complaints)
        self.source = source
        super().__init__("\n".join(self.lines()))

    def lines(self) -> list[str]:
        """One line per complaint, each opening with the file where there is one."""
        prefix = f"{self.source}: " if self.source else ""
        return [f"{prefix}{complaint}" for complaint in self.complaints]


class ShapeError(InputError):
    """Arrays whose shapes do not fit each other."""


class UnsupportedError(TolnetError, ValueError):
    """A combination that the mathematics does not cover, such as local tolerances for tau != 0."""
