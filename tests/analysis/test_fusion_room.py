"""The proof that eq. (17) leaves no room: its claims are true, and the neighbouring problem with room is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy import ndarray
from tests.fusion_problems import covariances, some_reference, stale
from tests.reference.exact_fusion import exactly_allowed, is_below, traces

from tolnet.analysis import fusion_weights, solve_fusion_weights
from tolnet.analysis.fusion_room import Room, prove_no_room
from tolnet.model import FusionWeights

GAP = 1e-8


def without_proof(monkeypatch: pytest.MonkeyPatch, Omega: ndarray, a: ndarray) -> FusionWeights:
    """By Newton's method alone."""
    nothing = Room(np.full(len(a), np.nan), np.zeros(len(a), dtype=bool))
    monkeypatch.setattr(fusion_weights, "prove_no_room", lambda *problem: nothing)
    found = solve_fusion_weights(Omega, a)
    monkeypatch.undo()
    return found


def test_two_pairs_neither_of_which_is_above_the_other():
    Omega = np.array([np.diag([4.0, 1.0]), np.diag([1.0, 9.0])])[None]
    room = prove_no_room(Omega, np.array([[0.25, 0.75]]), GAP)
    assert room.none.all()
    assert room.bound[0] == pytest.approx(1 / 1.75 + 1 / 7, rel=1e-12)


@pytest.mark.parametrize("room", [1.0, 1e-3, 1e-6])
def test_a_pair_that_is_better_by_a_little_is_not_denied(room: float):
    """Omega(a) + room vv' for one more pair: P <= P_0 holds there, and the trace is less."""
    rng = np.random.default_rng(0)
    Omega, a = covariances(rng, 100, 4, 3), some_reference(rng, 100, 4)
    v, alone = rng.normal(size=(100, 3)), np.eye(4)[[3] * 100]
    # a little more than Omega(a), so that the pair is above it in doubles as well
    Omega[:, 3] = (1 + 1e-10) * np.einsum("bj,bjkl->bkl", a, Omega) + room * v[:, :, None] * v[:, None, :]
    assert all(exactly_allowed(*problem) for problem in zip(Omega, alone, a, strict=True))
    least = traces(Omega, alone)
    found = prove_no_room(Omega, a, GAP)
    lost = least < (1 - GAP) * traces(Omega, a)
    assert lost.mean() > 0.9
    assert not found.none[lost].any()
    stated = np.isfinite(found.bound)
    assert is_below(found.bound[stated], Omega[stated], alone[stated])


@pytest.mark.parametrize("kind", ["six", "window", "units", "half"])
def test_the_same_answers_with_and_without_it(kind: str, monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(2)
    match kind:
        case "six":
            Omega, a = covariances(rng, 200, 6, 6), np.full((200, 6), 1 / 6)
        case "window":
            Omega, a = stale(rng, 200, 4, 4, 3)
        case "units":
            Omega, a = covariances(rng, 200, 5, 4, units=4.0), rng.dirichlet(np.ones(5), 200)
        case _:
            Omega, a = covariances(rng, 200, 6, 3), some_reference(rng, 200, 6)
    proved = prove_no_room(Omega, a, GAP).none
    found, plain = solve_fusion_weights(Omega, a), without_proof(monkeypatch, Omega, a)
    assert found.ok.all()
    assert 0.05 < proved.mean() < 1
    np.testing.assert_array_equal(found.weights[proved], a[proved])
    assert (found.iterations[proved] == 0).all()
    # each is at most its gap above the least trace, and below it only by what its violation of P <= P_0 buys
    assert max(found.gap.max(), plain.gap.max()) < 1e-6
    np.testing.assert_allclose(found.trace, plain.trace, rtol=1e-6)
    for each in (found, plain):
        assert is_below(each.bound[:60], Omega[:60], each.weights[:60])
        assert is_below(each.bound[:60], Omega[:60], a[:60])


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 5), st.floats(0.0, 1.0))
def test_never_above_allowed_weights(seed: int, n: int, J: int, far: float):
    """Where all pairs are between Omega(a) and something larger, every delta towards them is allowed."""
    rng = np.random.default_rng(seed)
    Omega, a = covariances(rng, 1, J, n), some_reference(rng, 1, J)
    above = (1 + 1e-10) * np.einsum("bj,bjkl->bkl", a, Omega) + far * covariances(rng, 1, 1, n)[:, 0]
    Omega, a = np.concatenate([Omega, above[:, None]], axis=1), np.pad(a, ((0, 0), (0, 1)))
    assert exactly_allowed(Omega[0], np.eye(J + 1)[J], a[0])
    bound = prove_no_room(Omega, a, GAP).bound
    assert np.isnan(bound[0]) or is_below(bound, Omega, np.eye(J + 1)[[J]])


def test_pairs_that_are_alike_and_slots_without_one():
    same = np.broadcast_to(np.diag([1.0, 2.0, 3.0]), (1, 4, 3, 3))
    np.testing.assert_allclose(prove_no_room(same, np.full((1, 4), 0.25), GAP).bound, 1 + 1 / 2 + 1 / 3, rtol=1e-8)
    Omega, a = stale(np.random.default_rng(3), 50, 3, 3, 1)
    padded, wide = np.concatenate([Omega, np.zeros((50, 2, 3, 3))], axis=1), np.pad(a, ((0, 0), (0, 2)))
    filled, plain = prove_no_room(padded, wide, GAP), prove_no_room(Omega, a, GAP)
    np.testing.assert_array_equal(filled.none, plain.none)
    np.testing.assert_allclose(filled.bound, plain.bound, rtol=1e-6)


def test_one_bad_member_leaves_the_others_alone():
    Omega, a = stale(np.random.default_rng(6), 6, 3, 3, 2)
    whole = solve_fusion_weights(Omega, a)
    spoilt = Omega.copy()
    spoilt[1] = 0.0
    spoilt[3, 0, 0, 0] = np.inf
    found = solve_fusion_weights(spoilt, a)
    assert found.status.tolist() == ["ok", "singular", "ok", "singular", "ok", "ok"]
    np.testing.assert_array_equal(found.or_reference()[[1, 3]], a[[1, 3]])
    good = [0, 2, 4, 5]
    np.testing.assert_allclose(found.weights[good], whole.weights[good], rtol=1e-9, atol=1e-12)
    assert not prove_no_room(np.zeros((2, 3, 2, 2)), np.full((2, 3), 1 / 3), GAP).none.any()


def test_hardly_any_room_is_measured_by_the_same_bound():
    """Weights that Newton's method cannot place: its answers break P <= P_0 by rounding, the reference is as good."""
    rng = np.random.default_rng(5)
    Omega = covariances(rng, 200, 1, 3) + 1e-8 * covariances(rng, 200, 3, 3)
    a = rng.dirichlet(np.ones(3), 200)
    found = solve_fusion_weights(Omega, a)
    assert found.ok.all()
    assert found.gap.max() < 1e-6
