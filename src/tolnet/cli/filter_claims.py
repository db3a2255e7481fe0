"""The claims about single filters, node by node: prepared in floating point, decided in balls, on all cores."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray

from tolnet.certificates import attraction, bracket, convergence, fixed_point, local_tolerance, statements
from tolnet.certificates.balls import NotProved
from tolnet.certificates.exact_filter import Covariance, ExactFilter, Sensor
from tolnet.certificates.verdicts import Node, Proved, Refuted, Undecided, Verdict

if TYPE_CHECKING:
    from collections.abc import Callable

    from tolnet.certificates.deployed import Deployed

    Progress = Callable[[int, int], None]

_SEQUENTIAL_UP_TO = 4
"""Filters that are decided here and now, since starting processes would take longer."""


@dataclass(frozen=True, eq=False)
class FilterCase:
    """One filter: the exact problem, the steady state in floating point, the stated gain, where it starts."""

    node: Node
    exact: ExactFilter
    P: ndarray
    theta: float
    gain: Sequence[ndarray]
    start: ndarray
    centre: tuple[ExactFilter, ndarray, float] | None
    """For the node's tolerance: the centre, and its steady state in floating point."""


def exact_sensors(deployed: Deployed) -> list[Sensor]:
    """Every sensor of the network as exact numbers; relays are left out where filters are made."""
    network, sensors = deployed.network, []
    for l in range(deployed.N):
        C, R = network.sensor(l)
        by_factor = network.factors is not None and bool(network.factors.filled[l])
        assert network.factors is not None or not by_factor
        noise = Covariance(network.factors.block(l), True) if by_factor and network.factors else Covariance(R)
        sensors.append(Sensor(C, noise))
    return sensors


def exact_filter(deployed: Deployed, sensors: Sequence[Sensor], nodes: Sequence[int], c: float) -> ExactFilter:
    """The filter that hears these sensors, at a tolerance on the gamma scale."""
    network = deployed.network
    process = Covariance(network.Q) if network.B is None else Covariance(network.B, True)
    return ExactFilter(network.A, process, tuple(sensors[l] for l in nodes if len(sensors[l].C)), c)


def stated_gain(deployed: Deployed, node: Node) -> list[ndarray]:
    """The stated gain of a node or of the centre, a matrix per sensor that is no relay."""
    rows = deployed.network.rows
    if node == "centre":
        assert deployed.centre is not None
        parts = [deployed.centre.gain[rows[l] : rows[l + 1]].T for l in range(deployed.N)]
    else:
        entries = range(*deployed.offsets[[int(node), int(node) + 1]].tolist())
        parts = [deployed.gains[deployed.columns[e] : deployed.columns[e + 1]].T for e in entries]
    return [part for part in parts if part.shape[1]]


def heard_by(deployed: Deployed, node: Node) -> list[int]:
    """The sensors that a filter hears."""
    if node == "centre":
        return list(range(deployed.N))
    return deployed.neighbours[slice(*deployed.offsets[[int(node), int(node) + 1]].tolist())].tolist()


def decide(case: FilterCase, claims: Sequence[str]) -> list[Verdict]:
    """The verdicts on one filter."""
    box = fixed_point.find_box(case.exact, case.P, case.theta)
    return [_decide(claim, case, box) for claim in claims if claim != "tolerance" or _has_tolerance(case)]


def _has_tolerance(case: FilterCase) -> bool:
    return case.node != "centre" and case.centre is not None


def _decide(claim: str, case: FilterCase, box: fixed_point.Box | NotProved) -> Verdict:
    node, exact = case.node, case.exact
    match claim:
        case "tolerance":
            assert case.centre is not None
            centre, P, theta = case.centre
            at = fixed_point.find_box(centre, P, theta)
            keys = at if isinstance(at, NotProved) else local_tolerance.prove_tolerance(centre, at, exact.sensors)
            return _verdict(claim, node, centre.c, keys)
        case "convergence-all":
            return _verdict(claim, node, exact.c, bracket.prove_convergence_all(exact, case.P, case.theta))
        case _ if isinstance(box, NotProved):
            return _verdict(claim, node, exact.c, box)
        case "steady-state":
            return _verdict(claim, node, exact.c, fixed_point.prove_steady_state(exact, box, case.gain))
        case "convergence":
            return _verdict(claim, node, exact.c, convergence.prove_convergence(exact, box, case.start))
    keys = attraction.prove_attraction(exact, box)
    if isinstance(keys, NotProved):
        against = attraction.refute_attraction(exact, box)
        keys = keys if isinstance(against, NotProved) else against
    return _verdict(claim, node, exact.c, keys)


def _verdict(claim: str, node: Node, c: float, keys: Mapping[str, Any] | NotProved) -> Verdict:
    if isinstance(keys, NotProved):
        statement = f"{claim} of {statements.who(node)} at the tolerance {c!r}"
        return Undecided(claim, statement, keys.reason, node=node)
    rest = {key: value for key, value in keys.items() if key not in ("proof", "witness")}
    verdict = "proved" if "proof" in keys else "refuted"
    sentence = statements.of_filter_claim({**keys, "claim": claim, "node": node, "verdict": verdict})
    if verdict == "proved":
        return Proved(claim, sentence, keys["proof"], keys=rest, node=node)
    return Refuted(claim, sentence, keys["witness"], keys=rest, node=node)


def decide_all(
    cases: Sequence[FilterCase], claims: Sequence[str], progress: Progress | None = None
) -> Iterator[Verdict]:
    """The verdicts on many filters, on all cores where there are many; claim by claim in the order of `claims`."""
    found: list[list[Verdict]] = []
    for verdicts in _run(cases, claims):
        found.append(verdicts)
        if progress is not None:
            progress(len(found), len(cases))
    for claim in claims:
        yield from (verdict for verdicts in found for verdict in verdicts if verdict.claim == claim)


def _run(cases: Sequence[FilterCase], claims: Sequence[str]) -> Iterator[list[Verdict]]:
    if len(cases) <= _SEQUENTIAL_UP_TO:
        return (decide(case, claims) for case in cases)
    import joblib

    parallel: Any = joblib.Parallel(n_jobs=-1, return_as="generator", batch_size=1 if len(cases) < 100 else 8)
    return parallel(joblib.delayed(decide)(case, claims) for case in cases)


def cases_of(
    deployed: Deployed,
    nodes: Sequence[Node],
    P: Mapping[Node, ndarray],
    theta: Mapping[Node, float],
    c: Mapping[Node, float],
) -> list[FilterCase]:
    """The cases of some filters, from their steady states in floating point."""
    sensors = exact_sensors(deployed)
    centre = None
    if "centre" in P:
        whole = exact_filter(deployed, sensors, heard_by(deployed, "centre"), c["centre"])
        centre = whole, P["centre"], theta["centre"]
    return [
        FilterCase(
            node,
            exact_filter(deployed, sensors, heard_by(deployed, node), c[node]),
            P[node],
            theta[node],
            stated_gain(deployed, node) if node != "centre" or deployed.centre is not None else [],
            np.asarray(deployed.network.initial_covariance),
            centre,
        )
        for node in nodes
    ]
