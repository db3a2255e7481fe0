"""Turning what a user wrote of a network with corrupted channels into checked quantities over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import ndarray
from scipy import sparse

from tolnet.model import _checks as checks
from tolnet.model import sensors as packing
from tolnet.model._checks import Complaints
from tolnet.model.time_varying import PerNode, TimeVarying, all_nodes_over_time, depth, over_time


def parse_plant(A: Any, B: Any, Q: Any, F: Any, mu: Any, complaints: Complaints) -> dict[str, Any]:
    """A, F, Q and mu over time; where A cannot be used, the shapes of the others are left alone."""
    sizes: list[int] = []

    def plant(value: Any, key: str, more: Complaints) -> ndarray | None:
        array = _non_singular(value, sizes[0] if sizes else None, key, more)
        if array is not None and not sizes:
            sizes.append(len(array))
        return array

    found = over_time(A, 2, "plant.A", plant, complaints)
    n = sizes[0] if sizes else None
    many = "n" if n is None else str(n)

    def square(value: Any, key: str, more: Complaints) -> ndarray | None:
        return checks.shaped(value, (n, n), key, f"{many} x {many}", more)

    def covariance(value: Any, key: str, more: Complaints) -> ndarray | None:
        return checks.covariance(value, n, key, more, definite=True)

    def gramian(value: Any, key: str, more: Complaints) -> ndarray | None:
        factor = checks.shaped(value, (n, None), key, f"{many} x m", more)
        return None if factor is None else covariance(packing.gramian(factor), key, more)

    if (B is None) == (Q is None):
        complaints.add("plant", f"has {'neither' if B is None else 'both'} B and Q; exactly one was expected")
    noise = over_time(B, 2, "plant.B", gramian, complaints) if Q is None else None
    noise = noise if Q is None else over_time(Q, 2, "plant.Q", covariance, complaints)
    mu = parse_variance(mu, complaints)
    if F is None:
        F = np.zeros((n or 0, n or 0))
        if mu is not None and (mu.values is None or mu.values.any()):
            complaints.add("plant.F", "is missing: multiplicative_variance is not 0")
    return {"A": found, "F": over_time(F, 2, "plant.F", square, complaints), "Q": noise, "mu": mu}


def parse_variance(mu: Any, complaints: Complaints) -> TimeVarying | None:
    """mu over time, numbers >= 0."""

    def variance(value: Any, key: str, more: Complaints) -> ndarray | None:
        number = checks.number(value, key, "a number >= 0", more)
        if number is not None and number < 0:
            more.add(key, f"is {checks.shown(value)}; a number >= 0 was expected")
        return None if number is None else np.array(number)

    return over_time(mu, 0, "plant.multiplicative_variance", variance, complaints)


def _non_singular(value: Any, n: int | None, key: str, complaints: Complaints) -> ndarray | None:
    """A square matrix whose inverse exists, judged after scaling its rows and columns to largest entries of one."""
    A = checks.shaped(value, (n, n), key, "an n x n matrix" if n is None else f"{n} x {n}", complaints)
    if A is None:
        return None
    if A.size == 0 or A.shape[0] != A.shape[1]:
        complaints.add(key, f"is {checks.by(A.shape)}; an n x n matrix was expected", shape=True)
        return None
    rows = np.abs(A).max(axis=1, keepdims=True)
    unit = A / np.where(rows > 0, rows, 1.0)
    columns = np.abs(unit).max(axis=0)
    sizes = np.linalg.svd(unit / np.where(columns > 0, columns, 1.0), compute_uv=False)
    if sizes[-1] <= len(A) * float(np.finfo(float).eps) * sizes[0]:
        complaints.add(key, "is singular; a non-singular one was expected")
    return A


def parse_sensors(C: Any, R: Any, D: Any, rows: Any, n: int | None, complaints: Complaints) -> dict[str, Any]:
    """C and R over time, and the offsets, which must be the same at every instant."""
    offsets: list[ndarray] = []

    def parse(instant: Sequence[Any], found: Complaints) -> Sequence[ndarray] | None:
        C_k, R_k, D_k = instant
        packed = packing.parse_sensors(C_k, R_k, D_k, rows, n, found)
        if packed["R"] is None or found.found:
            return None
        if offsets and not np.array_equal(offsets[0], packed["rows"]):
            found.add("sensors.C", "has another number of rows at another instant", shape=True)
            return None
        offsets.append(packed["rows"])
        return packed["C"], packed["R"]

    flat = () if rows is None else (1,)
    sources = [PerNode(C, 2, (3,) if rows is None else (2,)), PerNode(R, 2, (3, *flat)), PerNode(D, 2, (3, *flat))]
    found = all_nodes_over_time(sources, parse, complaints)
    if found is None:
        return dict.fromkeys(("C", "R", "rows"))
    return {"C": found[0], "R": found[1], "rows": offsets[0]}


def parse_start(
    mean: Any, P_0: Any, Pi_0: Any, n: int | None, N: int | None, complaints: Complaints
) -> dict[str, Any]:
    """What is known of the first state; Pi_0 is by default that of the initial mean and node 0's covariance."""
    many, width = "n" if n is None else str(n), n or 0
    if mean is not None:
        mean = checks.shaped(mean, (n,), "plant.initial_mean", f"a vector of {many}", complaints)
    mean = np.zeros(width) if mean is None else mean
    if packing.by_node(P_0) and len(P_0) == N and all(depth(item) == 2 or item is None for item in P_0):
        found = [
            np.eye(width)
            if item is None
            else checks.covariance(item, n, f"sensors[{i}].initial_covariance", complaints, definite=True)
            for i, item in enumerate(P_0)
        ]
    elif isinstance(P_0, ndarray) and P_0.ndim == 3:
        if N is not None and len(P_0) != N:
            complaints.add(
                "sensors.initial_covariance", f"is {checks.by(P_0.shape)}; there are {N} nodes", shape=True
            )
        found = [
            checks.covariance(item, n, f"sensors[{i}].initial_covariance", complaints, definite=True)
            for i, item in enumerate(P_0)
        ]
    else:
        one = np.eye(width)
        if P_0 is not None:
            one = checks.covariance(P_0, n, "plant.initial_covariance", complaints, definite=True)
        found = [one] * (N or 0)
    known = n is not None and not any(item is None for item in found)
    P_0 = np.array(found).reshape(len(found), width, width) if known else None
    if Pi_0 is not None:
        Pi_0 = checks.covariance(Pi_0, n, "plant.initial_second_moment", complaints, definite=False)
    elif P_0 is not None and len(P_0):
        Pi_0 = P_0[0] + np.outer(mean, mean)
    return {"initial_mean": mean, "initial_covariance": P_0, "initial_second_moment": Pi_0}


def check_connected(adjacency: sparse.csr_array, key: str, complaints: Complaints) -> None:
    """Complain unless every node hears of every other, if only through others."""
    from scipy.sparse import csgraph

    count, part = csgraph.connected_components(adjacency, directed=True, connection="strong")
    if count == 1:
        return
    reached = csgraph.breadth_first_order(adjacency, 0, directed=True, return_predecessors=False)
    deaf = np.setdiff1d(np.arange(len(part)), reached)
    l, k = (0, deaf[0]) if deaf.size else (int(np.flatnonzero(part != part[0])[0]), 0)
    complaints.add(key, f"does not connect the nodes strongly: nothing that node {l} sends ever reaches node {k}")
