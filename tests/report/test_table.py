"""The rows that people see of a large table, and how two tables are compared."""

from __future__ import annotations

import numpy as np
from tests.design.hand_made import hand_made

from tolnet.design.export import TableRecord
from tolnet.model import SensorNetwork, Status
from tolnet.report.difference import compare_tables
from tolnet.report.table import ALL_ROWS_UP_TO, ENDS, summary, telling_rows


def path_of(N: int, names: list[str] | None = None) -> SensorNetwork:
    """N nodes in a row."""
    edges = [[k, k + 1] for k in range(N - 1)]
    return SensorNetwork(
        A=[[0.9]], B=[[1.0]], C=np.ones((N, 1, 1)), R=np.ones((N, 1, 1)), edges=edges, names=names, name="path"
    )


def test_small_tables_show_every_row():
    record = TableRecord.of(hand_made(path_of(ALL_ROWS_UP_TO)))
    assert telling_rows(record).tolist() == list(range(ALL_ROWS_UP_TO))


def test_large_tables_show_their_ends_and_their_largest_variances():
    record = TableRecord.of(hand_made(path_of(100)))
    worst = np.argsort(-record.nodes["trace_V"])[:ENDS]
    ends = [*range(ENDS), *range(100 - ENDS, 100)]
    assert telling_rows(record).tolist() == sorted({*ends, *worst.tolist()})


def test_nodes_without_an_answer_are_the_worst():
    status = {30: Status.UNDETECTABLE, 60: Status.DIVERGES, 61: Status.OSCILLATES}
    record = TableRecord.of(hand_made(path_of(100), status=status))
    shown = set(telling_rows(record).tolist())
    assert set(status) <= shown
    assert len(shown) == 3 * ENDS
    assert summary(record).startswith("97 of 100 nodes ok; c_k from ")


def test_names_given_twice_do_not_tell_nodes_apart():
    """In a table that some other program wrote; no network has such names."""
    records = [TableRecord.of(hand_made(path_of(3, ["a", "b", "c"]), seed=seed)) for seed in (0, 1)]
    twice = {"name": np.array(["a", "b", "b"])}
    old, new = (TableRecord(**{**vars(record), "nodes": {**record.nodes, **twice}}) for record in records)
    difference = compare_tables(old, new)
    assert difference.in_old.tolist() == difference.in_new.tolist() == [0, 1, 2]
    assert difference.added.size == difference.removed.size == 0
    assert difference.changed.all()


def test_the_order_of_the_nodes_does_not_matter_where_names_tell_them():
    table = hand_made(path_of(4, ["a", "b", "c", "d"]))
    old = TableRecord.of(table)
    turned = {key: column[::-1] for key, column in old.nodes.items()}
    new = TableRecord(**{**vars(old), "nodes": {**turned, "node": old.nodes["node"]}})
    difference = compare_tables(old, new, threshold=0.0)
    assert not difference.changed.any()
    assert difference.in_old.tolist() == [3, 2, 1, 0]
