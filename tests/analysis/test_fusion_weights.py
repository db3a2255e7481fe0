"""Newton's method for fusion weights: against closed forms, against a scan, and against what its own bound proves."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy import ndarray
from tests.fusion_problems import covariances, some_reference, stale
from tests.reference.exact_fusion import exact_trace, is_below

from tolnet.analysis import solve_fusion_weights
from tolnet.analysis.fusion_newton import minimise
from tolnet.analysis.stacked import symmetric_part
from tolnet.model import FusionWeights, InputError, ShapeError
from tolnet.model.fusion_weights import lower_bound


def test_one_state_takes_the_best_pair():
    Omega = np.array([0.3, 2.0, 1.0]).reshape(1, 3, 1, 1)
    found = solve_fusion_weights(Omega)
    np.testing.assert_allclose(found.weights, [[0, 1, 0]], atol=1e-7)
    assert found.trace[0] == pytest.approx(0.5, rel=1e-7)


def test_two_pairs_that_see_one_state_each_share():
    """tr diag(1/(4 d + (1 - d)), 1/(d + 9 (1 - d))): d where 3 / (1 + 3 d)^2 = 8 / (9 - 8 d)^2."""
    Omega = np.array([np.diag([4.0, 1.0]), np.diag([1.0, 9.0])])[None]
    found = solve_fusion_weights(Omega)
    d = (9 * np.sqrt(3) - np.sqrt(8)) / (3 * np.sqrt(8) + 8 * np.sqrt(3))
    assert found.weights[0, 0] == pytest.approx(d, abs=1e-4)
    assert found.trace[0] == pytest.approx(1 / (1 + 3 * d) + 1 / (9 - 8 * d), rel=1e-8)


@pytest.mark.parametrize("constrained", [False, True])
def test_two_pairs_against_a_scan(constrained: bool):
    rng = np.random.default_rng(0)
    Omega, a = covariances(rng, 50, 2, 3), rng.dirichlet([1, 1], 50)
    found = solve_fusion_weights(Omega, a if constrained else None)
    for b in range(50):
        d = np.r_[np.linspace(0, 1, 2001), a[b, 0]]
        combined = d[:, None, None] * Omega[b, 0] + (1 - d)[:, None, None] * Omega[b, 1]
        allowed = np.ones(len(d), dtype=bool)
        if constrained:
            floor = a[b, 0] * Omega[b, 0] + a[b, 1] * Omega[b, 1]
            allowed = np.linalg.eigvalsh(combined - floor)[:, 0] >= -1e-12
        best = np.trace(np.linalg.inv(combined[allowed]), axis1=1, axis2=2).min()
        assert best * (1 - 1e-5) <= found.trace[b] <= best * (1 + 1e-8)


PROBLEMS = [(1, 1), (1, 4), (2, 2), (3, 6), (4, 12), (6, 6), (10, 4)]


@pytest.mark.parametrize(("n", "J"), PROBLEMS)
@pytest.mark.parametrize("units", [0.0, 4.0])
@pytest.mark.parametrize("kind", ["free", "uniform", "half"])
def test_every_problem_is_solved_and_proved(n: int, J: int, units: float, kind: str):
    rng = np.random.default_rng(n * 100 + J)
    Omega = covariances(rng, 200, J, n, units=units)
    a = {"free": None, "uniform": np.full((200, J), 1 / J), "half": some_reference(rng, 200, J)}[kind]
    found = solve_fusion_weights(Omega, a)
    assert (found.status == "ok").all()
    assert found.gap.max() < 1e-6
    assert found.gap.min() >= 0
    assert found.violation.max() < 1e-9
    some = slice(0, 20)
    assert is_below(found.bound[some], Omega[some], found.weights[some])
    assert a is None or is_below(found.bound[some], Omega[some], a[some])
    if a is not None:
        before = np.trace(np.linalg.inv(np.einsum("bj,bjkl->bkl", a, Omega)), axis1=1, axis2=2)
        assert (found.trace <= before * (1 + 1e-8)).all()


def test_a_window_of_the_past_is_solved():
    Omega, a = stale(np.random.default_rng(3), 300, 4, 4, 3)
    found = solve_fusion_weights(Omega, a)
    assert found.ok.all()
    assert found.gap.max() < 1e-6
    assert (found.weights != a).any(axis=1).mean() > 0.1


def test_where_the_reference_is_all_that_is_allowed_it_is_returned_as_it_is():
    Omega = np.array([np.diag([4.0, 1.0]), np.diag([1.0, 9.0])])[None]  # neither is above the other
    a = np.array([[0.25, 0.75]])
    found = solve_fusion_weights(Omega, a)
    np.testing.assert_array_equal(found.weights, a)
    assert found.violation[0] == 0
    assert found.ok.all()


@pytest.mark.parametrize("better", [1.0, 1e-3])
def test_one_pair_that_is_better_than_all_others_is_taken_alone(better: float):
    """Not where another is worth a little, nor where it is not above the reference in every direction."""
    rng = np.random.default_rng(10)
    Omega, a = covariances(rng, 50, 4, 3), np.full((50, 4), 0.25)
    Omega[:, 2] = Omega.sum(axis=1) + better * np.eye(3)
    found = solve_fusion_weights(Omega, a)
    np.testing.assert_array_equal(found.weights, np.eye(4)[[2] * 50])
    assert (found.iterations == 0).all()
    assert found.ok.all()
    most = Omega[:, [0, 1, 3], 2, 2].max(axis=1)
    Omega[:, 2] = 1e6 * np.diag([1.0, 1.0, 0.0])
    Omega[:, 2, 2, 2] = 0.9 * most
    for each in (solve_fusion_weights(Omega, a), solve_fusion_weights(Omega)):
        assert each.ok.all()
        assert (each.weights[:, 2] < 1).all()


def test_a_pair_that_knows_nothing_of_one_state_is_no_answer_alone():
    rng = np.random.default_rng(11)
    Omega, a = covariances(rng, 20, 3, 3), np.full((20, 3), 1 / 3)
    Omega[:, 0] = 1e3 * np.diag([1.0, 1.0, 0.0])
    found = solve_fusion_weights(Omega, a)
    assert found.ok.all()
    assert (found.weights[:, 0] < 1).all()


def test_identical_pairs_and_states_that_all_know_alike():
    same = np.broadcast_to(np.diag([1.0, 2.0, 3.0]), (5, 4, 3, 3))
    assert solve_fusion_weights(same, np.full((5, 4), 0.25)).ok.all()
    rng = np.random.default_rng(0)
    Omega = np.zeros((20, 5, 4, 4))
    Omega[:, :, :3, :3] = covariances(rng, 20, 5, 3)
    Omega[:, :, 3, 3] = 7.0  # P <= P_0 then never has room
    found = solve_fusion_weights(Omega, some_reference(rng, 20, 5))
    assert found.ok.all()
    assert found.gap.max() < 1e-6


def test_slots_without_a_pair_get_nothing():
    rng = np.random.default_rng(5)
    Omega = covariances(rng, 30, 3, 4)
    padded = np.concatenate([Omega, np.zeros((30, 2, 4, 4))], axis=1)
    found, plain = solve_fusion_weights(padded), solve_fusion_weights(Omega)
    assert (found.weights[:, 3:] == 0).all()
    np.testing.assert_allclose(found.trace, plain.trace, rtol=1e-7)


def test_one_bad_member_leaves_the_others_alone():
    rng = np.random.default_rng(6)
    Omega = covariances(rng, 5, 3, 3)
    whole = solve_fusion_weights(Omega)
    spoilt = Omega.copy()
    spoilt[1] = 0.0
    spoilt[3, 0, 0, 0] = np.nan
    found = solve_fusion_weights(spoilt)
    assert found.status.tolist() == ["ok", "singular", "ok", "singular", "ok"]
    np.testing.assert_allclose(found.weights[[0, 2, 4]], whole.weights[[0, 2, 4]], rtol=1e-9, atol=1e-12)


def test_any_stack_of_problems_and_progress():
    rng = np.random.default_rng(7)
    Omega = covariances(rng, 1200, 2, 2).reshape(30, 40, 2, 2, 2)
    seen: list[tuple[int, int]] = []
    found = solve_fusion_weights(Omega, progress=lambda *at: seen.append(at))
    assert found.weights.shape == (30, 40, 2)
    assert seen[-1] == (1200, 1200)
    np.testing.assert_allclose(solve_fusion_weights(Omega[3, 5]).weights, found.weights[3, 5], atol=1e-12)
    assert solve_fusion_weights(np.empty((0, 3, 2, 2))).weights.shape == (0, 3)


@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 6))
def test_the_bound_holds_for_any_multiplier(seed: int, n: int, J: int):
    """The certificate's only assumption is Z >= 0: below the trace of feasible weights, whatever V and Z are."""
    rng = np.random.default_rng(seed)
    Omega, delta = covariances(rng, 1, J, n)[0], rng.dirichlet(np.ones(J))
    a = some_reference(rng, 1, J)[0]
    V, X = rng.normal(size=(2, n, n))
    P = np.linalg.inv(np.einsum("j,jkl->kl", a, Omega))
    for guess in (V, P):
        assert is_below([lower_bound(Omega, None, guess, np.zeros((n, n)))], [Omega], [delta])
        assert is_below([lower_bound(Omega, a, guess, X @ X.T)], [Omega], [a])
        assert is_below([lower_bound(Omega, a, guess, 1e9 * np.outer(X[0], X[0]))], [Omega], [a])


def squeezed(rng: np.random.Generator, kind: str) -> tuple[ndarray, ndarray]:
    """Problems in which the bound is all but the trace, so that rounding decides which is above."""
    match kind:
        case "half":
            return covariances(rng, 100, 6, 3), some_reference(rng, 100, 6)
        case "hardly any room":
            return covariances(rng, 100, 1, 3) + 1e-8 * covariances(rng, 100, 3, 3), rng.dirichlet(np.ones(3), 100)
        case _:  # the condition numbers of the pairs are 1e10
            X = rng.normal(size=(100, 1, 3, 3)) @ (rng.normal(size=(100, 4, 3, 3)) * np.array([1, 1e-3, 1e-5]))
            return symmetric_part(X @ X.mT), np.full((100, 4), 0.25)


@pytest.mark.parametrize("kind", ["half", "hardly any room", "ill-conditioned"])
def test_no_bound_is_above_the_trace_that_it_bounds(kind: str):
    """In rational arithmetic; before rounding was taken off, several in a hundred of each kind were above."""
    Omega, a = squeezed(np.random.default_rng(2), kind)
    found = solve_fusion_weights(Omega, a)
    assert found.ok.all()
    assert (found.gap >= 0).all()
    assert is_below(found.bound, Omega, found.weights)
    assert is_below(found.bound, Omega, a)


def test_a_bound_above_the_trace_is_not_called_ok():
    Omega, a = squeezed(np.random.default_rng(12), "half")
    found = solve_fusion_weights(Omega, a)
    for above in (1e-10, 1e-5, 1.0):
        false = FusionWeights(Omega, a, found.weights, found.trace * (1 + above), found.iterations, "mutant")
        assert (false.gap < 0).all()
        assert set(false.status) == {"not-converged"}
    missing = FusionWeights(Omega, a, found.weights, np.full(100, np.nan), found.iterations, "mutant")
    assert not missing.ok.any()


@given(st.integers(0, 10_000), st.integers(1, 5), st.floats(0.0, 9.0))
def test_the_trace_is_known_to_its_stated_rounding(seed: int, n: int, spread: float):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(1, 3, n, n)) @ (np.eye(n) * 10 ** rng.uniform(-spread / 2, spread / 2, n))
    X = rng.normal(size=(n, n)) @ X.mT
    Omega, delta = symmetric_part(X @ X.mT), rng.dirichlet(np.ones(3), 1)
    found = FusionWeights(Omega, None, delta, np.zeros(1), np.zeros(1, dtype=int), "none")
    if np.isfinite(found.rounding[0]):
        truth = exact_trace(Omega[0], delta[0])
        assert abs(Fraction(float(found.trace[0])) - truth) <= Fraction(float(found.rounding[0])) * truth
    else:
        assert spread > 3


def test_worse_weights_are_not_called_ok():
    rng = np.random.default_rng(8)
    Omega, a = stale(rng, 20, 3, 3, 2)
    found = solve_fusion_weights(Omega, a)
    moved = np.roll(found.weights, 1, axis=1)
    mutant = FusionWeights(Omega, a, moved, found.bound, found.iterations, "mutant")
    assert (mutant.ok <= (mutant.violation < 1e-9)).all()
    assert mutant.ok.mean() < 0.2
    assert set(mutant.status) <= {"ok", "not-converged"}
    np.testing.assert_array_equal(mutant.or_reference()[~mutant.ok], a[~mutant.ok])
    negative = found.weights + np.array([0.1, -0.1, 0, 0, 0, 0])
    assert not FusionWeights(Omega, a, negative, found.bound, found.iterations, "mutant").ok.all()


def test_the_loop_returns_its_best_where_steps_run_out():
    rng = np.random.default_rng(9)
    Omega = covariances(rng, 4, 5, 3)
    few = minimise(Omega, np.broadcast_to(np.eye(3), (4, 3, 3)), constrained=False, gap=0.0)
    assert np.isfinite(few.weights).all()
    np.testing.assert_allclose(few.weights.sum(axis=1), 1, rtol=1e-12)


def test_misuse_is_refused():
    good = covariances(np.random.default_rng(1), 2, 3, 2)
    bad = good.copy()
    bad[1, 2, 0, 1] += 0.1
    with pytest.raises(InputError, match=r"information\[1\]\[2\] is not symmetric"):
        solve_fusion_weights(bad)
    with pytest.raises(ShapeError, match="information has shape"):
        solve_fusion_weights(np.empty((3, 0, 2, 2)))
    with pytest.raises(InputError, match=r"reference\[0\] is no set of weights"):
        solve_fusion_weights(good, np.full((2, 3), 0.5))
    plain = solve_fusion_weights(good)
    with pytest.raises(ValueError, match="no reference weights"):
        plain.or_reference()
    assert "2 of 3 pairs each, 2 ok" in repr(plain)
