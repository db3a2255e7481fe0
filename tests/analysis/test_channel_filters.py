"""Every filter over corrupted channels against a plain loop over nodes, run by run, on the same draws."""

from __future__ import annotations

import numpy as np
import pytest
from numpy import ndarray
from tests.corrupted_networks import odd_network
from tests.reference.corrupted_loop import LOOPS, Run

from tolnet import model
from tolnet.analysis import follow_window, fusion_window
from tolnet.analysis.channel_filters import DrkfSwf, moments
from tolnet.analysis.comparison_filters import scalar_gain
from tolnet.analysis.corrupted_simulation import CHANNEL_FILTERS
from tolnet.analysis.corrupted_truth import CorruptedInstant, walk_corrupted
from tolnet.model import CorruptedNetwork

RUNS, STEPS = 2, 8


def drawn(network: CorruptedNetwork, *, shared: bool = False) -> list[CorruptedInstant]:
    rng, path = (np.random.default_rng(seed) for seed in (1, 2))
    return list(walk_corrupted(network, rng, path, runs=RUNS, steps=STEPS, shared=shared))


def followed(network: CorruptedNetwork, name: str, walk: list[CorruptedInstant]) -> tuple[ndarray, ndarray | None]:
    """Estimates and covariances at every instant."""
    each = CHANNEL_FILTERS[name](network, RUNS)
    x, P = [each.x], [each.P]
    for moment, instant in zip(moments(network, STEPS), walk[1:], strict=True):
        each.step(moment, instant)
        x.append(each.x)
        P.append(each.P)
    every = [np.broadcast_to(p, (RUNS, *p.shape[1:])) for p in P if p is not None]
    return np.stack(x), np.stack(every) if every else None


NETWORKS = {
    "field": lambda: model.example("field"),
    "field with a window": lambda: with_window(model.example("field"), 3, 2),
    "odd": odd_network,
}


def with_window(network: CorruptedNetwork, window: int, interval: int) -> CorruptedNetwork:
    object.__setattr__(network, "window", window)
    object.__setattr__(network, "interval", np.full(network.N, interval))
    return network


@pytest.mark.parametrize("instance", NETWORKS)
@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("shared", [False, True])
def test_the_plain_loop_agrees(instance: str, name: str, shared: bool):
    network = NETWORKS[instance]()
    walk = drawn(network, shared=shared)
    x, P = followed(network, name, walk)
    for run in range(RUNS):
        one: Run = [(at.x[run], at.y[run], at.e[run], at.D[run if len(at.D) > 1 else 0]) for at in walk]
        want_x, want_P = LOOPS[name](network, one)
        # where weights come from a program, its flat optimum leaves them some digits
        tolerance = 1e-4 if name == "DRKF-SWF" else 1e-8
        np.testing.assert_allclose(x[:, run], want_x, rtol=tolerance, atol=tolerance)
        if P is not None:
            np.testing.assert_allclose(P[:, run], want_P, rtol=tolerance, atol=tolerance)


def test_the_gain_of_the_loop_is_that_of_unit_sensors():
    assert scalar_gain(model.example("field")) == pytest.approx(0.25)
    assert scalar_gain(odd_network()) == pytest.approx(0.25)


@pytest.mark.parametrize("name", ["CKF", "CSGF"])
def test_the_mean_of_the_fading_counts_where_something_fades(name: str):
    fading = odd_network()
    for network, same in ((fading.replaced(fading_mean=1.0, fading_variance=0.0), True), (fading, False)):
        walk = drawn(network)
        without, knowing = (followed(network, each, walk)[0] for each in (name, f"{name}-tau"))
        assert np.array_equal(without, knowing) == same
        assert not np.array_equal(knowing[0], knowing[-1])


def test_everything_that_is_drawn_is_as_large_as_the_bounds_allow():
    """Second moments of 20,000 draws: fading, channel and measurement noise, process and multiplicative noise."""
    network = odd_network()
    walk = walk_corrupted(
        network, np.random.default_rng(0), np.random.default_rng(1), runs=20_000, steps=2, shared=False
    )
    start, first, _ = list(walk)
    mean = network.initial_mean
    np.testing.assert_allclose(start.x.mean(axis=0), mean, atol=0.05)
    np.testing.assert_allclose(start.x.T @ start.x / 20_000, network.initial_second_moment, rtol=0.05, atol=0.1)
    Pi = moments(network, 1)[0].Pi
    np.testing.assert_allclose(first.x.T @ first.x / 20_000, Pi, rtol=0.1, atol=0.1)
    own = network.pairs[:, 0] == network.pairs[:, 1]
    assert (first.e[:, own] == 0).all()
    assert (first.D[:, own] == 0).all()
    for r in np.flatnonzero(~own):
        bound = network.W_bar(1)[r]
        np.testing.assert_allclose(np.cov(first.e[:, r].T), bound, atol=0.03 * bound[0, 0])
        np.testing.assert_array_equal(first.D[:, r], first.D[:, r].swapaxes(1, 2))
        reach = np.abs(np.linalg.eigvalsh(first.D[:, r])).max()
        bound = network.D_bar(1)[r, 0, 0]
        assert 0.7 * bound < reach <= bound * (1 + 1e-12)
    C = network.C(1)
    for i, rows in enumerate(np.split(np.arange(5), network.rows[1:-1])):
        for m in rows:
            seen = first.x @ C[m]
            slope = (first.y[:, m] @ seen) / (seen @ seen)
            assert slope == pytest.approx(network.tau(1)[i], abs=0.02)
            spread = ((first.y[:, m] - network.tau(1)[i] * seen) ** 2).mean()
            assert spread == pytest.approx(1 + 0.3 * len(rows) + network.phi(1)[i] * (seen**2).mean(), rel=0.05)


def test_a_start_that_is_surer_than_the_second_moment_is_believed():
    network = CorruptedNetwork(
        A=[[0.9]], Q=[[1.0]], C=[[[1.0]], [[1.0]]], R=[[[1.0]], [[1.0]]], edges=[[0, 1]],
        initial_covariance=[[[4.0]], [[0.25]]], initial_second_moment=[[9.0]],
    )  # fmt: skip
    (start,) = walk_corrupted(
        network, np.random.default_rng(0), np.random.default_rng(0), runs=20_000, steps=0, shared=True
    )
    assert start.x.var() == pytest.approx(0.25, rel=0.05)


def test_fading_kinds_and_contradictions():
    def of(fading: str, variance: float, **more: object) -> CorruptedNetwork:
        return CorruptedNetwork(
            A=[[0.9]], Q=[[1.0]], C=[[[1.0]]], R=[[[1e-12]]], edges=[], fading_mean=0.7, fading_variance=variance,
            initial_mean=[0.5], simulation=model.SimulationModel(fading=fading), **more,  # pyright: ignore
        )  # fmt: skip

    def factors(network: CorruptedNetwork) -> ndarray:
        _, first = walk_corrupted(
            network, np.random.default_rng(0), np.random.default_rng(0), runs=4_000, steps=1, shared=True
        )
        return first.y[:, 0] / first.x[:, 0]

    np.testing.assert_allclose(factors(of("constant", 0.1)), 0.7, atol=1e-2)
    coin = factors(of("bernoulli", 0.7 * 0.3))
    assert coin.mean() == pytest.approx(0.7, abs=0.03)
    assert set(np.round(coin).astype(int)) == {0, 1}
    wide = factors(of("uniform", 0.2))
    assert 0.39 < wide.min() < 0.45  # the variance of 0.2 would leave [0, 1]: the half width ends at 1 - 0.7
    assert 0.95 < wide.max() <= 1.01
    with pytest.raises(model.InputError, match=r"sensors\[0\]\.fading_variance is 0\.01; Bernoulli fading"):
        factors(of("bernoulli", 0.01))
    with pytest.raises(model.InputError, match=r"plant\.initial_second_moment is below the square"):
        factors(of("uniform", 0.0, initial_second_moment=[[0.1]]))


def test_algorithm_2_is_below_algorithm_1_at_every_step_and_node():
    """Eq. (18), on one realisation of the channel noise for both; and the mutant that skips (17)'s constraint."""
    for network in (with_window(model.example("field"), 2, 1), odd_network(3, window=3, interval=1)):
        walk = drawn(network)
        _, P1 = followed(network, "DRKF", walk)
        _, P2 = followed(network, "DRKF-SWF", walk)
        assert P1 is not None
        assert P2 is not None
        root = np.linalg.inv(np.linalg.cholesky(P1))
        relative = np.linalg.eigvalsh(root @ P2 @ root.mT)
        assert relative.max() <= 1 + 1e-8
        assert relative.min() < 0.97


def test_windows_and_intervals_of_nothing_are_algorithm_1():
    network = odd_network(window=1, interval=10**6)
    walk = drawn(network)
    x, P = followed(network, "DRKF-SWF", walk)
    plain_x, plain_P = followed(network, "DRKF", walk)
    np.testing.assert_array_equal(x, plain_x)
    np.testing.assert_array_equal(P, plain_P)


def test_nodes_of_different_degree_in_one_stack(monkeypatch: pytest.MonkeyPatch):
    """Slots without a pair fill it up; the same comes out, and nothing of a slot is seen."""
    network = odd_network(window=3, interval=1)
    degree = np.diff(network.fusion.indptr)
    assert len(set(degree.tolist())) > 1
    found = []
    for enough in (1, 1_000):
        monkeypatch.setattr(fusion_window, "_ENOUGH", enough)
        found.append(follow_window(network, STEPS, window=np.array([1, 3, 3, 2, 3])))
    apart, together = found
    np.testing.assert_allclose(together.node_trace, apart.node_trace, rtol=1e-6)
    assert (together.solves, together.fallbacks) == (apart.solves, apart.fallbacks) == (5 * STEPS, 0)
    for node, (rows, weights) in together.solved.items():
        np.testing.assert_array_equal(network.pairs[rows, 0], [node] * degree[node])
        assert weights.sum() == pytest.approx(1, abs=1e-12)


def test_weights_that_fail_their_check_leave_algorithm_1(monkeypatch: pytest.MonkeyPatch):
    network = odd_network(window=2, interval=1)
    walk = drawn(network)
    plain_x, _ = followed(network, "DRKF", walk)
    honest = fusion_window.solve_fusion_weights

    def spoilt(information: ndarray, reference: ndarray) -> model.FusionWeights:
        found = honest(information, reference)
        bound = np.full_like(found.bound, np.nan)
        return model.FusionWeights(information, reference, found.weights, bound, found.iterations, "mutant")

    monkeypatch.setattr(fusion_window, "solve_fusion_weights", spoilt)
    each = DrkfSwf(network, RUNS)
    for moment, instant in zip(moments(network, STEPS), walk[1:], strict=True):
        each.step(moment, instant)
    np.testing.assert_array_equal(each.x, plain_x[-1])
    assert each.sliding.fallbacks == each.sliding.solves == RUNS * network.N * STEPS
