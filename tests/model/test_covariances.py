"""(V^-1 + S)^-1 and (I + V S)^-1 against fifty digits, singular, badly scaled and hopeless."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from tolnet.model.covariances import SIX_DIGITS, condition

CASES = {
    "plain": (np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([[1.0, 0.2], [0.2, 3.0]])),
    "one state": (np.array([[1e-9]]), np.array([[1e12]])),
    "no information": (np.diag([1e-6, 1e6]), np.zeros((2, 2))),
    "units": (np.diag([1e-12, 1.0, 1e12]), np.diag([1e14, 1.0, 1e-10]) + 0.1 * np.diag([1e7, 1e-5], 1)),
    "precise and nearly singular": (1e8 * np.ones((2, 2)) + np.diag([1e-4, 2e-4]), np.diag([1e14, 1e14])),
}
CASES["units"] = (CASES["units"][0], (CASES["units"][1] + CASES["units"][1].T) / 2)


def exact(V: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    with mpmath.workdps(60):
        v, s = mpmath.matrix(V.tolist()), mpmath.matrix(S.tolist())
        loop = mpmath.inverse(mpmath.eye(len(V)) + v * s)
        return np.array((loop * v).tolist(), dtype=float), np.array(loop.tolist(), dtype=float)


@pytest.mark.parametrize("name", CASES)
def test_against_fifty_digits(name):
    V, S = CASES[name]
    found, (Z, loop) = condition(V, S), exact(V, S)
    deviation = np.sqrt(np.diag(V))
    bound = max(float(found.error), 1e-14)
    assert bound <= SIX_DIGITS
    assert np.abs((found.covariance - Z) / deviation / deviation[:, None]).max() <= bound
    assert np.abs((found.loop - loop) * deviation / deviation[:, None]).max() <= 10 * bound


def test_a_singular_covariance_stays_singular():
    V, S = np.array([[1.0, 0.0], [0.0, 0.0]]), np.array([[2.0, 1.0], [1.0, 3.0]])
    found = condition(V, S)
    np.testing.assert_allclose(found.covariance, [[1 / 3, 0.0], [0.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(found.loop, [[1 / 3, -1 / 3], [0.0, 1.0]], atol=1e-15)


def test_what_rounding_hides_is_said():
    direction = np.array([0.6, 0.8])
    errors = [float(condition(np.eye(2), scale * np.outer(direction, direction)).error) for scale in (1e4, 1e8, 1e12)]
    assert errors[0] < 1e-10 < errors[1] < SIX_DIGITS < errors[2]
    along_an_axis = condition(np.array([[1e8, 1e3], [1e3, 1e8]]), np.diag([1e14, 0.0]))
    assert not along_an_axis.error <= SIX_DIGITS
    hopeless = condition(np.eye(2), 1e20 * np.ones((2, 2)))
    assert not hopeless.error <= SIX_DIGITS


def test_one_bad_member_leaves_the_others_alone():
    V = np.stack([np.eye(2), np.full((2, 2), np.nan), 2 * np.eye(2)])
    found = condition(V, np.eye(2))
    np.testing.assert_allclose(found.covariance[[0, 2]], [np.eye(2) / 2, 2 / 3 * np.eye(2)], rtol=1e-14)
    assert np.isnan(found.covariance[1]).all()
    assert np.isinf(found.error[1])
