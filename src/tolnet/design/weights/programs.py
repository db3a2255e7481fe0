"""Semidefinite programs: solved by Clarabel, and believed by nobody before the answer is recomputed."""

from __future__ import annotations

import warnings
from typing import Any


def solve_program(problem: Any) -> bool:
    """Solve a CVXPY problem; whether there are numbers. Whether they are good is for the caller to recompute."""
    import cvxpy as cp

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Solution may be inaccurate")
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.SolverError:
            return False
    return all(variable.value is not None for variable in problem.variables())
