"""`tolnet check`: is every claim of a certificate true, and does it speak of this deployment?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.documents import render
from tolnet.cli.findings import Row, coverage, plain, required_claims, requirements, view
from tolnet.cli.options import AsJson, Quiet, Rule, Tolerance, Unit, check_outputs

if TYPE_CHECKING:
    from tolnet.certificates.verify import Answer
    from tolnet.model import Ambiguity, CorruptedNetwork, SensorNetwork

INVALID, NOT_CHECKED = 1, 3
LONGEST, A_CLAIM = 1800.0, 10.0
"""Seconds that all ball arithmetic together may take: half an hour, and so many more a claim."""
_COMPLAINTS = 20
"""Lines on standard error about what is invalid; the rest is counted."""


def check(
    certificate: Annotated[Path, typer.Argument(metavar="CERTIFICATE", help="A file of `tolnet certify`.")],
    problem: Annotated[
        str | None, typer.Option(metavar="PROBLEM", help="Does it speak of this problem? Compares every number.")
    ] = None,
    table: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Does it speak of this table (.npz, full .json)?")
    ] = None,
    require: Annotated[
        str | None,
        typer.Option(
            metavar="A,B",
            help="Fail unless these claims are proved, those about filters for every node: 'convergence'.",
        ),
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
    compared, number by number; no Riccati equation is solved. A valid refutation is a valid claim: --require asks for
    proofs. Exit code 0: every claim is valid; 1: one is not, or one that is required is missing or not proved; 2: it
    is no certificate; 3: none is invalid, but one is undecided or was not checked.
    """
    from tolnet.cli.compared import Against, compared
    from tolnet.model import InputError

    console = Console(json=json, quiet=quiet)
    wanted = required_claims(require)
    check_outputs([], [], inputs=[str(certificate)])
    if table is not None and problem is None:
        raise InputError("--table is given without --problem; a table alone has no plant and no graph")
    if tolerance is not None and problem is None:
        raise InputError("--tolerance is given without --problem, whose own it replaces")
    document = _load(certificate)
    rows = [*_judged(document, certificate, console)]
    nodes, subject = document["data"]["nodes"], None
    told = coverage(rows, nodes)
    added = [*requirements(rows, wanted, nodes)]
    if problem is not None:
        against = Against.opened(problem, table, (tolerance, convention), diffusion, precision, document, console)
        subject = against.network, against.ambiguity
        added = [*compared(document, rows, against, console), *added]
    rows += added
    results = {row.result for row in rows}
    status = "invalid" if "invalid" in results else "ok" if results == {"valid"} else "not-checked"
    console.document([render(_document(rows, told, status, subject))])
    console.show(*view(rows, told, _heading(document, subject)))
    if problem is None:
        console.note("compared with no problem: --problem FILE tells whether it speaks of that deployment")
    if status == "invalid":
        _complain([row for row in rows if row.result == "invalid"])
        raise typer.Exit(INVALID)
    if status != "ok":
        raise typer.Exit(NOT_CHECKED)


def _complain(rows: Sequence[Row]) -> None:
    lines = [plain(f"{row.claim} of {row.of}: {row.text}") for row in rows[:_COMPLAINTS]]
    more = len(rows) - len(lines)
    complain([*lines, *([f"and {more:,} more"] if more else [])], "invalid")


def _load(path: Path) -> Any:
    from tolnet.certificates import check as checker
    from tolnet.model import InputError

    if path.exists() and not path.is_file():
        raise InputError("is no regular file", source=str(path))
    try:
        return checker.load(str(path))
    except checker.Refused as refusal:
        raise InputError(str(refusal).removeprefix(f"{path}: "), source=str(path)) from None


# ---- Claims ----


def _judged(document: Any, path: Path, console: Console) -> Iterator[Row]:
    """A row a claim: first by the stand-alone checker, then in balls what that leaves open."""
    from tolnet.certificates import check as checker
    from tolnet.certificates.statements import who
    from tolnet.certificates.verify import NotChecked, can_verify
    from tolnet.model import InputError

    try:
        with console.progress("exact arithmetic") as progress:
            findings = checker.check(document, _watch(progress))
    except checker.Refused as refusal:
        raise InputError(plain(str(refusal)), source=str(path)) from None
    claims = document["claims"]
    left = [i for i, finding in enumerate(findings) if finding.result == "not checked here"]
    open_claims = [i for i in left if "kind" not in document["data"] and can_verify(claims[i])]
    answers = dict(zip(open_claims, _in_balls(document, open_claims, console), strict=True))
    for i, finding in enumerate(findings):
        of = "the network" if finding.node is None else who(finding.node)
        result, reason = finding.result, finding.reason
        if i in answers:
            answer = answers[i]
            if isinstance(answer, NotChecked):
                reason = answer.reason
            else:
                result, reason = "valid" if answer is None else "invalid", answer
        text = finding.statement if result == "valid" or reason is None else reason
        entry = claims[i] if result == "valid" else None
        yield Row(finding.claim, of, result, text, finding.verdict, finding.node, i, entry)


def _watch(progress: Any) -> Any:
    def watch(label: str, count: int) -> Iterator[int]:
        for i in range(count):
            if i % 100 == 0:
                progress(i, count)
            yield i

    return watch


def _in_balls(document: Any, which: Sequence[int], console: Console) -> list[Answer]:
    """What is to be said of the claims of these numbers. What has not the form of a claim goes no further."""
    import time
    from functools import partial

    from tolnet.certificates.stated import stated_deployment
    from tolnet.certificates.verify import misshapen, verify_claims
    from tolnet.cli.parallel import in_parallel
    from tolnet.model import TolnetError

    claims = [document["claims"][i] for i in which]
    found: list[Answer] = [misshapen(claim) for claim in claims]
    shaped = [i for i, complaint in enumerate(found) if complaint is None]
    if not shaped:
        return found
    try:
        deployed = stated_deployment(document["data"])
    except (TolnetError, ValueError, ArithmeticError) as error:
        for i in shaped:
            found[i] = f"the data are no sensor network: {error}"
        return found
    size = max(1, min(50, len(shaped) // 16))
    parts = [[claims[i] for i in shaped[start : start + size]] for start in range(0, len(shaped), size)]
    end = time.monotonic() + LONGEST + A_CLAIM * len(shaped)
    with console.progress("ball arithmetic") as progress:
        answers = in_parallel(partial(verify_claims, deployed=deployed, end=end), parts, progress)
        for i, answer in zip(shaped, (answer for part in answers for answer in part), strict=True):
            found[i] = answer
    return found


# ---- What is said ----


def _document(
    rows: Sequence[Row],
    told: list[dict[str, Any]],
    status: str,
    subject: tuple[SensorNetwork | CorruptedNetwork, Ambiguity | None] | None,
) -> dict[str, Any]:
    """The findings. Whatever labels the certificate carries, the heading names what it was compared with."""
    from tolnet.design.export import opening

    network, ambiguity = (None, None) if subject is None else subject
    head = opening("tolnet.check/1", network, status, ambiguity)
    return {**head, "coverage": told, "findings": [row.document() for row in rows]}


def _heading(document: Any, subject: tuple[SensorNetwork | CorruptedNetwork, Ambiguity | None] | None) -> str:
    claims, nodes = len(document["claims"]), document["data"]["nodes"]
    name = "" if subject is None else f", compared with {subject[0].name or 'an unnamed problem'}"
    counted = f"{claims:,} claim{'' if claims == 1 else 's'} on {nodes:,} node{'' if nodes == 1 else 's'}"
    return f"certificate: {counted}{name}"
