"""MATLAB files: the constructor's vocabulary, in the shapes in which MATLAB keeps things."""

from __future__ import annotations

import hashlib
import io
import struct
import warnings
import zlib
from typing import Any

import numpy as np
from numpy import ndarray
from scipy import sparse

from tolnet.model._checks import Complaints, by, nearest
from tolnet.model.ambiguity import Ambiguity
from tolnet.model.errors import InputError

MATRICES = ("A", "B", "Q", "initial_covariance", "positions", "adjacency", "W")
VECTORS = ("input", "initial_mean")
PER_NODE = ("C", "R", "D")
NUMBERS = ("dt", "directed", "tolerance", "tau")
TEXTS = ("name", "description", "rule", "convention")
LISTS = ("names", "states")
KNOWN = (*MATRICES, *VECTORS, *PER_NODE, *NUMBERS, *TEXTS, *LISTS, "edges")


def arguments_of_mat(data: bytes) -> dict[str, Any]:
    """The arguments of `SensorNetwork` that the bytes of a MATLAB file give; see `SensorNetwork.from_mat`."""
    variables = _variables(data)
    complaints = Complaints()
    for name in variables.keys() - set(KNOWN):
        hint = f"the nearest is {nearest(name, KNOWN)!r}; save only the network's variables"
        complaints.add(name, f"is no known variable; {hint}")
    values = {name: _value(name, variables[name], complaints) for name in KNOWN if name in variables}
    if "A" not in values or "C" not in values:
        complaints.add("A" if "A" not in values else "C", "is missing")
    complaints.raise_if_any()
    values["edges"] = _from_zero(values.get("edges"), len(values["C"]), complaints)
    complaints.raise_if_any()
    ball = {key: values.pop(key) for key in ("tolerance", "convention", "tau") if key in values}
    if ball:
        values["ambiguity"] = Ambiguity(**{"tolerance": None, **ball})
    weights, rule = values.pop("W", None), values.pop("rule", None)
    if weights is not None and rule is not None:
        raise InputError("has both W and rule; at most one was expected")
    if weights is not None or rule is not None:
        values["diffusion"] = rule if weights is None else weights
    return {**values, "digest": hashlib.sha256(data).hexdigest()}


def _variables(data: bytes) -> dict[str, Any]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    malformed = (MatReadError, zlib.error, struct.error, LookupError, MemoryError, OSError, TypeError, ValueError)
    if not data:
        raise InputError("is empty; a MATLAB file was expected")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a variable given twice the last counts, as in MATLAB
            content = loadmat(io.BytesIO(data), appendmat=False)
    except NotImplementedError:
        raise InputError("is in MATLAB's format 7.3, which is not read; save it with -v7") from None
    except malformed as error:
        raise InputError(f"is no MATLAB file: {error or type(error).__name__}") from None
    return {name: value for name, value in content.items() if not name.startswith("__")}


def _value(name: str, value: Any, complaints: Complaints) -> Any:
    """One variable in the form in which the constructor takes it; None, with a complaint, if it cannot have it."""
    cell = isinstance(value, ndarray) and value.dtype == object
    plain = isinstance(value, ndarray) and value.dtype.kind in "iufb"
    if name in PER_NODE and (cell or plain):
        return _per_node(value)
    if name in ("adjacency", "W") and sparse.issparse(value):
        return value
    if sparse.issparse(value):
        value, plain = sparse.csr_array(value).toarray(), True
    if name in MATRICES or (name == "edges" and plain):
        if plain and value.ndim == 2:
            return value
        complaints.add(name, "is no matrix of real numbers")
        return None
    if name in VECTORS and plain and value.ndim == 2 and min(value.shape) <= 1:
        return value.ravel()
    if name in NUMBERS and plain and value.size == 1:
        number = value.item()
        return bool(number) if name == "directed" and number in (0, 1) else number
    text = _text(value)
    if name in TEXTS and text is not None:
        return text
    if name in LISTS:
        return _texts(value, name, complaints)
    meant = "a number" if name in NUMBERS else "a text" if name in TEXTS else "an array of real numbers"
    found = by(value.shape) if plain else f"of type {type(value).__name__}"
    complaints.add(name, f"is {found}; {meant} was expected")
    return None


def _per_node(value: ndarray) -> Any:
    """A cell array as a list; p x n x N with the nodes first; p x n, to which MATLAB cuts p x n x 1, as one node."""
    if value.dtype == object:
        return list(value.ravel(order="F"))
    return np.ascontiguousarray(np.moveaxis(value, 2, 0)) if value.ndim == 3 else [value]


def _text(value: Any) -> str | None:
    if isinstance(value, ndarray) and value.dtype.kind == "U" and value.size <= 1:
        return str(value.item()) if value.size else ""
    return None


def _texts(value: Any, name: str, complaints: Complaints) -> list[str] | None:
    """A cell array of texts, or the rows of a character matrix, which MATLAB fills up with blanks."""
    if isinstance(value, ndarray) and value.dtype.kind == "U":
        return [str(text).rstrip() for text in value.ravel()]
    found = [_text(item) for item in value.ravel(order="F")] if isinstance(value, ndarray) else []
    texts = [text for text in found if text is not None]
    if not texts or len(texts) < len(found):
        complaints.add(name, "is no cell array of texts (cellstr turns strings into one)")
        return None
    return texts


def _from_zero(edges: ndarray | None, N: int, complaints: Complaints) -> ndarray | None:
    """MATLAB's E x 2 edges, nodes counted from 1, as pairs counted from 0."""
    if edges is None:
        return None
    if edges.size == 0:
        return np.empty((0, 2), dtype=np.int64)
    if edges.shape[1] != 2:
        complaints.add("edges", f"is {by(edges.shape)}; E x 2 was expected", shape=True)
        return None
    bad = np.flatnonzero(~((edges >= 1) & (edges <= N) & (edges == np.floor(edges))).all(axis=1))
    each = (
        (f"edges({e + 1},:)", f"is {edges[e].tolist()}; nodes are numbered from 1 to {N}, as MATLAB counts")
        for e in bad
    )
    complaints.add_each(each, bad.size)
    return None if bad.size else edges.astype(np.int64) - 1
