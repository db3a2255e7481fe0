"""Each node's best combination: the semidefinite program against every possible support of the quadratic one."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from numpy import ndarray

from tolnet import analysis, design
from tolnet.analysis.msd_gradient import NetworkErrors
from tolnet.design.weights import combination
from tolnet.design.weights.admissible import Admissible, Constraints
from tolnet.design.weights.combination import CombinationPrograms, combination_gap, combine
from tolnet.design.weights.msd import Criterion, MsdObjective
from tolnet.model.examples import projectile


def quadratic(H: ndarray, g: ndarray, v: ndarray, w: ndarray) -> float:
    return float(g @ w + (w - v) @ H @ (w - v) / 2)


def best_by_enumeration(H: ndarray, g: ndarray, v: ndarray, lower: ndarray) -> float:
    """The least value over the simplex above `lower`: on each face the stationary point, where it is admissible."""
    d, best = len(v), np.inf
    for size in range(1, d + 1):
        for face in combinations(range(d), size):
            i = list(face)
            K = np.block([[H[np.ix_(i, i)], np.ones((size, 1))], [np.ones((1, size)), np.zeros((1, 1))]])
            fixed = lower.copy()
            fixed[i] = 0.0
            slope = (g - H @ v + H @ fixed)[i]
            w = fixed.copy()
            w[i] = np.linalg.lstsq(K, np.append(-slope, 1 - fixed.sum()), rcond=None)[0][:size]
            if (w >= lower - 1e-9).all() and abs(w.sum() - 1) < 1e-9:
                best = min(best, quadratic(H, g, v, w))
    return best


@pytest.mark.parametrize("seed", range(12))
def test_the_program_is_the_quadratic_program(seed: int):
    rng = np.random.default_rng(seed)
    programs = CombinationPrograms()
    for d in (2, 3, 5, 3):  # the program for 3 is used twice
        rank = d if seed % 3 else 1
        root = rng.normal(size=(d, rank)) * 10.0 ** rng.integers(-4, 4)
        H, v = root @ root.T, rng.dirichlet(np.ones(d))
        g = rng.normal(size=d) * np.abs(H).max()
        lower = np.zeros(d)
        lower[0] = rng.choice([0.0, 0.3])
        found = programs.best(H, g, v, lower)
        assert found is not None
        assert (found >= lower).all()
        assert found.sum() == pytest.approx(1, abs=1e-12)
        least, scale = best_by_enumeration(H, g, v, lower), max(np.ptp(g), np.abs(H).max())
        assert quadratic(H, g, v, found) == pytest.approx(least, abs=1e-6 * scale)
        assert combination_gap(H, g, v, lower, found) >= quadratic(H, g, v, found) - least - 1e-9 * scale
        corners = lower + (1 - lower.sum()) * np.eye(d)
        other = max(corners, key=lambda w: quadratic(H, g, v, w))
        assert (
            combination_gap(H, g, v, lower, other) > quadratic(H, g, v, other) - least - 1e-9 * scale > 1e-4 * scale
        )


def test_an_answer_that_is_not_the_best_one_is_not_taken(monkeypatch: pytest.MonkeyPatch):
    H, g, v = np.eye(3), np.array([0.0, 1.0, 2.0]), np.full(3, 1 / 3)
    assert CombinationPrograms().best(H, g, v, np.zeros(3)) is not None

    def poor(problem: object) -> bool:
        for variable in problem.variables():  # pyright: ignore[reportAttributeAccessIssue]
            variable.value = np.full(variable.shape, 1 / 3)
        return True

    monkeypatch.setattr(combination, "solve_program", poor)
    assert CombinationPrograms().best(H, g, v, np.zeros(3)) is None
    monkeypatch.setattr(combination, "solve_program", lambda problem: False)
    assert CombinationPrograms().best(H, g, v, np.zeros(3)) is None


def test_steps_to_the_best_combinations_lower_the_msd():
    network = projectile(5, nodes=6, links=9)
    table = design.choose_tolerances(network, 0.02)
    errors = NetworkErrors(network, table.local, analysis.least_favourable_model(network, table.central))
    objective = MsdObjective([errors], Criterion("mean", np.full(6, 1 / 6)))
    among = Admissible.of(errors.columns, Constraints(own_weight=0.1))
    uniform = among.project(1 / errors.columns.degree[errors.columns.hearer])
    w = combine(objective, among, uniform)
    np.testing.assert_allclose(errors.columns.sums(w), 1, atol=1e-12)
    assert (w[errors.columns.own] >= 0.1).all()
    assert w.min() >= 0
    best = design.optimise_diffusion(network, table, constraints=Constraints(own_weight=0.1))
    assert best.value <= objective.exact(w) < best.value + 0.2 * (objective.exact(uniform) - best.value)
    again = combine(objective, among, w)
    assert objective.exact(again) <= objective.exact(w)
