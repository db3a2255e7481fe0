"""Who hears whom: edges, matrices, networkx graphs and GraphML all mean the same."""

from __future__ import annotations

from pathlib import Path

import networkx
import numpy as np
import pytest
import tomli_w
from scipy import sparse

from tolnet import model
from tolnet.model import InputError, SensorNetwork


def network(N: int = 3, **graph) -> SensorNetwork:
    return SensorNetwork(A=[[0.5]], B=[[1.0]], C=np.ones((N, 1, 1)), R=np.ones((N, 1, 1)), **graph)


ONE_WAY = np.array([[1, 1, 0], [0, 1, 1], [0, 0, 1]], dtype=bool)
"""0 -> 1 -> 2: node 1 hears 0, node 2 hears 1."""


@pytest.mark.parametrize(
    "graph",
    [
        {"edges": [[0, 1], [1, 2]], "directed": True},
        {"edges": np.array([[1, 2], [0, 1]], dtype=np.uint8), "directed": True},
        {"adjacency": [[0, 1, 0], [0, 0, 1], [0, 0, 0]]},
        {"adjacency": np.array([[0, 2.5, 0], [0, 0, -1], [0, 0, 0]])},
        {"adjacency": sparse.coo_array(([1, 1], ([0, 1], [1, 2])), shape=(3, 3))},
        {"adjacency": sparse.csc_matrix(ONE_WAY)},
        {"adjacency": networkx.DiGraph([(0, 1), (1, 2)])},
        {"adjacency": networkx.MultiDiGraph([(0, 1), (0, 1), (1, 2)])},
        {"adjacency": networkx.DiGraph([("a", "b"), ("b", "c")])},
    ],
)
def test_one_way_links(graph):
    own = network(**graph)
    np.testing.assert_array_equal(own.adjacency.toarray(), ONE_WAY)
    assert own.directed
    assert [own.neighbours(k).tolist() for k in range(3)] == [[0], [0, 1], [1, 2]]
    assert own.degree.tolist() == [1, 2, 2]
    assert own.links.tolist() == [[0, 1], [1, 2]]


@pytest.mark.parametrize(
    "graph",
    [
        {"edges": [[0, 1], [2, 1]]},
        {"edges": [[0, 1], [1, 2], [2, 2]]},
        {"adjacency": ONE_WAY | ONE_WAY.T},
        {"adjacency": sparse.csr_array(ONE_WAY | ONE_WAY.T)},
        {"adjacency": networkx.path_graph(3)},
        {"adjacency": networkx.Graph([(0, 1), (1, 2)], weight=0.0)},
    ],
)
def test_links_that_work_both_ways(graph):
    own = network(**graph)
    np.testing.assert_array_equal(own.adjacency.toarray(), ONE_WAY | ONE_WAY.T)
    assert not own.directed
    assert own.links.tolist() == [[0, 1], [1, 2]]


def test_nodes_stand_in_the_order_of_the_graph():
    graph = networkx.DiGraph()
    graph.add_nodes_from(["z", "a", "m"])
    graph.add_edge("m", "z")
    own = network(adjacency=graph)
    assert own.links.tolist() == [[2, 0]]
    assert own.names == ("z", "a", "m")


@pytest.mark.parametrize("kind", [int, np.int64, str])
def test_nodes_that_are_numbers_stand_in_rising_order(kind):
    graph = networkx.DiGraph([(kind(2), kind(10)), (kind(0), kind(2))])  # networkx itself keeps 2, 10, 0
    networkx.set_node_attributes(graph, {kind(k): (float(k), 0.0) for k in (0, 2, 10)}, "pos")
    own = network(adjacency=graph)
    assert own.links.tolist() == [[0, 1], [1, 2]]
    assert own.names == ("0", "2", "10")
    assert own.positions is not None
    assert own.positions[:, 0].tolist() == [0.0, 2.0, 10.0]


@pytest.mark.parametrize("kind", [int, str])
def test_numbers_that_are_places_are_no_names(kind):
    own = network(adjacency=networkx.Graph([(kind(2), kind(1)), (kind(1), kind(0))]))
    assert own.links.tolist() == [[0, 1], [1, 2]]
    assert own.names is None


@pytest.mark.parametrize("nodes", [["2", "01", "0"], ["2", "-1", "0"], ["2", "1 ", "0"], [2, True, "a"], [2, 1.0, 0]])
def test_other_nodes_are_not_sorted(nodes):
    own = network(adjacency=networkx.DiGraph([nodes[:2], nodes[1:]]))
    np.testing.assert_array_equal(own.adjacency.toarray(), ONE_WAY)


def test_a_graph_brings_positions_and_names():
    graph = networkx.path_graph(3)
    networkx.set_node_attributes(graph, {k: (0.5 * k, 1.0) for k in graph}, "pos")
    networkx.set_node_attributes(graph, {k: f"node {k}" for k in graph}, "name")
    own = network(adjacency=graph)
    assert own.positions is not None
    assert own.positions.tolist() == [[0.0, 1.0], [0.5, 1.0], [1.0, 1.0]]
    assert own.names == ("node 0", "node 1", "node 2")
    told = network(adjacency=graph, positions=np.zeros((3, 2)), names=["a", "b", "c"])
    assert told.positions is not None
    assert not told.positions.any()
    assert told.names == ("a", "b", "c")


@pytest.mark.parametrize("attributes", [("x", "y"), ("Longitude", "Latitude")])
def test_coordinates_in_two_attributes(attributes):
    graph = networkx.path_graph(3)
    for axis, key in enumerate(attributes):
        networkx.set_node_attributes(graph, {k: str(k + axis) for k in graph}, key)
    positions = network(adjacency=graph).positions
    assert positions is not None
    assert positions.tolist() == [[0.0, 1.0], [1.0, 2.0], [2.0, 3.0]]


@pytest.mark.parametrize(
    "pos", [None, (1.0,), (1.0, float("nan")), ("a", "b"), {0: 1}, (1.0, 2.0, 3.0), (10**400, 0)]
)
def test_positions_of_some_nodes_are_no_positions(pos):
    graph = networkx.path_graph(3)
    networkx.set_node_attributes(graph, {0: pos, 1: (0.0, 0.0), 2: (0.0, 0.0)}, "pos")
    assert network(adjacency=graph).positions is None


def test_a_graph_of_another_size_is_refused():
    with pytest.raises(InputError, match="network has a graph of 4 nodes; there are 3 sensors"):
        network(adjacency=networkx.path_graph(4))
    with pytest.raises(InputError, match=r"network\.adjacency is 2 x 2; there are 3 sensors"):
        network(adjacency=np.eye(2))


@pytest.mark.parametrize("adjacency", ["x", 3, [[1], [1, 2]], np.array([["a"]]), np.ones((3, 3, 3)), [[1j] * 3] * 3])
def test_what_is_no_graph_is_refused(adjacency):
    with pytest.raises(InputError, match=r"network\.adjacency is no matrix of numbers and no networkx graph"):
        network(adjacency=adjacency)


def test_a_matrix_with_a_hole_is_refused():
    with pytest.raises(InputError, match=r"network\.adjacency has a value that is not a finite number"):
        network(adjacency=np.diag([1.0, np.nan, 1.0]))


def problem_with(folder: Path, data: bytes, **keys) -> Path:
    (folder / "g.graphml").write_bytes(data)
    problem = {
        "schema": "tolnet.problem/1",
        "plant": {"A": [[0.5]], "B": [[1.0]]},
        "network": {"graphml": "g.graphml", **keys},
        "sensors": [{"C": [[1.0]], "R": [[1.0]]}] * 3,
    }
    path = folder / "p.toml"
    path.write_bytes(tomli_w.dumps(problem).encode())
    return path


def graphml(graph: networkx.Graph, folder: Path) -> bytes:
    networkx.write_graphml(graph, folder / "g.graphml")
    return (folder / "g.graphml").read_bytes()


def test_graphml(tmp_path):
    graph = networkx.DiGraph()
    graph.add_node("n0", x=0.5, y=0.0, label="Oslo")
    graph.add_node("n1", x=1.5, y=0.0, label="Bergen")
    graph.add_node("n2", x=2.5, y=1.0, label="Narvik")
    graph.add_edges_from([("n0", "n1"), ("n1", "n2")])
    data = graphml(graph, tmp_path)
    own = model.load(problem_with(tmp_path, data))
    np.testing.assert_array_equal(own.adjacency.toarray(), ONE_WAY)
    assert own.directed
    assert own.names == ("Oslo", "Bergen", "Narvik")
    assert own.positions is not None
    assert own.positions.tolist() == [[0.5, 0.0], [1.5, 0.0], [2.5, 1.0]]
    other = model.load(problem_with(tmp_path, data.replace(b"Narvik", b"Narwik")))
    assert own.digest != other.digest
    assert model.load(problem_with(tmp_path, data, nodes=3, directed=True, names=["a", "b", "c"])).names == (
        "a",
        "b",
        "c",
    )


HEAD = b'<graphml xmlns="http://graphml.graphdrawing.org/xmlns"><graph edgedefault="undirected">'
NODES = b'<node id="a"/><node id="b"/><node id="c"/>'
TAIL = b"</graph></graphml>"


def test_undirected_graphml_without_attributes(tmp_path):
    own = model.load(problem_with(tmp_path, HEAD + NODES + b'<edge source="b" target="a"/>' + TAIL, directed=False))
    assert own.links.tolist() == [[0, 1]]
    assert own.names == ("a", "b", "c")
    assert own.positions is None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is no GraphML: no element found"),
        (b"<graphml", "is no GraphML: "),
        (b"<html/>", "is no GraphML: its outermost element is 'html'"),
        (
            HEAD + NODES + b'<edge source="a" target="q"/>' + TAIL,
            "has an edge to the node 'q', which it does not have",
        ),
        (HEAD + NODES + b'<edge source="a"/>' + TAIL, "has an edge without source or target"),
        (HEAD + NODES + b"<hyperedge/>" + TAIL, "has a hyperedge, a link of more than two nodes"),
        (HEAD + TAIL, "has no nodes"),
        (b"<graphml/>", "is no GraphML: it has no graph"),
        (HEAD + NODES.replace(b'"c"', b'"b"') + TAIL, "has the node 'b' twice"),
        (HEAD + b"<node/>" + TAIL, "has a node without id"),
        (HEAD + b'<node id="g"><graph>' + NODES + b"</graph></node>" + TAIL, "has a graph within a node"),
        (HEAD + NODES + b"</graph><graph></graph></graphml>", "has more than one graph; one was expected"),
        (b'<!DOCTYPE g [<!ENTITY l "lol">]>' + HEAD + NODES + TAIL, "declares entities, which are not read"),
        (b'<?xml version="1.0" encoding="klingon"?>' + HEAD + NODES + TAIL, "is no GraphML: unknown encoding"),
        ((HEAD + NODES + TAIL).replace(b"<node", b"<y:node"), "is no GraphML: unbound prefix"),
    ],
)
def test_bad_graphml(tmp_path, data, message):
    with pytest.raises(InputError, match=rf"p\.toml: network\.graphml names 'g\.graphml', which {message}"):
        model.load(problem_with(tmp_path, data))


def test_graphml_that_contradicts(tmp_path):
    data = HEAD + NODES + TAIL
    with pytest.raises(InputError, match=r"network\.directed is true; 'g\.graphml' says the contrary"):
        model.load(problem_with(tmp_path, data, directed=True))
    with pytest.raises(InputError, match="network has a graph of 4 nodes; there are 3 sensors"):
        model.load(problem_with(tmp_path, data.replace(b"</graph>", b'<node id="d"/></graph>')))
    with pytest.raises(InputError, match=r"network\.graphml names 'none\.graphml', which does not exist"):
        model.load(problem_with(tmp_path, data, graphml="none.graphml"))


def test_graphml_numbers_its_nodes_as_the_sensors_are_numbered(tmp_path):
    own = model.load(problem_with(tmp_path, graphml(networkx.DiGraph([(2, 1), (0, 2)]), tmp_path)))
    assert own.links.tolist() == [[0, 2], [2, 1]]
    assert own.names is None


PATH = b'<edge source="a" target="b"/><edge source="b" target="c"/>'
LINES, ARROWS = [[0, 1], [1, 2]], HEAD.replace(b"undirected", b"directed")


@pytest.mark.parametrize(
    "data",
    [
        b'<graphml><graph edgedefault="undirected">' + NODES + PATH + TAIL,
        HEAD.replace(b"/xmlns", b"/xmlns/graphml") + NODES + PATH + TAIL,
        (HEAD + NODES + PATH + TAIL).replace(b"<", b"<g:").replace(b"<g:/", b"</g:").replace(b"xmlns=", b"xmlns:g="),
        HEAD.replace(b"<graph ", b'<key id="w" for="edge" attr.name="stairs" attr.type="boolean"/><graph ')
        + NODES
        + PATH.replace(b"/>", b'><data key="w"> true </data></edge>', 1)
        + TAIL,
        HEAD + NODES.replace(b"/>", b'><data key="none">1</data><port name="p"/></node>') + PATH + TAIL,
        HEAD.replace(b"undirected", b"sideways") + NODES + PATH + TAIL,
        ARROWS + NODES + PATH.replace(b"/>", b' directed="false"/>') + TAIL,
        b'<?xml version="1.0" encoding="UTF-16"?>'.decode().encode("utf-16")
        + (HEAD + NODES + PATH + TAIL).decode().encode("utf-16-le"),
    ],
)
def test_graphml_of_all_kinds(tmp_path, data):
    own = model.load(problem_with(tmp_path, data))
    assert own.links.tolist() == LINES
    assert not own.directed
    assert own.names == ("a", "b", "c")


def test_arrows_of_a_drawing_give_way_to_the_problem(tmp_path):
    data = ARROWS + NODES + PATH + TAIL
    own = model.load(problem_with(tmp_path, data, directed=False))
    assert not own.directed
    assert (own.adjacency != own.adjacency.T).nnz == 0
    assert own.links.tolist() == LINES
    assert model.load(problem_with(tmp_path, data)).directed


def test_a_line_without_an_arrow_among_arrows_works_both_ways(tmp_path):
    own = model.load(problem_with(tmp_path, ARROWS + NODES + PATH.replace(b"/>", b' directed="false"/>', 1) + TAIL))
    assert own.directed
    assert own.links.tolist() == [[0, 1], [1, 0], [1, 2]]


def test_labels_and_places_of_an_editor(tmp_path):
    def shape(label: str, x: int) -> bytes:
        return (
            f'<data key="d6"><y:ShapeNode><y:Geometry x="{x}" y="2.5"/><y:NodeLabel fontSize="12"> {label}'
            "<y:LabelModel>not this</y:LabelModel></y:NodeLabel></y:ShapeNode></data></node>"
        ).encode()

    head = HEAD.replace(b"<graph ", b'<key for="node" id="d6" yfiles.type="nodegraphics"/><graph ').replace(
        b"<graphml ", b'<graphml xmlns:y="http://www.yworks.com/xml/graphml" '
    )
    nodes = [NODES.replace(b"/>", b">").split(b"<node")[k + 1] for k in range(3)]

    def drawing(*labels: str) -> bytes:
        drawn = [b"<node" + node + shape(label, k) for k, (node, label) in enumerate(zip(nodes, labels, strict=True))]
        return head + b"".join(drawn) + PATH + TAIL

    own = model.load(problem_with(tmp_path, drawing("north", "east\n side", "south")))
    assert own.names == ("north", "east side", "south")
    assert own.positions is not None
    assert own.positions.tolist() == [[0.0, 2.5], [1.0, 2.5], [2.0, 2.5]]
    alike = model.load(problem_with(tmp_path, drawing("pump", "pump", "valve")))
    assert alike.names == ("a", "b", "c")


def test_names_must_tell_nodes_apart():
    with pytest.raises(InputError, match=r"network\.names\[2\] is 'a', which names\[0\] is already"):
        network(edges=[], names=["a", "b", "a"])


def test_a_long_name_in_graphml_is_cut_short(tmp_path):
    data = HEAD + NODES + b'<edge source="a" target="' + b"q" * 9999 + b'"/>' + TAIL
    with pytest.raises(InputError, match="has an edge to the node 'qqq") as caught:
        model.load(problem_with(tmp_path, data))
    assert len(str(caught.value)) < 300
