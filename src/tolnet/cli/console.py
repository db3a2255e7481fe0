"""Where words go: answers for people or programs to standard output, everything else to standard error."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.progress import Progress

PATIENCE = 1.0
"""Seconds of work before a progress bar appears."""
EVERY = 10.0
"""Seconds between two lines about the work, where standard error is a file or a pipe."""
WIDE = 240
"""Columns when nobody's terminal limits them: nothing is cut in a file or a pipe."""


def prepare_streams() -> None:
    """Make standard output and error take any text: what their encoding lacks is escaped; closed ones swallow."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115 - lives as long as we do
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def complain(lines: Iterable[str], what: str = "error") -> None:
    """Say on standard error what is wrong, one line each."""
    _write("stderr", (f"{what}: {line}\n" for line in lines))


class Console:
    """The output of one command.

    `json`: standard output carries one JSON document and nothing else. `quiet`: people get only complaints.
    """

    def __init__(self, *, json: bool, quiet: bool) -> None:
        self.json = json
        self.quiet = quiet
        self._clock = _Clock()

    def show(self, *renderables: RenderableType) -> None:
        """Print text or rich tables for people."""
        if self.json or self.quiet:
            return
        from rich.console import Console as RichConsole

        width = None if sys.stdout.isatty() else WIDE
        rich = RichConsole(file=sys.stdout, width=width, markup=False, highlight=False, emoji=False)
        with rich.capture() as captured:
            for renderable in renderables:
                rich.print(renderable)
        _write("stdout", [captured.get()])

    def text(self, text: str) -> None:
        """Print text for people exactly as it is, since it may be piped into a file."""
        if not (self.json or self.quiet):
            _write("stdout", [text])

    def wrote(self, paths: Sequence[Path]) -> None:
        """Say which files were written."""
        if paths:
            self.show(f"wrote {', '.join(map(str, paths))}")

    def suggest(self, *commands: str) -> None:
        """Say which commands to try next."""
        if commands:
            self.show("next:", *(f"  {command}" for command in commands))

    def document(self, pieces: Iterable[str]) -> None:
        """Print a JSON document where one was asked for."""
        if self.json:
            _write("stdout", pieces)

    def note(self, text: str) -> None:
        """Say on standard error what a person should know."""
        if not self.quiet:
            _write("stderr", [f"{text}\n"])

    def progress(self, what: str, unit: str = "") -> ProgressBar:
        """On standard error, how far the work within it is, counted in `unit`s.

        On a terminal, a bar for work that takes over a second; elsewhere, a line every ten seconds of the command.
        """
        return ProgressBar(what, wanted=not self.quiet, unit=unit, clock=None if sys.stderr.isatty() else self._clock)


class _Clock:
    """When a command began, by its name, and when it last said how far it is."""

    def __init__(self) -> None:
        # Typer brings a Click of its own, under a private name that changes; this one has been there in all versions.
        from typer.main import get_current_context  # pyright: ignore[reportPrivateImportUsage]

        context = get_current_context(silent=True)
        self.name = "tolnet" if context is None or context.info_name is None else context.info_name
        self.began = self.said = time.monotonic()

    def due(self) -> float:
        """Seconds until the next line."""
        return max(0.0, self.said + EVERY - time.monotonic())

    def line(self, how_far: str) -> str:
        """The next line, which is said now."""
        self.said = time.monotonic()
        return f"{self.name}: {how_far}, {self.said - self.began:.0f} s\n"


class ProgressBar:
    """A bar that appears once the work within it has taken PATIENCE seconds, and clears itself at the end.

    Called with (done, total) as the work goes on; it pulses where nothing counts the work. With a clock it says lines
    instead.
    """

    def __init__(self, what: str, *, wanted: bool, unit: str = "", clock: _Clock | None = None) -> None:
        self._what, self._wanted, self._unit, self._clock = what, wanted, unit, clock
        self._done = 0
        self._total: int | None = None
        self._lock = threading.Lock()
        self._bar: Progress | None = None
        self._timer = self._after(PATIENCE, self._appear) if clock is None else self._after(clock.due(), self._say)

    @staticmethod
    def _after(seconds: float, what: Callable[[], None]) -> threading.Timer:
        timer = threading.Timer(seconds, what)
        timer.daemon = True
        return timer

    def __enter__(self) -> ProgressBar:
        if self._wanted:
            self._timer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            self._wanted = False
            self._timer.cancel()
            if self._bar is not None:
                self._bar.stop()

    def __call__(self, done: int, total: int) -> None:
        """Show how much is done."""
        with self._lock:
            self._done, self._total = done, total
            if self._bar is not None:
                self._bar.update(self._bar.task_ids[0], completed=done, total=total)

    def say(self, what: str, value: float) -> None:
        """Show what is going on and the value that it has reached."""
        with self._lock:
            self._what = f"{what}: {value:.6g}"
            if self._bar is not None:
                self._bar.update(self._bar.task_ids[0], description=self._what)

    def _say(self) -> None:
        with self._lock:
            if self._clock is None or not self._wanted:
                return
            count = "" if self._total is None else f" {self._done:,} of {self._total:,} {self._unit}".rstrip()
            _write("stderr", [self._clock.line(self._what + count)])
            self._timer = self._after(EVERY, self._say)
            self._timer.start()

    def _appear(self) -> None:
        from rich.console import Console as RichConsole
        from rich.progress import Progress

        with self._lock:
            if self._wanted:
                self._bar = Progress(console=RichConsole(file=sys.stderr), transient=True)
                self._bar.add_task(self._what, completed=self._done, total=self._total)
                self._bar.start()


def _write(name: Literal["stdout", "stderr"], pieces: Iterable[str]) -> None:
    """Write and flush; a reader that has left (`| head`) is no error, and hears nothing more."""
    stream = getattr(sys, name)
    try:
        for piece in pieces:
            stream.write(piece)
        stream.flush()
    except BrokenPipeError:
        with open(os.devnull, "wb") as nowhere:  # noqa: PTH123
            os.dup2(nowhere.fileno(), stream.fileno())
