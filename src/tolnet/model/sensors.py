"""Sensors packed one under the other: C (M, n), row offsets, and flattened blocks R_k."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.model import _checks as checks
from tolnet.model._checks import Complaints, frozen


@dataclass(frozen=True, eq=False)
class Packed:
    """C, offsets and one flattened square block a node, whatever the p_k."""

    C: Float[ndarray, "M n"]
    rows: Int[ndarray, " N1"]
    blocks: Float[ndarray, " sum_p2"]

    @cached_property
    def block_offsets(self) -> Int[ndarray, " N1"]:
        """Where each node's block begins in `blocks`: cumulative p_k squared."""
        return frozen(np.concatenate([[0], np.cumsum(np.diff(self.rows) ** 2)]))

    def block(self, k: int) -> Float[ndarray, "p p"]:
        """The block of node k."""
        p = int(self.rows[k + 1] - self.rows[k])
        start = int(self.block_offsets[k])
        return self.blocks[start : start + p * p].reshape(p, p)

    def groups(self) -> Iterator[tuple[ndarray, Float[ndarray, "K p n"], Float[ndarray, "K p p"]]]:
        """Nodes of equal p_k at a time: their indices, C_k stacked and blocks stacked. Relays are left out."""
        sizes = np.diff(self.rows)
        for p in np.unique(sizes[sizes > 0]):
            nodes = np.flatnonzero(sizes == p)
            if len(nodes) == len(sizes):  # one size for all: both are stacks already
                yield nodes, self.C.reshape(len(nodes), p, -1), self.blocks.reshape(-1, p, p)
                continue
            C = self.C[self.rows[nodes, None] + np.arange(p)]
            blocks = self.blocks[self.block_offsets[nodes, None] + np.arange(p * p)].reshape(-1, p, p)
            yield nodes, C, blocks

    @cached_property
    def filled(self) -> ndarray:
        """(N,), whether each node's block has an entry other than zero. A node without rows has none."""
        result = np.zeros(len(self.rows) - 1, dtype=bool)
        for nodes, _, stack in self.groups():
            result[nodes] = stack.any(axis=(1, 2))
        return frozen(result)


def count(C: Any, rows: Any) -> int | None:
    """How many sensors C describes, as far as its form tells."""
    if rows is not None:
        return max(0, len(rows) - 1) if isinstance(rows, ndarray) and rows.ndim == 1 else None
    return len(C) if by_node(C) or (isinstance(C, ndarray) and C.ndim == 3) else None


def parse_sensors(C: Any, R: Any, D: Any, rows: Any, n: int | None, complaints: Complaints) -> dict[str, Any]:
    """C, R, D and the offsets, packed and checked; all None where C could not be packed."""
    packed = pack_observations(C, rows, n, complaints)
    if packed is None:
        return dict.fromkeys(("C", "R", "D", "rows"))
    C, rows, unknown = packed
    R, D = pack_noise(R, D, C, rows, unknown, complaints)
    return {"C": C, "R": R, "D": D, "rows": rows}


def pack_observations(
    C: Any, rows: Any, n: int | None, complaints: Complaints
) -> tuple[ndarray, ndarray, set[int]] | None:
    """C as (M, n) with offsets `rows`, from a packed array, a stack (N, p, n) or a sequence of matrices.

    `n` None: any number of columns, since A is wrong already. The third value holds the nodes whose matrix was
    complained about and left out, so that the others can still be judged.
    """
    columns = "n" if n is None else str(n)
    if rows is not None:
        packed = checks.shaped(C, (None, n), "sensors.C", f"M x {columns} with offsets `rows`", complaints)
        return None if packed is None else _checked_offsets(packed, rows, complaints)
    if isinstance(C, ndarray) and C.ndim == 3:
        stack = _stack(C, (None, None, n), "C", f"N x p x {columns}", complaints)
        if stack is None:
            return None
        N, p, width = stack.shape
        if N == 0:
            complaints.add("sensors", "is empty; one sensor a node was expected")
            return None
        return stack.reshape(N * p, width), np.arange(N + 1) * p, set()
    if not by_node(C):
        complaints.add("sensors.C", "is neither a stack N x p x n nor a sequence of one matrix a node")
        return None
    parts = [_observation(C_k, n, f"sensors[{k}].C", complaints) for k, C_k in enumerate(C)]
    if not parts:
        complaints.add("sensors", "is empty; one sensor a node was expected")
        return None
    bad = {k for k, part in enumerate(parts) if part is None}
    width = max((part.shape[1] for part in parts if part is not None), default=0)
    matrices = [np.empty((0, width)) if part is None else part for part in parts]
    if any(len(matrix) and matrix.shape[1] != width for matrix in matrices):
        complaints.add("sensors", "have different numbers of columns in C; all were expected to agree", shape=True)
        return None
    offsets = np.concatenate([[0], np.cumsum([len(matrix) for matrix in matrices])])
    return np.concatenate([matrix.reshape(len(matrix), width) for matrix in matrices]), offsets, bad


def _stack(
    value: ndarray, shape: tuple[int | None, ...], letter: str, meant: str, complaints: Complaints
) -> ndarray | None:
    """`checks.shaped` for a stack of matrices, one a node; a value that is not finite is named with its node."""
    if value.dtype.kind in "iuf" and not np.isfinite(value).all():
        bad = np.argwhere(~np.isfinite(value).reshape(len(value), -1).all(axis=1)).ravel()
        wrong = ((f"sensors[{k}].{letter}", "has a value that is not a finite number") for k in bad)
        complaints.add_each(wrong, len(bad))
        return None
    return checks.shaped(value, shape, f"sensors.{letter}", meant, complaints)


def _observation(C_k: Any, n: int | None, key: str, complaints: Complaints) -> ndarray | None:
    array = checks.real_array(C_k, key, complaints)
    if array is None:
        return None
    if array.size == 0 and (array.ndim == 1 or array.shape[0] == 0):
        return np.empty((0, n or 0))
    if array.ndim != 2:
        complaints.add(key, f"is {checks.by(array.shape)}; a p x {n or 'n'} matrix was expected", shape=True)
        return None
    if n is not None and array.shape[1] != n:
        complaints.add(key, f"has {array.shape[1]} columns; plant.A is {n} x {n}", shape=True)
        return None
    return array


def _checked_offsets(C: ndarray, rows: Any, complaints: Complaints) -> tuple[ndarray, ndarray, set[int]] | None:
    try:
        given = np.asarray(rows)
    except ValueError:  # a ragged list
        given = np.empty(0)
    whole = given.dtype.kind in "iu" and given.ndim == 1 and given.size >= 2
    # Compared before any conversion: an offset beyond int64 is out of range as it stands.
    if not whole or given[0] != 0 or given[-1] != len(C) or (given[1:] < given[:-1]).any():
        complaints.add(
            "sensors.rows", f"is not N + 1 whole offsets that rise from 0 to {len(C)}, the number of rows of C"
        )
        return None
    return C, given.astype(np.int64), set()


def pack_noise(
    R: Any, D: Any, C: ndarray, rows: ndarray, unknown: set[int], complaints: Complaints
) -> tuple[ndarray | None, ndarray | None]:
    """The blocks R_k and, where a node gave its factor, D_k; both flattened and concatenated.

    Each node gives exactly one of the two; the block of D is zero where it gave R, and D is None where all did.
    The p_k of nodes that are `unknown` is not known, and nothing is said about their blocks.
    """
    unknown = unknown | _check_choice(R, D, rows, complaints)
    covariances = None if R is None else pack_blocks(R, rows, "R", unknown, complaints)
    factors = None if D is None else pack_blocks(D, rows, "D", unknown, complaints)
    by_factor = np.zeros(len(rows) - 1, dtype=bool)
    if factors is not None:
        factor = Packed(C, rows, factors)
        by_factor = ~by_factor if isinstance(D, ndarray) else np.array([block is not None for block in D or ()])
        squares = squared(factor, complaints)
        where = np.repeat(by_factor, np.diff(rows) ** 2)
        covariances = squares if covariances is None else np.where(where, squares, covariances)
    if covariances is None:  # relays only, or nothing that could be judged
        return np.empty(0), None
    check_noise(Packed(C, rows, covariances), by_factor, complaints)
    return covariances, factors if factors is not None and factors.any() else None


def by_node(blocks: Any) -> bool:
    """Whether this is one matrix a node, rather than one array for all."""
    if isinstance(blocks, ndarray):
        return blocks.dtype == object and blocks.ndim == 1
    return isinstance(blocks, Sequence) and not isinstance(blocks, str | bytes)


def _check_choice(R: Any, D: Any, rows: ndarray, complaints: Complaints) -> set[int]:
    """The nodes with a sensor that do not give exactly one of R and D, after a complaint about each."""
    given = [blocks for blocks in (R, D) if blocks is not None]
    if not given and rows[-1]:
        complaints.add("sensors", "have neither R nor D; exactly one was expected")
    if not given or not all(map(by_node, given)):
        if len(given) == 2:
            complaints.add("sensors", "have both R and D; exactly one was expected")
        return set()
    bad: dict[int, str] = {}
    for k, (p, *both) in enumerate(zip(np.diff(rows).tolist(), *given, strict=False)):
        count = sum(block is not None for block in both)
        if p and count != 1:
            bad[k] = "both R and D" if count else "neither R nor D"
    each = ((f"sensors[{k}]", f"has {found}; exactly one was expected") for k, found in bad.items())
    complaints.add_each(each, len(bad))
    return set(bad)


def pack_blocks(blocks: Any, rows: ndarray, letter: str, unknown: set[int], complaints: Complaints) -> ndarray | None:
    """Square blocks (R_k or D_k) flattened and concatenated, from that form, a stack or a sequence.

    In a sequence None becomes a block of zeros; what was complained about, and what is `unknown`, an identity.
    """
    sizes = np.diff(rows)
    if isinstance(blocks, ndarray) and blocks.ndim == 1 and blocks.dtype != object:
        total = int((sizes**2).sum())
        meant = f"{total} numbers, the sum of p_k squared,"
        return checks.shaped(blocks, (total,), f"sensors.{letter}", meant, complaints)
    if isinstance(blocks, ndarray) and blocks.ndim == 3:
        p = int(sizes[0])
        if (sizes != p).any():
            complaints.add(f"sensors.{letter}", "is a stack, but the p_k differ; give one matrix a node", shape=True)
            return None
        stack = _stack(blocks, (len(sizes), p, p), letter, f"{len(sizes)} x {p} x {p}", complaints)
        return None if stack is None else stack.reshape(-1)
    if not by_node(blocks):
        complaints.add(f"sensors.{letter}", "is neither a stack N x p x p nor a sequence of one matrix a node")
        return None
    if len(blocks) != len(sizes):
        complaints.add(f"sensors.{letter}", f"has {len(blocks)} matrices; C has {len(sizes)}", shape=True)
        return None
    flat: list[ndarray] = []
    for k, (block, p) in enumerate(zip(blocks, sizes.tolist(), strict=True)):
        key = f"sensors[{k}].{letter}"
        if block is None or k in unknown:
            flat.append((np.eye(p) if k in unknown else np.zeros((p, p))).reshape(-1))
            continue
        if p == 0 and isinstance(block, Sequence) and not block:  # R = [] beside C = []
            block = np.empty((0, 0))
        part = checks.shaped(block, (p, p), key, f"{p} x {p}, one row and column for each row of C,", complaints)
        flat.append((np.eye(p) if part is None else part).reshape(-1))
    return np.concatenate(flat)


def squared(D: Packed, complaints: Complaints) -> ndarray:
    """The blocks D_k D_k', flattened and concatenated; complains where they overflow, and puts identities there."""
    R = np.zeros_like(D.blocks)
    for nodes, _, stack in D.groups():
        p = stack.shape[-1]
        product = gramian(stack)
        bad = ~np.isfinite(product).all(axis=(1, 2))
        complaints.add_each(((f"sensors[{k}].D", "is too large: D D' overflows") for k in nodes[bad]), int(bad.sum()))
        product[bad] = np.eye(p)
        R[D.block_offsets[nodes, None] + np.arange(p * p)] = product.reshape(-1, p * p)
    return R


def gramian(stack: Float[ndarray, "*K n m"]) -> Float[ndarray, "*K n n"]:
    """X X' of each matrix, symmetric to the last bit, which a matrix product alone does not promise."""
    with np.errstate(over="ignore", invalid="ignore"):  # callers look for values that are not finite
        product = stack @ stack.mT
        return (product + product.mT) / 2


def check_noise(R: Packed, by_factor: ndarray, complaints: Complaints) -> None:
    """Complain about every R_k that is not symmetric positive definite, naming its node."""
    wrong = 0
    for nodes, _, stack in R.groups():
        p = stack.shape[-1]
        bad = (stack != stack.mT).any(axis=(1, 2)) | (np.diagonal(stack, axis1=1, axis2=2) <= 0).any(axis=1)
        if p > 1:
            bad |= checks.smallest_scaled_eigenvalue(stack) <= checks.cholesky_margin(p)
        for i in np.flatnonzero(bad):
            wrong += 1
            key = f"sensors[{nodes[i]}]"
            if wrong > checks.MOST_OF_A_KIND:
                continue
            if by_factor[nodes[i]]:
                complaints.add(f"{key}.D", "is singular: R = D D' is not positive definite")
            elif checks.symmetric(stack[i], f"{key}.R", complaints):
                checks.positive(stack[i], f"{key}.R", complaints, definite=True)
    if wrong > checks.MOST_OF_A_KIND:
        complaints.more(wrong - checks.MOST_OF_A_KIND)


def information(R: Packed, n: int) -> Float[ndarray, "N n n"]:
    """C_k' R_k^-1 C_k of every node, stacked; zero for relays. Assumes every R_k positive definite.

    Raises InputError where it overflows.
    """
    S = np.zeros((len(R.rows) - 1, n, n))
    for nodes, C, stack in R.groups():
        with np.errstate(over="ignore", invalid="ignore"):
            Y = whiten(C, stack)
            S[nodes] = Y.mT @ Y
    complaints, bad = Complaints(), np.flatnonzero(~np.isfinite(S).all(axis=(1, 2)))
    each = ((f"sensors[{k}]", "has C too large for its R: C' R^-1 C overflows") for k in bad)
    complaints.add_each(each, bad.size)
    complaints.raise_if_any()
    return S


def whiten(C: Float[ndarray, "K p n"], R: Float[ndarray, "K p p"]) -> Float[ndarray, "K p n"]:
    """L^-1 C with R = L L', so that C' R^-1 C is its Gramian."""
    return np.linalg.solve(np.linalg.cholesky(R), C)
