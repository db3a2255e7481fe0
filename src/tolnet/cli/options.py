"""The arguments and options that commands share, and the checks that come before any computation."""

from __future__ import annotations

import os
import shlex
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tolnet.cli.console import Console

if TYPE_CHECKING:
    from tolnet.model import Ambiguity, Convention, CorruptedNetwork, SensorNetwork

PLOT_SUFFIXES = (".png", ".svg", ".pdf")

Problem = Annotated[
    str,
    typer.Argument(metavar="PROBLEM", help="A problem file (.toml, .mat) or a built-in problem.", show_default=False),
]
Outputs = Annotated[
    list[Path] | None,
    typer.Option("-o", "--output", metavar="FILE", help="Write there too; the suffix picks the format. Repeatable."),
]
Tolerance = Annotated[
    float | None,
    typer.Option("--tolerance", "-c", metavar="C", help="The network's tolerance, instead of the problem's."),
]
Unit = Annotated[
    Literal["gamma", "nats"] | None,
    typer.Option("--convention", help="Unit of --tolerance and of the answer: gamma, or nats (half of gamma)."),
]
Tau = Annotated[
    float | None,
    typer.Option("--tau", metavar="TAU", help="Member of the tau-divergence family, 0 to 1; 0 unless --uniform."),
]
Uniform = Annotated[bool, typer.Option("--uniform", help="c_k = c at every node, instead of local ones.")]
Filters = Annotated[
    str | None,
    typer.Option("--filters", metavar="A,B", help="Some of KFC, RKFC, KFD, RKFDU, RKFDNU, RKFDNU2; all without."),
]
Rule = Annotated[
    str | None,
    typer.Option(
        "--diffusion",
        metavar="RULE",
        help="Weights by a rule: uniform, relative-degree, metropolis, ...; the problem's without.",
    ),
]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="FILE", help="Draw it (.png, .svg, .pdf).")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document on standard output, and nothing else there.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Nothing but complaints for people.")]


def check_outputs(
    paths: Sequence[Path], suffixes: Iterable[str], *, inputs: Iterable[str] = (), plot: Path | None = None
) -> None:
    """Raise InputError unless every output has a known suffix, can be written, is given once, and is no input.

    `plot` is one more output, with suffixes of its own.
    """
    from tolnet.model import InputError, check_writable

    formats = tuple(suffixes)
    wanted = [(path, formats) for path in paths] + ([(plot, PLOT_SUFFIXES)] if plot is not None else [])
    if not wanted:
        return
    files = (path for name in inputs for path in _files_of(Path(name)))
    taken = {os.path.realpath(path): "is an input of this command" for path in files}
    for path, known in wanted:
        if path.suffix.lower() not in known:
            found = f"the suffix {path.suffix!r}" if path.suffix else "no suffix"
            raise InputError(f"has {found}; {' or '.join(known)} was expected", source=str(path))
        check_writable(path)
        place = os.path.realpath(path)
        if place in taken:
            raise InputError(f"cannot be written: it {taken[place]}", source=str(path))
        taken[place] = "is given twice"


def _files_of(problem: Path) -> Iterable[Path]:
    """An input and the side archive that it names, as far as that can be told without judging it."""
    from tolnet.model.bounded_reading import LARGEST_PROBLEM, read_whole

    if "\0" in str(problem):  # the name of no file; opening it will say so
        return
    yield problem
    if problem.suffix.lower() in (".mat", ".json", ".csv", ".npz"):
        return
    try:
        beginning = read_whole(problem, LARGEST_PROBLEM).partition(b"\n[")[
            0
        ]  # keys of no table come before the first
        arrays = tomllib.loads(beginning.decode()).get("arrays")
    except (ValueError, RecursionError):  # loading the problem will say what is wrong with it
        return
    if isinstance(arrays, str) and "\0" not in arrays:
        yield problem.parent / arrays


def open_problem(name: str, console: Console) -> SensorNetwork:
    """The problem in a file or, where there is no such file, the built-in problem of that name, with exact channels.

    Says so where the file has corrupted channels, which are left out. Raises InputError for periodic matrices.
    """
    from tolnet import model

    found = _find(name, console)
    if not isinstance(found, model.CorruptedNetwork):
        return found
    if Path(name).exists():
        console.note(f"note: this command answers for exact channels; what {name} says of corrupted ones is left out")
        return model.load(name)
    raise model.InputError("has corrupted channels; this command answers for exact ones", source=name)


def open_corrupted(name: str, console: Console) -> CorruptedNetwork:
    """The same for a problem with corrupted channels; one without any has exact ones."""
    from tolnet import model

    found = _find(name, console)
    if isinstance(found, model.CorruptedNetwork):
        return found
    try:
        return model.CorruptedNetwork.of(found)
    except model.InputError as error:
        raise type(error)(error.complaints, source=name) from None


def open_any(name: str, console: Console) -> SensorNetwork | CorruptedNetwork:
    """The problem as what it is: with corrupted channels where it says anything of them."""
    return _find(name, console)


def _find(name: str, console: Console) -> SensorNetwork | CorruptedNetwork:
    import warnings

    from tolnet import model

    path = Path(name)
    if _is_there(path):
        with console.progress(f"reading {name}"), warnings.catch_warnings(record=True) as loose:
            warnings.simplefilter("always", model.LooseBoundWarning)
            mat = path.suffix.lower() == ".mat"
            found = model.SensorNetwork.from_mat(path) if mat else model.load_problem(path)
        for warning in loose:
            console.note(f"warning: {name}: {warning.message}")
        return found
    if name in model.example_names():
        console.note(f"no file {name} here: taking the built-in problem {name}")
        return model.example(name)
    raise model.InputError(
        f"no such file, and no built-in problem{nearest(name, model.example_names())}", source=name
    )


def _is_there(path: Path) -> bool:
    """Whether anything has that name, also a link that leads nowhere or in a circle. Raises OSError if none can."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return False
    return True


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


def check_family(ambiguity: Ambiguity, *, uniform: bool) -> None:
    """Refuse local tolerances where they are not defined, with the way out."""
    from tolnet.model import UnsupportedError

    if ambiguity.tau != 0 and not uniform:
        raise UnsupportedError(
            f"local tolerances are defined for tau = 0 only (tau is {ambiguity.tau:g}); --uniform takes c_k = c at"
            " every node"
        )


def repeated(**given: object) -> str:
    """Options as they were given, to stand in a command that is suggested; those that were not given are left out."""
    words = []
    for name, value in given.items():
        for each in value if isinstance(value, list | tuple) else [value]:
            if each is not None and each is not False:
                words.append(f" --{name}" + ("" if each is True else f" {shlex.quote(str(each))}"))
    return "".join(words)
