"""What a Monte Carlo study of one filter over corrupted channels found."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.model.results import _ReadOnly
from tolnet.model.status import Status

_NORMAL = 1.959963984540054
_GROWS = 1.01


@dataclass(frozen=True, eq=False, repr=False)
class CorruptedSimulation(_ReadOnly):
    """Errors of one filter in many runs, beside the covariance bounds that it believed in.

    Shapes: T + 1 instants 0..T, K = N nodes or 1 for a centralised filter. Units: those of the state squared for
    errors and bounds. Runs that diverged are counted and in no other number. A filter without bounds has NaN there.
    """

    name: str
    meaning: str
    centralised: bool
    node_error: Float[ndarray, "T1 K n n"]
    """Mean of (x^ - x)(x^ - x)' over the runs."""
    node_P: Float[ndarray, "T1 K n n"]
    """Mean of the filter's own P over the runs; P itself where all runs share one path of matrix noise."""
    node_consistency: Float[ndarray, "T1 K"]
    """Share of runs in which the error lies in the 95 % ellipsoid of the filter's own P."""
    node_nees: Float[ndarray, "T1 K"]
    """Mean of e' P^-1 e / n: 1 for an exact covariance, less for a bound; infinite where some P had lost its sign."""
    node_spread: Float[ndarray, "T1 K"]
    """Root of the mean of (e' P^-1 e)^2, over that of the number of runs."""
    standard_error: Float[ndarray, " T1"]
    """Of `mse`, from the spread between runs."""
    growth: float
    """Factor a step by which the typical squared error (geometric mean) grew in the second half; 1 if it did not."""
    diverged: int
    """Runs whose errors left the doubles, or became a million times the state that they are of."""
    solves: int
    """Fusion problems that were solved."""
    fallbacks: int
    """How many of them Algorithm 1 had to answer."""
    beyond_bounds: tuple[str, ...]
    """What was simulated larger than the filters believe it can be."""
    shared: bool
    """Whether all runs met one path of noise on matrices, so that P bounds each conditional covariance."""
    runs: int
    steps: int
    seed: int

    @cached_property
    def node_mse(self) -> Float[ndarray, "T1 K"]:
        """Mean of |x^ - x|^2."""
        return np.asarray(np.trace(self.node_error, axis1=2, axis2=3))

    @cached_property
    def node_bound(self) -> Float[ndarray, "T1 K"]:
        """Mean of tr P."""
        return np.asarray(np.trace(self.node_P, axis1=2, axis2=3))

    @property
    def mse(self) -> Float[ndarray, " T1"]:
        """Mean over runs and nodes."""
        return self.node_mse.mean(axis=1)

    @property
    def bound(self) -> Float[ndarray, " T1"]:
        """Mean over the nodes."""
        return self.node_bound.mean(axis=1)

    @property
    def consistency(self) -> Float[ndarray, " T1"]:
        """Mean over the nodes."""
        return self.node_consistency.mean(axis=1)

    @property
    def nees(self) -> Float[ndarray, " T1"]:
        """Mean over the nodes."""
        return self.node_nees.mean(axis=1)

    @property
    def interval(self) -> Float[ndarray, "T1 2"]:
        """95 % confidence interval of `mse`, by the normal law."""
        half = _NORMAL * self.standard_error
        return np.stack([self.mse - half, self.mse + half], axis=1)

    @cached_property
    def excess(self) -> Float[ndarray, "T1 K"]:
        """The largest eigenvalue of P^-1/2 (sample covariance) P^-1/2: above 1 by more than `margin`, P is no bound.

        NaN where there is no positive definite P.
        """
        found = np.full(self.node_mse.shape, np.nan)
        usable = np.asarray(np.isfinite(self.node_P + self.node_error).all(axis=(2, 3)))
        usable[usable] = np.linalg.eigvalsh(self.node_P[usable])[:, 0] > 0
        if usable.any():
            root = np.linalg.inv(np.linalg.cholesky(self.node_P[usable]))
            found[usable] = np.linalg.eigvalsh(root @ self.node_error[usable] @ root.mT)[:, -1]
        return found

    def margin(self, doubt: float = 1e-3) -> Float[ndarray, "T1 K"]:
        """How far chance may lift `excess` above 1, with probability `doubt` at most over all nodes and instants.

        z sqrt(E d^2 / runs), d = e' P^-1 e, z the normal quantile of doubt over the number of nodes and instants: no
        direction's square varies more than d does. E d^2 is measured, so that heavy tails count.
        """
        from scipy.special import ndtri

        return -float(ndtri(doubt / self.node_mse.size)) * self.node_spread

    @property
    def overconfident(self) -> bool:
        """Whether some sample covariance exceeds P by more than chance allows, or some P was no covariance at all."""
        with np.errstate(invalid="ignore"):
            return bool((self.excess > 1 + self.margin()).any() or np.isinf(self.node_nees).any())

    @property
    def grows(self) -> bool:
        """Whether the error doubles at least every seventy steps, and shows no sign of an end."""
        return self.growth > _GROWS

    @property
    def status(self) -> Status:
        """`ok`, or `diverges` where runs did."""
        return Status.DIVERGES if self.diverged else Status.OK

    @property
    def reason(self) -> str:
        """Why not `ok`."""
        if not self.diverged:
            return ""
        return (
            f"{self.diverged:,} of {self.runs:,} runs diverged (errors beyond a million times the state), and are not"
            " among the numbers"
        )

    def __repr__(self) -> str:
        return f"<CorruptedSimulation {self.name}: {self.runs} runs of {self.steps} steps, MSE {self.mse[-1]:.6g}>"
