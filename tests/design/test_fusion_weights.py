"""One door for fusion weights: the fast method and both programs agree to 1e-6 on every instance."""

from __future__ import annotations

import numpy as np
import pytest
from tests.fusion_problems import covariances, some_reference, stale
from tests.reference.exact_fusion import is_below

from tolnet.design import choose_fusion_weights, fusion_weights
from tolnet.model import FusionWeights, InputError


@pytest.mark.parametrize(("n", "J"), [(1, 3), (2, 2), (3, 6), (4, 12), (6, 6)])
@pytest.mark.parametrize("units", [0.0, 3.0])
@pytest.mark.parametrize("kind", ["free", "uniform", "half", "window"])
def test_every_method_reaches_the_same_trace(n: int, J: int, units: float, kind: str):
    rng = np.random.default_rng(10 * n + J)
    if kind == "window":
        Omega, a = stale(rng, 4, max(J // 3, 1), n, 3)
    else:
        Omega = covariances(rng, 4, J, n, units=units)
        a = {"free": None, "uniform": np.full((4, J), 1 / J), "half": some_reference(rng, 4, J)}[kind]
    fast = choose_fusion_weights(Omega, a, method="newton")
    assert fast.ok.all()
    for method in ("clarabel", "cvxpy"):
        slow = choose_fusion_weights(Omega, a, method=method)
        np.testing.assert_allclose(slow.trace, fast.trace, rtol=1e-6)
        assert is_below(slow.bound, Omega, slow.weights)
        assert a is None or is_below(slow.bound, Omega, a)
        assert (slow.weights >= 0).all()
        np.testing.assert_allclose(slow.weights.sum(axis=1), 1, rtol=1e-14)
        assert slow.method == method


def test_automatic_falls_back_member_by_member(monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(0)
    Omega = covariances(rng, 6, 4, 3)
    honest = choose_fusion_weights(Omega)
    assert honest.method == "newton"

    def lazy(*arguments: object, **options: object) -> FusionWeights:
        uniform = honest.weights.copy()
        uniform[2] = 0.25
        return FusionWeights(Omega, None, uniform, honest.bound, honest.iterations, "newton")

    monkeypatch.setattr(fusion_weights, "solve_fusion_weights", lazy)
    found = choose_fusion_weights(Omega)
    assert found.method == "newton, clarabel"
    assert found.ok.all()
    np.testing.assert_array_equal(np.delete(found.weights, 2, 0), np.delete(honest.weights, 2, 0))
    assert not choose_fusion_weights(Omega, method="newton").ok.all()


def test_a_solver_without_an_answer_leaves_the_reference_and_says_so(monkeypatch: pytest.MonkeyPatch):
    class Silent:
        def solve(self, Omega: object, M: object) -> None:
            return None

    monkeypatch.setattr(fusion_weights, "solver_for", lambda *key: Silent())
    Omega, a = stale(np.random.default_rng(1), 3, 2, 2, 2)
    found = choose_fusion_weights(Omega, a, method="clarabel")
    assert set(found.status) == {"not-converged"}
    np.testing.assert_array_equal(found.or_reference(), a)


def test_weights_that_break_the_constraint_are_not_accepted(monkeypatch: pytest.MonkeyPatch):
    """A solver that ignores P <= P_0 but is otherwise perfect: the recheck finds it, Algorithm 1 takes over."""
    Omega, a = stale(np.random.default_rng(2), 40, 3, 3, 1)
    free = choose_fusion_weights(Omega)
    judged = FusionWeights(Omega, a, free.weights, free.bound, free.iterations, "mutant")
    broken = judged.violation > 1e-9
    assert broken.mean() > 0.5
    assert not judged.ok[broken].any()
    np.testing.assert_array_equal(judged.or_reference()[broken], a[broken])


def test_one_bad_member_and_a_program_that_is_built_once():
    Omega = covariances(np.random.default_rng(3), 3, 3, 2)
    Omega[1, 0, 0, 0] = np.inf
    seen: list[tuple[int, int]] = []
    found = choose_fusion_weights(Omega, method="clarabel", progress=lambda *at: seen.append(at))
    assert found.status.tolist() == ["ok", "singular", "ok"]
    assert seen[-1] == (3, 3)
    assert fusion_weights.solver_for("cvxpy", 3, 2, True) is fusion_weights.solver_for("cvxpy", 3, 2, True)


def test_misuse_is_refused():
    Omega = covariances(np.random.default_rng(4), 2, 2, 2)
    with pytest.raises(InputError, match="reference"):
        choose_fusion_weights(Omega, np.ones((2, 2)), method="cvxpy")
