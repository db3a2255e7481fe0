"""Gains that were designed, from channel coordinates to what a node deploys."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.msd_gradient import NetworkErrors
from tolnet.design.export.deployment import Deployment
from tolnet.model import Diffusion, ErrorDynamics, GainTable, SensorNetwork


def pack_gains(
    network: SensorNetwork, dynamics: ErrorDynamics, errors: NetworkErrors, z: Float[ndarray, " z"]
) -> GainTable:
    """G_k on the neighbours of node k, from its h_kc: G_kl = sum over the channels c of sensor l of h_kc t_c'.

    A sensor's channels are the columns f of F_l, F_l F_l' = C_l' R_l^-1 C_l; their outputs are t_c' y_l, where the
    t_c' are the rows of F_l^+ C_l' R_l^-1. Rounding apart, sum_l G_kl C_l is sum_c h_kc f_c'.
    """
    offsets, neighbours = errors.columns.offsets, errors.columns.sender
    columns = np.concatenate([[0], np.cumsum(np.diff(network.rows)[neighbours])])
    h = errors.channel_gains(z, network.n, len(dynamics.channels))
    gains = np.zeros((int(columns[-1]), network.n))
    readings = [_reading(network, dynamics, l) for l in range(network.N)]
    for i, (k, l) in enumerate(zip(errors.columns.hearer.tolist(), neighbours.tolist(), strict=True)):
        own, T = readings[l]
        gains[columns[i] : columns[i + 1]] = (h[k][:, own] @ T).T
    return GainTable(offsets, neighbours, columns, gains)


def deployment_of(found: Diffusion) -> Deployment:
    """What every node is given: the designed W, and the designed gains or else those of the table."""
    deployment = Deployment.of(found.table, found.W)
    if found.gains is None:
        return deployment
    return replace(deployment, gains=np.ascontiguousarray(found.gains.gains))


def _reading(network: SensorNetwork, dynamics: ErrorDynamics, l: int) -> tuple[ndarray, Float[ndarray, "c p"]]:
    """The channels of sensor l, and the rows t_c'."""
    own = np.flatnonzero(dynamics.owner == l)
    C, R = network.sensor(l)
    if not len(C):
        return own, np.zeros((0, 0))
    F = dynamics.channels[own].T
    return own, np.linalg.pinv(F) @ np.linalg.solve(R, C).T
