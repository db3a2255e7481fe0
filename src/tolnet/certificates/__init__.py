"""Prove: stability, convergence, observability and enclosures, in exact and in ball arithmetic; and the checker."""

from tolnet.certificates.deployed import Centre, Deployed
from tolnet.certificates.document import certificate_json
from tolnet.certificates.exact_network import ExactNetwork
from tolnet.certificates.performance import prove_performance
from tolnet.certificates.stability import Candidate, prove_stability, refute_stability
from tolnet.certificates.stated import stated_deployment
from tolnet.certificates.switching import Scenario, prove_link_losses, prove_scenarios
from tolnet.certificates.verdicts import Proved, Refuted, Undecided, Verdict

__all__ = [
    "Candidate",
    "Centre",
    "Deployed",
    "ExactNetwork",
    "Proved",
    "Refuted",
    "Scenario",
    "Undecided",
    "Verdict",
    "certificate_json",
    "prove_link_losses",
    "prove_performance",
    "prove_scenarios",
    "prove_stability",
    "refute_stability",
    "stated_deployment",
]
