"""Links that drop and return: what may be lost at each node, and what the node does then.

A node k that loses the link from l keeps its own estimate in the place of that of l, w_kk + w_lk, and leaves out the
columns of its gain that weigh the measurement of l. In an undirected network l loses the link to k at the same time.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.model.errors import InputError

MOST_CASES = 2_000_000


@dataclass(frozen=True, eq=False)
class Losses:
    """Cases of lost links, each at one node: what a stability condition of that node has to hold for.

    Entries number the pairs (k hears l) as in a deployment: those of node k stand from `offsets[k]` to
    `offsets[k + 1]`, their l in rising order. Case c is at `node[c]`, which loses the links of the entries
    `lost[c]` (padded with -1); `returned[c]` are the entries the other way round, -1 where that link stays.
    """

    node: Int[ndarray, " K"]
    lost: Int[ndarray, "K m"]
    returned: Int[ndarray, "K m"]

    def __len__(self) -> int:
        return len(self.node)


def possible_losses(
    offsets: Int[ndarray, " N1"], neighbours: Int[ndarray, " L"], most: int, *, directed: bool
) -> Losses:
    """Every way in which at most `most` links at a node drop at once, none included.

    In a directed network those into the node, since the loss of one out of it only takes a term from its condition.
    Raises InputError where these are more than MOST_CASES.
    """
    N = len(offsets) - 1
    hearer = np.repeat(np.arange(N), np.diff(offsets))
    others = neighbours != hearer
    count = np.bincount(hearer[others], minlength=N)
    cases = sum(float(_choose(count, m).sum()) for m in range(most + 1))
    if cases > MOST_CASES:
        raise InputError(f"--drop-links {most} makes {cases:.3g} cases at single nodes; {MOST_CASES:,} are the most")
    backward = np.full(len(hearer), -1) if directed else reverse_entries(offsets, neighbours)
    nodes: list[int] = []
    lost: list[tuple[int, ...]] = []
    for k in range(N):
        own = [e for e in range(offsets[k], offsets[k + 1]) if others[e]]
        for m in range(min(most, len(own)) + 1):
            for some in itertools.combinations(own, m):
                nodes.append(k)
                lost.append((*some, *(-1,) * (most - m)))
    table = np.array(lost, dtype=np.int64).reshape(len(lost), most)
    return Losses(np.array(nodes), table, np.where(table >= 0, backward[table], -1))


def reverse_entries(offsets: Int[ndarray, " N1"], neighbours: Int[ndarray, " L"]) -> Int[ndarray, " L"]:
    """For the entry (k hears l) the entry (l hears k); -1 where l does not hear k."""
    N = len(offsets) - 1
    hearer = np.repeat(np.arange(N), np.diff(offsets))
    codes, wanted = hearer * N + neighbours, neighbours * N + hearer
    at = np.minimum(np.searchsorted(codes, wanted), len(codes) - 1)
    return np.where(codes[at] == wanted, at, -1) if len(codes) else at


def weights_without(
    weights: Float[ndarray, " L"],
    offsets: Int[ndarray, " N1"],
    neighbours: Int[ndarray, " L"],
    dropped: Int[ndarray, " m"],
) -> Float[ndarray, " L"]:
    """The weights after the links of some entries have dropped, in floating point."""
    hearer = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    own = np.flatnonzero(neighbours == hearer)
    after = weights.copy()
    np.add.at(after, own[hearer[dropped]], weights[dropped])
    after[dropped] = 0.0
    return after


def _choose(n: Int[ndarray, " N"], m: int) -> Float[ndarray, " N"]:
    result = np.ones(len(n))
    for i in range(m):
        result *= np.maximum(n - i, 0) / (i + 1)
    return result
