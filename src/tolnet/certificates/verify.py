"""What the stand-alone checker leaves open, decided with python-flint and NumPy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray

from tolnet.certificates import balls, filter_claims, fixed_point, statements
from tolnet.certificates.balls import NotProved
from tolnet.certificates.clock import OutOfTime, until
from tolnet.certificates.deployed import Deployed
from tolnet.certificates.eigenpair import MOST, validate
from tolnet.certificates.exact_network import ExactNetwork
from tolnet.certificates.filter_claims import FILTER_CLAIMS, ExactFilters
from tolnet.certificates.fixed_point import MOST_STATES, Box
from tolnet.certificates.numerals import require_exact, vector
from tolnet.certificates.performance import verify_performance
from tolnet.certificates.verdicts import Node


@dataclass(frozen=True)
class NotChecked:
    """The claim may well be true, but is not decided here."""

    reason: str


Answer = str | NotChecked | None
"""Why a claim is not shown; None where it is."""


def can_verify(claim: dict[str, Any]) -> bool:
    """Whether this is a claim about a filter, an eigenvalue outside the unit circle, or a performance without Q."""
    return claim["claim"] in FILTER_CLAIMS or _verifier(claim) is not None


def misshapen(claim: dict[str, Any]) -> str | None:
    """What in the form of a claim of which `can_verify` is true is wrong; None where nothing is.

    Nothing that passes is nested deeply or of a type that no claim has.
    """
    if claim["claim"] in FILTER_CLAIMS:
        return filter_claims.misshapen(claim)
    if _verifier(claim) is verify_performance:
        proof = claim["proof"]
        texts = [claim.get("centre"), claim.get("network"), proof.get("delta"), *_listed(claim.get("nodes"))]
        keys, own, lists = (
            {"Q", "Y", "delta"},
            {"nodes", "centre", "network", "proof"},
            [claim.get("nodes"), proof.get("Y")],
        )
        texts += _listed(proof.get("Y"))
    else:
        proof = claim["witness"]
        keys, own, lists = {"of", "method", "eigenvalue", "vector"}, {"block", "witness"}, []
        texts = [claim.get("block"), *proof.values()]
    common = {"claim", "verdict", "statement", "margin", "reason"}
    if claim.keys() != common | own or proof.keys() != keys:
        return "its keys are not those of such a claim"
    if not all(isinstance(thing, str) for thing in [*texts, claim["statement"]]):
        return "its numbers are not written as texts"
    if not all(isinstance(thing, list) for thing in lists):
        return "its numbers are not in lists"
    return None if claim["margin"] is None and claim["reason"] is None else "margin and reason: expected null"


def _listed(thing: Any) -> list[Any]:
    return thing if isinstance(thing, list) else []


def verify_claims(claims: Sequence[dict[str, Any]], deployed: Deployed, end: float = np.inf) -> list[Answer]:
    """What is to be said of each of these entries of a certificate, of which `can_verify` is true.

    At `end`, an instant of `time.monotonic`, what is not decided yet is given up.
    """
    filters, network = ExactFilters(deployed), ExactNetwork(deployed)
    return [_verified(claim, filters, network, end) for claim in claims]


def _verified(claim: dict[str, Any], filters: ExactFilters, network: ExactNetwork, end: float) -> Answer:
    verifier, longest = _verifier(claim), _longest_text(network.deployed)
    if (complaint := misshapen(claim)) is not None:
        return complaint
    try:
        for text in _numerals(claim):
            if len(text) > longest:
                return "it has more numbers than such a claim can have"
            require_exact(text)
        # what overflows becomes infinite or NaN, and every comparison with that declines
        with until(end), np.errstate(all="ignore"):
            return filter_claims.verify(claim, filters) if verifier is None else verifier(network, claim)
    except OutOfTime as late:
        return NotChecked(str(late))
    except (KeyError, ValueError, TypeError, AttributeError, ArithmeticError) as error:
        return f"it is malformed: {error}"


def gain_distances(stated: Sequence[tuple[Node, float, Box]], deployed: Deployed) -> list[float | None]:
    """How far the gains of these filters are from those of the steady states in their boxes, at their tolerances.

    In units of states and outputs, of which exact entries are at most 1; None where that was not enclosed.
    """
    filters, found = ExactFilters(deployed), list[float | None]()
    for node, c, box in stated:
        try:
            found.append(fixed_point.gain_distance(filters.filter(node, c), box, filters.gain(node)))
        except (ValueError, ArithmeticError):
            found.append(None)
    return found


def exact_centre(c: float, box: Box, deployed: Deployed) -> tuple[ndarray, ndarray, float] | None:
    """The doubles nearest to P, V = (P^-1 - theta I)^-1 and theta of the centre's steady state in the box, at c."""
    try:
        found = fixed_point.enclose(ExactFilters(deployed).filter("centre", c), box)
        if isinstance(found, NotProved):
            return None
        with balls.working_precision(found.bits):
            at = found.equations.at(found.P, found.theta)
            V = found.P if at.H is None else balls.symmetric_part(at.H * found.P)
            return balls.midpoints(found.P), balls.midpoints(V), float(found.theta.mid())
    except (ValueError, ArithmeticError):
        return None


def _longest_text(deployed: Deployed) -> int:
    """Characters of the longest text that a claim can have: of the derivative's Y, or of an eigenvector."""
    n = min(deployed.n, MOST_STATES)
    d = n * (n + 1) // 2
    return 25 * max(d * (d + 1) // 2, 2 * deployed.N * deployed.n, deployed.n**2)


_WORDS = ("claim", "node", "verdict", "statement", "reason", "method", "of", "block")
"""Keys whose texts are no numbers."""


def _numerals(thing: Any) -> Iterator[str]:
    """The texts of numbers in a claim."""
    if isinstance(thing, str):
        yield thing
    elif isinstance(thing, list):
        for part in thing:
            yield from _numerals(part)
    elif isinstance(thing, Mapping):
        for key, part in thing.items():
            if key not in _WORDS:
                yield from _numerals(part)


def _verifier(claim: dict[str, Any]) -> Callable[[ExactNetwork, dict[str, Any]], Answer] | None:
    witness, proof = claim.get("witness"), claim.get("proof")
    if claim["claim"] == "schur-stability" and isinstance(witness, dict) and witness.get("method") == "eigenpair":
        return _verify_eigenpair
    if claim["claim"] == "performance" and isinstance(proof, dict) and proof.get("Q", "") is None:
        return verify_performance
    return None


def _verify_eigenpair(network: ExactNetwork, claim: dict[str, Any]) -> Answer:
    """A refuted `schur-stability` by an eigenvalue: the approximate inverse is computed anew."""
    deployed, witness = network.deployed, claim["witness"]
    if claim["statement"] != statements.instability("network") or witness["of"] != "network":
        return "the statement is not the one that the claim proves"
    if claim["verdict"] != "refuted" or claim["block"] not in statements.BLOCKS:
        return "no such claim has this verdict, or this block"
    if network.unmixed:
        return network.unmixed
    if deployed.N * deployed.n > MOST:
        return NotChecked(
            f"the network has {deployed.N * deployed.n} states; up to {MOST} an eigenvalue is validated"
        )
    real, imaginary = vector(witness["eigenvalue"]).tolist()
    parts = vector(witness["vector"]).reshape(2, deployed.N * deployed.n)
    found = validate(deployed, complex(real, imaginary), parts[0] + 1j * parts[1])
    return found if isinstance(found, str) else None
