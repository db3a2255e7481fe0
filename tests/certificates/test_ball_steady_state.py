"""`steady-state`: boxes hold what fifty digits find, and neighbouring boxes, tolerances and gains are refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.certificates import ball_filters
from tests.certificates.ball_filters import CASES, Solved, case, projectile, scalar
from tests.reference import fifty_digits
from tests.reference.exact import exact, eye, inverse, mp, mpf, size, solve

from tolnet.certificates import balls
from tolnet.certificates.exact_filter import Covariance, Sensor
from tolnet.certificates.fixed_point import (
    Box,
    Enclosure,
    enclose,
    find_box,
    prove_steady_state,
    verify_steady_state,
)


def number(x: balls.Ball):
    """The middle of a ball, in mpmath."""
    mantissa, exponent = x.mid().man_exp()
    return mpf(int(mantissa)) * mpf(2) ** int(exponent)


def agree(x: balls.Ball, exactly, size) -> bool:
    """Whether a ball is tiny and holds a number known to fifty digits."""
    radius = number(x.rad())
    return radius <= mpf("1e-38") * size and abs(exactly - number(x)) <= radius + mpf("1e-45") * size


@pytest.mark.parametrize("name", CASES)
def test_the_box_holds_the_steady_state_of_fifty_digits(name: str):
    solved = case(name)
    claim = prove_steady_state(solved.exact, solved.box(), solved.gain)
    assert isinstance(claim, dict), claim
    assert verify_steady_state(solved.exact, claim, solved.gain) is None
    box = Box.read(claim["proof"]["box"])
    assert box.radius <= 2.0**-40
    found = enclose(solved.exact, box)
    assert isinstance(found, Enclosure)
    exactly = solved.oracle()
    with mp.workdps(70):
        scale = [mp.sqrt(x) for x in np.diag(exactly.P)]
        for i in range(len(scale)):
            for j in range(len(scale)):
                size = scale[i] * scale[j]
                assert abs(exactly.P[i, j] - mpf(box.P[i, j])) <= box.radius * size * (1 + 1e-10)
                assert agree(found.P[i, j], exactly.P[i, j], size)
        assert agree(found.theta, exactly.theta, exactly.theta)


def test_the_process_noise_of_a_factor_is_its_exact_square():
    """B B' rounded to doubles is another problem, and another steady state in the thirtieth digit."""
    solved = projectile()
    B = np.sqrt(0.001) * np.eye(6)
    exact, rounded = (replace(solved.exact, process=p) for p in (Covariance(B, True), Covariance(B @ B.T)))
    found = [enclose(e, solved.box()) for e in (exact, rounded)]
    P, other = (f.P[0, 0] for f in found if isinstance(f, Enclosure))
    assert not P.overlaps(other)


@settings(max_examples=40)
@given(st.sampled_from(["three", "few-drives", "scaled"]), st.integers(0, 5), st.integers(-400, 400))
def test_a_box_is_accepted_only_where_it_holds_the_steady_state(name: str, entry: int, eighths: int):
    """One entry moved by up to 50 radii; what is accepted is decided by fifty digits."""
    solved, exactly = case(name), oracle(name)
    good = replace(solved.box(), radius=2.0**-40)
    P = good.P.copy()
    i, j = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)][entry]
    P[i, j] = P[j, i] = P[i, j] + eighths / 8 * good.radius * np.sqrt(P[i, i] * P[j, j])
    box = replace(good, P=P)
    accepted = isinstance(enclose(solved.exact, box), Enclosure)
    with mp.workdps(60):
        off = abs(exactly.P[i, j] - mpf(P[i, j])) / mp.sqrt(mpf(P[i, i]) * mpf(P[j, j])) / mpf(box.radius)
    assert not (accepted and off > 1)
    assert accepted or off > 0.9


@cache
def oracle(name: str) -> fifty_digits.Exact:
    """The steady state of a case in fifty digits, found once."""
    return case(name).oracle()


@pytest.mark.parametrize("factor", [1 + 1e-9, 1 - 1e-9, 1.5])
def test_no_steady_state_of_another_tolerance_lies_in_the_box(factor: float):
    solved = projectile()
    assert not isinstance(enclose(ball_filters.at(solved.exact, 0.02 * factor), solved.box()), Enclosure)


def test_no_steady_state_of_another_filter_lies_in_the_box():
    solved, box = projectile(), projectile().box()
    exact = solved.exact
    others = [
        replace(exact, sensors=exact.sensors[:-1]),
        replace(exact, A=np.nextafter(exact.A, 2) * (1 + 1e-12)),
        replace(exact, process=Covariance(exact.process.matrix * (1 + 1e-12))),
    ]
    assert not any(isinstance(enclose(other, box), Enclosure) for other in others)


def test_what_makes_no_sense_is_refused_with_a_reason():
    solved, box = projectile(), projectile().box()
    skew = np.eye(6) + np.triu(np.ones((6, 6)), 1)
    singular = Sensor(np.eye(6)[:2], Covariance(np.ones((2, 2))))
    for filter_, wrong in [
        (solved.exact, replace(box, radius=np.nan)),
        (solved.exact, replace(box, radius=0.0)),
        (solved.exact, replace(box, radius=1.0)),
        (solved.exact, replace(box, theta=0.0)),
        (solved.exact, replace(box, theta=np.nan)),
        (solved.exact, replace(box, theta=-box.theta)),
        (solved.exact, replace(box, P=box.P * np.inf)),
        (solved.exact, replace(box, P=-box.P)),
        (solved.exact, replace(box, P=box.P[:5, :5])),
        (ball_filters.at(solved.exact, 0.0), box),
        (ball_filters.at(solved.exact, -0.02), box),
        (ball_filters.at(solved.exact, np.nan), box),
        (replace(solved.exact, process=Covariance(skew)), box),
        (replace(solved.exact, sensors=(singular,)), box),
        (replace(solved.exact, sensors=(Sensor(np.eye(6), Covariance(skew)),)), box),
    ]:
        found = enclose(filter_, wrong)
        assert isinstance(found, balls.NotProved)
        assert found.reason


def test_what_floating_point_does_not_know_is_not_proved():
    exact = projectile().exact
    for P, theta in [(np.full((6, 6), np.nan), 1.0), (np.eye(6), 0.0), (np.eye(6), np.nan), (np.eye(6), 1.0)]:
        assert isinstance(find_box(exact, P, theta), balls.NotProved)
    assert isinstance(find_box(scalar(0.5, 1.0, 1.0, 0.0), np.eye(31), 0.0), balls.NotProved)


def test_a_covariance_that_is_singular_is_not_proved():
    """A state that no noise reaches has P = 0 in the end."""
    exact = replace(scalar(0.5, 1.0, 1.0, 0.1), A=np.diag([0.5, 0.5]), process=Covariance(np.diag([1.0, 0.0])))
    exact = replace(exact, sensors=(Sensor(np.eye(2), Covariance(np.eye(2))),))
    assert isinstance(find_box(exact, np.diag([1.0, 0.0]), 0.2), balls.NotProved)


def gain_error(solved: Solved, gain, stated: float | None = None) -> tuple[float, str | None]:
    """The error that is proved for a gain, and the answer to a claim of `stated` or of that error."""
    claim = prove_steady_state(solved.exact, solved.box(), gain)
    assert isinstance(claim, dict), claim
    error = float.fromhex(claim["gain_error"])
    answer = verify_steady_state(solved.exact, claim | {"gain_error": (stated or error).hex()}, gain)
    return error, answer


def test_the_gain_is_compared_with_the_exact_one():
    solved = projectile()
    error, answer = gain_error(solved, solved.gain)
    assert error < 1e-12
    assert answer is None
    single = [G.astype(np.float32).astype(float) for G in solved.gain]
    error, answer = gain_error(solved, single)
    assert 1e-9 < error < 2.0**-24
    assert answer is None
    assert gain_error(solved, single, error * (1 - 1e-9))[1]
    assert gain_error(solved, single, error * (1 + 1e-9))[1] is None
    assert gain_error(solved, single, np.nan)[1]


def test_the_gain_error_is_what_fifty_digits_say():
    solved = case("three")
    gain = [G * 1.25 for G in solved.gain]
    error, _ = gain_error(solved, gain)
    exactly = solved.oracle()
    with mp.workdps(50):
        S = ball_filters.information(solved.exact)
        AZ = exact(solved.exact.A) @ solve(eye(3) + exactly.V @ S, exactly.V)
        off = [
            AZ @ exact(s.C.T) @ inverse(exact(s.noise.matrix)) - exact(G) if len(s.C) else exact(np.zeros((3, 0)))
            for s, G in zip(solved.exact.sensors, gain, strict=True)
        ]
        want = max(size(x) for x in off) / max(mpf(float(np.abs(G).max(initial=0))) for G in gain)
    assert error == pytest.approx(float(want), rel=1e-14)
    assert error >= want


def test_a_gain_that_does_not_fit_the_sensors_is_refused():
    solved, box = case("three"), case("three").box()
    claim = prove_steady_state(solved.exact, box, solved.gain)
    assert isinstance(claim, dict)
    zero = [np.zeros_like(G) for G in solved.gain]
    for gain in (solved.gain[:-1], [G[:2] for G in solved.gain], zero, [G * np.nan for G in solved.gain]):
        assert isinstance(prove_steady_state(solved.exact, box, gain), balls.NotProved)
        assert verify_steady_state(solved.exact, claim, gain)
