"""What the stand-alone checker leaves open, decided with python-flint and NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tolnet.certificates import statements
from tolnet.certificates.deployed import Deployed
from tolnet.certificates.eigenpair import validate
from tolnet.certificates.filter_claims import FILTER_CLAIMS, ExactFilters, verify
from tolnet.certificates.numerals import vector


def can_verify(claim: dict[str, Any]) -> bool:
    """Whether this is a claim about a filter, or an eigenvalue outside the unit circle."""
    witness = claim.get("witness")
    eigenpair = isinstance(witness, dict) and witness.get("method") == "eigenpair"
    return claim["claim"] in FILTER_CLAIMS or (claim["claim"] == "schur-stability" and eigenpair)


def verify_claims(claims: Sequence[dict[str, Any]], deployed: Deployed) -> list[str | None]:
    """Why each of these entries of a certificate, of which `can_verify` is true, is not shown; None where it is."""
    filters = ExactFilters(deployed)
    return [
        verify(claim, filters) if claim["claim"] in FILTER_CLAIMS else _verify_eigenpair(claim, deployed)
        for claim in claims
    ]


def _verify_eigenpair(claim: dict[str, Any], deployed: Deployed) -> str | None:
    """A refuted `schur-stability` by an eigenvalue: the approximate inverse is computed anew."""
    if claim["statement"] != statements.instability("network") or claim["witness"].get("of") != "network":
        return "the statement is not the one that the claim proves"
    witness = claim["witness"]
    try:
        real, imaginary = vector(witness["eigenvalue"]).tolist()
        parts = vector(witness["vector"]).reshape(2, deployed.N * deployed.n)
    except (KeyError, ValueError, AttributeError) as error:
        return f"it is malformed: {error}"
    found = validate(deployed, complex(real, imaginary), parts[0] + 1j * parts[1])
    return found if isinstance(found, str) else None
