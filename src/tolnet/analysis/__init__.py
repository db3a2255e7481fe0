"""Measure: steady states, error dynamics, performance, observability."""

from tolnet.analysis.data import Record, tolerance_from_data
from tolnet.analysis.detectability import Detectability, detectability
from tolnet.analysis.divergence import gamma
from tolnet.analysis.error_dynamics import error_dynamics
from tolnet.analysis.filters import evaluate_filters, follow_filters
from tolnet.analysis.least_favourable import least_favourable_model
from tolnet.analysis.limits import published_bound, tolerance_limits
from tolnet.analysis.local_tolerance import local_tolerances
from tolnet.analysis.lyapunov import solve_lyapunov
from tolnet.analysis.riccati import solve_riccati
from tolnet.analysis.simulation import simulate_filters
from tolnet.analysis.steady_state import (
    restore_steady_state,
    solve_local_steady_states,
    solve_steady_state,
    solve_steady_states,
)
from tolnet.analysis.trajectories import simulate_least_favourable

__all__ = [
    "Detectability",
    "Record",
    "detectability",
    "error_dynamics",
    "evaluate_filters",
    "follow_filters",
    "gamma",
    "least_favourable_model",
    "local_tolerances",
    "published_bound",
    "restore_steady_state",
    "simulate_filters",
    "simulate_least_favourable",
    "solve_local_steady_states",
    "solve_lyapunov",
    "solve_riccati",
    "solve_steady_state",
    "solve_steady_states",
    "tolerance_from_data",
    "tolerance_limits",
]
