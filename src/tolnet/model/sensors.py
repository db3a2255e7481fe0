"""Sensors packed one under the other: C (M, n), row offsets, and flattened blocks R_k."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.model import _checks as checks
from tolnet.model._checks import Complaints


@dataclass(frozen=True, eq=False)
class Packed:
    """C, offsets and one flattened square block a node, whatever the p_k."""

    C: Float[ndarray, "M n"]
    rows: Int[ndarray, " N1"]
    blocks: Float[ndarray, " sum_p2"]

    @property
    def block_offsets(self) -> Int[ndarray, " N1"]:
        """Where each node's block begins in `blocks`: cumulative p_k squared."""
        return np.concatenate([[0], np.cumsum(np.diff(self.rows) ** 2)])

    def groups(self) -> Iterator[tuple[ndarray, Float[ndarray, "K p n"], Float[ndarray, "K p p"]]]:
        """Nodes of equal p_k at a time: their indices, C_k stacked and blocks stacked. Relays are left out."""
        sizes, offsets = np.diff(self.rows), self.block_offsets
        for p in np.unique(sizes[sizes > 0]):
            nodes = np.flatnonzero(sizes == p)
            C = self.C[self.rows[nodes, None] + np.arange(p)]
            blocks = self.blocks[offsets[nodes, None] + np.arange(p * p)].reshape(-1, p, p)
            yield nodes, C, blocks


def pack_observations(C: Any, rows: Any, n: int, complaints: Complaints) -> tuple[ndarray, ndarray] | None:
    """C as (M, n) with offsets `rows`, from a packed array, a stack (N, p, n) or a sequence of matrices."""
    if rows is not None:
        packed = checks.shaped(C, (None, n), "sensors.C", f"M x {n} with offsets `rows`", complaints)
        return None if packed is None else _checked_offsets(packed, rows, complaints)
    if isinstance(C, ndarray) and C.ndim == 3:
        stack = checks.shaped(C, (None, None, n), "sensors.C", f"N x p x {n}", complaints)
        if stack is None:
            return None
        N, p = stack.shape[:2]
        return stack.reshape(N * p, n), np.arange(N + 1) * p
    if not isinstance(C, Sequence) and not (isinstance(C, ndarray) and C.dtype == object):
        complaints.add("sensors.C", "is neither a stack N x p x n nor a sequence of one matrix a node")
        return None
    parts = [_observation(C_k, n, f"sensors[{k}].C", complaints) for k, C_k in enumerate(C)]
    if not parts:
        complaints.add("sensors", "is empty; one table a node was expected")
    good = [part for part in parts if part is not None]
    if not parts or len(good) < len(parts):
        return None
    rows = np.concatenate([[0], np.cumsum([len(part) for part in good])])
    return np.concatenate(good), rows


def _observation(C_k: Any, n: int, key: str, complaints: Complaints) -> ndarray | None:
    array = checks.real_array(C_k, key, complaints)
    if array is None:
        return None
    if array.size == 0 and (array.ndim == 1 or array.shape[0] == 0):
        return np.empty((0, n))
    if array.ndim != 2:
        complaints.add(key, f"is {checks.by(array.shape)}; a p x {n} matrix was expected", shape=True)
        return None
    if array.shape[1] != n:
        complaints.add(key, f"has {array.shape[1]} columns; plant.A is {n} x {n}", shape=True)
        return None
    return array


def _checked_offsets(C: ndarray, rows: Any, complaints: Complaints) -> tuple[ndarray, ndarray] | None:
    given = np.array(rows)
    whole = given.dtype.kind in "iu" and given.ndim == 1 and given.size >= 2
    if not whole or given[0] != 0 or given[-1] != len(C) or (np.diff(given.astype(np.int64)) < 0).any():
        complaints.add("rows", f"is not N + 1 whole offsets that rise from 0 to {len(C)}, the number of rows of C")
        return None
    return C, given.astype(np.int64)


def pack_blocks(blocks: Any, rows: ndarray, letter: str, complaints: Complaints) -> ndarray | None:
    """Square blocks (R_k or D_k) flattened and concatenated, from that form, a stack or a sequence."""
    sizes = np.diff(rows)
    if isinstance(blocks, ndarray) and blocks.ndim == 1 and blocks.dtype != object:
        total = int((sizes**2).sum())
        meant = f"{total} numbers, the sum of p_k squared,"
        return checks.shaped(blocks, (total,), f"sensors.{letter}", meant, complaints)
    if isinstance(blocks, ndarray) and blocks.ndim == 3:
        p = int(sizes[0]) if len(set(sizes.tolist())) == 1 else None
        if p is None:
            complaints.add(f"sensors.{letter}", "is a stack, but the p_k differ; give one matrix a node", shape=True)
            return None
        stack = checks.shaped(
            blocks, (len(sizes), p, p), f"sensors.{letter}", f"{len(sizes)} x {p} x {p}", complaints
        )
        return None if stack is None else stack.reshape(-1)
    if not isinstance(blocks, Sequence | ndarray) or len(blocks) != len(sizes):
        count = len(blocks) if isinstance(blocks, Sequence | ndarray) else "no"
        complaints.add(f"sensors.{letter}", f"has {count} matrices; C has {len(sizes)}", shape=True)
        return None
    flat: list[ndarray] = []
    for k, (block, p) in enumerate(zip(blocks, sizes.tolist(), strict=True)):
        key = f"sensors[{k}].{letter}"
        if p == 0 and np.size(block) == 0:
            continue
        part = checks.shaped(block, (p, p), key, f"{p} x {p}, one row and column for each row of C,", complaints)
        flat.append(np.empty(0) if part is None else part.reshape(-1))
    return np.concatenate(flat) if flat else np.empty(0)


def squared(D: Packed) -> ndarray:
    """The blocks D_k D_k', flattened and concatenated."""
    R, offsets = np.zeros_like(D.blocks), D.block_offsets
    for nodes, _, stack in D.groups():
        p = stack.shape[-1]
        R[offsets[nodes, None] + np.arange(p * p)] = (stack @ stack.mT).reshape(-1, p * p)
    return R


def check_noise(R: Packed, letter: str, complaints: Complaints) -> None:
    """Complain about every R_k that is not symmetric positive definite, naming its node."""
    for nodes, _, stack in R.groups():
        skew = (stack != stack.mT).any(axis=(1, 2))
        diagonal = np.diagonal(stack, axis1=1, axis2=2)
        scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        unit = stack / scale[:, :, None] / scale[:, None, :]
        smallest = np.linalg.eigvalsh(unit)[:, 0]
        weak = (diagonal <= 0).any(axis=1) | (smallest <= stack.shape[-1] * np.finfo(float).eps)
        for i in np.flatnonzero(skew | weak):
            key = f"sensors[{nodes[i]}].{letter}"
            if letter == "D":
                complaints.add(key, "is singular: R = D D' is not positive definite")
            elif checks.symmetric(stack[i], key, complaints):
                checks.positive(stack[i], key, complaints, definite=True)


def information(R: Packed, n: int) -> Float[ndarray, "N n n"]:
    """C_k' R_k^-1 C_k of every node, stacked; zero for relays. Assumes every R_k positive definite."""
    S = np.zeros((len(R.rows) - 1, n, n))
    for nodes, C, stack in R.groups():
        Y = whiten(C, stack)
        S[nodes] = Y.mT @ Y
    return S


def whiten(C: Float[ndarray, "K p n"], R: Float[ndarray, "K p p"]) -> Float[ndarray, "K p n"]:
    """L^-1 C with R = L L', so that C' R^-1 C is its Gramian."""
    return np.linalg.solve(np.linalg.cholesky(R), C)
