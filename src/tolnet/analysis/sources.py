"""Where a filter's Q and S come from before they were rounded: B, and the rows C_l, R_l that it hears."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis import extended
from tolnet.analysis.extended import Extended, Matrix, Plant
from tolnet.model import SensorNetwork


@dataclass(frozen=True, eq=False)
class Sources:
    """A stack of filters on one plant, each with its information, in extended precision on request."""

    A: Float[ndarray, "n n"]
    B: Float[ndarray, "n m"] | None
    Q: Float[ndarray, "n n"]
    information: Callable[[int], tuple[Matrix, Matrix | None]]
    """S_k, and C' R^-1 where it is known; called inside `extended.precision()`."""

    @classmethod
    def of_matrices(cls, A: Float[ndarray, "n n"], Q: Float[ndarray, "n n"], S: Float[ndarray, "K n n"]) -> Sources:
        """Taken as they stand."""
        return cls(A, None, Q, lambda k: (extended.matrix(S[k]), None))

    @classmethod
    def of_nodes(cls, network: SensorNetwork) -> Sources:
        """Every node hears its neighbours."""

        def information(k: int) -> tuple[Matrix, Matrix]:
            return extended.information(network.n, [network.sensor(l) for l in network.neighbours(k).tolist()])

        return cls(network.A, network.B, network.Q, information)

    @classmethod
    def of_centre(cls, network: SensorNetwork) -> Sources:
        """The centre hears everybody."""
        return cls(
            network.A,
            network.B,
            network.Q,
            lambda _: extended.information(network.n, [network.sensor(l) for l in range(network.N)]),
        )

    @cached_property
    def _plant(self) -> tuple[Matrix, Matrix]:
        return extended.matrix(self.A), extended.noise_covariance(self.B, self.Q)

    def plant(self, k: int) -> Plant:
        """A, Q and S_k; called inside `extended.precision()`."""
        return Plant(*self._plant, *self.information(k))

    def solve(
        self,
        k: int,
        c: float,
        undriven: bool,
        near: tuple[Float[ndarray, "n n"], float] | None = None,
        *,
        only_near: bool = False,
    ) -> Extended:
        """The steady state of filter k at tolerance c, as `extended.solve_extended`."""
        if near is not None and not (np.isfinite(near[0]).all() and np.isfinite(near[1]) and near[0].any()):
            near = None
        with extended.precision():
            return extended.solve_extended(self.plant(k), c, near=near, undriven=undriven, only_near=only_near)[0]

    def covariances(self, k: int, c: float, near: tuple[Float[ndarray, "n n"], float]) -> tuple[Matrix, Matrix]:
        """P and V of the steady state near a guess (P, theta), before rounding. Raises extended.NoAnswer."""
        with extended.precision():
            return extended.solve_extended(self.plant(k), c, near=near, only_near=True)[1:]
