"""`tolnet diffusion`: which weights W are best?"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.documents import render, write
from tolnet.cli.options import (
    AsJson,
    Outputs,
    Problem,
    Quiet,
    Tolerance,
    Unit,
    check_outputs,
    choose_ambiguity,
    open_problem,
    repeated,
)
from tolnet.cli.solving import save_figure, solve_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from tolnet.design import Constraints
    from tolnet.design.weights.compare import Rival
    from tolnet.design.weights.topology import AddedLink
    from tolnet.model import Ambiguity, Complaint, Diffusion, SensorNetwork, ToleranceTable

NO_ANSWER = 4
SUFFIXES = (".csv", ".json", ".npz", ".toml")


def diffusion(
    problem: Problem,
    objective: Annotated[
        Literal["msd", "worst", "robust", "decay", "mixing"],
        typer.Option(help="MSD of the network, of its worst node, over scenarios; certified decay; mixing."),
    ] = "msd",
    nodes: Annotated[
        str | None, typer.Option(metavar="A,B", help="MSD of these nodes only (names or indices), for msd.")
    ] = None,
    max_neighbours: Annotated[
        int | None, typer.Option(metavar="D", help="At most so many neighbours in use, each node itself counted.")
    ] = None,
    own_weight: Annotated[float, typer.Option(metavar="W", help="Every w_kk is at least this.")] = 0.0,
    symmetric: Annotated[bool, typer.Option("--symmetric", help="w_lk = w_kl.")] = False,
    with_gains: Annotated[
        bool, typer.Option("--with-gains", help="Every node's gain is designed too, for msd, worst and robust.")
    ] = False,
    scenario_tolerance: Annotated[
        list[float] | None,
        typer.Option(metavar="C", help="A scenario for robust: another tolerance. Repeatable; c/2, c, 2c without."),
    ] = None,
    without_link: Annotated[
        list[str] | None,
        typer.Option(metavar="A-B", help="A scenario for robust: this link is lost. Repeatable."),
    ] = None,
    method: Annotated[
        Literal["auto", "quasi-newton", "ipopt", "sdp"],
        typer.Option(help="How: quasi-newton or ipopt for MSD; sdp is a general solver for decay and mixing."),
    ] = "auto",
    compare: Annotated[bool, typer.Option("--compare", help="All rules and all objectives side by side.")] = False,
    add_links: Annotated[
        int | None, typer.Option(metavar="M", help="Which M links to add, ranked by the optimised MSD.")
    ] = None,
    tolerance: Tolerance = None,
    convention: Unit = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the weights on the network, and MSD before and after."),
    ] = None,
    certificate: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Prove what was designed stable: a certificate for `tolnet check` (.json)."
        ),
    ] = None,
    gain_table: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the table that is deployed, W and gains in it (.npz)."),
    ] = None,
    output: Outputs = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Which weights W are best? The best that can be found, what they are worth, and how far from the best possible.

    -o takes .csv (W, N lines of N numbers), .json, .npz and .toml (the problem with W in it). Ctrl-C ends the search
    with the best W so far. Exit code 4: the filters have no performance under W.
    """
    console = Console(json=json, quiet=quiet)
    outputs = output or []
    check_outputs(outputs, SUFFIXES, inputs=[problem], plot=plot)
    if certificate is not None:
        check_outputs([certificate], [".json"], inputs=[problem, *map(str, outputs)])
    if gain_table is not None:
        check_outputs([gain_table], [".npz"], inputs=[problem, *map(str, outputs)])
    network = open_problem(problem, console)
    ambiguity = choose_ambiguity(network, tolerance, convention, None)
    constraints = _constraints(network, ambiguity, own_weight, max_neighbours, symmetric)
    _check_combination(objective, constraints, with_gains, method, without_link)
    chosen = _chosen(network, nodes, objective)
    _check_scenarios(network, objective, scenario_tolerance, without_link)
    if add_links is not None:
        _check_added(network, add_links, objective, constraints, with_gains or nodes is not None)

    from tolnet import design

    table = solve_table(network, ambiguity, console)
    scenarios = None
    if objective == "robust":
        scenarios = _scenarios(network, table, ambiguity, scenario_tolerance, without_link, console)
    with console.progress(f"weights for {objective}") as progress:
        found = design.optimise_diffusion(
            network,
            table,
            objective,
            nodes=chosen,
            constraints=constraints,
            scenarios=scenarios,
            with_gains=with_gains,
            method=method,
            watch=progress.say,
        )
    rivals, links = _more(found, ambiguity, constraints, compare, add_links, console)
    _tell(found, rivals, links, console, outputs, plot)
    if gain_table is not None:
        _deploy(found, gain_table)
        console.wrote([gain_table])
        console.suggest(f"tolnet certify {shlex.quote(problem)} --table {shlex.quote(str(gain_table))}")
    if certificate is not None and found.status != "no-steady-state":
        _prove(found, ambiguity, certificate, console)
        designed = next((path for path in outputs if path.suffix.lower() == ".toml"), None)
        against = repeated(problem=designed, table=gain_table if designed is not None else None)
        console.suggest(f"tolnet check {shlex.quote(str(certificate))}{against}")
    if found.interrupted:
        console.note("interrupted: these are the best weights so far")
    options = repeated(tolerance=tolerance, convention=convention)
    console.suggest(*_next_commands(shlex.quote(problem), options, found, outputs, compare))
    if not found.status.has_numbers:
        complain([f"{found.status}: {found.reason}"], "no answer")
        raise typer.Exit(NO_ANSWER)


def _constraints(
    network: SensorNetwork, ambiguity: Ambiguity, own_weight: float, max_neighbours: int | None, symmetric: bool
) -> Constraints:
    """What is asked of W, in the words of the command line where nothing can satisfy it."""
    from tolnet.design import Constraints
    from tolnet.model import InputError, UnsupportedError

    if ambiguity.tau != 0:
        raise UnsupportedError(
            f"the least favourable model is defined for tau = 0 only, and ambiguity.tau is {ambiguity.tau:g}"
        )
    constraints = Constraints(symmetric=symmetric, own_weight=own_weight, max_neighbours=max_neighbours)
    try:
        constraints.check(network)
    except InputError as error:
        raise InputError(_as_options(error.complaints)) from None
    return constraints


def _check_combination(
    objective: str, constraints: Constraints, with_gains: bool, method: str, lost: list[str] | None
) -> None:
    """Raise for options that cannot be had together, before anything is computed."""
    from tolnet.design.weights.optimise import complaints_of
    from tolnet.model import InputError

    complaints = complaints_of(objective, constraints, with_gains, method)
    if complaints:
        raise InputError(_as_options(complaints))
    if with_gains and lost:
        raise InputError("--with-gains cannot be combined with --without-link: its gains are on links")


def _as_options(complaints: Sequence[Complaint]) -> list[Complaint]:
    """The same in the words of the command line."""
    return [replace(c, key=f"--{c.key.replace('_', '-')}") for c in complaints]


def _chosen(network: SensorNetwork, nodes: str | None, objective: str) -> np.ndarray | None:
    """Weights of the nodes that were named; None for all alike."""
    import numpy as np

    from tolnet.model import InputError

    if nodes is None:
        return None
    if objective != "msd":
        raise InputError(f"--nodes is given; the objective {objective!r} weighs no nodes")
    a = np.zeros(network.N)
    for word in nodes.split(","):
        a[_node(network, word.strip(), "--nodes")] = 1.0
    return a


def _node(network: SensorNetwork, word: str, option: str) -> int:
    from tolnet.model import InputError

    labels = [network.label(k) for k in range(network.N)]
    if word in labels:
        return labels.index(word)
    if word.isdigit() and int(word) < network.N:
        return int(word)
    known = f"names or indices up to {network.N - 1}" if network.names else f"indices from 0 to {network.N - 1}"
    raise InputError(f"{option} names {word!r}, which is no node; {known} were expected")


def _check_scenarios(
    network: SensorNetwork, objective: str, tolerances: list[float] | None, lost: list[str] | None
) -> None:
    from tolnet.model import InputError

    for option, given in (("--scenario-tolerance", tolerances), ("--without-link", lost)):
        if given and objective != "robust":
            raise InputError(f"{option} is given; the objective {objective!r} has one scenario")
    for pair in lost or ():
        _link(network, pair)


def _link(network: SensorNetwork, pair: str) -> tuple[int, int]:
    """The two ends of a link, given as A-B."""
    from tolnet.model import InputError

    for at in (i for i, letter in enumerate(pair) if letter == "-"):
        try:
            l, k = (_node(network, word, "--without-link") for word in (pair[:at], pair[at + 1 :]))
        except InputError:
            continue
        if l != k and (network.adjacency[l, k] or network.adjacency[k, l]):
            return l, k
        raise InputError(f"--without-link names {pair!r}, and there is no such link")
    raise InputError(f"--without-link is {pair!r}; two nodes with a dash between them were expected")


def _check_added(network: SensorNetwork, m: int, objective: str, constraints: Constraints, more: bool) -> None:
    from tolnet.model import InputError

    if objective != "msd":
        raise InputError(f"--add-links ranks links by the MSD of the network; the objective is {objective!r}")
    if more or constraints.symmetric or constraints.own_weight or constraints.max_neighbours is not None:
        raise InputError(
            "--add-links ranks links by what weights without constraints make of the whole network; it cannot be"
            " combined with --with-gains, --nodes, --symmetric, --own-weight or --max-neighbours"
        )
    lacking = network.N * (network.N - 1) // (1 if network.directed else 2) - len(network.links)
    if not 1 <= m <= lacking:
        raise InputError(f"--add-links is {m}; the graph lacks {lacking} links")


def _scenarios(
    network: SensorNetwork,
    table: ToleranceTable,
    ambiguity: Ambiguity,
    tolerances: list[float] | None,
    lost: list[str] | None,
    console: Console,
) -> Sequence[ToleranceTable]:
    """The table itself, then those at other tolerances and on networks that lost a link."""
    import numpy as np

    from tolnet import analysis, design
    from tolnet.model import Ambiguity

    c = ambiguity.tolerance
    wanted = [c / 2, 2 * c] if tolerances is None and not lost else tolerances or []
    with console.progress("scenarios"):
        tables = [table]
        for other in wanted:
            one = design.choose_tolerances(network, Ambiguity(other, ambiguity.convention))
            if tolerances is None and not analysis.least_favourable_model(network, one.central).exists:
                console.note(f"no scenario at c = {other:g}: the centre has no least favourable model there")
                continue
            tables.append(one)
        for pair in lost or ():
            ends = set(_link(network, pair))
            kept = [link for link in network.links.tolist() if set(link) != ends]
            shorter = network.relinked(np.array(kept, dtype=np.int64).reshape(-1, 2))
            tables.append(design.choose_tolerances(shorter, ambiguity))
    return tables


def _deploy(found: Diffusion, path: Path) -> None:
    """The tolerance table with the designed weights and gains in the place of its own."""
    from tolnet.design.export.arrays import write_npz
    from tolnet.design.weights.gains import deployment_of
    from tolnet.model import replacing

    with replacing(path) as file:
        write_npz(found.table, file, deployment=deployment_of(found))


def _prove(found: Diffusion, ambiguity: Ambiguity, path: Path, console: Console) -> None:
    """Write the certificate, and say what it proves."""
    from tolnet.cli.designed import write_certificate

    for verdict in write_certificate(found, ambiguity, path, console):
        console.show(f"{verdict.verdict}: {verdict.statement}")
    console.wrote([path])


def _more(
    found: Diffusion,
    ambiguity: Ambiguity,
    constraints: Constraints,
    compare: bool,
    add_links: int | None,
    console: Console,
) -> tuple[list[Rival], list[AddedLink]]:
    """The comparison and the links, where they were asked for and nothing was interrupted."""
    rivals: list[Rival] = []
    links: list[AddedLink] = []
    try:
        if compare and not found.interrupted:
            from tolnet.design.weights.compare import compare_diffusions

            with console.progress("all rules and objectives") as progress:
                rivals = compare_diffusions(found.table.network, found.table, constraints, watch=progress.say)
        if add_links is not None and not found.interrupted and found.status.has_numbers:
            from tolnet.design.weights.topology import add_links as rank_links

            with console.progress("links") as progress:
                links = rank_links(found.table.network, ambiguity, found.W.toarray(), add_links, watch=progress.say)
            if links[-1].interrupted:
                console.note("interrupted: these are the links that were found so far")
    except KeyboardInterrupt:
        console.note("interrupted: the weights were found, and are written; not all that was asked beside them")
    return rivals, links


def _tell(
    found: Diffusion,
    rivals: list[Rival],
    links: list[AddedLink],
    console: Console,
    outputs: list[Path],
    plot: Path | None,
) -> None:
    """Write, draw and print what was found."""
    from tolnet.report.diffusion import compare_view, diffusion_document, diffusion_view, links_view

    document = diffusion_document(found, rivals, links)
    for path in outputs:
        with console.progress(f"writing {path}"):
            _write(found, document, path)
    if plot is not None:
        from tolnet.report.weights_map import weights_figure

        with console.progress(f"drawing {plot}"):
            save_figure(weights_figure(found), plot)
    if console.json:
        console.document([render(document)])
    console.show(*diffusion_view(found))
    if rivals:
        console.show("rules and objectives side by side", compare_view(rivals))
    if links:
        console.show("links to add, one after the other", links_view(found, links))
    console.wrote([*outputs, *([plot] if plot else [])])


def _write(found: Diffusion, document: dict, path: Path) -> None:
    import numpy as np

    from tolnet import model
    from tolnet.report.diffusion import diffusion_arrays, diffusion_csv

    match path.suffix.lower():
        case ".csv":
            write(path, diffusion_csv(found))
        case ".npz":
            with model.replacing(path) as file:
                np.savez(file, allow_pickle=False, **diffusion_arrays(found))
        case ".toml":
            model.save(found.table.network.with_diffusion(found.W), path)
        case _:
            write(path, [render(document)])


def _next_commands(problem: str, options: str, found: Diffusion, outputs: list[Path], compare: bool) -> Iterator[str]:
    designed = [path for path in outputs if path.suffix.lower() == ".toml"]
    if designed:
        yield f"tolnet performance {shlex.quote(str(designed[0]))}{options}"
    else:
        yield f"tolnet diffusion {problem}{options} --objective {found.objective} -o designed.toml --plot weights.png"
    if found.objective == "msd" and found.gains is None:
        yield f"tolnet diffusion {problem}{options} --with-gains"
    if not compare:
        yield f"tolnet diffusion {problem}{options} --compare"
