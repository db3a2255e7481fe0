"""The gains and weights that are deployed, packed one after the other for any number of nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.design.diffusion import diffusion_matrix
from tolnet.model import SensorNetwork, SteadyState, ToleranceTable

_COLUMNS_AT_A_TIME = 200_000


@dataclass(frozen=True, eq=False)
class Deployment:
    """What every node is given beside c_k, theta_k, P_k and V_k; eqs. (44)-(45).

    The entries of node k are the i from `offsets[k]` to `offsets[k + 1]`, one for each node l that it hears, itself
    included, in rising order: `neighbours[i]` is l, `weights[i]` is w_lk, and the columns of G_k that weigh
    y_l - C_l x_k are the rows `columns[i]:columns[i + 1]` of `gains`, which holds G_k' for one node after the other.
    """

    offsets: Int[ndarray, " N1"]
    neighbours: Int[ndarray, " L"]
    weights: Float[ndarray, " L"]
    columns: Int[ndarray, " L1"]
    gains: Float[ndarray, "M n"]

    @classmethod
    def of(cls, table: ToleranceTable, W: sparse.csr_array | None = None) -> Deployment:
        """Pack G_k = A (V_k^-1 + S_k)^-1 C_loc' R_loc^-1 and column k of W for every node; W None: the own one."""
        network = table.network
        heard = network.adjacency.tocsc()
        heard.sort_indices()
        offsets, neighbours = heard.indptr.astype(np.int64), heard.indices.astype(np.int64)
        columns = np.concatenate([[0], np.cumsum(np.diff(network.rows)[neighbours])])
        W = diffusion_matrix(network, table=table) if W is None else W
        hearing = np.repeat(np.arange(network.N), np.diff(offsets))
        weights = np.asarray(W[neighbours, hearing]).ravel() if neighbours.size else np.empty(0)
        return cls(offsets, neighbours, weights, columns, _gain_columns(table, offsets, neighbours, columns))

    def rounded(self, precision: type[np.floating]) -> Deployment:
        """The same with gains and weights rounded to a precision that a device has."""
        weights, gains = (X.astype(precision).astype(float) for X in (self.weights, self.gains))
        return replace(self, weights=weights, gains=gains)

    def gain(self, k: int) -> Float[ndarray, "n m"]:
        """G_k, columns by neighbour."""
        first, last = self.columns[self.offsets[[k, k + 1]]]
        return self.gains[first:last].T


def central_gain_columns(network: SensorNetwork, central: SteadyState) -> Float[ndarray, "M n"]:
    """The columns of the centre's gain G = A (V^-1 + S_tot)^-1 C' R^-1 as rows, sensor by sensor, eq. (7)."""
    return central.gains[0].T if central.gains else _noise_weighted(network) @ (network.A @ central.filtered).T


def _gain_columns(
    table: ToleranceTable, offsets: Int[ndarray, " N1"], neighbours: Int[ndarray, " L"], columns: Int[ndarray, " L1"]
) -> Float[ndarray, "M n"]:
    """The columns of every G_k as rows: (A Z_k) y for each row y of R_l^-1 C_l, Z_k = (V_k^-1 + S_k)^-1.

    Those of filters that were solved in extended precision come from there.
    """
    network = table.network
    Y = _noise_weighted(network)
    first = columns[offsets]  # of each node
    gains = np.empty((int(columns[-1]), network.n))
    k = 0
    while k < network.N:  # stretches of nodes, so that the stack A Z_k repeated for each column stays small
        end = max(k + 1, int(np.searchsorted(first, first[k] + _COLUMNS_AT_A_TIME, side="right")) - 1)
        AZ = network.A @ table.local.filtered[k:end]
        links = slice(offsets[k], offsets[end])
        widths = np.diff(columns)[links]
        within = np.arange(widths.sum()) - np.repeat(np.cumsum(widths) - widths, widths)
        rows = np.repeat(network.rows[neighbours[links]], widths) + within
        node = np.repeat(np.arange(end - k), np.diff(first[k : end + 1]))
        gains[first[k] : first[end]] = np.einsum("mij,mj->mi", AZ[node], Y[rows])
        k = end
    for k, G in table.local.gains.items():
        gains[first[k] : first[k + 1]] = G.T
    return gains


def _noise_weighted(network: SensorNetwork) -> Float[ndarray, "M n"]:
    """R_l^-1 C_l of every sensor, one under the other."""
    Y = np.empty_like(network.C)
    for nodes, C, R in network.sensors.groups():
        rows = network.rows[nodes, None] + np.arange(C.shape[1])
        Y[rows] = np.linalg.solve(R, C)
    return Y
