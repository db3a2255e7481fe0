"""`tolerance`: the interval holds what fifty digits find by determinants, and every interval beside it is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.certificates.ball_filters import CASES, Solved, case, projectile, sensors_of
from tests.instances import ring_projectile
from tests.reference import determinants, fifty_digits
from tests.reference.exact import mpf

from tolnet.certificates import balls
from tolnet.certificates.exact_filter import Sensor
from tolnet.certificates.local_tolerance import prove_tolerance, verify_tolerance


def interval(claim: dict) -> tuple[float, float]:
    """Its two ends."""
    lo, hi = (float.fromhex(x) for x in claim["interval"].split())
    return lo, hi


def truth(solved: Solved, sensors: tuple[Sensor, ...]):
    """c_k by determinants of size n + p_k."""
    exact, state = solved.exact, solved.oracle()
    C = np.concatenate([sensor.C for sensor in sensors])
    R = np.zeros((len(C), len(C)))
    at = 0
    for sensor in sensors:
        p = len(sensor.C)
        R[at : at + p, at : at + p] = sensor.noise.matrix
        at += p
    return fifty_digits.local_tolerance(exact.A, exact.process.matrix, C, R, state.P, state.V)


@pytest.mark.parametrize("name", CASES)
def test_the_interval_holds_the_tolerance_of_fifty_digits(name: str):
    solved = case(name)
    heard = solved.exact.sensors[:2]
    claim = prove_tolerance(solved.exact, solved.box(), heard)
    assert isinstance(claim, dict), claim
    assert verify_tolerance(solved.exact, claim, heard) is None
    lo, hi = interval(claim)
    c_k = truth(solved, heard)
    assert abs(c_k) < 1e-60 if lo == hi == 0 else mpf(lo) < c_k < mpf(hi)
    assert hi - lo <= 1e-15 * solved.exact.c


def test_every_node_of_the_projectile():
    network, solved = ring_projectile(), projectile()
    box = solved.box()
    widths = []
    for k in range(network.N):
        claim = prove_tolerance(solved.exact, box, sensors_of(network, determinants.hears(network, k)))
        assert isinstance(claim, dict), claim
        lo, hi = interval(claim)
        widths.append((hi - lo) / 2)
        assert 0.014 < lo < 0.0158
    assert max(widths) <= 1e-10 * 0.02


def test_a_node_that_hears_all_has_the_tolerance_of_the_centre():
    solved = projectile()
    claim = prove_tolerance(solved.exact, solved.box(), solved.exact.sensors)
    assert isinstance(claim, dict)
    lo, hi = interval(claim)
    assert lo <= 0.02 <= hi


@given(st.integers(-40, 40), st.integers(0, 40))
def test_an_interval_is_accepted_only_where_it_holds_the_truth(start: int, width: int):
    """Intervals of whole units in the last place around c_k, which lies strictly between two doubles."""
    solved, known = case("three"), _known()
    lo, hi = known["interval"]
    unit = hi - lo
    a, b = lo + start * unit, lo + (start + width) * unit
    claim = known["claim"] | {"interval": f"{a.hex()} {b.hex()}"}
    assert (verify_tolerance(solved.exact, claim, known["sensors"]) is None) == (a <= lo and b >= hi)


@cache
def _known() -> dict:
    solved = case("three")
    sensors = solved.exact.sensors[:2]
    claim = prove_tolerance(solved.exact, solved.box(), sensors)
    assert isinstance(claim, dict)
    exactly = truth(solved, sensors)
    near = float(exactly)
    lo = near if near < exactly else np.nextafter(near, 0)
    return {"claim": claim, "sensors": sensors, "interval": (float(lo), float(np.nextafter(lo, 1)))}


@pytest.mark.parametrize("text", ["", "0x1p+0", "nan nan", "-inf nan", "0x1p+0 0x0p+0", "0x0p+0 0x0p+0"])
def test_an_interval_that_is_none_is_refused(text: str):
    known = _known()
    assert verify_tolerance(case("three").exact, known["claim"] | {"interval": text}, known["sensors"])


def test_the_sensors_of_another_node_are_refused():
    known, exact = _known(), case("three").exact
    assert verify_tolerance(exact, known["claim"], exact.sensors[1:])


def test_a_tolerance_needs_the_steady_state_of_the_centre():
    solved = projectile()
    wrong = replace(solved.box(), P=solved.P * 1.001)
    assert isinstance(prove_tolerance(solved.exact, wrong, solved.exact.sensors[:3]), balls.NotProved)
