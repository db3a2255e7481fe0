"""The mean square deviation as something to be minimised: of the network, of its worst node, over scenarios."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.curvature import Curvature
from tolnet.analysis.msd_gradient import Errors, NetworkErrors

SHARPNESS = (8.0, 32.0, 128.0, 512.0)
"""A largest value is approached by the p-norm with these exponents, each search starting where the last one ended."""


@dataclass(frozen=True, eq=False)
class Criterion:
    """One number from MSD_k in one or several scenarios.

    `mean`: sum_k a_k MSD_k, the largest over the scenarios. `worst`: the largest MSD_k of all.
    """

    kind: Literal["mean", "worst"]
    a: Float[ndarray, " N"]

    def __call__(self, msd: Float[ndarray, "S N"]) -> float:
        """What is reported."""
        return float((msd if self.kind == "worst" else msd @ self.a).max())

    def smooth(self, msd: Float[ndarray, "S N"], p: float) -> tuple[float, Float[ndarray, "S N"]]:
        """The p-norm in place of the maximum, at most M^(1/p) times larger for M values, and its derivatives."""
        values = msd if self.kind == "worst" else (msd @ self.a)[:, None]
        largest = float(values.max())
        if values.size == 1 or not np.isfinite(largest):
            return largest, np.broadcast_to(self.a, msd.shape).copy()
        relative = (values / largest) ** p
        total = float(relative.sum()) ** (1 / p)
        slope = (values / largest) ** (p - 1) * total ** (1 - p)
        return largest * total, slope if self.kind == "worst" else slope * self.a


class _At(NamedTuple):
    errors: Sequence[Errors]
    slope: Float[ndarray, "S N"]


@dataclass(frozen=True, eq=False)
class MsdObjective:
    """The criterion at W (and gains), with its gradient: an `Objective` for the quasi-Newton method."""

    scenarios: Sequence[NetworkErrors]
    criterion: Criterion
    sharpness: float = SHARPNESS[0]
    gains: bool = False
    sent: float = 0.0
    """How much the mean of tr Psi_kk, the errors of what is sent, counts beside the criterion. Without it, gains have
    no minimum: a node that nobody weighs much may send ever larger ones."""

    @property
    def plain(self) -> bool:
        """Whether what is minimised is the criterion itself."""
        return self.sent == 0 and self.criterion.kind == "mean" and len(self.scenarios) == 1

    @property
    def stages(self) -> Sequence[MsdObjective]:
        """The same ever closer to the maximum that it stands for; itself where there is none."""
        smooth = self.criterion.kind == "mean" and len(self.scenarios) == 1
        return [self] if smooth else [replace(self, sharpness=p) for p in SHARPNESS]

    def value(self, z: Float[ndarray, " z"]) -> tuple[float, Any]:
        """The smoothed criterion."""
        errors = []
        for scenario in self.scenarios:
            errors.append(scenario.solve(z))
            if not np.isfinite(errors[-1].node_msd).all():
                return np.inf, None
        value, slope = self.criterion.smooth(np.array([each.node_msd for each in errors]), self.sharpness)
        if self.sent:
            value += self.sent * float(sum(s.sent_msd(e) @ self.criterion.a for s, e in self._pairs(errors)))
        return value, _At(errors, slope)

    def _pairs(self, errors: Sequence[Errors]) -> Iterator[tuple[NetworkErrors, Errors]]:
        return zip(self.scenarios, errors, strict=True)

    def gradient(self, at: _At) -> tuple[Float[ndarray, " z"], Curvature]:
        """By one adjoint equation a scenario."""
        total, curvature = None, None
        for scenario, errors, a in zip(self.scenarios, at.errors, at.slope, strict=True):
            g, B = scenario.gradient(errors, a, self.sent * self.criterion.a if self.sent else None, gains=self.gains)
            total = g if total is None else total + g
            curvature = B if curvature is None else curvature + B
        assert total is not None
        assert curvature is not None
        return total, curvature

    def exact(self, z: Float[ndarray, " z"]) -> float:
        """The criterion itself."""
        msd = np.array([scenario.solve(z).node_msd for scenario in self.scenarios])
        return self.criterion(msd) if np.isfinite(msd).all() else np.inf
