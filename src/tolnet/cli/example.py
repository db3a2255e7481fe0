"""`tolnet example`: the built-in problems."""

from __future__ import annotations

import shlex
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tolnet.cli.console import Console
from tolnet.cli.documents import render
from tolnet.cli.options import AsJson, Quiet, check_outputs

if TYPE_CHECKING:
    from tolnet.model import CorruptedNetwork, SensorNetwork

STDOUT = Path("-")


def example(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Which one; none lists them.")] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="Write the problem file (.toml); - prints it."),
    ] = None,
    nodes: Annotated[int | None, typer.Option(min=1, metavar="N", help="Number of nodes, for random.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, metavar="S", help="Seed of the draw, for random.")] = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """List the built-in problems, or write one of them as a problem file."""
    from tolnet import model

    console = Console(json=json, quiet=quiet)
    if name is None:
        if output is not None or nodes is not None or seed is not None:
            raise model.InputError(f"NAME is missing: one of {', '.join(model.example_names())}")
        _list(console)
        return
    if output not in (None, STDOUT):
        check_outputs([output], [".toml"])
    network = model.example(name, nodes, seed)
    if output is None or output == STDOUT:
        _print(network, console)
    else:
        _write(network, output, console)


def _list(console: Console) -> None:
    from tolnet import model
    from tolnet.design.export import opening

    known = model.example_names()
    listed = [{"name": name, "description": description} for name, description in known.items()]
    console.document([render({**opening("tolnet.examples/1", None, "ok"), "examples": listed})])
    width = max(map(len, known))
    console.show(*(f"{name:{width}}  {description}" for name, description in known.items()))
    console.suggest("tolnet example projectile -o projectile.toml")


def _write(network: SensorNetwork | CorruptedNetwork, path: Path, console: Console) -> None:
    from tolnet import model
    from tolnet.design.export import opening

    written = [str(file) for file in model.save(network, path)]
    saved = model.load_problem(path)
    console.document([render({**opening("tolnet.example/1", saved, "ok"), "written": written})])
    console.show(f"wrote {' and '.join(written)}: {saved.description or saved.name}")
    quoted = shlex.quote(str(path))
    command = "observability" if isinstance(saved, model.CorruptedNetwork) else "table"
    console.suggest(f"tolnet validate {quoted}", f"tolnet {command} {quoted}")


def _print(network: SensorNetwork | CorruptedNetwork, console: Console) -> None:
    """The problem file on standard output, where it is one file."""
    from tolnet import model
    from tolnet.design.export import opening

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "problem.toml"
        if len(model.save(network, path)) > 1:
            raise model.InputError(
                "is a file and an archive of arrays, too large to print: use -o FILE.toml", source=network.name
            )
        text = path.read_text(encoding="utf-8")
        document = {**opening("tolnet.example/1", model.load_problem(path), "ok"), "written": [], "toml": text}
    console.document([render(document)])
    console.text(text)
