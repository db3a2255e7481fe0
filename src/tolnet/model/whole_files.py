"""Files that appear whole or not at all: written beside their target and renamed into place."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from tolnet.model.errors import InputError


def check_writable(path: Path) -> None:
    """Raise InputError, saying why, unless `replacing(path)` could write there now.

    To be asked before a long computation. Tried, not guessed: a file is made beside the target and removed.
    """
    try:
        _check_target(path)
        part = _beside(path)
        part.open("xb").close()
        part.unlink()
    except OSError as error:
        raise _unwritable(path, error) from None


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A new binary file that takes the place of `path` when the block ends well, and disappears when it does not.

    A link keeps pointing where it did, at the new content; the permissions of a file that was there stay.
    Raises InputError where the file cannot be written.
    """
    try:
        _check_target(path)
        target, part = _behind(path), _beside(path)
        try:
            with part.open("xb") as file:
                if target.exists():
                    part.chmod(stat.S_IMODE(target.stat().st_mode))
                yield file
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise _unwritable(path, error) from None


def _check_target(path: Path) -> None:
    """Refuse what a rename would wrongly replace, or could not."""
    try:
        _behind(path)
    except ValueError as error:  # a name that no file can have
        raise InputError(f"cannot be written: {error}", source=str(path)) from None
    if path.is_dir():
        raise InputError("cannot be written: it is a directory", source=str(path))
    if not path.parent.is_dir():
        what = "is not a directory" if path.parent.exists() else "does not exist"
        raise InputError(f"cannot be written: {path.parent} {what}", source=str(path))
    if path.exists() and not path.is_file():
        raise InputError("cannot be written: it is not a regular file", source=str(path))
    if path.exists() and not os.access(path, os.W_OK):
        raise InputError("cannot be written: it is write-protected", source=str(path))


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(f"cannot be written: {error.strerror}", source=str(path))


def _behind(path: Path) -> Path:
    """What a link leads to; the link itself where it leads in a circle, on which Path.resolve differs by version."""
    return Path(os.path.realpath(path))


def _beside(path: Path) -> Path:
    return _behind(path).with_name(f".tolnet-{secrets.token_hex(6)}.part")
