"""The best certified decay rate: several searches, and a certificate for the best of what they lead to.

    T_W(X)_k = sigma_k sum_l w_lk M_l X_l M_l',  sigma_k = sum_l w_lk = 1: X_k >= T_W(X)_k / r^2 for some X > 0 proves
    that errors decay like r^t; the best r^2 is the spectral radius of T_W

    alternate  from the best start. X step, fixed W: the least X with X - T_W(X) / s >= I, for s a little above the
               spectral radius, a semidefinite program whose solution is known: X = sum_j T_W^j(I) / s^j, a linear
               equation. W step, fixed X: for each node apart, min sum_l w_lk tr(Y_k M_l X_l M_l')  subject to
               sum_l w_lk M_l X_l M_l' <= s X_k, with Y = sum_j T_W*^j(I) / s^j. The constraint keeps the certificate;
               the objective is the derivative of the spectral radius
    polish     from there and from other starts: down the slope of the spectral radius
    exchange   the columns of the best, node by node, and polish again

The least spectral radius is no convex problem, and these are local searches: nothing bounds how far they are from the
best W. (The dual of a W step bounds the rate for its X alone; other X do better.)
Source: docs/mathematics.md, section 12.3; docs/decisions/0022-decay.md and 0025-decay-search.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.design.weights.admissible import Admissible, make_admissible
from tolnet.design.weights.decay_polish import exchange, polish
from tolnet.design.weights.decay_programs import CertificateProgram, ColumnPrograms
from tolnet.design.weights.second_moments import SecondMoments
from tolnet.model import DecayCertificate

_SLACK = (0.01, 0.003, 0.001)
"""How far s may be above the spectral radius, relatively: the room that a W step has. Ever less."""
_ROUNDS = 30
_GAIN = 3e-5
"""A round that lowers the spectral radius by less, relatively, is the last with its slack."""
MARGIN = 1e-4
"""How far r^2 of the certificate is above the spectral radius, relatively: room for rounding."""
LEAST_RATE = 1e-3
"""No smaller rate is claimed: errors that die out in a few steps (T_W nilpotent) leave nothing to search for, and the
X of ever smaller rates grow beyond what rounding leaves definite."""
_FEASIBLE = 1e-7
_SEARCHES = ((150, 100, 8), (500, 4, 2), (1500, 2, 0))
"""Up to so many unknowns in X, polish from so many of the best starts, and from so many random ones; else not."""
_EXCHANGE_UP_TO = 500
RANDOM = "random"
"""How the names of random starts begin."""

Watch = Callable[[str, float], None]


class DecayDesign(NamedTuple):
    """W with its certificate."""

    W: sparse.csr_array
    certificate: DecayCertificate
    before: float
    """The rate before the last step made W exactly admissible."""
    starts: dict[str, float]
    ends: dict[str, float]
    """Where the searches from some of the starts ended."""
    best_start: str
    history: list[float]
    evaluations: int
    interrupted: bool


def design_decay(
    among: Admissible,
    loops: Float[ndarray, "N n n"],
    starts: dict[str, Float[ndarray, " L"]],
    watch: Watch,
    *,
    sdp: bool = False,
    thorough: bool = True,
) -> DecayDesign:
    """The best certified decay rate that is found from some starts; without `thorough` by alternation alone.

    W = I is always among the starts, whose rate is the largest spectral radius of the local loops: below 1 where
    every local filter is stable. The certificate is recomputed for the W that is returned. With `sdp` the X and Y of
    every X step come from its semidefinite program instead of the linear equations that solve it.
    """
    columns = among.columns
    moments = SecondMoments(columns, loops)
    alone = np.zeros(len(columns.sender))
    alone[columns.own] = 1.0
    best_of, drawn = next(((most, drawn) for size, most, drawn in _SEARCHES if moments.unknowns <= size), (0, 0))
    begin = {**starts, "none": alone}
    if thorough:
        begin |= _random(among, drawn)
    found = _Search(moments, among, alone, watch)
    try:
        for name, w in begin.items():
            found.start(name, among.project(w))
        if found.radius > LEAST_RATE**2:
            _alternate(found, CertificateProgram(columns, loops) if sdp else None)
            if thorough and best_of:
                _polish(found, best_of)
    except KeyboardInterrupt:
        if not found.radii:
            raise
        found.interrupted = True
    W = make_admissible(among, found.w)
    certificate = certify(moments, np.asarray(W[columns.sender, columns.hearer]).ravel())
    return DecayDesign(
        W,
        certificate,
        float(np.sqrt(max(found.radius * (1 + MARGIN), LEAST_RATE**2))),
        {name: float(np.sqrt(radius)) for name, radius in found.radii.items()},
        {name: float(np.sqrt(radius)) for name, radius in found.ends.items()},
        found.best_start,
        found.history,
        found.evaluations,
        found.interrupted,
    )


@dataclass(eq=False)
class _Search:
    """The best so far, and on the way to it."""

    moments: SecondMoments
    among: Admissible
    w: Float[ndarray, " L"]
    watch: Watch
    radius: float = np.inf
    best_start: str = "none"
    begin: dict[str, Float[ndarray, " L"]] = field(default_factory=dict)
    radii: dict[str, float] = field(default_factory=dict)
    ends: dict[str, float] = field(default_factory=dict)
    history: list[float] = field(default_factory=list)
    evaluations: int = 0
    interrupted: bool = False

    def start(self, name: str, w: Float[ndarray, " L"]) -> None:
        """One more start."""
        self.begin[name], self.radii[name] = w, self.moments.radius(w)
        self.evaluations += 1
        self.offer(name, w, self.radii[name])

    def offer(self, name: str, w: Float[ndarray, " L"], radius: float) -> None:
        """Keep w where it is better than the best."""
        if radius < self.radius:
            self.w, self.radius, self.best_start = w, radius, name
        self.tell(name, self.radius)

    def tell(self, name: str, radius: float) -> None:
        """Say how far a search has come."""
        reached = float(np.sqrt(min(radius, self.radius)))
        self.history.append(min([reached, *self.history[-1:]]))
        self.watch(f"from {name}", self.history[-1])


def _random(among: Admissible, drawn: int) -> dict[str, Float[ndarray, " L"]]:
    """Random weights, always the same ones, near the corners of their simplices more often than uniform ones are."""
    columns = among.columns
    squares = np.random.default_rng(0).exponential(size=(drawn, len(columns.sender))) ** 2
    return {f"{RANDOM}-{i + 1}": w / columns.sums(w)[columns.hearer] for i, w in enumerate(squares)}


def _alternate(found: _Search, certificates: CertificateProgram | None) -> None:
    """X and W steps from the best start, with ever less slack."""
    name, programs = found.best_start, ColumnPrograms(found.moments.shape[1])
    for slack in _SLACK:
        for _ in range(_ROUNDS):
            before = found.radius
            w, radius = _round(found.moments, found.among, programs, certificates, found.w, before, slack)
            found.evaluations += 1
            found.offer(name, w, radius)
            if radius > (1 - _GAIN) * before:
                break
    found.ends[name] = found.radius


def _polish(found: _Search, best_of: int) -> None:
    """Down the slope from where the alternation ended, from the best starts and from random ones; then exchanges."""
    moments, among = found.moments, found.among
    for name, w in [(found.best_start, found.w), *_chosen(found, best_of)]:
        end = polish(moments, among, w, lambda radius, name=name: found.tell(name, radius))
        found.evaluations += end.evaluations
        found.ends[name] = min(found.ends.get(name, np.inf), end.radius)
        found.offer(name, end.w, end.radius)
    name = found.best_start
    if moments.unknowns > _EXCHANGE_UP_TO:
        return
    swapped = exchange(moments, among, found.w, lambda radius: found.tell(name, radius))
    end = polish(moments, among, swapped.w, lambda radius: found.tell(name, radius))
    found.evaluations += swapped.evaluations + end.evaluations
    for each in (swapped, end):
        found.offer(name, each.w, each.radius)
    found.ends[name] = found.radius


def _chosen(found: _Search, best_of: int) -> Iterator[tuple[str, Float[ndarray, " L"]]]:
    """The best starts, each different one once, and all random ones."""
    known = [name for name in sorted(found.begin, key=found.radii.__getitem__) if not name.startswith(RANDOM)]
    seen: set[bytes] = set()
    for name in known:
        if len(seen) < best_of and found.begin[name].tobytes() not in seen:
            seen.add(found.begin[name].tobytes())
            yield name, found.begin[name]
    yield from ((name, w) for name, w in found.begin.items() if name.startswith(RANDOM))


def certify(moments: SecondMoments, w: Float[ndarray, " L"]) -> DecayCertificate:
    """X_k for fixed weights with r^2 a little above the spectral radius, and its margin, recomputed."""
    s = max(moments.radius(w) * (1 + MARGIN), LEAST_RATE**2)
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
