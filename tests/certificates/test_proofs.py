"""Every proof and witness, made on random networks, is accepted by the stand-alone checker; false ones never."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.certificates.deployments import deployment_of, document, random_network, scalar

from tolnet import model
from tolnet.analysis.stability_candidates import (
    block_candidate,
    full_candidate,
    growth_candidate,
    network_matrix,
    power_candidate,
)
from tolnet.certificates.check import check
from tolnet.certificates.deployed import Deployed
from tolnet.certificates.eigenpair import refute_by_eigenpair
from tolnet.certificates.exact_network import ExactNetwork
from tolnet.certificates.performance import prove_performance
from tolnet.certificates.stability import Candidate, prove_stability, refute_stability
from tolnet.certificates.stated import stated_deployment
from tolnet.certificates.switching import Scenario
from tolnet.certificates.verdicts import Proved, Refuted, Undecided
from tolnet.certificates.verify import verify_claims
from tolnet.cli.evidence import Evidence
from tolnet.model.link_loss import possible_losses

CASES = [(seed, directed, factors) for seed in range(6) for directed in (False, True) for factors in (False, True)]
UNSTABLE = ("unstable-path", "unstable-ring", "unstable-metropolis")


def results(deployed: Deployed, *verdicts: Any) -> list[str]:
    """Of each verdict in a certificate of its own: several proofs of one claim would be told twice."""
    return [check(document(deployed, verdict))[0].result for verdict in verdicts]


def candidates(deployed: Deployed) -> list[Candidate]:
    M, W = deployed.loops[0], deployed.mixing
    exact = ExactNetwork(deployed)
    centre = None if deployed.centre is None else full_candidate(exact.centre_loops[1].rounded())
    found = [
        Candidate("primal", X, centre) for X in [block_candidate(M, W)] if X is not None
    ] + [Candidate("dual", Y, centre) for Y in [block_candidate(M, W, dual=True)] if Y is not None]  # fmt: skip
    for power in (2, 3):
        result = power_candidate(M, W, power)
        if result is not None:
            found.append(Candidate("power", result.X, centre, power, result.shares))
    full = full_candidate(network_matrix(M, W))
    return [*found, *([] if full is None else [Candidate("full", full, centre)])]


@pytest.mark.parametrize(("seed", "directed", "factors"), CASES)
def test_the_checker_accepts_what_is_proved(seed: int, directed: bool, factors: bool):
    deployed = deployment_of(random_network(seed, directed=directed, factors=factors))
    network = ExactNetwork(deployed)
    tried = candidates(deployed)
    proved = [v for c in tried if isinstance(v := prove_stability(network, c), Proved)]
    assert {c.method for c in tried} >= {"primal", "full"}
    assert len(proved) == len(tried)
    evidence = Evidence(deployed)
    others = [evidence.decay_rate(None), evidence.performance()]
    assert all(isinstance(v, Proved) for v in others)
    assert set(results(deployed, *proved, *others)) == {"valid"}


@pytest.mark.parametrize(("seed", "directed", "factors"), CASES[::3])
def test_stated_data_read_back_as_they_were(seed: int, directed: bool, factors: bool):
    deployed = deployment_of(random_network(seed, directed=directed, factors=factors))
    assert stated_deployment(deployed.data()).data() == deployed.data()


@pytest.mark.parametrize("method", ["primal", "dual", "full", "power"])
def test_a_candidate_that_proves_nothing_is_declined(method: str):
    deployed = deployment_of(random_network(2))
    candidate = next(c for c in candidates(deployed) if c.method == method)
    network = ExactNetwork(deployed)
    assert isinstance(prove_stability(network, candidate), Proved)
    for X in (-candidate.X, candidate.X * 0, np.abs(np.random.default_rng(0).standard_normal(candidate.X.shape))):
        symmetric = X + X.swapaxes(-1, -2)
        assert isinstance(prove_stability(network, replace(candidate, X=symmetric)), Undecided)
    assert isinstance(prove_stability(network, replace(candidate, centre=None)), Undecided)


@pytest.mark.parametrize("bits", [1, 20, 50, 52])
def test_the_unit_circle_to_the_last_bit(bits: int):
    inside, outside = 1 - 2.0**-bits, 1 + 2.0**-bits
    one = np.ones((1, 1, 1))
    assert isinstance(prove_stability(ExactNetwork(scalar(inside)), Candidate("primal", one)), Proved)
    for a in (1.0, outside):
        assert isinstance(prove_stability(ExactNetwork(scalar(a)), Candidate("primal", one)), Undecided)
    v = np.ones(1)
    assert isinstance(refute_stability(ExactNetwork(scalar(outside)), "network", one[0], v), Refuted)
    for a in (1.0, inside):
        assert isinstance(refute_stability(ExactNetwork(scalar(a)), "network", one[0], v), Undecided)


def test_a_rate_is_proved_just_above_the_spectral_radius_only():
    deployed = scalar(0.5)
    candidate = Candidate("full", np.ones((1, 1)))
    network = ExactNetwork(deployed)
    above = prove_stability(network, candidate, rate=np.nextafter(0.5, 1))
    assert isinstance(above, Proved)
    assert results(deployed, above) == ["valid"]
    assert isinstance(prove_stability(network, candidate, rate=0.5), Undecided)


def test_the_proved_decay_rate_is_within_one_percent_of_the_truth():
    for seed in range(4):
        evidence = Evidence(deployment_of(random_network(seed)))
        verdict = evidence.decay_rate(None)
        assert isinstance(verdict, Proved)
        assert evidence.centre_loop is not None
        truth = max(evidence.radius, np.abs(np.linalg.eigvals(evidence.centre_loop)).max())
        assert truth < float.fromhex(verdict.keys["rate"]) <= 1.01 * truth


@pytest.mark.parametrize("name", UNSTABLE)
def test_counter_examples_are_refuted_both_ways(name: str):
    network = model.example(name)
    assert isinstance(network, model.SensorNetwork)
    deployed = deployment_of(network)
    exact = ExactNetwork(deployed)
    F = network_matrix(deployed.loops[0], deployed.mixing)
    growth = growth_candidate(F)
    assert growth is not None
    assert growth.X is not None
    by_matrix = refute_stability(exact, "network", growth.X, growth.v)
    by_eigenvalue = refute_by_eigenpair(deployed, growth.eigenvalue, growth.mode)
    assert isinstance(by_matrix, Refuted)
    assert isinstance(by_eigenvalue, Refuted)
    assert results(deployed, by_matrix, by_eigenvalue) == ["valid", "not checked here"]
    assert verify_claims([by_eigenvalue.entry()], deployed) == [None]
    assert [c for c in candidates(deployed) if isinstance(prove_stability(exact, c), Proved)] == []


def test_a_stable_network_is_not_refuted():
    deployed = deployment_of(random_network(0))
    F = network_matrix(deployed.loops[0], deployed.mixing)
    values, vectors = np.linalg.eig(F)
    top = int(np.argmax(np.abs(values)))
    assert isinstance(refute_by_eigenpair(deployed, complex(values[top]), vectors[:, top]), Undecided)
    assert isinstance(refute_by_eigenpair(deployed, 1.5 + 0j, vectors[:, top]), Undecided)
    d = len(F)
    assert isinstance(refute_stability(ExactNetwork(deployed), "network", np.eye(d), np.ones(d)), Undecided)


@pytest.mark.parametrize(("seed", "directed"), [(0, False), (1, True), (3, False), (4, True)])
def test_what_is_proved_of_switching_is_accepted(seed: int, directed: bool):
    network = random_network(seed, directed=directed)
    deployed = deployment_of(network)
    evidence = Evidence(deployed)
    links = np.flatnonzero(deployed.neighbours != deployed.hearer)
    both = np.stack([deployed.neighbours, deployed.hearer])
    dropped = links[:1] if directed else np.flatnonzero((both.min(axis=0) == 0) & (both.max(axis=0) == 1))
    own = (deployed.neighbours == deployed.hearer).astype(float)
    scenarios = [Scenario(dropped=dropped), Scenario(weights=own), Scenario(gains=deployed.gains * 0.9)]
    verdicts = [evidence.link_losses(1), evidence.link_losses(2), evidence.scenarios(scenarios)]
    assert any(isinstance(verdict, Proved) for verdict in verdicts)
    for verdict in verdicts:
        expected = "valid" if isinstance(verdict, Proved) else "undecided"
        assert results(deployed, verdict) == [expected]


def test_losses_are_all_sets_of_links_at_a_node():
    deployed = deployment_of(random_network(1))
    losses = possible_losses(deployed.offsets, deployed.neighbours, 2, directed=False)
    degree = np.diff(deployed.offsets) - 1
    assert len(losses) == int((1 + degree + degree * (degree - 1) // 2).sum())
    lost = losses.lost[losses.lost >= 0]
    assert (deployed.hearer[lost] == np.repeat(losses.node, (losses.lost >= 0).sum(axis=1))).all()
    back = losses.returned[losses.lost >= 0]
    assert (deployed.neighbours[back] == deployed.hearer[lost]).all()
    with pytest.raises(model.InputError, match="drop-links"):
        possible_losses(np.array([0, 40]), np.arange(40), 20, directed=True)


def test_performance_encloses_the_truth_and_nothing_else():
    deployed = deployment_of(random_network(5))
    evidence = Evidence(deployed)
    verdict = evidence.performance()
    assert isinstance(verdict, Proved)
    low, high = map(float.fromhex, verdict.keys["network"].split(" "))
    assert low <= high <= low * (1 + 1e-6)
    network = deployed.network
    exact = prove_performance(evidence.exact, None, evidence.dual, None)
    assert isinstance(exact, Undecided)
    from tolnet import analysis, design

    table = design.choose_tolerances(network)
    found = analysis.evaluate_filters(table, design.diffusion_matrix(network), filters=["RKFDNU2"])["RKFDNU2"]
    assert low * (1 - 1e-9) <= found.msd <= high * (1 + 1e-9)


def test_negative_weights_and_foreign_gains_can_be_certified():
    network = random_network(3)
    deployed = deployment_of(network)
    rng = np.random.default_rng(0)
    signed = deployed.weights * rng.choice([-0.3, 0.6], len(deployed.weights))
    own = deployed.neighbours == deployed.hearer
    signed[own] += 1 - np.add.reduceat(signed, deployed.offsets[:-1])
    other = replace(
        deployed,
        weights=signed,
        gains=deployed.gains.astype(np.float32).astype(float),
    )
    verdict = Evidence(other).stability()
    assert isinstance(verdict, Proved)
    assert results(other, verdict) == ["valid"]
    losses = Evidence(other).link_losses(1)
    assert isinstance(losses, Undecided)
