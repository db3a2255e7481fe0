"""The local tolerance c_k: how much of the network's ambiguity a node sees through its own sensors (eqs. (30), (42)).

1.  only the state block of the least favourable covariance differs, by X = V - P >= 0
2.  P_k^loc = A (V^-1 + S_k)^-1 A' + Q, with the central V and the node's S_k
3.  c_k = tr(P_k^-1 X) - log det(I + P_k^-1 X) = sum_i (m_i - log(1 + m_i)),  m_i the eigenvalues of P_k^-1 X
4.  P_k is evaluated with an error between -D and D, D = u (n diag(q) + A Z diag(W) Z A') as in `accuracy`; m moves by
    at most the share tr(P_k^-1 D) of itself, and c_k by at most twice that
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis import extended, stacked
from tolnet.analysis.accuracy import reconstruction, step_rounding
from tolnet.analysis.divergence import divergence
from tolnet.analysis.extended import Matrix
from tolnet.analysis.fixed_point import Inflated, filter_information, inflate_covariance
from tolnet.analysis.sources import Sources
from tolnet.model import SensorNetwork, SteadyState, UnsupportedError

_ROUNDING = 1e-11
_VOUCHED = 1e-8
"""Largest estimated relative error of a c_k that is taken from doubles."""


class LocalTolerances:
    """c_k of every node on the gamma scale, from the steady state of the central filter, eq. (42)."""

    def __init__(self, network: SensorNetwork, central: SteadyState) -> None:
        """Assumes a centre with a steady state at c > 0, tau = 0."""
        self._network, self._central = network, central
        self._nodes = Sources.of_nodes(network)

    def all(self) -> Float[ndarray, " N"]:
        """From doubles where they can vouch for eight digits, else in extended precision."""
        network, central = self._network, self._central
        c = float(central.tolerance)
        at = inflate_covariance(central.P[None], np.array([c]))
        share = float(central.error) + network.n * float(reconstruction(central.P[None], at)[0])
        found, error = _seen_with_error(network, c, at, at, share if np.isfinite(share) else 0.0)
        for k in np.flatnonzero(~(error <= _VOUCHED)).tolist():
            exact = self.exact(k)
            found[k] = exact if np.isfinite(exact) else found[k]
        return found

    def exact(self, k: int) -> float:
        """c_k of node k to the last digit; NaN where the centre has no steady state in extended precision."""
        if self._centre is None:
            return np.nan
        with extended.precision():
            found = extended.seen_tolerance(self._nodes.plant(k), *self._centre)
        c = float(self._central.tolerance)
        return min(found, c) if found <= c * (1 + _ROUNDING) else found

    @cached_property
    def _centre(self) -> tuple[Matrix, Matrix] | None:
        central, centre = self._central, Sources.of_centre(self._network)
        try:
            return centre.covariances(0, float(central.tolerance), (central.P, float(central.theta)))
        except extended.NoAnswer:
            return None


def local_tolerances(network: SensorNetwork, central: SteadyState) -> Float[ndarray, " N"]:
    """c_k of every node on the gamma scale, from the steady state of the central filter, eq. (42).

    Uses n x n matrices only, and no difference of large numbers: V - P and V^-1 + S_k are formed in the eigenbasis of
    the central P. What doubles cannot vouch for to eight digits comes from extended precision. 0 <= c_k <= c; a node that hears everybody has c_k = c. NaN where the centre has no steady state.
    Raises UnsupportedError for tau != 0: local tolerances are defined for Kullback-Leibler balls only.
    Source: eqs. (30), (31), (42); docs/mathematics.md, section 3.
    """
    if central.tau != 0:
        raise UnsupportedError(
            f"local tolerances are defined for tau = 0 only (tau is {central.tau}); use uniform tolerances c_k = c"
        )
    c = float(central.tolerance)
    if not central.exists:
        return np.full(network.N, np.nan)
    if c == 0:
        return np.zeros(network.N)
    return LocalTolerances(network, central).all()


def seen_tolerances(network: SensorNetwork, c: float, *, now: Inflated, following: Inflated) -> Float[ndarray, " N"]:
    """c_{k,t} of eq. (30) from the centre's V_t (`now`) and its P_{t+1}, V_{t+1} (`following`), stacks of one.

    In the steady state the two are the same, eq. (42).
    """
    return _seen_with_error(network, c, now, following, 0.0)[0]


def _seen_with_error(
    network: SensorNetwork, c: float, now: Inflated, following: Inflated, share: float
) -> tuple[Float[ndarray, " N"], Float[ndarray, " N"]]:
    """c_{k,t}, and its estimated relative error where `share` is that of V and X in the units of each state."""
    root_X = following.U * np.sqrt(following.eigenvalues * following.excess)[:, None, :]
    size = max(1, 2**21 // (8 * network.n**2))
    with np.errstate(all="ignore"):
        parts = [
            _seen(network, network.information[start : start + size], now, root_X, share)
            for start in range(0, network.N, size)
        ]
    found, error = (np.concatenate(part) for part in zip(*parts, strict=True))
    # c_k <= c is a theorem; where the node hears everybody the two differ by rounding alone.
    return np.where(found <= c * (1 + _ROUNDING), np.minimum(found, c), found), error


def _seen(
    network: SensorNetwork, S: Float[ndarray, "K n n"], now: Inflated, root_X: Float[ndarray, "1 n n"], share: float
) -> tuple[Float[ndarray, " K"], Float[ndarray, " K"]]:
    """Lines 2 to 4, with X = root_X root_X'; P_loc is scaled to a unit diagonal first."""
    A, Q, n = network.A, network.Q, network.n
    filtered = filter_information(A, S, now)
    P_loc = stacked.symmetric_part(filtered.AZ @ filtered.AU.mT) + Q
    variance = np.einsum("kii->ki", P_loc)
    scale = np.sqrt(np.where(variance > 0, variance, 1.0))
    eigenvalues, U = stacked.symmetric_eigen(P_loc / scale[:, :, None] / scale[:, None, :])
    # X lives in the range of P, which is inside that of P_loc: null directions of P_loc carry nothing.
    inside = eigenvalues > 4 * n * np.finfo(float).eps * eigenvalues[:, -1:]
    inverse_root = np.where(inside, 1.0 / np.sqrt(np.where(inside, eigenvalues, 1.0)), 0.0)
    half = inverse_root[:, :, None] * (U.mT @ (root_X / scale[:, :, None]))
    m = np.linalg.svd(half, compute_uv=False) ** 2
    D = step_rounding(A, Q, S, now, filtered)
    np.einsum("kii->ki", D)[...] += share * variance
    moved = np.einsum("kai,kab,kbi->ki", U / scale[:, :, None], D, U / scale[:, :, None])
    return divergence(np.log1p(m)).sum(axis=-1), 2 * (inverse_root**2 * np.abs(moved)).sum(axis=-1)
