"""What is said about the form of a problem file: keys that are unknown or missing, and values of a wrong type."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

from pydantic import ValidationError

from tolnet.model._checks import nearest, shown, shown_key
from tolnet.model.errors import Complaint, Remainder
from tolnet.model.problem import SCHEMA, TABLES, Link, Problem, SimulatedChannel

LONG = 1000
"""How many entries of a list, and how many unknown keys, are judged at a time."""
_FORMS = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "string_type": "a text",
    "string_unicode": "a text",
    "bool_type": "true or false",
    "list_type": "a list",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "dict_type": "a table",
    "too_short": "a pair",
    "too_long": "a pair",
}
_BOUNDS = {"greater_than": (">", "gt"), "greater_than_equal": (">=", "ge"), "less_than_equal": ("<=", "le")}


def complaints_about_form(mapping: dict[Any, Any]) -> list[tuple[str, Complaint]]:
    """What is wrong with the keys and types of a problem file, each with the key of the value to blame.

    Several entries of one matrix that are wrong in the same way make one complaint. Lists are judged by their first
    `LONG` entries, and lists of tables on from there, as many at a time, up to the first that are wrong; of what is
    wrong with later numbers of a matrix, the network will speak. So a million faults are not remembered one by one.
    """
    shortened = _Shortened(mapping)
    found = _faults(shortened.value, 0)
    if shortened.keys:
        found.append(("", Remainder("", "", shortened.keys)))
    start = LONG
    while not found and start < _most_tables(mapping):
        found = _faults(_window(mapping, shortened.value, start), start)
        start += LONG
    return found


def _faults(mapping: dict[Any, Any], start: int) -> list[tuple[str, Complaint]]:
    """The complaints about a file whose lists of tables begin with the entry `start`."""
    try:
        Problem.model_validate(mapping)
    except ValidationError as error:
        return list(_translated(error.errors(include_url=False), start))
    return []


def _most_tables(mapping: dict[Any, Any]) -> int:
    """The length of the longest list of tables."""
    channel = mapping.get("channel")
    lists = [mapping.get("sensors"), channel.get("links") if isinstance(channel, dict) else None]
    return max(len(tables) if isinstance(tables, list) else 0 for tables in lists)


def _window(mapping: dict[Any, Any], right: dict[Any, Any], start: int) -> dict[Any, Any]:
    """The same file, as far as it was found right, with other entries of its lists of tables."""

    def part(of: dict[Any, Any], key: str) -> dict[Any, Any]:
        tables = of.get(key)
        return {key: _Shortened(tables[start : start + LONG]).value} if isinstance(tables, list) else {}

    channel = {"channel": {**right["channel"], **part(mapping["channel"], "links")}} if right.get("channel") else {}
    return {**right, **channel, **part(mapping, "sensors")}


class _Shortened:
    """A problem file of which long lists, and tables with many unknown keys, are cut."""

    def __init__(self, value: Any) -> None:
        self.keys = 0
        self.value = self.cut(value)

    def cut(self, value: Any) -> Any:
        if isinstance(value, list):
            return [self.cut(item) if isinstance(item, list | dict) else item for item in value[:LONG]]
        if isinstance(value, dict):
            kept = list(value)
            if len(kept) > LONG:
                kept = [key for i, key in enumerate(value) if i < LONG or key in _known_keys()]
                self.keys += len(value) - len(kept)
            return {key: self.cut(value[key]) for key in kept}
        return value


@cache
def _known_keys() -> frozenset[str]:
    """Every key of every table, as files spell them."""
    models = (Problem, *TABLES.values(), Link, SimulatedChannel)
    return frozenset(field.alias or name for model in models for name, field in model.model_fields.items())


def _translated(errors: Iterable[Any], start: int) -> Iterator[tuple[str, Complaint]]:
    first: dict[tuple[Any, ...], Any] = {}
    count: dict[tuple[Any, ...], int] = {}
    for error in errors:
        place = tuple(x for x in error["loc"] if not (isinstance(x, str) and re.fullmatch(r"\*\w+\*", x)))
        tables = 1 if place[0] == "sensors" else 2 if place[:2] == ("channel", "links") else len(place)
        place = tuple(x + start if i == tables and isinstance(x, int) else x for i, x in enumerate(place))
        base = place[: 3 if place[0] == "sensors" else 2]
        kind = (*base, error["type"])
        first.setdefault(kind, (place, base, error))
        count[kind] = count.get(kind, 0) + 1
    for kind, (place, base, error) in first.items():
        others = count[kind] - 1
        more = f" (and so for {others} more of its entries)" if others else ""
        yield _path(base), Complaint(_path(place), _message(place, error) + more)


def _message(place: tuple[Any, ...], error: Any) -> str:
    table, last = TABLES.get(place[0], Problem) if len(place) > 1 else Problem, place[len(place) - 1]
    known = {field.alias or name: field for name, field in table.model_fields.items()}
    kind, value, bounds = error["type"], error["input"], error.get("ctx", {})
    if kind == "extra_forbidden":
        siblings = _siblings(place, known)
        return f"is no known key; the nearest is {nearest(str(last), siblings)!r}"
    if kind == "invalid_key":
        return "is no text; keys are text"
    if kind == "missing" and last == "schema":
        return f"is missing; schema = {SCHEMA!r} was expected"
    if kind == "missing":
        meant = known[last].description if last in known else None
        return "is missing" + (f": {meant}" if meant else "")
    if kind == "literal_error":
        return f"is {shown(value)}; {bounds['expected']} was expected"
    if kind == "too_short" and bounds["min_length"] == 1:
        return "is empty"
    if kind in _BOUNDS:
        sign, name = _BOUNDS[kind]
        return f"is {shown(value)}; a number {sign} {bounds[name]:.16g} was expected"
    return f"is {shown(value)}; {_FORMS.get(kind, 'something else')} was expected"


def _siblings(place: tuple[Any, ...], known: dict[str, Any]) -> list[str]:
    """The keys that are known where an unknown one stands: those of its table, or of a reference to the archive."""
    depth = sum(isinstance(x, str) for x in place)
    return list(known) if depth <= 2 else ["array", *(["triples"] if "weights" in place else [])]


def _path(place: tuple[Any, ...]) -> str:
    """A key path such as `sensors[3].R`."""
    path = ""
    for x in place:
        if isinstance(x, int):
            path += f"[{x}]"
        else:
            bare = shown_key(x)
            path += f".{bare}" if path else bare
    return path
