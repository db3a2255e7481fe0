"""`tolnet check`: is every claim of a certificate true, and does it speak of this deployment?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.documents import render
from tolnet.cli.options import (
    AsJson,
    Quiet,
    Rule,
    Tolerance,
    Unit,
    check_outputs,
    choose_ambiguity,
    open_corrupted,
    open_problem,
)

if TYPE_CHECKING:
    from tolnet.certificates.deployed import Deployed
    from tolnet.design.export.deployed import DeployedTable
    from tolnet.model import SensorNetwork, SteadyState

INVALID, NOT_CHECKED = 1, 3
_ALIKE = 1e-9
"""Relative difference up to which a least favourable model agrees with what the centre's V and theta lead to."""


@dataclass(frozen=True)
class Row:
    """What is to be said of one claim, or of one part of a comparison."""

    claim: str
    of: str
    result: str
    text: str


def check(
    certificate: Annotated[Path, typer.Argument(metavar="CERTIFICATE", help="A file of `tolnet certify`.")],
    problem: Annotated[
        str | None, typer.Option(metavar="PROBLEM", help="Does it speak of this problem? Compares every number.")
    ] = None,
    table: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Does it speak of this table (.npz, full .json)?")
    ] = None,
    tolerance: Tolerance = None,
    convention: Unit = None,
    diffusion: Rule = None,
    precision: Annotated[
        Literal["float64", "float32"], typer.Option(help="What the device computes in: the table is rounded to it.")
    ] = "float64",
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Is every claim true? Exact arithmetic, and ball arithmetic where a logarithm is needed.

    With --problem and --table: does the certificate speak of that deployment? Every matrix that the claims use is
    compared, number by number; no Riccati equation is solved. Exit code 0: every claim is valid; 1: one is not; 2: it
    is no certificate; 3: none is invalid, but one is undecided or was not checked.
    """
    from tolnet.model import InputError

    console = Console(json=json, quiet=quiet)
    check_outputs([], [], inputs=[str(certificate)])
    if table is not None and problem is None:
        raise InputError("--table is given without --problem; a table alone has no plant and no graph")
    if tolerance is not None and problem is None:
        raise InputError("--tolerance is given without --problem, whose own it replaces")
    document = _load(certificate)
    rows = [*_judged(document, certificate, console)]
    if problem is not None:
        own = tolerance, convention
        rows = [*rows, *_compared(document, rows, problem, table, own, diffusion, precision, console)]
    counts = {result: sum(row.result == result for row in rows) for result in ("valid", "invalid")}
    status = "invalid" if counts["invalid"] else "ok" if counts["valid"] == len(rows) else "not-checked"
    console.document([render(_document(document, rows, status))])
    console.show(*_view(document, rows))
    if problem is None:
        console.note("compared with no problem: --problem FILE tells whether it speaks of that deployment")
    if status == "invalid":
        complain((f"{row.claim} of {row.of}: {row.text}" for row in rows if row.result == "invalid"), "invalid")
        raise typer.Exit(INVALID)
    if status != "ok":
        raise typer.Exit(NOT_CHECKED)


def _load(path: Path) -> Any:
    from tolnet.certificates import check as checker
    from tolnet.model import InputError

    try:
        return checker.load(str(path))
    except checker.Refused as refusal:
        raise InputError(str(refusal).removeprefix(f"{path}: "), source=str(path)) from None


def _judged(document: Any, path: Path, console: Console) -> Iterator[Row]:
    """A row a claim: first by the stand-alone checker, then in balls what that leaves open."""
    from tolnet.certificates import check as checker
    from tolnet.certificates.statements import who
    from tolnet.certificates.verify import can_verify
    from tolnet.model import InputError

    try:
        with console.progress("exact arithmetic") as progress:
            findings = checker.check(document, _watch(progress))
    except checker.Refused as refusal:
        raise InputError(str(refusal), source=str(path)) from None
    left = [i for i, finding in enumerate(findings) if finding.result == "not checked here"]
    open_claims = [i for i in left if "kind" not in document["data"] and can_verify(document["claims"][i])]
    answers = dict(zip(open_claims, _in_balls(document, open_claims, console), strict=True))
    for i, finding in enumerate(findings):
        of = "the network" if finding.node is None else who(finding.node)
        if i in answers:
            reason = answers[i]
            yield Row(finding.claim, of, "valid" if reason is None else "invalid", reason or finding.statement)
        else:
            text = finding.statement if finding.result == "valid" else finding.reason or finding.statement
            yield Row(finding.claim, of, finding.result, text)


def _watch(progress: Any) -> Any:
    def watch(label: str, count: int) -> Iterator[int]:
        for i in range(count):
            if i % 100 == 0:
                progress(i, count)
            yield i

    return watch


def _in_balls(document: Any, which: Sequence[int], console: Console) -> list[str | None]:
    """Why the claims of these numbers do not hold, or None where they do."""
    from functools import partial

    from tolnet.certificates.stated import stated_deployment
    from tolnet.certificates.verify import verify_claims
    from tolnet.cli.parallel import in_parallel
    from tolnet.model import InputError

    if not which:
        return []
    try:
        deployed = stated_deployment(document["data"])
    except InputError as error:
        return [f"the data are no sensor network: {error}"] * len(which)
    size = max(1, min(50, len(which) // 16))
    claims = [document["claims"][i] for i in which]
    parts = [claims[i : i + size] for i in range(0, len(claims), size)]
    with console.progress("ball arithmetic") as progress:
        answers = in_parallel(partial(verify_claims, deployed=deployed), parts, progress)
        return [answer for part in answers for answer in part]


def _compared(
    document: Any,
    rows: Sequence[Row],
    problem: str,
    table: Path | None,
    tolerance: tuple[float | None, Literal["gamma", "nats"] | None],
    diffusion: str | None,
    precision: str,
    console: Console,
) -> Iterator[Row]:
    """Whether the numbers of the certificate are those of a problem and of a table."""
    from tolnet.design.export.deployed import read_deployed
    from tolnet.model import InputError

    if "kind" in document["data"]:
        from tolnet.cli.certify_channels import channel_differences

        if table is not None:
            raise InputError("--table is a table for exact channels; the certificate speaks of corrupted ones")
        wrong = channel_differences(document["data"], open_corrupted(problem, console))
        yield _row("problem", problem, wrong, "plant, sensors and fading are the same")
        return
    network = open_problem(problem, console)
    stored = None if table is None else read_deployed(table)
    if stored is not None and (tolerance[0] is not None or diffusion is not None):
        raise InputError("--table holds the tolerance and the weights; --tolerance and --diffusion were not expected")
    own = network.ambiguity if tolerance[0] is None else choose_ambiguity(network, *tolerance, None)
    whole = stored.tolerance if stored is not None else None if own is None else own.gamma
    data, claims = document["data"], document["claims"]
    try:
        deployed = _deployment(network, stored, diffusion, precision)
    except InputError as error:
        yield Row("deployment", str(table), "invalid", str(error))
        return
    from tolnet.certificates.document import OF_PROBLEM, OF_TABLE, differences

    wrong = differences(data, deployed, OF_PROBLEM)
    yield _row("problem", problem, wrong, "plant, sensors and graph are the same")
    if wrong:
        return
    if stored is None:
        wrong = differences(data, deployed, ("weights",))
        yield _row("weights", problem, wrong, "the weights are the problem's own")
        yield _gains_without_table(claims, rows, network.N, problem)
    else:
        wrong = differences(data, deployed, OF_TABLE)
        yield _row("table", str(table), wrong, "gains and weights are the same")
    central = _stated_centre(claims, rows, network, stored)
    if data["centre"] is not None and central is not None:
        yield _row("least favourable model", problem, _worst_case(data, network, central), _WORST)
    elif data["centre"] is not None:
        text = "not compared: no claim states the centre's steady state; --table FILE holds it"
        yield Row("least favourable model", problem, "not checked here", text)
    if any("c" in claim for claim in claims):
        wrong = list(_numbers_of_claims(claims, network, stored, whole))
        yield _row("claims", problem, wrong, "tolerances and initial covariances are those of the deployment")


def _gains_without_table(claims: Any, rows: Sequence[Row], nodes: int, problem: str) -> Row:
    """Gains follow from a problem through a Riccati equation, which is not solved: `steady-state` ties them to it."""
    tied = [
        claim
        for claim, row in zip(claims, rows, strict=True)
        if claim["claim"] == "steady-state" and row.result == "valid" and claim["node"] != "centre"
    ]
    if len({claim["node"] for claim in tied}) < nodes:
        text = "not compared: --table FILE holds what is deployed, and a problem alone does not"
        return Row("gains", problem, "not checked here", text)
    error = max(float.fromhex(claim["gain_error"]) for claim in tied)
    return Row("gains", problem, "valid", f"the gains are those of the exact steady states, within {error:.1e}")


def _stated_centre(
    claims: Any, rows: Sequence[Row], network: SensorNetwork, stored: DeployedTable | None
) -> SteadyState | None:
    """The centre's steady state as the table has it or, without one, as its `steady-state` claim does."""
    import numpy as np

    from tolnet import analysis
    from tolnet.certificates.numerals import symmetric_matrix

    if stored is not None:
        theta = float(stored.record.central["theta"])
        return analysis.restore_steady_state(network, stored.tolerance, stored.central_P, stored.central_V, theta)
    for claim, row in zip(claims, rows, strict=True):
        if claim["claim"] == "steady-state" and claim["node"] == "centre" and row.result == "valid":
            box = claim["proof"]["box"]
            P, theta = symmetric_matrix(box["P"]), float.fromhex(box["theta"])
            V = np.linalg.solve(np.eye(len(P)) - theta * P, P)
            return analysis.restore_steady_state(network, float.fromhex(claim["c"]), P, (V + V.T) / 2, theta)
    return None


_WORST = f"the stated model follows from the centre's V and theta, within {_ALIKE:g}"


def _row(claim: str, of: str, wrong: Sequence[str], right: str) -> Row:
    some = ", ".join(wrong[:_NAMED]) + (f" and {len(wrong) - _NAMED} more" if len(wrong) > _NAMED else "")
    return Row(claim, of, "invalid" if wrong else "valid", f"differs in {some}" if wrong else right)


def _deployment(
    network: SensorNetwork, stored: DeployedTable | None, diffusion: str | None, precision: str
) -> Deployed:
    """What a problem and a table say is deployed; without a table, gains of zero stand for what is not known."""
    import numpy as np

    from tolnet.certificates.deployed import Deployed
    from tolnet.design import diffusion_matrix

    if stored is not None:
        d = stored.deployment if precision == "float64" else stored.deployment.rounded(np.float32)
        return Deployed(network, d.offsets, d.neighbours, d.weights, d.columns, d.gains)
    heard = network.adjacency.tocsc()
    heard.sort_indices()
    hearer = np.repeat(np.arange(network.N), np.diff(heard.indptr))
    weights = np.asarray(diffusion_matrix(network, diffusion)[heard.indices, hearer]).ravel()
    if precision == "float32":
        weights = weights.astype(np.float32).astype(float)
    columns = np.concatenate([[0], np.cumsum(np.diff(network.rows)[heard.indices])])
    gains = np.zeros((int(columns[-1]), network.n))
    return Deployed(network, heard.indptr, heard.indices, weights, columns, gains)


def _worst_case(data: Any, network: SensorNetwork, central: SteadyState) -> list[str]:
    """How the stated least favourable model differs from what the centre's V and theta lead to: linear equations."""
    import numpy as np

    from tolnet import analysis
    from tolnet.certificates.stated import stated_deployment
    from tolnet.design.export.deployment import central_gain_columns
    from tolnet.model import InputError

    try:
        stated = stated_deployment(data).centre
    except InputError as error:
        return [str(error)]
    worst = analysis.least_favourable_model(network, central)
    if stated is None or not worst.exists:
        return [] if stated is None and not worst.exists else ["whether there is one"]
    pairs = {
        "the centre's gain": (stated.gain, central_gain_columns(network, central)),
        "its tilt": (stated.tilt @ stated.tilt.T, worst.tilt),
    }
    return [name for name, (a, b) in pairs.items() if not np.abs(a - b).max() <= _ALIKE * np.abs(b).max()]


def _numbers_of_claims(
    claims: Any, network: SensorNetwork, stored: DeployedTable | None, whole: float | None
) -> Iterator[str]:
    """The tolerances and initial covariances of claims that are not those of the deployment."""
    import numpy as np

    from tolnet.certificates.numerals import symmetric_matrix

    for i, claim in enumerate(claims):
        if claim.get("verdict") == "undecided" or "c" not in claim:
            continue
        c, node = float.fromhex(claim["c"]), claim["node"]
        of_network = node == "centre" or claim["claim"] == "tolerance"
        expected = whole if of_network else None if stored is None else float(stored.tolerances[node])
        if expected is not None and c != expected:
            yield f"claims[{i}].c: {c!r} instead of {expected!r}"
        if "start" in claim and not np.array_equal(symmetric_matrix(claim["start"]), network.initial_covariance):
            yield f"claims[{i}].start"


def _document(document: Any, rows: Sequence[Row], status: str) -> dict[str, Any]:
    opening = {key: document[key] for key in ("tolnet", "problem", "convention", "tau", "tolerance")}
    findings = [{"claim": row.claim, "of": row.of, "result": row.result, "text": row.text} for row in rows]
    return {"schema": "tolnet.check/1", **opening, "status": status, "findings": findings}


_NAMED = 3
_STYLES = {"invalid": "bold red", "undecided": "yellow", "not checked here": "yellow"}


def _view(document: Any, rows: Sequence[Row]) -> Iterator[Any]:
    from tolnet.report.table import empty_table

    problem = document["problem"] or {}
    count = len(document["claims"])
    yield f"certificate of {problem.get('name') or 'an unnamed problem'}: {count} claim{'' if count == 1 else 's'}"
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.claim, row.result), []).append(row)
    table = empty_table(["claim", "of", "result"], words=("claim", "of", "result"))
    for (claim, result), members in groups.items():
        of = members[0].of if len(members) == 1 else f"{len(members):,} filters"
        table.add_row(claim, of, result, style=_STYLES.get(result))
    yield table
    for (_, result), members in groups.items():
        more = f" (and {len(members) - 1:,} more)" if len(members) > 1 else ""
        yield f"- {result.capitalize()}{more}: {members[0].text}"
