"""How the second moment of the state grows: where it stays bounded, and its limit there (docs/mathematics.md, 13.1).

    Pi_{k+1} = A_k Pi_k A_k' + mu_k F_k Pi_k F_k' + Q_k                                              Lemma 3.1

The directions u' Pi_k u that grow without bound are those outside the orthogonal complement of a subspace U_k, which
A_k (and F_k, where mu_k > 0) maps into U_{k+1}. Modulo U the recursion is stable and has a periodic limit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.drkf import step_second_moment
from tolnet.analysis.stacked import symmetric_part
from tolnet.model import CorruptedNetwork, UnsupportedError

_CLUSTER = 1e-3  # an eigenvalue farther than this from one that does not decay is not it, split by rounding
_ROOM_OF_SPLITS = 100
_MARGIN = 1e-9  # what decays by less in a period counts as growing
_RANK = 1e-8  # singular values below this share of the largest are rounding
_HUGE = 1e100  # beyond this the growing directions count as infinite, long before they overflow
_GROWN = 1e12  # and here they have grown so far that a fading sensor sees nothing along them
_SETTLED = 1e-12  # how close to its limit the bounded part must be to count as there
_PATIENCE = 2000  # instants after which it counts as there in any case: what grows like a power of k takes long
_ROOM = 20_000_000  # numbers in the rows of all nodes over those instants; large networks wait less, but for 100


class Moment(NamedTuple):
    """The second moment at one instant: `Pi`, plus infinity along the orthonormal columns of `U`, where it has any.

    `bounded` is Pi modulo the directions that grow, by a recursion of its own: when Pi has grown by 1e16, nothing
    else of it is left in doubles, and mu F Pi F' formed from it would be rounding.
    """

    Pi: Float[ndarray, "n n"]
    U: Float[ndarray, "n r"]
    bounded: Float[ndarray, "n n"]


@dataclass(frozen=True, eq=False)
class SecondMomentLimit:
    """The limit of Pi_k as k grows with k = t mod T: infinite along U_t, and `Pi[t]` on its complement."""

    Pi: Float[ndarray, "T n n"]
    U: Float[ndarray, "T n r"]
    residual: float
    """Largest relative residual of the recursion, modulo U."""

    @property
    def bounded(self) -> bool:
        """Whether the second moment stays bounded in every direction."""
        return self.U.shape[2] == 0

    def at(self, k: int) -> Moment:
        """The limit for instants like k."""
        t = k % len(self.Pi)
        return Moment(self.Pi[t], self.U[t], self.Pi[t])


def second_moment_limit(network: CorruptedNetwork) -> SecondMomentLimit:
    """Where the second moment grows without bound, and its periodic limit elsewhere.

    U begins with the invariant subspace of all eigenvalues of a period's transition matrix that do not decay, closed
    under F. While the recursion modulo U is not mean-square stable, the range of its dominant second moment joins U:
    at most n rounds of O(n^6), since a second moment has n (n + 1) / 2 entries.
    Raises UnsupportedError for functions of k, which have no period.
    """
    T, n = network.period, network.n
    if T is None:
        raise UnsupportedError("some matrix is a function of k, of which no limit is known; give a horizon")
    A = np.stack([network.A(t) for t in range(T)])
    G = np.stack([np.sqrt(network.mu(t)) * network.F(t) for t in range(T)])
    Y = np.broadcast_to(np.eye(n), (T, n, n))
    for find in (_not_decaying, _dominant):
        while (U := find(A, G)).shape[1]:
            kept = _complements(_closed(A, G, U))
            following = np.roll(kept, -1, axis=0)
            A, G, Y = following.mT @ A @ kept, following.mT @ G @ kept, Y @ kept
    Q = np.stack([network.Q(t) for t in range(T)])
    following = np.roll(Y, -1, axis=0)
    noise = symmetric_part(following.mT @ Q @ following)
    reduced = _periodic_solution(A, G, noise)
    right = A @ reduced @ A.mT + G @ reduced @ G.mT + noise
    error = np.abs(right - np.roll(reduced, -1, axis=0)).max(initial=0.0)
    U = np.stack([_complement(Y_t) for Y_t in Y])
    residual = float(error / np.abs(reduced).max(initial=1e-300))
    return SecondMomentLimit(symmetric_part(Y @ reduced @ Y.mT), U, residual)


def second_moments(network: CorruptedNetwork, limit: SecondMomentLimit | None) -> Iterator[Moment]:
    """Pi_0, Pi_1, ... one instant at a time, without end; without a limit nothing is known to grow."""
    Pi, nothing, k = network.initial_second_moment, np.zeros((network.n, 0)), 0
    if limit is None or limit.bounded:
        while True:
            yield Moment(Pi, nothing, Pi)
            Pi, k = step_second_moment(network.at(k), Pi), k + 1
    # One output that sees a growing direction has a variance that is that of the growth, however large; of several
    # outputs, combinations that do not see it would drown in rounding, so the growth counts as infinite in time.
    several = int(np.diff(network.rows).max(initial=0)) > 1
    huge = _GROWN * _size(network, limit) if several else _HUGE
    bounded = _modulo(limit.U[0], Pi)
    while np.abs(Pi).max() < huge:
        yield Moment(Pi, nothing, bounded)
        now, following = network.at(k), limit.at(k + 1).U
        Pi, bounded = step_second_moment(now, Pi), _modulo(following, step_second_moment(now, bounded))
        k += 1
    while True:
        yield Moment(bounded, limit.at(k).U, bounded)
        bounded = _modulo(limit.at(k + 1).U, step_second_moment(network.at(k), bounded))
        k += 1


def _size(network: CorruptedNetwork, limit: SecondMomentLimit) -> float:
    """What a second moment counts as large against."""
    parts = (network.initial_second_moment, network.Q(0), limit.Pi)
    return max(float(np.abs(part).max()) for part in parts)


def _modulo(U: Float[ndarray, "n r"], Pi: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    keep = np.eye(len(U)) - U @ U.T
    return symmetric_part(keep @ Pi @ keep)


def transient(network: CorruptedNetwork, limit: SecondMomentLimit) -> list[Moment]:
    """The second moments until their bounded part is at its limit, and a growing one far beyond everything else.

    Empty where they never matter: without fading.
    """
    T = network.period
    assert T is not None
    if not any(network.phi(t).any() for t in range(T)):
        return []
    found: list[Moment] = []
    size = _size(network, limit)
    patience = int(np.clip(_ROOM / (int(network.rows[-1]) * network.n + 1), 100, _PATIENCE))
    for k, moment in enumerate(second_moments(network, limit)):
        found.append(moment)
        goal = limit.at(k).Pi
        settled = np.abs(moment.bounded - goal).max() <= _SETTLED * size
        grown = limit.bounded or moment.U.shape[1] > 0 or np.abs(moment.Pi).max() > _GROWN * size
        if (settled and grown) or k >= patience:
            return found
    return found


def norm_recursion(network: CorruptedNetwork, horizon: int) -> Float[ndarray, " K"]:
    """pi_s, s = 0..horizon: pi_{s+1} = (|A_s|^2 + mu_s |F_s|^2) pi_s + |Q_s|, pi_0 = |Pi_0|, eq. (6)."""
    pi = np.empty(horizon + 1)
    pi[0] = np.linalg.norm(network.initial_second_moment, 2)
    with np.errstate(over="ignore"):
        for s in range(horizon):
            gain, noise = _norms(network, s)
            pi[s + 1] = gain * pi[s] + noise
    return pi


def norm_limit(network: CorruptedNetwork) -> Float[ndarray, " T"]:
    """The periodic limit of pi_s; infinite where it grows without bound."""
    T = network.period
    assert T is not None
    gains, noises = zip(*(_norms(network, t) for t in range(T)), strict=True)
    growth = float(np.sum(np.log(gains)))
    if growth >= -1e-12:
        return np.full(T, np.inf)
    start = 0.0
    for gain, noise in zip(gains, noises, strict=True):
        start = gain * start + noise
    pi = np.empty(T)
    pi[0] = start / -np.expm1(growth)
    for t in range(T - 1):
        pi[t + 1] = gains[t] * pi[t] + noises[t]
    return pi


def _norms(network: CorruptedNetwork, s: int) -> tuple[float, float]:
    norm_A, norm_F, norm_Q = (float(np.linalg.norm(part(s), 2)) for part in (network.A, network.F, network.Q))
    return norm_A**2 + float(network.mu(s)) * norm_F**2, norm_Q


def _symmetric_basis(m: int) -> Float[ndarray, "K m m"]:
    """An orthonormal basis of the symmetric m x m matrices."""
    i, j = np.triu_indices(m)
    basis = np.zeros((len(i), m, m))
    basis[np.arange(len(i)), i, j] = basis[np.arange(len(i)), j, i] = np.where(i == j, 1.0, np.sqrt(0.5))
    return basis


def _one_period(A: ndarray, G: ndarray, X: ndarray) -> tuple[ndarray, float]:
    """A stack of symmetric matrices after one period, scaled, and the logarithm of the scale."""
    log = 0.0
    for A_t, G_t in zip(A, G, strict=True):
        X = A_t @ X @ A_t.T + G_t @ X @ G_t.T
        size = float(np.abs(X).max())
        if size == 0:
            return X, -np.inf
        X, log = X / size, log + float(np.log(size))
    return X, log


def _not_decaying(A: Float[ndarray, "T n n"], _: Float[ndarray, "T n n"]) -> Float[ndarray, "n r"]:
    """An orthonormal basis of the states that the transition over one period does not make decay."""
    from scipy.linalg import schur

    Phi = _product(A)
    if not len(Phi):
        return np.zeros((0, 0))
    modulus = np.abs(values := np.linalg.eigvals(Phi))
    growing = values[modulus >= 1 - _MARGIN]
    if not growing.size:
        return np.zeros((len(Phi), 0))
    within = np.minimum(_split(Phi, values), _CLUSTER * max(1.0, float(modulus.max())))
    count = int((np.abs(values[:, None] - growing).min(axis=1) <= within).sum())
    # Schur's own eigenvalues differ from these by as much as rounding splits them, so the bound is put into the gap.
    falling = np.append(np.sort(modulus)[::-1], 0.0)
    least = (falling[count - 1] + falling[count]) / 2
    found = schur(Phi, output="real", sort=lambda real, imaginary: np.hypot(real, imaginary) >= least)
    return found[1][:, : found[2]]  # pyright: ignore[reportGeneralTypeIssues, reportIndexIssue]


def _split(Phi: Float[ndarray, "n n"], values: ndarray) -> Float[ndarray, " n"]:
    """How far rounding may have moved each eigenvalue: 100 n eps |Phi| / |y* x|, in balanced units.

    A defective eigenvalue of order k that rounding splits by delta has condition numbers of about
    delta / (k eps |Phi|), so that this reaches the others; a slow pole beside an integrator is far from being it.
    """
    from scipy.linalg import eig, matrix_balance

    balanced: ndarray = matrix_balance(Phi, permute=False)[0]
    solved: tuple[ndarray, ndarray, ndarray] = eig(balanced, left=True, right=True)  # pyright: ignore
    overlap = np.abs(np.einsum("ij,ij->j", solved[1].conj(), solved[2]))
    which = np.abs(values[:, None] - solved[0]).argmin(axis=1)
    moved = _ROOM_OF_SPLITS * len(Phi) * np.finfo(float).eps * np.linalg.norm(balanced) / np.maximum(overlap, 1e-300)
    return moved[which]


def _dominant(A: Float[ndarray, "T m m"], G: Float[ndarray, "T m m"]) -> Float[ndarray, "m r"]:
    """The range of the second moment that grows fastest over one period; nothing where all of them decay."""
    m = A.shape[1]
    if not m or not G.any():
        return np.zeros((m, 0))
    basis = _symmetric_basis(m)
    images, log = _one_period(A, G, basis)
    values, vectors = np.linalg.eig(np.einsum("kij,lij->kl", basis, images))
    real = np.real(values)
    top = int(np.argmax(real))  # a map that keeps the cone has its spectral radius among its eigenvalues
    if not np.log(max(float(real[top]), 1e-300)) + log >= -_MARGIN:
        return np.zeros((m, 0))
    eigenvalues, Z = np.linalg.eigh(np.einsum("kij,k->ij", basis, np.real(vectors[:, top])))
    size = np.abs(eigenvalues)
    return Z[:, size > _RANK * size.max()]


def _closed(A: ndarray, G: ndarray, U: Float[ndarray, "m r"]) -> list[ndarray]:
    """The smallest subspaces U_0, ..., U_{T-1} with U in U_0 that every A_t and G_t maps into the next."""
    spaces = [U, *(np.zeros((len(U), 0)) for _ in A[1:])]
    while True:
        before = sum(space.shape[1] for space in spaces)
        for t in range(len(A)):
            images = np.hstack([A[t] @ spaces[t], _significant(G[t] @ spaces[t], G[t])])
            following = (t + 1) % len(A)
            spaces[following] = _joined(spaces[following], images)
        if sum(space.shape[1] for space in spaces) == before:
            return spaces


def _significant(images: ndarray, G: ndarray) -> ndarray:
    """Columns of G U that are not the rounding of zero."""
    return images[:, np.linalg.norm(images, axis=0) > _RANK * np.linalg.norm(G, 2)]


def _joined(U: ndarray, V: ndarray) -> ndarray:
    """An orthonormal basis of U and V together."""
    new = V / np.maximum(np.linalg.norm(V, axis=0), 1e-300)
    new = new - U @ (U.T @ new)
    Z, sizes, _ = np.linalg.svd(new, full_matrices=False)
    return np.hstack([U, Z[:, sizes > _RANK]])


def _complements(spaces: list[ndarray]) -> Float[ndarray, "T m q"]:
    """Orthonormal bases of what is orthogonal to each; all have one dimension, since A_t is non-singular."""
    return np.stack([_complement(space) for space in spaces])


def _product(A: Float[ndarray, "T n n"]) -> Float[ndarray, "n n"]:
    """A_{T-1} ... A_0."""
    Phi = np.eye(A.shape[1])
    for A_t in A:
        Phi = A_t @ Phi
    return Phi


def _complement(Y: Float[ndarray, "n m"]) -> Float[ndarray, "n r"]:
    return np.linalg.svd(Y, full_matrices=True)[0][:, Y.shape[1] :]


def _periodic_solution(A: ndarray, G: ndarray, noise: Float[ndarray, "T m m"]) -> Float[ndarray, "T m m"]:
    """The periodic X with X_{t+1} = A_t X_t A_t' + G_t X_t G_t' + noise_t, for a stable map."""
    T, m = len(A), A.shape[1]
    if m == 0:
        return np.zeros((T, 0, 0))
    basis = _symmetric_basis(m)
    images, log = _one_period(A, G, basis)
    M = np.einsum("kij,lij->kl", basis, images) * np.exp(log)
    X = np.zeros((m, m))
    for t in range(T):
        X = A[t] @ X @ A[t].T + G[t] @ X @ G[t].T + noise[t]
    start = np.linalg.solve(np.eye(len(M)) - M, np.einsum("kij,ij->k", basis, X))
    solution = [symmetric_part(np.einsum("kij,k->ij", basis, start))]
    for t in range(T - 1):
        solution.append(symmetric_part(A[t] @ solution[t] @ A[t].T + G[t] @ solution[t] @ G[t].T + noise[t]))
    return np.stack(solution)
