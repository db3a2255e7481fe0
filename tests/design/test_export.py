"""Written tables: every format says where it comes from, keeps its doubles, and appears whole or not at all."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.design.hand_made import hand_made
from tests.instances import ring_projectile

from tolnet import __version__
from tolnet.design import diffusion_matrix
from tolnet.design.export import TABLE_SUFFIXES, TableRecord, check_table_path, export_table, read_table
from tolnet.design.export.deployment import Deployment
from tolnet.design.export.record import LIMITS, NODES
from tolnet.model import Ambiguity, InputError, SensorNetwork, Status, ToleranceLimits, ToleranceTable


def mixed_network(name: str = "mixed") -> SensorNetwork:
    """p_k = 2, 0, 1, 3 on a directed graph, with names that want quoting: what stresses the packing."""
    generator = np.random.default_rng(7)
    sizes = [2, 0, 1, 3]
    return SensorNetwork(
        A=0.9 * np.eye(3) + 0.1 * generator.normal(size=(3, 3)),
        B=np.eye(3),
        C=[generator.normal(size=(p, 3)) for p in sizes],
        R=[np.eye(p) * 0.3 + 0.1 for p in sizes],
        edges=[[0, 1], [1, 2], [3, 2], [2, 3], [0, 3]],
        directed=True,
        names=['north, "1"', "relay|2", "süd", "-3"],
        name=name,
        digest="0123456789abcdef" * 4,
        ambiguity=Ambiguity(0.02),
    )


def made_limits(table: ToleranceTable) -> tuple[ToleranceLimits, ToleranceLimits]:
    N = table.network.N
    nodes = {key: np.linspace(0.1, 0.3, N) * (i + 1) for i, key in enumerate(LIMITS)}
    nodes["exists"] = np.full(N, np.inf)
    centre = {key: np.asarray(column[0]) for key, column in nodes.items()}
    shared = {"window": 6, "largest": 1e8}
    return ToleranceLimits(**centre, **shared), ToleranceLimits(**nodes, **shared)


@pytest.fixture
def partial() -> ToleranceTable:
    """A table in nats in which one node has no answer and another oscillates."""
    return hand_made(mixed_network(), convention="nats", status={1: Status.UNDETECTABLE, 3: Status.OSCILLATES})


def same(a: np.ndarray, b: np.ndarray) -> bool:
    """Equal bit for bit, NaN counting as equal to NaN."""
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


@pytest.mark.parametrize("suffix", [".json", ".csv", ".npz"])
def test_what_is_read_back_is_what_was_written_bit_for_bit(suffix: str, partial: ToleranceTable, tmp_path: Path):
    path = tmp_path / f"table{suffix}"
    export_table(partial, path, full=True, limits=made_limits(partial))
    written, read = TableRecord.of(partial), read_table(path)
    assert read.heading() == written.heading()
    assert read.central == written.central
    assert list(read.nodes) == list(written.nodes)
    assert all(same(read.nodes[key], written.nodes[key]) for key in written.nodes)


@pytest.mark.parametrize("suffix", TABLE_SUFFIXES)
def test_every_file_says_where_it_comes_from(suffix: str, partial: ToleranceTable, tmp_path: Path):
    path = tmp_path / f"table{suffix}"
    export_table(partial, path)
    if suffix == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            said = " ".join(str(archive[key]) for key in archive.files if archive[key].ndim == 0)
    elif suffix == ".parquet":
        import pyarrow.parquet

        said = pyarrow.parquet.read_schema(path).metadata[b"tolnet"].decode()
    else:
        said = path.read_text(encoding="utf-8")
    tolerance = repr(partial.tolerance)
    for fact in ("mixed", "0123456789abcdef" * 4, "nats", tolerance, __version__, "undetectable"):
        assert fact in said
    assert "tau" in said or suffix == ".npz"


def test_json_is_the_document_of_the_contract(partial: ToleranceTable, tmp_path: Path):
    path = tmp_path / "table.json"
    export_table(partial, path, limits=made_limits(partial))
    document = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert list(document) == [
        "schema", "tolnet", "problem", "convention", "tau", "tolerance", "status", "central", "nodes",
    ]  # fmt: skip
    assert document["schema"] == "tolnet.table/1"
    assert document["problem"] == {"name": "mixed", "sha256": "0123456789abcdef" * 4}
    assert document["status"] == "undetectable"
    assert set(document["central"]) == {"theta", "trace_P", "trace_V", "attraction", "status", "reason", "limits"}
    assert document["central"]["reason"] is None
    node = document["nodes"][1]
    assert set(node) == {*NODES, "name", "reason", "limits"}
    assert node["status"] == "undetectable"
    assert node["reason"].startswith("no sensor that it hears (nodes 0, 1) sees all of the mode")
    assert "attraction 1.25 is not below 1" in document["nodes"][3]["reason"]
    assert document["nodes"][0]["reason"] is None
    assert node["theta"] is None
    assert node["trace_V"] is None
    assert node["limits"]["exists"] == "inf"
    assert set(node["limits"]) == set(LIMITS)
    assert document["nodes"][3]["status"] == "oscillates"
    assert document["nodes"][3]["attraction"] == 1.25


def test_limits_are_in_the_convention_of_the_document(partial: ToleranceTable, tmp_path: Path):
    limits = made_limits(partial)
    export_table(partial, tmp_path / "table.json", limits=limits)
    document = json.loads((tmp_path / "table.json").read_text())
    assert document["nodes"][2]["limits"]["fold"] == limits[1].fold[2] / 2
    assert document["central"]["limits"]["attracts"] == float(limits[0].attracts) / 2
    rows = TableRecord.of(partial, limits).columns
    np.testing.assert_array_equal(rows["limits_published"], limits[1].published / 2)


def test_full_json_carries_what_is_deployed(partial: ToleranceTable, tmp_path: Path):
    export_table(partial, tmp_path / "table.json", full=True)
    document = json.loads((tmp_path / "table.json").read_text())
    network, W = partial.network, diffusion_matrix(partial.network).toarray()
    for k in (0, 2, 3):
        node = document["nodes"][k]
        heard, gain = partial.gain(k)
        np.testing.assert_array_equal(node["P"], partial.local.P[k])
        np.testing.assert_array_equal(node["V"], partial.local.V[k])
        np.testing.assert_allclose(node["gain"], gain, rtol=1e-13, atol=1e-15)
        assert [link["node"] for link in node["neighbours"]] == heard.tolist()
        assert [link["weight"] for link in node["neighbours"]] == W[heard, k].tolist()
        for link in node["neighbours"]:
            first, last = link["columns"]
            assert last - first == network.rows[link["node"] + 1] - network.rows[link["node"]]
    assert np.array(document["nodes"][1]["V"], dtype=float).shape == (3, 3)
    assert document["nodes"][1]["V"][0] == [None, None, None]


def test_npz_packs_gains_and_weights_without_pickle(partial: ToleranceTable, tmp_path: Path):
    export_table(partial, tmp_path / "table.npz", limits=made_limits(partial))
    with np.load(tmp_path / "table.npz", allow_pickle=False) as archive:
        arrays = dict(archive)
    assert arrays["nodes_V"].shape == (4, 3, 3)
    assert same(arrays["nodes_P"], partial.local.P)
    assert np.isinf(arrays["nodes_limits_exists"]).all()
    W = diffusion_matrix(partial.network).toarray()
    for k in (0, 2, 3):
        heard, gain = partial.gain(k)
        links = slice(*arrays["neighbour_offsets"][[k, k + 1]])
        assert arrays["neighbours"][links].tolist() == heard.tolist()
        assert arrays["weights"][links].tolist() == W[heard, k].tolist()
        first, last = arrays["gain_offsets"][arrays["neighbour_offsets"][[k, k + 1]]]
        np.testing.assert_allclose(arrays["gains"][first:last].T, gain, rtol=1e-13, atol=1e-15)


def test_packed_gains_do_not_depend_on_how_many_are_formed_at_a_time(monkeypatch: pytest.MonkeyPatch):
    table = hand_made(ring_projectile())
    at_once = Deployment.of(table)
    monkeypatch.setattr("tolnet.design.export.deployment._COLUMNS_AT_A_TIME", 37)
    np.testing.assert_array_equal(Deployment.of(table).gains, at_once.gains)


def test_parquet_has_the_rows(partial: ToleranceTable, tmp_path: Path):
    import pyarrow.parquet

    export_table(partial, tmp_path / "table.parquet")
    rows = pyarrow.parquet.read_table(tmp_path / "table.parquet").to_pydict()
    assert rows["name"] == list(partial.network.names or ())
    assert rows["tolerance"] == partial.tolerances.tolist()
    assert rows["status"] == ["ok", "undetectable", "ok", "oscillates"]


def test_markdown_keeps_its_columns_whatever_the_names(partial: ToleranceTable, tmp_path: Path):
    export_table(partial, tmp_path / "table.md", limits=made_limits(partial))
    rows = [line for line in (tmp_path / "table.md").read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    assert len(rows) == 2 + 4
    assert len({line.replace("\\|", "").count("|") for line in rows}) == 1
    assert "relay\\|2" in rows[3]


def test_csv_is_read_by_anyone_who_skips_the_comments(partial: ToleranceTable, tmp_path: Path):
    export_table(partial, tmp_path / "table.csv")
    text = (tmp_path / "table.csv").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines(keepends=True) if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    assert [row["name"] for row in rows] == list(partial.network.names or ())
    assert float(rows[2]["theta"]) == partial.local.theta[2]
    assert rows[1]["theta"] == ""


PROBE = r"""
#include <stdio.h>
#include "table.h"
int main(void) {
    for (int k = 0; k < TOLNET_MIXED_NODES; k++) {
        const struct tolnet_mixed_node *node = &tolnet_mixed_nodes[k];
        printf("%d %d %a %a", (int)node->status, node->degree, node->tolerance, node->theta);
        for (int i = 0; i < node->degree; i++)
            printf(" %d %d %a", node->neighbours[i], node->columns[i + 1], node->weights[i]);
        for (int i = 0; i < TOLNET_MIXED_STATES * TOLNET_MIXED_STATES; i++)
            printf(" %a %a", node->P[i], node->V[i]);
        for (int i = 0; i < TOLNET_MIXED_STATES * node->columns[node->degree]; i++)
            printf(" %a", node->gain[i]);
        printf("\n");
    }
    return 0;
}
"""
STRICT = ["-Wall", "-Wextra", "-pedantic", "-Werror"]


def compiled(folder: Path, source: str, *compiler: str) -> str:
    """What a C program beside the header prints, compiled without a warning."""
    path = folder / ("probe.cc" if compiler[0] == "g++" else "probe.c")
    path.write_text(source)
    program = folder / "probe"
    subprocess.run([*compiler, *STRICT, str(path), "-o", str(program)], check=True, capture_output=True, text=True)
    return subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout


@pytest.mark.parametrize("compiler", [("gcc", "-std=c99"), ("g++", "-std=c++11")], ids=["c99", "c++11"])
def test_header_compiles_without_a_warning_and_reads_back_as_the_same_doubles(
    compiler: tuple[str, ...], partial: ToleranceTable, tmp_path: Path
):
    assert shutil.which(compiler[0]), f"{compiler[0]} is missing; a C compiler is part of what a clone needs"
    export_table(partial, tmp_path / "table.h")
    deployment = Deployment.of(partial)
    lines = compiled(tmp_path, PROBE, *compiler).splitlines()
    assert len(lines) == 4
    for k, line in enumerate(lines):
        words = line.split()
        degree, begin = int(words[1]), deployment.offsets[k]
        assert int(words[0]) == [0, 4, 0, 1][k]
        assert degree == partial.network.degree[k]
        links = slice(begin, begin + degree)
        widths = deployment.columns[begin + 1 : begin + degree + 1] - deployment.columns[begin]
        assert words[4 : 4 + 3 * degree : 3] == [str(l) for l in deployment.neighbours[links]]
        assert words[5 : 4 + 3 * degree : 3] == [str(width) for width in widths]
        read = np.array([float.fromhex(word) for word in [*words[2:4], *words[6 : 4 + 3 * degree : 3]]])
        expected = np.array([partial.tolerances[k], partial.local.theta[k], *deployment.weights[links]])
        assert same(read, expected)
        matrices = np.array([float.fromhex(word) for word in words[4 + 3 * degree :]])
        P_and_V = np.stack([partial.local.P[k], partial.local.V[k]], axis=-1).ravel()
        assert same(matrices, np.concatenate([P_and_V, deployment.gain(k).ravel()]))


@pytest.mark.parametrize("name", ["", "int", "9 lives", 'a */ "b" ??/ \\ c', "überall\nzwei", "%d{{ x }}"])
def test_header_compiles_whatever_the_problem_is_called(name: str, tmp_path: Path):
    table = hand_made(ring_projectile())
    object.__setattr__(table.network, "name", name)
    export_table(table, tmp_path / "table.h")
    assert compiled(tmp_path, '#include "table.h"\nint main(void) { return 0; }\n', "gcc", "-std=c99") == ""


def test_header_of_relays_only_has_no_empty_array(tmp_path: Path):
    relays = SensorNetwork(
        A=[[0.5]], B=[[1.0]], C=[np.empty((0, 1))] * 2, R=[np.empty((0, 0))] * 2, edges=[[0, 1]], name="relays"
    )
    export_table(hand_made(relays), tmp_path / "table.h")
    compiled(tmp_path, '#include "table.h"\nint main(void) { return 0; }\n', "gcc", "-std=c99")
    export_table(hand_made(relays), tmp_path / "table.json", full=True)
    assert json.loads((tmp_path / "table.json").read_text())["nodes"][0]["gain"] == [[]]


@pytest.mark.parametrize("size", [1, 2])
def test_tiny_networks_are_written_in_every_format(size: int, tmp_path: Path):
    network = SensorNetwork(
        A=[[0.5]], B=[[1.0]], C=np.ones((size, 1, 1)), R=np.ones((size, 1, 1)), edges=[[0, 1]][: size - 1]
    )
    for suffix in TABLE_SUFFIXES:
        export_table(hand_made(network), tmp_path / f"table{suffix}", full=True)
        assert (tmp_path / f"table{suffix}").stat().st_size > 100


def test_an_unknown_suffix_or_place_is_refused_before_anything_is_written(tmp_path: Path):
    table = hand_made(ring_projectile())
    for name, said in [
        ("table.xlsx", r"has the suffix '\.xlsx'; one of \.json, \.csv"),
        ("table", "has no suffix"),
        ("nowhere/table.json", "nowhere does not exist"),
    ]:
        with pytest.raises(InputError, match=said):
            check_table_path(tmp_path / name)
        with pytest.raises(InputError, match=said):
            export_table(table, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_failing_writer_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "table.json"
    path.write_text("old")

    def broken(*_: object, **__: object):
        yield "half of"
        raise ZeroDivisionError

    monkeypatch.setattr("tolnet.design.export.table_json", broken)
    with pytest.raises(ZeroDivisionError):
        export_table(hand_made(ring_projectile()), path)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["table.json"]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("t.json", b"", "is no table"),
        ("t.json", b"[1, 2]", "no object"),
        ("t.json", b"\xff\xfe", "is text in UTF-16"),
        ("t.json", b'{"schema": "tolnet.diff/1"}', "'tolnet.table/1' was expected"),
        ("t.json", b'{"schema": "tolnet.table/1"}', "nodes is missing"),
        ("t.json", b"[" * 100_000, "is no table"),
        ("t.csv", b"", "schema is 'none'"),
        ("t.csv", b'# schema: "tolnet.table/1"\nnode,theta\n0\n', "a row has not 2 cells"),
        ("t.csv", b"# schema: nonsense\n", "is no table"),
        ("t.npz", b"", "no archive"),
        ("t.npz", b"PK\x03\x04 nothing", "no archive"),
        ("t.txt", b"", r"expected \.json, \.csv, \.npz"),
    ],
)
def test_what_is_no_table_is_refused_with_its_name(name: str, content: bytes, said: str, tmp_path: Path):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as refusal:
        read_table(path)
    assert str(refusal.value).startswith(str(path))


def test_a_missing_table_and_a_directory_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="does not exist"):
        read_table(tmp_path / "missing.json")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(InputError, match="directory"):
        read_table(tmp_path / "folder.csv")


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("tolerance", "many", r"tolerance is wrong; a number was expected"),
        ("convention", "bits", r"convention is 'bits'; 'gamma' or 'nats' was expected"),
        ("central", 3, "central is missing"),
    ],
)
def test_a_damaged_document_names_the_key(key: str, value: object, said: str, tmp_path: Path):
    path = tmp_path / "t.json"
    export_table(hand_made(ring_projectile()), path)
    document = json.loads(path.read_text())
    path.write_text(json.dumps({**document, key: value}))
    with pytest.raises(InputError, match=said):
        read_table(path)


def test_pickled_content_is_refused(tmp_path: Path):
    path = tmp_path / "t.npz"
    np.savez(path, schema=np.array([object()], dtype=object))
    with pytest.raises(InputError, match="pickled"):
        read_table(path)


def test_the_status_of_a_document_is_the_centres_where_that_is_not_ok():
    table = hand_made(ring_projectile(), status={4: Status.DIVERGES}, centre=Status.OSCILLATES)
    record = TableRecord.of(table)
    assert record.status == "oscillates"
    assert replace(record, central={**record.central, "status": "ok"}).status == "diverges"
    assert TableRecord.of(hand_made(ring_projectile())).status == "ok"
