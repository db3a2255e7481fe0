"""`attraction`: rates just above the truth are proved, just below refused; what repels is refuted."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.certificates.ball_filters import CASES, case, information, oscillating, projectile, scalar
from tests.reference import fifty_digits

from tolnet.certificates import balls
from tolnet.certificates.attraction import (
    lyapunov,
    prove_attraction,
    refute_attraction,
    spectral_radius,
    verify_attraction,
    verify_refuted_attraction,
)
from tolnet.certificates.fixed_point import Box
from tolnet.certificates.numerals import matrix_text, symmetric_matrix, symmetric_text


def attraction(name: str) -> float:
    """The spectral radius by differences of the recursion itself."""
    exact = case(name).exact
    return fifty_digits.attraction(exact.A, exact.process.matrix, information(exact), exact.c, case(name).oracle())


@pytest.mark.parametrize("name", CASES)
def test_the_rate_is_just_above_the_truth(name: str):
    solved, truth = case(name), attraction(name)
    claim = prove_attraction(solved.exact, solved.box())
    assert isinstance(claim, dict), claim
    assert verify_attraction(solved.exact, claim) is None
    rate = float.fromhex(claim["rate"])
    assert truth < rate <= truth + 0.011 * (1 - truth)
    for below in (truth * (1 - 1e-6), 0.0, -rate, np.nan, 1.0):
        assert verify_attraction(solved.exact, claim | {"rate": below.hex()})
    assert isinstance(refute_attraction(solved.exact, solved.box()), balls.NotProved)


def test_the_last_digit_of_the_rate_decides():
    """A = S = 1, Q = 1/2, c = 0: P = 1 exactly, and J = (A / (1 + P S))^2 = 1/4."""
    exact = scalar(1.0, 0.5, 1.0, 0.0)
    box = Box(np.eye(1), 0.0, 2.0**-50)
    claim = {"c": "0x0p+0", "proof": {"box": box.text(), "Y": "0x1p+0"}}
    for rate, holds in [(0.25, False), (np.nextafter(0.25, 1), True), (np.nextafter(0.25, 0), False), (0.9, True)]:
        assert (verify_attraction(exact, claim | {"rate": float(rate).hex()}) is None) == holds


@settings(max_examples=30)
@given(st.integers(0, 20), st.floats(-1e3, 1e3), st.floats(0.3, 1.2))
def test_whatever_is_accepted_is_true(entry: int, change: float, factor: float):
    """An altered Y and rate: either may still prove it, but never a rate below the truth."""
    solved = projectile()
    proof = _claim()["proof"]
    Y = symmetric_matrix(proof["Y"])
    i, j = np.triu_indices(21)[0][entry], np.triu_indices(21)[1][entry]
    Y[i, j] = Y[j, i] = Y[i, j] + change
    rate = factor * 0.91
    claim = {"c": _claim()["c"], "rate": rate.hex(), "proof": proof | {"Y": symmetric_text(Y)}}
    if verify_attraction(solved.exact, claim) is None:
        assert solved.attraction < rate < 1


@cache
def _claim() -> dict:
    found = prove_attraction(projectile().exact, projectile().box())
    assert isinstance(found, dict)
    return found


@pytest.mark.parametrize("text", ["", "0x1p+0", symmetric_text(np.zeros((21, 21))), symmetric_text(-np.eye(21))])
def test_a_matrix_that_proves_nothing_is_refused(text: str):
    claim = _claim() | {"proof": _claim()["proof"] | {"Y": text}}
    assert verify_attraction(projectile().exact, claim)


def test_what_repels_is_refuted_with_a_witness():
    solved = oscillating()
    assert isinstance(prove_attraction(solved.exact, solved.box()), balls.NotProved)
    claim = refute_attraction(solved.exact, solved.box())
    assert isinstance(claim, dict), claim
    witness = claim["witness"]
    X = symmetric_matrix(witness["X"])
    for altered in (
        {"X": symmetric_text(-X)},
        {"X": symmetric_text(X + 2 * np.abs(X).max() * np.eye(len(X)))},
        {"X": "0x1p+0"},
        {"v": matrix_text(np.zeros(len(X)))},
        {"v": matrix_text(np.linalg.eigh(X)[1][:, 0])},
        {"v": "0x1p+0"},
        {"box": Box(solved.P * 1.01, solved.theta, 1e-12).text()},
    ):
        assert verify_refuted_attraction(solved.exact, {"witness": witness | altered})
    assert verify_refuted_attraction(solved.exact, claim) is None


def test_no_witness_against_what_attracts():
    """A = S = 1, Q = 1/2: J = 1/4 < 1, so (J^2 - 1) X > 0 makes X < 0."""
    box = Box(np.eye(1), 0.0, 2.0**-50).text()
    for x in (-1.0, 0.0, 1.0):
        witness = {"box": box, "X": matrix_text(np.array([x])), "v": "0x1p+0"}
        assert verify_refuted_attraction(scalar(1.0, 0.5, 1.0, 0.0), {"witness": witness})


def test_lyapunov_matrices():
    rng = np.random.default_rng(0)
    J = rng.normal(size=(5, 5)) / 5
    rate = spectral_radius(J) * 1.1
    Y = lyapunov(J, rate)
    assert Y is not None
    np.testing.assert_allclose(rate**2 * Y - J.T @ Y @ J, rate**2 * np.eye(5), atol=1e-12)
    assert lyapunov(J, spectral_radius(J) * 0.9) is None
