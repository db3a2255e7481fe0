"""The least favourable model of the centre's ambiguity set: the worst that can really happen to the network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.model.covariances import Posterior, condition, psd_factor, standard_deviations
from tolnet.model.network import SensorNetwork
from tolnet.model.results import _ReadOnly
from tolnet.model.status import Status

__all__ = ["LeastFavourableModel", "psd_factor", "standard_deviations"]


@dataclass(frozen=True, eq=False, repr=False)
class LeastFavourableModel(_ReadOnly):
    """The worst model that the centre's ambiguity set allows, eq. (34): the nominal plant and sensors driven by

        u_t = H_t e_t + L_t eps_t,   H_t = M' T (A - G C),   L_t L_t' = K_t = (I - M' X M)^-1 = I + M' T M,

    with M = [B, -G D], N = M M' = Q + A Z S Z A', X = Omega_{t+1}^-1 + theta_t I and T = X (I - N X)^-1, e_t the
    error of the centralised robust filter. u_t has m + sum p_k entries, but all follows from these n x n matrices.

    Shapes: (*time, n, n) and (*time,); the steady state has no time axis. Where `status` is neither `ok` nor
    `oscillates` there is no model: the numbers are NaN and `reason` says why. Source: eq. (34); Section 4.
    """

    network: SensorNetwork
    tolerance: float
    """c of the centre, on the gamma scale."""
    theta: Float[ndarray, "*time"]
    V: Float[ndarray, "*time n n"]
    """V_t of the centralised filter, from which its gain at t follows."""
    error_covariance: Float[ndarray, "*time n n"]
    """R_t = (V_t^-1 - Omega_t^-1)^-1: covariance of e_t, where e_0 has that of its time. It exceeds V_t; its trace in
    the steady state is the mean square deviation of the centralised robust filter."""
    tilt: Float[ndarray, "*time n n"]
    """T_t."""
    steering: Float[ndarray, "*time n n"]
    """T_t (A - G C), so that H_t = M' times this."""
    status: Status
    reason: str

    @property
    def exists(self) -> bool:
        """Whether there are numbers."""
        return bool(np.isfinite(self.theta).all())

    @property
    def horizon(self) -> int | None:
        """Number of steps of a time-varying model; None for the steady state."""
        return len(self.theta) if self.theta.ndim else None

    @cached_property
    def _posterior(self) -> Posterior:
        return condition(self.V, self.network.total_information)

    @property
    def filtered(self) -> Float[ndarray, "*time n n"]:
        """Z = (V^-1 + S)^-1 of the centre."""
        return self._posterior.covariance

    @cached_property
    def loop(self) -> Float[ndarray, "*time n n"]:
        """A - G C = A (I + V S)^-1: the error loop of the centre under the nominal model."""
        return self.network.A @ self._posterior.loop

    @cached_property
    def noise(self) -> Float[ndarray, "*time n n"]:
        """N = M M' = Q + A Z S Z A': covariance of the noise in e under the nominal model."""
        AZ = self.network.A @ self.filtered
        return self.network.Q + AZ @ self.network.total_information @ AZ.mT

    @cached_property
    def closed_loop(self) -> Float[ndarray, "*time n n"]:
        """A - G C + M H = A - G C + N T (A - G C): the error loop of the centre under this model."""
        return self.loop + self.noise @ self.steering

    @cached_property
    def closed_noise(self) -> Float[ndarray, "*time n n"]:
        """M K M' = N + N T N: covariance of the noise in e under this model."""
        return self.noise + self.noise @ self.tilt @ self.noise

    @cached_property
    def backward(self) -> Float[ndarray, "*time n n"]:
        """Omega_t^-1 = (A - G C)' T (A - G C)."""
        return self.loop.mT @ self.steering

    @cached_property
    def defect(self) -> Float[ndarray, "*steps n n"]:
        """F R F' + noise - R_next for the closed loop F: rounding. Over time, one step less than the model has."""
        F, noise, R = self.closed_loop, self.closed_noise, self.error_covariance
        if self.horizon is None:
            return F @ R @ F.mT + noise - R
        return F[:-1] @ R[:-1] @ F[:-1].mT + noise[:-1] - R[1:]

    @cached_property
    def residual(self) -> float:
        """|defect| / |R_next|, the worst over time."""
        R = self.error_covariance if self.horizon is None else self.error_covariance[1:]
        whole = np.maximum(np.linalg.norm(R, axis=(-1, -2)), np.finfo(float).tiny)  # zero without noise
        sizes = np.linalg.norm(self.defect, axis=(-1, -2)) / whole
        return float(np.max(sizes, initial=0.0))

    @cached_property
    def tilt_root(self) -> Float[ndarray, "*time n n"]:
        """Psi with L = I + M' Psi M the symmetric square root of K, so that L eps = eps + M' Psi (M eps).

        T = Y Y',  Y' N Y = U diag(d) U':  Psi = Y U diag(1 / (1 + sqrt(1 + d))) U' Y'.
        """
        Y = psd_factor(self.tilt)
        d, U = np.linalg.eigh(Y.mT @ self.noise @ Y)
        YU = Y @ U
        return (YU / (1 + np.sqrt(1 + np.maximum(d, 0)))[..., None, :]) @ YU.mT

    def __getitem__(self, t: int) -> LeastFavourableModel:
        """The model of one instant, without time axis."""
        at = {
            name: np.asarray(getattr(self, name)[t])
            for name in ("theta", "V", "error_covariance", "tilt", "steering")
        }
        return replace(self, **at)

    def __repr__(self) -> str:
        when = "steady" if self.horizon is None else f"{self.horizon} steps"
        return f"<LeastFavourableModel {self.status} ({when}): c = {self.tolerance:g}>"
