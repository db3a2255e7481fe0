"""Which W are admissible: on the graph, nonnegative, columns that sum to one, and what else is asked of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import sparse

from tolnet.analysis.curvature import Columns
from tolnet.model import Complaint, InputError, SensorNetwork


@dataclass(frozen=True, eq=False)
class Constraints:
    """What is asked of W beyond eq. (11).

    symmetric: w_lk = w_kl, so that W averages. own_weight: a lower bound on w_kk, one number or one a node.
    max_neighbours: at most so many nodes l with w_lk > 0 in each column, node k itself among them.
    """

    symmetric: bool = False
    own_weight: float | Float[ndarray, " N"] = 0.0
    max_neighbours: int | None = None

    def check(self, network: SensorNetwork) -> None:
        """Raise InputError unless some W on the graph satisfies this, with every complaint."""
        complaints = []
        own = np.asarray(self.own_weight, dtype=float)
        if own.shape not in ((), (network.N,)):
            complaints.append(Complaint("own_weight", f"has the shape {own.shape}; one number or {network.N} needed"))
        elif not (np.isfinite(own) & (own >= 0)).all():
            complaints.append(
                _bad_bound(network, own, ~(np.isfinite(own) & (own >= 0)), "no lower bound on a weight")
            )
        elif (own > 1).any():
            complaints.append(_bad_bound(network, own, own > 1, "no column sums to one beyond 1"))
        if self.max_neighbours is not None and self.max_neighbours < 1:
            message = f"is {self.max_neighbours}; at least 1 was expected, since every node counts itself"
            complaints.append(Complaint("max_neighbours", message))
        if self.symmetric and (network.adjacency != network.adjacency.T).nnz:
            complaints.append(Complaint("symmetric", "needs links that work both ways, and there are one-way links"))
        if self.symmetric and self.max_neighbours is not None:
            complaints.append(Complaint("max_neighbours", "cannot be combined with symmetric weights"))
        if complaints:
            raise InputError(complaints)


def _bad_bound(network: SensorNetwork, own: ndarray, bad: ndarray | np.bool_, why: str) -> Complaint:
    """The first node whose lower bound on w_kk is bad."""
    k = int(np.argmax(np.broadcast_to(bad, network.N)))
    found = float(np.broadcast_to(own, network.N)[k])
    return Complaint("own_weight", f"is {found:g} at node {network.label(k)}: {why}; 0 to 1 was expected")


@dataclass(frozen=True, eq=False)
class Admissible:
    """The set of admissible columns: w >= 0 on some links, w_kk >= `lower`, sums of one."""

    columns: Columns
    lower: Float[ndarray, " N"]
    used: Bool[ndarray, " L"]
    """The links that may carry a weight."""

    @classmethod
    def of(cls, columns: Columns, constraints: Constraints) -> Admissible:
        """All links; the bound on the number of neighbours is left to whoever narrows `used`."""
        lower = np.broadcast_to(np.asarray(constraints.own_weight, dtype=float), columns.nodes).copy()
        return cls(columns, lower, np.ones(len(columns.sender), dtype=bool))

    def narrowed(self, used: Bool[ndarray, " L"]) -> Admissible:
        """The same with fewer links."""
        return Admissible(self.columns, self.lower, used)

    @cached_property
    def _usable(self) -> Bool[ndarray, "N m"]:
        rows = np.zeros(self.columns.present.shape, dtype=bool)
        rows[self.columns.hearer, self.columns.place] = self.used
        return rows

    def project(self, z: Float[ndarray, " z"]) -> Float[ndarray, " z"]:
        """The nearest admissible point; what follows the weights is free.

        Each column on its simplex by sorting: w = max(v - t, 0) with the t that makes it sum to what is left.
        """
        columns = self.columns
        L = len(columns.sender)
        base = np.zeros(L)
        base[columns.own] = self.lower
        V = np.where(self._usable, columns.spread(z[:L] - base), -np.inf)
        V -= V.max(axis=1, keepdims=True)  # t moves along: however large v is, sums of one survive rounding
        falling = -np.sort(-V, axis=1)
        finite = np.isfinite(falling)
        excess = np.cumsum(np.where(finite, falling, 0.0), axis=1) - (1 - self.lower)[:, None]
        count = np.arange(1, V.shape[1] + 1)
        positive = finite & (falling * count > excess)
        last = V.shape[1] - np.argmax(positive[:, ::-1], axis=1)
        last[~positive.any(axis=1)] = 1  # w_kk >= 1 leaves nothing
        threshold = excess[np.arange(len(V)), last - 1] / last
        rows = np.maximum(V - threshold[:, None], 0.0)
        return np.concatenate([columns.gather(rows) + base, z[L:]])

    def weights(self, W: sparse.csr_array | ndarray) -> Float[ndarray, " L"]:
        """The weights of W link by link, made to obey the bounds."""
        return self.project(np.asarray(W[self.columns.sender, self.columns.hearer], dtype=float).ravel())

    def centred(self, v: Float[ndarray, " z"]) -> Float[ndarray, " z"]:
        """Without what no admissible step can feel."""
        L = len(self.columns.sender)
        return np.concatenate([self.columns.centred(v[:L]), v[L:]])


def make_admissible(among: Admissible, w: Float[ndarray, " L"], *, symmetric: bool = False) -> sparse.csr_array:
    """The last step of every design: weights below zero set to zero, columns divided by their sums.

    Symmetric weights are averaged over the two directions of a link, scaled down together where some column leaves
    too little for w_kk, and w_kk is what the others leave: dividing would break the symmetry. Entries outside the
    graph do not exist here. The sums of the doubles that are returned are within rounding of one.
    """
    columns, N = among.columns, among.columns.nodes
    w = np.maximum(w, 0.0)
    W = sparse.csr_array(sparse.coo_array((w, (columns.sender, columns.hearer)), shape=(N, N)))
    if symmetric:
        others = sparse.csr_array((W + W.T) / 2)
        others = sparse.csr_array(others - sparse.diags_array(others.diagonal()))
        crowded = np.asarray(others.sum(axis=0)) > 1 - among.lower
        room = (1 - among.lower)[crowded] / np.asarray(others.sum(axis=0))[crowded]
        others = others * float(np.min(room, initial=1.0))
        W = sparse.csr_array(others + sparse.diags_array(np.maximum(1.0 - np.asarray(others.sum(axis=0)), 0.0)))
    else:
        W = sparse.csr_array(W @ sparse.diags_array(1.0 / np.asarray(W.sum(axis=0))))
    W.sum_duplicates()
    W.eliminate_zeros()
    return W
