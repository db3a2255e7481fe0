"""The words in which a result says whether it is an answer (docs/mathematics.md, section 4)."""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """How a filter stands at its steady state. Anything but OK makes the command line exit with 4."""

    OK = "ok"
    """A steady state exists, its equations hold to rounding, and the recursion is attracted to it."""
    OSCILLATES = "oscillates"
    """A steady state exists, but the recursion is not attracted to it: the deployed filter never settles."""
    DIVERGES = "diverges"
    """The covariance recursion grows without bound."""
    NO_STEADY_STATE = "no-steady-state"
    """No steady state was found at this tolerance."""
    UNDETECTABLE = "undetectable"
    """A mode of A on or outside the unit circle is invisible to the sensors that the filter hears."""
    UNSTABILISABLE = "unstabilisable"
    """A mode of A on the unit circle is not driven by the process noise."""
    FOLD = "fold"
    """The centre's tolerance is at or beyond its fold: the least favourable model has no steady state (section 7)."""
    UNSTABLE = "unstable"
    """The error dynamics are not Schur: errors grow without bound."""
    NOT_CONVERGED = "not-converged"
    """An iteration ended without an answer that deserves six digits."""
    SINGULAR = "singular"
    """A matrix that had to be positive definite is not."""

    @property
    def has_numbers(self) -> bool:
        """Whether a performance of this status has numbers."""
        return self in (Status.OK, Status.OSCILLATES)
