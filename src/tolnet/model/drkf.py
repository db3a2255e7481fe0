"""What the filter over corrupted channels settles on, and its way there; none of it needs data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.model.corrupted import CorruptedNetwork
from tolnet.model.results import _ReadOnly
from tolnet.model.status import Status

Channel = Literal["worst", "clean", "best"]
CHANNELS: tuple[str, ...] = get_args(Channel)
"""The matrix noise on every link: at its upper bound, none, or at its lower bound. P grows with it.

`best` is also what holds where no matrices are sent at all, and every node takes those of its neighbours from a
table: then the bound of the matrix noise is not needed, and P + W is what is known of a received estimate.
"""
SIGNS = {"worst": 1.0, "clean": 0.0, "best": -1.0}
"""The matrix noise as a multiple of its bound."""


@dataclass(frozen=True, eq=False, repr=False)
class DrkfSteadyState(_ReadOnly):
    """The periodic solution of Algorithm 1's covariance recursion, one member a phase t of the period.

    It attracts the recursion from every P_0 > 0. Where `status` is not `ok` there is no answer: the numbers are NaN.
    Shapes: T phases, N nodes, M = sum p_i outputs. Units: those of the state squared.
    """

    network: CorruptedNetwork
    channel: Channel
    P_bar: Float[ndarray, "T N n n"]
    """Predicted, at instants k = t mod T."""
    P_tilde: Float[ndarray, "T N n n"]
    """Updated with the node's own measurement: what it sends."""
    P: Float[ndarray, "T N n n"]
    """Fused."""
    K: Float[ndarray, "T M n"]
    """Gains K_i, transposed and packed like C."""
    residual: float
    """Largest relative change of P over one more period, in the Loewner order."""
    error: float
    """e so that the true solution lies between P / (1 + e) and (1 + e) P in exact arithmetic."""
    iterations: int
    """Periods that were followed."""
    status: Status
    reason: str

    @property
    def trace(self) -> Float[ndarray, "T N"]:
        """tr P of every node at every phase."""
        return np.trace(self.P, axis1=-2, axis2=-1)

    @property
    def P_check(self) -> Float[ndarray, "T E n n"]:
        """What a node makes of what it receives: P~_j with the noise realised and the bounds added."""
        network, factor = self.network, 1 + SIGNS[self.channel]
        bounds = [network.W_bar(t) + factor * network.D_bar(t) for t in range(len(self.P))]
        return self.P_tilde[:, network.pairs[:, 1]] + np.stack(bounds)

    @property
    def weights(self) -> Float[ndarray, "T E n n"]:
        """W_ij = a_ij P_i Pcheck_ij^-1, eq. (5), one a pair of `network.pairs`; those of a node sum to I."""
        a = self.network.fusion.data[:, None, None]
        return a * self.P[:, self.network.pairs[:, 0]] @ np.linalg.inv(self.P_check)

    @property
    def worst(self) -> float:
        """The largest eigenvalue of any P: the bound on the error variance in any direction at any node."""
        return float(np.linalg.eigvalsh(self.P).max()) if np.isfinite(self.P).all() else float("nan")

    def gain(self, i: int, t: int = 0) -> Float[ndarray, "n p"]:
        """K_i of one node at phase t."""
        rows = self.network.rows
        return self.K[t, rows[i] : rows[i + 1]].T

    def __repr__(self) -> str:
        return f"<DrkfSteadyState ({self.channel} channel): {self.status}, mean tr P {self.trace.mean():.6g}>"


@dataclass(frozen=True, eq=False, repr=False)
class DrkfHistory(_ReadOnly):
    """Algorithm 1's covariances and gains from P_0 on, for instants k = 0..H; instant 0 has no gain (zeros)."""

    network: CorruptedNetwork
    channel: Channel
    P: Float[ndarray, "H1 N n n"]
    K: Float[ndarray, "H1 M n"]
    Pi: Float[ndarray, "H1 n n"]
    """Second moments of the state."""

    @property
    def trace(self) -> Float[ndarray, "H1 N"]:
        """tr P of every node at every instant."""
        return np.trace(self.P, axis1=-2, axis2=-1)

    def __repr__(self) -> str:
        return (
            f"<DrkfHistory ({self.channel} channel): {len(self.P) - 1} steps, mean tr P {self.trace[-1].mean():.6g}>"
        )
