"""The bounds that the theory gives: on what the multiplicative noise does, and on the errors of the filter."""

from __future__ import annotations

import math
from dataclasses import dataclass

from jaxtyping import Float
from numpy import ndarray

from tolnet.model.corrupted import CorruptedNetwork
from tolnet.model.drkf import DrkfSteadyState
from tolnet.model.observability import RobustObservability
from tolnet.model.results import _ReadOnly


@dataclass(frozen=True, eq=False, repr=False)
class MultiplicativeNoise(_ReadOnly):
    """Assumption 3.2, eqs. (8)-(10), and what it is there for: a bound on mu_k |F_k Pi_k F_k'| (Lemma 3.5).

    Over one period where `horizon` is None, else over 0..horizon. Where mu = 0 throughout, everything holds with 0.
    """

    network: CorruptedNetwork
    horizon: int | None
    holds: bool
    """Whether (8)-(10) hold: a_lower > 0, growth < 1, b_bar finite."""
    a_lower: float
    a_upper: float
    """a_lower I <= A_k A_k' <= a_upper I, eq. (8)."""
    a: Float[ndarray, " S"]
    """a_l of eq. (9), one for each instant with mu > 0 and the next; infinite where no G_l exists."""
    growth: float
    """Their geometric mean: rho of eq. (9) is below 1 just where this is, for a periodic network."""
    b_bar: float
    """The largest b_l, eq. (10)."""
    bound: float
    """What (9) and (10) bound sup mu |F Pi F'| by."""
    supremum: float
    """sup mu_k |F_k Pi_k F_k'| itself, from Lemma 3.1; infinite where F acts on a growing direction."""
    reason: str
    """Why it does not hold; empty where it does."""

    def __repr__(self) -> str:
        verdict = "holds" if self.holds else "does not hold"
        return f"<MultiplicativeNoise: {verdict}, growth {self.growth:.6g}, sup mu |F Pi F'| = {self.supremum:.6g}>"


@dataclass(frozen=True, eq=False, repr=False)
class ErrorBound(_ReadOnly):
    """Theorem 3.1: E e e' <= c_0 / alpha I at every node from instant `start` on, with everything that enters.

    N nodes, window of N_bar + 1 instants. Units: those of the state squared for `bound`, p_min and q_hat.
    """

    network: CorruptedNetwork
    observability: RobustObservability
    multiplicative_noise: MultiplicativeNoise
    applies: bool
    """Whether the theorem's assumptions hold, so that `bound` is one."""
    start: int
    """N + N_bar."""
    p_min: float
    """(1 / q_lower + sup tau^2 |C|^2 |R^-1|)^-1: no P falls below it."""
    q_lower: float
    """The least eigenvalue of Q."""
    q_hat: float
    """sup |Q + mu F Pi F'|."""
    eta: float
    """p_min / (p_min + sup |W + 2 D|): what the channel leaves of information."""
    beta: float
    """p_min a_lower / (p_min a_lower + q_hat): what prediction leaves of it."""
    a_min: float
    """The least entry of the powers N - 1 to N + N_bar - 1 of the fusion weights, eq. (40)."""
    log10_c0: float
    steady_state: DrkfSteadyState | None
    """The sharper, computed alternative: what the filter settles on under the worst admissible channels."""
    reason: str
    """Why the theorem does not apply; empty where it does."""

    @property
    def c0(self) -> float:
        """max(a_upper, 1)^(N + N_bar - 2) / (a_min eta^(N + N_bar - 1) beta^(N + N_bar - 2)); it may overflow."""
        return 10.0**self.log10_c0 if self.log10_c0 < 308 else math.inf

    @property
    def bound(self) -> float:
        """c_0 / alpha; infinite where the theorem does not apply."""
        if not self.applies:
            return math.inf
        log = self.log10_c0 - math.log10(self.observability.alpha)
        return 10.0**log if log < 308 else math.inf

    @property
    def computed(self) -> float:
        """The largest eigenvalue of any P of the steady state under the worst channels; NaN without one."""
        return math.nan if self.steady_state is None else self.steady_state.worst

    def __repr__(self) -> str:
        return f"<ErrorBound: c0/alpha = {self.bound:.6g} from k = {self.start} on, computed {self.computed:.6g}>"
