"""`tolnet validate`: is this file right? Every complaint at once."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Any

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.documents import render, write
from tolnet.cli.options import AsJson, Outputs, Problem, Quiet, check_outputs, open_problem

if TYPE_CHECKING:
    from tolnet.model import Complaint, SensorNetwork

BAD_INPUT = 2


def validate(problem: Problem, output: Outputs = None, json: AsJson = False, quiet: Quiet = False) -> None:
    """Is this problem file right? Says everything that is wrong at once, one complaint a line, or what is in it.

    -o takes .json. Exit code 2: something is wrong.
    """
    from tolnet.model import InputError

    console = Console(json=json, quiet=quiet)
    check_outputs(output or [], [".json"], inputs=[problem])
    network = None
    try:
        network = open_problem(problem, console)
        complaints = _refused_by_design(network)
    except InputError as error:
        complaints = list(error.complaints)
    document = _document(network if not complaints else None, complaints)
    for path in output or []:
        write(path, [render(document)])
    console.document([render(document)])
    if complaints:
        complain(f"{problem}: {complaint}" for complaint in complaints)
        raise typer.Exit(BAD_INPUT)
    if network is not None:
        console.show(*_contents(problem, network))
        console.suggest(f"tolnet table {shlex.quote(problem)}")


def _refused_by_design(network: SensorNetwork) -> list[Complaint]:
    """What a file may say, but not of this graph: rules that need links both ways."""
    from tolnet.design import diffusion_matrix
    from tolnet.model import Complaint, UnsupportedError

    try:
        diffusion_matrix(network)
    except UnsupportedError as error:
        return [Complaint("diffusion.rule", f"is {network.diffusion!r}: {error}")]
    return []


def _document(network: SensorNetwork | None, complaints: list[Complaint]) -> dict[str, Any]:
    from tolnet.design.export import opening

    document = opening("tolnet.validation/1", network, "invalid" if complaints else "ok")
    if network is not None:
        document |= _facts(network)
    return {**document, "complaints": [{"key": each.key, "message": each.message} for each in complaints]}


def _facts(network: SensorNetwork) -> dict[str, Any]:
    degree = network.degree
    links = int(network.adjacency.nnz - network.N) // (1 if network.directed else 2)
    outputs = network.rows[1:] - network.rows[:-1]
    return {
        "states": network.n,
        "nodes": network.N,
        "directed": network.directed,
        "links": links,
        "degree": {"least": int(degree.min()), "mean": float(degree.mean()), "most": int(degree.max())},
        "outputs": {"least": int(outputs.min()), "most": int(outputs.max()), "total": int(outputs.sum())},
        "relays": int((outputs == 0).sum()),
        "diffusion": network.diffusion if isinstance(network.diffusion, str) else "weights",
    }


def _contents(problem: str, network: SensorNetwork) -> list[str]:
    facts, own = _facts(network), network.ambiguity
    degree, outputs = facts["degree"], facts["outputs"]
    kind = ("one-way link" if network.directed else "link") + ("" if facts["links"] == 1 else "s")
    lines = [
        f"{problem}: a valid problem file",
        f"  name       {network.name or '-'}" + (f": {network.description}" if network.description else ""),
        f"  plant      n = {network.n} states" + (f", every {network.dt:g} s" if network.dt else ""),
        f"  network    N = {network.N:,} nodes, {facts['links']:,} {kind};"
        f" each hears {_range(degree)}, itself included, mean {degree['mean']:.3g}",
        f"  sensors    {_range(outputs)} outputs a node, {outputs['total']:,} in all;"
        f" {facts['relays']:,} relays without one",
        f"  diffusion  {facts['diffusion']}",
    ]
    tolerance = "none: give --tolerance" if own is None else f"c = {own.tolerance:g} ({own.convention})"
    family = f", tau = {own.tau:g}" if own is not None and own.tau else ""
    return [*lines, f"  ambiguity  {tolerance}{family}"]


def _range(facts: dict[str, Any]) -> str:
    """`3`, or `2 to 5`."""
    least, most = facts["least"], facts["most"]
    return f"{least}" if least == most else f"{least} to {most}"
