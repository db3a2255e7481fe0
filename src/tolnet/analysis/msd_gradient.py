"""How the MSD of a network changes with its weights and its gains: exact gradients by one adjoint Lyapunov solve.

With U = W' (x) I for the filters and I for the centre, F = U F_0 and G = U G_0, where F_0 and G_0 do not depend on W:

    1.  Psi = F_0 Q F_0' + G_0 G_0',  Q = U Psi U'                            errors before and after mixing
    2.  J = sum_k a_k tr Q_kk + b_k tr Psi_kk,  Y = F' Y F + C_a + F_0' C_b F_0         the adjoint
    3.  dJ / dw_lk = 2 tr (Y U Psi)_kl                                        only where node k hears node l

A gain in channel coordinates is a column h_kc for each node k and channel c that it hears, whose output f_c' x has
noise of unit variance: M_k = A - sum_c h_kc f_c', E_k = Q + (A - M_k) Z A'. With Y_0 = U' Y U + C_b, X = Y_0 F_0 Q,

    4.  dJ / dh_kc = 2 (-X_kk + (X_ke S' + (Y_0 E T)_k) A Z) f_c + 2 (Y_0 H)_kc,   S = T (A - G C)

where H stacks the h_kc of all nodes and of the centre. Q and Y share the powers F, F^2, F^4, ... of squared Smith.
Source: docs/mathematics.md, section 12.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.analysis.curvature import Columns, Curvature, GainCurvature, columns_of
from tolnet.analysis.error_dynamics import error_dynamics
from tolnet.analysis.lyapunov_dense import relative_size
from tolnet.model import ErrorDynamics, LeastFavourableModel, SensorNetwork, SteadyState
from tolnet.model.worst_case import standard_deviations

_MOST_DOUBLINGS = 40
_SETTLED = 1e-14
"""Relative size of a doubling's terms at which to stop."""
_LARGE, _FIRST_GLANCE = 300, 4
"""From this dimension on, and after so many doublings, a low rank is looked for."""
_LOW_RANK, _COLUMNS = 1e-9, 50
"""What may be left of a power, relatively, in this many of its columns."""


class _Unmixed(NamedTuple):
    """F_0 and G_0 G_0' of one group of states, with the pieces that they are made of."""

    F: Float[ndarray, "d d"]
    D: Float[ndarray, "d d"]
    loops: Float[ndarray, "K n n"]
    E: Float[ndarray, "K1 n n"]
    H: Float[ndarray, "d c"]


class _Powers(NamedTuple):
    """F, F^2, F^4, ... and, where the next power T of F is numerically of low rank, its range: F^T = V B."""

    doubled: Sequence[Float[ndarray, "d d"]]
    V: Float[ndarray, "d r"]
    B: Float[ndarray, "r d"]


class _Solved(NamedTuple):
    """Q of one group of states, and the powers F, F^2, F^4, ... that its sum was made of."""

    Q: Float[ndarray, "d d"]
    powers: _Powers
    unmixed: _Unmixed


class Errors(NamedTuple):
    """The steady errors of a network at one choice of its weights (and gains)."""

    node_msd: Float[ndarray, " K"]
    """MSD_k; infinite where the network is unstable."""
    mixing: Float[ndarray, "K K"]
    """W'."""
    parts: Sequence[_Solved]

    def sent_msd(self, units: Sequence[Float[ndarray, " n"]]) -> Float[ndarray, " K"]:
        """tr Psi_kk: the errors of what each node sends, before it is mixed."""
        K = len(self.mixing)
        total = np.zeros(K)
        for (Q, _, unmixed), unit in zip(self.parts, units, strict=True):
            own = np.einsum("ij,ij->i", _times_unmixed(unmixed, Q), unmixed.F) + np.diagonal(unmixed.D)
            total += (own.reshape(K + 1, -1) @ unit**2)[:K]
        return total

    @property
    def residual(self) -> float:
        """|F Q F' + G G' - Q| / |Q|, recomputed; the worst of the parts."""
        worst = 0.0
        for Q, powers, unmixed in self.parts:
            n = unmixed.loops.shape[1]
            D = _mixed(self.mixing, _mixed(self.mixing, unmixed.D, n).T, n)
            defect = powers.doubled[0] @ Q @ powers.doubled[0].T + D - Q
            worst = max(worst, relative_size(defect, Q))
        return worst

    @property
    def radius(self) -> float:
        """Spectral radius of the block of F that the filters make."""
        blocks = (
            powers.doubled[0][: len(unmixed.loops) * unmixed.loops.shape[1]] for _, powers, unmixed in self.parts
        )
        return float(max(np.abs(np.linalg.eigvals(F[:, : len(F)])).max() for F in blocks))


@dataclass(frozen=True, eq=False)
class _Part:
    """One group of states that no other group influences: what depends neither on W nor on the gains."""

    states: Int[ndarray, " n"]
    A: Float[ndarray, "n n"]
    noise: Float[ndarray, "n n"]
    ZA: Float[ndarray, "n n"]
    tilt: Float[ndarray, "n n"]
    steering: Float[ndarray, "n n"]
    centre_loop: Float[ndarray, "n n"]
    centre_noise: Float[ndarray, "n n"]
    centre_gain: Float[ndarray, "n c"]
    channels: Float[ndarray, "c n"]
    owner: Int[ndarray, " c"]
    node: Int[ndarray, " H"]
    channel: Int[ndarray, " H"]
    heard: Bool[ndarray, " H"]
    """Whether the node still hears the channel; a gain on a lost one is not used."""
    gain: Float[ndarray, "n H"]
    """h of the filters that the network was given; zero on lost channels."""
    unit: Float[ndarray, " n"]

    def unmixed(self, gain: Float[ndarray, "n H"], K: int) -> _Unmixed:
        """F_0 and G_0 G_0' for some gains."""
        n, c = self.A.shape[0], len(self.channels)
        H = np.zeros((K + 1, n, c))
        H[self.node, :, self.channel] = (gain * self.heard).T
        H[K] = self.centre_gain
        M = self.A - H[:K] @ self.channels
        E = np.concatenate([self.noise + (self.A - M) @ self.ZA, self.centre_noise[None]])
        d = (K + 1) * n
        F = np.zeros((K + 1, n, K + 1, n))
        F[np.arange(K), :, np.arange(K)] = M
        F[:K, :, K] = E[:K] @ self.steering
        F[K, :, K] = self.centre_loop
        H, tall = H.reshape(d, c), E.reshape(d, n)
        D = H @ H.T + tall @ self.tilt @ tall.T + np.tile(self.noise, (K + 1, K + 1))
        return _Unmixed(F.reshape(d, d), (D + D.T) / 2, M, E, H)


class NetworkErrors:
    """Steady errors of a network's filters under a least favourable model, as a function of W and of the gains.

    The variables are one vector: the weights w_lk link by link (`columns`) and, where gains are variables too, the
    h_kc of each group of states, states counted in `unit`. `columns` may be those of a graph with more links: what a
    lost link weighed then goes to w_kk, and the gain on its sensor waits for its return. Dense: (N + 1)^2 n^2 numbers
    for each group of n states that is not coupled to the others; the time of a gradient is that of five products of
    such matrices a doubling.
    Raises what `error_dynamics` raises. `status` and `reason` are those of the dynamics; without numbers there, every
    choice of W has infinite MSD.
    """

    def __init__(
        self,
        network: SensorNetwork,
        local: SteadyState,
        model: LeastFavourableModel,
        *,
        columns: Columns | None = None,
        unit: Float[ndarray, " n"] | None = None,
    ) -> None:
        dynamics = error_dynamics(network, local, sparse.csr_array(sparse.eye_array(network.N)), model)
        self.K = network.N
        self.columns = columns_of(network.adjacency) if columns is None else columns
        l, k = self.columns.sender, self.columns.hearer
        self._from = np.where(np.asarray(network.adjacency[l, k]).ravel(), l, k)
        self.status, self.reason, self.exists = dynamics.status, dynamics.reason, dynamics.exists
        deviation, _ = standard_deviations(model.V)
        self.unit = 2.0 ** np.round(np.log2(deviation)) if unit is None else unit
        self._parts = _split(dynamics, self.unit, self.columns) if dynamics.exists else []

    @property
    def gains(self) -> Float[ndarray, " g"]:
        """The gains that the network was given, as variables."""
        return np.concatenate([np.zeros(0), *(part.gain.ravel() for part in self._parts)])

    def solve(self, z: Float[ndarray, " z"]) -> Errors:
        """Q = F Q F' + G G' for the weights (and gains) z, by squared Smith; infinite MSD where that diverges."""
        K, L = self.K, len(self.columns.sender)
        WT = np.zeros((K, K))
        np.add.at(WT, (self.columns.hearer, self._from), z[:L])
        solved, msd = [], np.zeros(K)
        for part, gain in zip(self._parts, self._unpack(z), strict=True):
            n = len(part.A)
            unmixed = part.unmixed(gain, K)
            D = _mixed(WT, _mixed(WT, unmixed.D, n).T, n)
            found = _squared_smith(_mixed(WT, unmixed.F, n), (D + D.T) / 2)
            if found is None:
                return Errors(np.full(K, np.inf), WT, [])
            Q, powers = found
            msd += (np.diagonal(Q).reshape(K + 1, n) @ part.unit**2)[:K]
            solved.append(_Solved(Q, powers, unmixed))
        return Errors(msd if self.exists else np.full(K, np.inf), WT, solved)

    def sent_msd(self, at: Errors) -> Float[ndarray, " K"]:
        """tr Psi_kk: the mean square error of what each node sends."""
        return at.sent_msd([part.unit for part in self._parts])

    def gradient(
        self, at: Errors, a: Float[ndarray, " K"], b: Float[ndarray, " K"] | None = None, *, gains: bool = False
    ) -> tuple[Float[ndarray, " z"], Curvature]:
        """The gradient of sum_k a_k MSD_k + b_k tr Psi_kk in the weights (and gains), and the curvature node by node.

        Assumes that `at` has finite MSD.
        """
        sent = np.zeros_like(a) if b is None else b
        columns, K = self.columns, self.K
        weights, B = np.zeros(len(columns.sender)), np.zeros(len(columns.pairs[0]))
        for_gains, models = [], []
        i, j = columns.pairs
        k, l, m = columns.hearer[i], self._from[i], self._from[j]
        for part, (Q, powers, unmixed) in zip(self._parts, at.parts, strict=True):
            n = len(part.A)
            shape = (K + 1, n, K + 1, n)
            C_a, C_b = (np.concatenate([np.outer(x, part.unit**2).ravel(), np.zeros(n)]) for x in (a, sent))
            C = np.diag(C_a)
            if sent.any():
                C += (unmixed.F.T * C_b) @ unmixed.F
            Y = _adjoint(powers, C)
            FQ = _times_unmixed(unmixed, Q)
            Psi = _times_unmixed(unmixed, FQ.T) + unmixed.D
            YU = _mixed(at.mixing.T, Y, n).T
            change = (YU @ Psi).reshape(shape)
            weights += 2 * np.einsum("tii->t", change[columns.hearer, :, self._from, :])
            Y4, Psi4 = Y.reshape(shape), Psi.reshape(shape)
            B += np.einsum("tij,tij->t", Y4[k, :, k, :], Psi4[l, :, m, :])
            if gains:
                found, model = _gain_gradient(part, _mixed(at.mixing.T, YU, n) + np.diag(C_b), FQ, Q, unmixed)
                for_gains.append(found.ravel())
                models.append(model)
        return np.concatenate([weights, *for_gains]), Curvature.of_pairs(columns, B, models)

    def _unpack(self, z: Float[ndarray, " z"]) -> list[Float[ndarray, "n H"]]:
        start = len(self.columns.sender)
        if len(z) == start:
            return [part.gain for part in self._parts]
        gains = []
        for part in self._parts:
            stop = start + part.gain.size
            gains.append(z[start:stop].reshape(part.gain.shape))
            start = stop
        return gains

    def channel_gains(self, z: Float[ndarray, " z"], n: int, c: int) -> Float[ndarray, "K n c"]:
        """h of all nodes and all channels of the dynamics, in the state's own units."""
        h = np.zeros((self.K, n, c))
        for part, gain in zip(self._parts, self._unpack(z), strict=True):
            h[part.node[:, None], part.states, part.owner[part.channel][:, None]] = (gain * part.unit[:, None]).T
        return h


def _split(dynamics: ErrorDynamics, scale: Float[ndarray, " n"], columns: Columns) -> list[_Part]:
    """The groups of states that are not coupled, counted in `scale`; gains on every link of `columns`."""
    network, model, K = dynamics.model.network, dynamics.model, dynamics.filters
    linked, hearing = np.zeros((K, K), dtype=bool), dynamics.hearing[:K].toarray() > 0
    linked[columns.hearer, columns.sender] = True
    parts = []
    for states in sorted({tuple(island.states.tolist()) for island in dynamics.islands()}):
        i = np.array(states)
        unit = scale[i]
        like_covariance, like_map = unit * unit[:, None], unit / unit[:, None]
        block = np.ix_(i, i)
        used = np.flatnonzero(dynamics.channels[:, i].any(axis=1))
        f = dynamics.channels[used][:, i] * unit
        AZ = dynamics.gains[:, i][:, :, i] / like_covariance
        node, channel = np.nonzero(linked[:, dynamics.owner[used]])
        heard = hearing[node, dynamics.owner[used][channel]]
        parts.append(
            _Part(
                states=i,
                A=network.A[block] * like_map,
                noise=network.Q[block] / like_covariance,
                ZA=(model.filtered @ network.A.T)[block] / like_covariance,
                tilt=model.tilt[block] * like_covariance,
                steering=model.steering[block] * like_covariance,
                centre_loop=model.closed_loop[block] * like_map,
                centre_noise=model.noise[block] / like_covariance,
                centre_gain=AZ[K] @ f.T,
                channels=f,
                owner=used,
                node=node,
                channel=channel,
                heard=heard,
                gain=np.einsum("hij,hj->ih", AZ[node], f[channel]) * heard,
                unit=unit,
            )
        )
    return parts


def _mixed(WT: Float[ndarray, "K K"], X: Float[ndarray, "d m"], n: int) -> Float[ndarray, "d m"]:
    """(W' (x) I) X for the rows of the filters; those of the centre stay."""
    K, m = len(WT), X.shape[1]
    top = WT @ X[: K * n].reshape(K, n * m)
    return np.concatenate([top.reshape(K * n, m), X[K * n :]])


def _times_unmixed(unmixed: _Unmixed, X: Float[ndarray, "d m"]) -> Float[ndarray, "d m"]:
    """F_0 X, block by block."""
    K, n = unmixed.loops.shape[:2]
    m, filters = X.shape[1], K * n
    moved = (unmixed.loops @ X[:filters].reshape(K, n, m)).reshape(filters, m)
    coupled = unmixed.F[:, filters:] @ X[filters:]
    coupled[:filters] += moved
    return coupled


def _squared_smith(
    F: Float[ndarray, "d d"], D: Float[ndarray, "d d"]
) -> tuple[Float[ndarray, "d d"], _Powers] | None:
    """X = F X F' + D by doubling, and the powers that it took; None where F is not Schur.

    Large F forget differences between neighbours soon: once F^T = V B is of low rank, X = X_T + V S V' with the small
    equation S = (B V) S (B V)' + B X_T B'.
    """
    X, A, doubled = D, F, []
    none = np.zeros((len(F), 0))
    with np.errstate(over="ignore", invalid="ignore"):
        while len(doubled) < _MOST_DOUBLINGS:
            if len(F) >= _LARGE and len(doubled) >= _FIRST_GLANCE and np.isfinite(A).all():
                found = _low_rank(A)
                if found is not None:
                    V, B = found
                    small = _squared_smith(B @ V, _symmetric(B @ X @ B.T))
                    return None if small is None else (X + V @ small[0] @ V.T, _Powers(doubled, V, B))
            doubled.append(A)
            more = A @ X @ A.T
            X = X + _symmetric(more)
            size = np.linalg.norm(X)
            if not np.isfinite(size):
                return None
            if np.linalg.norm(more) <= _SETTLED * size:
                return X, _Powers(doubled, none, none.T)
            A = A @ A
    return None


def _low_rank(A: Float[ndarray, "d d"]) -> tuple[Float[ndarray, "d r"], Float[ndarray, "r d"]] | None:
    """V with orthonormal columns and B with A = V B to rounding, if d / 4 columns are enough."""
    d = len(A)
    V = np.linalg.qr(A @ np.random.default_rng(5).normal(size=(d, d // 4)))[0]
    B = V.T @ A
    lost = np.linalg.norm(A, axis=0) ** 2 - np.linalg.norm(B, axis=0) ** 2
    defect = A[:, :_COLUMNS] - V @ B[:, :_COLUMNS]
    good = np.linalg.norm(defect) <= _LOW_RANK * np.linalg.norm(A[:, :_COLUMNS])
    return (V, B) if good and lost.max() <= 1e-12 * float((A**2).sum()) else None


def _adjoint(powers: _Powers, C: Float[ndarray, "d d"]) -> Float[ndarray, "d d"]:
    """Y = F' Y F + C, from the powers of F."""
    Y = C
    for A in powers.doubled:
        Y = Y + _symmetric(A.T @ Y @ A)
    V, B = powers.V, powers.B
    if V.shape[1]:
        small = _squared_smith((B @ V).T, _symmetric(V.T @ Y @ V))
        assert small is not None  # the transpose of what was Schur before
        Y = Y + B.T @ small[0] @ B
    return Y


def _symmetric(X: Float[ndarray, "d d"]) -> Float[ndarray, "d d"]:
    """Rounding only: the exact matrix is symmetric."""
    return (X + X.T) / 2


def _gain_gradient(
    part: _Part,
    Y: Float[ndarray, "d d"],
    FQ: Float[ndarray, "d d"],
    Q: Float[ndarray, "d d"],
    unmixed: _Unmixed,
) -> tuple[Float[ndarray, "n H"], GainCurvature]:
    """Line 4 of the derivation, with Y_0 for `Y`, and the curvature of every node's gain."""
    K, n = unmixed.loops.shape[:2]
    shape, own, d = (K + 1, n, K + 1, n), np.arange(K), (K + 1) * n
    Y = (Y + Y.T) / 2
    X, Q4, AZ, S = (Y @ FQ).reshape(shape), Q.reshape(shape), part.ZA.T, part.steering
    tilted = (Y @ unmixed.E.reshape(d, n)).reshape(K + 1, n, n)[:K] @ part.tilt
    lead = -X[own, :, own, :] + (X[:K, :, K, :] @ S.T + tilted) @ AZ
    noise = (Y @ unmixed.H).reshape(K + 1, n, -1)
    f = part.channels[part.channel]
    gradient = 2 * np.einsum("hij,hj->ih", lead[part.node], f) + 2 * noise[part.node, :, part.channel].T
    cross = Q4[:K, :, K, :] @ S.T @ AZ
    inner = Q4[own, :, own, :] - cross - cross.mT + part.ZA @ (S @ Q4[K, :, K, :] @ S.T + part.tilt) @ AZ
    model = GainCurvature(Y.reshape(shape)[own, :, own, :], inner, part.channels, part.node, part.channel)
    return gradient * part.heard, model
