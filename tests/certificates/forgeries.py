"""Certificates that say more than is true of a deployment: a name, and how each is made out of a true one.

A forger may write every claim that can be proved of other numbers, and any number that no claim ties down. The
problem is the honest one, or one that the certificate is not for.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from tests.certificates.deployments import deployment_of, document
from tests.reference.certificates import Document, text

from tolnet import analysis, model
from tolnet.certificates import statements
from tolnet.certificates.deployed import Centre, Deployed
from tolnet.certificates.filter_claims import SteadyStates, decide, find_centre
from tolnet.cli.evidence import Evidence
from tolnet.design import choose_tolerances
from tolnet.design.export.deployment import central_gain_columns
from tolnet.model.worst_case import psd_factor

C = 0.01
CLAIMS = ("steady-state", "attraction", "tolerance")


def networks() -> dict[str, model.SensorNetwork]:
    """Small networks: a path in mixed units, a star with a relay, a one-way ring."""
    D = np.array([[0.5, 0.0], [0.1, 0.7]])
    own = {"ambiguity": model.Ambiguity(C)}
    units = np.diag([1.0, 1e-6])  # the second state in millions of its unit
    A, B = np.array([[1.0, 0.1], [0.0, 0.95]]), np.array([[0.1, 0.0], [0.0, 0.2]])
    H = [np.array([[1.0, 0.0]]), np.array([[1.0, 0.5]]), np.eye(2)]
    return {
        "path": model.SensorNetwork(
            A=units @ A @ np.linalg.inv(units), B=units @ B, C=[h @ np.linalg.inv(units) for h in H],
            R=[[[0.5]], [[0.4]], D @ D.T], edges=[[0, 1], [1, 2]], name="path", **own,
        ),
        "star": model.SensorNetwork(
            A=[[0.95, 0.2], [0.0, 0.9]], Q=0.1 * np.eye(2),
            C=[np.zeros((0, 2)), [[1.0, 0.3]], [[0.2, 1.0]], [[1.0, 1.0]]],
            D=[np.zeros((0, 0)), [[0.7]], [[0.6]], [[1.0]]], edges=[[0, 1], [0, 2], [0, 3]], name="star", **own,
        ),
        "ring": model.SensorNetwork(
            A=[[1.05]], Q=[[1.0]], C=[[[1.0]], [[0.5]], [[2.0]]], R=np.ones((3, 1, 1)),
            edges=[[0, 1], [1, 2], [2, 0]], directed=True, name="ring", **own,
        ),
    }  # fmt: skip


class Kit:
    """A network with its true certificate, and the means to forge others."""

    def __init__(self, network: model.SensorNetwork) -> None:
        self.network = network
        self.table = choose_tolerances(network)
        self.deployed = deployment_of(network)

    @cached_property
    def true(self) -> Document:
        """What `tolnet certify` would write, but for convergence."""
        evidence = Evidence(self.deployed)
        verdicts = [
            evidence.stability(),
            *self.about_filters(self.table.local.tolerance, self.deployed),
            evidence.performance(),
        ]
        assert all(verdict.verdict == "proved" for verdict in verdicts)
        return document(self.deployed, *verdicts)

    def copy(self) -> Document:
        """The true certificate, to be changed."""
        return copy.deepcopy(self.true)

    def about_filters(self, tolerances: np.ndarray, deployed: Deployed) -> list[Any]:
        """What can be proved of filters at these tolerances."""
        local, central = analysis.solve_local_steady_states(self.network, tolerances), self.table.central
        centre = float(central.tolerance), central.P, float(central.theta)
        states = SteadyStates(
            ["centre", *range(self.network.N)],
            [centre[0], *tolerances.tolist()],
            [centre[1], *local.P],
            [centre[2], *local.theta.tolist()],
            find_centre(deployed, *centre),
        )
        found = decide(states, deployed, CLAIMS)
        return [verdict for claim in CLAIMS for verdict in found if verdict.claim == claim]

    def gains_at(self, tolerances: np.ndarray) -> np.ndarray:
        """The gains of the steady states at these tolerances."""
        network, d = self.network, self.deployed
        local = analysis.solve_local_steady_states(network, tolerances)
        gains = d.gains.copy()
        for k in range(network.N):
            first, last = d.columns[d.offsets[[k, k + 1]]]
            rows = d.sensor_rows[first:last]
            if len(rows):
                weighed = np.linalg.solve(self.noise[np.ix_(rows, rows)], network.C[rows])
                V, H = local.V[k], network.C[rows]
                Z = np.linalg.solve(np.eye(network.n) + V @ H.T @ weighed, V)
                gains[first:last] = weighed @ Z.T @ network.A.T
        return gains

    @cached_property
    def noise(self) -> np.ndarray:
        """R of all sensors together."""
        R, rows = np.zeros((len(self.network.C),) * 2), self.network.rows
        for k in range(self.network.N):
            own = slice(rows[k], rows[k + 1])
            R[own, own] = self.network.sensors.block(k)
        return R

    def with_tolerances(self, factors: list[float], *, drop: tuple[str, ...] = ()) -> Document:
        """All that is true of filters whose tolerances are other than those that follow from the network's."""
        tolerances = self.table.local.tolerance * np.array(factors)
        deployed = replace(self.deployed, gains=self.gains_at(tolerances))
        evidence = Evidence(deployed)
        verdicts = [evidence.stability(), *self.about_filters(tolerances, deployed), evidence.performance()]
        return document(deployed, *(v for v in verdicts if v.verdict == "proved" and v.claim not in drop))

    def with_centre(self, c: float, *, gain: bool = True, tilt: bool = True) -> Document:
        """Performance and stability under the least favourable model of another tolerance, or a part of it."""
        central = analysis.solve_steady_state(self.network, model.Ambiguity(c))
        worst = analysis.least_favourable_model(self.network, central)
        own = self.deployed.centre
        assert own is not None
        other = Centre(
            central_gain_columns(self.network, central) if gain else own.gain,
            psd_factor(worst.tilt) if tilt else own.tilt,
        )
        deployed = replace(self.deployed, centre=other)
        evidence = Evidence(deployed)
        found = document(deployed, evidence.stability(), evidence.performance())
        for claim in self.copy()["claims"]:
            if claim["claim"] in CLAIMS:
                if claim["claim"] == "steady-state" and claim["node"] == "centre":
                    claim = _said(claim, gain_error=(2.0**20).hex())
                found["claims"].append(claim)
        return found


def _said(claim: Document, **changes: Any) -> Document:
    """The claim with other keys, and the statement that belongs to them."""
    changed = {**claim, **changes}
    return {**changed, "statement": statements.of_filter_claim(changed)}


@dataclass(frozen=True)
class Forgery:
    """A certificate that must not pass, against what it is checked, and a word of the reason."""

    certificate: Document
    word: str
    codes: tuple[int, ...] = (1,)
    problem: dict[str, Any] | None = field(default_factory=dict)
    """What the problem has otherwise than the honest one; None: checked without a problem."""
    options: tuple[str, ...] = ()


Make = Callable[[], Forgery]


def forgeries(kit: Kit) -> Iterator[tuple[str, Make]]:
    """All of them, by name."""
    yield from _of_weights(kit)
    yield from _of_tolerances(kit)
    yield from _of_problems(kit)
    yield from _of_the_model(kit)
    yield from _of_gains(kit)
    yield from _told_twice(kit)
    yield from _required(kit)
    yield from _of_words(kit)


def _numbers(words: str) -> list[float]:
    return [float.fromhex(word) for word in words.split(" ")] if words else []


def _of_weights(kit: Kit) -> Iterator[tuple[str, Make]]:
    """Columns that do not sum to one make every condition easier to meet, and F no error dynamics."""
    changes: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "zero": lambda w: 0 * w,
        "halved": lambda w: w / 2,
        "less by 1e-3": lambda w: w * (1 - 1e-3),
        "less by 1e-9": lambda w: w * (1 - 1e-9),
        "less by 1e-14": lambda w: w * (1 - 1e-14),
        "of another sign": lambda w: -w,
        "that cancel": lambda w: np.array([1e16, *[0.0] * (len(w) - 2), -1e16]) if len(w) > 1 else 0 * w,
        "cut to single precision": lambda w: np.ldexp(np.floor(np.ldexp(w, 12)), -12) * (1 - 2.0**-12),
    }

    def forged(k: int, what: str, at: str) -> Forgery:
        found = kit.copy()
        wrong = text(changes[what](np.array(_numbers(found["data"]["weights"][k]))))
        if at == "data":
            found["data"]["weights"][k] = wrong
        else:
            weights = list(found["data"]["weights"])
            weights[k] = wrong
            proof = {"Y": found["claims"][0]["proof"].get("Y") or found["claims"][0]["proof"]["X"]}
            own = {"claim": "switching", "verdict": "proved", "statement": statements.scenarios(1), "margin": 0.0}
            found["claims"] = [{**own, "reason": None, "scenarios": [{"weights": weights}], "proof": proof}]
        return Forgery(found, "instead of one" if at == "data" else "", problem=None)

    for k in range(kit.network.N):
        for what in changes:
            for at in ("data", "a scenario") if k == 1 else ("data",):
                yield f"weights of node {k} {what}, in {at}", lambda k=k, what=what, at=at: forged(k, what, at)


def _of_tolerances(kit: Kit) -> Iterator[tuple[str, Make]]:
    """Filters at tolerances that do not follow from the network's, with all that is true of them."""
    N = kit.network.N
    for k in range(N):
        for factor in (1e-4, 0.5, 1 - 1e-6, 1 + 1e-6, 3.0):
            factors = [factor if l == k else 1.0 for l in range(N)]
            yield (
                f"c of node {k} times {factor}",
                lambda factors=factors: Forgery(kit.with_tolerances(factors), "where its tolerance claim has"),
            )
    less = [0.1] * N
    yield "every c a tenth", lambda: Forgery(kit.with_tolerances(less), "where its tolerance claim has")
    yield (
        "every c a tenth, and no claim on tolerances",
        lambda: Forgery(kit.with_tolerances(less, drop=("tolerance",)), "ties c of", codes=(3,)),
    )

    def widened(k: int) -> Forgery:
        found = kit.with_tolerances([0.5 if l == k else 1.0 for l in range(N)])
        for i, claim in enumerate(found["claims"]):
            if claim["claim"] == "tolerance" and claim["node"] == k:
                found["claims"][i] = _said(claim, interval=f"{(0.0).hex()} {(1.0).hex()}")
        return Forgery(found, "where its tolerance claim has")

    def without(k: int) -> Forgery:
        found = kit.copy()
        found["claims"] = [c for c in found["claims"] if (c["claim"], c.get("node")) != ("tolerance", k)]
        return Forgery(found, f"ties c of node {k}", codes=(3,))

    for k in range(N):
        yield f"c of node {k} halved, in an interval from 0 to 1", lambda k=k: widened(k)
        yield f"no tolerance of node {k}", lambda k=k: without(k)


def _of_problems(kit: Kit) -> Iterator[tuple[str, Make]]:
    """A true certificate, held against a problem that it is not for."""
    network = kit.network
    R = [network.sensors.block(k) * (1 + (k == 1) * 2.0**-50) for k in range(network.N)]
    others: dict[str, tuple[dict[str, Any], str, tuple[int, ...]]] = {
        "another tolerance": ({"ambiguity": model.Ambiguity(0.02)}, "instead of", (1,)),
        "nats": ({"ambiguity": model.Ambiguity(C, "nats")}, "instead of", (1,)),
        "another tau": ({"ambiguity": model.Ambiguity(C, "gamma", 0.5)}, "tau = 0.5", (3,)),
        "no tolerance": ({"ambiguity": None}, "the problem has no tolerance", (3,)),
        "the plain filter": ({"ambiguity": model.Ambiguity(0.0)}, "instead of", (1,)),
        "a plant that is off by an ulp": ({"A": network.A * (1 + 2.0**-52)}, "A", (1,)),
        "noise that is off": ({"R": R, "D": None}, "noise", (1,)),
        "another start": ({"initial_covariance": 2 * np.eye(network.n)}, "", (0,)),
    }
    for what, (changes, word, codes) in others.items():
        if what != "another start":
            yield f"a problem with {what}", lambda c=changes, w=word, n=codes: Forgery(kit.copy(), w, n, problem=c)
    yield (
        "a problem with other weights",
        lambda: Forgery(
            kit.copy(), "weights", options=("--diffusion", "metropolis-own"), problem={"diffusion": "none"}
        ),
    )


def _of_the_model(kit: Kit) -> Iterator[tuple[str, Make]]:
    """Performance under a model that is not the least favourable one at the network's tolerance."""
    for c in (1e-6, C / 2, C * (1 - 1e-6)):
        yield f"the model of c = {c}", lambda c=c: Forgery(kit.with_centre(c), "least favourable model")
        yield f"the tilt of c = {c}", lambda c=c: Forgery(kit.with_centre(c, gain=False), "its tilt")
        yield (
            f"the centre's gain of c = {c}",
            lambda c=c: Forgery(kit.with_centre(c, tilt=False), "the centre's gain"),
        )

    def unstated() -> Forgery:
        found = kit.with_centre(1e-6)
        found["claims"] = [c for c in found["claims"] if (c["claim"], c.get("node")) != ("steady-state", "centre")]
        return Forgery(found, "no valid claim states the centre's steady state", codes=(3,))

    yield "the model of c = 1e-6, and no claim on the centre", unstated


def _of_gains(kit: Kit) -> Iterator[tuple[str, Make]]:
    """Gains that are not those of the steady states that claims speak of, which say how far off they are."""

    def forged(change: Callable[[np.ndarray], np.ndarray], error: float | None) -> Forgery:
        deployed = replace(kit.deployed, gains=change(kit.deployed.gains))
        found = kit.copy()
        found["data"] = deployed.data()
        evidence = Evidence(deployed)
        rest = [c for c in found["claims"] if c["claim"] in CLAIMS]
        if error is not None:
            rest = [_said(c, gain_error=error.hex()) if c["claim"] == "steady-state" else c for c in rest]
        found["claims"] = [evidence.stability().entry(), *rest]
        return Forgery(found, "")

    for size in (1e-2, 1e-5, 1e-8):
        yield f"gains off by {size}", lambda s=size: forged(lambda G: G * (1 + s), 2 * s)
    yield "gains off by 1e-5, as if they were not", lambda: forged(lambda G: G * (1 + 1e-5), None)
    yield "gains of which the claims allow anything", lambda: forged(lambda G: G, 2.0**10)
    yield (
        "gains in single precision, one of them off",
        lambda: forged(lambda G: (G * (1 + 1e-5)).astype(np.float32).astype(float), 1e-4),
    )
    if kit.network.name == "path":  # rows of the second state are a millionth of those of the first
        yield "gains of the state in large units", lambda: forged(lambda G: G * np.array([1.0, 1.0005]), 1e-9)
        yield "no gains of the state in large units", lambda: forged(lambda G: G * np.array([1.0, 1 - 1e-4]), 5e-10)


def _told_twice(kit: Kit) -> Iterator[tuple[str, Make]]:
    """One claim in the place of many."""

    def repeated(name: str, node: Any, times: int, **changes: Any) -> Forgery:
        found = kit.copy()
        claim = next(c for c in found["claims"] if (c["claim"], c.get("node")) == (name, node))
        again = _said(claim, **changes) if changes else claim
        found["claims"] += [again] * times
        return Forgery(found, "earlier claim", problem=None)

    for name in ("schur-stability", "performance"):
        yield f"{name} twice", lambda n=name: repeated(n, None, 1)
    for name in CLAIMS:
        for node in (0, kit.network.N - 1):
            yield f"{name} of node {node} four times", lambda n=name, k=node: repeated(n, k, 3)
    yield "steady-state of the centre twice", lambda: repeated("steady-state", "centre", 1)
    yield "attraction of node 0 at another rate", lambda: repeated("attraction", 0, 1, rate=(0.9999).hex())
    yield "steady-state of node 1, further off", lambda: repeated("steady-state", 1, 1, gain_error=(0.5).hex())
    yield "tolerance of node 1, wider", lambda: repeated("tolerance", 1, 1, interval=f"{(0.0).hex()} {(1.0).hex()}")


def _required(kit: Kit) -> Iterator[tuple[str, Make]]:
    """What is asked for and is not there, or not proved."""

    def less(drop: Callable[[Document], bool], ask: str) -> Forgery:
        found = kit.copy()
        found["claims"] = [c for c in found["claims"] if not drop(c)]
        return Forgery(found, "required", problem=None, options=("--require", ask))

    def undecided(name: str) -> Forgery:
        found = kit.copy()
        for claim in found["claims"]:
            if claim["claim"] == name and claim.get("node") != "centre":
                claim.pop("proof")
                claim |= {"verdict": "undecided", "margin": None, "reason": "it is surely true"}
        return Forgery(found, "not proved", problem=None, options=("--require", name))

    for name in ("schur-stability", "performance", *CLAIMS):
        yield f"no {name} where it is required", lambda n=name: less(lambda c: c["claim"] == n, n)
        yield f"{name} left undecided where it is required", lambda n=name: undecided(n)
    for name in CLAIMS:
        yield (
            f"no {name} of node 1 where it is required",
            lambda n=name: less(lambda c: (c["claim"], c.get("node")) == (n, 1), f"{n},schur-stability"),
        )
    yield "no convergence where it is required", lambda: less(lambda c: False, "convergence")


def _of_words(kit: Kit) -> Iterator[tuple[str, Make]]:
    """Words that nobody checks, and sentences that do not belong to what is proved."""

    def changed(name: str, change: Callable[[Document], None], word: str = "") -> Forgery:
        found = kit.copy()
        change(next(c for c in found["claims"] if c["claim"] == name and c.get("node") in (None, 0)))
        return Forgery(found, word, problem=None)

    def set_(key: str, value: Any) -> Callable[[Document], None]:
        return lambda claim: claim.update({key: value})

    for name in ("schur-stability", "performance", *CLAIMS):
        yield f"a word more in {name}", lambda n=name: changed(n, set_("note", "for every network"), "key")
        yield (
            f"a word more in the proof of {name}",
            lambda n=name: changed(n, lambda c: c["proof"].update(method_of="x", note="for every network"), "key"),
        )
        yield f"a reason for {name}", lambda n=name: changed(n, set_("reason", "and it will stay so"))
        yield (
            f"another sentence for {name}",
            lambda n=name: changed(n, set_("statement", "All is well."), "statement"),
        )
        yield f"{name} of another verdict", lambda n=name: changed(n, set_("verdict", "refuted"))
        yield f"{name} with a whole margin", lambda n=name: changed(n, set_("margin", 0.999999))
        if name in CLAIMS:
            yield f"{name} at another c", lambda n=name: changed(n, _restated(c=(2 * C).hex()))
            yield f"{name} of no node", lambda n=name: changed(n, _restated(node=kit.network.N))
            yield f"{name} of another node", lambda n=name: changed(n, _restated(node=-1))
            yield (
                f"a word more in the box of {name}",
                lambda n=name: changed(n, lambda c: c["proof"]["box"].update(holds="always"), "box"),
            )
    yield "attraction faster than it is", lambda: changed("attraction", _restated(rate=(1e-3).hex()))
    yield (
        "a tolerance that is larger",
        lambda: changed("tolerance", _restated(interval=f"{(0.5).hex()} {(0.6).hex()}")),
    )


def _restated(**changes: Any) -> Callable[[Document], None]:
    return lambda claim: claim.update(_said(claim, **changes))


def written(forgery: Forgery, kit: Kit, folder: Path) -> list[str]:
    """The command that must refuse it."""
    path, problem = folder / "certificate.json", folder / "problem.toml"
    path.write_text(json.dumps(forgery.certificate))
    if forgery.problem is None:
        return ["check", str(path), *forgery.options]
    own = kit.network
    given: dict[str, Any] = {
        "A": own.A, "C": [own.sensor(k)[0] for k in range(own.N)], "edges": own.links, "directed": own.directed,
        "name": own.name, "ambiguity": own.ambiguity, "diffusion": own.diffusion,
    }  # fmt: skip
    given |= {"Q": own.Q} if own.B is None else {"B": own.B}
    factors = own.factors
    if factors is not None:
        given["D"] = [factors.block(k) for k in range(own.N)]
    else:
        given["R"] = [own.sensors.block(k) for k in range(own.N)]
    given |= forgery.problem
    model.save(model.SensorNetwork(**{key: value for key, value in given.items() if value is not None}), problem)
    return ["check", str(path), "--problem", str(problem), *forgery.options]
