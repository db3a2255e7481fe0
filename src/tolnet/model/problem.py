"""The problem file, version 1, as pydantic models: its keys and their types.

Only the form is judged here; whether matrices fit each other is for `SensorNetwork` to say.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag
from pydantic.json_schema import GenerateJsonSchema

from tolnet.model.ambiguity import Convention
from tolnet.model.channels import ChannelNoise, Fading, Noise
from tolnet.model.fusion import FUSION_RULES
from tolnet.model.graph import DIFFUSION_RULES

SCHEMA = "tolnet.problem/1"


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, arbitrary_types_allowed=False)


class ArrayReference(_Table):
    """An array kept in the side archive that the top-level key `arrays` names."""

    array: str = Field(description="name of an array in the archive")


class TripleReference(_Table):
    """A sparse matrix kept in the side archive, one row `l, k, value` for each entry."""

    triples: str = Field(description="name of an M x 3 array in the archive")


def _kind(value: Any) -> str:
    """Which form of a matrix is meant: a table refers to the archive, everything else is to be a list."""
    if isinstance(value, dict):
        return "*triples*" if "triples" in value else "*array*"
    return "*list*"


def _kind_over_time(value: Any) -> str:
    """The same for what may be periodic: numbers and matrices, or lists of them, one an instant."""
    if isinstance(value, int | float):
        return "*number*"
    if isinstance(value, list) and value and not isinstance(value[0], list):
        return "*numbers*"
    periodic = isinstance(value, list) and value and value[0] and isinstance(value[0][0], list)
    return "*periods*" if periodic else _kind(value)


def _kind_of_matrix(value: Any) -> str:
    kind = _kind_over_time(value)
    return kind if kind in ("*periods*", "*array*") else "*list*"


def _kind_of_number(value: Any) -> str:
    return "*numbers*" if isinstance(value, list) else "*array*" if isinstance(value, dict) else "*number*"


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Index = Annotated[int, Field(strict=True, ge=0, le=2**53)]
_Reference = Annotated[ArrayReference, Tag("*array*")]
Vector = Annotated[Annotated[list[Number], Tag("*list*")] | _Reference, Discriminator(_kind)]
Matrix = Annotated[Annotated[list[list[Number]], Tag("*list*")] | _Reference, Discriminator(_kind)]
_Matrices = Annotated[
    list[Annotated[list[Annotated[list[Number], Field(min_length=1)]], Field(min_length=1)]],
    Field(min_length=1),
    Tag("*periods*"),
]
PeriodicMatrix = Annotated[
    Annotated[list[list[Number]], Tag("*list*")] | _Matrices | _Reference, Discriminator(_kind_of_matrix)
]
"""A matrix, or a list of one period of it."""
_Mean = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=1)]
_Size = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
_Sizes = Annotated[list[_Size], Field(min_length=1), Tag("*numbers*")]
PeriodicMean = Annotated[
    Annotated[_Mean, Tag("*number*")] | Annotated[list[_Mean], Field(min_length=1), Tag("*numbers*")] | _Reference,
    Discriminator(_kind_of_number),
]
PeriodicVariance = Annotated[Annotated[_Size, Tag("*number*")] | _Sizes | _Reference, Discriminator(_kind_of_number)]
Bound = Annotated[
    Annotated[_Size, Tag("*number*")]
    | _Sizes
    | Annotated[list[list[Number]], Tag("*list*")]
    | _Matrices
    | _Reference,
    Discriminator(_kind_over_time),
]
"""A covariance: a number s, which means s I, or a matrix; or a list of one period of it."""
Count = Annotated[int, Field(strict=True, ge=1, le=2**53)]
Labels = Annotated[Annotated[list[str], Tag("*list*")] | _Reference, Discriminator(_kind)]
Weights = Annotated[
    Annotated[list[list[Number]], Tag("*list*")] | _Reference | Annotated[TripleReference, Tag("*triples*")],
    Discriminator(_kind),
]
Edges = Annotated[
    Annotated[list[Annotated[list[Index], Field(min_length=2, max_length=2)]], Tag("*list*")] | _Reference,
    Discriminator(_kind),
]


def _one_of(*keys: str) -> dict[str, Any]:
    """What JSON Schema says for `exactly one of these keys`."""
    return {"oneOf": [{"required": [key]} for key in keys]}


def _at_most_one_of(*keys: str) -> dict[str, Any]:
    return {"not": {"required": list(keys)}}


class Plant(_Table):
    """x+ = A x + B w + r, w ~ N(0, I)."""

    model_config = ConfigDict(json_schema_extra=_one_of("B", "Q"))

    A: PeriodicMatrix = Field(description="state matrix, n x n")
    B: PeriodicMatrix | None = Field(None, description="factor of the process noise, n x m; exactly one of B and Q")
    Q: PeriodicMatrix | None = Field(None, description="covariance of the process noise, n x n, Q = B B'")
    input: Vector | None = Field(None, description="known constant input r, n numbers")
    initial_mean: Vector | None = Field(None, description="mean of the first state, n numbers; 0 if left out")
    initial_covariance: Matrix | None = Field(None, description="its covariance, n x n; I if left out")
    F: PeriodicMatrix | None = Field(None, description="matrix of the multiplicative noise, n x n; 0 if left out")
    multiplicative_variance: PeriodicVariance | None = Field(
        None, description="bound mu on the variance of the multiplicative noise; 0 if left out"
    )
    initial_second_moment: Matrix | None = Field(
        None, description="bound on E x0 x0', n x n; that of the initial mean and covariance if left out"
    )
    states: list[str] | None = Field(None, description="labels of the states, n texts")
    dt: Number | None = Field(None, gt=0, description="sampling time in seconds; nothing is computed from it")


class Network(_Table):
    """Who hears whom. Every node hears itself."""

    model_config = ConfigDict(
        json_schema_extra={
            "anyOf": [{"required": ["nodes"]}, {"required": ["graphml"]}],
            **_at_most_one_of("edges", "graphml"),
        }
    )

    nodes: Index | None = Field(None, ge=1, description="number of nodes; may be left out beside graphml")
    edges: Edges | None = Field(None, description="links as pairs of node indices from 0; [from, to] where directed")
    graphml: str | None = Field(None, description="path of a GraphML file, from the problem file's folder")
    directed: bool | None = Field(None, description="whether links work one way only; false if left out")
    positions: Matrix | None = Field(None, description="a point for each node, N x 2 or N x 3, for maps")
    names: Labels | None = Field(None, description="names of the nodes, N texts")


class Sensor(_Table):
    """y = C x + D v of one node, v ~ N(0, I)."""

    model_config = ConfigDict(
        json_schema_extra={
            "anyOf": [{"required": ["R"]}, {"required": ["D"]}, {"properties": {"C": {"const": []}}}],
            **_at_most_one_of("R", "D"),
        }
    )

    C: PeriodicMatrix = Field(description="observation matrix, p x n; [] for a relay without a sensor")
    R: PeriodicMatrix | None = Field(
        None, description="covariance of the measurement noise, p x p; exactly one of R and D"
    )
    D: PeriodicMatrix | None = Field(None, description="factor of the measurement noise, p x p, R = D D'")
    fading_mean: PeriodicMean | None = Field(None, description="mean tau of the fading factor; 1 if left out")
    fading_variance: PeriodicVariance | None = Field(
        None, description="bound phi on the variance of the fading factor; 0 if left out"
    )
    interval: Count | None = Field(None, description="how often this node may solve the fusion problem")
    initial_covariance: Matrix | None = Field(
        None, description="covariance of this node's first estimate, n x n; the plant's if left out"
    )


class AmbiguityTable(_Table):
    """How wrong the model may be: a ball around its transition density."""

    tolerance: Number = Field(ge=0, description="radius c of the ball; 0 gives the Kalman filter")
    convention: Convention = Field("gamma", description="scale of the tolerance: gamma = 2 nats")
    tau: Number = Field(0.0, ge=0, le=1, description="member of the tau-divergence family; 0 is Kullback-Leibler")


class Diffusion(_Table):
    """How a node mixes the estimates that it hears: x_k = sum_l w[l][k] psi_l."""

    model_config = ConfigDict(json_schema_extra=_at_most_one_of("rule", "weights"))

    rule: str | None = Field(
        None, description="rule that gives the weights", json_schema_extra={"enum": list(DIFFUSION_RULES)}
    )
    weights: Weights | None = Field(
        None, description="W, N x N: [l][k] weighs neighbour l at node k, columns sum to 1"
    )


class Link(_Table):
    """A link whose channel differs from the others."""

    model_config = ConfigDict(
        json_schema_extra={"anyOf": [{"required": ["estimate_noise"]}, {"required": ["matrix_noise"]}]}
    )

    from_: Index = Field(alias="from", description="the node that sends")
    to: Index = Field(description="the node that receives")
    estimate_noise: Bound | None = Field(None, description="bound on the covariance of the noise on estimates")
    matrix_noise: Bound | None = Field(None, description="two-sided bound on the noise on matrices")


class Channel(_Table):
    """How much the links corrupt what nodes send."""

    estimate_noise: Bound | None = Field(
        None, description="bound on the covariance of the noise on a sent estimate; s means s I; 0 if left out"
    )
    matrix_noise: Bound | None = Field(
        None, description="bound D on the noise on a sent matrix, -D <= noise <= D; d means d I; 0 if left out"
    )
    links: list[Link] | None = Field(None, description="exceptions")


class Fusion(_Table):
    """How a node weighs the pairs that it receives."""

    model_config = ConfigDict(json_schema_extra=_at_most_one_of("rule", "weights"))

    rule: str | None = Field(
        None, description="rule that gives the weights", json_schema_extra={"enum": list(FUSION_RULES)}
    )
    weights: Weights | None = Field(
        None, description="a_ij, N x N: [i][j] weighs neighbour j at node i, rows sum to 1"
    )
    window: Count | None = Field(None, description="pairs kept of each neighbour, the current one included; 1")
    interval: Count | None = Field(None, description="how often a node may solve the fusion problem; 1")


class SimulatedChannel(_Table):
    """The noise that is drawn on the channels."""

    kind: ChannelNoise | None = Field(None, description="law of the noise; uniform if left out")
    half_width: _Size | None = Field(None, description="its half width; the largest within the bounds if left out")


class Simulation(_Table):
    """What really happens in a simulation; the bounds above are what the filters know."""

    fading: Fading | None = Field(None, description="law of the fading factors; uniform if left out")
    channel: SimulatedChannel | None = Field(None, description="law of the noise on the channels")
    noise: Noise | None = Field(None, description="law of the process and measurement noise; gaussian")


class Problem(_Table):
    """A plant, the sensors that watch it, and the graph over which they talk."""

    model_config = ConfigDict(
        title=SCHEMA, json_schema_extra={"anyOf": [{"required": ["sensors"]}, {"required": ["arrays"]}]}
    )

    schema_: Literal["tolnet.problem/1"] = Field(alias="schema", description="version of this format")
    name: str = Field("", description="name of the problem")
    description: str = Field("", description="what it is about")
    arrays: str | None = Field(None, description="path of the side archive (.npz), from the problem file's folder")
    plant: Plant = Field(description="the table [plant]")
    network: Network = Field(description="the table [network]")
    sensors: list[Sensor] | None = Field(None, description="one table [[sensors]] a node, in node order")
    ambiguity: AmbiguityTable | None = Field(None, description="the table [ambiguity]")
    diffusion: Diffusion | None = Field(None, description="the table [diffusion]; relative-degree if left out")
    channel: Channel | None = Field(None, description="the table [channel]; exact channels if left out")
    fusion: Fusion | None = Field(None, description="the table [fusion]; uniform weights if left out")
    simulation: Simulation | None = Field(None, description="the table [simulation]")


TABLES: dict[str, type[BaseModel]] = {
    "plant": Plant,
    "network": Network,
    "sensors": Sensor,
    "ambiguity": AmbiguityTable,
    "diffusion": Diffusion,
    "channel": Channel,
    "fusion": Fusion,
    "simulation": Simulation,
}
"""The tables by their names in a file."""


class _SchemaOfToml(GenerateJsonSchema):
    """Without null, which TOML does not have: a key that may be left out has no other way to say nothing."""

    def nullable_schema(self, schema: Any) -> dict[str, Any]:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> dict[str, Any]:
        described = super().default_schema(schema)
        if described.get("default", 0) is None:
            del described["default"]
        return described

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def problem_schema() -> dict[str, Any]:
    """The JSON Schema of the problem file, generated from the models above."""
    own = Problem.model_json_schema(by_alias=True, schema_generator=_SchemaOfToml)
    return {"$schema": _SchemaOfToml.schema_dialect, **own}
