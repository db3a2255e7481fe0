"""Robust collective observability: sums of eqs. (6) and (11) against the textbook, windows, nodes, and the long run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.instances_corrupted import drawn
from tests.reference import naive_channels as naive

from tolnet import model
from tolnet.analysis import robust_observability
from tolnet.model import CorruptedNetwork, InputError, UnsupportedError
from tolnet.model.examples import field
from tolnet.model.observability import FORMS

EYE = np.eye(2)


def network_of(**changes: Any) -> CorruptedNetwork:
    """Two states, the first one unstable; node 0 sees the first, node 1 the second."""
    given = {
        "A": [[1.1, 0.0], [0.0, 0.5]],
        "Q": EYE,
        "C": [[[1.0, 0.0]], [[0.0, 1.0]]],
        "R": [[[1.0]], [[1.0]]],
        "edges": [[0, 1]],
        "states": ["heat", "drift"],
    }
    return CorruptedNetwork(**{**given, **changes})


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(6))
def test_it_agrees_with_the_textbook_over_a_horizon(seed: int, form: str):
    network = drawn(seed)
    L, H = 3, 6
    found = robust_observability(network, form=form, horizon=H, window=L)  # pyright: ignore[reportArgumentType]
    sums = [naive.gramians(network, start, L, form) for start in range(H - L + 2)]
    least = [np.linalg.eigvalsh(total)[0] for total in sums]
    np.testing.assert_allclose(found.alpha_over_time, least, rtol=1e-6, atol=1e-12)
    assert found.alpha == pytest.approx(min(least), rel=1e-6, abs=1e-12)
    worst = sums[int(np.argmin(least))]
    v = found.weakest_direction
    assert v @ worst @ v == pytest.approx(min(least), rel=1e-6, abs=1e-11)
    for i in range(network.N):
        without = [naive.gramians(network, start, L, form, left_out=i) for start in range(H - L + 2)]
        least_without = min(np.linalg.eigvalsh(total)[0] for total in without)
        assert found.alpha_without_node[i] == pytest.approx(least_without, rel=1e-6, abs=1e-11)
        alone = min(np.linalg.eigvalsh(a - b)[0] for a, b in zip(sums, without, strict=True))
        assert found.alpha_of_node[i] == pytest.approx(alone, rel=1e-5, abs=1e-10)
        twice = min(np.linalg.eigvalsh(2 * a - b)[0] for a, b in zip(sums, without, strict=True))
        assert found.alpha_with_copy[i] == pytest.approx(twice, rel=1e-6, abs=1e-11)


@pytest.mark.parametrize("seed", range(6))
def test_for_every_k_is_the_least_of_a_long_horizon(seed: int):
    network = drawn(seed)
    A = network.A.one_period
    shrunk = drawn(seed, A=list(0.8 * A / np.abs(np.linalg.eigvals(A)).max()) if len(A) > 1 else 0.3 * A[0])
    for form in FORMS:
        L = 2
        ever = robust_observability(shrunk, form=form, window=L)  # pyright: ignore[reportArgumentType]
        long = robust_observability(shrunk, form=form, window=L, horizon=80)  # pyright: ignore[reportArgumentType]
        if form != "stated":  # whose recursion may grow although the state does not
            assert ever.alpha == pytest.approx(long.alpha, rel=1e-6, abs=1e-12)
        else:
            assert ever.alpha <= long.alpha * (1 + 1e-9)


def test_windows_grow_until_everything_is_seen():
    chain = np.eye(4, k=1) + 0.5 * np.eye(4)
    network = CorruptedNetwork(A=chain, Q=np.eye(4), C=[[[1.0, 0, 0, 0]]], R=[[[1.0]]], edges=[])
    found = robust_observability(network)
    assert (found.window, found.holds) == (4, True)
    assert (found.alpha_by_window[:3] == 0).all()
    assert found.alpha_by_window[3] > 0
    asked = robust_observability(network, window=3)
    assert (asked.holds, asked.alpha) == (False, 0.0)
    assert "no sensor sees" in asked.reason


def test_the_window_of_a_periodic_plant_may_span_periods():
    turn = [np.eye(3), np.eye(3)[[1, 2, 0]]]
    network = CorruptedNetwork(A=turn, Q=np.eye(3), C=[[[1.0, 0, 0]]], R=[[[1.0]]], edges=[])
    found = robust_observability(network)
    assert found.holds
    assert found.window == 6 - 1
    assert not robust_observability(network, window=4).holds


def test_classical_falls_out_without_fading():
    network = model.CorruptedNetwork.of(model.example("projectile"))
    alphas = {form: robust_observability(network, form=form).alpha for form in FORMS}  # pyright: ignore
    assert alphas["sharp"] == alphas["classical"] == alphas["stated"] > 0


def test_units_do_not_matter_to_the_verdict():
    scale = np.diag([1e-6, 1e6])
    network = network_of(C=[[[1e-6, 0.0]], [[0.0, 1e6]]])
    assert robust_observability(network).holds
    assert robust_observability(network).alpha == pytest.approx(1e-12)
    assert robust_observability(network_of(A=scale @ [[1.1, 0.1], [0.0, 0.5]] @ np.linalg.inv(scale))).holds


def test_an_unstable_mode_that_only_fading_sensors_see_is_lost():
    fading = network_of(fading_mean=0.9, fading_variance=[0.01, 0.0])
    found = robust_observability(fading)
    assert not found.holds
    assert [mode.nodes for mode in found.lost] == [(0,)]
    assert "+1 heat does not decay and is seen only by fading sensors (node 0)" in found.reason
    assert abs(found.weakest_direction[0]) == pytest.approx(1.0)
    assert robust_observability(fading, horizon=20).holds
    # The neighbouring truth: without fading there, or with a plant that decays, it holds.
    assert robust_observability(network_of(fading_mean=0.9, fading_variance=[0.0, 0.01])).holds
    assert robust_observability(network_of(A=0.5 * EYE, fading_mean=0.9, fading_variance=0.01)).holds


def test_one_sensor_that_does_not_fade_is_enough():
    network = network_of(
        C=[[[1.0, 0.0]], [[1.0, 1.0]]], fading_mean=0.9, fading_variance=[0.01, 0.0], A=[[1.1, 0.0], [0.0, 1.05]]
    )
    found = robust_observability(network)
    assert found.holds
    assert found.alpha_without_node[1] == 0
    assert found.alpha_without_node[0] == pytest.approx(found.alpha)


def test_of_several_outputs_the_combinations_that_do_not_grow_still_count():
    """Both outputs see the growing state alike, so their difference sees only the other one, and keeps its noise."""
    given: dict[str, Any] = {
        "A": [[1.2, 0.0], [0.0, 0.5]],
        "C": [[[1.0, 1.0], [1.0, -1.0]], [[1.0, 0.0]]],
        "R": [EYE, [[1.0]]],
        "fading_mean": [0.5, 1.0],
        "fading_variance": [0.1, 0.0],
    }
    found = robust_observability(network_of(**given))
    assert found.holds
    Pi = 4 / 3 + 0  # 1 / (1 - 0.25)
    kept = 0.25 * 4 / (2 + 0.1 * 4 * Pi)  # of (y1 - y2): C = (0, 2), R = 2
    assert found.alpha_limit is not None
    assert found.alpha_limit[0] == pytest.approx(min(1.0, kept), rel=1e-9)


def test_the_surrogate_fails_in_the_long_run_only():
    found = robust_observability(field())
    assert not found.holds
    assert found.lost == ()
    assert found.worst_start is None
    np.testing.assert_allclose(np.abs(found.growing.ravel()), 0.5, atol=1e-12)
    np.testing.assert_allclose(np.abs(found.weakest_direction), [0, np.sqrt(0.5), 0, np.sqrt(0.5)], atol=1e-9)
    np.testing.assert_array_equal(found.alpha_with_state > 0, [False, True, False, True])
    over_time = robust_observability(field(), horizon=100)
    assert over_time.holds
    assert over_time.alpha == pytest.approx(0.11601834, abs=1e-8)
    assert over_time.worst_start == 100


def test_the_stated_form_is_never_above_the_sharp_one():
    for seed in range(12):
        network = drawn(seed)
        alpha = {
            form: robust_observability(network, form=form, horizon=8, window=2).alpha_over_time  # pyright: ignore
            for form in FORMS
        }
        assert (alpha["stated"] <= alpha["sharp"] * (1 + 1e-9) + 1e-14).all()
        assert (alpha["sharp"] <= alpha["classical"] * (1 + 1e-9) + 1e-14).all()


def test_functions_of_k_need_a_horizon():
    network = network_of(A=lambda k: np.diag([1.1 + 0.01 * k, 0.5]))
    with pytest.raises(UnsupportedError, match="give a horizon"):
        robust_observability(network)
    assert robust_observability(network, horizon=5).holds


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"window": 0}, "the window is 0"),
        ({"horizon": -1}, "the horizon is -1"),
        ({"horizon": 3, "window": 5}, "1 to 4 was expected"),
    ],
)
def test_refusals(given: dict[str, Any], said: str):
    with pytest.raises(InputError, match=said):
        robust_observability(network_of(), **given)


def test_windows_from_some_starts_are_those_windows():
    import tolnet.analysis.observability as module
    from tolnet.analysis.second_moment import second_moment_limit

    for seed in range(4):
        network = drawn(seed)
        limit = second_moment_limit(network)
        for horizon in (None, 7):
            path = module._path(network, "sharp", horizon, limit)
            every = path.windows(path.Y, 3)
            starts = np.arange(len(every))[::2]
            for one, other in zip(path.windows_from(starts, 3), every[starts], strict=True):
                np.testing.assert_allclose(one.mT @ one, other.mT @ other, atol=1e-9 * np.abs(other).max() ** 2)


def test_in_large_networks_the_weakest_windows_decide(monkeypatch: pytest.MonkeyPatch):
    network = field()
    found = robust_observability(network, horizon=100, window=2)
    monkeypatch.setattr("tolnet.analysis.observability._EVERY_START", 40)
    fewer = robust_observability(network, horizon=100, window=2)
    for key in ("alpha_without_node", "alpha_of_node", "alpha_with_copy"):
        np.testing.assert_allclose(getattr(fewer, key), getattr(found, key), rtol=1e-9, atol=1e-15)
