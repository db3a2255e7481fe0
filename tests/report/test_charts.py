"""The pictures of filters show what was found: one line a filter, in its colour, at its numbers."""

from __future__ import annotations

import io
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from tolnet.analysis import evaluate_filters, follow_filters, simulate_filters
from tolnet.design import choose_tolerances, diffusion_matrix
from tolnet.model import Ambiguity, Performance, SensorNetwork, Status, ToleranceTable
from tolnet.model.history import FILTERS, FilterHistory
from tolnet.report.charts import COLOURS, ONE_BY_ONE_UP_TO, performance_figure, simulation_figure

DIFFUSION = [name for name, kind in FILTERS.items() if not kind.centralised]


def path_of(N: int, names: list[str] | None = None) -> SensorNetwork:
    """N nodes in a row, of which each hears its neighbours badly in its own measure."""
    return SensorNetwork(
        A=[[0.9]], B=[[1.0]], C=np.ones((N, 1, 1)), R=np.linspace(1.0, 9.0, N)[:, None, None],
        edges=[[k, k + 1] for k in range(N - 1)], names=names, name="a $b_$ \\frac{", ambiguity=Ambiguity(0.02),
    )  # fmt: skip


def solved(network: SensorNetwork) -> tuple[ToleranceTable, dict[str, Performance], dict[str, FilterHistory]]:
    table, W = choose_tolerances(network), diffusion_matrix(network)
    return table, evaluate_filters(table, W), follow_filters(table, W, 6)


@pytest.fixture(scope="module")
def five() -> tuple[ToleranceTable, dict[str, Performance], dict[str, FilterHistory]]:
    return solved(path_of(5, ["$x_$", "y^", "\\z", "$", "e"]))


def drawn(figure: Figure) -> bytes:
    """The picture, which must draw without a warning."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=50)
    return file.getvalue()


def lines(axes: Axes, name: str) -> list[np.ndarray]:
    """What stands in the colour of one filter."""
    return [np.asarray(line.get_ydata()) for line in axes.lines if to_hex(str(line.get_color())) == COLOURS[name]]


def decibels(values: object) -> np.ndarray:
    return 10 * np.log10(np.asarray(values))


def test_nodes_stand_at_their_deviations(five):
    table, steady, _ = five
    figure = performance_figure(table, steady, {})
    (axes,) = figure.axes
    for name, found in steady.items():
        (values,) = lines(axes, name)
        expected = decibels(found.node_msd)
        assert values == pytest.approx(expected if name in DIFFUSION else [expected[0]] * 2)
    assert [text.get_text() for text in axes.get_xticklabels()] == ["$x_$", "y^", "\\z", "$", "e"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == list(FILTERS)
    assert drawn(figure).startswith(b"\x89PNG")


def test_with_a_horizon_everything_is_drawn_over_time(five):
    table, steady, histories = five
    msd, _, tolerance, theta = performance_figure(table, steady, histories).axes
    for name, history in histories.items():
        over_time, rest = lines(msd, name)
        assert over_time == pytest.approx(history.msd_db)
        assert rest == pytest.approx([steady[name].msd_db] * 2)
        robust = history.kind.ball != "none"
        for axes, values in ((tolerance, history.tolerance), (theta, history.theta)):
            assert [line.tolist() for line in lines(axes, name)] == ([values.mean(axis=1).tolist()] if robust else [])
    assert "gamma" in tolerance.get_ylabel()
    bands = [band.get_paths()[0].vertices for band in tolerance.collections]
    assert len(bands) == 3
    assert np.asarray(bands[1])[:, 1].min() == histories["RKFDNU"].tolerance.min()
    assert np.asarray(bands[1])[:, 1].max() == histories["RKFDNU"].tolerance.max()


def test_tolerances_are_drawn_in_the_convention_of_the_table(five):
    table, steady, histories = five
    nats = choose_tolerances(table.network, Ambiguity(0.01, "nats"))
    *_, tolerance, _ = performance_figure(nats, steady, histories).axes
    assert "nats" in tolerance.get_ylabel()
    assert lines(tolerance, "RKFC")[0].tolist() == [0.01] * 6


def test_large_networks_are_curves_of_sorted_nodes():
    table, steady, _ = solved(path_of(ONE_BY_ONE_UP_TO + 1))
    (axes,) = performance_figure(table, steady, {}).axes
    assert axes.get_xlabel() == "nodes, sorted for each filter"
    for name in DIFFUSION:
        (values,) = lines(axes, name)
        assert values == pytest.approx(np.sort(decibels(steady[name].node_msd)))


def test_what_has_no_answer_is_in_the_legend_and_nowhere_else(five):
    table, steady, histories = five
    nothing = {
        name: replace(each, status=Status.UNSTABLE, blocks=np.full_like(each.blocks, np.nan))
        for name, each in steady.items()
    }
    figure = performance_figure(table, nothing, histories)
    assert not [line for name in COLOURS for line in lines(figure.axes[1], name) if np.isfinite(line).any()]
    assert figure.legends[0].get_texts()[0].get_text() == "KFC (unstable)"
    drawn(figure)


def test_simulations_stand_beside_what_was_predicted(five):
    table, _, _ = five
    found = simulate_filters(table, diffusion_matrix(table.network), runs=60, steps=4, filters=["RKFC", "RKFDNU2"])
    figure = simulation_figure(table, found)
    mse, ratio, node, consistency = figure.axes
    for name, each in found.items():
        measured, predicted = lines(mse, name)
        assert measured == pytest.approx(decibels(each.mse))
        assert predicted == pytest.approx(decibels(each.bound))
        assert (each.mse / each.bound).tolist() in [line.tolist() for line in lines(ratio, name)]
        assert (100 * each.consistency).tolist() in [line.tolist() for line in lines(consistency, name)]
    assert lines(node, "RKFDNU2")[0] == pytest.approx(decibels(found["RKFDNU2"].node_mse[-1]))
    band = np.asarray(ratio.collections[1].get_paths()[0].vertices)[:, 1]
    ends = found["RKFDNU2"].interval / found["RKFDNU2"].bound[:, None]
    assert (band.min(), band.max()) == pytest.approx((ends.min(), ends.max()))
    drawn(figure)


def test_pictures_leave_no_global_state_behind(five):
    table, steady, _ = five
    performance_figure(table, steady, {})
    if "matplotlib.pyplot" in sys.modules:
        assert not sys.modules["matplotlib.pyplot"].get_fignums()
