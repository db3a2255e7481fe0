"""What `tolnet certify` speaks of: the numbers that are deployed, and where they came from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from tolnet.cli.console import Console, complain
from tolnet.cli.options import choose_ambiguity
from tolnet.cli.solving import solve_table

if TYPE_CHECKING:
    from tolnet.certificates.deployed import Deployed
    from tolnet.certificates.verdicts import Verdict
    from tolnet.cli.evidence import Evidence
    from tolnet.design.export.deployment import Deployment
    from tolnet.model import Ambiguity, SensorNetwork, SteadyState

NO_ANSWER = 4


@dataclass(frozen=True, eq=False)
class Subject:
    """What is certified: the deployed numbers, and the steady states in floating point that they came from."""

    network: SensorNetwork
    ambiguity: Ambiguity
    central: SteadyState
    local: SteadyState
    deployed: Deployed
    evidence: Evidence

    def opening(self, verdicts: Sequence[Verdict]) -> dict:
        """The keys that open the document."""
        from tolnet.certificates.document import SCHEMA
        from tolnet.design.export import opening

        answers = {verdict.verdict for verdict in verdicts}
        status = next((word for word in ("refuted", "undecided") if word in answers), "ok")
        return opening(SCHEMA, self.network, status, self.ambiguity)


def prepare(
    network: SensorNetwork,
    tolerance: float | None,
    convention: Literal["gamma", "nats"] | None,
    diffusion: str | None,
    table: Path | None,
    precision: str,
    console: Console,
) -> Subject:
    """The numbers that are deployed: the table's own, or those that the problem leads to."""
    import numpy as np

    from tolnet import analysis
    from tolnet.certificates.document import SCHEMA, certificate_json
    from tolnet.cli.evidence import Evidence
    from tolnet.design.diffusion import check_rule, diffusion_matrix
    from tolnet.design.export import Reasons, opening
    from tolnet.design.export.deployed import read_deployed
    from tolnet.design.export.deployment import Deployment
    from tolnet.model import Complaint, InputError, UnsupportedError

    stored = None if table is None else read_deployed(table)
    if stored is not None and (tolerance is not None or diffusion is not None):
        raise InputError("--table holds the tolerance and the weights; --tolerance and --diffusion were not expected")
    if stored is not None:
        tolerance, convention = stored.record.tolerance, stored.record.convention
    ambiguity = choose_ambiguity(network, tolerance, convention, None)
    if ambiguity.tau != 0:
        raise UnsupportedError(f"certificates are defined for tau = 0 only, and ambiguity.tau is {ambiguity.tau:g}")
    try:
        rule = diffusion or network.diffusion
        if isinstance(rule, str):
            check_rule(network, rule)
    except InputError as error:
        raise InputError([Complaint("--diffusion", each.message) for each in error.complaints]) from None
    if stored is None:
        solved = solve_table(network, ambiguity, console)
        if not solved.local.exists.all():
            complain(Reasons(solved).offenders(), "no answer")
            status = str(solved.local.status[int(np.argmin(solved.local.exists))])
            console.document(certificate_json(opening(SCHEMA, network, status, ambiguity), {}, []))
            raise typer.Exit(NO_ANSWER)
        central, local = solved.central, solved.local
        deployment = Deployment.of(solved, diffusion_matrix(network, diffusion, solved))
    else:
        if len(stored.tolerances) != network.N:
            raise InputError(
                f"is a table of {len(stored.tolerances)} nodes; {network.N} were expected", source=str(table)
            )
        with console.progress("steady states") as progress:
            central = analysis.solve_steady_state(network, ambiguity)
            local = analysis.solve_local_steady_states(network, stored.tolerances, progress=progress)
        deployment = stored.deployment
    if precision == "float32":
        deployment = deployment.rounded(np.float32)
    try:
        deployed = deployed_of(network, central, deployment)
    except InputError as error:
        raise InputError(error.complaints, source=str(table)) from None
    return Subject(network, ambiguity, central, local, deployed, Evidence(deployed))


def deployed_of(network: SensorNetwork, central: SteadyState, deployment: Deployment) -> Deployed:
    """What is certified of a deployment: with the least favourable model, where there is one."""
    import numpy as np

    from tolnet import analysis
    from tolnet.certificates.deployed import Centre, Deployed
    from tolnet.design.export.deployment import central_gain_columns
    from tolnet.model import InputError
    from tolnet.model.worst_case import psd_factor

    worst = analysis.least_favourable_model(network, central)
    centre = None
    if worst.exists:
        Y = psd_factor(worst.tilt)
        centre = Centre(central_gain_columns(network, central), Y[:, Y.any(axis=0)])
    if not (np.isfinite(deployment.gains).all() and np.isfinite(deployment.weights).all()):
        raise InputError("holds gains or weights that are no finite numbers: some node has no filter")
    d = deployment
    return Deployed(network, d.offsets, d.neighbours, d.weights, d.columns, d.gains, centre)
