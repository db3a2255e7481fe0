"""GraphML files: nodes, links, and what editors write of where the nodes are and what they are called.

Read here rather than by networkx, which stops at files without a namespace and at attributes that nobody needs, and
which takes a kilobyte a node. Attributes that are not among `PLACES` and `NAMES` are passed over.
Source: U. Brandes et al., GraphML Primer, http://graphml.graphdrawing.org/primer/graphml-primer.html.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any
from xml.parsers import expat

from tolnet.model._checks import shown
from tolnet.model.errors import InputError

NAMES = ("name", "label")
PLACES = ("x", "y", "longitude", "latitude")


@dataclass(frozen=True)
class DrawnGraph:
    """A graph as a file has it, with those methods of networkx graphs that a network asks for."""

    directed: bool
    nodes: dict[str, dict[str, str]]
    """The attributes of each node that are read."""
    links: list[tuple[str, str]]
    """[from, to]; both ways where a link works both ways among others that do not."""
    count: int
    """How many nodes the file has, of which only as many are kept as were asked for."""

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[str]:
        return iter(self.nodes)

    def is_directed(self) -> bool:
        """Whether links work one way only."""
        return self.directed

    def edges(self) -> list[tuple[str, str]]:
        """The links."""
        return self.links

    def without_arrows(self) -> DrawnGraph:
        """The same lines, each working both ways."""
        return replace(self, directed=False)


def read_graphml(data: bytes, most: int | None = None) -> DrawnGraph:
    """The graph of a GraphML file, with or without the namespace of GraphML.

    Of more than `most` nodes the rest, and all links, are only counted. Raises InputError for what is no GraphML, for
    more than one graph, graphs within nodes, hyperedges and entities, for a graph without nodes, for a node that is
    there twice, and for an edge to none.
    """
    reader = _Reader(most)
    try:
        reader.parser.Parse(data, True)
    except InputError:
        raise
    except (expat.ExpatError, LookupError, ValueError) as error:  # also an encoding that Python does not know
        raise InputError(f"is no GraphML: {str(error)[:300]}") from None
    return reader.graph()


@dataclass
class _Reader:
    """What has been seen of a file so far; its methods are called by the parser as it goes."""

    most: int | None
    path: list[str] = field(default_factory=list)
    """The open elements: bare names of GraphML's own, and of those of editors."""
    keys: dict[str, str] = field(default_factory=dict)
    """The attribute that each key of nodes stands for, where it is read."""
    nodes: dict[str, dict[str, str]] = field(default_factory=dict)
    edges: list[tuple[str, str, bool]] = field(default_factory=list)
    count: int = 0
    graphs: int = 0
    directed: bool = False
    own: str = ""
    node: dict[str, str] | None = None
    attribute: str | None = None
    text: str = ""

    def __post_init__(self) -> None:
        self.parser = expat.ParserCreate(namespace_separator=" ")
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self.opened
        self.parser.EndElementHandler = self.closed
        self.parser.CharacterDataHandler = self.said
        self.parser.EntityDeclHandler = _refuse_entities

    def opened(self, full: str, attributes: dict[str, str]) -> None:
        self.taken()
        space, _, name = full.rpartition(" ")
        if not self.path:
            if name != "graphml":
                raise InputError(f"is no GraphML: its outermost element is {shown(name)}")
            self.own = space
        inside = self.path[-1] if self.path else ""
        self.path.append(name if space == self.own else f"{name} of an editor")
        if space != self.own:
            self.drawn(name, attributes)
        elif name == "key":
            self.declared(attributes)
        elif name == "graph":
            self.begun(attributes, inside)
        elif name == "node" and inside == "graph":
            self.found(attributes.get("id"))
        elif name == "edge" and inside == "graph":
            self.joined(attributes)
        elif name == "hyperedge":
            raise InputError("has a hyperedge, a link of more than two nodes; links of two were expected")
        elif name == "data" and inside == "node":
            self.attribute = self.keys.get(attributes.get("key", ""))

    def closed(self, _: str) -> None:
        self.taken()
        if self.path.pop() == "node":
            self.node = None

    def taken(self) -> None:
        """Keep the text of an attribute, which ends where an element does or another begins."""
        if self.node is not None and self.attribute is not None and (said := " ".join((self.text or "").split())):
            self.node.setdefault(self.attribute, said)
        self.attribute, self.text = None, ""

    def said(self, text: str) -> None:
        if self.attribute is not None:
            self.text += text

    def declared(self, attributes: dict[str, str]) -> None:
        """A key: which attribute it stands for. A name is text; places may be text that spells numbers."""
        name, kind = attributes.get("attr.name", ""), attributes.get("attr.type", "string")
        wanted = name.lower() in PLACES or (name in NAMES and kind == "string")
        if wanted and attributes.get("for", "all") in ("node", "all"):
            self.keys[attributes.get("id", "")] = name.lower()

    def begun(self, attributes: dict[str, str], inside: str) -> None:
        """A graph: the only one, and not within a node."""
        if inside != "graphml":
            raise InputError("has a graph within a node, as editors write groups; ungroup them")
        self.graphs += 1
        if self.graphs > 1:
            raise InputError("has more than one graph; one was expected")
        self.directed = attributes.get("edgedefault") == "directed"

    def found(self, name: str | None) -> None:
        """A node, which is kept unless there are too many already."""
        if name is None:
            raise InputError("has a node without id")
        self.count += 1
        if self.too_many:
            self.edges.clear()
            return
        if name in self.nodes:
            raise InputError(f"has the node {shown(name)} twice")
        self.node = self.nodes[name] = {}

    def joined(self, attributes: dict[str, str]) -> None:
        """An edge, which may say of itself whether it works one way."""
        ends = attributes.get("source"), attributes.get("target")
        if ends[0] is None or ends[1] is None:
            raise InputError("has an edge without source or target")
        one_way = {"true": True, "false": False}.get(attributes.get("directed", ""), self.directed)
        if not self.too_many:
            self.edges.append((ends[0], ends[1], one_way))

    def drawn(self, name: str, attributes: dict[str, str]) -> None:
        """What an editor adds to a node: its place, and a label."""
        if self.node is None:
            return
        if name == "Geometry":
            self.node.update((axis, attributes[axis]) for axis in ("x", "y") if axis in attributes)
        elif name == "NodeLabel" and "label" not in self.node:
            self.attribute = "label"

    @property
    def too_many(self) -> bool:
        """Whether there are more nodes than were asked for."""
        return self.most is not None and self.count > self.most

    def graph(self) -> DrawnGraph:
        """Everything, held against itself."""
        if not self.graphs:
            raise InputError("is no GraphML: it has no graph")
        if not self.count:
            raise InputError("has no nodes")
        for source, target, _ in self.edges:
            for end in (source, target):
                if end not in self.nodes:
                    raise InputError(f"has an edge to the node {shown(end)}, which it does not have")
        directed = any(one_way for *_, one_way in self.edges) if self.edges else self.directed
        links = [(source, target) for source, target, _ in self.edges]
        if directed:
            links += [(target, source) for source, target, one_way in self.edges if not one_way]
        return DrawnGraph(directed, self.nodes, links, self.count)


def _refuse_entities(*_: Any) -> None:
    raise InputError("declares entities, which are not read")
