"""Exact arithmetic on doubles: the same numbers as fractions give, and definiteness to the last bit."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tolnet.certificates.exact import Exact, segment_sums

doubles = st.floats(allow_nan=False, allow_infinity=False, width=64)


def fractions(values: Exact) -> np.ndarray:
    scale = Fraction(2) ** values.exponent
    return np.array([scale * x for x in values.ints.ravel().tolist()], dtype=object).reshape(values.ints.shape)


def of(values: np.ndarray) -> np.ndarray:
    return np.array([Fraction(x) for x in values.ravel().tolist()], dtype=object).reshape(values.shape)


@given(arrays(np.float64, (3, 2), elements=doubles), arrays(np.float64, (2, 3), elements=doubles))
def test_sums_and_products_are_those_of_fractions(a: np.ndarray, b: np.ndarray):
    x, y = Exact.of(a), Exact.of(b)
    assert (fractions(x) == of(a)).all()
    assert (fractions(x @ y) == of(a) @ of(b)).all()
    assert (fractions(x - y.T) == of(a) - of(b).T).all()
    assert (fractions(abs(x) * Exact.of(a)) == abs(of(a)) * of(a)).all()


@given(arrays(np.float64, 4, elements=doubles))
def test_rounding_back_gives_the_double(a: np.ndarray):
    assert np.array_equal(Exact.of(a).rounded(), a)


def test_segments_may_be_empty():
    sums = segment_sums(Exact.of(np.array([1.0, 2.0, 4.0])), np.array([0, 0, 2, 3, 3]))
    assert sums.rounded().tolist() == [0.0, 3.0, 4.0, 0.0]


@pytest.mark.parametrize("size", [1, 2, 3, 16, 17, 40])
def test_definiteness_to_the_last_bit(size: int):
    # 1 1' + e I is definite for e > 0 only; e = 2^-900 is far below any rounding
    ones = Exact(np.full((size, size), 1 << 900, dtype=object), -900)
    tiny = Exact(np.eye(size, dtype=int).astype(object), -900)
    assert bool((ones + tiny).definite())
    assert bool((ones - tiny).definite()) is (size == 1)
    assert bool(ones.definite()) is (size == 1)


@pytest.mark.parametrize("size", [2, 5, 30])
def test_definiteness_agrees_with_eigenvalues(size: int):
    rng = np.random.default_rng(size)
    for _ in range(20):
        X = rng.standard_normal((size, size))
        S = X @ X.T - rng.uniform(0, 2) * np.eye(size)
        S = (S + S.T) / 2
        lowest = np.linalg.eigvalsh(S)[0]
        assert abs(lowest) > 1e-9
        assert bool(Exact.of(S).definite()) is bool(lowest > 0)


def test_one_bad_member_spoils_no_other():
    stack = np.stack([np.eye(3), -np.eye(3), np.diag([1.0, 0.0, 1.0]), np.diag([1e300, 1e-300, 1.0])])
    assert Exact.of(stack).definite().tolist() == [True, False, False, True]
