"""Files that appear whole or not at all: written beside their target and renamed into place.

What is unfinished is locked, so that the next writer can tell what a killed one left from what is being written.
"""

from __future__ import annotations

import fcntl
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
        part, file = _begun(path)
        with file:
            part.unlink()
    except OSError as error:
        raise _unwritable(path, error) from None


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A new binary file that takes the place of `path` when the block ends well, and disappears when it does not.

    A link keeps pointing where it did, at the new content; the permissions of a file that was there stay. What killed
    writers left beside it is removed. Raises InputError where the file cannot be written.
    """
    try:
        _check_target(path)
        target = _behind(path)
        _remove_stale(target.parent)
        part, file = _begun(path)
        try:
            with file:
                if target.exists():
                    part.chmod(stat.S_IMODE(target.stat().st_mode))
                yield file
                file.flush()
                os.fsync(file.fileno())
                part.replace(target)  # while it is locked, so that nobody takes it for stale
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


def _begun(path: Path) -> tuple[Path, BinaryIO]:
    """A new file beside the target, locked for as long as it is open: that is how others see that it is alive.

    Between its creation and its lock somebody may take it for stale and remove it; then there is another.
    """
    while True:
        part = _behind(path).with_name(f".tolnet-{secrets.token_hex(6)}.part")
        file = part.open("xb")
        try:
            if not _locked(file.fileno(), wait=True) or _is(part, file.fileno()):
                return part, file
        except BaseException:
            part.unlink(missing_ok=True)
            file.close()
            raise
        file.close()


def _remove_stale(folder: Path) -> None:
    """Remove the unfinished files in a folder that nobody is writing.

    Only those that can be locked: their writer has ended, since the lock of a process ends with it. Where files
    cannot be locked, or are not ours to remove, they stay.
    """
    for part in folder.glob(".tolnet-*.part"):
        try:
            handle = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        except OSError:
            continue
        try:
            if stat.S_ISREG(os.fstat(handle).st_mode) and _locked(handle, wait=False) and _is(part, handle):
                part.unlink(missing_ok=True)
        except OSError:
            continue
        finally:
            os.close(handle)


def _locked(handle: int, *, wait: bool) -> bool:
    """Whether an open file is locked by this now; not where another has it, or where there are no locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        return False
    return True


def _is(path: Path, handle: int) -> bool:
    """Whether a path still leads to an open file."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(handle))
    except FileNotFoundError:
        return False
