"""The commands under one name, and what becomes of everything that they raise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer
import typer.main

from tolnet import __version__
from tolnet.cli import (
    INTERRUPTED,
    certify,
    check,
    diff,
    diffusion,
    example,
    observability,
    performance,
    simulate,
    table,
    validate,
    window,
)
from tolnet.cli.console import complain, prepare_streams

if TYPE_CHECKING:
    from tolnet.model import TolnetError

BAD_INPUT, NO_ANSWER = 2, 4

app = typer.Typer(
    name="tolnet",
    help="Offline design of robust Kalman filters on sensor networks: how much model error may each node assume?",
    epilog="Start with: tolnet example projectile -o projectile.toml, then: tolnet table projectile.toml",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("example")(example.example)
app.command("validate")(validate.validate)
app.command("table")(table.table)
app.command("performance")(performance.performance)
app.command("observability")(observability.observability)
app.command("diffusion")(diffusion.diffusion)
app.command("simulate")(simulate.simulate)
app.command("certify")(certify.certify)
app.command("check")(check.check)
app.command("window")(window.window)
app.command("diff")(diff.diff)


def _print_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"tolnet {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Options of the program itself; `version` acts in its callback."""


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code. Whatever it raises on purpose becomes a message on standard error."""
    prepare_streams()
    try:
        typer.main.get_command(app).main(args=arguments, prog_name="tolnet")
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    except KeyboardInterrupt:
        return INTERRUPTED
    except _misuse() as error:
        complain(str(error).splitlines())
        return BAD_INPUT
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        complain([f"{where}{error.strerror or error}"])
        return BAD_INPUT
    except MemoryError:
        complain(["not enough memory for a network of this size"])
        return NO_ANSWER
    return 0


def _misuse() -> type[TolnetError]:
    """What bad input raises; imported when something is raised, since `tolnet --help` needs no arrays."""
    from tolnet.model import TolnetError

    return TolnetError
