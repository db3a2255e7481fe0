"""Saved and loaded again without the change of a bit."""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse
from tests.instances import ring_projectile
from tests.model.networks import arguments, assert_same

from tolnet import model
from tolnet.model import SensorNetwork
from tolnet.model.examples import random_network


@given(arguments(), st.sampled_from([True, False, "auto"]))
def test_nothing_changes(given_arguments, arrays):
    network = SensorNetwork(**given_arguments)
    with tempfile.TemporaryDirectory() as folder:
        paths = model.save(network, Path(folder) / "problem.toml", arrays=arrays)
        loaded = model.load(paths[0])
        assert_same(network, loaded)
        assert sorted(Path(folder).iterdir()) == sorted(paths)
        assert loaded.digest == hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


@given(arguments())
def test_saving_is_repeatable(given_arguments):
    network = SensorNetwork(**given_arguments)
    with tempfile.TemporaryDirectory() as folder:
        for sub in ("a", "b"):
            Path(folder, sub).mkdir()
        first = model.save(network, Path(folder) / "a" / "p.toml")
        second = model.save(model.load(first[0]), Path(folder) / "b" / "p.toml")
        assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_the_form_of_the_noise_stays(tmp_path):
    shared = {"A": np.eye(1), "C": np.ones((2, 1, 1)), "edges": [[0, 1]]}
    factors = SensorNetwork(**shared, B=[[3.0]], D=np.full((2, 1, 1), 0.1))
    covariances = SensorNetwork(**shared, Q=[[9.0]], R=np.full((2, 1, 1), 0.1))
    for arrays in (True, False):
        model.save(factors, tmp_path / "f.toml", arrays)
        model.save(covariances, tmp_path / "c.toml", arrays)
        f, c = model.load(tmp_path / "f.toml"), model.load(tmp_path / "c.toml")
        assert f.B is not None
        assert f.D is not None
        np.testing.assert_array_equal(f.R, 0.1 * 0.1)
        assert c.B is None
        assert c.D is None


def test_one_node_may_give_its_covariance_and_another_its_factor(tmp_path):
    mixed = SensorNetwork(
        A=np.eye(1), B=np.eye(1), C=[[[1.0]], [[1.0]], []], R=[[[4.0]], None, []], D=[None, [[3.0]], None], edges=[]
    )
    np.testing.assert_array_equal(mixed.R, [4.0, 9.0])
    for arrays in (True, False):
        model.save(mixed, tmp_path / "m.toml", arrays)
        assert_same(mixed, model.load(tmp_path / "m.toml"))


def test_large_arrays_leave_the_text(tmp_path):
    network = random_network(3_000, seed=1)
    named = [f"node {k}" for k in range(network.N)]
    W = network.adjacency.multiply(1.0 / network.degree)
    large = SensorNetwork(
        A=network.A,
        B=network.B,
        C=network.C.reshape(network.N, 1, -1),
        R=network.R,
        adjacency=network.adjacency,
        positions=network.positions,
        names=named,
        diffusion=W,
    )
    paths = model.save(large, tmp_path / "large.toml")
    assert [path.name for path in paths] == ["large.toml", "large.npz"]
    assert paths[0].stat().st_size < 2_000
    assert_same(large, model.load(paths[0]))
    with pytest.raises(model.InputError, match=r"diffusion\.weights is 12000 x 12000.*arrays=True"):
        model.save(_with_weights(12_000), tmp_path / "text.toml", arrays=False)


def _with_weights(N: int) -> SensorNetwork:
    return SensorNetwork(
        A=[[0.5]], B=[[1.0]], C=np.ones((N, 1, 1)), R=np.ones((N, 1, 1)), edges=[], diffusion=sparse.eye_array(N)
    )


def test_a_small_network_is_one_file_that_people_can_read(tmp_path):
    paths = model.save(ring_projectile(), tmp_path / "ring.toml")
    assert [path.name for path in paths] == ["ring.toml"]
    text = paths[0].read_text(encoding="utf-8")
    assert "    [0.1, 0.0, 0.0, 1.0, 0.0, 0.0],\n" in text
    assert "    [0, 19],\n" in text
