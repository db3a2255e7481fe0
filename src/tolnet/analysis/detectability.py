"""Which modes of the plant the sensors miss, and which the process noise does not reach (Popov-Belevitch-Hautus).

A node misses a mode lambda of A when some x != 0 has A x = lambda x and C_l x = 0 for every l that it hears. With E
an orthonormal basis of the eigenspace and whitened rows Y_l = R_l^-1/2 C_l E, that is: sum_l Y_l* Y_l is singular.
The sum is formed from the Y_l and never from S_k, so a direction seen through a sensor a million times worse than
the others is still told from one that is not seen at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from tolnet.model import SensorNetwork
from tolnet.model.sensors import whiten

_CLUSTER = 1e-4  # eigenvalues this close, relative to |A|, may be one defective eigenvalue that rounding split
_NULL = 1e-11  # singular values of A - lambda I below this, relative to |A|, are zero
_UNSEEN = 1e-24  # a squared row of C E below this, relative to |C|^2 |E|^2, is rounding
_DEPENDENT = 1e-13  # smallest eigenvalue of a Gramian of unit diagonal that counts as zero
_MARGIN = 1e-12  # moduli above 1 - _MARGIN count as on the unit circle


@dataclass(frozen=True, eq=False)
class Mode:
    """An eigenvalue of A with its eigenspace."""

    eigenvalue: complex
    basis: ndarray
    """Orthonormal, (n, m)."""

    @property
    def modulus(self) -> float:
        """|lambda|."""
        return abs(self.eigenvalue)

    def __str__(self) -> str:
        value = self.eigenvalue
        return f"{value.real:.6g}" if value.imag == 0 else f"{value.real:.6g} ± {abs(value.imag):.6g}i"


@dataclass(frozen=True, eq=False)
class Detectability:
    """What is reached by the noise and seen by the sensors.

    `unseen` and `centre_unseen` hold, for each of `modes`, whether the node (the centre) misses a direction of it.
    """

    modes: tuple[Mode, ...]
    undriven: Bool[ndarray, " m"]
    """Modes with a direction that the process noise does not reach."""
    unseen: Bool[ndarray, "N m"]
    centre_unseen: Bool[ndarray, " m"]

    @property
    def unstable(self) -> Bool[ndarray, " m"]:
        """Modes on or outside the unit circle."""
        return np.array([mode.modulus >= 1 - _MARGIN for mode in self.modes], dtype=bool)

    @property
    def stabilisable(self) -> bool:
        """Whether (A, B) is stabilisable: every mode that does not decay is driven by the noise."""
        return not (self.undriven & self.unstable).any()

    @property
    def detectable(self) -> Bool[ndarray, " N"]:
        """Nodes that see every mode that does not decay."""
        return np.asarray(~(self.unseen & self.unstable).any(axis=1))

    @property
    def centre_detectable(self) -> bool:
        """Whether all sensors together see every mode that does not decay."""
        return not (self.centre_unseen & self.unstable).any()

    @property
    def observable(self) -> Bool[ndarray, " N"]:
        """Nodes that see every mode."""
        return np.asarray(~self.unseen.any(axis=1))

    @property
    def centre_observable(self) -> bool:
        """Whether all sensors together see every mode."""
        return not self.centre_unseen.any()

    def offending(self, k: int | None) -> list[Mode]:
        """Modes that do not decay and that node k (None: the centre) misses."""
        missed = (self.centre_unseen if k is None else self.unseen[k]) & self.unstable
        return [mode for mode, is_missed in zip(self.modes, missed, strict=True) if is_missed]

    def offending_undriven(self) -> list[Mode]:
        """Modes that do not decay and that the noise does not reach."""
        return [mode for mode, is_it in zip(self.modes, self.undriven & self.unstable, strict=True) if is_it]


def detectability(network: SensorNetwork) -> Detectability:
    """Test (A, B) and every (A, C_k^loc) mode by mode.

    Assumes nothing; a defective A is handled through the eigenspace of each cluster of eigenvalues. Conjugate pairs
    are listed once.
    Source: M. L. J. Hautus, Indag. Math. 31, 1969; docs/mathematics.md, section 3.
    """
    A, Q = network.A, network.Q
    modes = modes_of(A)
    heard = network.adjacency.T.astype(float).tocsr()
    unseen = np.zeros((network.N, len(modes)), dtype=bool)
    centre = np.zeros(len(modes), dtype=bool)
    for j, mode in enumerate(modes):
        own, size = _gramians(network, mode.basis)
        m = mode.basis.shape[1]
        parts = own.reshape(network.N, m * m)
        local = heard @ np.real(parts) + 1j * (heard @ np.imag(parts))
        unseen[:, j] = _is_singular(local.reshape(-1, m, m), heard @ size)
        centre[j] = bool(_is_singular(own.sum(axis=0)[None], size.sum(axis=0)[None])[0])
    # A left eigenvector that Q annihilates is a direction in which the noise never pushes.
    left = modes_of(A.T)
    bad = np.array([_is_undriven(Q, mode) for mode in left])
    distance = np.abs(np.subtract.outer([m.eigenvalue for m in modes], [m.eigenvalue for m in left]))
    return Detectability(modes, bad[distance.argmin(axis=1)], unseen, centre)


def modes_of(A: Float[ndarray, "n n"]) -> tuple[Mode, ...]:
    """The distinct eigenvalues of A, conjugates once, largest modulus first, each with its eigenspace."""
    n = len(A)
    values = np.linalg.eigvals(A)
    scale = max(float(np.linalg.norm(A, 2)), np.finfo(float).tiny)
    values = values[values.imag >= 0]
    values = values[np.argsort(-np.abs(values), kind="stable")]
    modes: list[Mode] = []
    taken = np.zeros(len(values), dtype=bool)
    for i in range(len(values)):
        if taken[i]:
            continue
        cluster = ~taken & (np.abs(values - values[i]) <= _CLUSTER * scale)
        mean = values[cluster].mean()
        mean = mean.real + 0j if abs(mean.imag) <= _CLUSTER * scale else mean
        basis = _null_space(A - mean * np.eye(n), _NULL * scale)
        if basis.shape[1]:
            modes.append(Mode(complex(mean), basis))
            taken |= cluster
        else:  # the cluster is of distinct eigenvalues: each has its own eigenvector
            basis = _null_space(A - values[i] * np.eye(n), _NULL * scale, at_least=1)
            modes.append(Mode(complex(values[i]), basis))
            taken[i] = True
    return tuple(modes)


def _null_space(M: ndarray, tolerance: float, at_least: int = 0) -> ndarray:
    M = M if np.imag(M).any() else np.real(M)
    _, sizes, Vh = np.linalg.svd(M)
    count = max(int((sizes <= tolerance).sum()), at_least)
    return Vh[len(M) - count :].conj().T


def _gramians(network: SensorNetwork, E: ndarray) -> tuple[ndarray, Float[ndarray, "N m"]]:
    """Y_k* Y_k of every node alone, and the squared size that each diagonal entry would have without cancellation."""
    m = E.shape[1]
    own = np.zeros((network.N, m, m), dtype=complex)
    size = np.zeros((network.N, m))
    for nodes, C, R in network.sensors.groups():
        rounding = np.abs(C) @ np.abs(E)
        Y = C @ E
        Y = np.where(np.abs(Y) ** 2 <= _UNSEEN * rounding**2, 0.0, Y)
        L_Y = whiten(C=np.concatenate([np.real(Y), np.imag(Y), rounding], axis=-1), R=R)
        W: ndarray = L_Y[..., :m] + 1j * L_Y[..., m : 2 * m]
        own[nodes] = W.conj().mT @ W
        size[nodes] = (L_Y[..., 2 * m :] ** 2).sum(axis=-2)
    return own, size


def _is_singular(gramian: ndarray, size: Float[ndarray, "K m"]) -> Bool[ndarray, " K"]:
    diagonal = np.real(np.einsum("kii->ki", gramian))
    blind = (diagonal <= _UNSEEN * size) | (diagonal == 0)
    root = np.sqrt(np.where(blind, 1.0, diagonal))
    unit = gramian / root[:, :, None] / root[:, None, :]
    return blind.any(axis=1) | (np.linalg.eigvalsh(unit)[:, 0] <= _DEPENDENT)


def _is_undriven(Q: ndarray, mode: Mode) -> bool:
    E: ndarray = mode.basis
    push = E.conj().T @ Q @ E
    size = np.einsum("im,ij,jm->m", np.abs(E), np.abs(Q), np.abs(E))
    diagonal = np.real(np.diag(push))
    blind = diagonal <= 1e-14 * size
    if blind.any():
        return True
    root = np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(push / root / root[:, None])[0] <= _DEPENDENT)
