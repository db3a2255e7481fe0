"""Windows for a budget: what is chosen is affordable, as good as the best, and what it is said to be."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from tests.corrupted_networks import odd_network

from tolnet import model
from tolnet.analysis import follow_window
from tolnet.design import choose_window
from tolnet.design.window import pair_bytes
from tolnet.model import InputError, UnsupportedError
from tolnet.model.window_choice import WindowChoice


def test_nodes_are_credited_with_their_own_solves_alone():
    """On `field` two nodes that solve give the trace of all four; those two do nothing for it."""
    field = model.example("field")
    choice = choose_window(field, windows=(1,), intervals=(1,), steps=60)
    assert choice.interval.tolist() == [1, 1, 0, 0]
    assert choice.solves == 2 * 60
    assert choice.rate == 0.5
    everyone = next(point for point in choice.front if point.solving == 4)
    assert choice.trace == pytest.approx(everyone.trace, rel=1e-14)
    assert not everyone.on_front
    assert any(point.on_front and point.solving == 2 for point in choice.mixtures)
    late = follow_window(field, 60, choice.window, choice.interval).node_trace[31:].mean()
    assert late == pytest.approx(3.0607503915, rel=1e-9)
    alone = {tuple(point.intervals.tolist()): point.trace for point in choice.mixtures}
    assert alone[1, 0, 0, 0] == pytest.approx(3.17, rel=1e-3)
    assert choice.plain.trace == pytest.approx(3.597, rel=1e-3)


def test_the_cheapest_good_choice_of_a_small_network_is_found():
    """Against every set of nodes that may solve."""
    network = odd_network(2)
    choice = choose_window(network, windows=(1,), intervals=(1,), steps=6)
    every = [np.array(bits) for bits in product((0, 1), repeat=network.N)]
    traces = [follow_window(network, 6, 1, interval).node_trace[3:].mean(axis=0) for interval in every]
    good = [bool((trace <= 1.001 * traces[-1]).all()) for trace in traces]
    fewest = min(int(interval.sum()) for interval, fine in zip(every, good, strict=True) if fine)
    assert int((choice.interval > 0).sum()) == fewest
    best = min(trace.mean() for interval, trace in zip(every, traces, strict=True) if interval.sum() == fewest)
    assert choice.trace <= best * 1.001


def test_a_choice_is_as_good_as_all_nodes_alike_at_every_node():
    network = odd_network(2)
    choice = choose_window(network, windows=(1, 2), intervals=(1, 3), steps=6)
    history = follow_window(network, 6, choice.window, choice.interval)
    np.testing.assert_array_equal(choice.node_trace, history.node_trace[3:].mean(axis=0))
    assert choice.plain.interval == 0
    assert choice.trace < choice.plain.trace
    assert (choice.node_trace <= choice.plain.node_trace * (1 + 1e-9)).all()
    best = min(choice.front, key=lambda point: point.trace)
    assert (choice.node_trace <= best.node_trace * 1.001).all()
    assert choice.rate <= best.solves
    assert [point.solves for point in choice.front] == [0, 1, pytest.approx(1 / 3), 1, pytest.approx(1 / 3)]
    assert choice.front[1].bytes == pair_bytes(network) == 8 * (3 + 6)


def test_a_budget_limits_what_is_taken():
    network = odd_network(2)
    unlimited = choose_window(network, windows=(2,), intervals=(1, 2), steps=4)
    limited = choose_window(network, {"solves": 0.5, "bytes": 72}, windows=(1, 2), intervals=(1, 2), steps=4)
    assert set(limited.interval.tolist()) <= {0, 2}
    assert set(limited.window.tolist()) == {1}
    assert unlimited.trace < limited.trace <= limited.plain.trace
    nothing = choose_window(network, {"solves": 0.0}, windows=(1,), intervals=(1,), steps=6)
    assert nothing.gain == 0
    assert [nothing.method(i) for i in range(5)] == ["DRKF"] * 5
    weights = [[pair.weight for pair in pairs] for pairs in nothing.weights]
    np.testing.assert_allclose(weights[0], network.fusion[[0]].data)


def test_the_front_is_a_front():
    choice = choose_window(model.example("field"), windows=(1, 3), intervals=(1, 4), steps=8)
    everything = [*choice.front, *choice.mixtures]
    for point in everything:
        cheaper = [p for p in everything if p.solves <= point.solves and p.bytes <= point.bytes and p is not point]
        same = [p for p in cheaper if (p.solves, p.bytes) == (point.solves, point.bytes)]
        less = [p for p in cheaper if (p.solves, p.bytes) != (point.solves, point.bytes)]
        dominated = any(p.trace <= point.trace * (1 + 1e-9) for p in less)
        dominated |= any(p.trace < point.trace * (1 - 1e-9) for p in same)
        assert point.on_front == (not dominated)
    assert choice.front[0].on_front
    for point in choice.mixtures:
        assert point.solves == pytest.approx(np.mean([1 / D if D else 0.0 for D in point.intervals]))


def test_weights_are_those_of_the_last_fusion():
    choice = choose_window(odd_network(2), windows=(2,), intervals=(1,), steps=8)
    for i, pairs in enumerate(choice.weights):
        assert sum(pair.weight for pair in pairs) == pytest.approx(1, abs=1e-5)
        assert {pair.sender for pair in pairs} <= set(odd_network(2).neighbours(i).tolist())
        assert {pair.age for pair in pairs} <= {0, 1}
    assert isinstance(choice, WindowChoice)
    assert "L in [2]" in repr(choice)


def test_seconds_count_where_a_step_has_a_length():
    network = model.CorruptedNetwork(
        A=[[0.9]], Q=[[1.0]], C=[[[1.0]], [[1.0]]], R=[[[1.0]], [[1.0]]], edges=[[0, 1]], dt=0.1
    )
    choice = choose_window(network, {"solves": 5}, windows=(1,), intervals=(1, 2), steps=4)
    assert [point.solves for point in choice.front] == pytest.approx([0, 10, 5])
    assert [point.affordable for point in choice.front] == [True, False, True]


def test_progress_ends_at_the_total():
    seen: list[tuple[int, int]] = []
    choose_window(odd_network(), windows=(1,), intervals=(1,), steps=4, progress=lambda *at: seen.append(at))
    assert seen[-1][0] == seen[-1][1]
    assert seen == sorted(seen)
    assert all(done < total for done, total in seen[:-1])


def test_misuse_is_refused_at_once():
    network = odd_network()
    with pytest.raises(InputError, match=r"budget\.power is no known budget"):
        choose_window(network, {"power": 1})
    with pytest.raises(InputError, match=r"budget\.bytes is 10; a link needs 72 bytes"):
        choose_window(network, {"bytes": 10})
    with pytest.raises(InputError, match="windows is"):
        choose_window(network, windows=(0, 1))
    with pytest.raises(InputError, match=r"budget.solves is nan(.|\n)*steps is 1"):
        choose_window(network, {"solves": float("nan")}, steps=1)


def test_one_window_for_all_is_what_a_problem_file_says(tmp_path: Path):
    """Written, read and followed again: the same traces. Nodes of Algorithm 1 never solve."""
    network = odd_network(2)
    mixed = choose_window(network, windows=(1, 2, 3), intervals=(1, 3), steps=6)
    choice = choose_window(network, windows=(1, 2, 3), intervals=(1, 3), steps=6, common_window=True)
    lengths = {L for L, D in zip(choice.window.tolist(), choice.interval.tolist(), strict=True) if D}
    assert len(lengths) == 1
    best = min(point.trace for point in choice.front)
    assert choice.trace <= 1.01 * 1.001 * best
    assert mixed.trace <= 1.01 * best
    model.save(choice.designed(), tmp_path / "designed.toml")
    read = model.load_corrupted(tmp_path / "designed.toml")
    history = follow_window(read, 6)
    np.testing.assert_array_equal(history.node_trace[3:].mean(axis=0), choice.node_trace)
    nothing = choose_window(network, {"solves": 0.0}, windows=(2,), intervals=(1,), steps=6, common_window=True)
    assert follow_window(nothing.designed(), 6).solves == 0


def test_different_windows_are_no_problem_file():
    network = odd_network(2)
    choice = choose_window(network, windows=(2,), intervals=(1,), steps=4)
    mixed = replace(choice, window=np.array([1, 2, 3, 1, 1]), interval=np.array([1, 1, 0, 1, 1]))
    with pytest.raises(UnsupportedError, match=r"windows of \[1, 2\] instants; a problem file has one for all"):
        mixed.designed()
    alike = replace(choice, window=np.array([2, 2, 3, 2, 2]), interval=np.array([1, 1, 0, 1, 1])).designed()
    assert alike.window == 2
    assert alike.interval.tolist()[:2] == [1, 1]
    with pytest.raises(InputError, match=r"fusion\.window is 0"):
        network.replaced(window=0)
    with pytest.raises(InputError, match=r"sensors\[2\]\.interval is 0"):
        network.replaced(interval=[1, 1, 0, 1, 1])
