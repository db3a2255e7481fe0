"""Modes that do not decay and that nobody sees in the long run: errors along them grow without bound."""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from tolnet.analysis.detectability import modes_of
from tolnet.analysis.fading_information import exact_rows, rows_given_moment
from tolnet.analysis.second_moment import SecondMomentLimit
from tolnet.model import CorruptedNetwork
from tolnet.model.observability import LostMode

_UNSEEN = 1e-10  # rows along a mode below this share of all rows are rounding


def lost_modes(network: CorruptedNetwork, limit: SecondMomentLimit) -> tuple[LostMode, ...]:
    """The modes of a period that do not decay and that no sensor sees when the second moment is at its limit."""
    T, n = len(limit.Pi), network.n
    Phi, exact, fading = np.eye(n), [], []
    for t in range(T):
        exact.append(exact_rows(network, t) @ Phi)
        fading.append((rows_given_moment(network, t, limit.at(t)).Y @ Phi).reshape(-1, n))
        Phi = network.A(t) @ Phi
    own = np.concatenate(exact, axis=1)
    found = []
    for mode in modes_of(Phi):
        if mode.modulus < 1 - 1e-9:
            continue
        E = mode.basis
        _, sizes, Vh = np.linalg.svd(np.concatenate(fading) @ E)
        missed = Vh[np.concatenate([sizes, np.zeros(len(Vh))])[: len(Vh)] <= _UNSEEN * np.linalg.norm(own)]
        if not len(missed):
            continue
        direction: ndarray = E @ missed[-1].conj()
        seers = np.linalg.norm(own @ direction, axis=1) > _UNSEEN * np.linalg.norm(own)
        real = np.real(direction) if np.linalg.norm(np.real(direction)) > 1e-8 else np.imag(direction)
        unit = real / np.linalg.norm(real)
        found.append(LostMode(mode.eigenvalue, tuple(unit.tolist()), tuple(np.flatnonzero(seers).tolist())))
    return tuple(found)
