"""Filters with little information: folds, turning points in c, and more than one steady state at the same c.

Where several attract, which one a deployed filter settles on depends on where it starts; the solver reports one that
attracts, the one on the path from the Kalman filter where that does.
"""

from __future__ import annotations

import numpy as np
import pytest
from tests.instances_random import poorly_informed
from tests.reference import fifty_digits, recursion
from tests.reference.exact import exact, eye, mp, mpf, solve, trace
from tests.reference.fifty_digits import Exact

from tolnet import analysis


def test_two_attracting_steady_states_at_one_tolerance():
    """Both in 50 digits: their equations hold, and the derivative of the recursion is a contraction at each."""
    A, Q, S = poorly_informed(231)
    c = 0.3
    small = fifty_digits.steady_state(A, Q, S, c)
    end = recursion.run(A, Q, S, c)
    assert end.verdict == "settles"
    with mp.workdps(80):
        start = exact(end.P), mpf(end.theta)
        P, theta = fifty_digits.newton(exact(A), exact(Q), exact(S), mpf(c), *start, digits=50)
        large = Exact(P, solve(eye(2) - P * theta, P), theta)
        assert float(trace(small.P)) == pytest.approx(0.0632177, rel=1e-5)
        assert float(trace(large.P)) == pytest.approx(0.1806240, rel=1e-5)
    for state in (small, large):
        assert fifty_digits.attraction(A, Q, S, c, state) < 0.9
    from_below = recursion.run(A, Q, S, c, 1e-6 * np.eye(2))
    np.testing.assert_allclose(np.trace(from_below.P), float(trace(small.P)), rtol=1e-10)


@pytest.mark.parametrize(("seed", "c"), [(84, 0.8), (84, 30.0), (104, 3.0), (165, 3.0), (184, 3.0), (285, 3.0)])
def test_the_branch_past_the_fold_is_that_of_the_path(seed: int, c: float):
    """Here the path from the Kalman filter leads to where the recursion settles, from large and from small starts."""
    A, Q, S = poorly_informed(seed)
    want = fifty_digits.steady_state(A, Q, S, c, digits=20)
    for start in (np.eye(len(A)), 1e-6 * np.eye(len(A))):
        end = recursion.run(A, Q, S, c, start, steps=1500)
        assert end.verdict == "settles"
        assert np.trace(end.P) == pytest.approx(float(np.trace(want.P)), rel=1e-8)
    state = analysis.solve_steady_states(A, Q, S[None], np.array([c]))[0]
    assert str(state.status) == "ok"
    assert float(state.trace_P) == pytest.approx(float(np.trace(want.P)), rel=1e-9)
    assert float(state.theta) == pytest.approx(float(want.theta), rel=1e-9)


@pytest.mark.parametrize(
    ("seed", "c"), [(9, 3.0), (57, 3.0), (79, 3.0), (132, 3.0), (231, 0.3), (386, 0.03), (24, 1.1)]
)
def test_of_several_steady_states_one_that_attracts_is_reported(seed: int, c: float):
    """A filter that starts near it settles on it; one that starts elsewhere may settle on another."""
    A, Q, S = poorly_informed(seed)
    state = analysis.solve_steady_states(A, Q, S[None], np.array([c]))[0]
    assert str(state.status) == "ok"
    end = recursion.run(A, Q, S, c, 1.001 * state.V, steps=3000)
    assert end.verdict == "settles"
    assert float(state.trace_P) == pytest.approx(np.trace(end.P), rel=1e-8)
