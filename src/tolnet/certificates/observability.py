"""Robust collective observability, eq. (11), from exact numbers (docs/mathematics.md, section 11.12).

    sum_{j < L} Phi_{k+j,k}' S_{k+j} Phi_{k+j,k} - alpha I > 0,     S_s = sum_i tau^2 (C'K + K'C - K' Rt K)

for every window, whatever the K: S_s lies below sum_i tau^2 C' Rt^-1 C, by a term of second order in K - Rt^-1 C. In
Rt = R + phi C Pi C' the second moment is replaced by bounds Pi_0 <= X_0, A X_k A' + mu F X_k F' + Q <= X_{k+1}, which
may end in a loop. Nothing is inverted. A direction that no sensor sees at all refutes every alpha > 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import statements
from tolnet.certificates.exact import Exact
from tolnet.certificates.numerals import matrix_text, number_text, shortened, symmetric_text
from tolnet.certificates.verdicts import Proved, Refuted, Undecided
from tolnet.model import CorruptedNetwork, UnsupportedError

KIND = "corrupted-channels"
_GAIN_BITS = (26, 53)
"""Digits of K; the square of their error counts."""
_MOMENT_BITS = (44, 30, 18)
_SLACK = (2.0**-20, 2.0**-10, 2.0**-5, 1.0)
"""How far above the limit of the second moment its bound may lie, tried one after the other."""
_TRIED = (1 - 1e-10, 1 - 1e-6, 1 - 1e-4, 0.999, 0.99, 0.9, 0.5)
"""Parts of the alpha that floating point sees, and of that of what is counted."""
_LONGEST = 2000
"""Instants that are followed one by one, before the bounds of the second moment must have closed their loop."""


class Claimed(NamedTuple):
    """Windows of `window` instants, inside 0..horizon or everywhere; "classical": tau = 1, phi = 0."""

    window: int
    horizon: int | None
    form: Literal["sharp", "classical"] = "sharp"

    @property
    def keys(self) -> dict[str, Any]:
        """The claim's own keys, without alpha."""
        return {"window": self.window, "form": self.form, "horizon": self.horizon}


@dataclass(frozen=True, eq=False)
class Path:
    """The instants 0, 1, ..., m - 1 that a proof speaks of; then the last `loop` of them again and again.

    The loop is a multiple of the period, or 0 where the instants reach the horizon.
    """

    gains: list[list[ndarray]]
    """K, p_i x n for every sensor, at every instant."""
    moments: list[ndarray] | None
    """X, the bounds of the second moment; None where nothing that is used fades."""
    loop: int

    def proof(self) -> dict[str, Any]:
        """As docs/certificate.md has it."""
        moments = None if self.moments is None else [symmetric_text(X) for X in self.moments]
        return {"loop": self.loop, "moments": moments, "gains": [[matrix_text(K) for K in at] for at in self.gains]}


def channels_data(network: CorruptedNetwork) -> dict[str, Any]:
    """The `data` of a certificate about corrupted channels, every quantity over its own period.

    Raises UnsupportedError for functions of k, which no list of numbers holds.
    """
    if any(network.varying[letter].values is None for letter in ("A", "F", "Q", "mu", "C", "R", "tau", "phi")):
        raise UnsupportedError("some matrix is a function of k; certificates speak of constant and periodic ones")
    cuts, squares = network.rows[1:-1], np.cumsum(np.diff(network.rows) ** 2)[:-1]

    def texts(letter: str) -> list[str]:
        return [matrix_text(np.atleast_1d(value)) for value in network.varying[letter].one_period]

    return {
        "kind": KIND,
        "n": network.n,
        "nodes": network.N,
        **{letter: texts(letter) for letter in ("A", "F", "Q", "mu")},
        "C": [list(map(matrix_text, np.split(at, cuts))) for at in network.C.one_period],
        "R": [list(map(matrix_text, np.split(at, squares))) for at in network.R.one_period],
        **{letter: texts(letter) for letter in ("tau", "phi")},
        "initial_second_moment": symmetric_text(network.initial_second_moment),
    }


def prove_observability(
    network: CorruptedNetwork, claimed: Claimed, alpha: float, limit: Float[ndarray, "T n n"] | None
) -> Proved | Undecided:
    """Prove that all windows see at least alpha I, or a little less, from what floating point found.

    `limit` is the limit of the second moment, a matrix a phase of the period; None where it grows: then, without a
    horizon, only what does not fade counts.
    """
    exact = _ExactChannels(network)
    moments, loop, reason = None, exact.period, ""
    fading = claimed.form == "sharp" and any(network.phi(t).any() for t in range(exact.period))
    if fading and (claimed.horizon is not None or limit is not None):
        found = _bounds(exact, claimed.horizon, limit)
        if isinstance(found, str):
            return undecided(claimed, found)
        moments, loop = found
    for bits in _GAIN_BITS:
        count = exact.period if moments is None else len(moments)
        gains = [exact.gains(k, claimed.form, None if moments is None else moments[k], bits) for k in range(count)]
        path = Path(gains, moments, loop)
        gramians = _gramians(exact, path, claimed)
        near = gramians.rounded()
        seen = float(np.linalg.eigvalsh(near)[:, 0].min()) if np.isfinite(near).all() else 0.0
        for below in sorted(
            {float(f"{part * size:.12g}") for part in _TRIED for size in (alpha, seen)}, reverse=True
        ):
            if below > 0 and (gramians - _multiple(below, network.n)).definite().all():
                keys = {"alpha": number_text(below), **claimed.keys}
                return Proved(
                    "observability", statements.observability(below, **claimed.keys), path.proof(), keys=keys
                )
        reason = (
            f"floating point sees alpha = {alpha:.3g}, but what can be counted exactly does not exceed any alpha > 0"
        )
    return undecided(claimed, reason)


def refute_observability(network: CorruptedNetwork, claimed: Claimed) -> Refuted | Undecided:
    """Look for a window, and a direction that no sensor sees in it at all, in exact arithmetic."""
    exact, L, H = _ExactChannels(network), claimed.window, claimed.horizon
    starts = exact.period if H is None else min(exact.period, H - L + 2)
    reason = "every window sees every direction, though some less than floating point can tell from nothing"
    for start in range(starts):
        unseen = exact.unseen(start, L)
        for column in unseen:
            v = _doubles(column)
            if v is not None:
                witness = {"start": start, "vector": matrix_text(v)}
                return Refuted("observability", statements.blindness(**claimed.keys), witness, keys=claimed.keys)
        if unseen:
            reason = f"the direction that no sensor sees in the window from k = {start} is no vector of doubles"
    return undecided(claimed, reason)


def undecided(claimed: Claimed, reason: str) -> Undecided:
    """The verdict where neither was shown."""
    return Undecided("observability", statements.observability(None, **claimed.keys), reason, keys=claimed.keys)


class _ExactChannels:
    """The numbers of the network over one period, exactly."""

    def __init__(self, network: CorruptedNetwork) -> None:
        if network.period is None:
            raise UnsupportedError("some matrix is a function of k; certificates speak of constant and periodic ones")
        self.network, self.period = network, network.period
        each = range(self.period)
        self.A = Exact.of(np.stack([network.A(t) for t in each]))
        self.F = Exact.of(np.stack([network.F(t) for t in each]))
        self.Q = Exact.of(np.stack([network.Q(t) for t in each]))
        self.mu = Exact.of(np.stack([network.mu(t) for t in each]).reshape(-1, 1, 1))
        self.C = Exact.of(np.stack([network.C(t) for t in each]))

    def step(self, k: int, X: ndarray) -> Exact:
        """A X A' + mu F X F' + Q at instant k."""
        t, P = k % self.period, Exact.of(X)
        A, F = self.A[t], self.F[t]
        return A @ P @ A.T + self.mu[t] * (F @ P @ F.T) + self.Q[t]

    def gains(self, k: int, form: str, X: ndarray | None, bits: int) -> list[ndarray]:
        """Rt^-1 C of every sensor, rounded; zero where it fades and there is no bound X of the second moment."""
        network = self.network
        found: list[ndarray] = [np.zeros((0, network.n))] * network.N
        for nodes, C, R in network.sensors(k).groups():
            phi = network.phi(k)[nodes, None, None] * (form == "sharp")
            Rt = R if X is None else R + phi * (C @ X @ C.mT)
            K = np.linalg.solve(Rt, C) if C.size else C
            if X is None:
                K = np.where(phi > 0, 0.0, K)
            mantissa, exponent = np.frexp(K)
            for i, K_i in zip(nodes, np.ldexp(np.round(np.ldexp(mantissa, bits)), exponent - bits), strict=True):
                found[i] = K_i
        return found

    def information(self, k: int, form: str, gains: Sequence[ndarray], X: ndarray | None) -> Exact:
        """sum_i tau^2 (C'K + K'C - K' R K - phi (C'K)' X (C'K))."""
        network = self.network
        total = Exact.of(np.zeros((network.n, network.n)))
        for nodes, C, R in network.sensors(k).groups():
            K = Exact.of(np.stack([gains[i] for i in nodes]))
            seen = Exact.of(C).T @ K
            part = seen + seen.T - K.T @ Exact.of(R) @ K
            if form == "sharp":
                tau, phi = (Exact.of(x(k)[nodes].reshape(-1, 1, 1)) for x in (network.tau, network.phi))
                if X is not None:
                    part = part - phi * (seen.T @ Exact.of(X) @ seen)
                part = tau * tau * part
            total = total + part.sum(axis=0)
        return total

    def unseen(self, start: int, L: int) -> list[list[int]]:
        """Whole vectors that span what no sensor sees in a window.

        N spans it, and M = Phi N up to a power of two. A row c of C with w = c M other than zero, w_j say, leaves the
        combinations w_j N_l - w_l N_j of the columns, and those of M.
        """
        n = self.network.n
        N = np.array([[int(i == j) for j in range(n)] for i in range(n)], dtype=object)
        M = N.copy()
        for k in range(start, start + L):
            C, A = self.C[k % self.period].ints, self.A[k % self.period].ints
            while N.shape[1] and (seeing := (W := C @ M).any(axis=1)).any():
                w = W[int(np.argmax(seeing))]
                j = int(np.argmax(w != 0))
                both = np.concatenate([N, M])
                both = np.delete(both * w[j] - both[:, [j]] * w[None, :], j, axis=1)
                divisors = [math.gcd(*column) for column in both.T.tolist()]
                both = both // np.array(divisors, dtype=object) if divisors else both
                N, M = both[:n], both[n:]
            if not N.shape[1]:
                return []
            M = A @ M
        return N.T.tolist()


def _bounds(
    exact: _ExactChannels, horizon: int | None, limit: Float[ndarray, "T n n"] | None
) -> tuple[list[ndarray], int] | str:
    """Bounds of the second moment, and how many of them, at the end, loop; or why none were found.

    Up to a near horizon nothing loops, since the moments there may lie well below their limit.
    """
    if horizon is not None and horizon < _LONGEST:
        limit = None
    for bits in _MOMENT_BITS:
        for slack in (None,) if limit is None else _SLACK:
            loop = None
            if limit is not None and slack is not None:
                loop = [_above((1 + slack) * P, bits) for P in limit]
                follows = [loop[(t + 1) % len(loop)] for t in range(len(loop))]
                steps = [Exact.of(X) - exact.step(t, loop[t]) for t, X in enumerate(follows)]
                if not all(step.definite() for step in steps):
                    continue
            found = _until(exact, loop, _LONGEST if limit is not None else (horizon or 0) + 1, bits)
            if found is not None and (found[1] or limit is None):
                return found
    return "no bounds of the second moment were found that hold exactly"


def _until(
    exact: _ExactChannels, loop: list[ndarray] | None, count: int, bits: int
) -> tuple[list[ndarray], int] | None:
    """Bounds one by one, until those of the loop hold too; None where rounding spoils one."""
    found: list[ndarray] = []
    least = Exact.of(exact.network.initial_second_moment)
    for k in range(count):
        if loop is not None and (Exact.of(loop[k % len(loop)]) - least).definite():
            return [*found, *(loop[(k + t) % len(loop)] for t in range(len(loop)))], len(loop)
        X = _above(least.rounded(), bits)
        if not np.isfinite(X).all() or not (Exact.of(X) - least).definite():
            return None
        found.append(X)
        least = exact.step(k, X)
    return found, 0


def _above(X: Float[ndarray, "n n"], bits: int) -> Float[ndarray, "n n"]:
    """X in short numerals, raised by more than what rounding takes away."""
    return shortened((X + X.T) / 2 + np.diag(np.diagonal(X)) * len(X) * 2.0 ** (2 - bits), bits)


def _gramians(exact: _ExactChannels, path: Path, claimed: Claimed) -> Exact:
    """The lower bounds of all windows, by their first instant; those that follow repeat some of them."""
    m, loop = len(path.gains), path.loop
    moments = path.moments or [None] * m
    each = [exact.information(k, claimed.form, path.gains[k], moments[k]) for k in range(m)]
    low = min(S.exponent for S in each)
    S = Exact(np.stack([S.ints << (S.exponent - low) for S in each]), low)
    A = exact.A[np.arange(m) % exact.period]
    following = np.arange(1, m + 1)
    following[-1] = m - loop
    G = S
    for _ in range(claimed.window - 1):
        count = m if loop else len(G.ints) - 1
        G = S[:count] + A[:count].T @ G[following[:count]] @ A[:count]
    return G if claimed.horizon is None else G[: claimed.horizon - claimed.window + 2]


def _multiple(alpha: float, n: int) -> Exact:
    return Exact.of(alpha * np.eye(n))


def _doubles(v: Sequence[int]) -> Float[ndarray, " n"] | None:
    """Whole numbers as doubles, scaled by a power of two to below one; None where they are none."""
    v = [x // math.gcd(*v) for x in v]
    size = max(abs(x).bit_length() for x in v)
    lowest = min((x & -x).bit_length() for x in v if x)
    if size - lowest > 1000:
        return None
    odd = [x >> (x & -x).bit_length() - 1 if x else 0 for x in v]
    if any(abs(x).bit_length() > 53 for x in odd):
        return None
    return np.array(
        [math.ldexp(x, (y & -y).bit_length() - 1 - size) if y else 0.0 for x, y in zip(odd, v, strict=True)]
    )
