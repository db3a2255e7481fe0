"""What is seen and what is driven, against exact rational arithmetic, in any units and any basis."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray
from tests.instances_random import random_network
from tests.reference.hidden_truth import exactly, hidden_excesses, product

from tolnet import analysis
from tolnet.analysis.hidden_modes import CIRCLE, OUTSIDE, hidden_modes, hides
from tolnet.design import choose_tolerances
from tolnet.design.export import Reasons
from tolnet.model import SensorNetwork

SEEDS = st.integers(0, 2**32 - 1)


def network(A: ndarray, *C: Any, B: ndarray | None = None, **more: Any) -> SensorNetwork:
    """A node for each C, which hears nobody, with R = I."""
    A = np.asarray(A, dtype=float)
    arguments: dict[str, Any] = {"edges": []} | more
    return SensorNetwork(
        A=A, B=np.eye(len(A)) if B is None else B, C=list(map(np.atleast_2d, C)),
        R=[np.eye(len(np.atleast_2d(C_k))) for C_k in C], **arguments,
    )  # fmt: skip


def chain(rng: np.random.Generator) -> ndarray:
    """One to five integrators in a chain, driven by up to two poles a little inside the circle."""
    length, poles = int(rng.integers(1, 6)), 1 - 10.0 ** -rng.uniform(3, 12, int(rng.integers(0, 3)))
    n = length + len(poles)
    A = np.diag(np.concatenate([np.ones(length), poles]))
    for i in range(length):
        for j in range(i + 1, n):
            if j == i + 1 or rng.random() < 0.3:
                A[i, j] = rng.choice([-1, 1]) * 10.0 ** rng.uniform(-6, 6)
    return A


def nearly_defective(rng: np.random.Generator) -> tuple[ndarray, ndarray]:
    """Chains side by side, up or down, with sensors on some states, and units from 1e-8 to 1e8."""
    parts = [chain(rng) for _ in range(rng.integers(1, 3))]
    n = sum(map(len, parts))
    A = np.zeros((n, n))
    at = 0
    for part in parts:
        A[at : at + len(part), at : at + len(part)] = part
        at += len(part)
    order, d = rng.permutation(n), 10.0 ** rng.uniform(-8, 8, n)
    A = A[np.ix_(order, order)]
    A = A.T if rng.random() < 0.3 else A
    C = np.zeros((rng.integers(1, 4), n))
    for row in C:
        on = rng.choice(n, size=rng.integers(1, min(n, 3) + 1), replace=False)
        row[on] = rng.normal(size=len(on)) * 10.0 ** rng.uniform(-6, 6, len(on))
    return A * np.divide.outer(d, d), C / d


def assert_true_of(A: ndarray, C: ndarray) -> None:
    """Both questions about the pair, and the network's answers, are those of exact arithmetic."""
    excesses = hidden_excesses(A, C)
    hidden, on_circle = any(e >= 0 for e in excesses), any(e == 0 for e in excesses)
    modes = hidden_modes(A, C, OUTSIDE)
    assert hides(A, C, OUTSIDE) == bool(modes) == hidden
    assert hides(A, C, CIRCLE) == bool(hidden_modes(A, C, CIRCLE)) == on_circle
    for mode in modes:
        x = mode.direction
        # Of rational eigenvalues every entry is rounded, and the sums here are of n + 1 products. Others come from
        # singular vectors in doubles: two chains of length two that are 2^-10 apart leave a second singular value
        # of about 2^-20, hence 2^-33 times the couplings.
        u = (len(A) + 2) * np.finfo(float).eps
        allowed = u * (np.abs(A) @ np.abs(x)), u * (np.abs(C) @ np.abs(x))
        if mode.eigenvalue.imag:
            allowed = 1e-8 * np.linalg.norm(A), 1e-8 * np.linalg.norm(C)
        assert (np.abs(A @ x - mode.eigenvalue * x) <= allowed[0]).all()
        assert (np.abs(C @ x) <= allowed[1]).all()
        assert np.linalg.norm(x) == pytest.approx(1.0)
        assert not np.delete(x, mode.states).any()
    seen = analysis.detectability(network(A, C))
    assert seen.detectable.tolist() == [not hidden]
    assert seen.centre_detectable == (not hidden)
    assert bool(seen.offending(0)) == hidden
    dual = analysis.detectability(network(A.T, np.eye(len(A)), B=C.T))
    assert dual.stabilisable == (not on_circle)
    assert bool(dual.offending_undriven()) == on_circle


@settings(max_examples=60)
@given(seed=SEEDS)
def test_nearly_defective_plants_in_any_units(seed: int):
    assert_true_of(*nearly_defective(np.random.default_rng(seed)))


def whole(M: ndarray) -> list[list[Fraction]]:
    """Whole numbers as fractions."""
    return [[Fraction(int(x)) for x in row] for row in M]


@settings(max_examples=60)
@given(seed=SEEDS)
def test_jordan_blocks_on_and_near_the_circle_in_a_basis_of_whole_numbers(seed: int):
    """Blocks of 1, of i and of exp(i pi / 3), some moved off by 2^-4 to 2^-10, so that every number is a double."""
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(rng.integers(1, 3)):
        block = [np.eye(1), np.array([[0.0, -1.0], [1.0, 0.0]]), np.array([[0.0, -1.0], [1.0, 1.0]])][rng.integers(3)]
        if rng.random() < 0.5:
            block = block * (1 + rng.choice([-1, 1]) * 2.0 ** -rng.integers(4, 11))
        length = int(rng.integers(1, 3))
        parts.append(np.kron(np.eye(length), block) + np.kron(np.eye(length, k=1), np.eye(len(block))))
    n = sum(map(len, parts))
    A = np.zeros((n, n))
    at = 0
    for part in parts:
        A[at : at + len(part), at : at + len(part)] = part
        at += len(part)
    C = rng.integers(-3, 4, (rng.integers(1, 3), n)) * (rng.random(n) < 0.6)
    T, inverse = np.eye(n), np.eye(n)
    for _ in range(int(rng.integers(0, 2 * n)) if n > 1 else 0):
        i, j = rng.choice(n, 2, replace=False)
        k = rng.choice([-1, 1])
        T[i] += k * T[j]
        inverse[:, j] -= k * inverse[:, i]
    turned = T @ A @ inverse
    assert exactly(turned) == product(product(whole(T), exactly(A)), whole(inverse))
    assert_true_of(turned, C @ inverse)


@settings(max_examples=40)
@given(seed=SEEDS)
def test_what_rounding_hides_in_a_turned_basis_is_found(seed: int):
    """Integrators and rotations in chains, of which some are hidden exactly before basis and units are changed.

    Afterwards nothing is hidden exactly, and what does not decay splits: three integrators by 1e-5.
    """
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(2):
        angle = rng.uniform(0.3, 2.8)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        block = [np.eye(1), turn, rng.uniform(0.2, 0.95, (1, 1))][rng.integers(3)]
        length = int(rng.integers(1, 4))
        parts.append(np.kron(np.eye(length), block) + np.kron(np.eye(length, k=1), np.eye(len(block))))
    n = sum(map(len, parts))
    A = np.zeros((n, n))
    A[: len(parts[0]), : len(parts[0])] = parts[0]
    A[len(parts[0]) :, len(parts[0]) :] = parts[1]
    C = np.where(rng.random((2, n)) < 0.5, rng.choice([-1, 1], (2, n)) * rng.uniform(0.5, 2, (2, n)), 0.0)
    C[0, int(rng.integers(n))] = 1.0
    T, _ = np.linalg.qr(rng.normal(size=(n, n)))
    d = 10.0 ** rng.uniform(-8, 8, n)
    turned, rows = T @ A @ T.T * np.divide.outer(d, d), C @ T.T / d
    margin = 1e-14  # rounding of cosine and sine
    excesses = hidden_excesses(A, C)
    for region, among in (
        (OUTSIDE, [e >= -margin for e in excesses]),
        (CIRCLE, [abs(e) <= margin for e in excesses]),
    ):
        assert hides(A, C, region) == hides(turned, rows, region) == any(among)
    assert analysis.detectability(network(turned, rows)).centre_detectable == (not hides(A, C, OUTSIDE))


SINGER = np.array([[1.0, 0.01, 5e-05], [0.0, 1.0, 0.01], [0.0, 0.0, 0.9999900000499998]])
STATES = ["position", "velocity", "acceleration"]


def test_of_a_singer_model_only_the_position_tells_the_position():
    own = network(SINGER, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], states=STATES)
    seen = analysis.detectability(own)
    np.testing.assert_array_equal(seen.detectable, [False, False, True])
    np.testing.assert_array_equal(seen.observable, [False, False, True])
    assert [(mode.eigenvalue, mode.states) for mode in seen.offending(0)] == [(1.0, (0,))]
    assert [(mode.eigenvalue, mode.states) for mode in seen.offending(1)] == [(1.0, (0, 1))]
    assert seen.offending(2) == seen.offending(None) == []
    reasons = Reasons(choose_tolerances(own, 0.0))
    assert "node 0) sees all of the mode 1 (position) of A, which does not decay" in str(reasons.of(0))
    assert "node 1) sees all of the mode 1 (position, velocity) of A, which does not decay" in str(reasons.of(1))


@pytest.mark.parametrize("pole", [0.99, 1 - 1e-6, 1 - 1e-12])
@pytest.mark.parametrize("unit", [1e-8, 1.0, 5000.0, 1e8])
def test_a_speed_in_any_unit_does_not_tell_the_position(pole: float, unit: float):
    A = np.array([[1.0, unit], [0.0, pole]])
    np.testing.assert_array_equal(
        analysis.detectability(network(A, [0.0, 1.0], [1.0, 0.0])).detectable, [False, True]
    )


@pytest.mark.parametrize("pole", [0.9, 1 - 1e-6, 1 - 1e-9, 1 - 1e-12])
def test_a_bias_without_noise_beside_a_slow_lag(pole: float):
    A = np.array([[1.0, 0.0], [1.0, pole]])
    seen = analysis.detectability(network(A, [0.0, 1.0], B=np.array([[0.0], [1.0]])))
    assert not seen.stabilisable
    assert [(mode.eigenvalue, mode.states) for mode in seen.offending_undriven()] == [(1.0, (0,))]
    assert analysis.detectability(network(A, [0.0, 1.0], B=np.array([[1e-150], [1.0]]))).stabilisable


@pytest.mark.parametrize("value", [1.5, 1.0540914992969064, 1 + 1e-12])
def test_an_undriven_mode_outside_the_circle_has_a_stabilising_solution(value: float):
    A = np.array([[0.95, -0.3], [0.0, value]])
    seen = analysis.detectability(network(A, [0.0, 1.0], B=np.array([[1.0], [0.0]])))
    assert seen.stabilisable
    assert seen.offending_undriven() == []


@pytest.mark.parametrize(("size", "kind"), [(1e-10, "Q"), (1e-160, "Q"), (-5e-15, "B"), (1e-150, "B")])
def test_noise_however_small_drives(size: float, kind: str):
    for value in (1.0, 0.999):
        plant: dict[str, Any] = {"B": [[size]]} if kind == "B" else {"Q": [[size**2]]}
        own = SensorNetwork(A=[[value]], C=[[[1.0]]], R=[[[1.0]]], edges=[], **plant)
        assert analysis.detectability(own).stabilisable


@pytest.mark.parametrize("push", [1e-9, 1e-11, 1e-13])
def test_a_mode_driven_by_a_faint_combination_of_noises_is_driven(push: float):
    """Its share of Q would be the square, and lost: only the rows of B tell it from rounding."""
    T, _ = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))
    A = T @ np.diag([1.0, 0.8, 0.5]) @ T.T
    B = T @ np.diag([push, 1.0, 1.0])
    faint = analysis.detectability(network(A, np.eye(3), B=B))
    assert faint.stabilisable
    assert not analysis.detectability(network(A, np.eye(3), B=T @ np.diag([0.0, 1.0, 1.0]))).stabilisable


@pytest.mark.parametrize("worse", [1.0, 1e6, 1e12])
def test_a_direction_is_seen_through_a_sensor_however_bad(worse: float):
    A = np.array([[1.0, 0.1], [-0.1, 1.0]]) * 1.01
    C = [[[1.0, 0.2], [1.0, 0.2 + 1e-7]]]
    own = SensorNetwork(A=np.kron(np.eye(2), A), B=np.eye(4), edges=[],
                        C=[np.kron(np.eye(2), C[0]), np.kron(np.diag([1.0, 1e-9]), C[0])],
                        R=[np.diag([1.0, worse, 1.0, worse**2])] * 2)  # fmt: skip
    assert analysis.detectability(own).detectable.all()


def test_hidden_exactly_and_a_rounding_from_the_circle_is_on_it():
    """A rotation whose cosine and sine are rounded has a modulus next to one, above or below, and never decays."""
    for angle in np.linspace(0.1, 3.0, 30):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        A = np.zeros((3, 3))
        A[:2, :2], A[2, 2] = turn, 0.5
        assert not analysis.detectability(network(A, [0.0, 0.0, 1.0])).centre_detectable
        assert not analysis.detectability(network(A, np.eye(3), B=np.eye(3)[:, 2:])).stabilisable
    for pole, decays in ((1 - 2.0**-53, False), (1 - 1e-14, True), (1.0, False)):
        assert analysis.detectability(network(np.diag([pole, 0.5]), [0.0, 1.0])).centre_detectable == decays


def test_a_network_decides_like_its_nodes_one_by_one():
    """Nodes that see nothing, a part, weakly or all, some of them alike: groups and the screen change no answer."""
    rng = np.random.default_rng(5)
    A = np.kron(np.array([[1.0, 0.1], [0.0, 1.0]]), np.eye(2))
    A = np.block([[A, np.zeros((4, 2))], [rng.normal(size=(2, 4)), np.diag([0.9, 1 - 1e-9])]])
    base = random_network(rng, 6, 60, relays=0.5, degree=1.0)
    C = []
    for k in range(base.N):
        rows = base.sensor(k)[0] * (rng.random(6) < rng.choice([0.2, 0.5, 1.0]))
        C.append(rows * 10.0 ** rng.uniform(-12, 0, (len(rows), 1)) if k % 3 else np.round(rows))
    own = SensorNetwork(A=A, B=np.eye(6), C=C, R=[np.eye(len(C_k)) for C_k in C], adjacency=base.adjacency.toarray())
    seen = analysis.detectability(own)
    local = [np.concatenate([C[l] for l in own.neighbours(k)]) for k in range(own.N)]
    want = [not any(e >= 0 for e in hidden_excesses(A, rows)) for rows in local]
    assert 0 < sum(want) < own.N
    assert seen.detectable.tolist() == want
    assert [not seen.offending(k) for k in range(own.N)] == want
    assert seen.observable.tolist() == [not hidden_excesses(A, rows) for rows in local]
