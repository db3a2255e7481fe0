"""What every written table says, whatever its format: which problem, which tolerance, and one row a node."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy import ndarray

from tolnet import __version__
from tolnet.model import (
    Ambiguity,
    Convention,
    CorruptedNetwork,
    SensorNetwork,
    Status,
    ToleranceLimits,
    ToleranceTable,
    gamma_per,
)

SCHEMA = "tolnet.table/1"
CENTRAL = ("theta", "trace_P", "trace_V", "attraction", "status")
NODES = (
    "node",
    "degree",
    "tolerance",
    "theta",
    "trace_P",
    "trace_V",
    "spectral_radius",
    "attraction",
    "status",
)
STATUSES = (
    Status.OK,
    Status.OSCILLATES,
    Status.DIVERGES,
    Status.NO_STEADY_STATE,
    Status.UNDETECTABLE,
    Status.UNSTABILISABLE,
)
"""The words that a row of a table may carry; a C header numbers them in this order."""
LIMITS = ("fold", "attracts", "exists", "published")

Limits = tuple[ToleranceLimits, ToleranceLimits]
"""Of the centre and of the nodes, as analysis.tolerance_limits returns them."""


@dataclass(frozen=True, eq=False)
class TableRecord:
    """A table as it is written and read back: numbers without the network that they came from.

    `central` has the keys of CENTRAL; `nodes` the columns of NODES, each of length N, and `name` where the nodes have
    names; `central_limits` and `node_limits` those of LIMITS, where the limits were asked for. Tolerances and limits
    are in `convention`; NaN stands for a value that does not exist. `data` says how the tolerance was estimated,
    where it was.
    """

    problem: str
    sha256: str | None
    version: str
    convention: Convention
    tau: float
    tolerance: float
    central: Mapping[str, Any]
    nodes: Mapping[str, ndarray]
    central_limits: Mapping[str, float] | None = None
    node_limits: Mapping[str, ndarray] | None = None
    data: Mapping[str, Any] | None = None

    @classmethod
    def of(
        cls, table: ToleranceTable, limits: Limits | None = None, data: Mapping[str, Any] | None = None
    ) -> TableRecord:
        """What is written of a table, with its limits and what is known of its data where they are given."""
        network, central, local = table.network, table.central, table.local
        names = {} if network.names is None else {"name": np.array(network.names)}
        columns = {
            "node": np.arange(network.N),
            "degree": network.degree,
            "tolerance": table.tolerances,
            **{key: getattr(local, key) for key in ("theta", "trace_P", "trace_V", "spectral_radius", "attraction")},
            "status": local.status,
        }
        scale = gamma_per(table.convention)
        return cls(
            problem=network.name,
            sha256=network.digest,
            version=__version__,
            convention=table.convention,
            tau=table.tau,
            tolerance=table.tolerance,
            central={
                **{key: float(getattr(central, key)) for key in CENTRAL[:-1]},
                "status": str(central.status),
            },
            nodes={"node": columns.pop("node"), **names, **columns},
            central_limits=limits and {key: float(getattr(limits[0], key)) / scale for key in LIMITS},
            node_limits=limits and {key: getattr(limits[1], key) / scale for key in LIMITS},
            data=data,
        )

    @property
    def status(self) -> str:
        """`ok`, or the centre's status where that is not, or that of the first node that is not."""
        if self.central["status"] != Status.OK:
            return self.central["status"]
        bad = np.flatnonzero(self.nodes["status"] != Status.OK.value)
        return str(self.nodes["status"][bad[0]]) if bad.size else Status.OK.value

    def heading(self) -> dict[str, Any]:
        """The keys that open every document, in their order."""
        return {
            "schema": SCHEMA,
            "tolnet": self.version,
            "problem": {"name": self.problem, "sha256": self.sha256},
            "convention": self.convention,
            "tau": plain(self.tau),
            "tolerance": plain(self.tolerance),
            "status": self.status,
        }

    @cached_property
    def columns(self) -> dict[str, ndarray]:
        """The columns of `nodes` with those of the limits behind them, as `limits_fold` and so on."""
        limits = {f"limits_{key}": column for key, column in (self.node_limits or {}).items()}
        return {**self.nodes, **limits}

    def rows(self) -> Iterator[tuple[Any, ...]]:
        """The rows of `columns`, one a node, as Python values."""
        return zip(*(column.tolist() for column in self.columns.values()), strict=True)


def opening(
    schema: str, network: SensorNetwork | CorruptedNetwork | None, status: str, ambiguity: Ambiguity | None = None
) -> dict[str, Any]:
    """The keys that open every document; null for what does not exist. `ambiguity` takes the place of the network's.

    A table's heading has the same keys from its record, which may have been read from a file.
    """
    if ambiguity is None and isinstance(network, SensorNetwork):
        ambiguity = network.ambiguity
    return {
        "schema": schema,
        "tolnet": __version__,
        "problem": None if network is None else {"name": network.name, "sha256": network.digest},
        "convention": ambiguity and ambiguity.convention,
        "tau": ambiguity and ambiguity.tau,
        "tolerance": ambiguity and ambiguity.tolerance,
        "status": status,
    }


def plain(value: Any) -> Any:
    """A number, or arrays and mappings of numbers, as JSON says them: null for NaN, "inf" for infinity."""
    if isinstance(value, ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        if math.isfinite(value):
            return value
        return None if math.isnan(value) else ("inf" if value > 0 else "-inf")
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [plain(item) for item in value]
    return value
