"""The tolerance from recorded data: what `--data` reads, and what is said of it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tolnet.cli.console import Console
from tolnet.cli.options import nearest

if TYPE_CHECKING:
    from numpy import ndarray

    from tolnet.analysis.data import Record
    from tolnet.model import Ambiguity, Complaint, Convention, SensorNetwork
    from tolnet.model.estimate import DataMethod

ARRAYS = {
    "x": "the states x_0 to x_T, one a row",
    "y": "the outputs y_0 to y_{T-1} of all nodes, one a row",
    "u": "the known inputs r_0 to r_{T-1}, one a row",
}
"""What an archive of recorded data holds; `u` may be missing."""


def estimate_tolerance(
    network: SensorNetwork,
    path: Path,
    method: DataMethod,
    convention: Convention | None,
    tau: float | None,
    console: Console,
) -> tuple[Ambiguity, dict[str, Any]]:
    """The ambiguity set that recorded data ask for, and what documents say of the data, both in one convention.

    That is `convention`, else the problem's own. Raises InputError, naming the file and the array, for what is no
    record of this network, UnsupportedError for tau other than 0 (the problem's, unless given) and where there is no
    estimate.
    """
    from tolnet.analysis.data import tolerance_from_data
    from tolnet.model import Ambiguity, InputError, UnsupportedError, gamma_per
    from tolnet.model.bounded_reading import LARGEST_ARCHIVE, read_whole

    own = network.ambiguity or Ambiguity(0.0)
    family = own.tau if tau is None else tau
    if family != 0:
        raise UnsupportedError(f"--data estimates a tolerance for tau = 0 only (tau is {family:g}); add --tau 0")
    unit = convention or own.convention
    try:
        content = read_whole(path, LARGEST_ARCHIVE)
        with console.progress(f"estimating from {path}"):
            estimate = tolerance_from_data(network, _record(content), method=method)
    except InputError as error:
        raise InputError(error.complaints, source=str(path)) from None
    scale = gamma_per(unit)
    in_unit = {key: getattr(estimate, key) / scale for key in ("tolerance", "observed", "bias")}
    return estimate.ambiguity(unit), {
        "file": path.name,
        "sha256": hashlib.sha256(content).hexdigest(),
        **asdict(estimate),
        **in_unit,
        "interval": [bound / scale for bound in estimate.interval],
    }


def data_view(data: Mapping[str, Any], convention: Convention) -> Iterator[str]:
    """The estimate as people read it."""
    low, high = data["interval"]
    yield (
        f"tolerance from {data['file']} ({data['method']}, {data['steps']:,} steps): c = {data['tolerance']:.6g}"
        f" ({convention}), {data['level']:.0%} interval {low:.6g} to {high:.6g};"
        f" observed {data['observed']:.6g}, of which {data['bias']:.6g} is bias"
    )
    if data["tolerance"] == 0:
        yield "the data cannot be told from the nominal model: at c = 0 every filter is the plain Kalman filter"


def _record(content: bytes) -> Record:
    """The arrays of an archive, each of numbers; complains about every one that is missing, unknown or of texts."""
    from tolnet.analysis.data import Record
    from tolnet.model import Complaint, InputError
    from tolnet.model.archive import read_archive

    arrays = read_archive(content)
    complaints = [
        Complaint(name, f"is not expected; the arrays are {', '.join(ARRAYS)}{nearest(name, ARRAYS)}")
        for name in arrays
        if name not in ARRAYS
    ]
    complaints += [
        Complaint(name, f"is missing; {meaning}, were expected")
        for name, meaning in ARRAYS.items()
        if name not in arrays and name != "u"
    ]
    complaints += _no_numbers(arrays)
    if complaints:
        raise InputError(complaints)
    return Record(arrays["x"], arrays["y"], arrays.get("u"))


def _no_numbers(arrays: Mapping[str, ndarray]) -> Iterator[Complaint]:
    from tolnet.model import Complaint

    for name in ARRAYS:
        if name in arrays and arrays[name].dtype.kind not in "iuf":
            yield Complaint(name, f"is of type {arrays[name].dtype}; numbers were expected")
