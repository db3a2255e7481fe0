"""The command line. Importing this costs nothing; the commands are imported when they run."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `tolnet ARGUMENTS` (those of the process by default) and return its exit code."""
    try:
        with _interrupts():
            from tolnet.cli.app import run

            return run(arguments)
    except KeyboardInterrupt:
        return INTERRUPTED


class _Interrupt(KeyboardInterrupt):
    """Ctrl-C. A class of our own, since CPython notes every plain KeyboardInterrupt that passes through an `exec` of
    source text (as imports of scipy and pydantic do) and then ends `python -m` by the signal, although it was caught.
    """


@contextmanager
def _interrupts() -> Iterator[None]:
    """Raise `_Interrupt` where Python raises KeyboardInterrupt; a handler that somebody else set is left alone."""
    ours = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    if not ours:
        yield
        return
    signal.signal(signal.SIGINT, _raise_interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _raise_interrupt(number: int, frame: FrameType | None) -> None:
    raise _Interrupt
