"""No altered certificate is accepted, unless it is still true; the truth is decided apart."""

from __future__ import annotations

import random

import pytest
from tests.certificates.alterations import at_random, designed
from tests.certificates.examples import certificate, certificates
from tests.reference.certificate_truth import is_true
from tests.reference.certificates import Document
from tests.study import sized

from tolnet.certificates.check import Finding, Refused, check

RANDOM = sized(1_000, 10_000)


def findings(document: Document) -> list[Finding]:
    """What the checker says; nothing where it refuses the file."""
    try:
        return check(document)
    except Refused:
        return []


def is_accepted(document: Document) -> bool:
    """Whether some claim is valid; if one is, it must be true."""
    accepted = False
    for i, finding in enumerate(findings(document)):
        claim = document["claims"][i]
        assert finding.result in ("valid", "invalid", "undecided", "not checked here")
        if finding.result == "valid":
            accepted = True
            assert is_true(document["data"], claim), finding
    return accepted


# What no certificate survives, whatever the numbers say.
NEVER = (
    *("no number", "infinite", "decimal", "two spaces", "a number too few", "a number too many", "unknown key"),
    *(
        "no key",
        "verdict",
        "the claim",
        "statement",
        "a reason",
        "method",
        "columns",
        "zero in ('claims', 0, 'proof'",
    ),
)


@pytest.mark.parametrize("name", certificates())
def test_designed_alterations(name: str) -> None:
    original = certificate(name)
    refused = 0
    for what, altered in designed(original):
        if altered == original:
            continue
        accepted = is_accepted(altered)
        refused += not accepted
        assert not accepted or not what.startswith(NEVER), what
    assert refused >= 150


@pytest.mark.parametrize("batch", range(RANDOM // 100))
def test_random_alterations(batch: int) -> None:
    rng = random.Random(batch)
    names = sorted(certificates())
    refused = 0
    for _ in range(100):
        original = certificate(rng.choice(names))
        refused += not is_accepted(at_random(original, rng))
    assert refused > 25  # labels and slack may be altered and leave all claims true; most alterations do not
