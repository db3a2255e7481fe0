"""Stability of a network's error dynamics, proved or refuted in exact integers (docs/certificate.md).

The candidates come from floating point; nothing is believed of them.

    1.  M_k = A - G_k C_k^loc, sigma_k = sum_l |w_lk|, exactly, from the doubles that are deployed
    2.  primal  X_k > 0,  (1 - d) r^2 X_k - sigma_k sum_l |w_lk| M_l X_l M_l' > 0 for every node k
    3.  dual    Y_l > 0,  (1 - d) r^2 Y_l - M_l' (sum_k sigma_k |w_lk| Y_k) M_l > 0 for every node l
    4.  power   the same as 2. for A^j, with shares p_kl in the place of |w_lk| / sigma_k
    5.  full    X > 0,  (1 - d) r^2 X - A X A' > 0
    6.  centre  X > 0,  (1 - d) r^2 X - F_e X F_e' > 0
    7.  refuted, f' X f - X > 0 and v' X v > 0 for f = A or F_e
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.certificates import statements
from tolnet.certificates.exact import Exact
from tolnet.certificates.exact_network import ExactNetwork, both_sides, exact_power
from tolnet.certificates.numerals import matrix_text, number_text, shortened, symmetric_text
from tolnet.certificates.verdicts import Proved, Refuted, Undecided

Method = Literal["primal", "dual", "power", "full"]
Progress = Callable[[int, int], None]
"""Called with how much is done, and how much there is."""

_SHORT, _LONG = 24, 46
"""Bits to which candidates are rounded: few, for a short certificate; more, where that proves nothing."""
_KEPT = 0.999
"""Part of the margin that is claimed of what floating point finds."""
_NODES_AT_A_TIME = 5_000


@dataclass(frozen=True, eq=False)
class Candidate:
    """What floating point found: `X` (N, n, n), or (N n, N n) for `full`; for the centre's block `centre` (n, n).

    `power` j and `shares`, one for each (k, l) of `pattern` (CSR of A^j by nodes), for `power` only.
    """

    method: Method
    X: Float[ndarray, "*shape"]
    centre: Float[ndarray, "n n"] | None = None
    power: int = 1
    shares: sparse.csr_array | None = None


def prove_stability(
    network: ExactNetwork, candidate: Candidate, *, rate: float | None = None, progress: Progress | None = None
) -> Proved | Undecided:
    """Decide exactly whether the candidate proves that every eigenvalue of F lies inside the circle of radius `rate`.

    Without a rate: inside the unit circle. With a centre the claim is on the whole F, else on its network block.
    Source: docs/certificate.md, `schur-stability`; docs/mathematics.md, section 11.
    """
    deployed = network.deployed
    rate = None if rate is None else float(rate)
    block = "network" if deployed.centre is None else "F"
    claim, keys = "schur-stability", {"block": block}
    statement = statements.stability(block)
    if rate is not None:
        claim, keys = "decay-rate", {"block": block, "rate": number_text(rate)}
        statement = statements.decay_rate(block, rate)
    if network.unmixed:
        return Undecided(claim, statement, network.unmixed, keys=keys)
    if not (
        has_positive_diagonal(candidate.X) and (candidate.centre is None or has_positive_diagonal(candidate.centre))
    ):
        return Undecided(claim, statement, f"{candidate.method}: the candidate is not positive definite", keys=keys)
    reason = ""
    for bits in (_SHORT, _LONG):
        attempt = _Attempt(network, candidate, 1.0 if rate is None else rate, bits)
        reason = attempt.run(progress)
        if not reason:
            return Proved(claim, statement, attempt.proof(), attempt.margin, keys=keys)
    return Undecided(claim, statement, f"{candidate.method}: {reason}", keys=keys)


def has_positive_diagonal(X: Float[ndarray, "*shape"]) -> bool:
    """Whether X is finite with a positive diagonal, as whatever is definite has; only then can it be rounded."""
    return bool(np.isfinite(X).all() and (np.diagonal(X, axis1=-2, axis2=-1) > 0).all())


class _Attempt:
    """One candidate, rounded to so many bits, and what it proves."""

    def __init__(self, network: ExactNetwork, candidate: Candidate, rate: float, bits: int) -> None:
        self.network, self.candidate = network, candidate
        self.X = shortened(candidate.X, bits)
        self.centre = None if candidate.centre is None else shortened(candidate.centre, bits)
        self.rate = rate
        self.margin = 0.0

    def run(self, progress: Progress | None) -> str:
        """Decide; the reason why not, or nothing."""
        if self.network.deployed.centre is not None and self.centre is None:
            return "no candidate for the least favourable block"
        self.margin = _shorter(_KEPT * self._estimated_margin())
        if not 0 <= self.margin < 1:
            return f"the candidate's margin is {self.margin:.3g}"
        square = Exact.of(self.rate) * Exact.of(self.rate)
        self.kept = square * (Exact.of(1.0) - Exact.of(self.margin))
        if self.centre is not None:
            _, F = self.network.centre_loops
            X = Exact.of(self.centre)
            if not _both(X, self.kept * X - F @ X @ F.T):
                return "the least favourable block is not proved stable"
        return getattr(self, f"_{self.candidate.method}")(progress)

    def _estimated_margin(self) -> float:
        loops, _ = self.network.deployed.loops
        W = self.network.deployed.mixing
        stack = self.X if self.X.ndim == 3 else self.X[None]
        image = _image(self.candidate, self.X, loops, W)
        ratio = largest_ratio(stack, image) / self.rate ** (2 * self.candidate.power)
        if self.centre is not None:
            F = self.network.centre_loops[1].rounded()
            ratio = max(ratio, largest_ratio(self.centre[None], (F @ self.centre @ F.T)[None]) / self.rate**2)
        return 1 - ratio

    def _primal(self, progress: Progress | None) -> str:
        X, M = Exact.of(self.X), self.network.loops
        moved = M @ X @ M.T
        sigma = self.network.totals.reshape(-1, 1, 1)
        return self._by_node(lambda k: sigma[k] * self.network.heard(moved, k), X, progress)

    def _dual(self, progress: Progress | None) -> str:
        network, Y = self.network, Exact.of(self.X)
        M = network.loops
        return self._by_node(lambda l: M[l].T @ network.spread(Y, l) @ M[l], Y, progress)

    def _by_node(self, image: Callable[[slice], Exact], X: Exact, progress: Progress | None) -> str:
        N = self.network.deployed.N
        for start in range(0, N, _NODES_AT_A_TIME):
            nodes = slice(start, min(start + _NODES_AT_A_TIME, N))
            good = X[nodes].definite() & (self.kept * X[nodes] - image(nodes)).definite()
            if not good.all():
                return f"the inequality of node {start + int(np.argmin(good))} does not hold"
            if progress is not None:
                progress(nodes.stop, N)
        return ""

    def _power(self, progress: Progress | None) -> str:
        assert self.candidate.shares is not None
        deployed, shares = self.network.deployed, self.candidate.shares
        power = exact_power(self.network, self.candidate.power)
        kept = self.kept
        for _ in range(self.candidate.power - 1):
            kept = kept * Exact.of(self.rate) * Exact.of(self.rate)
        X = Exact.of(self.X)
        good = X.definite()
        for k in range(deployed.N):
            p = shares.data[shares.indptr[k] : shares.indptr[k + 1]]
            l = shares.indices[shares.indptr[k] : shares.indptr[k + 1]]
            if not np.array_equal(l, power[k][0]) or not (p > 0).all():
                return f"the shares of node {k} are not those of its paths"
            exact = Exact.of(p)
            if not bool((Exact.of(1.0) - exact.sum(0)).ints >= 0):
                return f"the shares of node {k} exceed one"
            # multiplied by the product of all p_kl: no division
            blocks = power[k][1]
            products = blocks @ X[l] @ blocks.T
            total = _product(exact)
            images = Exact.of(np.zeros((deployed.n, deployed.n)))
            for i in range(len(l)):
                images = images + _product(exact, without=i) * products[i]
            good[k] &= bool((total * kept * X[k] - images).definite())
            if progress is not None:
                progress(k + 1, deployed.N)
        return "" if good.all() else f"the inequality of node {int(np.argmin(good))} does not hold"

    def _full(self, progress: Progress | None) -> str:
        X = Exact.of(self.X)
        image = both_sides(self.network.forwards, X, self.network.deployed.n)
        return "" if _both(X, self.kept * X - image) else "the Lyapunov inequality does not hold"

    def proof(self) -> dict[str, Any]:
        """The proof as the certificate holds it."""
        method = self.candidate.method
        name = "Y" if method == "dual" else "X"
        proof: dict[str, Any] = {"method": method}
        if method == "power":
            shares = self.candidate.shares
            assert shares is not None
            proof["power"] = self.candidate.power
            proof["shares"] = [matrix_text(row) for row in np.split(shares.data, shares.indptr[1:-1])]
        proof[name] = symmetric_text(self.X) if method == "full" else [symmetric_text(X) for X in self.X]
        return proof if self.centre is None else {**proof, "centre": symmetric_text(self.centre)}


def refute_stability(
    network: ExactNetwork,
    of: Literal["network", "centre"],
    X: Float[ndarray, "d d"],
    v: Float[ndarray, " d"],
) -> Refuted | Undecided:
    """Decide exactly whether f' X f - X > 0 and v' X v > 0: then some eigenvalue of f lies outside the unit circle.

    f is the network block A, or the least favourable block F_e.
    Source: docs/certificate.md, `schur-stability`; docs/mathematics.md, section 11.
    """
    block = "network" if network.deployed.centre is None else "F"
    statement = statements.instability(of)
    if network.unmixed:
        return Undecided("schur-stability", statement, network.unmixed, keys={"block": block})
    for bits in (_SHORT, _LONG):
        short, direction = shortened_indefinite(X, bits), _shortened_vector(v, bits)
        witness, x = Exact.of(short), Exact.of(direction[:, None])
        if of == "network":
            image = both_sides(network.backwards, witness, network.deployed.n)
        else:
            image = network.centre_loops[1].T @ witness @ network.centre_loops[1]
        if (x.T @ witness @ x).positive().all() and (image - witness).definite():
            held = {"of": of, "method": "lyapunov", "X": symmetric_text(short), "v": matrix_text(direction)}
            return Refuted("schur-stability", statement, held, keys={"block": block})
    reason = "the indefinite Lyapunov matrix that floating point found is none in exact arithmetic"
    return Undecided("schur-stability", statement, reason, keys={"block": block})


def shortened_indefinite(X: Float[ndarray, "d d"], bits: int) -> Float[ndarray, "d d"]:
    """A symmetric matrix, entries rounded to so many bits below the largest of their row and column."""
    size = np.exp2(np.ceil(np.log2(np.maximum(np.sqrt(np.abs(X).max(axis=0)), 1e-150))))
    unit = size[:, None] * size * 2.0**-bits
    X = np.round(X / unit) * unit
    return np.triu(X) + np.triu(X, 1).T


def _shortened_vector(v: Float[ndarray, " d"], bits: int) -> Float[ndarray, " d"]:
    mantissa, exponent = np.frexp(v)
    return np.ldexp(np.round(np.ldexp(mantissa, bits)), exponent - bits)


def _both(*matrices: Exact) -> bool:
    return all(bool(np.all(X.definite())) for X in matrices)


def _product(values: Exact, without: int | None = None) -> Exact:
    total = Exact.of(1.0)
    for i in range(len(values.ints)):
        if i != without:
            total = total * values[i]
    return total


def _shorter(margin: float) -> float:
    """Three digits of it, rounded down: a number that people can read, and that stays true."""
    if not 0 < margin < np.inf:
        return margin
    near = float(f"{margin:.2e}")
    return near if near <= margin else float(f"{near - 10.0 ** (np.floor(np.log10(margin)) - 2):.2e}")


def largest_ratio(X: Float[ndarray, "K n n"], image: Float[ndarray, "K n n"]) -> float:
    """The largest eigenvalue of X^-1 image; inf where X is not positive definite."""
    scale = np.sqrt(np.maximum(np.diagonal(X, axis1=1, axis2=2), 1e-300))
    both = [Z / (scale[:, :, None] * scale[:, None, :]) for Z in (X, image)]
    try:
        half = np.linalg.inv(np.linalg.cholesky(both[0]))
    except np.linalg.LinAlgError:
        return np.inf
    return float(np.linalg.eigvalsh(half @ both[1] @ half.mT)[:, -1].max())


def _image(
    candidate: Candidate, X: Float[ndarray, "*shape"], M: Float[ndarray, "N n n"], W: sparse.csr_array
) -> Float[ndarray, "K m m"]:
    """T(X) of the candidate's inequality, in floating point."""
    N, n, _ = M.shape
    size = abs(W)
    sigma = np.asarray(size.sum(axis=1))
    if candidate.method == "primal":
        moved = (M @ X @ M.mT).reshape(N, -1)
        return (sigma[:, None] * (size @ moved)).reshape(N, n, n)
    if candidate.method == "dual":
        spread = (size.T @ (sigma[:, None] * X.reshape(N, -1))).reshape(N, n, n)
        return M.mT @ spread @ M
    F = (W.toarray()[:, None, :, None] * M.swapaxes(0, 1)[None]).reshape(N * n, N * n)
    if candidate.method == "full":
        return (F @ X @ F.T)[None]
    F = np.linalg.matrix_power(F, candidate.power).reshape(N, n, N, n)
    assert candidate.shares is not None
    p = candidate.shares.toarray()
    inverse = np.divide(1.0, p, out=np.zeros_like(p), where=p > 0)
    return np.einsum("kl,kalb,lbc,kdlc->kad", inverse, F, X, F, optimize=True)
