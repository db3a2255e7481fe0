"""Reading problem files: everything is judged before anything is computed, and every complaint comes at once."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from numpy import ndarray

from tolnet.model._checks import Complaints, nearest, shown, there_are
from tolnet.model.ambiguity import Ambiguity
from tolnet.model.archive import read_archive
from tolnet.model.bounded_reading import LARGEST_ARCHIVE, LARGEST_TEXT, read_whole
from tolnet.model.errors import Complaint, InputError
from tolnet.model.graph import DIFFUSION_RULES, weights_of_triples
from tolnet.model.network import SensorNetwork
from tolnet.model.problem_text import mapping_of, read_problem
from tolnet.model.sensors import count

if TYPE_CHECKING:
    from tolnet.model.graphml import DrawnGraph

PACKED = ("C", "R", "D", "rows", "edges")
"""Arrays of a side archive that stand, without a reference, for the `[[sensors]]` tables and the list of links."""

PACKED_CHANNELS = ("fading_mean", "fading_variance", "interval", "P0")
"""The same for the keys of corrupted channels in those tables; P0 (N, n, n) stands for `initial_covariance`."""

_TABLES = ("plant", "network", "sensors", "ambiguity", "diffusion", "channel", "fusion", "simulation")
_ORDER = ("schema", "name", "description", "arrays", *_TABLES)

Built = TypeVar("Built")


def load(path: str | Path) -> SensorNetwork:
    """The network that a problem file (TOML, version 1) describes, with its side archive and GraphML file.

    `digest` is the SHA-256 of the bytes of the problem file followed by those of the files that it names.
    Raises InputError, which names the file and carries every complaint with its key path, for a file that is
    missing, empty, malformed, or describes no network. The format is described by problem.schema.json.
    """
    data = read_problem(path, Reader.judge_content)
    return Reader(mapping_of(data, str(path)), Path(path).parent, data, str(path)).network()


def parse(mapping: Mapping[str, Any], folder: str | Path = ".") -> SensorNetwork:
    """The network that the content of a problem file describes; paths in it start from `folder`.

    Raises InputError with every complaint. `digest` is None: there were no bytes of a file.
    """
    return Reader(mapping, Path(folder)).network()


def parse_text(data: bytes, source: str) -> SensorNetwork:
    """`load` for a problem file whose bytes are at hand and that refers to no other file."""
    return Reader(mapping_of(data, source), Path(), data, source).network()


class Reader:
    """One problem file on its way to a network.

    Form (keys and types) is judged by the pydantic models. What has the right form, and what has not, goes on to
    `SensorNetwork`, whose complaints are dropped where the form was blamed already: so each fault is told once.
    """

    def __init__(
        self, mapping: Mapping[str, Any], folder: Path, data: bytes | None = None, source: str | None = None
    ) -> None:
        from tolnet.model.form import complaints_about_form  # imported late: pydantic takes its time

        self.content, self.folder, self.source = dict(mapping), folder, source
        self.hash = None if data is None else hashlib.sha256(data)
        self.complaints = Complaints()
        self.blamed: set[str] = set()
        for key, complaint in complaints_about_form(self.content):
            self.blamed.add(key)
            self.complaints.keep(complaint)
        self.complaints.only_shapes &= not self.complaints.found
        self.archive: dict[str, ndarray] = {}
        self.opened = False
        self.used: set[str] = set(PACKED_CHANNELS)

    def blame(self, key: str, message: str, at: str | None = None) -> None:
        """Complain about a key, once; `at` points into its value."""
        self.blamed.add(key)
        self.complaints.add(key if at is None else at, message)

    def network(self) -> SensorNetwork:
        """Build the network, or raise with everything that is wrong."""
        return self.build(SensorNetwork, self.arguments)

    def arguments(self) -> dict[str, Any]:
        """What the constructor takes."""
        arguments = self.plant() | self.sensors()
        N = count(arguments["C"], arguments.get("rows"))
        return arguments | self.graph(N) | self.diffusion(N) | self.texts() | {"ambiguity": self.ambiguity()}

    @classmethod
    def judge_content(cls, content: dict[str, Any], folder: Path) -> None:
        """Raise everything that is wrong with the content of a problem file."""
        cls(content, folder).network()

    def build(self, kind: Callable[..., Built], gather: Callable[[], dict[str, Any]]) -> Built:
        """A network of that kind from the arguments gathered, or all complaints."""
        self.open_archive()
        arguments = gather()
        unused = sorted(set(self.archive) - self.used - set(_references(self.content)))
        each = (
            (
                "arrays",
                f"holds {shown(name)}, which nothing refers to; the nearest of the names read without"
                f" a reference is {nearest(name, PACKED)!r}",
            )
            for name in unused
        )
        self.complaints.add_each(each, len(unused))
        try:
            network = kind(**arguments, digest=self.hash.hexdigest() if self.hash else None)
        except InputError as error:
            new = [each for each in error.kept if not (each.key and self.told(each.key))]
            if any(each.key for each in new):
                self.complaints.extend(type(error)(new))
        else:
            if not self.complaints.found:
                return network
        self.complaints.found.sort(key=_place)
        raise self.complaints.error(self.source)

    def told(self, key: str) -> bool:
        """Whether the value at `key`, or one that holds it, was blamed before."""
        return any(key == old or key.startswith((f"{old}.", f"{old}[")) for old in self.blamed)

    def side_file(self, key: str, name: str, most: int) -> bytes | None:
        """The bytes of a file, at most so many, that the problem file names; they count for the digest."""
        try:
            data = read_whole(self.folder / name, most)
        except InputError as error:
            self.blame(key, f"names {shown(name)}, which {error}")
            return None
        if self.hash:
            self.hash.update(data)
        return data

    def open_archive(self) -> None:
        """Read the side archive. Without it nothing else can be judged, so a bad one ends the reading."""
        name = self.content.get("arrays")
        if self.opened or not isinstance(name, str):
            return
        self.opened = True
        data = self.side_file("arrays", name, LARGEST_ARCHIVE)
        if data is not None:
            try:
                self.archive = read_archive(data)
            except InputError as error:
                self.blame("arrays", f"names {shown(name)}, which {error}")
        if "arrays" in self.blamed:
            raise self.complaints.error(self.source)

    def table(self, key: str) -> dict[str, Any]:
        """A table of the file; empty where there is none."""
        value = self.content.get(key)
        return value if isinstance(value, dict) else {}

    def plain(self, table: str, key: str, default: Any = None) -> Any:
        """A value that is no array, or the default where its form is wrong."""
        path = f"{table}.{key}" if table else key
        source = self.table(table) if table else self.content
        return default if self.told(path) else source.get(key, default)

    def resolved(self, value: Any, key: str) -> Any:
        """A value, or the array of the archive that it refers to."""
        name = value.get("array", value.get("triples")) if isinstance(value, dict) else None
        if not isinstance(name, str) or self.told(key):
            return value
        if "arrays" not in self.content:
            self.blame(key, f"refers to {shown(name)}, but no archive is named (`arrays = ...`)")
            return value
        if name not in self.archive:
            hint = f"; the nearest is {nearest(name, self.archive)!r}" if self.archive else ""
            self.blame(key, f"refers to {shown(name)}, which the archive does not hold{hint}")
            return value
        self.used.add(name)
        return self.archive[name]

    def packed(self, name: str) -> ndarray | None:
        """An array of the archive that needs no reference."""
        self.used.add(name)
        return self.archive.get(name)

    def plant(self) -> dict[str, Any]:
        """A, B, Q, what is known of the input and the first state, and labels."""
        table = self.table("plant")
        arrays = ("A", "B", "Q", "input", "initial_mean", "initial_covariance")
        values = {key: self.resolved(table.get(key), f"plant.{key}") for key in arrays}
        dt = self.plain("plant", "dt")
        return values | {"states": self.plain("plant", "states"), "dt": None if dt is None else float(dt)}

    def sensor_tables(self) -> list[dict[str, Any]] | None:
        """The tables [[sensors]], if the file has them; what is no table is an empty one."""
        tables = self.content.get("sensors")
        if not isinstance(tables, list):
            return None
        return [table if isinstance(table, dict) else {} for table in tables]

    def sensors(self) -> dict[str, Any]:
        """C, R and D from the tables, one a node, or else packed in the archive."""
        tables = self.sensor_tables()
        if tables is not None:
            return {
                letter: [self.resolved(table.get(letter), f"sensors[{k}].{letter}") for k, table in enumerate(tables)]
                for letter in ("C", "R", "D")
            }
        if "C" not in self.archive and not self.told("sensors"):
            self.blame("sensors", "is missing: one table [[sensors]] a node, or C and R in an archive, were expected")
        return {key: self.packed(key) for key in ("C", "R", "D", "rows")}

    def graph(self, N: int | None) -> dict[str, Any]:
        """The links from whichever of the three places has them, and what hangs on the nodes."""
        table, graph = self.table("network"), None
        nodes, directed, graphml = (self.plain("network", key) for key in ("nodes", "directed", "graphml"))
        edges = self.resolved(table.get("edges"), "network.edges") if "edges" in table else None
        packed = self.packed("edges") if "edges" not in self.used else None
        given = {"edges": edges, "graphml": graphml, "edges in the archive": packed}
        places = [place for place, value in given.items() if value is not None]
        if len(places) > 1:
            both = "both " if len(places) == 2 else ""
            self.blame("network", f"has {both}{' and '.join(places)}; exactly one was expected")
        if graphml is not None and edges is None:
            graph = self.graphml(graphml, directed, N)
            if graph is None:
                self.blamed.add("network.edges")
                edges = graphml  # no links, as has been said
        elif edges is None:
            edges = packed
        if nodes is None and graphml is None and not self.told("network.nodes"):
            self.blame("network.nodes", "is missing: number of nodes")
        if nodes is not None and N and nodes != N:
            self.complaints.add("network.nodes", f"is {shown(nodes)}; {there_are(N, 'sensor')}", shape=True)
            self.blamed |= {"network.edges", "network.positions", "network.names", "diffusion.weights"}
        names = self.resolved(table.get("names"), "network.names")
        return {
            "adjacency": graph,
            "edges": edges,
            "directed": bool(directed),
            "positions": self.resolved(table.get("positions"), "network.positions"),
            "names": None if self.told("network.names") else names,
        }

    def graphml(self, name: str, directed: bool | None, N: int | None) -> DrawnGraph | None:
        """The graph of a GraphML file, with links as `directed` says where it says anything.

        Editors write the word `directed` into drawings of lines without arrows, so `directed = false` is taken at its
        word; but no file of lines tells which way they work, so `directed = true` contradicts it.
        """
        from tolnet.model.graphml import read_graphml

        data = self.side_file("network.graphml", name, LARGEST_TEXT)
        if data is None:
            return None
        try:
            graph = read_graphml(data, N)
        except InputError as error:
            self.blame("network.graphml", f"names {shown(name)}, which {error}")
            return None
        if directed and not graph.directed:
            self.blame("network.directed", f"is true; {shown(name)} says the contrary")
        return graph.without_arrows() if directed is False else graph

    def diffusion(self, N: int | None) -> dict[str, Any]:
        """The rule, or W itself."""
        table, key = self.table("diffusion"), "diffusion.weights"
        if "weights" not in table:
            return {"diffusion": self.plain("diffusion", "rule", DIFFUSION_RULES[0])}
        if "rule" in table:
            self.blame("diffusion", "has both rule and weights; exactly one was expected")
        return {"diffusion": self.weights(table["weights"], N, key)}

    def weights(self, value: Any, N: int | None, key: str) -> Any:
        """A matrix of weights, from the text or the archive; None where its triples are no such thing."""
        weights = self.resolved(value, key)
        if isinstance(weights, ndarray) and "triples" in value:
            weights = None if N is None else weights_of_triples(weights, N, key, self.complaints)
            if weights is None:
                self.blamed.add(key)
        return weights

    def texts(self) -> dict[str, Any]:
        """Name and description."""
        return {key: self.plain("", key, "") for key in ("name", "description")}

    def ambiguity(self) -> Ambiguity | None:
        """The ball, where the file has one and its form is right."""
        table = self.table("ambiguity")
        if not table or any(old.partition(".")[0] == "ambiguity" for old in self.blamed):
            return None
        numbers = {key: float(table[key]) for key in ("tolerance", "tau") if key in table}
        try:
            return Ambiguity(**{**table, **numbers})
        except InputError as error:
            for complaint in error.complaints:
                self.blame(complaint.key, complaint.message)
            return None


def _references(content: Any) -> Iterator[str]:
    """The names of all arrays that a file refers to, whether or not the network that is read needs them."""
    if isinstance(content, dict):
        for key, value in content.items():
            if key in ("array", "triples") and isinstance(value, str):
                yield value
            else:
                yield from _references(value)
    elif isinstance(content, list):
        for value in content:
            if isinstance(value, dict):
                yield from _references(value)


def _place(complaint: Complaint) -> int:
    """Where in the file a complaint belongs: tables in their usual order, what is unknown first."""
    top = complaint.key.partition(".")[0].partition("[")[0]
    return _ORDER.index(top) if top in _ORDER else -1
