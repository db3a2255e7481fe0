"""What the filter settles on: a fixed point that attracts, ordered by channels, and safe to deploy as a table."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.instances_corrupted import arguments
from tests.reference import naive_channels as naive

from tolnet.analysis import error_bound, follow_drkf, multiplicative_noise_condition, solve_drkf, sweep_drkf
from tolnet.model import CorruptedNetwork, InputError, Status, UnsupportedError
from tolnet.model.examples import field


def stable(seed: int, **changes: Any) -> CorruptedNetwork:
    """A network whose state does not grow."""
    given = arguments(seed)
    A = np.array(given["A"])
    changes = {"A": 0.6 * A / np.linalg.norm(A, 2, axis=(-2, -1), keepdims=True), **changes}
    return CorruptedNetwork(**{**given, **changes})


def above(one: np.ndarray, other: np.ndarray) -> float:
    """The least eigenvalue of one - other, over the size of one."""
    return float(np.linalg.eigvalsh(one - other).min() / np.abs(one).max())


@pytest.mark.parametrize("seed", range(8))
def test_it_is_a_fixed_point_of_the_textbook(seed: int):
    network = stable(seed)
    found = solve_drkf(network, channel="worst")
    assert found.status == Status.OK
    assert found.error < 1e-9
    T = len(found.P)
    Pi = network.initial_second_moment
    for k in range(400):
        A, F = network.A(k), network.F(k)
        Pi = A @ Pi @ A.T + float(network.mu(k)) * F @ Pi @ F.T + network.Q(k)
    k = 401  # Pi belongs to instant 400
    P = found.P[400 % T]
    D = {(i, j): network.D_bar(k)[e] for e, (i, j) in enumerate(network.pairs.tolist()) if i != j}
    expected, gains, updated, _ = naive.step(network, k, P, Pi, D)
    np.testing.assert_allclose(found.P[k % T], expected, rtol=1e-8)
    np.testing.assert_allclose(found.P_tilde[k % T], updated, rtol=1e-8)
    for i, K in enumerate(gains):
        np.testing.assert_allclose(found.gain(i, k % T), K, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_it_attracts_from_above_and_below(seed: int):
    network = stable(seed)
    found = solve_drkf(network, channel="best")
    for scale in (1e-6, 1e6):
        P_0 = scale * np.eye(network.n)
        other = stable(seed, initial_covariance=P_0)
        last = follow_drkf(other, 60 * len(found.P), channel="best").P[-1]
        np.testing.assert_allclose(last, found.P[0], rtol=1e-8)


def test_the_error_is_an_error():
    """A recursion that is stopped early lies within its own bound of the solution."""
    import tolnet.analysis.drkf_steady_state as module

    network = stable(3)
    exact = solve_drkf(network)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "TOLERANCE", 1e-3)
        patch.setattr(module, "SIX_DIGITS", 1.0)
        early = solve_drkf(network)
    assert exact.error < 1e-10 < early.error
    assert above((1 + early.error) * early.P, exact.P) > -1e-12
    assert above(exact.P, early.P / (1 + early.error)) > -1e-12


def test_channels_are_ordered():
    for network in (field(), stable(1), stable(2)):
        worst, clean, best = (solve_drkf(network, channel=channel).P for channel in ("worst", "clean", "best"))
        assert above(worst, clean) > -1e-12
        assert above(clean, best) > -1e-12


@pytest.mark.parametrize("seed", range(4))
def test_no_realisation_is_above_the_worst_channels(seed: int):
    network = stable(seed)
    generator = np.random.default_rng(seed)
    worst = follow_drkf(network, 10, channel="worst")
    P, Pi = network.initial_covariance, network.initial_second_moment
    for k in range(1, 11):
        D = {}
        for e, (i, j) in enumerate(network.pairs.tolist()):
            if i != j:
                D[i, j] = generator.choice([-1.0, 1.0, 0.3]) * network.D_bar(k)[e]
        P, _, _, Pi = naive.step(network, k, P, Pi, D)
        assert above(worst.P[k], P) > -1e-10


@pytest.mark.parametrize("seed", range(4))
def test_the_table_of_gains_bounds_the_true_errors_without_sent_matrices(seed: int):
    """The exact covariance of state and errors under the fixed gains and weights, against P of the table."""
    given = arguments(seed)
    A = np.array(given["A"]).reshape(-1, *np.array(given["A"]).shape[-2:])[0]
    network = stable(seed, A=0.6 * A / np.linalg.norm(A, 2), multiplicative_variance=0.2)
    found = solve_drkf(network, channel="best")
    P, W, n, N = found.P[0], found.weights[0], network.n, network.N
    now, size = network.at(0), (N + 1) * n
    fuse = np.eye(size)
    fuse[n:, n:] = 0.0
    noise = np.zeros((size, size))
    for e, (i, j) in enumerate(network.pairs.tolist()):
        place = slice(n * (i + 1), n * (i + 2))
        fuse[place, n * (j + 1) : n * (j + 2)] = W[e]
        noise[place, place] += W[e] @ now.W_bar[e] @ W[e].T
    np.testing.assert_allclose(fuse[n:, n:] @ np.tile(np.eye(n), (N, 1)), np.tile(np.eye(n), (N, 1)), atol=1e-10)
    move, shake = np.kron(np.eye(N + 1), now.A), np.zeros((size, size))
    shake[:, :n] = np.vstack([now.F] + [-now.F] * N)
    ones = np.vstack([np.eye(n)] + [-np.eye(n)] * N)
    correct, drive, fade = np.eye(size), np.zeros((size, size)), []
    for i in range(N):
        C, K = now.sensors.C[network.rows[i] : network.rows[i + 1]], found.gain(i)
        place = slice(n * (i + 1), n * (i + 2))
        correct[place, place] -= now.tau[i] * K @ C
        drive[place, place] = K @ now.sensors.block(i) @ K.T
        fading = np.zeros((size, size))
        fading[place, :n] = K @ C
        fade.append((float(now.phi[i]), fading))
    S = np.zeros((size, size))
    for _ in range(300):
        S = move @ S @ move.T + now.mu * shake @ S @ shake.T + ones @ now.Q @ ones.T
        S = correct @ S @ correct.T + sum(phi * B @ S @ B.T for phi, B in fade) + drive
        S = fuse @ S @ fuse.T + noise
    for i in range(N):
        place = slice(n * (i + 1), n * (i + 2))
        assert above(P[i], S[place, place]) > -1e-9
    assert np.trace(S[n:, n:]) > 0.05 * np.trace(P, axis1=1, axis2=2).sum()


def test_an_unstable_mode_that_nobody_sees():
    given: dict[str, Any] = {"A": np.diag([1.1, 0.5]), "Q": np.eye(2), "R": [[[1.0]]], "edges": []}
    blind = CorruptedNetwork(**given, C=[[[0.0, 1.0]]])
    assert solve_drkf(blind).status == Status.UNDETECTABLE
    assert "is seen by nobody" in solve_drkf(blind).reason
    assert np.isnan(solve_drkf(blind).P).all()
    fading = CorruptedNetwork(**given, C=[[[1.0, 0.0]]], fading_mean=0.9, fading_variance=0.01)
    assert "only by fading sensors" in solve_drkf(fading).reason
    assert solve_drkf(CorruptedNetwork(**given, C=[[[1.0, 0.0]]])).status == Status.OK


def test_noise_on_a_growing_direction():
    one = np.eye(2)
    given: dict[str, Any] = {"A": np.diag([1.1, 0.5]), "Q": one, "C": [one], "R": [one], "edges": []}
    driven = CorruptedNetwork(**given, F=np.diag([1.0, 0.0]), multiplicative_variance=0.1)
    assert solve_drkf(driven).status == Status.DIVERGES
    noise = multiplicative_noise_condition(driven)
    assert (noise.holds, noise.supremum) == (False, np.inf)
    apart = CorruptedNetwork(**given, F=np.diag([0.0, 1.0]), multiplicative_variance=0.1)
    assert solve_drkf(apart).status == Status.OK
    assert multiplicative_noise_condition(apart).holds


def test_sweeps():
    network = field()
    found = sweep_drkf(network, "matrix_noise", [0.0, 1.0, 2.0], relative=True)
    traces = [each.trace.mean() for each in found]
    assert traces == sorted(traces)
    assert traces[1] == pytest.approx(solve_drkf(network).trace.mean())
    absolute = sweep_drkf(network, "matrix_noise", [0.4])[0]
    assert absolute.trace.mean() == pytest.approx(traces[1])
    fading = [each.trace.mean() for each in sweep_drkf(network, "fading_mean", [0.5, 1.0], relative=True)]
    assert fading[0] > fading[1]
    with pytest.raises(InputError, match="cannot be swept"):
        sweep_drkf(network, "A", [1.0])


def test_functions_of_k_have_no_steady_state():
    network = field().replaced(multiplicative_variance=lambda k: 1.0 + 0.1 * np.cos(k))
    with pytest.raises(UnsupportedError, match="give a horizon"):
        solve_drkf(network)
    assert np.isfinite(follow_drkf(network, 20).P).all()


def test_the_ingredients_of_the_bound():
    """By hand: one state, two nodes, window 1."""
    network = CorruptedNetwork(
        A=[[2.0]],
        Q=[[0.5]],
        C=[[[1.0]], [[2.0]]],
        R=[[[1.0]], [[2.0]]],
        fading_mean=[1.0, 0.5],
        estimate_noise=0.1,
        matrix_noise=0.2,
        edges=[[0, 1]],
        fusion=[[0.75, 0.25], [0.5, 0.5]],
    )
    found = error_bound(network)
    p_min = 1 / (2 + 1)  # tau^2 |C|^2 |R^-1| is 1 and 0.25 * 4 / 2
    eta, beta = p_min / (p_min + 0.5), p_min * 4 / (p_min * 4 + 0.5)
    assert (found.start, found.applies) == (2, True)
    assert found.p_min == pytest.approx(p_min)
    assert (found.eta, found.beta) == (pytest.approx(eta), pytest.approx(beta))
    assert (found.a_min, found.q_hat) == (0.25, 0.5)
    assert found.observability.alpha == pytest.approx(1 + 0.25 * 4 / 2)
    assert found.bound == pytest.approx(1 / (0.25 * eta) / 1.5)


@pytest.mark.parametrize("seed", range(6))
def test_the_bound_of_the_theorem_is_one(seed: int):
    network = stable(seed)
    found = error_bound(network)
    if not found.applies:
        assert found.observability.alpha == 0
        assert np.isinf(found.bound)
        return
    history = follow_drkf(network, found.start + 10, channel="worst")
    largest = np.linalg.eigvalsh(history.P[found.start :]).max()
    assert largest <= found.bound
    assert found.computed <= found.bound


@pytest.mark.parametrize("seed", range(6))
def test_what_the_multiplicative_noise_makes_stays_below_its_bound(seed: int):
    network = stable(seed)
    found = multiplicative_noise_condition(network)
    Pi, sizes = network.initial_second_moment, []
    for k in range(200):
        F = network.F(k)
        sizes.append(float(network.mu(k)) * np.linalg.norm(F @ Pi @ F.T, 2))
        A = network.A(k)
        Pi = A @ Pi @ A.T + float(network.mu(k)) * F @ Pi @ F.T + network.Q(k)
    assert max(sizes) == pytest.approx(found.supremum, rel=1e-9)
    assert found.supremum <= found.bound * (1 + 1e-9)
    assert (found.growth < 1) == np.isfinite(found.bound)


def test_the_surrogate():
    noise = multiplicative_noise_condition(field())
    assert noise.holds
    assert noise.a.max() == pytest.approx(0.84**2 + 0.09, abs=1e-3)
    bound = error_bound(field())
    assert not bound.applies
    assert np.isinf(bound.bound)
    finite = error_bound(field(), horizon=100)
    assert finite.applies
    assert finite.bound > 1e5 * finite.computed
