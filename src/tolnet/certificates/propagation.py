"""Mean square deviations of large networks: every source of noise, followed until it has died out.

    Q = sum_t X_t X_t',   X_0 near G,   X_{t+1} near F X_t

in floating point, with a bound on all that "near" leaves out. For Y with Y - F' Y F > d Y and Y > I, as in
docs/mathematics.md, 11.3, let |A|_Y be the least tr(Y D) over +-A <= D. The residual F Q F' + G G' - Q is a sum of

1.  F X X' F' - X_+ X_+' for X_+ = F X + R: at most 2 |X_+| |R| + |R|^2, where |X|^2 = tr X' Y X
2.  X X' - (X V)(X V)', where X is replaced by fewer columns X V: at most e |X|^2 + |X V_out|^2 for a square matrix
    [V, V_out] with |I - V V' - V_out V_out'| <= e
3.  F X_T X_T' F', at most |X_T|^2

and |tr Q_kk - MSD_k| is at most |.|_Y of it, divided by d. All is bounded node by node: |X|^2 <= sum_k l_k x_k^2
for x_k = |X_k|_F and l_k, the largest row sum of |Y_k|.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.certificates.deployed import Deployed
from tolnet.certificates.exact_network import ExactNetwork

_U = 2.0**-53
_RAISED = 1 + 1e-8
"""More than what bounds lose when they are evaluated themselves."""
_TINY = 1e-290
"""More than all underflows of one product."""
_ROOM = 40_000_000
"""Entries of X_0, and of the Gramian of its columns, up to which noise is followed; some copies are held."""
_MOST_WORK = 10**11
"""Entries of all X_t together: ten minutes or so."""
_SMALLEST, _LARGEST = 1e-100, 1e50
"""Of mean square deviations and of Y: far from where squares underflow or overflow."""
_FALLEN = 0.1
_LEFT = 1e-13
"""Part of the whole that columns may carry to be left out, and that may remain at the end."""


class Deviations(NamedTuple):
    """tr Q_kk of every node, then the centre; how far they are together from the mean square deviations."""

    traces: Float[ndarray, " K"]
    error: float


class Sources(NamedTuple):
    """X_0, (N + 1, n, m), with |X_0 X_0' - G G'|_Y; E_k T F_0, the couplings to the centre, and their errors."""

    X: Float[ndarray, "K n m"]
    doubt: float
    coupling: Float[ndarray, "K n n"]
    coupling_error: Float[ndarray, " K"]


def can_follow(deployed: Deployed) -> bool:
    """Whether there is room for the noise of so many sources. Assumes that a centre is stated."""
    network, centre = deployed.network, deployed.centre
    assert centre is not None
    columns = len(network.C) + (network.n if network.B is None else network.B.shape[1]) + centre.tilt.shape[1]
    return columns * max(columns, (deployed.N + 1) * deployed.n) <= _ROOM


def follow_noise(network: ExactNetwork, Y: Float[ndarray, "K n n"], delta: float) -> Deviations | None:
    """Enclose the mean square deviations. Assumes Y - F' Y F > delta Y and Y > I to be shown, the centre's Y last.

    None where the noise does not die out in reasonable time, or is too near the ends of the range of doubles.
    Source: the derivation above; docs/certificate.md, `performance`.
    """
    steps = _Steps(network, Y)
    X, bound = steps.sources.X, steps.sources.doubt
    traces, longest = steps.squares(X), X[0].size
    x = _norms(X)
    whole = last = size = steps.squared(x)
    count = work = 0
    while size > _LEFT * delta * whole:
        work += X.size
        if work > _MOST_WORK or not np.isfinite(size):
            return None
        if size <= _FALLEN * last:
            X, lost = steps.fewer_columns(X, x, _LEFT * delta * whole)
            x, last, bound = _norms(X), size, bound + lost
        X, r = steps.step(X, x)
        x, squares = _norms(X), steps.squares(X)
        traces, bound, size = traces + squares, bound + steps.change(x, r), steps.squared(x)
        whole, count = whole + size, count + 1
    total = float(traces.sum())
    error = _RAISED * (bound + size) / delta + 4 * (longest + count) * _U * total
    safe = total > _SMALLEST and steps.weight.max() < _LARGEST and np.isfinite(error)
    return Deviations(traces, error) if safe else None


class _Steps:
    """F, in floating point and in parts, and what its rounding may cost.

    In coordinates u_i x_i, u_i the power of two next to the largest root of (Y_k)_ii: nothing is rounded on the way
    there, and a norm of a block says as much of its small states as of its large ones.
    """

    def __init__(self, network: ExactNetwork, Y: Float[ndarray, "K n n"]) -> None:
        deployed = self.deployed = network.deployed
        N, n = deployed.N, deployed.n
        unit = self.unit = np.exp2(np.round(np.log2(np.diagonal(Y, axis1=1, axis2=2).max(axis=0)) / 2))
        there = unit[:, None] / unit
        self.weight = np.abs(Y / unit[:, None] / unit).sum(axis=2).max(axis=1) * _RAISED
        self.W, self.size = deployed.mixing, abs(deployed.mixing)
        self.degree = int(np.diff(self.W.indptr).max(initial=0)) + 4
        M, size = (Z * there for Z in deployed.loops)
        outputs = int(np.diff(deployed.columns[deployed.offsets]).max(initial=0))
        F0 = network.centre_loops[0].rounded() * there
        self.M = np.concatenate([M, F0[None]])
        self.doubt = _norms(np.concatenate([4 * (outputs + 4) * _U * size, 8 * _U * np.abs(F0)[None]]))
        self.sources = self._sources(F0)
        self.loop, self.coupling = _norms(self.M), _norms(self.sources.coupling)
        self.product = (n + 4) * _U
        self.N, self.n = N, n

    def squares(self, X: Float[ndarray, "K n m"]) -> Float[ndarray, " K"]:
        """tr X_k X_k' in the coordinates of the problem."""
        return _squares(X / self.unit[:, None])

    def squared(self, x: Float[ndarray, " K"]) -> float:
        """A bound of |X|^2."""
        return _RAISED * float(self.weight @ x**2)

    def change(self, x: Float[ndarray, " K"], r: Float[ndarray, " K"]) -> float:
        """A bound of |X X' - (X + R)(X + R)'|_Y from the norms of X + R and of R."""
        square = self.squared(r)
        return _RAISED * (2 * np.sqrt(self.squared(x)) * np.sqrt(square) + square)

    def mixed(self, X: Float[ndarray, "K n m"]) -> Float[ndarray, "K n m"]:
        """U X, U = diag(W' (x) I, I)."""
        N = self.deployed.N
        return np.concatenate([(self.W @ X[:N].reshape(N, -1)).reshape(N, *X.shape[1:]), X[N:]])

    def spread(self, x: Float[ndarray, " K"], r: Float[ndarray, " K"]) -> Float[ndarray, " K"]:
        """Norms of the error of `mixed`, of X with the norms x and an error of the norms r."""
        N = self.deployed.N
        mixed = self.size @ (r + self.degree * _U * x)[:N]
        return _RAISED * np.append(mixed, r[N]) + _TINY

    def step(self, X: Float[ndarray, "K n m"], x: Float[ndarray, " K"]) -> tuple[ndarray, Float[ndarray, " K"]]:
        """F X, and the norms of its error."""
        Z = self.M @ X
        Z += self.sources.coupling @ X[-1]
        reached = self.loop * x + self.coupling * x[-1]
        r = self.doubt * x + self.sources.coupling_error * x[-1] + self.product * reached
        return self.mixed(Z), self.spread(_RAISED * reached, r)

    def fewer_columns(
        self, X: Float[ndarray, "K n m"], x: Float[ndarray, " K"], spare: float
    ) -> tuple[Float[ndarray, "K n r"], float]:
        """X V for some columns V of a nearly orthogonal matrix, the others carrying at most `spare`; and 2. above."""
        m = X.shape[2]
        flat = X.reshape(-1, m)
        scaled = flat * np.sqrt(np.repeat(self.weight, X.shape[1]))[:, None]
        try:
            energy, V = np.linalg.eigh(scaled.T @ scaled)
        except np.linalg.LinAlgError:
            return X, 0.0
        out = int(np.searchsorted(np.cumsum(np.maximum(energy, 0)), spare))
        if out < m // 8:
            return X, 0.0
        kept, gone = ((flat @ part).reshape(*X.shape[:2], -1) for part in (V[:, out:], V[:, :out]))
        r = 2 * m * _U * np.sqrt(m) * x * _RAISED + _TINY  # |V|_F^2 is near m
        dropped = self.squared(_norms(gone) + r)
        return kept, _defect(V) * self.squared(x) + dropped + self.change(_norms(kept), r)

    def _sources(self, F0: Float[ndarray, "n n"]) -> Sources:
        """H_k = [I, G_k] L for Q and R near L L', and E_k Y for E_k = H_k H_N' and T = Y Y'; then the mixing."""
        deployed = self.deployed
        centre, N, n = deployed.centre, deployed.N, deployed.n
        assert centre is not None
        L, doubt = _noise_factor(deployed)
        P = sparse.diags_array(np.tile(self.unit, N + 1)) @ _inputs(deployed)
        H, spread, rough = (
            sparse.csr_array(Z).toarray().reshape(N + 1, n, -1)
            for Z in (P @ L, abs(P) @ abs(L), abs(P) @ sparse.diags_array(np.sqrt(doubt)))
        )
        far = _norms(rough)  # |p' S q| <= sqrt(p' D p q' D q) for +-S <= D
        tilt, c = centre.tilt / self.unit[:, None], 4 * (H.shape[2] + n + centre.tilt.shape[1] + 8) * _U
        E, E_error = H @ H[N].T, _RAISED * (_norms(c * spread @ spread[N].T) + far * far[N])
        K, K_error = tilt @ (tilt.T @ F0), c * _norm(np.abs(tilt) @ (np.abs(tilt).T @ np.abs(F0)))
        E_norms = _norms(E)
        coupling_error = _RAISED * (E_error * (_norm(K) + K_error) + E_norms * (K_error + c * _norm(K))) + _TINY
        X = np.concatenate([H, E @ tilt], axis=2)
        r = _RAISED * (_norms(c * spread) + (E_error + c * E_norms) * _norm(tilt))
        r = self.spread(_norms(X), r)
        X = self.mixed(X)
        factors = self.squared(_RAISED * np.append(self.size @ far[:N], far[N]))
        return Sources(X, self.change(_norms(X), r) + factors, E @ K, coupling_error)


def _noise_factor(deployed: Deployed) -> tuple[sparse.csr_array, Float[ndarray, " s"]]:
    """L with L L' near diag(Q, R), and d with +-(diag(Q, R) - L L') <= diag(d)."""
    network = deployed.network
    factors = [_factor(network.Q) if network.B is None else (network.B, np.zeros(network.n))]
    for k in np.flatnonzero(np.diff(network.rows)).tolist():
        if network.factors is not None and network.factors.filled[k]:
            D = network.factors.block(k)
            factors.append((D, np.zeros(len(D))))
        else:
            factors.append(_factor(network.sensors.block(k)))
    return sparse.csr_array(sparse.block_diag([L for L, _ in factors])), np.concatenate([d for _, d in factors])


def _factor(S: Float[ndarray, "p p"]) -> tuple[Float[ndarray, "p p"], Float[ndarray, " p"]]:
    """L with L L' near a semidefinite S, and d with +-(S - L L') <= diag(d), in the units that S has."""
    scale = np.sqrt(np.maximum(np.diagonal(S), np.finfo(float).tiny))
    values, V = np.linalg.eigh(S / scale[:, None] / scale)
    L = scale[:, None] * V * np.sqrt(np.maximum(values, 0.0))
    size = np.abs(L) @ np.abs(L).T + np.abs(S)
    missed = np.abs(S - L @ L.T) + 2 * (len(S) + 4) * _U * size
    return L, _RAISED * (missed * (scale[:, None] / scale)).sum(axis=1) + _TINY  # 2 x y <= x^2 s / t + y^2 t / s


def _inputs(deployed: Deployed) -> sparse.csr_array:
    """[I, G_k] for every node and the centre, one below the other: ((N + 1) n, n + M)."""
    N, n, centre = deployed.N, deployed.n, deployed.centre
    assert centre is not None
    M = len(centre.gain)
    hearer = np.append(np.repeat(deployed.hearer, np.diff(deployed.columns)), np.full(M, N))
    sensor = np.append(deployed.sensor_rows, np.arange(M))
    gains = np.concatenate([deployed.gains, centre.gain])
    state = np.arange(n)
    rows = np.concatenate([np.arange((N + 1) * n), (hearer[:, None] * n + state).ravel()])
    columns = np.concatenate([np.tile(state, N + 1), np.repeat(n + sensor, n)])
    values = np.concatenate([np.ones((N + 1) * n), gains.ravel()])
    return sparse.csr_array(sparse.coo_array((values, (rows, columns)), shape=((N + 1) * n, n + M)))


def _defect(V: Float[ndarray, "m m"]) -> float:
    """A bound of |I - V V'| in the spectral norm: the leading 22 bits of V multiply without rounding."""
    m = len(V)
    high = np.round(V * 2.0**22) * 2.0**-22
    low = V - high
    if not np.square(high).sum(axis=1).max() < 2:
        return np.inf
    cross = high @ low.T
    defect = np.eye(m) - high @ high.T - cross - cross.T - low @ low.T
    rounding = 4 * (m + 4) * _U * _norm(np.abs(low)) * (_norm(high) + _norm(low)) + 8 * _U * _norm(defect)
    return _RAISED * (_norm(defect) + rounding)


def _squares(X: Float[ndarray, "K n m"]) -> Float[ndarray, " K"]:
    return np.einsum("kim,kim->k", X, X)


def _norms(X: Float[ndarray, "K n m"]) -> Float[ndarray, " K"]:
    """Frobenius norms, or a little more."""
    return _RAISED * np.sqrt(_squares(X)) + _TINY


def _norm(X: ndarray) -> float:
    return _RAISED * float(np.linalg.norm(X)) + _TINY
