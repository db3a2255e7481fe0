"""Measure: steady states, error dynamics, performance, observability."""

from tolnet.analysis.channel_filters import follow_window
from tolnet.analysis.corrupted_simulation import CHANNEL_FILTERS, channel_filters, simulate_corrupted
from tolnet.analysis.data import Record, tolerance_from_data
from tolnet.analysis.detectability import Detectability, detectability
from tolnet.analysis.divergence import gamma
from tolnet.analysis.drkf_steady_state import follow_drkf, solve_drkf, sweep_drkf
from tolnet.analysis.error_bound import error_bound
from tolnet.analysis.error_dynamics import error_dynamics
from tolnet.analysis.filters import evaluate_filters, follow_filters
from tolnet.analysis.fusion_weights import solve_fusion_weights
from tolnet.analysis.hidden_modes import Mode
from tolnet.analysis.least_favourable import least_favourable_model
from tolnet.analysis.limits import published_bound, tolerance_limits
from tolnet.analysis.local_tolerance import local_tolerances
from tolnet.analysis.lyapunov import solve_lyapunov
from tolnet.analysis.multiplicative_noise import multiplicative_noise_condition
from tolnet.analysis.observability import robust_observability
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
    "CHANNEL_FILTERS",
    "Detectability",
    "Mode",
    "Record",
    "channel_filters",
    "detectability",
    "error_bound",
    "error_dynamics",
    "evaluate_filters",
    "follow_drkf",
    "follow_filters",
    "follow_window",
    "gamma",
    "least_favourable_model",
    "local_tolerances",
    "multiplicative_noise_condition",
    "published_bound",
    "restore_steady_state",
    "robust_observability",
    "simulate_corrupted",
    "simulate_filters",
    "simulate_least_favourable",
    "solve_drkf",
    "solve_fusion_weights",
    "solve_local_steady_states",
    "solve_lyapunov",
    "solve_riccati",
    "solve_steady_state",
    "solve_steady_states",
    "sweep_drkf",
    "tolerance_from_data",
    "tolerance_limits",
]
