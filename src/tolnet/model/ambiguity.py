"""The ambiguity set: how wrong the model may be, and in which unit that is said."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from tolnet.model.errors import Complaint, InputError

Convention = Literal["gamma", "nats"]
"""`gamma`: tolerances are values of gamma(P, theta) as printed in eq. (4). `nats`: they are D_KL = gamma / 2."""

CONVENTIONS: tuple[str, ...] = get_args(Convention)


@dataclass(frozen=True)
class Ambiguity:
    """A ball of radius `tolerance` around the nominal transition density, eq. (2).

    `tau` selects the member of the tau-divergence family (docs/mathematics.md, section 5); 0 is Kullback-Leibler.
    Raises InputError for a tolerance that is negative, infinite or no number, an unknown convention,
    tau outside [0, 1], and `nats` together with tau != 0, where it has no meaning.
    """

    tolerance: float
    convention: Convention = "gamma"
    tau: float = 0.0

    def __post_init__(self) -> None:
        complaints = list(self._complaints())
        if complaints:
            raise InputError(complaints)

    def _complaints(self):
        if not (math.isfinite(self.tolerance) and self.tolerance >= 0):
            yield Complaint("ambiguity.tolerance", f"is {self.tolerance}; a finite number >= 0 was expected")
        if self.convention not in CONVENTIONS:
            yield Complaint("ambiguity.convention", f"is {self.convention!r}; 'gamma' or 'nats' was expected")
        if not 0 <= self.tau <= 1:
            yield Complaint("ambiguity.tau", f"is {self.tau}; a number from 0 to 1 was expected")
        elif self.tau != 0 and self.convention == "nats":
            yield Complaint("ambiguity.convention", "is 'nats', which only tau = 0 has; use 'gamma'")

    @property
    def gamma(self) -> float:
        """The tolerance on the scale of gamma, in which everything is computed."""
        return self.tolerance * gamma_per(self.convention)


def gamma_per(convention: Convention) -> float:
    """How much gamma one unit of `convention` is: 1 for gamma, 2 for nats (gamma = 2 D_KL)."""
    return 2.0 if convention == "nats" else 1.0
