"""A table as arrays: NumPy archives with everything that is deployed, and Parquet with the rows."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np

from tolnet.design.export.deployment import Deployment
from tolnet.design.export.record import Limits, TableRecord, plain
from tolnet.model import ToleranceTable


def write_npz(
    table: ToleranceTable,
    file: BinaryIO,
    *,
    limits: Limits | None = None,
    data: Mapping[str, Any] | None = None,
    deployment: Deployment | None = None,
) -> None:
    """Everything as arrays without pickle: the keys of the JSON document, joined by `_` where they are nested.

    Per node: `nodes_tolerance` and so on (N,); `nodes_P`, `nodes_V` (N, n, n). Gains and weights are packed as in
    `Deployment`: `neighbour_offsets` (N + 1,), `neighbours` and `weights` (L,), `gain_offsets` (L + 1,) and
    `gains` (M, n), whose rows are the columns of G_k. `deployment` stands for the table's own.
    """
    record = TableRecord.of(table, limits, data)
    deployment = Deployment.of(table) if deployment is None else deployment
    limits_of_centre = {f"central_limits_{key}": value for key, value in (record.central_limits or {}).items()}
    heading = record.heading()
    problem = heading.pop("problem")
    arrays: dict[str, Any] = {
        **heading,
        "tolerance": record.tolerance,
        "problem_name": problem["name"],
        "problem_sha256": problem["sha256"] or "",
        **{f"data_{key}": value for key, value in (record.data or {}).items()},
        **{f"central_{key}": value for key, value in record.central.items()},
        **limits_of_centre,
        "central_P": table.central.P,
        "central_V": table.central.V,
        **{f"nodes_{key}": column for key, column in record.columns.items()},
        "nodes_P": table.local.P,
        "nodes_V": table.local.V,
        "neighbour_offsets": deployment.offsets,
        "neighbours": deployment.neighbours,
        "weights": deployment.weights,
        "gain_offsets": deployment.columns,
        "gains": deployment.gains,
    }
    np.savez(file, allow_pickle=False, **arrays)


def write_parquet(record: TableRecord, file: BinaryIO) -> None:
    """One row a node; the heading and the centre, as JSON, in the schema's metadata under `tolnet`."""
    import pyarrow
    import pyarrow.parquet

    columns = {
        key: column if column.dtype.kind in "if" else column.tolist() for key, column in record.columns.items()
    }
    central = plain({**record.central, "limits": record.central_limits or {}})
    heading = {**record.heading(), "data": plain(record.data), "central": central}
    metadata = {"tolnet": json.dumps(heading, allow_nan=False)}
    pyarrow.parquet.write_table(pyarrow.table(columns, metadata=metadata), file)
