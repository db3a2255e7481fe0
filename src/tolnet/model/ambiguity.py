"""The ambiguity set: how wrong the model may be, and in which unit that is said."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from tolnet.model._checks import Complaints, number, shown

Convention = Literal["gamma", "nats"]
"""`gamma`: tolerances are values of gamma(P, theta) as printed in eq. (4). `nats`: they are D_KL = gamma / 2."""

CONVENTIONS: tuple[str, ...] = get_args(Convention)


SMALLEST, LARGEST = 1e-200, 1e10
"""Tolerances other than 0: beyond, theta^2 underflows, or V outgrows P by more than doubles hold."""


@dataclass(frozen=True)
class Ambiguity:
    """A ball of radius `tolerance` around the nominal transition density, eq. (2).

    `tau` selects the member of the tau-divergence family (docs/mathematics.md, section 5); 0 is Kullback-Leibler.
    Raises InputError for a tolerance that is negative, no number, or neither 0 nor between `SMALLEST` and `LARGEST`,
    an unknown convention, tau outside [0, 1], and `nats` together with tau != 0, where it has no meaning.
    """

    tolerance: float
    convention: Convention = "gamma"
    tau: float = 0.0

    def __post_init__(self) -> None:
        complaints = Complaints()
        meant = "a finite number >= 0"
        tolerance = number(self.tolerance, "ambiguity.tolerance", meant, complaints)
        if tolerance is not None and tolerance < 0:
            complaints.add("ambiguity.tolerance", f"is {shown(self.tolerance)}; {meant} was expected")
        elif tolerance and not SMALLEST <= tolerance <= LARGEST:
            meant = f"0, or a number from {SMALLEST:g} to {LARGEST:g}"
            complaints.add("ambiguity.tolerance", f"is {shown(self.tolerance)}; {meant}, was expected")
        if self.convention not in CONVENTIONS:
            complaints.add("ambiguity.convention", f"is {shown(self.convention)}; 'gamma' or 'nats' was expected")
        meant = "a number from 0 to 1"
        tau = number(self.tau, "ambiguity.tau", meant, complaints)
        if tau is not None and not 0 <= tau <= 1:
            complaints.add("ambiguity.tau", f"is {shown(self.tau)}; {meant} was expected")
        elif tau and self.convention == "nats":
            complaints.add("ambiguity.convention", "is 'nats', which only tau = 0 has; use 'gamma'")
        complaints.raise_if_any()
        object.__setattr__(self, "tolerance", tolerance)
        object.__setattr__(self, "tau", tau)

    @property
    def gamma(self) -> float:
        """The tolerance on the scale of gamma, in which everything is computed."""
        return self.tolerance * gamma_per(self.convention)


def gamma_per(convention: Convention) -> float:
    """How much gamma one unit of `convention` is: 1 for gamma, 2 for nats (gamma = 2 D_KL)."""
    return 2.0 if convention == "nats" else 1.0
