"""What each node's measurement says of the state, as rows Y with Y'Y = tau^2 C' Rt^-1 C (docs/mathematics.md, 13.3).

Rows instead of matrices: a direction that is seen a million times worse than the others keeps its digits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.second_moment import Moment
from tolnet.analysis.stacked import symmetric_part
from tolnet.model import CorruptedNetwork

_UNSEEN = 1e-10  # a row of C U below this share of C is rounding


class Whitened(NamedTuple):
    """Rows Y = Z tau C of every node, with Z Rt Z' = I on what is kept; fewer outputs than others are zeros below."""

    Y: Float[ndarray, "N p n"]
    Z: Float[ndarray, "N p p"]


def exact_rows(network: CorruptedNetwork, k: int) -> Float[ndarray, "N p n"]:
    """R^-1/2 C: as if nothing faded, tau = 1 and phi = 0."""
    now = network.at(k)
    whitened = _Stacks(network)
    for nodes, C, R in now.sensors.groups():
        whitened.put(nodes, C, R)
    return whitened.found.Y


def rows_given_norm(network: CorruptedNetwork, k: int, pi: float) -> Float[ndarray, "N p n"]:
    """tau (R + phi pi C C')^-1/2 C, eq. (6); an infinite pi leaves nothing of a fading sensor."""
    now = network.at(k)
    whitened = _Stacks(network)
    for nodes, C, R in now.sensors.groups():
        tau, phi = now.tau[nodes, None, None], now.phi[nodes, None, None]
        lost = (phi > 0) & np.isinf(pi)
        size = 0.0 if np.isinf(pi) else pi
        whitened.put(nodes, np.where(lost, 0.0, tau * C), R + phi * size * (C @ C.mT))
    return whitened.found.Y


def rows_given_moment(network: CorruptedNetwork, k: int, moment: Moment) -> Whitened:
    """tau (R + phi C Pi C')^-1/2 C, eq. (11); what a fading sensor sees of infinite directions leaves no row.

    With N a basis of the outputs that do not see U, the limit is tau^2 C'N (N'(R + phi C Pi C')N)^-1 N'C.
    """
    now = network.at(k)
    whitened = _Stacks(network)
    for nodes, C, R in now.sensors.groups():
        tau, phi = now.tau[nodes, None, None], now.phi[nodes, None, None]
        kept = None
        if moment.U.shape[1]:
            kept = _finite_outputs(C @ moment.U, np.linalg.norm(C, axis=2), phi[:, 0, 0])
        whitened.put(nodes, tau * C, R + phi * (C @ moment.Pi @ C.mT), kept)
    return whitened.found


class _Stacks:
    """The rows of all nodes, group by group."""

    def __init__(self, network: CorruptedNetwork) -> None:
        p = int(np.diff(network.rows).max(initial=0))
        self.found = Whitened(np.zeros((network.N, p, network.n)), np.zeros((network.N, p, p)))

    def put(
        self,
        nodes: ndarray,
        rows: Float[ndarray, "K p n"],
        noise: Float[ndarray, "K p p"],
        kept: Float[ndarray, "K p p"] | None = None,
    ) -> None:
        """Whiten rows by their noise; `kept` combines the outputs first, zero rows of it leave nothing."""
        noise = symmetric_part(noise)
        Z = np.broadcast_to(np.eye(rows.shape[1]), noise.shape) if kept is None else kept
        if kept is not None:
            empty = np.asarray(~kept.any(axis=2))
            noise = symmetric_part(kept @ noise @ kept.mT) + empty[:, :, None] * np.eye(rows.shape[1])
        Z = np.linalg.solve(np.linalg.cholesky(noise), Z)
        self.found.Y[nodes, : rows.shape[1]] = Z @ rows
        self.found.Z[nodes, : rows.shape[1], : rows.shape[1]] = Z


def _finite_outputs(
    growing: Float[ndarray, "K p r"], size: Float[ndarray, "K p"], phi: Float[ndarray, " K"]
) -> Float[ndarray, "K p p"]:
    """Orthonormal combinations of outputs whose noise stays finite, zero rows below; all where nothing fades."""
    p = growing.shape[1]
    kept = np.tile(np.eye(p), (len(growing), 1, 1))
    sees = (np.abs(growing).max(axis=2) > _UNSEEN * size).any(axis=1)
    for i in np.flatnonzero(sees & (phi > 0)):
        outputs, sizes, _ = np.linalg.svd(growing[i])
        rank = int((sizes > _UNSEEN * size[i].max()).sum())
        kept[i] = 0.0
        kept[i, : p - rank] = outputs[:, rank:].T
    return kept
