"""Spectral radii of the two diagonal blocks of F."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from tolnet.analysis import stacked
from tolnet.model import ErrorDynamics

_DENSE_BELOW = 100
_DENSE_AT_MOST = 4000
"""Where Arnoldi iterations fail, eigenvalues of the dense matrix are still computed up to this dimension."""
_WANTED = 4
"""Eigenvalues asked for, so that one of a tight cluster is not overlooked."""


class Radii(NamedTuple):
    """Spectral radii; NaN where the iteration did not converge."""

    network: float
    """Of the block of the filters, (W' (x) I) diag(M_k)."""
    least_favourable: float
    """Of A - G C + M H."""


def spectral_radii(dynamics: ErrorDynamics) -> Radii:
    """The spectral radius of F, block by block: dense eigenvalues when small, else Arnoldi (ARPACK) on the operator.

    Parts that do not influence one another are taken apart. ARPACK stops at a residual of rounding size; how far that
    is from an eigenvalue depends on how far the matrix is from normal.
    """
    if not dynamics.exists:
        return Radii(np.nan, np.nan)
    least_favourable = float(stacked.spectral_radius(dynamics.least_favourable_loop))
    network = np.max([_network_radius(part) for *_, part in dynamics.islands()])
    return Radii(float(network), least_favourable)


def _network_radius(dynamics: ErrorDynamics) -> float:
    """NaN where the iteration did not converge and the matrix is too large for dense eigenvalues."""
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

    K, n = dynamics.filters, dynamics.n
    if K * n <= _DENSE_BELOW:
        return float(stacked.spectral_radius(_network_matrix(dynamics)))

    def step(v: ndarray) -> ndarray:
        moved = dynamics.loops @ v.reshape(K, n, 1)
        return np.asarray(dynamics.mixing @ moved.reshape(K, n)).ravel()

    kind: Any = LinearOperator
    operator = kind(shape=(K * n, K * n), matvec=step, dtype=np.float64)
    start = np.random.default_rng(3).normal(size=K * n)
    try:
        values = eigs(operator, k=_WANTED, v0=start, ncv=40, maxiter=500, return_eigenvectors=False)
    except ArpackNoConvergence:
        return float(stacked.spectral_radius(_network_matrix(dynamics))) if K * n <= _DENSE_AT_MOST else np.nan
    return float(np.abs(values).max())


def _network_matrix(dynamics: ErrorDynamics) -> ndarray:
    d = dynamics.filters * dynamics.n
    return dynamics.sparse_matrix()[:d, :d].toarray()
