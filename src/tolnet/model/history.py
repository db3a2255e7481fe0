"""How filters fare over time: the mean square deviation from one instant to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.model.results import _ReadOnly
from tolnet.model.status import Status


@dataclass(frozen=True)
class FilterKind:
    """One of the six filters of the literature: who computes it, against which ball, what the centre must send."""

    name: str
    centralised: bool
    ball: str
    """`none` (plain Kalman), `c`, `c_k,t` (the local tolerance of every instant) or `c_k` (its steady state)."""
    messages: str
    """What the centre sends to a node, as the published table counts it."""
    meaning: str


FILTERS: dict[str, FilterKind] = {
    kind.name: kind
    for kind in (
        FilterKind("KFC", True, "none", "n/a", "centralised Kalman filter"),
        FilterKind("RKFC", True, "c", "n/a", "centralised robust Kalman filter, eq. (4)"),
        FilterKind("KFD", False, "none", "none", "diffusion Kalman filter"),
        FilterKind("RKFDU", False, "c", "one", "diffusion robust filter, the same c at every node (Algorithm 1)"),
        FilterKind("RKFDNU", False, "c_k,t", "every step", "diffusion robust filter, c_k,t anew (Algorithm 2)"),
        FilterKind("RKFDNU2", False, "c_k", "one", "diffusion robust filter, steady c_k (Algorithm 3)"),
    )
}
"""The filters of the literature by name, in the order of its figures."""


@dataclass(frozen=True, eq=False, repr=False)
class FilterHistory(_ReadOnly):
    """One filter under the least favourable model of a finite horizon T, eqs. (34)-(40).

    Shapes: (T + 1, K) for deviations at t = 0..T, (T, K) for what drives the step from t to t + 1; K = N, or 1 for
    a centralised filter. Where `status` is not `ok` there are no numbers (NaN) and `reason` says why. Gamma scale;
    units those of the state squared.
    """

    kind: FilterKind
    node_msd: Float[ndarray, "T1 K"]
    theta: Float[ndarray, "T K"]
    tolerance: Float[ndarray, "T K"]
    status: Status
    reason: str

    @property
    def exists(self) -> bool:
        """Whether there are numbers."""
        return bool(np.isfinite(self.tolerance).all())

    @property
    def msd(self) -> Float[ndarray, " T1"]:
        """Mean over the nodes, eq. (40)."""
        return self.node_msd.mean(axis=1)

    @property
    def msd_db(self) -> Float[ndarray, " T1"]:
        """10 log10 of the mean."""
        with np.errstate(divide="ignore"):  # minus infinity for nothing
            return 10 * np.log10(self.msd)

    def __repr__(self) -> str:
        return f"<FilterHistory {self.kind.name}, {len(self.theta)} steps: ends at {self.msd_db[-1]:.4f} dB>"
