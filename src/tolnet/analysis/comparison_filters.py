"""What else a person could run over corrupted channels: centralised filters, CSGF (two kinds) and DSEA-CP.

The centralised ones hear every sensor without channel noise. Sources: docs/mathematics.md, section 13.8.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.channel_filters import ChannelFilter, Moment
from tolnet.analysis.corrupted_truth import CorruptedInstant
from tolnet.analysis.drkf import sum_by_receiver
from tolnet.analysis.stacked import inverse, symmetric_part
from tolnet.model import CorruptedNetwork
from tolnet.model.corrupted import Instant


class _Centralised(ChannelFilter):
    """P^-1 = Pbar^-1 + sum_i C_i' R_i^-1 C_i,   x = xbar + P sum_i C_i' R_i^-1 (y_i - C_i xbar)."""

    centralised = True
    fading_known: ClassVar[bool]
    """Whether tau C stands in the place of C."""
    robust: ClassVar[bool]
    """Whether multiplicative noise and the variance of the fading count."""

    def step(self, moment: Moment, drawn: CorruptedInstant) -> None:
        A, now = moment.before.A, moment.now
        assert self.P is not None
        weighted, information = _weighted(now, moment.Pi, fading_known=self.fading_known, robust=self.robust)
        P_bar = A @ self.P @ A.T + (moment.noise if self.robust else moment.before.Q)
        self.P = symmetric_part(np.linalg.inv(np.linalg.inv(P_bar) + information.sum(axis=0)))
        x = self.x @ A.T
        pull = drawn.y[:, None, :] @ weighted - x @ information.sum(axis=0)
        self.x = x + pull @ self.P[0, 0]


class Ckf(_Centralised):
    """The plain Kalman filter of all sensors, which knows of no fading."""

    name = "CKF"
    meaning = "centralised Kalman filter that takes C for what fading leaves of it"
    fading_known, robust = False, False


class CkfTau(_Centralised):
    """The plain Kalman filter with the mean of the fading."""

    name = "CKF-tau"
    meaning = "centralised Kalman filter with tau C in the place of C"
    fading_known, robust = True, False


class Crkf(_Centralised):
    """The best linear filter that uses all the bounds."""

    name = "CRKF"
    meaning = "centralised robust Kalman filter: all sensors, all bounds, no channels"
    fading_known, robust = True, True


class Csgf(ChannelFilter):
    """Consensus with one scalar gain (Khan and Jadbabaie), in filtered time:

        x_i = A sum_j a_ij (x_j + e_ij) + alpha sum_{j in N_i} C_j' (y_j - C_j A x_i)

    with alpha from `scalar_gain`. It knows no covariance, and of no fading.
    """

    name = "CSGF"
    meaning = "consensus filter with one scalar gain"
    fading_known: ClassVar[bool] = False
    """Whether the innovation is y_j - tau_j C_j A x_i."""

    def __init__(self, network: CorruptedNetwork, runs: int) -> None:
        super().__init__(network, runs)
        self.P = None
        self.gain = scalar_gain(network)

    def step(self, moment: Moment, drawn: CorruptedInstant) -> None:
        network, A = self.network, moment.before.A
        senders, C = network.pairs[:, 1], moment.now.sensors.C
        sensed = np.zeros_like(self.x)
        for nodes, own, _ in moment.now.sensors.groups():
            rows = network.rows[nodes, None] + np.arange(own.shape[1])
            sensed[:, nodes] = (drawn.y[:, rows, None] * C[rows]).sum(axis=2)
        heard = sum_by_receiver(network, sensed[:, senders, :, None])[..., 0]
        mixed = sum_by_receiver(
            network, network.fusion.data[:, None, None] * (self.x[:, senders] + drawn.e)[..., None]
        )
        squares = _squares(moment.now)
        if self.fading_known:
            squares = moment.now.tau[:, None, None] * squares
        seen = sum_by_receiver(network, squares[senders])
        predicted = self.x @ A.T
        self.x = mixed[..., 0] @ A.T + self.gain * (heard - (seen @ predicted[..., None])[..., 0])


class CsgfTau(Csgf):
    """The same with the mean of the fading in its innovation:

        x_i = A sum_j a_ij (x_j + e_ij) + alpha sum_{j in N_i} C_j' (y_j - tau_j C_j A x_i)

    The gain is the same; as tau_j <= 1, it stays stable where all see the same (docs/decisions/0043).
    """

    name = "CSGF-tau"
    meaning = "consensus filter with one scalar gain and tau C in its innovation"
    fading_known = True


class DseaCp(ChannelFilter):
    """Consensus on information pairs (Battistelli and Chisci), one round a step, fed with what the channels deliver:

        update  Omega + C_i' R_i^-1 C_i,   fusion  sum_j a_ij (P_j + D_ij)^-1,   prediction  P = A Omega^-1 A' + Q

    It knows neither fading nor channel noise, so matrices may lose their sign on the way.
    """

    name = "DSEA-CP"
    meaning = "consensus on information pairs, one round a step"

    def step(self, moment: Moment, drawn: CorruptedInstant) -> None:
        network, A = self.network, moment.before.A
        senders, a = network.pairs[:, 1], network.fusion.data[:, None, None]
        assert self.P is not None
        weighted, information = _weighted(moment.now, moment.Pi, fading_known=False, robust=False)
        P_bar = symmetric_part(A @ self.P @ A.T + moment.before.Q)
        P = _inverse(_inverse(P_bar) + information)
        x = self.x @ A.T
        by_node = np.zeros_like(x)
        for nodes, C, _ in moment.now.sensors.groups():
            rows = network.rows[nodes, None] + np.arange(C.shape[1])
            by_node[:, nodes] = (drawn.y[:, rows, None] * weighted[rows]).sum(axis=2)
        x = x + (P @ (by_node - (information @ x[..., None])[..., 0])[..., None])[..., 0]
        received = a * _inverse(P[:, senders] + drawn.D)
        self.P = _inverse(sum_by_receiver(network, received))
        total = sum_by_receiver(network, received @ (x[:, senders] + drawn.e)[..., None])
        self.x = (self.P @ total)[..., 0]


def scalar_gain(network: CorruptedNetwork) -> float:
    """A quarter of the gain that takes a node's own measurements at face value, and stable where all see the same.

    alpha = 1/4 over the largest eigenvalue of a C_i' C_i, at most 1 over that of a sum over N_i, at instant 0.
    """
    squares = _squares(network.at(0))
    seen = sum_by_receiver(network, squares[network.pairs[:, 1]])
    own, together = (float(np.linalg.eigvalsh(X)[:, -1].max()) for X in (squares, seen))
    return min(0.25 / own, 1 / together) if own > 0 else 0.0


def _squares(now: Instant) -> Float[ndarray, "N n n"]:
    """C_i' C_i of every node."""
    squares = np.zeros((len(now.tau), len(now.A), len(now.A)))
    for nodes, C, _ in now.sensors.groups():
        squares[nodes] = C.mT @ C
    return squares


def _weighted(
    now: Instant, Pi: Float[ndarray, "n n"], *, fading_known: bool, robust: bool
) -> tuple[Float[ndarray, "M n"], Float[ndarray, "N n n"]]:
    """R_i^-1 C_i, packed like C, and C_i' R_i^-1 C_i, with tau C and R + phi C Pi C' where they are known."""
    weighted = np.zeros_like(now.sensors.C)
    information = np.zeros((len(now.tau), len(Pi), len(Pi)))
    for nodes, C, R in now.sensors.groups():
        if robust:
            R = R + now.phi[nodes, None, None] * (C @ Pi @ C.mT)
        C = now.tau[nodes, None, None] * C if fading_known else C
        rows = now.sensors.rows[nodes, None] + np.arange(C.shape[1])
        weighted[rows] = np.linalg.solve(R, C)
        information[nodes] = symmetric_part(C.mT @ weighted[rows])
    return weighted, information


def _inverse(X: Float[ndarray, "p K n n"]) -> Float[ndarray, "p K n n"]:
    """Of symmetric matrices of any sign; NaN where singular or not finite."""
    return symmetric_part(inverse(X.reshape(-1, *X.shape[2:])).reshape(X.shape))
