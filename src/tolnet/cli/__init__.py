"""The command line. Importing this costs nothing; the commands are imported when they run."""

from __future__ import annotations

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `tolnet ARGUMENTS` (those of the process by default) and return its exit code."""
    try:
        from tolnet.cli.app import run

        return run(arguments)
    except KeyboardInterrupt:
        return 130
