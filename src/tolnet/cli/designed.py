"""Designed weights (and gains) handed to the room of certificates, which proves them stable or declines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tolnet.analysis.stability_candidates import full_candidate
from tolnet.certificates.document import SCHEMA, certificate_json
from tolnet.certificates.stability import Candidate, prove_stability
from tolnet.certificates.verdicts import Undecided, Verdict
from tolnet.cli.console import Console
from tolnet.cli.documents import write
from tolnet.cli.evidence import Evidence
from tolnet.cli.subject import deployed_of
from tolnet.design.export import opening
from tolnet.design.weights.gains import deployment_of
from tolnet.model import Ambiguity, Diffusion

if TYPE_CHECKING:
    from tolnet.certificates.deployed import Deployed


def write_certificate(found: Diffusion, ambiguity: Ambiguity, path: Path, console: Console) -> list[Verdict]:
    """Write the certificate of designed weights: stability, and the decay rate where the design has X_k for it.

    It speaks of the whole F, or of the network's block alone where the least favourable block, which no W changes,
    decays more slowly than the design.
    """
    deployed = deployed_of(found.table.network, found.table.central, deployment_of(found))
    with console.progress("certificate") as progress:
        if found.certificate is not None and not _centre_keeps_up(deployed, found.certificate.rate):
            deployed = replace(deployed, centre=None)
        evidence = Evidence(deployed)
        verdicts: list[Verdict] = [evidence.stability(progress)]
        if found.certificate is not None:
            verdicts.append(_decay(found, evidence))
        answers = {verdict.verdict for verdict in verdicts}
        status = next((word for word in ("refuted", "undecided") if word in answers), "ok")
        heading = opening(SCHEMA, found.table.network, status, ambiguity)
        write(path, certificate_json(heading, deployed.data(), verdicts))
    return verdicts


def _centre_keeps_up(deployed: Deployed, r: float) -> bool:
    """Whether the least favourable block, which W cannot change, decays at least as fast as the design."""
    loop = Evidence(deployed).centre_loop
    return loop is not None and bool(np.abs(np.linalg.eigvals(loop)).max() < r)


def _decay(found: Diffusion, evidence: Evidence) -> Verdict:
    """The rate that the X_k of the design stand for; a slower one is searched for where these do not prove theirs."""
    assert found.certificate is not None
    r = found.certificate.rate
    centre = None if evidence.centre_loop is None else full_candidate(evidence.centre_loop, r)
    if evidence.deployed.centre is None or centre is not None:
        verdict = prove_stability(evidence.exact, Candidate("primal", found.certificate.X, centre), rate=r)
        if not isinstance(verdict, Undecided):
            return verdict
    return evidence.decay_rate(None)
