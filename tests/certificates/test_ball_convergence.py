"""`convergence` and `convergence-all`: orbits hold those of fifty digits; what proves nothing is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray
from tests.certificates.ball_filters import (
    CASES,
    Solved,
    at,
    case,
    centre,
    information,
    node,
    oscillating,
    projectile,
)
from tests.certificates.ball_filters import scalar as scalar_filter
from tests.instances import ring_projectile
from tests.reference import fifty_digits
from tests.reference.exact import exact, eye, mp, mpf, solve

from tolnet.certificates import balls
from tolnet.certificates.bracket import (
    largest_tolerance_for_all,
    prove_convergence_for_all,
    verify_convergence_for_all,
)
from tolnet.certificates.convergence import prove_convergence, verify_convergence
from tolnet.certificates.exact_filter import Covariance
from tolnet.certificates.numerals import matrix_text, symmetric_matrix, symmetric_text, vector
from tolnet.certificates.recursion import enclose_theta, first_covariance, step
from tolnet.model import example


@pytest.mark.parametrize("name", CASES)
def test_every_case_converges_from_the_identity(name: str):
    solved = case(name)
    claim = prove_convergence(solved.exact, solved.box(), np.eye(len(solved.P)))
    assert isinstance(claim, dict), claim
    assert verify_convergence(solved.exact, claim) is None


@pytest.mark.parametrize("c", [0.02, 0.06])
@pytest.mark.parametrize("name", ["ring", "built-in"])
def test_the_projectile_converges(name: str, c: float):
    network = ring_projectile() if name == "ring" else example("projectile")
    for solved in (centre(network, c), node(network, c, 1)):
        claim = prove_convergence(solved.exact, solved.box(), network.initial_covariance)
        assert isinstance(claim, dict), claim


@pytest.mark.parametrize("name", ["tiny", "scalar", "few-drives", "scaled", "large"])
def test_the_orbit_is_that_of_fifty_digits(name: str):
    solved = case(name)
    A, Q, S, c = solved.exact.A, solved.exact.process.matrix, information(solved.exact), solved.exact.c
    start = solved.P * 1.5
    with mp.workdps(110):
        P = exact(A) @ solve(eye(len(A)) + exact(start) @ S, exact(start)) @ exact(A).T + exact(Q)
        V = _inflated(P, c)
        second = exact(A) @ solve(eye(len(A)) + V @ S, V) @ exact(A).T + exact(Q)
    with balls.working_precision(512):
        equations = solved.exact.equations()
        orbit = step(equations, first_covariance(equations, balls.matrix(start)), c)
        assert not isinstance(orbit, balls.NotProved)
        hull = orbit.hull()
    assert all(agree(hull[i, j], second[i, j], mp.sqrt(second[i, i] * second[j, j])) for i, j in np.ndindex(A.shape))


def agree(x: balls.Ball, exactly, size) -> bool:
    """Whether a ball is tiny and holds a number."""
    with mp.workdps(110):
        middle, radius = (
            mpf(int(mantissa)) * mpf(2) ** int(exponent)
            for mantissa, exponent in (part.man_exp() for part in (x.mid(), x.rad()))
        )
        return radius < mpf("1e-60") * size and abs(exactly - middle) <= radius + mpf("1e-70") * size


def _inflated(P: ndarray, c: float) -> ndarray:
    """V with gamma(P, theta) = c, by bisection."""
    low, high = mpf(0), 1 / max(P[i, i] for i in range(len(P)))
    for _ in range(360):
        middle = (low + high) / 2
        above = not fifty_digits.inside(P, middle) or fifty_digits.gamma(P, middle) > mpf(c)
        low, high = (low, middle) if above else (middle, high)
    return solve(eye(len(P)) - P * low, P)


def test_theta_is_enclosed_for_every_covariance_of_a_ball():
    solved = projectile()
    with balls.working_precision(balls.BITS):
        equations = solved.exact.equations()
        wide = balls.matrix(solved.P) * balls.ball(1, 1e-6)
        around = enclose_theta(equations, wide, 0.02)
        assert not isinstance(around, balls.NotProved)
        for factor in (1 - 1e-6, 1 - 3e-7, 1 + 9e-7):
            inside = enclose_theta(equations, balls.matrix(solved.P) * balls.ball(factor), 0.02)
            assert not isinstance(inside, balls.NotProved)
            assert around.contains(inside)
        assert around.rad() < 1e-4
        assert isinstance(enclose_theta(equations, balls.matrix(-solved.P), 0.02), balls.NotProved)


@cache
def _claim() -> dict:
    claim = prove_convergence(projectile().exact, projectile().box(), np.eye(6))
    assert isinstance(claim, dict)
    return claim


def altered(claim: dict, **changes) -> dict:
    """The claim with other keys in its proof."""
    return claim | {"proof": claim["proof"] | changes}


def number(claim: dict, key: str) -> float:
    """A number of the proof."""
    return float.fromhex(claim["proof"][key])


def test_what_proves_nothing_is_refused():
    solved, claim = projectile(), _claim()
    radius, steps = number(claim, "radius"), claim["proof"]["steps"]
    for wrong in (
        altered(claim, radius=(radius * 1e4).hex()),
        altered(claim, radius=(radius * 16).hex(), steps=1),
        altered(claim, radius=(radius / 16).hex()),
        altered(claim, radius="nan"),
        altered(claim, radius="-0x1p+0"),
        altered(claim, radius="inf"),
        altered(claim, rate=(solved.attraction * 0.99).hex()),
        altered(claim, rate="0x1p+0"),
        altered(claim, rate="nan"),
        altered(claim, steps=1),
        altered(claim, steps=steps // 2),
        altered(claim, steps=0),
        altered(claim, steps=10**9),
        altered(claim, bits=2),
        altered(claim, bits=10**9),
        altered(claim, Y=symmetric_text(np.zeros((21, 21)))),
        altered(claim, Y=symmetric_text(-symmetric_matrix(claim["proof"]["Y"]))),
        altered(claim, Y="0x1p+0"),
        altered(claim, factor=""),
        altered(claim, factor=matrix_text(np.zeros((6, 6)))),
        altered(claim, factor=matrix_text(vector(claim["proof"]["factor"]) * 2)),
        claim | {"start": symmetric_text(np.zeros((6, 6)))},
        claim | {"start": symmetric_text(-np.eye(6))},
        claim | {"start": symmetric_text(np.eye(5))},
    ):
        assert verify_convergence(solved.exact, wrong)
    assert verify_convergence(at(solved.exact, 0.021), claim)
    assert verify_convergence(solved.exact, claim) is None


def test_more_steps_and_bits_and_other_starts_prove_it_too():
    claim = altered(_claim(), steps=_claim()["proof"]["steps"] + 5, bits=512)
    assert verify_convergence(projectile().exact, claim) is None
    for size in (0.5, 1e30):
        assert verify_convergence(projectile().exact, claim | {"start": symmetric_text(np.eye(6) * size)}) is None


@settings(max_examples=12)
@given(st.floats(0.0, 2.0), st.floats(0.9, 1.1))
def test_a_region_is_accepted_only_where_steps_contract(grow: float, factor: float):
    """Whatever region passes: fifteen random points of its boundary come closer by the rate in one step."""
    solved, claim = projectile(), _claim()
    radius, rate = number(claim, "radius") * 10**grow, number(claim, "rate") * factor
    if verify_convergence(solved.exact, altered(claim, radius=radius.hex(), rate=rate.hex())) is not None:
        return
    assert rate < 1
    Y = symmetric_matrix(claim["proof"]["Y"])
    L = vector(claim["proof"]["factor"]).reshape(6, 6)
    factor_of_Y, (i, j) = np.linalg.cholesky(Y), np.triu_indices(6)
    root = np.where(i == j, 1.0, np.sqrt(2.0))
    rng = np.random.default_rng(1)
    for _ in range(15):
        u = np.linalg.solve(factor_of_Y.T, rng.normal(size=21))
        u *= radius / np.linalg.norm(factor_of_Y.T @ u)
        D = np.zeros((6, 6))
        D[i, j] = D[j, i] = u / root
        after = _step(solved, solved.P + L @ D @ L.T) - solved.P
        moved = np.linalg.solve(L, np.linalg.solve(L, after).T)[i, j] * root
        assert np.linalg.norm(factor_of_Y.T @ moved) <= rate * radius * (1 + 1e-6)


def _step(solved: Solved, P: ndarray) -> ndarray:
    """One step in floating point, theta by bisection."""
    low, high = 0.0, 1 / float(np.linalg.eigvalsh(P)[-1])
    for _ in range(200):
        s = np.linalg.eigvalsh(P) * (low + high) / 2
        above = (np.log1p(-s) + s / (1 - s)).sum() > solved.exact.c
        low, high = (low, (low + high) / 2) if above else ((low + high) / 2, high)
    V = np.linalg.inv(np.linalg.inv(P) - low * np.eye(len(P)))
    S = np.array([[float(x) for x in row] for row in information(solved.exact)])
    return solved.exact.A @ np.linalg.inv(np.linalg.inv(V) + S) @ solved.exact.A.T + solved.exact.process.matrix


def test_what_oscillates_is_not_proved_to_converge():
    solved = oscillating()
    found = prove_convergence(solved.exact, solved.box(), np.eye(len(solved.P)))
    assert isinstance(found, balls.NotProved)
    assert isinstance(prove_convergence_for_all(solved.exact), balls.NotProved)


@pytest.mark.parametrize("c", [0.0, 1e-10, 1e-3, 2e-3, 4e-3])
def test_the_centre_of_the_projectile_converges_from_every_start(c: float):
    solved = centre(ring_projectile(), c)
    claim = prove_convergence_for_all(solved.exact)
    assert isinstance(claim, dict), claim
    assert verify_convergence_for_all(solved.exact, claim) is None


def test_at_the_published_tolerance_the_bracket_stays_open():
    found = prove_convergence_for_all(projectile().exact)
    assert isinstance(found, balls.NotProved)
    assert "does not close" in found.reason


def test_a_bracket_that_proves_nothing_is_refused():
    filter_ = at(projectile().exact, 1e-3)
    claim = prove_convergence_for_all(filter_)
    assert isinstance(claim, dict)
    lower, upper = (symmetric_matrix(claim["proof"][key]) for key in ("lower", "upper"))
    for wrong in (
        altered(claim, lower=symmetric_text(upper), upper=symmetric_text(lower)),
        altered(claim, lower=symmetric_text(lower * 1.1)),
        altered(claim, lower=symmetric_text(lower * 0)),
        altered(claim, lower=symmetric_text(-lower)),
        altered(claim, upper=symmetric_text(upper * 0.9)),
        altered(claim, upper=symmetric_text(lower)),
        altered(claim, upper="0x1p+0"),
        altered(claim, steps=claim["proof"]["steps"] // 2),
        altered(claim, steps=-1),
        altered(claim, steps=10**9),
        altered(claim, radius=(number(claim, "radius") * 1e4).hex()),
    ):
        assert verify_convergence_for_all(filter_, wrong)
    assert verify_convergence_for_all(at(filter_, 1.001e-3), claim)
    indefinite = filter_.process.matrix - np.diag([0, 0, 0, 0, 0, 0.002])
    assert verify_convergence_for_all(replace(filter_, process=Covariance(indefinite)), claim)


def test_without_a_sensor_everything_depends_on_kappa():
    """P+ = 0.81 kappa P + Q: bounded just below kappa = 1 / 0.81, c = 0.02385; diverging above (section 6.1)."""
    limit = 1 / 0.81 - 1 + np.log(0.81)
    assert isinstance(prove_convergence_for_all(scalar_filter(0.9, 1.0, 0.0, 0.95 * limit)), dict)
    assert isinstance(prove_convergence_for_all(scalar_filter(0.9, 1.0, 0.0, 1.0001 * limit)), balls.NotProved)
    claim = largest_tolerance_for_all(scalar_filter(0.9, 1.0, 0.0, 0.0), within=2.0)
    assert isinstance(claim, dict)
    assert 0.49 * limit < float.fromhex(claim["c"]) < limit


def test_one_state_converges_from_every_start_at_any_tolerance():
    for c in (1e-14, 0.02, 1.0, 1e3):
        filter_ = scalar_filter(1.1, 0.3, 2.0, c)
        claim = prove_convergence_for_all(filter_)
        assert isinstance(claim, dict), claim
        assert verify_convergence_for_all(filter_, claim) is None


def test_the_largest_tolerance_is_found_by_bisection():
    claim = largest_tolerance_for_all(projectile().exact, within=2.0)
    assert isinstance(claim, dict)
    assert 0.0021 < float.fromhex(claim["c"]) < 0.0048
