"""What every objective starts from: the network, its table, the admissible W, the baseline and the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.analysis import error_dynamics, least_favourable_model, solve_lyapunov
from tolnet.analysis.curvature import Columns, columns_of
from tolnet.design.diffusion import diffusion_matrix
from tolnet.design.weights.admissible import Admissible, Constraints
from tolnet.model import LeastFavourableModel, Performance, SensorNetwork, ToleranceTable


@dataclass(frozen=True, eq=False)
class Setting:
    """What every objective starts from."""

    network: SensorNetwork
    table: ToleranceTable
    constraints: Constraints
    among: Admissible
    baseline: sparse.csr_array
    rule: str
    model: LeastFavourableModel

    @classmethod
    def of(cls, network: SensorNetwork, table: ToleranceTable, constraints: Constraints) -> Setting:
        """The baseline is the network's own W, or its rule."""
        own = network.diffusion
        return cls(
            network=network,
            table=table,
            constraints=constraints,
            among=Admissible.of(columns_of(network.adjacency), constraints),
            baseline=diffusion_matrix(network, table=table),
            rule=own if isinstance(own, str) else "weights",
            model=least_favourable_model(network, table.central),
        )

    def performance(self, W: sparse.csr_array, table: ToleranceTable | None = None) -> Performance:
        """Of a table's filters under W; what a link weighed that its network lacks goes to w_kk."""
        if table is None or table is self.table:
            return solve_lyapunov(error_dynamics(self.network, self.table.local, W, self.model))
        model = least_favourable_model(table.network, table.central)
        return solve_lyapunov(error_dynamics(table.network, table.local, folded(W, table.network), model))

    @property
    def bound(self) -> float:
        """MSD of the centralised robust filter; NaN where its model does not exist."""
        return float(np.trace(self.model.error_covariance))

    @property
    def words(self) -> dict[str, str]:
        """The constraints, as far as they ask for something."""
        asked, own = {}, np.asarray(self.constraints.own_weight)
        if self.constraints.symmetric:
            asked["symmetric"] = "yes"
        if own.any():
            asked["own_weight"] = f"at least {own.min():g}" if own.min() == own.max() else "at least as given"
        if self.constraints.max_neighbours is not None:
            asked["max_neighbours"] = str(self.constraints.max_neighbours)
        return asked


def folded(W: sparse.csr_array, network: SensorNetwork) -> sparse.csr_array:
    """W on a network that lacks some of its links: what a lost link weighed goes to w_kk."""
    kept = sparse.csr_array(W.multiply(network.adjacency.astype(float)))
    lost = np.asarray(W.sum(axis=0)) - np.asarray(kept.sum(axis=0))
    return sparse.csr_array(kept + sparse.diags_array(lost))


def links_of(W: sparse.csr_array, columns: Columns) -> Float[ndarray, " L"]:
    return np.asarray(W[columns.sender, columns.hearer], dtype=float).ravel()


def local_loops(table: ToleranceTable) -> Float[ndarray, "N n n"]:
    """M_k = A (I + V_k S_k)^-1."""
    eye = np.eye(table.network.n)
    return table.network.A @ np.linalg.solve(
        eye + table.local.V @ table.local.S, np.broadcast_to(eye, table.local.V.shape)
    )
