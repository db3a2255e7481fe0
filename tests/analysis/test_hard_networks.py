"""Right to six digits, or honest: networks on which doubles lose their digits, against 100 digits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy import ndarray
from tests.reference import exact_filter
from tests.reference.hard_networks import KINDS, hard_network
from tests.study import sized

from tolnet import analysis, design
from tolnet.analysis.divergence import scalar_excess
from tolnet.analysis.fixed_point import Recursion, derivative, step
from tolnet.model import SensorNetwork, Status, SteadyState, ToleranceTable

SEEDS = sized(3, 230)
SIX = 1e-6


def filters(table: ToleranceTable) -> list[tuple[str, list[int], SteadyState, ndarray | None]]:
    """Name, nodes heard, answer and gain of the centre and of every node."""
    network = table.network
    found: list = [("centre", list(range(network.N)), table.central, None)]
    for k in range(network.N):
        gain = table.gain(k)[1] if table.local.exists[k] else None
        found.append((f"node {k}", network.neighbours(k).tolist(), table.local[k], gain))
    return found


def disagreement(state: SteadyState, gain: ndarray | None, truth: exact_filter.Truth) -> float:
    """The largest relative error: matrices in the units of each state, gains beside the largest."""
    units = np.sqrt(np.diag(truth.P))
    gap = [abs(float(state.theta) - truth.theta) / truth.theta if truth.theta else 0.0]
    gap.append(float(np.abs((state.P - truth.P) / np.outer(units, units)).max()))
    inflated = np.sqrt(np.diag(truth.V))
    gap.append(float(np.abs((state.V - truth.V) / np.outer(inflated, inflated)).max()))
    gap.append(abs(float(state.spectral_radius) - truth.spectral_radius) / (truth.spectral_radius or 1.0))
    if gain is not None and gain.size:
        scaled = np.abs(truth.gain / units[:, None])
        # Each column beside its own largest entry: a precise sensor's gain is no smaller for that.
        largest = scaled.max(axis=0)
        moved = np.abs((gain - truth.gain) / units[:, None]).max(axis=0)
        gap.append(float((moved / np.where(largest > 0, largest, 1.0)).max()))
    return max(gap)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(SEEDS))
def test_an_answer_is_right_to_six_digits(kind: str, seed: int):
    network, tolerance = hard_network(kind, seed)
    table = design.choose_tolerances(network, tolerance)
    centre = None
    for name, heard, state, gain in filters(table):
        if str(state.status) not in (Status.OK, Status.OSCILLATES):
            continue
        its = exact_filter.filter_of(network, heard)
        c = tolerance
        if name != "centre":
            assert centre is not None
            c = exact_filter.local_tolerance(its, centre)
            assert float(state.tolerance) == pytest.approx(c, rel=SIX), name
        truth = exact_filter.polish(its, float(state.tolerance), state.P, float(state.theta))
        centre = truth if name == "centre" else centre
        assert disagreement(state, gain, truth) < SIX, name
        attraction = exact_filter.attraction(its, float(state.tolerance), truth)
        assert float(state.attraction) == pytest.approx(attraction, rel=SIX, abs=1e-12), name


def test_hardly_any_answer_is_refused():
    """Where noise drives everything and sensors see everything, every tolerance has a steady state (section 6)."""
    total, refused = 0, []
    for kind in KINDS:
        if kind == "quiet":
            continue
        for seed in range(1000, 1000 + sized(12, 250)):
            network, tolerance = hard_network(kind, seed)
            table = design.choose_tolerances(network, tolerance)
            for name, _, state, _ in filters(table):
                total += 1
                if str(state.status) not in (Status.OK, Status.OSCILLATES):
                    refused.append((kind, seed, name, str(state.status), str(state.reason)))
    assert len(refused) <= 0.01 * total, refused


@pytest.mark.parametrize("seed", range(12))
def test_without_noise_a_stable_plant_has_no_steady_state(seed: int):
    """kappa_c |A|^2 < 1: P falls to zero from every start, and no theta spends c on P = 0."""
    rng = np.random.default_rng(seed)
    n = 1 + seed % 3
    A = rng.normal(size=(n, n))
    A *= 0.3 / np.linalg.norm(A, 2)
    network = SensorNetwork(
        A=A, Q=np.zeros((n, n)), C=[rng.normal(size=(1, n)), rng.normal(size=(2, n))], R=[np.eye(1), np.eye(2)],
        edges=[[0, 1]],
    )  # fmt: skip
    table = design.choose_tolerances(network, 0.005)
    assert str(table.central.status) == "no-steady-state"
    assert "falls to zero" in str(table.central.reason)
    assert not table.local.exists.any()
    assert np.isnan(table.local.tolerance).all()
    plain = analysis.solve_steady_state(network, 0.0)
    assert str(plain.status) == "ok"
    np.testing.assert_array_equal(plain.P, 0.0)


@pytest.mark.parametrize("noise", [1e-6, 1e-12, 1e-20, 1e-100])
@pytest.mark.parametrize("c", [1e-4, 0.02, 5.0])
def test_the_tolerance_alone_keeps_a_filter_awake(noise: float, c: float):
    """n = 1: V = kappa P, so P = A^2 kappa P / (1 + kappa S P) + Q, a quadratic; from a tiny start P grows for long."""
    A, S = 0.999, 1.0
    state = analysis.solve_steady_states(np.array([[A]]), np.array([[noise]]), np.array([[[S]]]), np.array([c]))[0]
    kappa = 1 + float(scalar_excess(np.array([c]))[0])
    b = 1 - A * A * kappa - kappa * S * noise
    root = np.sqrt(b * b + 4 * kappa * S * noise)
    P = (root - b) / (2 * kappa * S) if b < 0 else 2 * noise / (b + root)
    assert str(state.status) == "ok"
    assert float(state.P[0, 0]) == pytest.approx(P, rel=1e-9)
    assert float(state.theta) == pytest.approx((1 - 1 / kappa) / P, rel=1e-9)


def test_a_plant_that_grows_undriven_has_a_filter():
    """One mode grows and no noise drives it: the stabilising solution is not the one that is reached from P = 0.

    A scalar grows by a and is seen through R: P = a^2 P / (1 + P / R) gives P = (a^2 - 1) R.
    """
    a, R = 1.25, 8.0
    A, Q, S = np.diag([a, 0.5]), np.diag([0.0, 1.0]), np.diag([1 / R, 3.0])
    state = analysis.solve_steady_states(A, Q, S[None], np.zeros(1), undriven=True)[0]
    assert str(state.status) == "ok"
    assert float(state.P[0, 0]) == pytest.approx((a * a - 1) * R, rel=1e-12)
    assert float(state.spectral_radius) == pytest.approx(1 / a, rel=1e-9)
    robust = analysis.solve_steady_states(A, Q, S[None], np.full(1, 0.02), undriven=True)[0]
    assert str(robust.status) == "ok"
    assert float(robust.P[0, 0]) > float(state.P[0, 0])


@pytest.mark.parametrize("n", [13, 16, 20])
@pytest.mark.parametrize("decades", [0, 4, 8])
def test_attraction_is_the_same_in_all_units(n: int, decades: int):
    """By Arnoldi's method beyond 12 states; against the dense derivative."""
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    d = 10 ** rng.uniform(-decades, decades, n)
    C = rng.normal(size=(n // 2, n)) / d
    A, Q, S = A * d[:, None] / d, np.diag(d**2 * rng.uniform(0.1, 1, n)), C.T @ C
    state = analysis.solve_steady_states(A, Q, S[None], np.full(1, 0.02))[0]
    recursion = Recursion(A, Q, S[None], np.full(1, 0.02))
    slope = derivative(recursion, step(recursion, state.P[None]))
    dense = float(np.abs(np.linalg.eigvals(slope.matrix()[0])).max())
    assert str(state.status) == "ok"
    assert float(state.attraction) == pytest.approx(dense, rel=1e-7)
