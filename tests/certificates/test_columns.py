"""Columns of W sum to one as far as rounding lets them; what is told twice counts once; tiny numbers are bounded."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from tests.certificates.deployments import deployment_of, random_network
from tests.certificates.examples import certificate, certificates
from tests.reference.certificate_truth import mixes

from tolnet import model
from tolnet.certificates.check import check, unmixed
from tolnet.certificates.deployed import Deployed
from tolnet.certificates.eigenpair import refute_by_eigenpair, sparse_block
from tolnet.certificates.exact_network import ExactNetwork, unmixed_column
from tolnet.certificates.stability import refute_stability
from tolnet.certificates.switching import Scenario
from tolnet.certificates.verdicts import Proved, Undecided
from tolnet.cli.evidence import Evidence

ULP, SINGLE = 2.0**-52, 2.0**-24


def refused(*columns: list[float]) -> bool:
    """What the checker, the prover and the reference say, who must agree."""
    weights = {k: {l: Fraction(w) for l, w in enumerate(column) if w} for k, column in enumerate(columns)}
    offsets = np.cumsum([0, *map(len, columns)])
    W = np.zeros((max(map(len, columns)), len(columns)), dtype=object)
    for k, column in enumerate(columns):
        W[: len(column), k] = [Fraction(w) for w in column]
    answers = (
        unmixed(weights, "weights") is not None,
        unmixed_column(np.concatenate(columns), offsets) is not None,
        not mixes(W + Fraction(0)),
    )
    assert len(set(answers)) == 1, answers
    return answers[0]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("m", [1, 2, 3, 5])
def test_one_ulp_a_weight_is_what_rounding_takes(m: int, sign: int):
    """Weights 2^-j, but for the first: their sum is off by a whole number of ulps."""
    column = [2.0**-j for j in range(1, m)] + [2.0 ** -(m - 1)]
    third = [1 / 3, 1 / 3, 1 / 3]  # doubles that need all their digits: no single precision
    for ulps, wrong in ((0, False), (m, False), (m + 1, True), (1000, True)):
        off = [column[0] + sign * ulps * ULP, *column[1:]]
        assert sum(map(Fraction, off)) - 1 == sign * ulps * Fraction(ULP)
        assert refused(off, third) is wrong
        assert refused(third, off) is wrong
    assert refused([*column, 0.0], third) is False
    assert refused([column[0] + sign * (m + 1) * ULP, *column[1:], 0.0], third) is True  # zeros give no room


def test_single_precision_is_rounded_once_more_where_all_weights_are():
    half = np.float32(0.5)
    below = float(np.nextafter(half, np.float32(0)))  # half a unit of 2^-24 less
    assert 0.5 - below == SINGLE / 2
    assert not refused([0.5, below], [0.5, 0.5])
    assert not refused([below, below], [1.0])
    assert refused([0.5 - 3 * SINGLE / 2, 0.5], [1.0])
    assert refused([0.5, below], [1 / 3, 1 / 3, 1 / 3])  # doubles elsewhere: no weight was rounded to single


@pytest.mark.parametrize(
    "column", [[0.0, 0.0], [1e16, -1e16], [2.0**60, -(2.0**60) + 2048], [-0.5, -0.5], [2.0, 2.0]]
)
def test_weights_that_cancel_have_no_more_room(column: list[float]):
    assert refused(column, [1.0])


@pytest.mark.parametrize("seed", range(5))
def test_what_is_normalised_is_accepted(seed: int):
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 40, 60)
    columns = [w / w.sum() for w in (10.0 ** rng.uniform(-6, 6, size) for size in sizes)]
    assert not refused(*(w.tolist() for w in columns))
    assert not refused(*(w.astype(np.float32).astype(float).tolist() for w in columns))


def test_provers_and_the_ball_checker_decline_other_columns():
    """Half of every weight: proofs of half of the network would be found, and are about no filter."""
    deployed = deployment_of(random_network(3))
    honest, other = Evidence(deployed), Evidence(replace(deployed, weights=deployed.weights / 2))
    for decide in (
        Evidence.stability,
        Evidence.performance,
        lambda e: e.decay_rate(None),
        lambda e: e.link_losses(1),
    ):
        verdict = decide(other)
        assert isinstance(verdict, Undecided)
        assert "instead of one" in verdict.reason
    scenario = Scenario(weights=deployed.weights / 2)
    assert isinstance(honest.scenarios([Scenario(weights=deployed.weights)]), Proved)
    verdict = honest.scenarios([scenario])
    assert isinstance(verdict, Undecided)
    assert "instead of one" in verdict.reason
    grown = replace(deployed, weights=10 * deployed.weights)
    network = ExactNetwork(grown)
    n = deployed.N * deployed.n
    for refuted in (
        refute_stability(network, "network", np.eye(n), np.ones(n)),
        refute_by_eigenpair(grown, 2.0 + 0j, np.ones(n, dtype=complex)),
    ):
        assert isinstance(refuted, Undecided)
        assert "instead of one" in refuted.reason


# ---- What is told twice ----


@pytest.mark.parametrize("name", certificates())
def test_a_claim_counts_once(name: str):
    found = certificate(name)
    found["claims"] *= 3
    results = [finding.result for finding in check(found)]
    assert results == ["valid", "invalid", "invalid"]


def test_other_claims_count_too():
    """Of a network block and of F, at two rates, for one and for two links."""
    for first, second in (("primal network", "dual F"), ("drop 1", "drop 2")):
        found, other = certificate(first), certificate(second)
        assert found["data"] == other["data"]
        found["claims"] += other["claims"]
        assert [finding.result for finding in check(found)] == ["valid", "valid"]
    found = certificate("primal network")
    found["claims"] += certificate("full network")["claims"]  # the same, proved otherwise
    assert [finding.result for finding in check(found)] == ["valid", "invalid"]


@pytest.mark.parametrize(
    "other", [{}, {"c": "0x1.0p-3"}, {"rate": "0x1.0p-1"}, {"verdict": "refuted"}, {"proof": {}}]
)
def test_of_a_filter_there_is_one_claim_of_a_name(other: dict[str, Any]):
    found = certificate("primal network")
    claim = {"claim": "attraction", "node": 1, "verdict": "proved", "statement": "", "margin": None, "reason": None}
    found["claims"] = [claim, {**claim, "node": 2}, {**claim, "node": "centre"}, {**claim, **other}]
    assert [finding.result for finding in check(found)] == [*["not checked here"] * 3, "invalid"]


# ---- Tiny numbers ----


@pytest.mark.parametrize("seed", range(6))
def test_the_bounds_of_the_network_block_hold_where_products_underflow(seed: int):
    """Loops of a few of the smallest doubles, weights and gains below 1: relative bounds see nothing there."""
    rng = np.random.default_rng(seed)
    smallest = 2.0**-1074
    network = model.SensorNetwork(
        A=np.array([[0.5, 3 * smallest], [smallest * rng.integers(1, 9), 2.0**-1040]]),
        Q=np.eye(2),
        C=[np.array([[1.0, 2.0**-1060]])] * 2,
        R=np.ones((2, 1, 1)),
        edges=[[0, 1]],
    )
    w = rng.uniform(0, 1, 2)
    gains = rng.uniform(0, 1, (4, 2)) * 2.0 ** -rng.integers(0, 30, (4, 2))
    weights = np.array([w[0], 1 - w[0], w[1], 1 - w[1]])
    deployed = Deployed(network, np.array([0, 2, 4]), np.array([0, 1, 0, 1]), weights, np.arange(5), gains)
    A, doubt = (X.toarray() for X in sparse_block(deployed))
    lost = False
    for k in range(2):
        for l in range(2):
            for i in range(2):
                for j in range(2):
                    C = network.C[:, j]
                    M = Fraction(network.A[i, j]) - sum(
                        Fraction(gains[2 * l + m, i]) * Fraction(C[m]) for m in range(2)
                    )
                    off = abs(Fraction(weights[2 * k + l]) * M - Fraction(A[2 * k + i, 2 * l + j]))
                    assert off <= Fraction(doubt[2 * k + i, 2 * l + j])
                    lost = lost or (off > 0 and off < Fraction(smallest))
    assert lost  # something less than every double was lost, and is in the bound
