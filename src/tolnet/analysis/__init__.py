"""Measure: steady states, error dynamics, performance, observability."""

from tolnet.analysis.detectability import Detectability, detectability
from tolnet.analysis.divergence import gamma
from tolnet.analysis.limits import published_bound, tolerance_limits
from tolnet.analysis.local_tolerance import local_tolerances
from tolnet.analysis.riccati import solve_riccati
from tolnet.analysis.steady_state import solve_local_steady_states, solve_steady_state, solve_steady_states

__all__ = [
    "Detectability",
    "detectability",
    "gamma",
    "local_tolerances",
    "published_bound",
    "solve_local_steady_states",
    "solve_riccati",
    "solve_steady_state",
    "solve_steady_states",
    "tolerance_limits",
]
