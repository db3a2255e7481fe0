"""The text of a problem file: read within bounds, and turned into tables and lists."""

from __future__ import annotations

import re
import tomllib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tolnet.model.bounded_reading import LARGEST_PROBLEM, read_whole, text_of
from tolnet.model.errors import MOST_COMPLAINTS, Complaint, InputError, Remainder

Judge = Callable[[dict[str, Any], Path], object]
"""Raises InputError with everything that is wrong with the content of a problem file, whose folder is given."""


def mapping_of(data: bytes, source: str) -> dict[str, Any]:
    """The content of a problem file. Raises InputError, naming the `source`, for what is no TOML."""
    if not data.strip():
        raise InputError("is empty; a problem file was expected", source=source)
    try:
        text = _text_of(data)
        if _MANY_PARTS.search(text):
            raise RecursionError
        content = tomllib.loads(text)
        if deeper_than(content, DEEPEST):
            raise RecursionError
    except InputError as error:
        raise InputError(error.complaints, source=source) from None
    except RecursionError:
        raise InputError("is nested too deeply to be read", source=source) from None
    except ValueError as error:  # TOMLDecodeError, with its line; or an integer of thousands of digits
        raise InputError(f"is not TOML: {error}", source=source) from None
    return content


def _text_of(data: bytes) -> str:
    text = text_of(data)
    if "\r" in text and "\n" not in text:
        raise InputError("ends its lines with carriage returns alone; save it with line feeds")
    return text


DEEPEST = 20
"""How deep tables and lists may hold one another; a bound over time is 5 deep, and no key is deeper."""

_MANY_PARTS = re.compile(
    r"""(?<![\w.-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){100}"""  # possessive: linear in the text
)
"""A dotted key five times as deep as anything may be. One is read in the square of its parts: 200,000 take minutes.

It could stand in a string, too, but no text has a hundred words with nothing but dots and blanks between them.
"""


def deeper_than(content: Any, most: int) -> bool:
    """Whether tables and lists hold one another more than `most` deep."""
    layer = [content]
    for _ in range(most):
        members = (item.values() if isinstance(item, dict) else item for item in layer)
        layer = [member for inside in members for member in inside if isinstance(member, dict | list)]
        if not layer:
            return False
    return True


def read_problem(path: str | Path, judge: Judge) -> bytes:
    """The bytes of a problem file, whose beginning is judged before the rest of a long one is read.

    Raises InputError, naming the file.
    """

    def look(head: bytes, size: int) -> None:
        if b"\0" in head and head[:2] not in (b"\xff\xfe", b"\xfe\xff"):
            raise InputError("is no text: it holds zero bytes")
        if size > len(head):
            _judge_head(head, size, Path(path).parent, judge)

    try:
        return read_whole(path, LARGEST_PROBLEM, look)
    except InputError as error:
        raise InputError(error.kept, source=str(path)) from None


def _judge_head(head: bytes, size: int, folder: Path, judge: Judge) -> None:
    """Raise InputError where the beginning of a file holds more complaints already than an error tells.

    The beginning ends with its last line, or else, if that lies within an array, before the last header of a table.
    """
    headers = [found.start() for found in _HEADER.finditer(head)]
    for end in (head.rfind(b"\n") + 1, *headers[-1:]):
        part = head[:end]
        try:
            content = mapping_of(part, "")
        except InputError:
            continue
        found, more = _told_by_beginning(content, folder, judge)
        more += len(found) - MOST_COMPLAINTS
        if len(found) >= MOST_COMPLAINTS and more > 0:
            line = part.count(b"\n")
            rest = f"has {more:,} more complaints up to line {line:,}; the rest of its {size:,} bytes was not judged"
            raise InputError([*found[:MOST_COMPLAINTS], Complaint("", rest)])
        return


def _told_by_beginning(content: dict[str, Any], folder: Path, judge: Judge) -> tuple[list[Complaint], int]:
    """The complaints about the beginning of a file that are true of the whole: unknown keys, sensors but the last.

    With the number of those that were only counted. What is said of other things may be for want of the rest, or of
    the archive, which is not opened.
    """
    content.pop("arrays", None)
    tables = content.get("sensors")
    last = f"sensors[{len(tables) - 1}]" if isinstance(tables, list) else "sensors"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the whole file will warn
            judge(content, folder)
    except InputError as error:
        counted = sum(each.count for each in error.kept if isinstance(each, Remainder))
        return [each for each in error.kept if _stands_alone(each, last)], counted
    return [], 0


_HEADER = re.compile(rb"^[ \t]*\[\[?[ \t]*[A-Za-z_][\w. \t-]*\]\]?[ \t]*(?:#.*)?\r?$", re.MULTILINE)
"""A line that opens a table; in an array that is spread over lines, no line looks like it."""


def _stands_alone(complaint: Complaint, last: str) -> bool:
    if complaint.message.startswith("is no known key"):
        return True
    of_sensor = complaint.key.startswith("sensors[") and complaint.key.partition(".")[0] != last
    return of_sensor and "refers to" not in complaint.message
