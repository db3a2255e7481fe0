"""The arguments and options that commands share, and the checks that come before any computation."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tolnet.cli.console import Console

if TYPE_CHECKING:
    from tolnet.model import Ambiguity, Convention, SensorNetwork

Problem = Annotated[
    str,
    typer.Argument(metavar="PROBLEM", help="A problem file (.toml, .mat) or a built-in problem.", show_default=False),
]
Outputs = Annotated[
    list[Path] | None,
    typer.Option("-o", "--output", metavar="FILE", help="Write there too; the suffix picks the format. Repeatable."),
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document on standard output, and nothing else there.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Nothing but complaints for people.")]


def check_outputs(paths: Sequence[Path], suffixes: Iterable[str], *, inputs: Iterable[str] = ()) -> None:
    """Raise InputError unless every output has a known suffix, can be written, is given once, and is no input."""
    from tolnet.model import InputError, check_writable

    if not paths:
        return
    suffixes = tuple(suffixes)
    taken = {path.resolve(): "is an input of this command" for name in inputs for path in _files_of(Path(name))}
    for path in paths:
        if path.suffix.lower() not in suffixes:
            found = f"the suffix {path.suffix!r}" if path.suffix else "no suffix"
            raise InputError(f"has {found}; {' or '.join(suffixes)} was expected", source=str(path))
        if path.resolve() in taken:
            raise InputError(f"cannot be written: it {taken[path.resolve()]}", source=str(path))
        check_writable(path)
        taken[path.resolve()] = "is given twice"


def _files_of(problem: Path) -> Iterable[Path]:
    """An input and the side archive that it names, as far as that can be told without judging it."""
    yield problem
    if problem.suffix.lower() in (".mat", ".json", ".csv", ".npz") or not problem.is_file():
        return
    try:
        arrays = tomllib.loads(problem.read_text(encoding="utf-8")).get("arrays")
    except (ValueError, RecursionError):  # loading the problem will say what is wrong with it
        return
    if isinstance(arrays, str):
        yield problem.parent / arrays


def open_problem(name: str, console: Console) -> SensorNetwork:
    """The problem in a file or, where there is no such file, the built-in problem of that name."""
    from tolnet import model

    path = Path(name)
    if path.exists():
        with console.progress(f"reading {name}"):
            return model.SensorNetwork.from_mat(path) if path.suffix.lower() == ".mat" else model.load(path)
    if name in model.example_names():
        console.note(f"no file {name} here: taking the built-in problem {name}")
        return model.example(name)
    raise model.InputError(
        f"no such file, and no built-in problem{nearest(name, model.example_names())}", source=name
    )


def nearest(word: str, known: Iterable[str]) -> str:
    """`; did you mean ...?` where something known is close, and nothing otherwise."""
    import difflib

    close = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def choose_ambiguity(
    network: SensorNetwork, tolerance: float | None, convention: Convention | None, tau: float | None
) -> Ambiguity:
    """The ambiguity set to solve for: the problem's own, as far as the options do not override it.

    `convention` is the unit of `tolerance` and of the answer; a tolerance that comes from the problem is converted.
    """
    from tolnet.model import Ambiguity, Complaint, InputError, gamma_per

    own = network.ambiguity
    if tolerance is None and own is None:
        raise InputError("--tolerance is missing: the problem carries no [ambiguity]")
    given = {"tolerance": tolerance, "convention": convention, "tau": tau}
    own = own or Ambiguity(0.0)
    unit = convention or own.convention
    c = own.gamma / gamma_per(unit) if tolerance is None else tolerance
    try:
        return Ambiguity(c, unit, own.tau if tau is None else tau)
    except InputError as error:
        named = [(complaint.key.removeprefix("ambiguity."), complaint.message) for complaint in error.complaints]
        raise InputError(
            [Complaint(f"ambiguity.{key}" if given[key] is None else f"--{key}", message) for key, message in named]
        ) from None
