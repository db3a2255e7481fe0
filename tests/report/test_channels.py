"""Pictures and reports of filters over corrupted channels show what was found."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_hex

from tolnet import model
from tolnet.analysis import CHANNEL_FILTERS, simulate_corrupted
from tolnet.design import choose_window
from tolnet.model.corrupted_simulation import CorruptedSimulation
from tolnet.report.channel_charts import COLOURS, channel_figure
from tolnet.report.channels import channel_report, channel_view
from tolnet.report.window import window_view
from tolnet.report.window_chart import window_figure


@pytest.fixture(scope="module")
def found() -> dict[str, CorruptedSimulation]:
    return simulate_corrupted(model.example("field"), runs=20, steps=10)


def test_each_filter_is_a_line_in_its_colour(found: dict[str, CorruptedSimulation]):
    assert list(COLOURS) == list(CHANNEL_FILTERS)
    figure = channel_figure(model.example("field"), found)
    mse = figure.axes[0]
    solid = {to_hex(line.get_color()): line for line in mse.lines if line.get_linestyle() == "-"}
    for name, each in found.items():
        np.testing.assert_allclose(np.asarray(solid[COLOURS[name]].get_ydata()), 10 * np.log10(each.mse), rtol=1e-12)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == list(found)


def test_what_diverges_grows_or_falls_back_is_said(found: dict[str, CorruptedSimulation]):
    network = model.example("field")
    odd = {
        "CKF": replace(found["CKF"], growth=1.05),
        "DRKF-SWF": replace(found["DRKF-SWF"], fallbacks=3, beyond_bounds=("the noise is too large",)),
        "CSGF": replace(found["CSGF"], diverged=2),
    }
    report = channel_report(network, {**odd, "DRKF": found["DRKF"]})
    assert report.status == "diverges"
    assert list(report.complaints()) == [f"CSGF: diverges: {odd['CSGF'].reason}"]
    lines = [line for line in channel_view(report, dict(reversed(odd.items()))) if isinstance(line, str)]
    said = "\n".join(lines)
    assert "CKF (5.0 % a step)" in said
    assert "3 of 800 fusions fell back" in said
    legend = channel_figure(network, odd).legends[0]
    assert [text.get_text() for text in legend.get_texts()] == ["CKF (grows)", "DRKF-SWF", "CSGF (diverges)"]
    assert json.dumps(report.document()["filters"]["CSGF"]["status"]) == '"diverges"'


def test_a_choice_of_windows_is_drawn_and_told():
    choice = choose_window(model.example("field"), {"solves": 1}, windows=(1,), intervals=(1, 2), steps=8)
    front, node = window_figure(choice).axes
    assert front.get_xlabel() == "solves per step and node"
    before, after = (line.get_ydata() for line in node.lines)
    np.testing.assert_array_equal(before, choice.plain.node_trace)
    np.testing.assert_array_equal(after, choice.node_trace)
    said = "\n".join(line for line in window_view(choice) if isinstance(line, str))
    assert "solves <= 1" in said
    assert f"mean tr P {choice.trace:.5g}" in said
