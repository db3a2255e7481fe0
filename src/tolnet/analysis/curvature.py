"""The part of a network's second derivative that needs no further equation: node by node, at fixed Q and Y.

At fixed Psi (error covariance before mixing) and adjoint Y, J is quadratic in column k of W, and in node k's gain:

    w_k' B w_k,  B_lm = tr(Y_kk Psi_lm)            tr(Y_0,kk H Sigma_k H'),  Sigma_k = I + f_k' D_k f_k

with D_k what node k's innovation holds beside its own noise. The model is positive semidefinite by construction, and
close enough to the true curvature that a quasi-Newton method which starts from it needs some ten gradients.
Source: docs/mathematics.md, section 12.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import sparse

_FLOOR = 1e-9
"""An adjoint below this part of the largest counts as that much: a node that nobody listens to has none."""
_LEAST = 1e-2
"""The same for the scale of a column."""


@dataclass(frozen=True, eq=False)
class Columns:
    """The columns of W one after the other: link i weighs node `sender[i]` at node `hearer[i]`.

    `offsets[k]:offsets[k + 1]` are the links of node k, senders in rising order, itself among them.
    """

    offsets: Int[ndarray, " K1"]
    sender: Int[ndarray, " L"]

    @property
    def nodes(self) -> int:
        """K."""
        return len(self.offsets) - 1

    @cached_property
    def degree(self) -> Int[ndarray, " K"]:
        """How many nodes each node hears, itself included."""
        return np.diff(self.offsets)

    @cached_property
    def hearer(self) -> Int[ndarray, " L"]:
        """The node whose column each link belongs to."""
        return np.repeat(np.arange(self.nodes), self.degree)

    @cached_property
    def place(self) -> Int[ndarray, " L"]:
        """The place of each link within its column."""
        return np.arange(len(self.sender)) - self.offsets[self.hearer]

    @cached_property
    def own(self) -> Int[ndarray, " K"]:
        """The link of each node to itself."""
        return np.flatnonzero(self.sender == self.hearer)

    @cached_property
    def present(self) -> Bool[ndarray, "K m"]:
        """Which places of a matrix with one row a column are links."""
        return np.arange(int(self.degree.max())) < self.degree[:, None]

    @cached_property
    def pairs(self) -> tuple[Int[ndarray, " T"], Int[ndarray, " T"]]:
        """All pairs of links of one column."""
        first = np.repeat(np.arange(len(self.sender)), self.degree[self.hearer])
        count = self.degree[self.hearer]
        within = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
        return first, self.offsets[self.hearer[first]] + within

    def spread(self, w: Float[ndarray, " L"], fill: float = 0.0) -> Float[ndarray, "K m"]:
        """One row a column, filled up with `fill`."""
        rows = np.full(self.present.shape, fill)
        rows[self.hearer, self.place] = w
        return rows

    def gather(self, rows: Float[ndarray, "K m"]) -> Float[ndarray, " L"]:
        """Back from `spread`."""
        return rows[self.hearer, self.place]

    def sums(self, w: Float[ndarray, " L"]) -> Float[ndarray, " K"]:
        """Of every column."""
        return np.bincount(self.hearer, weights=w, minlength=self.nodes)

    def centred(self, w: Float[ndarray, " L"]) -> Float[ndarray, " L"]:
        """Without what moves all weights of a column alike, which no admissible change does."""
        return w - (self.sums(w) / self.degree)[self.hearer]


def columns_of(adjacency: sparse.csr_array) -> Columns:
    """The links of a graph whose [l, k] says that node k hears node l, column by column."""
    heard = sparse.csc_array(adjacency)
    heard.sort_indices()
    return Columns(heard.indptr.astype(np.int64), heard.indices.astype(np.int64))


@dataclass(frozen=True, eq=False)
class GainCurvature:
    """Y_0,kk (x) Sigma_k of every node, for one group of states."""

    adjoint: Float[ndarray, "K n n"]
    inner: Float[ndarray, "K n n"]
    """D_k."""
    channels: Float[ndarray, "c n"]
    node: Int[ndarray, " H"]
    channel: Int[ndarray, " H"]

    def __add__(self, other: GainCurvature) -> GainCurvature:
        """Near the sum, which is no Kronecker product: the D_k are averaged as their adjoints weigh."""
        first, second = (np.trace(each.adjoint, axis1=1, axis2=2) for each in (self, other))
        share = (first / np.maximum(first + second, np.finfo(float).tiny))[:, None, None]
        inner = share * self.inner + (1 - share) * other.inner
        return GainCurvature(self.adjoint + other.adjoint, inner, self.channels, self.node, self.channel)

    def times(self, H: Float[ndarray, "n H"]) -> Float[ndarray, "n H"]:
        """2 Y_0,kk H_k Sigma_k."""
        f = self.channels[self.channel]
        through = (self._collect(H) @ self.inner)[self.node]
        changed = H.T + np.einsum("hij,hj->hi", through, f)
        return 2 * np.einsum("hij,hj->ih", self.adjoint[self.node], changed)

    def solve(self, G: Float[ndarray, "n H"]) -> Float[ndarray, "n H"]:
        """The H with 2 Y_0,kk H_k Sigma_k = G_k; Sigma^-1 = I - f' D (I + S D)^-1 f with n x n matrices."""
        f = self.channels[self.channel]
        half = np.einsum("hij,jh->hi", self._inverse_adjoint[self.node], G) / 2
        through = self._collect(half.T) @ self._inside
        return half.T - np.einsum("hij,hj->ih", through[self.node], f)

    def _collect(self, H: Float[ndarray, "n H"]) -> Float[ndarray, "K n n"]:
        """H_k f_k."""
        full = np.zeros((len(self.inner), len(H), len(self.channels)))
        full[self.node, :, self.channel] = H.T
        return full @ self.channels

    @cached_property
    def _inside(self) -> Float[ndarray, "K n n"]:
        """D (I + S D)^-1."""
        heard = np.zeros((len(self.inner), len(self.channels)))
        heard[self.node, self.channel] = 1.0
        f = self.channels
        S = (heard @ (f[:, :, None] * f[:, None, :]).reshape(len(f), f.shape[1] ** 2)).reshape(self.inner.shape)
        return self.inner @ np.linalg.inv(np.eye(f.shape[1]) + S @ self.inner)

    @cached_property
    def _inverse_adjoint(self) -> Float[ndarray, "K n n"]:
        largest = np.trace(self.adjoint, axis1=1, axis2=2).max()
        return np.linalg.inv(self.adjoint + _FLOOR * largest * np.eye(self.adjoint.shape[1]))


@dataclass(frozen=True, eq=False)
class Curvature:
    """2 B of every column of W, centred, and twice what the gains have, where gains are variables."""

    columns: Columns
    weights: Float[ndarray, "K m m"]
    gains: Sequence[GainCurvature] = ()

    @classmethod
    def of_pairs(cls, columns: Columns, B: Float[ndarray, " T"], gains: Sequence[GainCurvature] = ()) -> Curvature:
        """From B_lm, pair by pair of `columns.pairs`; what moves all weights of a column alike is taken out."""
        i, j = columns.pairs
        full = np.zeros((*columns.present.shape, columns.present.shape[1]))
        full[columns.hearer[i], columns.place[i], columns.place[j]] = 2 * B
        here = columns.present
        d = columns.degree[:, None]
        rows = np.where(here, full.sum(axis=2) / d, 0.0)
        mean = (rows.sum(axis=1) / columns.degree)[:, None, None]
        centred = full - rows[:, :, None] - rows[:, None, :] + mean
        return cls(columns, np.where(here[:, :, None] & here[:, None, :], centred, 0.0), gains)

    def __add__(self, other: Curvature) -> Curvature:
        """Of a sum."""
        gains = [one + another for one, another in zip(self.gains, other.gains, strict=True)]
        return Curvature(self.columns, self.weights + other.weights, gains)

    @cached_property
    def scale(self) -> Float[ndarray, " K"]:
        """At least the largest eigenvalue of each column's model."""
        bound = np.abs(self.weights).sum(axis=2).max(axis=1)
        largest = float(bound.max(initial=0.0))
        return np.maximum(bound, _LEAST * largest) if largest > 0 else np.ones_like(bound)

    def times(self, v: Float[ndarray, " z"]) -> Float[ndarray, " z"]:
        """The model's second derivative times v."""
        L = len(self.columns.sender)
        moved = np.einsum("kij,kj->ki", self.weights, self.columns.spread(v[:L]))
        return np.concatenate([self.columns.gather(moved), *self._each(v, "times")])

    def descent(self, g: Float[ndarray, " z"]) -> Float[ndarray, " z"]:
        """g over the scale of its column; for gains, the model solved."""
        L = len(self.columns.sender)
        return np.concatenate([g[:L] / self.scale[self.columns.hearer], *self._each(g, "solve")])

    def length(self, v: Float[ndarray, " z"]) -> float:
        """v' P v, where `descent` multiplies by P^-1."""
        L = len(self.columns.sender)
        own = float(v[:L] ** 2 @ self.scale[self.columns.hearer])
        rest = np.concatenate([np.zeros(0), *self._each(v, "times")])
        return own + float(v[L:] @ rest)

    def _each(self, v: Float[ndarray, " z"], what: str) -> list[ndarray]:
        found, start = [], len(self.columns.sender)
        for part in self.gains:
            shape = (part.channels.shape[1], len(part.node))
            stop = start + shape[0] * shape[1]
            found.append(getattr(part, what)(v[start:stop].reshape(shape)).ravel())
            start = stop
        return found
