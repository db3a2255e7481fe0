"""Scenarios of a network as a file: lost links, other weights, other gains (`tolnet certify --scenarios`)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray

from tolnet.certificates.switching import Scenario
from tolnet.model import Complaint, InputError
from tolnet.model._checks import Complaints
from tolnet.model.bounded_reading import LARGEST_TEXT, read_whole, text_of
from tolnet.model.graph import weights_of_triples

if TYPE_CHECKING:
    from tolnet.certificates.deployed import Deployed

_KEYS = ("drop", "weights", "triples", "table")


def read_scenarios(path: Path, deployed: Deployed) -> list[Scenario]:
    """The scenarios of a JSON file `{"scenarios": [...]}`, or of the list alone, each an object with some of

        drop      [[l, k], ...], links that dropped; stands alone
        weights   W, N x N, w[l][k] weighing neighbour l at node k
        triples   the same as [[l, k, w], ...], the rest being zero
        table     a table file whose gains and weights are in force then; its path counts from this file

    Raises InputError, naming the file and the key path, for everything else.
    """
    try:
        document = json.loads(text_of(read_whole(path, LARGEST_TEXT)))
    except InputError as error:
        raise InputError(error.complaints, source=str(path)) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"is no JSON: {error}", source=str(path)) from None
    listed = document.get("scenarios") if isinstance(document, dict) else document
    if not isinstance(listed, list) or not listed:
        raise InputError([Complaint("scenarios", "is no list; at least one scenario was expected")], source=str(path))
    found, complaints = [], []
    for number, entry in enumerate(listed):
        try:
            found.append(_scenario(entry, f"scenarios[{number}]", deployed, path.parent))
        except InputError as error:
            where = f"{error.source}: " if error.source else ""
            complaints += [Complaint(c.key or f"scenarios[{number}]", where + c.message) for c in error.complaints]
    if complaints:
        raise InputError(complaints, source=str(path))
    return found


def _scenario(entry: Any, key: str, deployed: Deployed, folder: Path) -> Scenario:
    if not isinstance(entry, dict) or not entry or set(entry) - set(_KEYS):
        raise InputError([Complaint(key, f"is no object with keys among {', '.join(_KEYS)}")])
    weights = gains = dropped = None
    if "table" in entry:
        weights, gains = _of_table(entry["table"], f"{key}.table", deployed, folder)
    for name in ("weights", "triples"):
        if name in entry:
            weights = _weights(entry[name], f"{key}.{name}", deployed, triples=name == "triples")
    if "drop" in entry:
        if len(entry) > 1:
            raise InputError([Complaint(key, "drops links and changes weights; make two scenarios of it")])
        dropped = _dropped(entry["drop"], f"{key}.drop", deployed)
        if deployed.weights.min(initial=0.0) < 0:
            raise InputError([Complaint(key, "drops links where some weights are negative")])
    return Scenario(dropped, weights, gains)


def _of_table(name: Any, key: str, deployed: Deployed, folder: Path) -> tuple[ndarray, ndarray]:
    from tolnet.design.export.deployed import read_deployed

    if not isinstance(name, str):
        raise InputError([Complaint(key, "is no path")])
    other = read_deployed(folder / name).deployment
    same = all(
        np.array_equal(getattr(other, part), getattr(deployed, part)) for part in ("offsets", "neighbours", "columns")
    )
    if not same:
        raise InputError([Complaint(key, "is a table of another graph, or of other sensors")])
    if not (np.isfinite(other.weights).all() and np.isfinite(other.gains).all()):
        raise InputError([Complaint(key, "has nodes without gains")])
    return other.weights, other.gains


def _weights(value: Any, key: str, deployed: Deployed, *, triples: bool) -> ndarray:
    complaints = Complaints()
    try:
        given = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise InputError([Complaint(key, "is no matrix of numbers")]) from None
    W = weights_of_triples(given, deployed.N, key, complaints) if triples else given
    complaints.raise_if_any()
    try:
        weighed = deployed.network.with_diffusion(W).diffusion
    except InputError as error:
        named = [Complaint(c.key.replace("diffusion.weights", key), c.message) for c in error.complaints]
        raise InputError(named) from None
    assert not isinstance(weighed, str)
    return np.asarray(weighed[deployed.neighbours, deployed.hearer]).ravel()


def _dropped(value: Any, key: str, deployed: Deployed) -> ndarray:
    """The entries of the links; both directions in an undirected network."""
    entries: list[int] = []
    index = _index(deployed)
    for i, pair in enumerate(value if isinstance(value, list) else [value]):
        match pair:
            case [int(l), int(k)] if l != k and (l, k) in index:
                entries += [index[l, k]] if deployed.network.directed else [index[l, k], index[k, l]]
            case _:
                raise InputError([Complaint(f"{key}[{i}]", f"is {pair!r}; a link [l, k] of the graph was expected")])
    return np.unique(np.array(entries, dtype=np.int64))


def _index(deployed: Deployed) -> Mapping[tuple[int, int], int]:
    pairs = zip(deployed.neighbours.tolist(), deployed.hearer.tolist(), strict=True)
    return {pair: entry for entry, pair in enumerate(pairs)}
