"""The claims about single filters: which exact problem each speaks of, and the door to its proof and verification."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import attraction, bracket, convergence, fixed_point, local_tolerance, statements
from tolnet.certificates.balls import NotProved
from tolnet.certificates.deployed import Deployed
from tolnet.certificates.exact_filter import Covariance, ExactFilter, Sensor
from tolnet.certificates.fixed_point import Box, Enclosure
from tolnet.certificates.verdicts import Node, Proved, Refuted, Undecided, Verdict

FILTER_CLAIMS = ("steady-state", "attraction", "tolerance", "convergence", "convergence-all")


@dataclass(frozen=True, eq=False)
class SteadyStates:
    """Filters, their tolerances on the gamma scale, and their steady states in floating point."""

    nodes: Sequence[Node]
    c: Sequence[float]
    P: Sequence[Float[ndarray, "n n"]]
    theta: Sequence[float]
    centre: tuple[float, Box] | None
    """For the tolerances of nodes: that of the network, and the box around the centre's steady state."""

    def parts(self, size: int) -> list[SteadyStates]:
        """So many filters at a time."""
        starts = range(0, len(self.nodes), size)
        return [
            SteadyStates(
                self.nodes[i : i + size],
                self.c[i : i + size],
                self.P[i : i + size],
                self.theta[i : i + size],
                self.centre,
            )
            for i in starts
        ]


class ExactFilters:
    """The filters of a deployment as exact problems. A sensor that several nodes hear is prepared once."""

    def __init__(self, deployed: Deployed) -> None:
        self.deployed = deployed
        network = deployed.network
        factors = network.factors
        self.process = Covariance(network.Q) if network.B is None else Covariance(network.B, True)
        self.sensors = []
        for l in range(deployed.N):
            C, R = network.sensor(l)
            by_factor = factors is not None and bool(factors.filled[l])
            noise = Covariance(factors.block(l), True) if factors is not None and by_factor else Covariance(R)
            self.sensors.append(Sensor(C, noise))

    def filter(self, node: Node, c: float) -> ExactFilter:
        """The filter of a node, or of the centre, at a tolerance on the gamma scale. Relays have no sensor."""
        heard = (self.sensors[l] for l in self._heard(node))
        return ExactFilter(self.deployed.network.A, self.process, tuple(s for s in heard if len(s.C)), c)

    def gain(self, node: Node) -> list[Float[ndarray, "n _p"]]:
        """The stated gain, a matrix per sensor that is no relay; none where no centre is stated."""
        deployed, rows = self.deployed, self.deployed.network.rows
        if node == "centre":
            if deployed.centre is None:
                return []
            parts = [deployed.centre.gain[rows[l] : rows[l + 1]].T for l in range(deployed.N)]
        else:
            entries = range(*deployed.offsets[[int(node), int(node) + 1]].tolist())
            parts = [deployed.gains[deployed.columns[e] : deployed.columns[e + 1]].T for e in entries]
        return [part for part in parts if part.shape[1]]

    def _heard(self, node: Node) -> list[int]:
        if node == "centre":
            return list(range(self.deployed.N))
        first, last = self.deployed.offsets[[int(node), int(node) + 1]].tolist()
        return self.deployed.neighbours[first:last].tolist()


def find_centre(deployed: Deployed, c: float, P: Float[ndarray, "n n"], theta: float) -> tuple[float, Box] | None:
    """The tolerance of the network and the box around the centre's steady state; None where none was found."""
    box = fixed_point.find_box(ExactFilters(deployed).filter("centre", c), P, theta)
    return None if isinstance(box, NotProved) else (c, box)


def decide(states: SteadyStates, deployed: Deployed, claims: Sequence[str]) -> list[Verdict]:
    """The verdicts on some filters: proved, refuted or undecided, for each of these claims that a filter can have."""
    filters = ExactFilters(deployed)
    centre: Enclosure | NotProved = NotProved("the steady state of the centre was not enclosed")
    if states.centre is not None and "tolerance" in claims:
        centre = fixed_point.enclose(filters.filter("centre", states.centre[0]), states.centre[1])
    found: list[Verdict] = []
    for node, c, P, theta in zip(states.nodes, states.c, states.P, states.theta, strict=True):
        exact = filters.filter(node, c)
        box = fixed_point.find_box(exact, P, theta)
        for claim in claims:
            if claim == "tolerance" and node != "centre":
                keys = _tolerance(filters, exact, states.centre, centre)
            elif claim != "tolerance":
                keys = _keys(claim, exact, box, filters, node)
            else:
                continue
            found.append(
                _verdict(claim, node, c if claim != "tolerance" or not states.centre else states.centre[0], keys)
            )
    return found


def _keys(
    claim: str, exact: ExactFilter, box: Box | NotProved, filters: ExactFilters, node: Node
) -> dict[str, Any] | NotProved:
    """The keys of a claim that was proved or refuted."""
    if claim == "convergence-all":
        return bracket.prove_convergence_for_all(exact)
    if isinstance(box, NotProved):
        return box
    if claim == "steady-state":
        return fixed_point.prove_steady_state(exact, box, filters.gain(node))
    if claim == "convergence":
        start = np.asarray(filters.deployed.network.initial_covariance)
        return convergence.prove_convergence(exact, box, start)
    proved = attraction.prove_attraction(exact, box)
    if not isinstance(proved, NotProved):
        return proved
    refuted = attraction.refute_attraction(exact, box)
    return proved if isinstance(refuted, NotProved) else refuted


def _tolerance(
    filters: ExactFilters, exact: ExactFilter, centre: tuple[float, Box] | None, enclosed: Enclosure | NotProved
) -> dict[str, Any] | NotProved:
    if centre is None or isinstance(enclosed, NotProved):
        return NotProved("the steady state of the centre was not enclosed")
    c, box = centre
    return local_tolerance.prove_tolerance(filters.filter("centre", c), box, exact.sensors, enclosed)


def _verdict(claim: str, node: Node, c: float, keys: Mapping[str, Any] | NotProved) -> Verdict:
    if isinstance(keys, NotProved):
        statement = f"The claim {claim} of {statements.who(node)} at the tolerance {c!r}."
        return Undecided(claim, statement, keys.reason, node=node)
    rest = {key: value for key, value in keys.items() if key not in ("proof", "witness")}
    verdict = "proved" if "proof" in keys else "refuted"
    sentence = statements.of_filter_claim({**keys, "claim": claim, "node": node, "verdict": verdict})
    if verdict == "proved":
        return Proved(claim, sentence, keys["proof"], keys=rest, node=node)
    return Refuted(claim, sentence, keys["witness"], keys=rest, node=node)


_VERIFIERS: dict[tuple[str, str], Callable[[ExactFilter, dict[str, Any]], str | None]] = {
    ("attraction", "proved"): attraction.verify_attraction,
    ("attraction", "refuted"): attraction.verify_refuted_attraction,
    ("convergence", "proved"): convergence.verify_convergence,
    ("convergence-all", "proved"): bracket.verify_convergence_for_all,
}


_OPENING = {"claim", "node", "verdict", "statement", "margin", "reason", "c"}
_REGION = {"box", "factor", "Y", "rate", "radius", "steps"}
_KEYS: dict[tuple[str, str], tuple[set[str], str, set[str]]] = {
    ("steady-state", "proved"): ({"gain_error"}, "proof", {"box"}),
    ("attraction", "proved"): ({"rate"}, "proof", {"box", "Y"}),
    ("attraction", "refuted"): (set(), "witness", {"box", "X", "v"}),
    ("tolerance", "proved"): ({"interval"}, "proof", {"box"}),
    ("convergence", "proved"): ({"start"}, "proof", _REGION | {"bits"}),
    ("convergence-all", "proved"): (set(), "proof", _REGION | {"lower", "upper"}),
}
"""A claim's own keys, whether it has a proof or a witness, and the keys of that."""
_BRACKET = {"lower", "upper", "blocks"}
"""Which a proof of `convergence` of a slow filter has besides: all of them or none."""
_WHOLE = {"steps", "bits"}
_WHOLES = {"blocks"}


def misshapen(claim: Mapping[str, Any]) -> str | None:
    """What in the form of a claim about a filter is not as docs/certificate.md has it; None where nothing is.

    Afterwards every value is a text, a whole number (`blocks`: a list of such) or null, but for the proof or the
    witness and the box in it.
    """
    name, verdict = claim.get("claim"), claim.get("verdict")
    if not (isinstance(name, str) and isinstance(verdict, str) and (name, verdict) in _KEYS):
        return "there is no such claim, or none with this verdict"
    own, evidence, held = _KEYS[name, verdict]
    if claim.keys() != _OPENING | own | {evidence}:
        return "its keys are not those of such a claim"
    given = claim[evidence]
    if name == "convergence" and isinstance(given, dict) and given.keys() & _BRACKET:
        held = held | _BRACKET
    if not isinstance(given, dict) or given.keys() != held:
        return f"the keys of its {evidence} are not those of such a claim"
    box = given["box"]
    if not isinstance(box, dict) or box.keys() != {"P", "theta", "radius"}:
        return "the keys of its box are not those of a box"
    if any(type(given[key]) is not int for key in held & _WHOLE):
        return "its numbers of steps and bits are no whole numbers"
    if not all(isinstance(given[key], list) and all(type(k) is int for k in given[key]) for key in held & _WHOLES):
        return "its blocks are no list of whole numbers"
    texts = [*(given[key] for key in held - _WHOLE - _WHOLES - {"box"}), *box.values(), claim["statement"]]
    if not all(isinstance(text, str) for text in [*texts, claim["c"], *(claim[key] for key in own)]):
        return "its numbers are not written as texts"
    if claim["margin"] is not None or claim["reason"] is not None:
        return "margin and reason: expected null"
    return None


def verify(claim: dict[str, Any], filters: ExactFilters) -> str | None:
    """Why a claim about a filter does not hold as far as can be shown, in balls; None where it does.

    `claim` is an entry of a certificate. Whatever is malformed is a reason too.
    """
    if (complaint := misshapen(claim)) is not None:
        return complaint
    try:
        node = claim["node"]
        whole = type(node) is int and 0 <= node < filters.deployed.N
        if not (whole or node == "centre"):
            return "it speaks of no node of the network"
        if claim["statement"] != statements.of_filter_claim(claim):
            return "the statement is not the one that the claim proves"
        name, c = claim["claim"], float.fromhex(claim["c"])
        if name == "tolerance":
            if node == "centre":
                return "the centre has no local tolerance"
            sensors = filters.filter(node, c).sensors
            return local_tolerance.verify_tolerance(filters.filter("centre", c), claim, sensors)
        exact = filters.filter(node, c)
        if name == "steady-state":
            return fixed_point.verify_steady_state(exact, claim, filters.gain(node))
        return _VERIFIERS[name, claim["verdict"]](exact, claim)
    except (KeyError, ValueError, TypeError, AttributeError, ArithmeticError) as error:
        return f"it is malformed: {error}"
