"""What tolnet raises: misuse and bad input. Numerical failure is a status in a result, never an exception."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
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


@dataclass(frozen=True)
class Remainder(Complaint):
    """The complaints that were only counted, as one more."""

    count: int = 0


MOST_COMPLAINTS = 20
"""How many complaints an error carries before the rest are only counted."""


class InputError(TolnetError, ValueError):
    """An input that cannot be used. Carries every complaint found, not only the first.

    Of more than `MOST_COMPLAINTS` it carries the first ones, and last a `Remainder`, which says how many more there
    are. ``source`` names the file, where there is one.
    """

    def __init__(self, complaints: Iterable[Complaint] | str, *, source: str | None = None) -> None:
        if isinstance(complaints, str):
            complaints = [Complaint("", complaints)]
        self.kept: Sequence[Complaint] = tuple(complaints)
        """All that were given, for whoever sorts them or leaves some out before they are told."""
        self.complaints: Sequence[Complaint] = tuple(_first(self.kept))
        self.source = source
        super().__init__("\n".join(self.lines()))

    def lines(self) -> list[str]:
        """One line per complaint, each opening with the file where there is one."""
        prefix = f"{self.source}: " if self.source else ""
        return [f"{prefix}{complaint}" for complaint in self.complaints]


def _first(complaints: Iterable[Complaint]) -> Iterator[Complaint]:
    """The first complaints, and the number of the others."""
    counted, own = 0, []
    for each in complaints:
        if isinstance(each, Remainder):
            counted += each.count
        elif len(own) <= MOST_COMPLAINTS:
            own.append(each)
        else:
            counted += 1
    if counted and len(own) > MOST_COMPLAINTS:
        own.pop()
        counted += 1
    yield from own  # one more than the most is told rather than counted: an error raised again keeps its remainder
    if counted:
        yield Remainder("", f"has {counted:,} more complaint{'' if counted == 1 else 's'}", counted)


class ShapeError(InputError):
    """Arrays whose shapes do not fit each other."""


class UnsupportedError(TolnetError, ValueError):
    """A combination that the mathematics does not cover, such as local tolerances for tau != 0."""
