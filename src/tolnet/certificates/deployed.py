"""The exact numbers that a certificate speaks of: what runs on the sensors, and the stated least favourable model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.certificates.numerals import matrix_text
from tolnet.model import Complaint, SensorNetwork, ShapeError

_COLUMNS_AT_A_TIME = 200_000


@dataclass(frozen=True, eq=False)
class Centre:
    """The stated least favourable model, as far as F and G need it: doubles, taken as exact.

    With T = Y Y' and the centre's gain G, the plant is driven by u = H e + L eps, H = M' T (A - G C),
    L L' = I + M' T M, M = [B, -G D]; docs/certificate.md.
    """

    gain: Float[ndarray, "M n"]
    """G', the rows of one sensor after the other."""
    tilt: Float[ndarray, "n r"]
    """Y."""


@dataclass(frozen=True, eq=False)
class Deployed:
    """A network with the gains and weights that run on it; every double is taken as the exact number that it is.

    The entries of node k are the i from `offsets[k]` to `offsets[k + 1]`, one for each node l that it hears, itself
    included, in rising order: `neighbours[i]` is l, `weights[i]` is w_lk, and the columns of G_k for sensor l are the
    rows `columns[i]:columns[i + 1]` of `gains`. Gains need not come from any Riccati equation.
    Raises ShapeError where the arrays do not fit the network.
    """

    network: SensorNetwork
    offsets: Int[ndarray, " N1"]
    neighbours: Int[ndarray, " L"]
    weights: Float[ndarray, " L"]
    columns: Int[ndarray, " L1"]
    gains: Float[ndarray, "M n"]
    centre: Centre | None = None

    def __post_init__(self) -> None:
        heard = self.network.adjacency.tocsc()
        heard.sort_indices()
        if not (np.array_equal(self.offsets, heard.indptr) and np.array_equal(self.neighbours, heard.indices)):
            raise ShapeError([Complaint("table", "has other neighbours than the problem's graph")])
        rows = np.diff(self.network.rows)[self.neighbours]
        if not np.array_equal(self.columns, np.concatenate([[0], np.cumsum(rows)])):
            raise ShapeError([Complaint("table", "has other numbers of outputs than the problem's sensors")])
        if self.weights.shape != self.neighbours.shape or self.gains.shape != (self.columns[-1], self.network.n):
            raise ShapeError([Complaint("table", "has gains or weights of another shape than the problem's network")])

    @property
    def N(self) -> int:
        """Number of nodes."""
        return self.network.N

    @property
    def n(self) -> int:
        """Number of states."""
        return self.network.n

    @cached_property
    def hearer(self) -> Int[ndarray, " L"]:
        """The node k of each entry."""
        return np.repeat(np.arange(self.N), np.diff(self.offsets))

    @cached_property
    def mixing(self) -> sparse.csr_array:
        """W', N x N: row k holds w_lk."""
        return sparse.csr_array((self.weights, self.neighbours, self.offsets), shape=(self.N, self.N))

    @cached_property
    def sensor_rows(self) -> Int[ndarray, " M"]:
        """The row of C that each row of `gains` multiplies."""
        widths = np.diff(self.columns)
        within = np.arange(widths.sum()) - np.repeat(self.columns[:-1], widths)
        return np.repeat(self.network.rows[self.neighbours], widths) + within

    @cached_property
    def loops(self) -> tuple[Float[ndarray, "N n n"], Float[ndarray, "N n n"]]:
        """M_k = A - G_k C_k^loc in floating point; |A| + |G_k| |C_k^loc|, of which its rounding is a small part."""
        A, C = self.network.A, self.network.C
        M = np.broadcast_to(A, (self.N, *A.shape)).copy()
        size = np.broadcast_to(np.abs(A), M.shape).copy()
        for nodes, part in self._stretches():
            product = self.gains[part][:, :, None] * C[self.sensor_rows[part]][:, None, :]
            starts = self.columns[self.offsets[nodes.start : nodes.stop]] - part.start
            ends = np.append(starts[1:], part.stop - part.start)
            has = ends > starts
            if has.any():
                M[nodes][has] -= np.add.reduceat(product, starts[has], axis=0)
                size[nodes][has] += np.add.reduceat(np.abs(product), starts[has], axis=0)
        return M, size

    def _stretches(self) -> Iterator[tuple[slice, slice]]:
        """Ranges of nodes, with their rows of `gains`, that keep the temporaries small."""
        first = self.columns[self.offsets]
        k = 0
        while k < self.N:
            end = max(k + 1, int(np.searchsorted(first, first[k] + _COLUMNS_AT_A_TIME, side="right")) - 1)
            yield slice(k, end), slice(int(first[k]), int(first[end]))
            k = end

    def data(self) -> dict[str, Any]:
        """The `data` of a certificate: all of it, as text that reads back to the same numbers."""
        network = self.network
        process = (
            {"Q": matrix_text(network.Q)}
            if network.B is None
            else {"B": matrix_text(network.B), "columns": network.B.shape[1]}
        )
        rows, gains = network.rows.tolist(), self.columns[self.offsets].tolist()
        offsets, neighbours = self.offsets.tolist(), self.neighbours.tolist()
        each = range(self.N)
        centre = self.centre and {
            "gain": [matrix_text(self.centre.gain[rows[k] : rows[k + 1]].T) for k in each],
            "tilt": matrix_text(self.centre.tilt),
            "columns": self.centre.tilt.shape[1],
        }
        return {
            "n": self.n,
            "nodes": self.N,
            "A": matrix_text(network.A),
            "process": process,
            "C": [matrix_text(network.C[rows[k] : rows[k + 1]]) for k in each],
            "noise": [self._noise(k) for k in each],
            "directed": bool(network.directed),
            "neighbours": [neighbours[offsets[k] : offsets[k + 1]] for k in each],
            "weights": [matrix_text(self.weights[offsets[k] : offsets[k + 1]]) for k in each],
            "gains": [matrix_text(self.gains[gains[k] : gains[k + 1]].T) for k in each],
            "centre": centre,
        }

    def _noise(self, k: int) -> dict[str, str]:
        factors = self.network.factors
        if factors is not None and factors.filled[k]:
            return {"D": matrix_text(factors.block(k))}
        R = self.network.sensors.block(k)
        return {"R": matrix_text(R)} if R.size else {}
