"""Reading problem files that are about corrupted channels, and telling which files are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tolnet.model.channels import SimulationModel
from tolnet.model.corrupted import CorruptedNetwork
from tolnet.model.errors import Complaint, InputError
from tolnet.model.fusion import FUSION_RULES
from tolnet.model.network import SensorNetwork
from tolnet.model.problem_text import mapping_of, read_problem
from tolnet.model.reading import PACKED_CHANNELS, Reader
from tolnet.model.sensors import count
from tolnet.model.time_varying import depth

PLANT_KEYS = ("F", "multiplicative_variance", "initial_second_moment")
SENSOR_KEYS = ("fading_mean", "fading_variance", "interval", "initial_covariance")
TABLES = ("channel", "fusion", "simulation")


def load_problem(path: str | Path) -> SensorNetwork | CorruptedNetwork:
    """The network that a problem file describes: a CorruptedNetwork where the file has any key of corrupted channels.

    Raises InputError as `load` does.
    """
    reader = _reader(path)
    return reader.corrupted() if reader.about_channels else reader.network()


def load_corrupted(path: str | Path) -> CorruptedNetwork:
    """The network with corrupted channels that a problem file describes; what the file leaves out is exact.

    Tables that are about something else ([ambiguity], [diffusion]) are judged for their form and left alone.
    Raises InputError as `load` does, and where A is singular, Q is not positive definite or the graph is not strongly
    connected.
    """
    return _reader(path).corrupted()


def validate(path: str | Path) -> list[Complaint]:
    """Every complaint about a problem file; none where `load_problem` succeeds."""
    try:
        load_problem(path)
    except InputError as error:
        return list(error.complaints)
    return []


def parse_corrupted(mapping: Mapping[str, Any], folder: str | Path = ".") -> CorruptedNetwork:
    """The network with corrupted channels that the content of a problem file describes, as `parse` does."""
    return CorruptedReader(mapping, Path(folder)).corrupted()


def parse_corrupted_text(data: bytes, source: str) -> CorruptedNetwork:
    """`load_corrupted` for a problem file whose bytes are at hand and that refers to no other file."""
    return CorruptedReader(mapping_of(data, source), Path(), data, source).corrupted()


def _reader(path: str | Path) -> CorruptedReader:
    data = read_problem(path, CorruptedReader.judge_content)
    return CorruptedReader(mapping_of(data, str(path)), Path(path).parent, data, str(path))


class CorruptedReader(Reader):
    """A problem file on its way to a network with corrupted channels."""

    @property
    def about_channels(self) -> bool:
        """Whether the file has any key of corrupted channels, or a matrix that is periodic."""
        self.open_archive()
        plant, sensors = self.table("plant"), self.sensor_tables() or []
        if any(key in self.content for key in TABLES) or any(key in plant for key in PLANT_KEYS):
            return True
        if any(key in table for key in SENSOR_KEYS for table in sensors):
            return True
        return any(name in self.archive for name in PACKED_CHANNELS) or bool(self.periodic())

    def periodic(self) -> list[str]:
        """The keys of the matrices that are periodic."""
        plant = self.table("plant")
        keys = [f"plant.{key}" for key in ("A", "B", "Q") if depth(self.peek(plant.get(key))) == 3]
        for k, table in enumerate(self.sensor_tables() or []):
            keys += [f"sensors[{k}].{key}" for key in ("C", "R", "D") if depth(self.peek(table.get(key))) == 3]
        constant = 2 if "rows" in self.archive else 3
        if self.sensor_tables() is None and "C" in self.archive and self.archive["C"].ndim > constant:
            keys.append("sensors.C")
        return keys

    def peek(self, value: Any) -> Any:
        """A value, or the array that it refers to, without a complaint where there is none."""
        return self.archive.get(str(value.get("array"))) if isinstance(value, dict) else value

    @classmethod
    def judge_content(cls, content: dict[str, Any], folder: Path) -> None:
        """Raise everything that is wrong with the content of a problem file."""
        reader = cls(content, folder)
        reader.corrupted() if reader.about_channels else reader.network()

    def corrupted(self) -> CorruptedNetwork:
        """Build the network, or raise with everything that is wrong."""
        return self.build(CorruptedNetwork, self.corrupted_arguments)

    def corrupted_arguments(self) -> dict[str, Any]:
        """What the constructor takes."""
        arguments = self.plant() | self.sensors() | self.start() | self.fading()
        N = count(arguments["C"], arguments.get("rows"))
        arguments |= (
            self.graph(N) | self.channel() | self.fusion(N) | self.texts() | {"simulation": self.simulation()}
        )
        self.ambiguity()
        if arguments.pop("input") is not None and self.about_channels:
            self.blame("plant.input", "is not part of the model with corrupted channels; leave it out")
        return arguments

    def start(self) -> dict[str, Any]:
        """The multiplicative noise, and what is known of the first state: P_0 of each node, or one for all."""
        table = self.table("plant")
        values = {key: self.resolved(table.get(key), f"plant.{key}") for key in ("F", "initial_second_moment")}
        mu = self.resolved(table.get("multiplicative_variance", 0.0), "plant.multiplicative_variance")
        one = self.resolved(table.get("initial_covariance"), "plant.initial_covariance")
        each = self.each_sensor("initial_covariance", None)
        if isinstance(each, list):
            each = [one if item is None else item for item in each]
        start = one if each is None else each
        return {**values, "multiplicative_variance": mu, "initial_covariance": start}

    def fading(self) -> dict[str, Any]:
        """tau, phi and the interval of every node."""
        interval = self.plain("fusion", "interval", 1) or 1
        defaults = {"fading_mean": 1.0, "fading_variance": 0.0, "interval": interval}
        found = {key: self.each_sensor(key, default) for key, default in defaults.items()}
        if isinstance(
            found["fading_variance"], list
        ):  # a variance is judged by its mean, where that has the right form
            means = [self.told(f"sensors[{k}].fading_mean") for k in range(len(found["fading_variance"]))]
            found["fading_variance"] = [
                0.0 if bad else phi for bad, phi in zip(means, found["fading_variance"], strict=True)
            ]
        return {key: defaults[key] if found[key] is None else found[key] for key in defaults}

    def each_sensor(self, key: str, default: Any) -> Any:
        """One value a node from the tables, or the array of the archive; None where no node says anything."""
        tables = self.sensor_tables()
        if tables is None:
            return self.packed("P0" if key == "initial_covariance" else key)
        if not any(key in table for table in tables):
            return None
        places = [(table.get(key), f"sensors[{k}].{key}") for k, table in enumerate(tables)]
        values = [None if self.told(place) else self.resolved(value, place) for value, place in places]
        return [default if value is None else value for value in values]

    def channel(self) -> dict[str, Any]:
        """Bounds of all links, and exceptions."""
        table = self.table("channel")
        names = ("estimate_noise", "matrix_noise")
        bounds = {name: self.resolved(table.get(name, 0.0), f"channel.{name}") for name in names}
        links = []
        for index, link in enumerate(self.plain("channel", "links", ()) or ()):
            where = f"channel.links[{index}]"
            own = {name: self.resolved(link[name], f"{where}.{name}") for name in names if name in link}
            links.append({**link, **own})
        return {**bounds, "links": links}

    def fusion(self, N: int | None) -> dict[str, Any]:
        """The rule, or a_ij itself; and the window."""
        table = self.table("fusion")
        window = self.plain("fusion", "window", 1) or 1
        if "weights" not in table:
            return {"fusion": self.plain("fusion", "rule", FUSION_RULES[0]), "window": window}
        if "rule" in table:
            self.blame("fusion", "has both rule and weights; exactly one was expected")
        return {"fusion": self.weights(table["weights"], N, "fusion.weights"), "window": window}

    def simulation(self) -> SimulationModel | None:
        """What really happens, where the file says it and its form is right."""
        table = self.table("simulation")
        if not table or any(old.partition(".")[0] == "simulation" for old in self.blamed):
            return None
        channel = table.get("channel") or {}
        given = {key: table[key] for key in ("fading", "noise") if key in table}
        if "kind" in channel:
            given["channel"] = channel["kind"]
        try:
            width = channel.get("half_width")
            return SimulationModel(**given, half_width=None if width is None else float(width))
        except InputError as error:
            for complaint in error.complaints:
                self.blame(complaint.key, complaint.message)
            return None
