"""`tolnet certify`: is it stable? prove it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tolnet.cli.certify_channels import CLAIM, GramianForm, Horizon, Window, certify_channels, speaks_of_channels
from tolnet.cli.console import Console, ProgressBar
from tolnet.cli.documents import write
from tolnet.cli.options import (
    AsJson,
    Outputs,
    Problem,
    Quiet,
    Rule,
    Tolerance,
    Unit,
    check_outputs,
    nearest,
    open_any,
    open_problem,
    repeated,
)
from tolnet.cli.subject import Subject, prepare

if TYPE_CHECKING:
    from tolnet.certificates.verdicts import Node, Verdict

REFUTED, UNDECIDED = 1, 3
ATTEMPTED = ("schur-stability", "steady-state", "attraction", "tolerance", "convergence", "performance")
"""What is attempted where nobody selects."""
ON_REQUEST = ("decay-rate", "convergence-all", "switching")
FILTER_CLAIMS = ("steady-state", "attraction", "tolerance", "convergence", "convergence-all")
"""Those that speak of single filters, and are decided node by node."""


def certify(
    problem: Problem,
    tolerance: Tolerance = None,
    convention: Unit = None,
    diffusion: Rule = None,
    table: Annotated[
        Path | None,
        typer.Option(
            "--table", metavar="FILE", help="Certify the gains and weights of this table (.npz, full .json)."
        ),
    ] = None,
    precision: Annotated[
        Literal["float64", "float32"],
        typer.Option(help="What the device computes in: gains and weights are rounded."),
    ] = "float64",
    claims: Annotated[
        str | None,
        typer.Option(
            metavar="A,B",
            help="Some of schur-stability, steady-state, attraction, tolerance, convergence,"
            " performance (these without), decay-rate, convergence-all, switching; of corrupted channels:"
            " observability.",
        ),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(metavar="R", help="Claim that errors decay by this factor a step (decay-rate).")
    ] = None,
    scenarios: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Claim stability under switching among these weights or lost links (.json)."
        ),
    ] = None,
    drop_links: Annotated[
        int | None,
        typer.Option(
            "--drop-links", min=1, metavar="M", help="Claim stability when any M links at once drop and return."
        ),
    ] = None,
    stable_weights: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Where a network is refuted: write weights nearby that are proved stable"
            " (.csv, or .toml for the problem with its weights replaced).",
        ),
    ] = None,
    form: GramianForm = None,
    window: Window = None,
    horizon: Horizon = None,
    output: Outputs = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Is it stable? Proofs, or witnesses against it, in a file that `tolnet check` and check.py verify.

    -o takes .json, the certificate. What is proved concerns the very doubles that are deployed. Exit code 0: every
    claim is proved; 1: one is refuted; 3: none is refuted, but one is undecided; 4: there is no filter to certify.
    For corrupted channels the claim is that the network is robustly observable.
    """
    console = Console(json=json, quiet=quiet)
    outputs = output or []
    inputs = [problem, *(str(path) for path in (table, scenarios) if path is not None)]
    check_outputs(outputs, [".json"], inputs=inputs)
    if stable_weights is not None:
        check_outputs([stable_weights], [".csv", ".toml"], inputs=[*inputs, *map(str, outputs)])
    wanted = _choose_claims(claims, rate=rate, switching=scenarios is not None or drop_links is not None)
    from tolnet import model

    network = open_any(problem, console)
    exact = {
        "tolerance": tolerance is not None,
        "convention": convention,
        "diffusion": diffusion,
        "table": table,
        "precision": _unless(precision),
        "stable-weights": stable_weights,
    }
    corrupted = {"form": form, "window": window, "horizon": horizon}
    named = [claim for claim in wanted if claims is not None or claim not in ATTEMPTED]
    if speaks_of_channels(network, problem, named, exact, corrupted):
        assert isinstance(network, model.CorruptedNetwork)
        certify_channels(network, problem, form or "sharp", window, horizon, outputs, console)
        return
    if not isinstance(network, model.SensorNetwork):
        network = open_problem(problem, console)
    subject = prepare(network, tolerance, convention, diffusion, table, precision, console)
    verdicts = list(_decide(subject, wanted, rate, scenarios, drop_links, console))

    from tolnet.certificates.document import certificate_json
    from tolnet.report.certificate import certificate_view

    opening = subject.opening(verdicts)
    data = subject.deployed.data() if outputs or json else {}
    for path in outputs:
        with console.progress(f"writing {path}"):
            write(path, certificate_json(opening, data, verdicts))
    if json:
        console.document(certificate_json(opening, data, verdicts))
    bounds = _published(subject, verdicts), _largest(subject, wanted, console)
    console.show(*certificate_view(subject.deployed, subject.ambiguity, verdicts, *bounds))
    written = list(outputs)
    if _unstable(verdicts):
        written += _advise(subject, stable_weights, console)
    console.wrote(written)
    if stable_weights is not None and stable_weights not in written:
        console.note(f"{stable_weights} is not written: no network was refuted, or no stable weights were found")
    deployment = repeated(
        tolerance=tolerance, convention=convention, diffusion=diffusion, precision=_unless(precision)
    )
    meant = deployment
    if table is not None and network.ambiguity is None:  # a check must be told whose tolerance is meant
        own = subject.ambiguity
        meant += repeated(tolerance=own.tolerance, convention=own.convention)
    asked = repeated(claims=claims, rate=rate, scenarios=scenarios, **{"drop-links": drop_links}, table=table)
    console.suggest(
        *_next_commands(shlex.quote(problem), deployment, meant, asked, verdicts, outputs, table, stable_weights)
    )
    answers = {verdict.verdict for verdict in verdicts}
    if "refuted" in answers:
        raise typer.Exit(REFUTED)
    if "undecided" in answers:
        raise typer.Exit(UNDECIDED)


def _choose_claims(text: str | None, *, rate: float | None, switching: bool) -> list[str]:
    from tolnet.model import InputError

    words = list(ATTEMPTED) if text is None else [word.strip() for word in text.split(",")]
    known = (*ATTEMPTED, *ON_REQUEST, CLAIM)
    for word in words:
        if word not in known:
            raise InputError(f"--claims names {word!r}; the claims are {', '.join(known)}{nearest(word, known)}")
    if rate is not None:
        if not 0 < rate < float("inf"):
            raise InputError(f"--rate is {rate}; a number above 0 was expected")
        words += ["decay-rate"]
    if switching:
        words += ["switching"]
    elif "switching" in words:
        raise InputError("--claims names 'switching', which needs --scenarios FILE or --drop-links M")
    return list(dict.fromkeys(words))


def _decide(
    subject: Subject,
    wanted: Sequence[str],
    rate: float | None,
    scenarios: Path | None,
    drop_links: int | None,
    console: Console,
) -> Iterator[Verdict]:
    """The verdicts, in the order of the claims."""
    from tolnet.cli.scenarios import read_scenarios

    evidence = subject.evidence
    listed = None if scenarios is None else read_scenarios(scenarios, subject.deployed)
    for claim in wanted:
        with console.progress(claim) as progress:
            match claim:
                case "schur-stability":
                    yield evidence.stability(progress)
                case "decay-rate":
                    yield evidence.decay_rate(rate, progress)
                case "performance":
                    yield evidence.performance()
                case "switching":
                    if listed is not None:
                        yield evidence.scenarios(listed, progress)
                    if drop_links is not None:
                        yield evidence.link_losses(drop_links, progress)
                case _ if claim == next(name for name in wanted if name in FILTER_CLAIMS):
                    yield from _decide_filters(subject, [c for c in wanted if c in FILTER_CLAIMS], progress)


def _decide_filters(subject: Subject, claims: Sequence[str], progress: ProgressBar) -> Iterator[Verdict]:
    """The verdicts on single filters, claim by claim: the centre first, then the nodes."""
    from functools import partial

    from tolnet.certificates.filter_claims import SteadyStates, decide, find_centre
    from tolnet.cli.parallel import in_parallel

    local, central = subject.local, subject.central
    nodes: list[Node] = [*range(subject.network.N)]
    c, P, theta = local.tolerance.tolist(), list(local.P), local.theta.tolist()
    centre = None
    if central.exists:
        own = float(central.tolerance), central.P, float(central.theta)
        centre = find_centre(subject.deployed, *own)
        nodes, c, P, theta = ["centre", *nodes], [own[0], *c], [own[1], *P], [own[2], *theta]
    parts = SteadyStates(nodes, c, P, theta, centre).parts(_at_a_time(len(nodes)))
    work = partial(decide, deployed=subject.deployed, claims=claims)
    found = [verdict for verdicts in in_parallel(work, parts, progress) for verdict in verdicts]
    for claim in claims:
        yield from (verdict for verdict in found if verdict.claim == claim)


def _at_a_time(filters: int) -> int:
    """Filters that one process decides in a row: few, to show progress; not too few, since each row starts anew."""
    return max(1, min(50, filters // 16))


def _published(subject: Subject, verdicts: Sequence[Verdict]) -> float | None:
    """The published sufficient bound for the centre, to stand beside what was proved of convergence."""
    if not any(verdict.claim.startswith("convergence") for verdict in verdicts):
        return None
    from tolnet import analysis

    network = subject.network
    S = network.total_information[None]
    return float(analysis.published_bound(network.A, network.Q, S, 2 * network.n)[0])


def _largest(subject: Subject, wanted: Sequence[str], console: Console) -> float | None:
    """The largest c for which the centre is proved to converge from every start, where that was asked for."""
    from tolnet.certificates.balls import NotProved
    from tolnet.certificates.bracket import largest_tolerance_for_all
    from tolnet.certificates.filter_claims import ExactFilters

    if "convergence-all" not in wanted or console.json or console.quiet:
        return None
    with console.progress("largest tolerance"):
        found = largest_tolerance_for_all(ExactFilters(subject.deployed).filter("centre", 0.0))
    return None if isinstance(found, NotProved) else float.fromhex(found["c"])


def _unstable(verdicts: Sequence[Verdict]) -> bool:
    return any(v.verdict == "refuted" and v.claim == "schur-stability" for v in verdicts)


def _advise(subject: Subject, path: Path | None, console: Console) -> list[Path]:
    """Who carries the unstable mode, and which weights nearby are proved stable."""
    from tolnet.report.certificate import instability_view

    with console.progress("weights nearby that are stable"):
        repaired = subject.evidence.stable_weights_nearby()
    view = instability_view(subject.deployed, subject.evidence.growth, repaired, written=path is not None)
    console.show(*view)
    if path is None or repaired is None:
        return []
    from tolnet import model
    from tolnet.model import replacing

    if path.suffix.lower() == ".toml":
        return model.save(subject.network.with_diffusion(repaired.W), path)
    with replacing(path) as file:
        file.write(b"# diffusion weights: line l, number k is w_lk\n")
        for row in repaired.W.toarray():
            file.write((",".join(map(repr, row.tolist())) + "\n").encode())
    return [path]


def _unless(precision: str) -> str | None:
    return None if precision == "float64" else precision


def _next_commands(
    problem: str,
    deployment: str,
    meant: str,
    asked: str,
    verdicts: Sequence[Verdict],
    outputs: Sequence[Path],
    table: Path | None,
    stable_weights: Path | None,
) -> Iterator[str]:
    if outputs:
        tied = table is not None or any(v.claim == "steady-state" and v.verdict == "proved" for v in verdicts)
        against = f" --problem {problem}{repeated(table=table)}{meant}"
        yield f"tolnet check {shlex.quote(str(outputs[0]))}{against if tied else ''}"
    else:
        yield f"tolnet certify {problem}{deployment}{asked} -o certificate.json"
    if _unstable(verdicts):
        if stable_weights is None:
            yield f"tolnet certify {problem}{deployment} --stable-weights mended.toml"
        elif stable_weights.suffix.lower() == ".toml":
            yield f"tolnet certify {shlex.quote(str(stable_weights))}"
    elif not any(v.claim == "switching" for v in verdicts):
        against = repeated(table=table)
        yield f"tolnet certify {problem}{deployment}{against} --claims switching --drop-links 1"
