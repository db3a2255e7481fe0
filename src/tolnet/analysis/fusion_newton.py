"""Newton's method for fusion weights: weights, slack and multipliers of eq. (17) move together.

With mu > 0 the minimum of the barrier function tr(M P) - mu sum_j log delta_j - mu log det S is where

    1.  g_j + lambda - z_j - <Omega_j, Z> = 0,   g_j = -<Omega_j, P M P>
    2.  sum_j delta_j = 1,   S = Omega(delta) - I
    3.  delta_j z_j = mu,   S Z = mu I

which is solved for all unknowns at once while mu falls (a predictor-corrector method). Equation 3 is linearised in
the coordinates of Nesterov and Todd, in which S and Z are one diagonal matrix D: with H S H' = D = H'^-1 Z H^-1 and
X~ = H X H',

    4.  dZ~ = Y - dS~,   dS~ = Omega~(d delta) + missing~,   Y_ij = (mu I - D^2 - correction)_ij / ((D_i + D_j) / 2)
    5.  (Hessian + [<Omega~_j, Omega~_k>] + diag(z / delta)) d delta + lambda
            = -g + mu / delta + <Omega~_j, D + Y - missing~>,   sum_j d delta_j = 0

Without the constraint, S and Z have no rows. What was tried instead: decision 0035.
Source: docs/mathematics.md, section 13.6.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from tolnet.analysis.stacked import cholesky, eigenvalues, inverse, solve, symmetric_part

_SHRINK = 0.7
"""The part of any Omega(delta) that a step may remove: beyond, its quadratic model says nothing of the trace."""
_FEASIBLE = 1e-12
"""The slack that may be missing in the end, where Omega of the reference is I. The bound is lowered by what it buys,
which is up to 1e6 times as much of the trace where there is hardly any room."""


class Haste(NamedTuple):
    """How boldly to go on."""

    cautious: bool
    """Every step aims at the same part of mu, without a predictor."""
    most: int
    """Steps."""
    patience: int
    """Steps without progress after which a problem is given up."""


BOLD = Haste(False, 50, 8)
"""Ten steps or so; fails once in some hundred times where hardly any weights but the reference are feasible."""
CAREFUL = Haste(True, 150, 30)
"""Some fifty steps."""


class Solution(NamedTuple):
    """Weights, the multiplier Z of the constraint, and the steps that were taken."""

    weights: Float[ndarray, "B J"]
    multiplier: Float[ndarray, "B n n"]
    iterations: Int[ndarray, " B"]


def minimise(
    Omega: Float[ndarray, "B J n n"],
    M: Float[ndarray, "B n n"],
    *,
    constrained: bool,
    gap: float,
    haste: Haste = BOLD,
) -> Solution:
    """Minimise tr(M Omega(delta)^-1) over the simplex, with Omega(delta) >= I where `constrained`.

    Stops at a relative duality gap of `gap`; where it cannot get there, with the best weights that it met.
    """
    at = _start(Omega, M, constrained)
    B, _, n, _ = Omega.shape
    m = at.S.shape[1]
    best = Solution(at.delta.copy(), np.zeros((B, n, n)), np.zeros(B, dtype=int))
    score, waiting = np.full(B, np.inf), np.zeros(B, dtype=int)
    with np.errstate(all="ignore"):  # a step that leaves the doubles shows as a score that is not finite
        for step in range(haste.most):
            slope = _Slope.at(at)
            now = np.maximum(_proven_gap(at, slope) / gap, np.linalg.norm(at.missing, axis=(1, 2)) / _FEASIBLE)
            better = now < score[at.place]
            where = at.place[better]
            score[where], best.weights[where], best.iterations[where] = now[better], at.delta[better], step
            best.multiplier[where, :m, :m] = at.proof[better]
            waiting[at.place] = np.where(better, 0, waiting[at.place] + 1)
            moving = np.isfinite(now) & (now > 1) & (waiting[at.place] < haste.patience)
            if not moving.any():
                break
            at, slope = at.keep(moving), slope.keep(moving)
            _advance(at, slope, gap, haste)
    return best


@dataclass
class _Iterate:
    """The problems that are still moving, and where they are. m = n rows in the constraint, or 0."""

    place: Int[ndarray, " B"]
    """Which problem of the stack each one is."""
    Omega: Float[ndarray, "B J n n"]
    side_by_side: Float[ndarray, "B n Jn"]
    """[Omega_1, ..., Omega_J] in one row."""
    M: Float[ndarray, "B n n"]
    delta: Float[ndarray, "B J"]
    z: Float[ndarray, "B J"]
    S: Float[ndarray, "B m m"]
    Z: Float[ndarray, "B m m"]
    missing: Float[ndarray, "B m m"]
    """Omega(delta) - I - S. Every step leaves the same part of it: recomputing it would only add rounding."""
    proof: Float[ndarray, "B m m"]
    """The Z of the iterates so far that proved the smallest gap..."""
    proven: Float[ndarray, " B"]
    """... which is this, at the weights that it came with."""

    def keep(self, mask: Bool[ndarray, " B"]) -> _Iterate:
        """Only some of them."""
        return self if mask.all() else _Iterate(*(getattr(self, item.name)[mask] for item in fields(self)))


def _start(Omega: Float[ndarray, "B J n n"], M: Float[ndarray, "B n n"], constrained: bool) -> _Iterate:
    """Uniform weights, and a slack of I whether it is there or not."""
    B, J, n, _ = Omega.shape
    m = n if constrained else 0
    eye = np.broadcast_to(np.eye(m), (B, m, m))
    delta = np.full((B, J), 1 / J)
    missing = _combine(delta, Omega)[:, :m, :m] - 2 * eye
    return _Iterate(
        place=np.arange(B),
        Omega=Omega,
        side_by_side=np.moveaxis(Omega, 1, 2).reshape(B, n, J * n),
        M=M,
        delta=delta,
        z=np.ones((B, J)),
        S=eye.copy(),
        Z=eye / J,
        missing=missing,
        proof=eye / J,
        proven=np.full(B, np.inf),
    )


class _Slope(NamedTuple):
    """The objective and its derivatives at an iterate."""

    root: Float[ndarray, "B n n"]
    """The inverse of Cholesky's factor of Omega(delta)."""
    P: Float[ndarray, "B n n"]
    N: Float[ndarray, "B n n"]
    """P M P."""
    value: Float[ndarray, " B"]
    g: Float[ndarray, "B J"]

    @classmethod
    def at(cls, at: _Iterate) -> _Slope:
        root = inverse(cholesky(_combine(at.delta, at.Omega)))
        P = root.mT @ root
        N = P @ at.M @ P
        return cls(root, P, N, np.einsum("bij,bij->b", at.M, P), -_inner(at.Omega, N))

    def keep(self, mask: Bool[ndarray, " B"]) -> _Slope:
        return self if mask.all() else _Slope(*(each[mask] for each in self))

    def curvature(self, at: _Iterate) -> Float[ndarray, "B J J"]:
        """The Hessian, 2 tr(Omega_j P Omega_k P M P), for unknowns d delta_j / delta_j."""
        flat = at.Omega.reshape(*at.delta.shape, -1) * (2 * at.delta)[:, :, None]
        return flat @ (_between(self.P, at.side_by_side, self.N) * at.delta[:, None, :])


def _proven_gap(at: _Iterate, slope: _Slope) -> Float[ndarray, " B"]:
    """What the best multiplier so far proves. Where the weights have no room, rounding spoils later ones."""
    own = _gap(at, slope, at.Z)
    if not at.Z.shape[1]:
        return own
    better = own < at.proven
    at.proven = np.where(better, own, at.proven)
    at.proof = np.where(better[:, None, None], at.Z, at.proof)
    return own if better.all() else _gap(at, slope, at.proof)


def _gap(at: _Iterate, slope: _Slope, Z: Float[ndarray, "B m m"]) -> Float[ndarray, " B"]:
    """By how much the objective may be above its minimum, relative to it, as the multiplier Z proves."""
    towards = slope.g - (_inner(at.Omega, Z) if Z.shape[1] else 0.0)
    bound = (slope.g * at.delta).sum(axis=1) - np.trace(Z, axis1=1, axis2=2) - towards.min(axis=1)
    return np.abs(bound) / slope.value


def _advance(at: _Iterate, slope: _Slope, gap: float, haste: Haste) -> None:
    """One step, in place."""
    system = _System(at, slope)
    floor = 0.1 * gap * slope.value / system.barrier  # below it, rounding spoils the multipliers
    if haste.cautious:
        step = system.direction(np.maximum(0.7 * system.mu, floor))
        wall = np.full(len(floor), 0.8)
    else:
        ahead = system.direction(np.zeros(len(floor)))
        reach = np.minimum(1.0, system.room(ahead, opposite=True))
        left = system.complementarity(ahead, reach) / system.mu
        centring = np.clip(left ** np.maximum(1.0, 3 * reach**2), 1e-6, 1.0)
        step = system.direction(np.maximum(centring * system.mu, floor), ahead, reach)
        wall = 0.9 + 0.09 * reach
    system.move(step, np.minimum(np.minimum(1.0, system.trust(step)), wall * system.room(step)))


class _Step(NamedTuple):
    delta: Float[ndarray, "B J"]
    z: Float[ndarray, "B J"]
    S: Float[ndarray, "B m m"]
    """In the coordinates of Nesterov and Todd, as Z."""
    Z: Float[ndarray, "B m m"]


class _System:
    """The linearised equations 4 and 5 at one iterate, and what steps do to it."""

    def __init__(self, at: _Iterate, slope: _Slope) -> None:
        self.at, self.slope = at, slope
        (self.B, self.J), self.m = at.delta.shape, at.S.shape[1]
        self.barrier = self.J + self.m
        product = at.delta * at.z
        # unknowns d delta_j / delta_j: every row then has entries of one size
        self.K = slope.curvature(at)
        self.D = np.zeros((self.B, 0))
        self.missing = self.diagonal = np.zeros((self.B, 0, 0))
        if self.m:
            self._scale()
            self.K += self.scaled.mT @ self.scaled
        self.mu = (product.sum(axis=1) + (self.D**2).sum(axis=1)) / self.barrier
        self.K[:, np.arange(self.J), np.arange(self.J)] += product
        self.unity: Float[ndarray, "B J"] | None = None

    def _scale(self) -> None:
        """Nesterov and Todd's coordinates, from the factors of S and Z without an inverse."""
        at, m = self.at, self.m
        L, R = cholesky(at.S), cholesky(at.Z)
        U, self.D, Vt = np.linalg.svd(np.nan_to_num(R.mT @ L))
        root = np.sqrt(self.D)
        self.back, self.H = L @ Vt.mT / root[:, None, :], U.mT @ R.mT / root[:, :, None]
        self.scaled = _between(self.H, at.side_by_side, self.H.mT) * at.delta[:, None, :]
        self.missing = self.H @ at.missing @ self.H.mT
        self.between = (self.D[:, :, None] + self.D[:, None, :]) / 2
        self.diagonal = self.D[:, :, None] * np.eye(m)
        self.unit = 1 / (root[:, :, None] * root[:, None, :])

    def direction(
        self, mu: Float[ndarray, " B"], ahead: _Step | None = None, reach: Float[ndarray, " B"] | None = None
    ) -> _Step:
        """Towards the point of the central path at mu.

        `ahead` gives the terms of second order; where only a part of it, `reach`, could be taken, they count as much.
        """
        at, m = self.at, self.m
        right = np.broadcast_to(mu[:, None], at.delta.shape)
        target = mu[:, None, None] * np.eye(m) - self.diagonal**2
        if ahead is not None and reach is not None:
            right = right - reach[:, None] * ahead.delta * ahead.z
            target = target - reach[:, None, None] * symmetric_part(ahead.S @ ahead.Z)
        rows = right - at.delta * self.slope.g
        Y = target
        if m:
            Y = target / self.between
            pull = (self.diagonal + Y - self.missing).reshape(self.B, 1, m * m) @ self.scaled
            rows = rows + pull[:, 0, :]
        # a solve, no product with an inverse: what is left of these rows is what is left of equation 1
        if self.unity is None:  # the same for every direction from here
            x, self.unity = np.moveaxis(solve(self.K, np.stack([rows, at.delta], axis=2)), 2, 0)
        else:
            x = solve(self.K, rows[:, :, None])[:, :, 0]
        share = (x * at.delta).sum(axis=1) / (self.unity * at.delta).sum(axis=1)
        relative = x - share[:, None] * self.unity
        ddelta = at.delta * relative
        dz = (right - at.z * ddelta) / at.delta - at.z
        if not m:
            return _Step(ddelta, dz, self.missing, self.missing)
        dS = (self.scaled @ relative[:, :, None]).reshape(self.B, m, m) + self.missing
        return _Step(ddelta, dz, dS, Y - dS)

    def room(self, step: _Step, *, opposite: bool = False) -> Float[ndarray, " B"]:
        """How many times the step can be taken until something leaves its cone; 0 where it is not finite.

        `opposite` says that S and Z change by -D together, so that one spectrum tells both.
        """
        at = self.at
        low = np.minimum((step.delta / at.delta).min(axis=1), (step.z / at.z).min(axis=1))
        if self.m:
            spectrum = eigenvalues(step.S * self.unit)
            other = -1 - spectrum[:, -1] if opposite else eigenvalues(step.Z * self.unit)[:, 0]
            low = np.minimum(low, np.minimum(spectrum[:, 0], other))
        return _until(low)

    def trust(self, step: _Step) -> Float[ndarray, " B"]:
        """How many times the step can be taken until it removes more than `_SHRINK` of Omega(delta)."""
        root = self.slope.root
        change = root @ _combine(step.delta, self.at.Omega) @ root.mT
        low = -np.linalg.norm(change, axis=(1, 2))
        risky = np.flatnonzero(~(low >= -_SHRINK))
        low[risky] = eigenvalues(change[risky])[:, 0]
        return _SHRINK * _until(low)

    def complementarity(self, step: _Step, reach: Float[ndarray, " B"]) -> Float[ndarray, " B"]:
        """mu after a part of the step."""
        at, a, A = self.at, reach[:, None], reach[:, None, None]
        scalar = ((at.delta + a * step.delta) * (at.z + a * step.z)).sum(axis=1)
        matrix = np.einsum("bij,bij->b", self.diagonal + A * step.S, self.diagonal + A * step.Z)
        return (scalar + matrix) / self.barrier

    def move(self, step: _Step, reach: Float[ndarray, " B"]) -> None:
        """Take a part of the step."""
        at, a, A = self.at, reach[:, None], reach[:, None, None]
        at.delta = at.delta + a * step.delta
        at.delta /= at.delta.sum(axis=1, keepdims=True)
        at.z = at.z + a * step.z
        if self.m:
            at.S = at.S + A * symmetric_part(self.back @ step.S @ self.back.mT)
            at.Z = at.Z + A * symmetric_part(self.H.mT @ step.Z @ self.H)
            at.missing = (1 - A) * at.missing


def _until(low: Float[ndarray, " B"]) -> Float[ndarray, " B"]:
    """The largest t with 1 + t low >= 0; 0 where `low` is not a number."""
    return np.where(low < 0, -1 / low, np.where(np.isnan(low), 0.0, np.inf))


def _combine(weights: Float[ndarray, "B J"], Omega: Float[ndarray, "B J n n"]) -> Float[ndarray, "B n n"]:
    B, J, n, _ = Omega.shape
    return (weights[:, None, :] @ Omega.reshape(B, J, n * n)).reshape(B, n, n)


def _between(
    X: Float[ndarray, "B n n"], side_by_side: Float[ndarray, "B n Jn"], Y: Float[ndarray, "B n n"]
) -> ndarray:
    """X Omega_j Y of every j, one a column: (B, n n, J). Two products with wide matrices, not 2 J small ones."""
    B, n, _ = X.shape
    product = (X @ side_by_side).reshape(B, -1, n) @ Y
    return np.moveaxis(product.reshape(B, n, -1, n), 2, 3).reshape(B, n * n, -1)


def _inner(Omega: Float[ndarray, "B J n n"], X: Float[ndarray, "B n n"]) -> Float[ndarray, "B J"]:
    B, J, n, _ = Omega.shape
    return (Omega.reshape(B, J, n * n) @ X.reshape(B, n * n, 1))[:, :, 0]
