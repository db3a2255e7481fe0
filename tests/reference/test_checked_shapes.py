"""Wrong shapes are refused in tests, at the first calls and later ones, of functions, methods and dataclasses."""

import inspect
from dataclasses import dataclass

import numpy as np
import pytest
from beartype import beartype
from jaxtyping import Float, TypeCheckError
from numpy import ndarray
from tests.checked_shapes import EVERY, FIRST, next_test, now_and_then

from tolnet.analysis.stacked import solve

enforced = now_and_then(typechecker=beartype)
SQUARE, FLAT = np.eye(2), np.ones((2, 3))


@enforced
def doubled(X: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    return 2 * X


@enforced
def cut(X: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    return X[:1]


@enforced
@dataclass
class Held:
    X: Float[ndarray, "n n"]

    @property
    @enforced
    def first(self) -> Float[ndarray, " n"]:
        return self.X


def test_wrong_arguments_results_fields_and_properties():
    np.testing.assert_array_equal(doubled(SQUARE), 2 * SQUARE)
    for wrong in (lambda: doubled(FLAT), lambda: cut(SQUARE), lambda: Held(FLAT), lambda: Held(SQUARE).first):
        with pytest.raises(TypeCheckError):
            wrong()


def test_also_late_in_a_loop_and_in_the_next_test():
    for _ in range(5 * FIRST):
        doubled(SQUARE)
    refused = 0
    for _ in range(2 * EVERY):
        try:
            doubled(FLAT)
        except TypeCheckError:
            refused += 1
    assert refused == 2
    next_test()
    with pytest.raises(TypeCheckError):
        doubled(FLAT)


def test_the_package_is_enforced():
    with pytest.raises(TypeCheckError):
        solve(np.eye(2), np.eye(2))
    assert list(inspect.signature(solve).parameters) == ["a", "b"]
