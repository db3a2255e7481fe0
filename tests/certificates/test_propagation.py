"""Mean square deviations by following the noise: every bound holds in exact arithmetic, and no interval is false."""

from __future__ import annotations

import copy
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from numpy import ndarray
from tests.certificates.deployments import deployment_of, random_network

from tolnet import model
from tolnet.analysis.stability_candidates import full_candidate
from tolnet.certificates import performance, propagation
from tolnet.certificates.deployed import Centre, Deployed
from tolnet.certificates.exact import Exact
from tolnet.certificates.exact_network import ExactNetwork
from tolnet.certificates.performance import ExactDynamics, contracts, prove_performance, verify_performance
from tolnet.certificates.verdicts import Proved, Undecided
from tolnet.certificates.verify import NotChecked, can_verify, verify_claims
from tolnet.cli.evidence import Evidence

CASES = [(0, False, False), (1, True, False), (2, False, True), (3, True, True), (5, False, False)]


def dual_matrices(deployed: Deployed) -> tuple[ExactNetwork, float, ndarray]:
    """delta, and the Y of every filter, as a certificate has them."""
    evidence = Evidence(deployed)
    assert evidence.dual is not None
    assert evidence.centre_loop is not None
    centre = full_candidate(evidence.centre_loop.T)
    assert centre is not None
    plan = performance._plan(evidence.dual, centre, evidence.exact)
    assert plan is not None
    return evidence.exact, *plan


def size_in(Y: ndarray, S: ndarray) -> float:
    """The least tr(Y D) over +-S <= D: the sum of the moduli of the eigenvalues of L' S L, Y = L L'."""
    K, n, _ = Y.shape
    L = np.zeros((K * n, K * n))
    for k in range(K):
        L[k * n : (k + 1) * n, k * n : (k + 1) * n] = np.linalg.cholesky(Y[k])
    return float(np.abs(np.linalg.eigvalsh(L.T @ S @ L)).sum())


def outer(X: ndarray) -> Exact:
    """X X', exactly."""
    flat = Exact.of(X).reshape(X.shape[0] * X.shape[1], -1)
    return flat @ flat.T


def followed_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if every network were large."""
    monkeypatch.setattr(performance, "MOST", 0)


@pytest.mark.parametrize(("seed", "directed", "factors"), CASES)
def test_bounds_hold_in_exact_arithmetic(seed: int, directed: bool, factors: bool):
    network, _, Y = dual_matrices(deployment_of(random_network(seed, directed=directed, factors=factors)))
    steps, dynamics = propagation._Steps(network, Y), ExactDynamics(network)
    X, there = steps.sources.X, 1 / steps.unit[:, None]
    Y = Y * there * there.T  # the coordinates of the steps: powers of two, so that all stays exact
    noise = (outer(X * there) - dynamics.noise).rounded()
    noise *= np.outer(*2 * [np.tile(steps.unit, len(Y))])
    assert size_in(Y, noise) <= steps.sources.doubt
    assert steps.squares(X) == pytest.approx(np.linalg.norm(X * there, axis=(1, 2)) ** 2, rel=1e-12)
    for _ in range(4):
        x = propagation._norms(X)
        assert (np.linalg.norm(X, axis=(1, 2)) <= x).all()
        assert size_in(Y, outer(X).rounded()) <= steps.squared(x)
        after, r = steps.step(X, x)
        missed = (dynamics.step(Exact.of(X * there)) - Exact.of(after * there)).rounded() / there
        assert (np.linalg.norm(missed, axis=(1, 2)) <= r).all()
        assert r.max() < 1e-11 * x.max()
        difference = (outer(after) - outer(after + 1e-3 * X)).rounded()
        changed = steps.change(propagation._norms(after + 1e-3 * X), propagation._norms(1e-3 * X))
        assert size_in(Y, difference) <= changed
        for spare in (0.0, 1e-3 * steps.squared(x), steps.squared(x) / 2):
            kept, lost = steps.fewer_columns(X, x, spare)
            assert size_in(Y, (outer(X) - outer(kept)).rounded()) <= lost or kept is X
            assert lost <= 1.1 * spare + 1e-9 * steps.squared(x)
        X = after


@pytest.mark.parametrize("m", [1, 2, 7, 40])
def test_the_defect_of_a_basis_is_never_too_small(m: int):
    rng = np.random.default_rng(m)
    V = np.linalg.qr(rng.normal(size=(m, m)))[0]
    for error in (0.0, 1e-15, 1e-9, 1e-3):
        W = V * (1 + error)
        exact = (Exact.of(np.eye(m)) - Exact.of(W) @ Exact.of(W).T).rounded()
        defect = propagation._defect(W)
        assert np.linalg.norm(exact, 2) <= defect <= 3 * m * (error + 1e-15)
    assert propagation._defect(2 * V) == np.inf


@pytest.mark.parametrize(("seed", "directed", "factors"), CASES)
def test_both_ways_enclose_one_truth(seed: int, directed: bool, factors: bool, monkeypatch: pytest.MonkeyPatch):
    deployed = deployment_of(random_network(seed, directed=directed, factors=factors))
    by_residual = Evidence(deployed).performance()
    followed_only(monkeypatch)
    by_steps = Evidence(deployed).performance()
    assert isinstance(by_residual, Proved)
    assert isinstance(by_steps, Proved)
    assert by_steps.proof["Q"] is None
    for one, other in zip(intervals(by_residual), intervals(by_steps), strict=True):
        assert max(one[0], other[0]) <= min(one[1], other[1])
        assert other[1] - other[0] <= 1e-4 * other[1]
    assert verify_claims([by_steps.entry()], deployed) == [None]


def intervals(verdict: Proved) -> list[list[float]]:
    keys = verdict.keys
    return [[float.fromhex(x) for x in t.split(" ")] for t in [*keys["nodes"], keys["centre"], keys["network"]]]


@pytest.mark.parametrize("tilted", [True, False])
def test_states_in_other_units(tilted: bool, monkeypatch: pytest.MonkeyPatch):
    s = random_network(5)
    unit = 10.0 ** np.linspace(-4, 4, s.n)
    scaled = model.SensorNetwork(
        A=s.A * unit[:, None] / unit,
        Q=s.Q * unit[:, None] * unit,
        C=[s.C[s.rows[k] : s.rows[k + 1]] / unit for k in range(s.N)],
        R=[s.sensors.block(k) for k in range(s.N)],
        edges=[[k, k + 1] for k in range(s.N - 1)],
        ambiguity=s.ambiguity,
    )
    deployed = deployment_of(scaled)
    assert deployed.centre is not None
    if not tilted:
        deployed = replace(deployed, centre=replace(deployed.centre, tilt=np.zeros((s.n, 0))))
    followed_only(monkeypatch)
    verdict = Evidence(deployed).performance()
    monkeypatch.undo()
    exact = Evidence(deployed).performance()
    assert isinstance(verdict, Proved)
    assert isinstance(exact, Proved)
    for one, other in zip(intervals(exact), intervals(verdict), strict=True):
        assert max(one[0], other[0]) <= min(one[1], other[1])


@pytest.fixture
def certified(monkeypatch: pytest.MonkeyPatch) -> tuple[Deployed, dict[str, Any]]:
    followed_only(monkeypatch)
    deployed = deployment_of(random_network(1))
    verdict = Evidence(deployed).performance()
    assert isinstance(verdict, Proved)
    return deployed, verdict.entry()


def test_what_is_altered_is_not_verified(certified: tuple[Deployed, dict[str, Any]]):
    deployed, claim = certified
    network = ExactNetwork(deployed)
    assert can_verify(claim)
    assert verify_performance(network, claim) is None

    def altered(change: Any) -> str | NotChecked | None:
        other = copy.deepcopy(claim)
        change(other)
        return verify_claims([other], deployed)[0]

    def narrowed(text: str, upper: bool) -> str:
        low, high = map(float.fromhex, text.split(" "))
        middle = (low + high) / 2
        return f"{low.hex()} {middle.hex()}" if upper else f"{middle.hex()} {high.hex()}"

    for upper in (True, False):
        for change in (
            lambda c, upper=upper: c["nodes"].__setitem__(0, narrowed(c["nodes"][0], upper)),
            lambda c, upper=upper: c["nodes"].__setitem__(-1, narrowed(c["nodes"][-1], upper)),
            lambda c, upper=upper: c.__setitem__("centre", narrowed(c["centre"], upper)),
        ):
            assert "interval" in str(altered(change))
    smaller = [" ".join((0.9 * float.fromhex(x)).hex() for x in words.split(" ")) for words in claim["proof"]["Y"]]
    assert "contraction" in str(altered(lambda c: c["proof"].__setitem__("Y", smaller)))
    for delta in (0.9, 0.0, -0.1, 1.0):
        assert altered(lambda c, delta=delta: c["proof"].__setitem__("delta", delta.hex())) is not None
    for change in (
        lambda c: c.__setitem__("statement", c["statement"] + " "),
        lambda c: c.__setitem__("network", c["nodes"][0]),
        lambda c: c.__setitem__("margin", 0.5),
        lambda c: c.__setitem__("reason", "so it is"),
        lambda c: c.__setitem__("note", "true"),
        lambda c: c["proof"].__setitem__("note", "true"),
        lambda c: c["proof"].pop("delta"),
        lambda c: c["proof"]["Y"].pop(),
        lambda c: c["proof"].__setitem__("Y", None),
        lambda c: c["nodes"].pop(),
        lambda c: c["nodes"].__setitem__(0, "0x1p+0"),
        lambda c: c["nodes"].__setitem__(0, "nan nan"),
    ):
        assert altered(change) is not None


def test_other_noise_or_weights_are_noticed(certified: tuple[Deployed, dict[str, Any]]):
    deployed, claim = certified
    assert verify_claims([claim], replace(deployed, gains=1.001 * deployed.gains)) != [None]
    assert verify_claims([claim], replace(deployed, weights=1.001 * deployed.weights)) != [None]
    assert "least favourable" in str(verify_claims([claim], replace(deployed, centre=None))[0])


def test_the_contraction_is_decided_exactly():
    """Y falls by less than delta: the same Y with a larger delta, or smaller than I, is refused."""
    network, delta, Y = dual_matrices(deployment_of(random_network(2)))
    assert contracts(network, delta, Y)
    assert not contracts(network, min(3 * delta, 0.999), Y)
    assert not contracts(network, delta, Y / 2)
    for k in range(len(Y)):
        other = Y.copy()
        other[k] *= 0.5 if k == len(Y) - 1 else 100.0
        assert not contracts(network, delta, other)


def test_networks_without_an_answer_are_undecided(monkeypatch: pytest.MonkeyPatch):
    deployed = deployment_of(random_network(1))
    evidence = Evidence(deployed)
    followed_only(monkeypatch)
    assert isinstance(prove_performance(evidence.exact, None, None, None), Undecided)
    monkeypatch.setattr(propagation, "_ROOM", 10)
    verdict = evidence.performance()
    assert isinstance(verdict, Undecided)
    assert "nodes" in verdict.reason
    monkeypatch.undo()
    followed_only(monkeypatch)
    monkeypatch.setattr(propagation, "_MOST_WORK", 100)
    assert isinstance(Evidence(deployed).performance(), Undecided)


def relays(B: float, weights: list[list[float]] | None = None, **process: Any) -> Deployed:
    """Two nodes without sensors that mix; no tilt."""
    network = model.SensorNetwork(
        A=[[1e-10]],
        **(process or {"B": [[B]]}),
        C=[np.empty((0, 1))] * 2,
        D=[np.empty((0, 0))] * 2,
        edges=[[0, 1]],
    )
    entries = np.array(weights if weights is not None else [[0.5, 0.5], [0.5, 0.5]]).ravel()
    nothing = np.empty((0, 1))
    centre = Centre(nothing, np.zeros((1, 0)))
    return Deployed(network, np.array([0, 2, 4]), np.array([0, 1, 0, 1]), entries, np.zeros(5, int), nothing, centre)


@pytest.mark.parametrize("B", [1.1, 1.1e-30, 1.1e-48, 1.1e-60, 1.1e-80, 1.1e-150, 1.1e-158])
def test_noise_near_the_end_of_doubles_is_no_proof(B: float, monkeypatch: pytest.MonkeyPatch):
    """Weights that cancel make much of the rounding; squares of it must not be lost."""
    followed_only(monkeypatch)
    W = [[1e8 + 0.1328125, -1e8 + 0.8671875], [0.3e8 + 0.6796875, -0.3e8 + 0.3203125]]
    deployed = relays(B, W)
    verdict = prove_performance(ExactNetwork(deployed), None, np.full((2, 1, 1), 2.0), np.full((1, 1), 2.0))
    assert isinstance(verdict, Proved) is (B > 1e-50)
    if isinstance(verdict, Proved):
        a, rows = Fraction(1e-10), [[Fraction(w) for w in row] for row in W]
        sources, truth = [sum(row) * Fraction(B) for row in rows], [Fraction(0)] * 2
        for _ in range(12):
            truth = [t + x * x for t, x in zip(truth, sources, strict=True)]
            sources = [a * sum(w * x for w, x in zip(row, sources, strict=True)) for row in rows]
        for (low, high), t in zip(intervals(verdict), truth, strict=False):
            assert Fraction(low) <= t <= Fraction(high)


def test_numbers_are_written_as_doubles_are(certified: tuple[Deployed, dict[str, Any]]):
    deployed, claim = certified
    for text in ("-0x1p-1000 -0x1p-2000", "-inf inf", "-100 0X1P9", "-0x1p+9 0x1.fffffffffffff8p+9", "-9 9"):
        for key in ("nodes", "centre"):
            other = copy.deepcopy(claim)
            other[key] = [text, *other["nodes"][1:]] if key == "nodes" else text
            assert "malformed" in str(verify_claims([other], deployed)[0])
    other = copy.deepcopy(claim)
    other["proof"]["delta"] = "0.001"
    assert "float.hex" in str(verify_claims([other], deployed)[0])


@pytest.mark.parametrize("follow", [True, False])
def test_what_is_no_covariance_has_no_performance(follow: bool, monkeypatch: pytest.MonkeyPatch):
    """Q = [[1, 1], [1, 1 - 2^-53]] is indefinite by less than a model refuses."""
    if follow:
        followed_only(monkeypatch)
    network = random_network(2)
    n = network.n
    Q = np.ones((n, n))
    Q[-1, -1] = 1 - 2.0**-53
    assert n > 1
    other = model.SensorNetwork(
        A=network.A,
        Q=Q,
        C=[network.C[network.rows[k] : network.rows[k + 1]] for k in range(network.N)],
        R=[network.sensors.block(k) for k in range(network.N)],
        edges=[[k, k + 1] for k in range(network.N - 1)],
        ambiguity=network.ambiguity,
    )
    verdict = Evidence(deployment_of(other)).performance()
    assert isinstance(verdict, Undecided)
    assert "semidefinite" in verdict.reason


@pytest.mark.parametrize("follow", [True, False])
def test_a_network_without_sensors(follow: bool, monkeypatch: pytest.MonkeyPatch):
    if follow:
        followed_only(monkeypatch)
    verdict = Evidence(relays(1.0)).performance()
    assert isinstance(verdict, Proved)
    assert intervals(verdict)[0][0] <= 1 <= intervals(verdict)[0][1]


def test_a_wide_tilt_is_not_followed():
    deployed = relays(1.0)
    assert propagation.can_follow(deployed)
    wide = Centre(np.empty((0, 1)), np.zeros((1, 10_000)))
    assert not propagation.can_follow(replace(deployed, centre=wide))
