"""Matrices that may prove that a network is stable, or that it is not: candidates, found in floating point.

Whether they prove anything is decided in the room of certificates, in exact arithmetic.

    primal  X = T(X) + E,     T(X)_k  = sigma_k sum_l |w_lk| M_l X_l M_l'
    dual    Y = T*(Y) + E,    T*(Y)_l = M_l' (sum_k sigma_k |w_lk| Y_k) M_l
    power   the same as primal for F^j, with shares p_kl of the sum in the place of |w_lk| / sigma_k
    full    X = F X F' / s^2 + E

E is diagonal, in the units of the states.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.analysis.lyapunov_dense import solve_smith

_DENSE_UP_TO = 1500
"""Unknowns up to which the linear equation is solved at once instead of iterated."""
_DENSE_RADIUS_UP_TO = 400
_MOST_STEPS = 3000
_CHECK_EVERY = 8
_GROWN = 1e15
"""A sum of terms that is so much larger than the first has no limit that would prove anything."""
_SHARE_UPDATES = 40
_NARROWINGS = 5

Progress = Callable[[int, int], None]


class PowerCandidate(NamedTuple):
    """X for F^power, and the shares p_kl <= 1 in sum, (N, N)."""

    X: Float[ndarray, "N n n"]
    power: int
    shares: sparse.csr_array


def block_candidate(
    M: Float[ndarray, "N n n"], mixing: sparse.csr_array, *, dual: bool = False, progress: Progress | None = None
) -> Float[ndarray, "N n n"] | None:
    """X with X - T(X) positive definite block by block, or None where the iteration found none.

    `mixing` is W'. Small networks by one dense solve, others by X <- T(X) + E, one sparse product a step.
    Source: docs/mathematics.md, section 11; it is the second-moment test of a Markov jump linear system (O. L. V.
    Costa, M. D. Fragoso, R. P. Marques, Discrete-Time Markov Jump Linear Systems, 2005).
    """
    N, n, _ = M.shape
    return _fixed_point(_block_map(M, mixing, dual), N, n, progress)


def _block_map(
    M: Float[ndarray, "N n n"], mixing: sparse.csr_array, dual: bool
) -> Callable[[Float[ndarray, "N n n"]], Float[ndarray, "N n n"]]:
    """T, or T*."""
    N, n, _ = M.shape
    size = abs(mixing).tocsr()
    sigma = np.asarray(size.sum(axis=1))[:, None]

    def image(X: Float[ndarray, "N n n"]) -> Float[ndarray, "N n n"]:
        if dual:
            spread = size.T @ (sigma * X.reshape(N, -1))
            return M.mT @ spread.reshape(N, n, n) @ M
        moved = (M @ X @ M.mT).reshape(N, -1)
        return (sigma * (size @ moved)).reshape(N, n, n)

    return image


def wide_candidate(
    M: Float[ndarray, "N n n"], mixing: sparse.csr_array, *, dual: bool = False, part: float = 1.0
) -> Float[ndarray, "N n n"] | None:
    """The same with a margin, X - T(X) >= delta X, near the largest or a part of that: one less T's spectral radius.

    X = T(X) / s + E has the margin 1 - s for every s above that radius, which is found by bisection of log(1 - s).
    The nearer to the largest, the nearer is X to an eigenvector of T, which may be nearly singular.
    """
    found = block_candidate(M, mixing, dual=dual)
    if found is None:
        return None
    least = 1 - _largest_ratio(found, _block_map(M, mixing, dual)(found))
    if not 0 < least < 1:
        return found
    low, high = np.log(least), 0.0
    for _ in range(_NARROWINGS):
        middle = (low + high) / 2
        X = block_candidate(M / np.sqrt(1 - np.exp(middle)), mixing, dual=dual)
        low, high, found = (low, middle, found) if X is None else (middle, high, X)
    if part < 1:
        return block_candidate(M / np.sqrt(1 - part * np.exp(low)), mixing, dual=dual)
    return found


def power_candidate(
    M: Float[ndarray, "N n n"], mixing: sparse.csr_array, power: int, progress: Progress | None = None
) -> PowerCandidate | None:
    """X and shares p_kl with X_k - sum_l p_kl^-1 (F^j)_kl X_l (F^j)_kl' > 0, or None. Assumes a moderate size.

    For given X the best shares, in the trace weighted by X_k^-1, are p_kl ~ |X_k^-1/2 (F^j)_kl X_l^1/2|.
    """
    N, n, _ = M.shape
    F = np.linalg.matrix_power(network_matrix(M, mixing), power).reshape(N, n, N, n).swapaxes(1, 2)
    pattern = abs(mixing).sign()
    reach = pattern
    for _ in range(power - 1):
        reach = reach @ pattern
    reach = sparse.csr_array(reach)
    reach.sort_indices()
    k, l = np.repeat(np.arange(N), np.diff(reach.indptr)), reach.indices
    blocks = F[k, l]
    X = np.broadcast_to(np.eye(n), (N, n, n)).copy()
    shares = np.empty(len(k))

    def image(X: Float[ndarray, "N n n"]) -> Float[ndarray, "N n n"]:
        images = (blocks @ X[l] @ blocks.mT) / shares[:, None, None]
        return np.add.reduceat(images, reach.indptr[:-1], axis=0)

    for _ in range(_SHARE_UPDATES):
        norms = np.sqrt(np.einsum("eij,eji->e", np.linalg.inv(X)[k], blocks @ X[l] @ blocks.mT).clip(1e-300))
        norms = np.maximum(norms, 1e-9 * np.maximum.reduceat(norms, reach.indptr[:-1])[k])
        shares = norms / np.add.reduceat(norms, reach.indptr[:-1])[k] * (1 - 2.0**-40)
        X = image(X) + 0.05 * X
        X = (X + X.mT) / 2 / np.trace(X, axis1=1, axis2=2).max()
    found = _fixed_point(image, N, n, progress)
    if found is None:
        return None
    return PowerCandidate(found, power, sparse.csr_array((shares, l, reach.indptr), shape=(N, N)))


class Alternatives(NamedTuple):
    """Several forms of the dual condition of each node: its loop, and how the Y_k of its hearers are weighed."""

    node: Int[ndarray, " K"]
    """The node l of each form; every node has one at least."""
    loops: Float[ndarray, "K n n"]
    spread: sparse.csr_array
    """(K, N): sigma_k |w_lk|."""


def switching_candidate(
    forms: Alternatives, N: int, progress: Progress | None = None
) -> tuple[Float[ndarray, "N n n"], float] | None:
    """One Y with Y_l - M' (sum_k sigma_k |w_lk| Y_k) M > 0 for every form of every node, and the margin; or None.

    Y <- sup over the forms + E, where sup(X, Z) = X + (Z - X)_+ lies above both.
    """
    n = forms.loops.shape[1]
    order = np.argsort(forms.node, kind="stable")
    node, M, spread = forms.node[order], forms.loops[order], forms.spread[order]
    starts = np.searchsorted(node, np.arange(N))
    rank = np.arange(len(node)) - starts[node]

    def images(Y: Float[ndarray, "N n n"]) -> Float[ndarray, "K n n"]:
        return M.mT @ (spread @ Y.reshape(N, n * n)).reshape(-1, n, n) @ M

    def image(Y: Float[ndarray, "N n n"]) -> Float[ndarray, "N n n"]:
        each = images(Y)
        top = each[starts]
        for r in range(1, int(rank.max(initial=0)) + 1):
            some = np.flatnonzero(rank == r)
            k = node[some]
            scale = np.sqrt(np.maximum(np.diagonal(Y[k], axis1=1, axis2=2), 1e-300))
            outer = scale[:, :, None] * scale[:, None, :]
            values, U = np.linalg.eigh((each[some] - top[k]) / outer)
            top[k] += (U * np.maximum(values, 0.0)[:, None, :]) @ U.mT * outer
        return top

    Y = _fixed_point(image, N, n, progress, linear=False)
    if Y is None:
        return None
    ratio = _largest_ratio(Y[node], images(Y))
    return (Y, 1 - ratio) if ratio < 1 else None


def full_candidate(F: Float[ndarray, "d d"], rate: float = 1.0) -> Float[ndarray, "d d"] | None:
    """X with rate^2 X - F X F' > 0 for a dense F, or None where rho(F) is not below the rate.

    X solves the equation of F / s for s between rho(F) and the rate, so that there is a margin.
    """
    radius = float(np.abs(np.linalg.eigvals(F)).max(initial=0.0))
    if not radius < rate:
        return None
    s = np.sqrt(rate * max(radius, 0.05 * rate))
    unit = _units(F)
    X = solve_smith(F / s * (unit / unit[:, None]), np.eye(len(F))).X * (unit[:, None] * unit)
    return X if np.isfinite(X).all() else None


class Growth(NamedTuple):
    """X symmetric with f' X f - X > 0, v with v' X v > 0, and the eigenvalue that grows, with its vector.

    X is None where the matrix is too large for one, or where none was found.
    """

    X: Float[ndarray, "d d"] | None
    v: Float[ndarray, " d"]
    eigenvalue: complex
    mode: ndarray


def growth_candidate(F: Float[ndarray, "d d"]) -> Growth | None:
    """An indefinite Lyapunov matrix that shows an eigenvalue of F outside the unit circle, or None where none is.

    F' X F - X = I has a solution unless two eigenvalues multiply to one; X is positive along what grows.
    """
    from scipy.linalg import LinAlgError, solve_discrete_lyapunov

    eigenvalues, vectors = np.linalg.eig(F)
    largest = int(np.argmax(np.abs(eigenvalues)))
    value, mode = complex(eigenvalues[largest]), vectors[:, largest]
    if not abs(value) > 1:
        return None
    parts = [np.real(mode), np.imag(mode)]
    unit = _units(F)
    scaled = F * (unit / unit[:, None])
    try:
        X = np.asarray(solve_discrete_lyapunov(scaled.T, -np.eye(len(F)))) / (unit[:, None] * unit)
    except LinAlgError:
        X = np.full_like(F, np.nan)
    if not np.isfinite(X).all():
        return Growth(None, parts[0], value, mode)
    X = (X + X.T) / 2  # rounding only: the exact solution is symmetric
    return Growth(X, max(parts, key=lambda v: float(v @ X @ v)), value, mode)


def network_matrix(M: Float[ndarray, "N n n"], mixing: sparse.csr_array) -> Float[ndarray, "d d"]:
    """The network block (W' (x) I) diag(M_l), dense."""
    N, n, _ = M.shape
    return (mixing.toarray()[:, None, :, None] * M.swapaxes(0, 1)[None]).reshape(N * n, N * n)


def network_radius(M: Float[ndarray, "N n n"], mixing: sparse.csr_array) -> float:
    """Spectral radius of the network block: dense eigenvalues if small, else Arnoldi's method; NaN where it fails."""
    N, n, _ = M.shape
    if N * n <= _DENSE_RADIUS_UP_TO:
        return float(np.abs(np.linalg.eigvals(network_matrix(M, mixing))).max(initial=0.0))
    found = _arnoldi(M, mixing)
    return np.nan if found is None or not found.converged else abs(found.eigenvalue)


def leading_mode(M: Float[ndarray, "N n n"], mixing: sparse.csr_array) -> Growth | None:
    """The eigenvalue of the network block that grows fastest, with its vector; None where none was found to grow."""
    found = _arnoldi(M, mixing)
    if found is None or not abs(found.eigenvalue) > 1:
        return None
    return Growth(None, np.real(found.mode), found.eigenvalue, found.mode)


class _Leading(NamedTuple):
    """An eigenvalue of large modulus; the largest where all that were asked for converged."""

    eigenvalue: complex
    mode: ndarray
    converged: bool


def _arnoldi(M: Float[ndarray, "N n n"], mixing: sparse.csr_array) -> _Leading | None:
    """The eigenvalue of largest modulus that Arnoldi's method (ARPACK) finds, and its vector."""
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

    N, n, _ = M.shape

    def step(v: ndarray) -> ndarray:
        return np.asarray(mixing @ (M @ v.reshape(N, n, 1)).reshape(N, n)).ravel()

    kind: Any = LinearOperator
    operator = kind(shape=(N * n, N * n), matvec=step, dtype=np.float64)
    start = np.random.default_rng(3).normal(size=N * n)
    solve: Any = eigs
    try:
        values, vectors = solve(operator, k=4, v0=start, ncv=40, maxiter=500)
        converged = True
    except ArpackNoConvergence as stopped:
        values, vectors, converged = stopped.eigenvalues, stopped.eigenvectors, False
    if not len(values):
        return None
    largest = int(np.argmax(np.abs(values)))
    return _Leading(complex(values[largest]), vectors[:, largest], converged)


def _units(F: Float[ndarray, "d d"]) -> Float[ndarray, " d"]:
    """Powers of two that balance F: F_ij u_j / u_i is of one size."""
    from scipy.linalg import matrix_balance

    _, (scale, _) = matrix_balance(F, permute=False, separate=True)
    return np.asarray(scale)


def _fixed_point(
    image: Callable[[ndarray], ndarray], N: int, n: int, progress: Progress | None, *, linear: bool = True
) -> Float[ndarray, "N n n"] | None:
    """X = T(X) + E for a positive T: the sum of T^j(E), or None where it does not converge."""
    X = np.broadcast_to(np.eye(n), (N, n, n)).copy()
    for _ in range(_CHECK_EVERY):  # towards the slowest direction, whose units E takes
        X = image(X) + X * 0.1
        X /= np.trace(X, axis1=1, axis2=2).max()
    if not np.isfinite(X).all():
        return None
    unit = np.sqrt(np.maximum(np.diagonal(X, axis1=1, axis2=2).mean(axis=0), 1e-300))
    E = np.broadcast_to(np.diag(unit**2), (N, n, n))
    if linear and N * n * n <= _DENSE_UP_TO:
        return _solved(image, E, unit)
    X = E.copy()
    for step in range(_MOST_STEPS):
        following = image(X) + E
        if not np.abs(following / E.max()).max() < _GROWN:
            return None
        if step % _CHECK_EVERY == _CHECK_EVERY - 1:
            ratio = _largest_ratio(X, following - E)
            if not np.isfinite(ratio):
                return None
            growth = (np.abs(following - X).max(axis=0) / unit[:, None] / unit).max()
            if ratio < 1 and growth < 0.05 * (np.abs(X).max(axis=0) / unit[:, None] / unit).max():
                return following
            if progress is not None:
                progress(step + 1, _MOST_STEPS)
        X = (following + following.mT) / 2
    return None


def _solved(
    image: Callable[[ndarray], ndarray], E: Float[ndarray, "N n n"], unit: Float[ndarray, " n"]
) -> Float[ndarray, "N n n"] | None:
    """(I - T)^-1 E by a dense solve over upper triangles, in units of the states; None where it is no covariance."""
    N, n, _ = E.shape
    i, j = np.triu_indices(n)
    d = N * len(i)
    T = np.empty((d, d))
    for column in range(d):
        k, entry = divmod(column, len(i))
        X = np.zeros((N, n, n))
        X[k, i[entry], j[entry]] = X[k, j[entry], i[entry]] = unit[i[entry]] * unit[j[entry]]
        T[:, column] = (image(X)[:, i, j] / (unit[i] * unit[j])).ravel()
    try:
        x = np.linalg.solve(np.eye(d) - T, (E[:, i, j] / (unit[i] * unit[j])).ravel())
    except np.linalg.LinAlgError:
        return None
    X = np.zeros((N, n, n))
    X[:, i, j] = x.reshape(N, -1) * (unit[i] * unit[j])
    X = X + np.triu(X, 1).mT
    return X if np.isfinite(X).all() and _largest_ratio(X, image(X)) < 1 else None


def _largest_ratio(X: Float[ndarray, "N n n"], image: Float[ndarray, "N n n"]) -> float:
    """Largest eigenvalue of X^-1 image; inf where X is not positive definite."""
    diagonal = np.diagonal(X, axis1=1, axis2=2)
    if not (np.isfinite(image).all() and (diagonal > 1e-300).all()):
        return np.inf
    scale = np.sqrt(diagonal)
    outer = scale[:, :, None] * scale[:, None, :]
    try:
        half = np.linalg.inv(np.linalg.cholesky(X / outer))
    except np.linalg.LinAlgError:
        return np.inf
    return float(np.linalg.eigvalsh(half @ (image / outer) @ half.mT)[:, -1].max())


def carriers(mode: ndarray, n: int) -> Int[ndarray, " N"]:
    """Nodes by how much of a mode they carry, the most first."""
    share = np.linalg.norm(mode.reshape(-1, n), axis=1)
    return np.argsort(-share, kind="stable")
