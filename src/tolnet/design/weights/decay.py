"""The best certified decay rate: weights and a certificate, each improved while the other stands still.

    T_W(X)_k = sigma_k sum_l w_lk M_l X_l M_l',  sigma_k = sum_l w_lk = 1: X_k >= T_W(X)_k / r^2 for some X > 0 proves
    that errors decay like r^t; the best r^2 is the spectral radius of T_W

    X step  fixed W: the least X with X - T_W(X) / s >= I, for s a little above the spectral radius. A semidefinite
            program whose solution is known: X = sum_j T_W^j(I) / s^j, a linear equation
    W step  fixed X: for each node apart, min sum_l w_lk tr(Y_k M_l X_l M_l')  subject to  sum_l w_lk M_l X_l M_l' <=
            s X_k, with Y = sum_j T_W*^j(I) / s^j. The constraint keeps the certificate; the objective is the
            derivative of the spectral radius

Source: docs/mathematics.md, section 12.3; docs/decisions/0022-decay.md.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.analysis.curvature import Columns
from tolnet.design.weights.admissible import Admissible, make_admissible
from tolnet.design.weights.decay_programs import CertificateProgram, ColumnPrograms
from tolnet.design.weights.programs import solve_program
from tolnet.model import DecayCertificate

_SLACK = (0.01, 0.003, 0.001)
"""How far s may be above the spectral radius, relatively: the room that a W step has. Ever less."""
_ROUNDS = 30
_GAIN = 3e-5
"""A round that lowers the spectral radius by less, relatively, is the last with its slack."""
MARGIN = 1e-4
"""How far r^2 of the certificate is above the spectral radius, relatively: room for rounding."""
_DENSE_UP_TO = 200
_FEASIBLE = 1e-7


class DecayDesign(NamedTuple):
    """W with its certificate."""

    W: sparse.csr_array
    certificate: DecayCertificate
    bound: float
    """No W has a better rate with these X_k; by the dual of the W step. 0 after Ctrl-C."""
    before: float
    """The rate before the last step made W exactly admissible."""
    starts: dict[str, float]
    best_start: str
    history: list[float]
    interrupted: bool


class SecondMoments:
    """T_W and its adjoint: diagonal blocks of the errors' second moments, bounded by Cauchy-Schwarz."""

    def __init__(self, columns: Columns, loops: Float[ndarray, "N n n"]) -> None:
        self.columns, self.M = columns, loops
        self.shape = loops.shape
        self.size = loops.size

    def weighing(self, w: Float[ndarray, " L"]) -> sparse.csr_array:
        """sigma_k w_lk as a matrix, node k's row holding what it weighs."""
        sums = self.columns.sums(np.abs(w))
        N = self.columns.nodes
        scaled = np.abs(w) * sums[self.columns.hearer]
        return sparse.csr_array((scaled, (self.columns.hearer, self.columns.sender)), shape=(N, N))

    def apply(self, weighing: sparse.csr_array, X: Float[ndarray, "N n n"]) -> Float[ndarray, "N n n"]:
        """T_W(X)."""
        moved = self.M @ X @ self.M.mT
        return (weighing @ moved.reshape(len(X), -1)).reshape(self.shape)

    def adjoint(self, weighing: sparse.csr_array, Y: Float[ndarray, "N n n"]) -> Float[ndarray, "N n n"]:
        """T_W*(Y)_l = M_l' (sum_k sigma_k w_lk Y_k) M_l."""
        gathered = (weighing.T @ Y.reshape(len(Y), -1)).reshape(self.shape)
        return self.M.mT @ gathered @ self.M

    def radius(self, w: Float[ndarray, " L"]) -> float:
        """The spectral radius of T_W: r^2 of the best certificate with these weights."""
        from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

        weighing = self.weighing(w)
        if self.size <= _DENSE_UP_TO:
            return float(np.abs(np.linalg.eigvals(self._dense(weighing))).max())
        kind: Any = LinearOperator
        solve: Any = eigs
        operator = kind(
            shape=(self.size, self.size),
            matvec=lambda x: self.apply(weighing, x.reshape(self.shape)).ravel(),
            dtype=np.float64,
        )
        start = np.tile(np.eye(self.shape[1]), (self.shape[0], 1, 1)).ravel()
        try:
            found = solve(operator, k=1, v0=start, ncv=30, maxiter=300, tol=1e-9, return_eigenvectors=False)
        except ArpackNoConvergence:
            return self._by_powers(weighing)
        return float(np.abs(found).max())

    def resolvent(self, w: Float[ndarray, " L"], s: float, *, adjoint: bool = False) -> Float[ndarray, "N n n"]:
        """X = sum_j T^j(I) / s^j, the least X with X - T(X) / s >= I; for s above the spectral radius.

        NaN where floating point finds none, as at the radius 0.
        """
        from scipy.sparse.linalg import LinearOperator, gmres

        weighing, one = self.weighing(w), np.broadcast_to(np.eye(self.shape[1]), self.shape)
        apply = self.adjoint if adjoint else self.apply
        if not s > 0:
            return np.full(self.shape, np.nan)
        if self.size <= _DENSE_UP_TO:
            T = self._dense(weighing)
            try:
                X = np.linalg.solve(np.eye(self.size) - (T.T if adjoint else T) / s, one.ravel())
            except np.linalg.LinAlgError:
                return np.full(self.shape, np.nan)
        else:
            kind: Any = LinearOperator
            operator = kind(
                shape=(self.size, self.size),
                matvec=lambda x: x - apply(weighing, x.reshape(self.shape)).ravel() / s,
                dtype=np.float64,
            )
            X, _ = gmres(operator, one.ravel(), rtol=1e-9, restart=80, maxiter=40)
        X = X.reshape(self.shape)
        return (X + X.mT) / 2  # rounding only

    def _dense(self, weighing: sparse.csr_array) -> Float[ndarray, "d d"]:
        N, n, _ = self.shape
        pairs = np.einsum("lij,lpq->lipjq", self.M, self.M).reshape(N, n * n, n * n)
        full = weighing.toarray()[:, None, :, None] * pairs.transpose(1, 0, 2)[None]
        return full.reshape(N * n * n, N * n * n)

    def _by_powers(self, weighing: sparse.csr_array) -> float:
        X = np.tile(np.eye(self.shape[1]), (self.shape[0], 1, 1))
        grown = np.inf
        for _ in range(2000):
            following = self.apply(weighing, X)
            size = float(np.linalg.norm(following))
            grown = size / float(np.linalg.norm(X))
            if not size > 0:
                break
            X = following / size
        return grown


def design_decay(
    among: Admissible,
    loops: Float[ndarray, "N n n"],
    starts: dict[str, Float[ndarray, " L"]],
    watch: Callable[[str, float], None],
    *,
    sdp: bool = False,
) -> DecayDesign:
    """The best certified decay rate by alternating X and W steps, from the start with the best rate.

    W = I is always among the starts, whose rate is the largest spectral radius of the local loops: below 1 where
    every local filter is stable. The certificate is recomputed for the W that is returned. With `sdp` the X and Y of
    every X step come from its semidefinite program instead of the linear equations that solve it.
    """
    columns = among.columns
    moments = SecondMoments(columns, loops)
    alone = np.zeros(len(columns.sender))
    alone[columns.own] = 1.0
    begin = {name: among.project(w) for name, w in {**starts, "none": alone}.items()}
    radii: dict[str, float] = {}
    best_start, w, radius = "none", alone, np.inf
    history: list[float] = []
    interrupted = False
    programs = ColumnPrograms(loops.shape[1])
    certificates = CertificateProgram(columns, loops) if sdp else None
    try:
        for name, start in begin.items():
            radii[name] = moments.radius(start)
            if radii[name] < radius:
                best_start, w, radius = name, start, radii[name]
        history.append(float(np.sqrt(radius)))
        for slack in _SLACK:
            for _ in range(_ROUNDS):
                before = radius
                w, radius = _round(moments, among, programs, certificates, w, radius, slack)
                history.append(float(np.sqrt(radius)))
                watch(f"from {best_start}", history[-1])
                if radius > (1 - _GAIN) * before:
                    break
    except KeyboardInterrupt:
        if not radii:
            raise
        interrupted = True
    W = make_admissible(among, w)
    final = np.asarray(W[columns.sender, columns.hearer]).ravel()
    certificate = certify(moments, final)
    bound = 0.0 if interrupted else rate_bound(moments, among, certificate)  # CVXPY may be half imported then
    rates = {name: float(np.sqrt(value)) for name, value in radii.items()}
    return DecayDesign(
        W, certificate, bound, float(np.sqrt(radius * (1 + MARGIN))), rates, best_start, history, interrupted
    )


def certify(moments: SecondMoments, w: Float[ndarray, " L"]) -> DecayCertificate:
    """X_k for fixed weights with r^2 a little above the spectral radius, and its margin, recomputed."""
    s = moments.radius(w) * (1 + MARGIN)
    X = moments.resolvent(w, s)
    return DecayCertificate(X, float(np.sqrt(s)), moments.M, margin_of(moments, w, X, s))


def margin_of(moments: SecondMoments, w: Float[ndarray, " L"], X: Float[ndarray, "N n n"], s: float) -> float:
    """The least eigenvalue of I - X_k^-1/2 T_W(X)_k X_k^-1/2 / s over all k; -inf unless every X_k > 0."""
    if not np.isfinite(X).all():
        return -np.inf
    eigenvalues, U = np.linalg.eigh(X)
    if not eigenvalues.min() > 0:
        return -np.inf
    root = U / np.sqrt(eigenvalues)[:, None, :]
    seen = root.mT @ moments.apply(moments.weighing(w), X) @ root / s
    return float(1 - np.linalg.eigvalsh((seen + seen.mT) / 2).max())


def rate_bound(moments: SecondMoments, among: Admissible, certificate: DecayCertificate) -> float:
    """A rate that no admissible W beats with these X_k: at every node, max over Lambda of min_l tr(Lambda P_l).

    Lambda >= 0 with trace 1; the largest eigenvalue of any sum_l w_l P_l, P_l = X_k^-1/2 M_l X_l M_l' X_k^-1/2, is at
    least the least tr(Lambda P_l). Any Lambda gives a bound; this one comes from the solver, the bound is recomputed.
    """
    import cvxpy as cp

    n = moments.shape[1]
    worst = 0.0
    programs: dict[int, Any] = {}
    for k in range(moments.columns.nodes):
        P = _seen_from(moments, certificate.X, k)
        if P is None:
            continue  # the bound of the other nodes stays one
        d = len(P)
        if d not in programs:
            Lambda, t = cp.Variable((n, n), PSD=True), cp.Variable()
            matrices = [cp.Parameter((n, n), symmetric=True) for _ in range(d)]
            rows: list[Any] = [cp.trace(Lambda @ matrix) >= t for matrix in matrices]
            limits: list[Any] = [*rows, cp.trace(Lambda) == 1]
            programs[d] = cp.Problem(cp.Maximize(t), limits), Lambda, matrices
        problem, Lambda, matrices = programs[d]
        for matrix, value in zip(matrices, P, strict=True):
            matrix.value = value
        if not solve_program(problem):
            continue
        values, U = np.linalg.eigh((Lambda.value + Lambda.value.T) / 2)
        dual = (U * np.maximum(values, 0.0)) @ U.T
        dual /= np.trace(dual)
        own = moments.columns.offsets[k] + np.arange(d)
        prices = np.einsum("lij,ji->l", P, dual)
        lower = among.lower[k]
        mine = prices[moments.columns.sender[own] == k][0]
        worst = max(worst, float(lower * mine + (1 - lower) * prices.min()))
    return float(np.sqrt(worst))


def _seen_from(moments: SecondMoments, X: Float[ndarray, "N n n"], k: int) -> Float[ndarray, "d n n"] | None:
    """X_k^-1/2 M_l X_l M_l' X_k^-1/2 for the nodes l that node k hears; None where rounding left no X_k > 0."""
    if not np.isfinite(X).all():
        return None
    values, U = np.linalg.eigh(X[k])
    if not values[0] > 0:
        return None
    root = U / np.sqrt(values)
    l = moments.columns.sender[moments.columns.offsets[k] : moments.columns.offsets[k + 1]]
    P = root.T @ moments.M[l] @ X[l] @ moments.M[l].mT @ root
    return (P + P.mT) / 2 if np.isfinite(P).all() else None


def _round(
    moments: SecondMoments,
    among: Admissible,
    programs: ColumnPrograms,
    certificates: CertificateProgram | None,
    w: Float[ndarray, " L"],
    radius: float,
    slack: float,
) -> tuple[Float[ndarray, " L"], float]:
    """One X step and one W step; the weights stay as they are where that lowers nothing."""
    columns = among.columns
    s = radius * (1 + slack)
    steps = certificates.least(w, s) if certificates is not None else None
    X, Y = steps or (moments.resolvent(w, s), moments.resolvent(w, s, adjoint=True))
    target = w.copy()
    for k in range(columns.nodes):
        here = slice(columns.offsets[k], columns.offsets[k + 1])
        l = columns.sender[here]
        if len(l) == 1:
            continue
        cost = np.einsum("ij,lji->l", Y[k], moments.M[l] @ X[l] @ moments.M[l].mT)
        P = _seen_from(moments, X, k)
        if P is None:
            continue
        found = programs.best(P / s, cost, np.where(l == k, among.lower[k], 0.0))
        if found is None:
            continue
        seen = np.einsum("l,lij->ij", np.maximum(found, 0.0), P / s)
        if np.linalg.eigvalsh(seen).max() <= 1 + _FEASIBLE:
            target[here] = found
    target = among.project(target)
    for length in (1.0, 0.5, 0.25, 0.1):
        trial = w + length * (target - w)
        reached = moments.radius(trial)
        if reached < radius:
            return trial, reached
    return w, radius
