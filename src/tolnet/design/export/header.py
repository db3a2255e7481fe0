"""A table as a C header: constants for the device, for C99 and C++, without a line of code to run."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Iterator
from importlib import resources

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.design.export.deployment import Deployment
from tolnet.design.export.record import SCHEMA, STATUSES, TableRecord
from tolnet.model import ToleranceTable


def table_header(table: ToleranceTable) -> Iterator[str]:
    """The header in pieces: one `struct` a node over constant arrays, all under a prefix made of the problem's name.

    A node that has no answer has NAN for every number and says why in `status`.
    """
    import jinja2

    record, deployment = TableRecord.of(table), Deployment.of(table)
    environment = jinja2.Environment(
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"double": _double, "string": _string}
    lower = f"tolnet_{re.sub(r'[^0-9a-z]+', '_', record.problem.lower()).strip('_') or 'table'}"
    source = resources.files("tolnet.design.export").joinpath("table.h.jinja").read_text(encoding="utf-8")
    return environment.from_string(source).generate(
        record=record,
        title=_comment(record.problem or "an unnamed problem"),
        sha256=record.sha256 or "none (not read from a file)",
        schema=SCHEMA,
        lower=lower,
        upper=lower.upper(),
        missing=not (table.local.exists & np.isfinite(table.tolerances)).all(),
        states=table.network.n,
        nodes=table.network.N,
        statuses=[status.value for status in STATUSES],
        neighbours=_per_node(deployment.offsets, deployment.neighbours),
        weights=_per_node(deployment.offsets, deployment.weights),
        columns=_columns(deployment),
        P=_matrices(table.local.P),
        V=_matrices(table.local.V),
        gains=_never_empty(_line(deployment.gain(k)) for k in range(table.network.N)),
        table=_nodes(record, deployment, lower, table.network.n),
    )


def _nodes(record: TableRecord, deployment: Deployment, lower: str, n: int) -> Iterator[str]:
    offsets, first = deployment.offsets.tolist(), (deployment.columns[deployment.offsets] * n).tolist()
    columns = record.nodes
    each = zip(columns["status"].tolist(), columns["tolerance"].tolist(), columns["theta"].tolist(), strict=True)
    for k, (status, tolerance, theta) in enumerate(each):
        begin, word = offsets[k], status.upper().replace("-", "_")
        pointers = (("neighbours", begin), ("columns", begin + k), ("weights", begin))
        links = ", ".join(f"{lower}_{name} + {at}" for name, at in pointers)
        matrices = f"{lower}_P + {k * n * n}, {lower}_V + {k * n * n}, {lower}_gain + {first[k]}"
        degree = offsets[k + 1] - begin
        yield (f"{{ {lower.upper()}_{word}, {degree}, {links}, {_double(tolerance)}, {_double(theta)}, {matrices} }}")


def _per_node(offsets: ndarray, values: ndarray) -> Iterator[str]:
    for begin, end in itertools.pairwise(offsets):
        yield _line(values[begin:end])


def _columns(deployment: Deployment) -> Iterator[str]:
    for begin, end in itertools.pairwise(deployment.offsets):
        yield _line(deployment.columns[begin : end + 1] - deployment.columns[begin])


def _matrices(stack: Float[ndarray, "N n n"]) -> Iterator[str]:
    return map(_line, stack)


def _never_empty(lines: Iterable[str]) -> Iterator[str]:
    """The lines that are not empty, or a zero where all are: C has no empty array."""
    found = False
    for line in filter(None, lines):
        found = True
        yield line
    if not found:
        yield "0.0"


def _line(values: ndarray) -> str:
    literal = str if values.dtype.kind == "i" else _double
    return ", ".join(map(literal, values.ravel().tolist()))


def _double(value: float) -> str:
    """A C literal that reads back as the same double: the shortest decimal that does."""
    return "NAN" if math.isnan(value) else repr(float(value))


def _string(text: str) -> str:
    """A C string literal of UTF-8 bytes, whatever the text: no trigraph, no escape runs into a following digit."""
    printable = set(range(0x20, 0x7F)) - set(b'"\\?')
    return '"' + "".join(chr(b) if b in printable else f"\\{b:03o}" for b in text.encode("utf-8", "replace")) + '"'


def _comment(text: str) -> str:
    """Text that can neither end a comment nor continue a line."""
    return re.sub(r"[^ -~]|[*/?\\]", "_", text)
