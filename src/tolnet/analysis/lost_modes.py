"""Modes that do not decay and that nobody sees in the long run: errors along them grow without bound."""

from __future__ import annotations

import numpy as np

from tolnet.analysis.fading_information import exact_rows, rows_given_moment
from tolnet.analysis.hidden_modes import Region, hidden_modes
from tolnet.analysis.second_moment import SecondMomentLimit
from tolnet.model import CorruptedNetwork
from tolnet.model.observability import LostMode

_UNSEEN = 1e-10  # what rows in the long run have along a growing direction, relative to rows that do not fade
_GROWING = Region(1 - 1e-9, np.inf)  # what decays by less in a period counts as growing, as for the second moment


def lost_modes(network: CorruptedNetwork, limit: SecondMomentLimit) -> tuple[LostMode, ...]:
    """The modes of a period that do not decay and that no sensor sees when the second moment is at its limit."""
    T, n = len(limit.Pi), network.n
    Phi, exact, fading = np.eye(n), [], []
    for t in range(T):
        exact.append(exact_rows(network, t) @ Phi)
        fading.append((rows_given_moment(network, t, limit.at(t)).Y @ Phi).reshape(-1, n))
        Phi = network.A(t) @ Phi
    own = np.concatenate(exact, axis=1)
    kept = np.concatenate(fading)
    kept[np.abs(kept) <= _UNSEEN * np.abs(own).max(axis=(0, 1), initial=0.0)] = 0.0
    found = []
    for mode in hidden_modes(Phi, kept, _GROWING, error=_UNSEEN):
        direction = mode.direction
        seen = np.linalg.norm(own @ direction, axis=1)
        seers = seen > _UNSEEN * np.linalg.norm(np.abs(own) @ np.abs(direction), axis=1)
        real = np.real(direction) if np.linalg.norm(np.real(direction)) > 1e-8 else np.imag(direction)
        unit = real / np.linalg.norm(real)
        found.append(LostMode(mode.eigenvalue, tuple(unit.tolist()), tuple(np.flatnonzero(seers).tolist())))
    return tuple(found)
