"""A tolerance estimated from recorded data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tolnet.model.ambiguity import Ambiguity, Convention, gamma_per

DataMethod = Literal["divergence", "likelihood"]


@dataclass(frozen=True)
class ToleranceEstimate:
    """How far recorded data stand from the nominal model; everything on the gamma scale.

    `tolerance` is `observed - bias`, or 0 where that is negative: then the data cannot be told from the nominal
    model.
    `interval` holds `level` of the bootstrap's mass around it, cut off at 0 likewise.
    """

    tolerance: float
    interval: tuple[float, float]
    level: float
    observed: float
    """The divergence of the fitted transition density from the nominal one, as it came out."""
    bias: float
    """What a nominal record of this length shows on average."""
    steps: int
    """Transitions in the record."""
    resamples: int
    method: DataMethod

    def ambiguity(self, convention: Convention = "gamma") -> Ambiguity:
        """The estimate as the radius of an ambiguity set."""
        return Ambiguity(self.tolerance / gamma_per(convention), convention)
