"""What was found out about the collective observability of a network with corrupted channels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from tolnet.model.corrupted import CorruptedNetwork
from tolnet.model.results import _ReadOnly

Form = Literal["sharp", "stated", "classical"]
FORMS: tuple[str, ...] = get_args(Form)
"""`sharp`: eq. (11), with the second moment itself. `stated`: eq. (6), with its norm. `classical`: without fading."""


@dataclass(frozen=True)
class LostMode:
    """A mode that does not decay and that no sensor sees in the long run."""

    eigenvalue: complex
    """Of the transition over one period."""
    direction: tuple[float, ...]
    """A unit vector in its eigenspace, the real part of it where it is complex."""
    nodes: tuple[int, ...]
    """The nodes that would see it if they did not fade; none where it is invisible to all."""


@dataclass(frozen=True, eq=False, repr=False)
class RobustObservability(_ReadOnly):
    """Whether sum_i sum_s tau^2 Phi' C' Rt^-1 C Phi >= alpha I over every window of instants, eqs. (6) and (11).

    Every alpha is the least over all windows that were looked at: those inside 0..horizon, or every k = 0, 1, ...
    where `horizon` is None; then the last T starts stand for the limit, one a phase of the period.
    Units: the inverse of those of the state squared.
    """

    network: CorruptedNetwork
    form: Form
    horizon: int | None
    window: int
    """L, instants in a window: the smallest for which the condition holds, unless another was asked for."""
    holds: bool
    alpha: float
    worst_start: int | None
    """The first instant of the worst window; None where that is the limit of large k."""
    weakest_direction: Float[ndarray, " n"]
    """Unit vector along which the worst window says least."""
    alpha_by_window: Float[ndarray, " L"]
    """For windows of 1, 2, ... instants."""
    alpha_over_time: Float[ndarray, " K"]
    """By the first instant of the window; over one period where everything repeats from the start."""
    alpha_limit: Float[ndarray, " T"] | None
    """For large k, one a phase of the period; None with a horizon."""
    alpha_without_node: Float[ndarray, " N"]
    """When node i fails. This and what follows is, in networks with very many nodes and windows, over those windows
    that say least and those of the limit."""
    alpha_of_node: Float[ndarray, " N"]
    """Of each node alone."""
    holds_of_node: Bool[ndarray, " N"]
    alpha_with_copy: Float[ndarray, " N"]
    """With one more sensor like that of node i."""
    alpha_with_state: Float[ndarray, " n"]
    """With one more sensor that measures state j alone, without fading, with the variance `added_variance`."""
    added_variance: float
    """Median variance of the network's outputs."""
    growing: Float[ndarray, "n r"]
    """Orthonormal directions in which the second moment grows without bound (at phase 0), where that was needed."""
    lost: tuple[LostMode, ...]
    reason: str
    """Why it does not hold; empty where it does."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """Labels of the states; x1, x2, ... where the network has none."""
        return self.network.states or tuple(f"x{j + 1}" for j in range(self.network.n))

    def named(self, direction: Float[ndarray, " n"]) -> list[tuple[str, float]]:
        """The components of a direction by state, largest first, without those that are rounding."""
        order = np.argsort(-np.round(np.abs(direction), 9), kind="stable")
        return [(self.state_names[j], float(direction[j])) for j in order if abs(direction[j]) > 1e-6]

    def __repr__(self) -> str:
        verdict = "holds" if self.holds else "does not hold"
        scope = "every k" if self.horizon is None else f"k = 0..{self.horizon}"
        found = f"{verdict} for {scope}, window {self.window}, alpha {self.alpha:.6g}"
        return f"<RobustObservability ({self.form}): {found}>"
