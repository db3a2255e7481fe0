"""MSD as a function of weights and gains: values against the solver of performance, gradients against differences."""

from __future__ import annotations

import numpy as np
import pytest
from numpy import ndarray
from scipy import sparse
from tests.instances_random import random_network

from tolnet import analysis, design
from tolnet.analysis import msd_gradient
from tolnet.analysis.msd_gradient import NetworkErrors
from tolnet.design.weights.setting import folded
from tolnet.model import SensorNetwork, ToleranceTable
from tolnet.model.examples import projectile

KINDS = [
    {"n": 1, "N": 2, "relays": 0.0},
    {"n": 2, "N": 4, "directed": True},
    {"n": 3, "N": 5, "relays": 0.4, "state_decades": 2.0},
    {"n": 4, "N": 6, "drives": 2, "singular": True},
]


def instance(seed: int) -> tuple[SensorNetwork, ToleranceTable, NetworkErrors]:
    """A random network whose filters have a performance, at a small tolerance."""
    kind = KINDS[seed % len(KINDS)]
    for attempt in range(50):
        network = random_network(np.random.default_rng([seed, attempt]), radius=0.95, **kind)
        table = design.choose_tolerances(network, 0.01)
        model = analysis.least_favourable_model(network, table.central)
        if table.ok and model.exists:
            return network, table, NetworkErrors(network, table.local, model)
    raise AssertionError("no instance was found")


def random_weights(errors: NetworkErrors, rng: np.random.Generator) -> ndarray:
    w = rng.exponential(size=len(errors.columns.sender))
    return w / errors.columns.sums(w)[errors.columns.hearer]


def matrix(errors: NetworkErrors, w: ndarray) -> sparse.csr_array:
    return sparse.csr_array((w, (errors.columns.sender, errors.columns.hearer)), shape=(errors.K, errors.K))


@pytest.mark.parametrize("seed", range(8))
def test_values_are_those_of_the_solver_of_performance(seed: int):
    network, table, errors = instance(seed)
    w = random_weights(errors, np.random.default_rng(seed))
    model = analysis.least_favourable_model(network, table.central)
    found = analysis.solve_lyapunov(analysis.error_dynamics(network, table.local, matrix(errors, w), model))
    at = errors.solve(w)
    np.testing.assert_allclose(at.node_msd, found.node_msd, rtol=1e-8)
    assert at.residual < 1e-12
    assert at.radius == pytest.approx(found.network_radius, rel=1e-6)
    given = errors.solve(np.concatenate([w, errors.gains]))
    np.testing.assert_allclose(given.node_msd, at.node_msd, rtol=1e-12)


@pytest.mark.parametrize("gains", [False, True])
@pytest.mark.parametrize("seed", range(8))
def test_gradients_agree_with_central_differences(seed: int, gains: bool):
    _, _, errors = instance(seed)
    rng = np.random.default_rng(100 + seed)
    w = random_weights(errors, rng)
    a, b = rng.uniform(size=errors.K), rng.uniform(size=errors.K)
    z = np.concatenate([w, errors.gains]) if gains else w

    def J(z: ndarray) -> float:
        at = errors.solve(z)
        return float(a @ at.node_msd + b @ errors.sent_msd(at))

    g, B = errors.gradient(errors.solve(z), a, b, gains=gains)
    assert g.shape == z.shape
    for _ in range(3):
        d = rng.normal(size=len(z)) * np.maximum(np.abs(z), 1e-3)
        h = 1e-4
        first, second = ((J(z + t * d) - J(z - t * d)) / (2 * t) for t in (h, 2 * h))
        assert (4 * first - second) / 3 == pytest.approx(g @ d, rel=1e-6, abs=1e-6 * np.abs(g * d).sum())
        moved = B.times(d)
        rounding = 1e-9 * np.abs(d * moved).sum() + 1e-14 * J(z)  # where J is linear in W only that is left
        assert d @ moved >= -rounding  # the model of the curvature is semidefinite
        if gains:
            tail = slice(len(w), None)
            back = B.descent(B.times(d))
            assert np.linalg.norm(back[tail] - d[tail]) <= 1e-3 * np.linalg.norm(d[tail])


def test_models_of_the_curvature_add():
    """Exactly for the weights and for gains that are alike; definite where they are not."""
    _, _, errors = instance(2)
    rng = np.random.default_rng(0)
    z = np.concatenate([random_weights(errors, rng), errors.gains])
    other = np.concatenate([random_weights(errors, rng), 0.8 * errors.gains])
    a, b = rng.uniform(size=(2, errors.K))
    one = errors.gradient(errors.solve(z), a, b, gains=True)[1]
    two = errors.gradient(errors.solve(other), a, b, gains=True)[1]
    L = errors.columns.offsets[-1]
    for d in rng.normal(size=(5, len(z))):
        np.testing.assert_allclose((one + one).times(d), 2 * one.times(d), rtol=1e-9, atol=1e-12)
        both = (one + two).times(d)
        np.testing.assert_allclose(both[:L], (one.times(d) + two.times(d))[:L], rtol=1e-9, atol=1e-12)
        assert d[L:] @ both[L:] > 0


def test_a_gradient_without_one_term_is_seen():
    """The mutant: forgetting that the centre's error drives the nodes, the difference is far above the tolerance."""
    _, _, errors = instance(2)
    rng = np.random.default_rng(0)
    z = np.concatenate([random_weights(errors, rng), errors.gains])
    a = np.full(errors.K, 1 / errors.K)
    right, _ = errors.gradient(errors.solve(z), a, gains=True)
    part = errors._parts[0]
    object.__setattr__(part, "steering", np.zeros_like(part.steering))
    wrong, _ = errors.gradient(errors.solve(z), a, gains=True)
    assert np.abs(wrong - right).max() > 1e-4 * np.abs(right).max()


def test_an_unstable_network_has_infinite_msd():
    _, _, errors = instance(1)
    w = random_weights(errors, np.random.default_rng(0))
    h = np.concatenate([w, 50 * errors.gains])
    assert np.isinf(errors.solve(h).node_msd).all()
    assert np.isfinite(errors.solve(w).node_msd).all()


def with_a_link_less(network: SensorNetwork):
    for i in range(len(network.links)):
        yield design.choose_tolerances(network.relinked(np.delete(network.links, i, axis=0)), 0.02)


def test_lost_links_hand_their_weight_to_the_node_itself():
    network = projectile(3)
    table = next(t for t in with_a_link_less(network) if t.ok)
    shorter = table.network
    model = analysis.least_favourable_model(shorter, table.central)
    local = design.choose_tolerances(network, 0.02).local
    whole = NetworkErrors(network, local, analysis.least_favourable_model(network, table.central))
    errors = NetworkErrors(shorter, table.local, model, columns=whole.columns)
    rng = np.random.default_rng(0)
    w = random_weights(whole, rng)
    W = folded(matrix(whole, w), shorter)
    found = analysis.solve_lyapunov(analysis.error_dynamics(shorter, table.local, W, model))
    at = errors.solve(w)
    np.testing.assert_allclose(at.node_msd, found.node_msd, rtol=1e-9)
    a, d = np.full(20, 0.05), rng.normal(size=len(w))
    g, _ = errors.gradient(at, a)
    J = [float(a @ errors.solve(w + t * d).node_msd) for t in (1e-5, -1e-5)]
    assert (J[0] - J[1]) / 2e-5 == pytest.approx(g @ d, rel=1e-6)
    z = np.concatenate([w, whole.gains])  # with the gains of the whole network: those of the lost link are not used
    d = rng.normal(size=len(z)) * np.abs(z)
    g, _ = errors.gradient(errors.solve(z), a, gains=True)
    J = [float(a @ errors.solve(z + t * d).node_msd) for t in (1e-5, -1e-5)]
    assert (J[0] - J[1]) / 2e-5 == pytest.approx(g @ d, rel=1e-6)
    unused = (g == 0) & (z != 0)
    assert unused[len(w) :].any()
    changed = errors.solve(z + unused * rng.normal(size=len(z)))
    np.testing.assert_array_equal(changed.node_msd, errors.solve(z).node_msd)


def test_the_low_rank_of_large_powers_changes_nothing(monkeypatch: pytest.MonkeyPatch):
    network = projectile(3, nodes=30, links=80)
    table = design.choose_tolerances(network, 0.02)
    errors = NetworkErrors(network, table.local, analysis.least_favourable_model(network, table.central))
    w, a = random_weights(errors, np.random.default_rng(0)), np.full(30, 1 / 30)
    monkeypatch.setattr(msd_gradient, "_LARGE", 10**9)
    plain = errors.solve(w)
    monkeypatch.setattr(msd_gradient, "_LARGE", 20)
    short = errors.solve(w)
    assert short.parts[0].powers.V.shape[1] > 0
    assert plain.parts[0].powers.V.shape[1] == 0
    np.testing.assert_allclose(short.node_msd, plain.node_msd, rtol=1e-8)
    found, wanted = (errors.gradient(at, a)[0] for at in (short, plain))
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-8 * np.abs(wanted).max())
