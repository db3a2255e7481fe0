"""Monte Carlo over corrupted channels: bounds hold, liars are found, the published order shows, seeds decide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.corrupted_networks import odd_network

from tolnet import model
from tolnet.analysis import simulate_corrupted
from tolnet.analysis.channel_filters import follow_window
from tolnet.analysis.corrupted_simulation import BATCH
from tolnet.model import CorruptedNetwork, UnsupportedError
from tolnet.model.corrupted_simulation import CorruptedSimulation
from tolnet.model.examples import field

BOUNDED = ("DRKF", "DRKF-SWF", "CRKF")


@pytest.fixture(scope="module")
def published() -> dict[str, CorruptedSimulation]:
    """2,000 runs of the surrogate on one path of noise on matrices, with eq. (17) at every fourth step."""
    return simulate_corrupted(model.example("field"), runs=2000, steps=100, seed=0, shared_path=True, interval=4)


@pytest.mark.slow
def test_no_sample_covariance_exceeds_its_bound_beyond_chance(published: dict[str, CorruptedSimulation]):
    """Given one path of noise on matrices, at all 4 nodes and 101 instants, with a doubt of 1e-3 in all."""
    for name in BOUNDED:
        found = published[name]
        assert found.node_P.shape[1] == (1 if name == "CRKF" else 4)
        assert not found.overconfident
        assert (found.node_mse[5:] < found.node_bound[5:] * 1.2).all()
    assert (published["DRKF"].consistency > 0.98).all()


def test_a_bound_that_is_too_small_is_found(published: dict[str, CorruptedSimulation]):
    """The mutants: filters that know less than there is, and DRKF with a sixth of its P."""
    for name in ("CKF", "CKF-tau", "DSEA-CP"):
        assert published[name].overconfident
    honest = published["DRKF"]
    less = replace(honest, node_P=honest.node_P / 6, node_spread=honest.node_spread * 6)
    assert less.overconfident


def test_the_published_order(published: dict[str, CorruptedSimulation]):
    last = {name: found.mse[-20:].mean() for name, found in published.items()}
    assert last["CRKF"] < last["DRKF"] < 1.6 * last["CRKF"]
    for name in ("CKF", "CSGF", "DSEA-CP"):
        assert last[name] > 5 * last["DRKF"]
        assert published[name].grows
    for name in ("DRKF", "DRKF-SWF", "CRKF", "CKF-tau", "CSGF-tau"):
        assert not published[name].grows
        assert published[name].mse[-1] < published[name].mse[0]
    # what lets CKF and CSGF grow is that they ignore fading
    assert last["CRKF"] < last["CKF-tau"] < last["DRKF"] < last["CSGF-tau"] < 1.4 * last["DRKF"]
    assert (published["DRKF"].bound > published["DRKF"].mse).all()
    assert published["DRKF-SWF"].bound[-20:].mean() < published["DRKF"].bound[-20:].mean()


@pytest.mark.parametrize("shared_path", [False, True])
def test_bounds_hold_where_everything_differs(shared_path: bool):
    network = odd_network(1, window=2, interval=2)
    found = simulate_corrupted(network, runs=400, steps=8, filters=BOUNDED, shared_path=shared_path)
    for each in found.values():
        assert not each.overconfident
        assert each.diverged == 0
        assert each.shared == shared_path
    assert found["DRKF-SWF"].solves > 0


def test_the_answer_depends_on_the_seed_alone():
    network, runs = model.example("field"), BATCH + 20

    def run(**more: object) -> CorruptedSimulation:
        return simulate_corrupted(network, runs=runs, steps=4, filters=["DRKF"], **more)["DRKF"]  # pyright: ignore

    one = run()
    for other in (run(workers=2), simulate_corrupted(network, runs=runs, steps=4)["DRKF"]):
        np.testing.assert_array_equal(one.node_error, other.node_error)
        np.testing.assert_array_equal(one.standard_error, other.standard_error)
    assert not np.array_equal(one.node_mse, run(seed=1).node_mse)
    same = run(shared_path=True)
    assert not np.array_equal(one.node_mse, same.node_mse)
    assert np.ptp([same.node_P, run(shared_path=True).node_P], axis=0).max() == 0


def test_progress_counts_runs():
    seen: list[tuple[int, int]] = []
    simulate_corrupted(
        model.example("field"), runs=BATCH + 5, steps=1, filters=["CKF"], progress=lambda *at: seen.append(at)
    )
    assert seen == [(BATCH, BATCH + 5), (BATCH + 5, BATCH + 5)]


def test_runs_that_diverge_are_told_of_in_words_and_left_out():
    """DSEA-CP on a plant that explodes: far beyond the doubles, without a warning (warnings are errors here)."""
    network = CorruptedNetwork(
        A=40 * np.eye(2), Q=np.eye(2), C=[[[1.0, 0.0]], [[0.0, 1.0]]], R=[[[1.0]], [[1.0]]], edges=[[0, 1]],
        fading_mean=[0.5, 1.0], fading_variance=[0.2, 0.0], estimate_noise=0.1, matrix_noise=0.5,
    )  # fmt: skip
    found = simulate_corrupted(network, runs=20, steps=250, filters=["CKF", "DSEA-CP", "CSGF"])
    for each in found.values():
        assert each.diverged == 20
        assert each.status == "diverges"
        assert "20 of 20 runs diverged" in each.reason
        assert np.isnan(each.mse).all()


def test_a_given_half_width_beyond_the_bounds_is_said():
    odd = odd_network()
    assert simulate_corrupted(odd, runs=2, steps=1, filters=["CKF"])["CKF"].beyond_bounds == ()
    wide = CorruptedNetwork(
        A=[[0.9]], Q=[[1.0]], C=[[[1.0]], [[1.0]]], R=[[[1.0]], [[1.0]]], edges=[[0, 1]], estimate_noise=0.01,
        matrix_noise=0.1, simulation=model.SimulationModel(half_width=0.5),
    )  # fmt: skip
    said = simulate_corrupted(wide, runs=2, steps=1, filters=["CKF"])["CKF"].beyond_bounds
    assert ["beyond its bound 0.01" in said[0], "beyond its bound 0.1" in said[1]] == [True, True]


def test_a_clean_channel_follows_the_reference_numbers():
    """docs/mathematics.md, section 13.5: tr P of DRKF with the bounds in force and nothing realised."""
    history = follow_window(field(base=1.01), 40, interval=0)
    np.testing.assert_allclose(history.node_trace[1], [5.570065, 5.826434, 5.802008, 5.541723], atol=1e-6)
    np.testing.assert_allclose(history.node_trace[40], [3.325149, 3.466143, 3.427847, 3.282440], atol=1e-6)
    assert history.solves == 0


def test_misuse_is_refused():
    network = model.example("field")
    with pytest.raises(ValueError, match="at least 2 runs of 1 step"):
        simulate_corrupted(network, runs=1, steps=3)
    with pytest.raises(UnsupportedError, match="no filter 'EKF'"):
        simulate_corrupted(network, runs=2, steps=3, filters=["EKF"])
    with pytest.raises(ValueError, match="a window is at least 1"):
        simulate_corrupted(network, runs=2, steps=3, window=0)
