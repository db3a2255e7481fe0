"""`tolnet validate`: is this file right? Every complaint at once."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Any

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.documents import render, write
from tolnet.cli.options import AsJson, Outputs, Problem, Quiet, check_outputs, open_any

if TYPE_CHECKING:
    from tolnet.model import Complaint, CorruptedNetwork, SensorNetwork

BAD_INPUT = 2


def validate(problem: Problem, output: Outputs = None, json: AsJson = False, quiet: Quiet = False) -> None:
    """Is this problem file right? Says everything that is wrong at once, one complaint a line, or what is in it.

    -o takes .json. Exit code 2: something is wrong.
    """
    from tolnet.model import InputError, SensorNetwork

    console = Console(json=json, quiet=quiet)
    check_outputs(output or [], [".json"], inputs=[problem])
    network = None
    try:
        network = open_any(problem, console)
        complaints = _refused_by_design(network)
    except InputError as error:
        complaints = list(error.complaints)
    if output or json:  # rendering brings in all that designs, which a bad file need not wait for
        text = render(_document(network if not complaints else None, complaints))
        for path in output or []:
            write(path, [text])
        console.document([text])
    if complaints:
        complain(f"{problem}: {complaint}" for complaint in complaints)
        raise typer.Exit(BAD_INPUT)
    if network is not None:
        console.show(*_contents(problem, network))
        command = "table" if isinstance(network, SensorNetwork) else "observability"
        console.suggest(f"tolnet {command} {shlex.quote(problem)}")


def _refused_by_design(network: SensorNetwork | CorruptedNetwork) -> list[Complaint]:
    """What a file may say, but not of this graph: rules that need links both ways."""
    from tolnet.design import diffusion_matrix
    from tolnet.model import Complaint, CorruptedNetwork, UnsupportedError

    if isinstance(network, CorruptedNetwork):
        return []
    try:
        diffusion_matrix(network)
    except UnsupportedError as error:
        return [Complaint("diffusion.rule", f"is {network.diffusion!r}: {error}")]
    return []


def _document(network: SensorNetwork | CorruptedNetwork | None, complaints: list[Complaint]) -> dict[str, Any]:
    from tolnet.design.export import opening

    document = opening("tolnet.validation/1", network, "invalid" if complaints else "ok")
    if network is not None:
        document |= _facts(network)
    return {**document, "complaints": [{"key": each.key, "message": each.message} for each in complaints]}


def _facts(network: SensorNetwork | CorruptedNetwork) -> dict[str, Any]:
    degree = network.degree
    links = int(network.adjacency.nnz - network.N) // (1 if network.directed else 2)
    outputs = network.rows[1:] - network.rows[:-1]
    facts = {
        "states": network.n,
        "nodes": network.N,
        "directed": network.directed,
        "links": links,
        "degree": {"least": int(degree.min()), "mean": float(degree.mean()), "most": int(degree.max())},
        "outputs": {"least": int(outputs.min()), "most": int(outputs.max()), "total": int(outputs.sum())},
        "relays": int((outputs == 0).sum()),
    }
    return facts | _own_facts(network)


def _own_facts(network: SensorNetwork | CorruptedNetwork) -> dict[str, Any]:
    """What only one of the two kinds has."""
    from tolnet.model import SensorNetwork

    if isinstance(network, SensorNetwork):
        return {"diffusion": network.diffusion if isinstance(network.diffusion, str) else "weights"}
    own = network.pairs[:, 0] == network.pairs[:, 1]
    channel = {name: bounds(0)[~own] for name, bounds in (("estimate", network.W_bar), ("matrix", network.D_bar))}
    return {
        "period": network.period,
        "multiplicative_variance": float(network.mu(0)),
        "fading_mean": {"least": float(network.tau(0).min()), "most": float(network.tau(0).max())},
        "fading_variance": {"least": float(network.phi(0).min()), "most": float(network.phi(0).max())},
        "channel": {name: bounds.trace(axis1=1, axis2=2).max(initial=0.0) for name, bounds in channel.items()},
        "window": network.window,
    }


def _contents(problem: str, network: SensorNetwork | CorruptedNetwork) -> list[str]:
    from tolnet.model import SensorNetwork

    facts = _facts(network)
    degree, outputs = facts["degree"], facts["outputs"]
    kind = ("one-way link" if network.directed else "link") + ("" if facts["links"] == 1 else "s")
    spread = _range(outputs, "d")
    relays = f"{facts['relays']:,} relay" + ("" if facts["relays"] == 1 else "s")
    lines = [
        f"{problem}: a valid problem file",
        f"  name       {network.name or '-'}" + (f": {network.description}" if network.description else ""),
        f"  plant      n = {network.n} states" + (f", every {network.dt:g} s" if network.dt else ""),
        f"  network    N = {network.N:,} nodes, {facts['links']:,} {kind};"
        f" each hears {_range(degree, 'd')}, itself included, mean {degree['mean']:.3g}",
        f"  sensors    {spread} outputs a node, {outputs['total']:,} in all; {relays} without one",
    ]
    if not isinstance(network, SensorNetwork):
        channel = facts["channel"]
        return [
            *lines[:2],
            f"{lines[2]}, {_period(network.period)}; multiplicative variance {facts['multiplicative_variance']:g}",
            *lines[3:],
            f"  fading     mean {_range(facts['fading_mean'], 'g')},"
            f" variance {_range(facts['fading_variance'], '.3g')}",
            f"  channels   noise on estimates up to trace {channel['estimate']:.3g},"
            f" on matrices up to trace {channel['matrix']:.3g}",
        ]
    own = network.ambiguity
    tolerance = "none: give --tolerance" if own is None else f"c = {own.tolerance:g} ({own.convention})"
    family = f", tau = {own.tau:g}" if own is not None and own.tau else ""
    return [*lines, f"  diffusion  {facts['diffusion']}", f"  ambiguity  {tolerance}{family}"]


def _range(of: dict[str, Any], digits: str) -> str:
    least, most = f"{of['least']:{digits}}", f"{of['most']:{digits}}"
    return least if least == most else f"{least} to {most}"


def _period(T: int | None) -> str:
    return "constant" if T == 1 else f"periodic over {T} steps"
