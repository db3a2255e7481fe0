"""Files read whole, but only files, and only as much of them as can be meant: nothing is opened that never ends.

Whoever reads an input reads it here, so that a pipe that nobody writes to, a device without an end, a file of a
terabyte and an archive that unpacks to one are refused by their sizes, before their bytes are touched.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

from tolnet.model.errors import InputError

LARGEST_PROBLEM = 2**27
"""Bytes of a problem file; a network that needs more keeps its matrices in an archive."""
LARGEST_TEXT = 2**30
"""Bytes of any other text: tables, graphs, scenarios."""
LARGEST_ARCHIVE = 2**34
"""Bytes of an archive of arrays or a MATLAB file."""
ALWAYS_UNPACKED = 2**26
"""Bytes that anything compressed may unpack to, however small it is."""
MOST_INFLATION = 100
"""How many times its size anything larger may unpack to. Noise shrinks by a tenth, identity matrices by 400."""
HEAD = 2**17
"""Bytes at the beginning of a file that a look at it sees."""

_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a directory",
}


def read_whole(path: str | Path, most: int, look: Callable[[bytes, int], None] | None = None) -> bytes:
    """The bytes of a regular file of at most `most` bytes.

    `look` is shown the first `HEAD` bytes and the size of the whole before the rest is read, and may raise. Raises
    InputError, which names no file, for everything that cannot be read.
    """
    try:
        check_regular(path, most)
        with open(path, "rb", opener=_without_waiting) as file:
            _check(os.fstat(file.fileno()), most)  # of what was opened, whatever took its place meanwhile
            head = file.read(HEAD)
            if head is None:  # a file of the system that would wait for what it will hold
                raise InputError("cannot be read: it holds nothing now")
            if look is not None:
                look(head, os.fstat(file.fileno()).st_size)
            data = head + file.read(max(0, most + 1 - len(head))) if len(head) == HEAD else head
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(_unreadable(error)) from None
    if len(data) > most:  # it grew, or is one of those of the system that have no size
        raise InputError(f"is larger than {_size(most)}")
    return data


def check_regular(path: str | Path, most: int) -> None:
    """Raise InputError, naming no file, unless `path` is a regular file of at most `most` bytes."""
    try:
        _check(os.stat(path), most)  # noqa: PTH116 - takes what Path does not, too
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(_unreadable(error)) from None


def check_inflation(unpacked: int, packed: int) -> None:
    """Raise InputError where so many bytes are said to unpack to more than any honest ones would."""
    if unpacked > max(ALWAYS_UNPACKED, MOST_INFLATION * packed):
        raise InputError(
            f"would unpack {_size(packed)} to {_size(unpacked)}, more than {MOST_INFLATION} times as much;"
            " if that is meant, store it without compression"
        )


def text_of(data: bytes) -> str:
    """The text that bytes spell in UTF-8, with or without a byte order mark. Raises InputError for anything else."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError("is text in UTF-16; save it in UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(f"is no text: line {line} holds bytes that are not UTF-8") from None


def _check(found: os.stat_result, most: int) -> None:
    kind = _KINDS.get(stat.S_IFMT(found.st_mode))
    if kind is not None:
        raise InputError(f"is {kind}; a file was expected")
    if found.st_size > most:
        raise InputError(f"is {_size(found.st_size)} long; at most {_size(most)} were expected")


def _without_waiting(path: str, flags: int) -> int:
    """Opens without waiting for somebody at the other end of a pipe that took the file's place a moment ago."""
    return os.open(path, flags | os.O_NONBLOCK | os.O_NOCTTY)


def _unreadable(error: OSError | ValueError) -> str:
    """Why a file cannot be read; a ValueError is about a name that no file can have."""
    if isinstance(error, FileNotFoundError):
        return "does not exist"
    return f"cannot be read: {error.strerror if isinstance(error, OSError) else error}"


def _size(count: int) -> str:
    """Bytes as people say them."""
    size, units = float(count), ["bytes", "KiB", "MiB", "GiB"]
    while size >= 1024 and len(units) > 1:
        size, units = size / 1024, units[1:]
    return f"{size:.4g} {units[0]}"
