"""What a Monte Carlo study of one filter found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.model.history import FilterKind
from tolnet.model.results import _ReadOnly
from tolnet.model.status import Status


@dataclass(frozen=True, eq=False, repr=False)
class Simulation(_ReadOnly):
    """Errors of one filter on sampled trajectories, beside what the covariances predict.

    Shapes: T + 1 instants 0..T, K = N filters or 1 for a centralised one. Units: those of the state squared. Where
    `status` is not `ok` or `oscillates` nothing was run: the numbers are NaN and `reason` says why.
    """

    kind: FilterKind
    node_mse: Float[ndarray, "T1 K"]
    """Mean of |x - x^_k|^2 over the runs."""
    standard_error: Float[ndarray, " T1"]
    """Of `mse`, from the spread between runs."""
    node_bound: Float[ndarray, "T1 K"]
    """The MSD that the error covariances predict, eq. (40)."""
    node_consistency: Float[ndarray, "T1 K"]
    """Share of runs in which the error lies in the 95 % ellipsoid of the filter's own V_k."""
    diverged: int
    """Runs whose errors left the range of doubles."""
    runs: int
    steps: int
    seed: int
    status: Status
    reason: str

    @property
    def mse(self) -> Float[ndarray, " T1"]:
        """Mean over runs and nodes."""
        return self.node_mse.mean(axis=1)

    @property
    def bound(self) -> Float[ndarray, " T1"]:
        """Predicted mean over the nodes."""
        return self.node_bound.mean(axis=1)

    @property
    def consistency(self) -> Float[ndarray, " T1"]:
        """Mean over the nodes of `node_consistency`."""
        return self.node_consistency.mean(axis=1)

    @property
    def interval(self) -> Float[ndarray, "T1 2"]:
        """95 % confidence interval of `mse`, by the normal law."""
        half = 1.959963984540054 * self.standard_error
        return np.stack([self.mse - half, self.mse + half], axis=1)

    def __repr__(self) -> str:
        return f"<Simulation {self.kind.name}: {self.runs} runs of {self.steps} steps, MSE {self.mse[-1]:.6g}>"
