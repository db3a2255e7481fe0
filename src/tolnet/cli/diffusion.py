"""`tolnet diffusion`: which weights W are best?"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.diffusion_options import (
    check_added,
    check_combination,
    check_scenarios,
    chosen_nodes,
    constraints_of,
    scenario_tables,
)
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
    from tolnet.design import Constraints
    from tolnet.design.weights.compare import Rival
    from tolnet.design.weights.topology import AddedLink
    from tolnet.model import Ambiguity, Diffusion

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
    constraints = constraints_of(network, ambiguity, own_weight, max_neighbours, symmetric)
    check_combination(objective, constraints, with_gains, method)
    chosen = chosen_nodes(network, nodes, objective)
    check_scenarios(network, objective, scenario_tolerance, without_link)
    if add_links is not None:
        check_added(network, add_links, objective, constraints, with_gains or nodes is not None)

    from tolnet import design

    table = solve_table(network, ambiguity, console)
    scenarios = None
    if objective == "robust":
        scenarios = scenario_tables(network, table, ambiguity, scenario_tolerance, without_link, console)
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
    asked = {
        "nodes": nodes,
        "max-neighbours": max_neighbours,
        "own-weight": own_weight or None,
        "symmetric": symmetric,
        "method": None if method == "auto" else method,
        "scenario-tolerance": scenario_tolerance,
        "without-link": without_link,
    }
    if found.status.has_numbers:
        console.suggest(*_next_commands(shlex.quote(problem), options, repeated(**asked), found, outputs, compare))
    else:
        from tolnet.design.smaller_tolerance import answering_tolerance

        with console.progress("smaller tolerances"):
            smaller = answering_tolerance(found.table)
        if smaller is not None:
            level = repeated(tolerance=f"{smaller:g}", convention=found.table.convention)
            console.suggest(
                f"tolnet diffusion {shlex.quote(problem)}{level} --objective {objective}{repeated(**asked)}"
            )
        complain([f"{found.status}: {found.reason}"], "no answer")
        raise typer.Exit(NO_ANSWER)


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


def _next_commands(
    problem: str, options: str, asked: str, found: Diffusion, outputs: list[Path], compare: bool
) -> Iterator[str]:
    designed = [path for path in outputs if path.suffix.lower() == ".toml"]
    if designed:
        yield f"tolnet performance {shlex.quote(str(designed[0]))}{options}"
    else:
        gains = "" if found.gains is None else " --with-gains"
        design = f"{options} --objective {found.objective}{asked}{gains}"
        yield f"tolnet diffusion {problem}{design} -o designed.toml --plot weights.png"
    if found.objective == "msd" and found.gains is None:
        yield f"tolnet diffusion {problem}{options} --with-gains"
    if not compare:
        yield f"tolnet diffusion {problem}{options} --compare"
