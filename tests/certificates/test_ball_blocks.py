"""`convergence` of slow filters: a bracket pushed on by doubling; what proves nothing is refused."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy import ndarray
from tests.certificates.ball_filters import Solved, at, centre, projectile, scalar
from tests.reference.exact import mp, mpf

from tolnet.certificates import balls, convergence, statements
from tolnet.certificates.blocks import Bracket, end_of
from tolnet.certificates.convergence import prove_convergence, verify_convergence
from tolnet.certificates.exact_filter import ExactFilter
from tolnet.certificates.filter_claims import misshapen
from tolnet.certificates.fixed_point import Box, find_box
from tolnet.certificates.numerals import symmetric_matrix, symmetric_text
from tolnet.certificates.recursion import first_covariance, step
from tolnet.model import SensorNetwork

FORGOTTEN = 0.999
"""Radius of a mode of which the sensors see little."""


@cache
def slow(c: float, *, singular: bool = False) -> Solved:
    """A centre whose slowest mode has the radius 0.999; with `singular`, one more state is forgotten at once."""
    A = np.array([[FORGOTTEN, 0.02, 0.0], [0.0, 0.9, 0.1], [0.0, 0.0, 0.0 if singular else 0.5]])
    C = [np.array([[0.01, 1.0, 0.3]]), np.array([[0.0, 0.2, 1.0]])]
    B = np.diag([1e-4, 0.1, 0.3])
    network = SensorNetwork(A=A, B=B, C=C, R=[np.eye(1) * 0.04, np.eye(1)], adjacency=np.ones((2, 2)))
    return centre(network, c)


@cache
def proved(c: float, *, singular: bool = False) -> dict:
    """Its claim from the identity."""
    solved = slow(c, singular=singular)
    claim = prove_convergence(solved.exact, solved.box(), np.eye(3))
    assert isinstance(claim, dict), claim
    return claim


@pytest.mark.parametrize("singular", [False, True])
@pytest.mark.parametrize("c", [0.0, 1e-10, 1e-8])
def test_slow_filters_are_proved_in_few_steps(c: float, singular: bool):
    solved, claim = slow(c, singular=singular), proved(c, singular=singular)
    assert solved.attraction > 0.99
    assert claim["proof"]["blocks"]
    assert claim["proof"]["steps"] < 200
    assert verify_convergence(solved.exact, claim) is None


@pytest.mark.parametrize("c", [0.0, 1e-9, 1e-3, 1.0])
def test_a_slow_filter_of_one_state_is_proved(c: float):
    """V = kappa P: no gain of theta on itself, however large c is."""
    filter_ = scalar(0.9999, 1e-6, 1e-3, c)
    P, theta = steady_state_of_one(filter_)
    box = find_box(filter_, P, theta)
    assert isinstance(box, Box)
    claim = prove_convergence(filter_, box, np.eye(1))
    assert isinstance(claim, dict), claim
    assert claim["proof"]["steps"] < 200
    assert verify_convergence(filter_, claim) is None
    for other in (c * 1.001, c + 1e-6):
        if other != c:
            assert verify_convergence(at(filter_, other), claim)


def steady_state_of_one(filter_: ExactFilter) -> tuple[ndarray, float]:
    """P = a^2 / (1 / (kappa P) + s) + q from its quadratic, kappa by bisection; theta = (1 - 1 / kappa) / P."""
    a, q, s, c = filter_.A[0, 0], filter_.process.matrix[0, 0], 1e-3, mpf(filter_.c)
    with mp.workdps(60):
        low, high = mpf(1), 2 + 2 * c + 2 * mp.sqrt(c)
        for _ in range(180):
            middle = (low + high) / 2
            low, high = (middle, high) if middle - 1 - mp.ln(middle) < c else (low, middle)
        kappa = low
        linear = 1 - kappa * mpf(a) ** 2 - kappa * s * mpf(q)
        P = (-linear + mp.sqrt(linear**2 + 4 * kappa * s * mpf(q))) / (2 * kappa * s)
        return np.array([[float(P)]]), float((1 - 1 / kappa) / P)


@pytest.mark.parametrize("c", [0.0, 1e-8])
def test_a_block_holds_the_orbit_step_by_step(c: float):
    """After 2^6 and 2^6 + 2^6 steps, and for ever: P_t lies between the ends of the bracket."""
    exact, (lower, upper, _) = slow(c).exact, Bracket.read(proved(c)["proof"])
    with balls.working_precision(balls.BITS):
        equations = exact.equations()
        start = balls.matrix((lower + upper) / 2)
        ends = [end_of(Bracket(lower, upper, (6,) * k), equations, c, start) for k in (1, 2)]
        P = step(equations, convergence.Around.of(start), c)
        for t in range(2, 200):
            assert not isinstance(P, balls.NotProved)
            P = step(equations, P, c)
            assert not isinstance(P, balls.NotProved)
            for k, end in enumerate(ends, start=1):
                assert not isinstance(end, balls.NotProved)
                if t >= k * 2**6:
                    assert balls.is_positive(P.hull() - end[0])
                    assert balls.is_positive(end[1] - P.hull())
    assert width(ends[1]) < width(ends[0]) < float(np.trace(upper - lower))


def width(end: tuple[balls.BallMatrix, balls.BallMatrix] | balls.NotProved) -> float:
    """The trace of U - L."""
    assert not isinstance(end, balls.NotProved)
    return float((end[1] - end[0]).trace())


def test_no_doubling_is_one_step():
    exact, (lower, upper, _) = slow(0.0).exact, Bracket.read(proved(0.0)["proof"])
    with balls.working_precision(balls.BITS):
        equations = exact.equations()
        inside = balls.matrix((lower + upper) / 2)
        L, U = _both(end_of(Bracket(lower, upper, (0,)), equations, 0.0, inside))
    for before, after in ((lower, L), (upper, U)):
        Z = before @ np.linalg.inv(np.eye(3) + _information() @ before)
        once = exact.A @ Z @ exact.A.T + np.diag([1e-8, 1e-2, 0.09])
        assert after == pytest.approx(once + (before - once) / 2**12, rel=1e-12)


def _both(end: tuple[balls.BallMatrix, balls.BallMatrix] | balls.NotProved) -> tuple[ndarray, ndarray]:
    assert not isinstance(end, balls.NotProved)
    return balls.midpoints(end[0]), balls.midpoints(end[1])


def _information() -> ndarray:
    C = np.array([[0.01, 1.0, 0.3], [0.0, 0.2, 1.0]])
    return C.T @ np.diag([25.0, 1.0]) @ C


def test_what_proves_nothing_is_refused():
    exact, claim = slow(1e-8).exact, proved(1e-8)
    proof = claim["proof"]
    lower, upper = symmetric_matrix(proof["lower"]), symmetric_matrix(proof["upper"])
    for changes in (
        {"lower": symmetric_text(upper), "upper": symmetric_text(lower)},
        {"lower": symmetric_text(lower * 0.0)},
        {"lower": symmetric_text(upper * 0.999)},
        {"upper": symmetric_text(upper * 1e9)},
        {"upper": symmetric_text(lower * 1.001)},
        {"upper": " ".join(["nan"] * 6)},
        {"upper": symmetric_text(np.eye(2))},
        {"blocks": []},
        {"blocks": proof["blocks"][:1]},
        {"blocks": [-1]},
        {"blocks": [41]},
        {"blocks": [20] * 65},
        {"steps": 1},
        {"radius": (float.fromhex(proof["radius"]) * 1e6).hex()},
    ):
        assert verify_convergence(exact, claim | {"proof": proof | changes}), changes
    for missing in ("lower", "upper", "blocks"):
        with pytest.raises(KeyError):
            verify_convergence(exact, claim | {"proof": {k: v for k, v in proof.items() if k != missing}})
    for blocks in (12, "12", [1.0], [True]):
        with pytest.raises(ValueError, match="whole numbers"):
            verify_convergence(exact, claim | {"proof": proof | {"blocks": blocks}})


def test_a_proof_has_all_keys_of_a_bracket_or_none():
    """What is found out about the form of an entry, before anything is computed."""
    keys = proved(1e-8)
    proof = keys["proof"]
    opening = {"claim": "convergence", "node": "centre", "verdict": "proved", "margin": None, "reason": None}
    entry = opening | keys
    entry["statement"] = statements.of_filter_claim(entry)
    plain = {key: value for key, value in proof.items() if key not in ("lower", "upper", "blocks")}
    assert misshapen(entry) is None
    assert misshapen(entry | {"proof": plain}) is None
    for missing in ("lower", "upper", "blocks"):
        assert misshapen(entry | {"proof": {k: v for k, v in proof.items() if k != missing}})
    assert misshapen(entry | {"proof": plain | {"blocks": proof["blocks"]}})
    for blocks in (12, "12", [1.0], [True], [[1]], None):
        assert "whole numbers" in str(misshapen(entry | {"proof": proof | {"blocks": blocks}}))


def test_a_bracket_that_the_orbit_could_leave_is_refused():
    """At the published tolerance the gain of theta on itself is above 1: no bracket of the projectile is kept."""
    solved = projectile()
    with balls.working_precision(balls.BITS):
        equations = solved.exact.equations()
        for width in (1e-9, 1e-3, 0.5):
            bracket = Bracket(solved.P * (1 - width), solved.P * (1 + width), (1,))
            found = end_of(bracket, equations, solved.exact.c, balls.matrix(solved.P))
            assert isinstance(found, balls.NotProved)


def test_what_is_too_slow_is_said_with_the_cap(monkeypatch: pytest.MonkeyPatch):
    """Without a bracket, and with few steps: the reason names how many were followed."""
    monkeypatch.setattr(convergence, "MOST_STEPS", 5)
    solved = projectile()
    found = prove_convergence(solved.exact, solved.box(), np.eye(6))
    assert isinstance(found, balls.NotProved)
    assert "5 steps" in found.reason


def test_the_first_covariance_is_the_kalman_step():
    """P_1 from V_0 = I, against the book."""
    exact = slow(0.0).exact
    with balls.working_precision(balls.BITS):
        P = balls.midpoints(first_covariance(exact.equations(), balls.identity(3)).middle)
    book = exact.A @ np.linalg.inv(np.eye(3) + _information()) @ exact.A.T + np.diag([1e-8, 1e-2, 0.09])
    assert pytest.approx(book, rel=1e-12) == P
