"""Balls: what was proved definite is, what is indefinite by a hair is not, and inverses hold the exact ones."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy import ndarray

from tolnet.certificates import balls
from tolnet.certificates.bracket import is_nonnegative
from tolnet.certificates.exact_filter import Covariance


def determinant(M: ndarray) -> Fraction:
    """By cofactors, in fractions."""
    if len(M) == 0:
        return Fraction(1)
    rest = (np.delete(M[1:], j, axis=1) for j in range(len(M)))
    return sum(
        ((-1) ** j * Fraction(float(M[0, j])) * determinant(minor) for j, minor in enumerate(rest)), Fraction(0)
    )


def is_definite(M: ndarray) -> bool:
    """Sylvester's criterion, exactly."""
    return all(determinant(M[:j, :j]) > 0 for j in range(1, len(M) + 1))


@st.composite
def nearly_singular(draw) -> ndarray:
    """Symmetric 3 x 3 matrices B B' of small integers, moved by a few units in the last place."""
    entries = draw(st.lists(st.integers(-3, 3), min_size=6, max_size=6))
    B = np.array(entries, dtype=float).reshape(3, 2)
    M = B @ B.T
    i, ulps = draw(st.integers(0, 2)), draw(st.integers(-3, 3))
    M[i, i] += ulps * 2.0**-50
    return M


@given(nearly_singular())
def test_definite_is_what_sylvester_says_up_to_the_last_digit(M: ndarray):
    with balls.working_precision(balls.BITS):
        assert balls.is_positive(balls.matrix(M)) == is_definite(M)


@given(nearly_singular())
def test_semidefinite_is_decided_exactly(M: ndarray):
    minors = [[i for i in range(3) if bits >> i & 1] for bits in range(1, 8)]
    want = all(determinant(M[np.ix_(m, m)]) >= 0 for m in minors)
    assert is_nonnegative(Covariance(M)) == want


def test_a_matrix_in_bad_units_is_definite_all_the_same():
    unit = np.diag([1e-140, 1.0, 1e140])
    M = unit @ (np.eye(3) + 0.9 * (1 - np.eye(3))) @ unit
    with balls.working_precision(balls.BITS):
        assert balls.is_positive(balls.matrix(M))
        assert not balls.is_positive(balls.matrix(M - 0.2 * unit @ unit))


def test_an_enclosure_with_one_indefinite_member_is_not_definite():
    with balls.working_precision(balls.BITS):
        wide = balls.matrix(np.eye(2)) + balls.matrix_of(2, 2, [balls.ball(0, r) for r in (0, 0.999, 0.999, 0)])
        wider = balls.matrix(np.eye(2)) + balls.matrix_of(2, 2, [balls.ball(0, r) for r in (0, 1, 1, 0)])
        assert balls.is_positive(wide)
        assert not balls.is_positive(wider)


@pytest.mark.parametrize("radius", [0.0, 1e-12, 1e-3, 0.05])
def test_the_inverse_of_a_wide_matrix_holds_every_inverse(radius: float):
    rng = np.random.default_rng(3)
    M = np.eye(4) + 0.3 * rng.normal(size=(4, 4))
    with balls.working_precision(balls.BITS):
        around = balls.matrix(M) + balls.matrix_of(4, 4, [balls.ball(0, radius)] * 16)
        inverse = balls.inverse_of_wide(around)
        for _ in range(20):
            inside = M + radius * rng.choice([-1.0, 0.999, 1.0], size=(4, 4))
            assert inverse.contains(balls.matrix(inside).inv().mid()) or radius == 0
        assert balls.row_sum_norm(inverse - balls.matrix(M).inv()) < 60 * radius + 1e-60


def test_a_wide_matrix_that_holds_a_singular_one_has_no_inverse():
    with balls.working_precision(balls.BITS), pytest.raises(ZeroDivisionError):
        balls.inverse_of_wide(balls.matrix(np.eye(2)) + balls.matrix_of(2, 2, [balls.ball(0, 1)] * 4))


@given(st.floats(-1e300, 1e300), st.floats(0, 1e10))
def test_rounding_outward_loses_nothing(x: float, radius: float):
    with balls.working_precision(balls.BITS):
        third = balls.ball(x, radius) / 3
        assert balls.below(third) <= third <= balls.above(third)
