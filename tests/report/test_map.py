"""The map shows what the table says: one mark a node in its colour, every link once, names where there is room."""

from __future__ import annotations

import io
import sys

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure
from tests.design.hand_made import hand_made
from tests.instances import ring_projectile

from tolnet.model import SensorNetwork, Status
from tolnet.report.map import NAMES_UP_TO, STRESSED_UP_TO, tolerance_map


def grid(N: int, *, positions: bool = False, directed: bool = False, names: bool = False) -> SensorNetwork:
    """N nodes on a path with every third one linked three further on."""
    edges = [[k, k + 1] for k in range(N - 1)] + [[k, k + 3] for k in range(0, N - 3, 3)]
    place = np.column_stack([np.arange(N) % 7, np.arange(N) // 7]).astype(float)
    return SensorNetwork(
        A=[[0.9]],
        B=[[1.0]],
        C=np.ones((N, 1, 1)),
        R=np.ones((N, 1, 1)),
        edges=edges,
        directed=directed,
        positions=place if positions else None,
        names=[f"node-{k}" for k in range(N)] if names else None,
        name="grid",
    )


def drawn(figure: Figure) -> bytes:
    """The picture, which must draw without a warning."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=50)
    return file.getvalue()


def marks(figure: Figure) -> list[PathCollection]:
    return [each for each in figure.axes[0].collections if isinstance(each, PathCollection)]


def lines(figure: Figure) -> LineCollection:
    (found,) = (each for each in figure.axes[0].collections if isinstance(each, LineCollection))
    return found


def test_every_node_has_the_colour_of_its_tolerance():
    table = hand_made(grid(12, positions=True), convention="nats")
    figure = tolerance_map(table)
    (dots,) = marks(figure)
    where = {tuple(xy): k for k, xy in enumerate(np.asarray(table.network.positions).tolist())}
    order = [where[tuple(xy)] for xy in np.asarray(dots.get_offsets()).tolist()]
    assert sorted(order) == list(range(12))
    np.testing.assert_array_equal(np.asarray(dots.get_array()), table.tolerances[order])
    bar = figure.axes[1]
    assert "nats" in bar.get_ylabel()
    assert table.tolerances.min() == pytest.approx(bar.get_ylim()[0])
    assert table.tolerances.max() == pytest.approx(bar.get_ylim()[1])
    assert drawn(figure).startswith(b"\x89PNG")


def test_larger_degree_is_a_larger_mark():
    table = hand_made(grid(10, positions=True))
    (dots,) = marks(tolerance_map(table))
    sizes = np.asarray(dots.get_sizes())
    assert sizes[0] == sizes.max() > sizes.min()
    assert (np.diff(sizes) <= 0).all()


@pytest.mark.parametrize("directed", [False, True])
def test_every_link_is_drawn_once_between_its_ends(directed: bool):
    network = grid(9, positions=True, directed=directed)
    segments = lines(tolerance_map(hand_made(network))).get_segments()
    assert len(segments) == len(network.links)
    place = np.asarray(network.positions)
    ends = {frozenset(map(tuple, np.asarray(segment).tolist())) for segment in segments}
    assert ends == {frozenset(map(tuple, place[[l, k]].tolist())) for l, k in network.links.tolist()}


def test_nodes_without_an_answer_are_crossed_out_and_counted():
    table = hand_made(grid(12, positions=True), status={3: Status.UNDETECTABLE, 5: Status.OSCILLATES})
    figure = tolerance_map(table)
    dots, crosses = marks(figure)
    assert len(np.asarray(dots.get_offsets())) == 10
    np.testing.assert_array_equal(np.asarray(crosses.get_offsets()), np.asarray(table.network.positions)[[3, 5]])
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert legend.get_texts()[0].get_text() == "no answer: 2 nodes"
    drawn(figure)


def test_a_network_of_which_no_node_has_an_answer_is_drawn_too():
    table = hand_made(grid(3), status=dict.fromkeys(range(3), Status.DIVERGES))
    figure = tolerance_map(table)
    assert len(figure.axes) == 1
    drawn(figure)


@pytest.mark.parametrize(("names", "expected"), [(True, ["node-0", "node-1"]), (False, ["0", "1"])])
def test_small_networks_name_their_nodes(names: bool, expected: list[str]):
    figure = tolerance_map(hand_made(grid(8, names=names)))
    assert [text.get_text() for text in figure.axes[0].texts][:2] == expected
    assert len(figure.axes[0].texts) == 8
    assert not tolerance_map(hand_made(grid(NAMES_UP_TO + 1))).axes[0].texts


@pytest.mark.parametrize("N", [1, 2, 3, 4, 40, STRESSED_UP_TO + 1, 3000])
def test_networks_of_every_size_get_places_apart_from_each_other(N: int):
    figure = tolerance_map(hand_made(grid(N)))
    places = np.concatenate([np.asarray(each.get_offsets()) for each in marks(figure)])
    assert np.isfinite(places).all()
    assert len(np.unique(places, axis=0)) == N
    drawn(figure)


def test_a_layout_is_its_seed():
    def places(seed: int) -> np.ndarray:
        (dots,) = marks(tolerance_map(hand_made(grid(400)), seed=seed))
        return np.asarray(dots.get_offsets())

    np.testing.assert_array_equal(places(1), places(1))
    assert (places(1) != places(2)).any()


def test_parts_without_a_link_between_them_stay_on_one_sheet():
    apart = SensorNetwork(
        A=[[0.9]], B=[[1.0]], C=np.ones((9, 1, 1)), R=np.ones((9, 1, 1)), edges=[[0, 1], [1, 2], [3, 4], [5, 6]]
    )
    (dots,) = marks(tolerance_map(hand_made(apart)))
    places = np.asarray(dots.get_offsets())
    assert np.ptp(places, axis=0).max() < 3 * np.std(places, axis=0).max() * 2
    assert len(np.unique(places, axis=0)) == 9


def test_a_hundred_thousand_nodes_are_one_picture():
    N = 100_000
    generator = np.random.default_rng(0)
    network = SensorNetwork(
        A=[[0.9]],
        B=[[1.0]],
        C=np.ones((N, 1, 1)),
        R=np.ones((N, 1, 1)),
        edges=np.stack([np.arange(N - 1), np.arange(1, N)], axis=1),
        positions=generator.random((N, 2)),
    )
    assert len(drawn(tolerance_map(hand_made(network)))) > 10_000


def test_plots_leave_no_global_state_behind():
    figure = tolerance_map(hand_made(ring_projectile()))
    assert isinstance(figure, Figure)
    if "matplotlib.pyplot" in sys.modules:
        assert not sys.modules["matplotlib.pyplot"].get_fignums()


def test_names_that_look_like_markup_are_drawn_as_they_are():
    network = grid(4)
    object.__setattr__(network, "name", "a $b_$ \\frac{")
    object.__setattr__(network, "names", ("$x_$", "y^", "\\z", "$"))
    figure = tolerance_map(hand_made(network))
    assert [text.get_text() for text in figure.axes[0].texts] == ["$x_$", "y^", "\\z", "$"]
    drawn(figure)
