"""MATLAB files: the constructor's vocabulary, in the shapes in which MATLAB keeps things."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import numpy as np
from numpy import ndarray
from scipy import sparse

from tolnet.model._checks import Complaints, by, nearest, shown, shown_key
from tolnet.model.ambiguity import CONVENTIONS, Ambiguity
from tolnet.model.errors import InputError
from tolnet.model.matfile import read_mat

MATRICES = ("A", "B", "Q", "initial_covariance", "positions", "adjacency", "edges", "W")
VECTORS = ("input", "initial_mean")
PER_NODE = ("C", "R", "D")
NUMBERS = ("dt", "tolerance", "tau")
TEXTS = ("name", "description", "rule", "convention")
LISTS = ("names", "states")
MEANT = {
    MATRICES: "a matrix of real numbers",
    VECTORS: "a vector of real numbers",
    PER_NODE: "a cell array or a stack of matrices",
    NUMBERS: "a number",
    ("directed",): "true or false",
    TEXTS: "a text",
    LISTS: "a cell array of texts",
}
LARGEST_FULL = 10**7
"""How many numbers a sparse matrix may stand for that is needed in full."""

KNOWN = tuple(name for group in MEANT for name in group)


def arguments_of_mat(data: bytes) -> dict[str, Any]:
    """The arguments of `SensorNetwork` that the bytes of a MATLAB file give; see `SensorNetwork.from_mat`."""
    variables = read_mat(data)
    complaints = Complaints()
    strange = [name for name in variables if name not in KNOWN]
    hints = (
        (shown_key(name), f"the nearest is {nearest(name, KNOWN)!r}; save only the network's variables")
        for name in strange
    )
    complaints.add_each(((name, f"is no known variable; {hint}") for name, hint in hints), len(strange))
    values = {name: _value(name, variables[name], complaints) for name in KNOWN if name in variables}
    needed = {"A", "C"} | ({"tolerance"} if {"tau", "convention"} & values.keys() else set())
    for name in sorted(needed - values.keys()):
        complaints.add(name, "is missing")
    if values.get("convention", CONVENTIONS[0]) not in CONVENTIONS:
        complaints.add("convention", f"is {shown(values['convention'])}; 'gamma' or 'nats' was expected")
    complaints.raise_if_any()
    values["edges"] = _from_zero(values.get("edges"), len(values["C"]), complaints)
    complaints.raise_if_any()
    ball = {key: values.pop(key) for key in ("tolerance", "convention", "tau") if key in values}
    if ball:
        values["ambiguity"] = Ambiguity(**ball)
    weights, rule = values.pop("W", None), values.pop("rule", None)
    if weights is not None and rule is not None:
        raise InputError("has both W and rule; at most one was expected")
    if weights is not None or rule is not None:
        values["diffusion"] = rule if weights is None else weights
    return {**values, "digest": hashlib.sha256(data).hexdigest()}


def _value(name: str, value: Any, complaints: Complaints) -> Any:
    """One variable in the form in which the constructor takes it; None, with a complaint, if it cannot have it."""
    if name in PER_NODE and isinstance(value, tuple | ndarray):
        return _per_node(value)
    if name in ("adjacency", "W") and sparse.issparse(value):
        return value
    if sparse.issparse(value) and math.prod(value.shape) <= LARGEST_FULL:
        value = sparse.csc_array(value).toarray()
    if isinstance(value, ndarray):
        if name in MATRICES and value.ndim == 2:
            return value
        if name in VECTORS and value.ndim == 2 and min(value.shape) <= 1:
            return value.ravel()
        if name in NUMBERS and value.size == 1:
            return float(value.item())
        if name == "directed" and value.size == 1 and value.item() in (0, 1):
            return bool(value.item())
    if isinstance(value, str) and name in TEXTS:
        return value
    if isinstance(value, str) and name in LISTS:  # a character matrix of one row
        return [value]
    if isinstance(value, tuple) and name in LISTS and all(isinstance(text, str) for text in value):
        return value
    meant = next(meant for group, meant in MEANT.items() if name in group)
    complaints.add(name, f"is {_kind(value)}; {meant} was expected")
    return None


def _kind(value: Any) -> str:
    if isinstance(value, ndarray):
        return by(value.shape)
    if sparse.issparse(value):
        return f"sparse and {by(value.shape)}"
    return "a text" if isinstance(value, str) else "a cell array"


def _per_node(value: tuple[Any, ...] | ndarray) -> Any:
    """A cell array as a list; p x n x N with the nodes first; p x n, to which MATLAB cuts p x n x 1, as one node."""
    if isinstance(value, tuple):
        return list(value)
    return np.ascontiguousarray(np.moveaxis(value, 2, 0)) if value.ndim == 3 else [value]


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
