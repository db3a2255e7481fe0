"""What is told of filters: the first status that is not ok, one line a reason, infinities that exist."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from tests.design.hand_made import hand_made

from tolnet.model import SensorNetwork
from tolnet.report.filters import FilterReport, decibels, number, per_node


def network(names: list[str] | None = None) -> SensorNetwork:
    return SensorNetwork(
        A=[[0.9]], B=[[1.0]], C=np.ones((2, 1, 1)), R=np.ones((2, 1, 1)), edges=[], names=names, name="two"
    )


def report(statuses: Mapping[str, tuple[str, str | None]]) -> FilterReport:
    """A report of nothing but these statuses and reasons, by filter."""
    return FilterReport(
        schema="tolnet.performance/1",
        title="Performance",
        table=hand_made(network()),
        about={"diffusion": "uniform"},
        filters={name: {"status": status, "reason": reason} for name, (status, reason) in statuses.items()},
        shown={"filter": list(statuses), "status": [status for status, _ in statuses.values()]},
        columns={"node": np.arange(2)},
    )


def test_the_status_of_a_document_is_the_first_that_is_not_ok():
    mixed = report({"KFC": ("ok", None), "KFD": ("unstable", "why"), "RKFDU": ("fold", "because")})
    assert (mixed.status, mixed.ok) == ("unstable", False)
    assert mixed.document()["status"] == "unstable"
    good = report({"KFC": ("ok", None)})
    assert (good.status, good.ok, list(good.complaints())) == ("ok", True, [])


def test_filters_that_share_a_reason_share_a_line():
    shared = report(
        {"KFC": ("fold", "far"), "KFD": ("unstable", "far"), "RKFC": ("fold", "far"), "RKFDU": ("ok", None)}
    )
    assert list(shared.complaints()) == ["KFC, RKFC: fold: far", "KFD: unstable: far"]
    markdown = "".join(shared.markdown())
    assert "- no answer: KFC, RKFC: fold: far\n" in markdown
    assert "| KFD | unstable |" in markdown


def test_a_centralised_filter_says_the_same_at_every_node():
    columns = per_node(network(["a", "b"]), {"KFC": np.array([3.0]), "KFD": np.array([4.0, 5.0])})
    assert {key: column.tolist() for key, column in columns.items()} == {
        "node": [0, 1], "name": ["a", "b"], "KFC": [3.0, 3.0], "KFD": [4.0, 5.0],
    }  # fmt: skip
    assert "name" not in per_node(network(), {})


def test_nothing_is_minus_infinity_decibels_and_no_number_is_a_dash():
    assert decibels(0.0) == -np.inf
    assert decibels(10.0) == 10.0
    assert np.isnan(decibels(np.nan))
    assert (number(np.nan, ".3f"), number(-np.inf, ".3f"), number(1.0, ".3f")) == ("-", "-inf", "1.000")
