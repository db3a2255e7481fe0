"""What the stand-alone checker leaves open, decided with python-flint and NumPy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from tolnet.certificates import statements
from tolnet.certificates.deployed import Deployed
from tolnet.certificates.eigenpair import validate
from tolnet.certificates.exact_network import ExactNetwork
from tolnet.certificates.filter_claims import FILTER_CLAIMS, ExactFilters, verify
from tolnet.certificates.numerals import require_exact, vector
from tolnet.certificates.performance import verify_performance


def can_verify(claim: dict[str, Any]) -> bool:
    """Whether this is a claim about a filter, an eigenvalue outside the unit circle, or a performance without Q."""
    return claim["claim"] in FILTER_CLAIMS or _verifier(claim) is not None


def verify_claims(claims: Sequence[dict[str, Any]], deployed: Deployed) -> list[str | None]:
    """Why each of these entries of a certificate, of which `can_verify` is true, is not shown; None where it is."""
    filters, network = ExactFilters(deployed), ExactNetwork(deployed)
    found = []
    for claim in claims:
        verifier = _verifier(claim)
        try:
            for text in _numerals(claim):
                require_exact(text)
            found.append(verify(claim, filters) if verifier is None else verifier(network, claim))
        except (KeyError, ValueError, TypeError, AttributeError, OverflowError) as error:
            found.append(f"it is malformed: {error}")
    return found


_WORDS = ("claim", "node", "verdict", "statement", "reason", "method", "of", "block")
"""Keys whose texts are no numbers."""


def _numerals(thing: Any) -> Iterator[str]:
    """The texts of numbers in a claim."""
    if isinstance(thing, str):
        yield thing
    elif isinstance(thing, list):
        for part in thing:
            yield from _numerals(part)
    elif isinstance(thing, dict):
        for key, part in thing.items():
            if key not in _WORDS:
                yield from _numerals(part)


def _verifier(claim: dict[str, Any]) -> Callable[[ExactNetwork, dict[str, Any]], str | None] | None:
    witness, proof = claim.get("witness"), claim.get("proof")
    if claim["claim"] == "schur-stability" and isinstance(witness, dict) and witness.get("method") == "eigenpair":
        return _verify_eigenpair
    if claim["claim"] == "performance" and isinstance(proof, dict) and proof.get("Q", "") is None:
        return verify_performance
    return None


def _verify_eigenpair(network: ExactNetwork, claim: dict[str, Any]) -> str | None:
    """A refuted `schur-stability` by an eigenvalue: the approximate inverse is computed anew."""
    deployed, witness = network.deployed, claim["witness"]
    if claim["statement"] != statements.instability("network") or witness.get("of") != "network":
        return "the statement is not the one that the claim proves"
    if witness.keys() != {"of", "method", "eigenvalue", "vector"}:
        return "its keys are not those of such a witness"
    real, imaginary = vector(witness["eigenvalue"]).tolist()
    parts = vector(witness["vector"]).reshape(2, deployed.N * deployed.n)
    found = validate(deployed, complex(real, imaginary), parts[0] + 1j * parts[1])
    return found if isinstance(found, str) else None
