"""`tolnet certify` and `tolnet check` for problems with corrupted channels: is the network robustly observable?"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tolnet.cli.console import Console
from tolnet.cli.documents import write
from tolnet.cli.options import repeated

if TYPE_CHECKING:
    from tolnet.certificates.verdicts import Verdict
    from tolnet.model import CorruptedNetwork, SensorNetwork
    from tolnet.model.observability import RobustObservability

CLAIM = "observability"
FINITE = 100
"""The horizon that is claimed as well where the condition is not known to hold in the long run."""
_LONGEST = 1000
"""Instants of the longest window in which an unseen direction is looked for, where no window is given."""
REFUTED, UNDECIDED = 1, 3

Form = Literal["sharp", "classical"]
GramianForm = Annotated[
    Form | None, typer.Option("--form", help="Corrupted channels: the condition (11), or that without fading.")
]
Window = Annotated[
    int | None,
    typer.Option(
        "--window", min=1, metavar="L", help="Corrupted channels: instants in a window; the least that does."
    ),
]
Horizon = Annotated[
    int | None,
    typer.Option("--horizon", min=1, metavar="H", help="Corrupted channels: windows within k = 0..H; all without."),
]


def speaks_of_channels(
    network: SensorNetwork | CorruptedNetwork,
    problem: str,
    named: Sequence[str],
    exact: Mapping[str, object],
    corrupted: Mapping[str, object],
) -> bool:
    """Whether the certificate is to speak of corrupted channels; InputError where claims and problem do not fit.

    `named` are the claims that were asked for, `exact` and `corrupted` the options that make sense for one kind only.
    A file with corrupted channels that has a tolerance too is certified for exact ones where its claims are named.
    """
    from tolnet import model

    others = [claim for claim in named if claim != CLAIM]
    given = {
        key: [f"--{name}" for name, value in options.items() if value]
        for key, options in (("exact", exact), ("corrupted", corrupted))
    }
    if CLAIM in named and others:
        raise model.InputError(
            f"--claims names {CLAIM!r} and {others[0]!r}; the one is of corrupted channels, the other of exact ones"
        )
    if not isinstance(network, model.CorruptedNetwork):
        wrong = [f"--claims {CLAIM}"] if CLAIM in named else given["corrupted"]
        if wrong:
            raise model.InputError(
                f"has no corrupted channels, of which {wrong[0]} speaks; `tolnet observability` tests exact ones too",
                source=problem,
            )
        return False
    is_file = not given["corrupted"] and Path(problem).exists()
    if (others or given["exact"]) and is_file:
        moving = [letter for letter in "AQCR" if network.varying[letter].period != 1]
        if moving:
            asked = f"the claim {others[0]!r}" if others else given["exact"][0]
            raise model.InputError(
                f"varies with time ({', '.join(moving)}), and {asked} is of constant ones; {CLAIM!r} is of both",
                source=problem,
            )
        if exact["tolerance"] or model.load(problem).ambiguity is not None:
            return False
    if others:
        raise model.InputError(
            f"has corrupted channels; the claim for those is {CLAIM!r}, not {others[0]!r}", source=problem
        )
    if given["exact"]:
        raise model.InputError(f"has corrupted channels, for which {given['exact'][0]} means nothing", source=problem)
    return True


def certify_channels(
    network: CorruptedNetwork,
    problem: str,
    form: Form,
    window: int | None,
    horizon: int | None,
    outputs: Sequence[Path],
    console: Console,
) -> None:
    """Decide, write, tell. Exits with 1 where a claim is refuted, 3 where one is undecided."""
    from tolnet.certificates.document import SCHEMA, certificate_json
    from tolnet.certificates.observability import channels_data
    from tolnet.design.export import opening
    from tolnet.report.certificate_channels import channels_view

    pairs = list(_decide(network, form, window, horizon, console))
    verdicts = [verdict for verdict, _ in pairs]
    answers = {verdict.verdict for verdict in verdicts}
    status = next((word for word in ("refuted", "undecided") if word in answers), "ok")
    head = opening(SCHEMA, network, status)
    data = channels_data(network) if outputs or console.json else {}
    for path in outputs:
        with console.progress(f"writing {path}"):
            write(path, certificate_json(head, data, verdicts))
    if console.json:
        console.document(certificate_json(head, data, verdicts))
    console.show(*channels_view(pairs))
    console.wrote(list(outputs))
    quoted = shlex.quote(problem)
    given = repeated(form=None if form == "sharp" else form, window=window, horizon=horizon)
    console.suggest(
        f"tolnet check {shlex.quote(str(outputs[0]))} --problem {quoted}"
        if outputs
        else f"tolnet certify {quoted}{given} -o certificate.json",
        f"tolnet observability {quoted}{given}",
    )
    if "refuted" in answers:
        raise typer.Exit(REFUTED)
    if "undecided" in answers:
        raise typer.Exit(UNDECIDED)


def _decide(
    network: CorruptedNetwork, form: Form, window: int | None, horizon: int | None, console: Console
) -> Iterator[tuple[Verdict, RobustObservability]]:
    """The verdict, with what floating point found; where that is open for every k, one over a horizon as well."""
    limit = _limit(network) if form == "sharp" else None
    pair = _verdict(network, form, window, horizon, limit, console)
    yield pair
    if horizon is None and pair[0].verdict == "undecided":
        yield _verdict(network, form, window, max(FINITE, window or 1), limit, console)


def _verdict(
    network: CorruptedNetwork, form: Form, window: int | None, horizon: int | None, limit: Any, console: Console
) -> tuple[Verdict, RobustObservability]:
    from tolnet import analysis
    from tolnet.certificates.observability import Claimed, prove_observability, refute_observability, undecided
    from tolnet.certificates.verdicts import Refuted

    where = "every k" if horizon is None else f"k = 0..{horizon}"
    with console.progress(f"observability, {where}") as progress:
        found = analysis.robust_observability(network, form=form, window=window, horizon=horizon, progress=progress)
    claimed = Claimed(found.window, horizon, form)
    with console.progress(f"exact arithmetic, {where}"):
        if found.holds:
            return prove_observability(network, claimed, found.alpha, limit), found
        longest = network.n * (network.period or 1) if horizon is None else horizon + 1
        refuted = refute_observability(network, Claimed(window or min(longest, _LONGEST), horizon, form))
    if isinstance(refuted, Refuted):
        return refuted, found
    return undecided(claimed, f"{found.reason}. No witness: {refuted.reason}"), found


def _limit(network: CorruptedNetwork) -> Any:
    """The limit of the second moment, where it has one in every direction."""
    from tolnet.analysis.second_moment import second_moment_limit

    limit = second_moment_limit(network)
    return limit.Pi if limit.bounded else None


def channel_differences(data: Mapping[str, Any], network: CorruptedNetwork) -> list[str]:
    """Where the `data` of a certificate are other numbers than the problem's."""
    from tolnet.certificates.document import data_differences
    from tolnet.certificates.observability import channels_data

    own = channels_data(network)
    return data_differences(data, own, list(own))
