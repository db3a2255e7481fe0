"""Designed diffusion weights: W, what it is worth, what bounds it, and what proves it stable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.model.results import ToleranceTable, _ReadOnly
from tolnet.model.status import Status

OBJECTIVES = {
    "msd": "mean square deviation of the network, or of chosen nodes, under the least favourable model",
    "worst": "mean square deviation of the worst node",
    "robust": "the largest mean square deviation over several scenarios",
    "decay": "certified decay rate of the errors, a step",
    "mixing": "|W - 11'/N|: how far one mixing step is from averaging",
}
"""What W may be designed for."""


@dataclass(frozen=True, eq=False)
class GainTable(_ReadOnly):
    """Gains for every node, each on its own neighbours, packed as the gains of a tolerance table are.

    The entries of node k are the i from `offsets[k]` to `offsets[k + 1]`, one for each node l that it hears, itself
    included, in rising order; the columns of G_k that weigh y_l - C_l x_k are the rows `columns[i]:columns[i + 1]` of
    `gains`, which holds G_k' for one node after the other.
    """

    offsets: Int[ndarray, " N1"]
    neighbours: Int[ndarray, " L"]
    columns: Int[ndarray, " L1"]
    gains: Float[ndarray, "M n"]

    def gain(self, k: int) -> Float[ndarray, "n m"]:
        """G_k, columns by neighbour."""
        first, last = self.columns[self.offsets[[k, k + 1]]]
        return self.gains[first:last].T


@dataclass(frozen=True, eq=False)
class DecayCertificate(_ReadOnly):
    """X_k with X_k - sigma_k / r^2 sum_l |w_lk| M_l X_l M_l' > 0 for all k: errors decay like r^t.

    A candidate in floating point, for `tolnet certify` to prove; sigma_k = sum_l |w_lk|.
    """

    X: Float[ndarray, "N n n"]
    rate: float
    """r."""
    loops: Float[ndarray, "N n n"]
    """M_k, of the filters before diffusion."""
    margin: float
    """The least eigenvalue, over all k, of the difference seen from X_k: I - X_k^-1/2 (...) X_k^-1/2; recomputed."""


@dataclass(frozen=True, eq=False)
class Elsewhere:
    """The same weights (and gains) under the least favourable model of another tolerance. Gamma scale."""

    name: str
    tolerance: float
    baseline: float
    """MSD of the baseline; NaN where it has none."""
    msd: float
    bound: float
    reason: str = ""
    """Why there are no numbers."""


@dataclass(frozen=True, eq=False)
class Start:
    """One start of the search: the value there, and where the search from it ended."""

    name: str
    value: float
    found: float
    """NaN where the search never went on from there."""


@dataclass(frozen=True, eq=False, repr=False)
class Diffusion(_ReadOnly):
    """Weights W that were designed for one objective, eq. (11), and everything that is known of them.

    `value`, `baseline` and `bound` are in the units of the objective: no admissible W is better than `bound`. MSD is
    under the least favourable model of the table's tolerance. NaN stands for what does not exist, or is not known:
    nothing bounds the best decay rate. `status` is that of the performance under W.
    """

    table: ToleranceTable
    objective: str
    W: sparse.csr_array
    gains: GainTable | None
    value: float
    baseline: float
    """Of `baseline_rule`."""
    bound: float
    """NaN where none is known."""
    baseline_rule: str
    node_msd: Float[ndarray, " N"]
    baseline_node_msd: Float[ndarray, " N"]
    msd_bound: float
    """MSD of the centralised robust filter: no estimator does better under its model."""
    network_radius: float
    """Spectral radius of the block of F that the filters and W make, the largest over scenarios."""
    least_favourable_radius: float
    """The same of the block of the centre's error under its least favourable model, which no W changes."""
    baseline_network_radius: float
    """Of `baseline_rule`."""
    status: Status
    reason: str
    starts: Sequence[Start]
    best_start: str
    history: Float[ndarray, " steps"]
    """The objective as it fell, on the way to this W."""
    change: float
    """Relative change of the value by the last step, which makes W exactly admissible."""
    residual: float
    """Relative residual of what the value was computed from, recomputed."""
    evaluations: int
    converged: bool
    interrupted: bool
    certificate: DecayCertificate | None
    elsewhere: Sequence[Elsewhere]
    about: Mapping[str, str]
    """The constraints, in words."""

    @property
    def gap_closed(self) -> float:
        """(baseline - value) / (baseline - bound): 0 is the rule, 1 is the bound. NaN where either is missing."""
        room = self.baseline - self.bound
        return (self.baseline - self.value) / room if np.isfinite(room) and room > 0 else float("nan")

    @property
    def spectral_radius(self) -> float:
        """Of F: of the slower of its two blocks."""
        return float(np.maximum(self.network_radius, self.least_favourable_radius))

    @property
    def msd(self) -> float:
        """Mean over the nodes, eq. (40)."""
        return float(self.node_msd.mean())

    @property
    def baseline_msd(self) -> float:
        """The same under the baseline."""
        return float(self.baseline_node_msd.mean())

    def __repr__(self) -> str:
        return f"<Diffusion {self.objective}: {self.value:.6g} ({self.baseline_rule} {self.baseline:.6g})>"
