"""Large networks: no loop over nodes where it counts."""

from __future__ import annotations

import time

import numpy as np
import pytest
from tests.model.networks import assert_same

from tolnet import model
from tolnet.model import SensorNetwork
from tolnet.model.examples import random_network

NODES = 200_000


@pytest.fixture(scope="module")
def large() -> SensorNetwork:
    return random_network(NODES, seed=0)


def test_two_hundred_thousand_nodes_are_saved_and_loaded_in_seconds(large, tmp_path):
    start = time.process_time()
    path = model.save(large, tmp_path / "large.toml")[0]
    loaded = model.load(path)
    assert time.process_time() - start < 8  # one takes about 1; a Python loop over nodes takes over a minute
    assert path.stat().st_size < 2_000
    assert_same(large, loaded)


def test_asking_for_one_node_does_not_touch_the_others(large):
    for ask in (large.sensor, large.neighbours):
        ask(0)  # computes what is computed once
    start = time.process_time()
    for k in range(0, NODES, 100):
        large.sensor(k)
        large.neighbours(k)
    assert time.process_time() - start < 1  # 2,000 nodes; a pass over all of them each time takes a minute


def test_packed_sensors_of_different_sizes_too(large, tmp_path):
    sizes = np.arange(NODES) % 3
    rows = np.concatenate([[0], np.cumsum(sizes)])
    blocks = np.concatenate([np.eye(2)[:p, :p].ravel() for p in range(3)])
    mixed = SensorNetwork(
        A=large.A,
        B=large.B,
        C=np.ones((rows[-1], 4)),
        D=np.tile(blocks, NODES // 3 + 1)[: int((sizes**2).sum())],
        rows=rows,
        edges=large.links,
    )
    start = time.process_time()
    loaded = model.load(model.save(mixed, tmp_path / "mixed.toml")[0])
    assert time.process_time() - start < 8
    assert_same(mixed, loaded)
