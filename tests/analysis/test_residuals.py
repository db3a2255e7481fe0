"""The residual fields are those of the P and V that are returned, and a wrong P cannot hide behind them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy import ndarray
from tests.instances_random import random_network
from tests.reference.exact import determinant, exact, eye, inverse, log, mp, mpf, rounded, solve, trace

from tolnet import analysis
from tolnet.analysis import steady_state
from tolnet.analysis.continuation import FixedPoints
from tolnet.model import SteadyState


def recomputed(state: SteadyState) -> tuple[float, float]:
    """Both residuals of the returned doubles, in 60 digits; gamma as a divergence of V from P."""
    with mp.workdps(60):
        A, Q, S, P, V = (exact(M) for M in (state.A, state.Q, state.S, state.P, state.V))
        gap = rounded(P - A @ solve(inverse(V) + S, A.T) - Q)
        ratio = solve(P, V)
        gamma = trace(ratio - eye(len(A))) - log(determinant(ratio))
        deviation = np.sqrt(np.diag(state.P))
        riccati = np.abs(gap / np.outer(deviation, deviation)).max()
        return float(riccati), float(abs(gamma / mpf(float(state.tolerance)) - 1))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("c", [1e-2, 1.0, 1e4])
def test_both_equations_hold_to_rounding(seed: int, c: float):
    """To what the rounding of V alone does to (V^-1 + S)^-1: eps times V's condition number."""
    network = random_network(np.random.default_rng(500 + seed), 1 + seed, 6)
    state = analysis.solve_steady_state(network, c)
    riccati, tolerance = recomputed(state)
    rounding = 4 * np.finfo(float).eps * float(np.linalg.cond(state.V))
    assert riccati < rounding
    assert tolerance < 1e-11
    assert float(state.riccati_residual) == pytest.approx(riccati, abs=rounding)
    assert float(state.tolerance_residual) == pytest.approx(tolerance, abs=1e-11)


@pytest.mark.parametrize("size", [1e-10, 1e-6, 1e-3])
def test_a_wrong_answer_shows(monkeypatch: pytest.MonkeyPatch, size: float):
    """A solver that returns P off by `size` and calls it found: nobody believes it, or the residual says so."""
    network = random_network(np.random.default_rng(2), 3, 6)
    solve_rightly = steady_state.solve_fixed_points

    def solve_wrongly(recursion: Any) -> FixedPoints:
        found = solve_rightly(recursion)
        return found._replace(P=found.P * (1 + size))

    right = analysis.solve_steady_state(network, 0.1)
    monkeypatch.setattr(steady_state, "solve_fixed_points", solve_wrongly)
    state = analysis.solve_steady_state(network, 0.1)
    if size >= 1e-6:  # solved anew, in extended precision
        np.testing.assert_allclose(state.P, right.P, rtol=1e-9)
        assert float(state.error) == np.finfo(float).eps
        return
    riccati, _ = recomputed(state)
    assert float(state.riccati_residual) == pytest.approx(riccati, rel=1e-3)
    assert 0.01 * size < riccati < 10 * size
    assert size < float(state.error) < 1e4 * size


@pytest.mark.parametrize("tau", [0.0, 0.3, 1.0])
def test_gamma_is_zero_at_zero_rises_and_is_infinite_at_its_pole(tau: float):
    P: ndarray = np.diag([1.0, 0.5, 0.2])
    pole = np.inf if tau == 1 else 1 / (1 - tau)
    thetas = np.linspace(0.0, min(0.99 * pole, 5.0), 50)
    values = analysis.gamma(np.broadcast_to(P, (50, 3, 3)), thetas, tau)
    assert values[0] == 0
    assert (np.diff(values) > 0).all()
    if tau < 1:
        assert analysis.gamma(P, pole, tau) == np.inf
        assert analysis.gamma(P, 2 * pole, tau) == np.inf
    small = 1e-9
    assert float(analysis.gamma(P, small, tau)) == pytest.approx(small**2 / 2 * (P @ P).trace(), rel=1e-7)
