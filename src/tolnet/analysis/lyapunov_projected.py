"""The network's Lyapunov equation by propagation and projection: Q = F Q F' + G G' without F, G or Q.

    1.  Q = sum_{t < T} F^t G G' F'^t + tail,   tail = F^T Q F'^T
    2.  every step mixes neighbours and contracts, so F^T G is numerically of low rank: F^T G = Y, range(Y) ~ range(V)
    3.  tail = V X V',  X = H X H' + C C',  H = V' F V,  C = V' Y: a small dense equation

Step 1 takes the columns of G (one a measurement channel) a few at a time, which stay in cache while they are
propagated, and adds up diagonal blocks only. T grows until the projection is accurate, which is checked with the
equation itself on random vectors: Q v needs only sums over the columns.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.lyapunov_dense import amplification, relative_size, solve_smith
from tolnet.model import ErrorDynamics

_FIRST, _MOST = 16, 2000
"""Steps before the first look at the rank, and the end."""
_SHARE, _LEAST = 8, 32
"""The subspace has at most this part of the dimension, or so many; twice as much after _PATIENCE steps."""
_PATIENCE = 100
_PROBES = 3
_BATCH_BYTES = 2**19
_TOGETHER = 4
"""Steps whose columns are added up together."""
_WIDE = 512
_LOW_RANK = 1e-13
"""What the last direction may add before a projection is worth its price."""
_CUTS = (1e-14, 1e-12, 1e-10)
"""Directions below this part of the largest are left out; more of them where rounding makes H unstable."""
_NOTHING = 1e-17
_MARGIN = 1.3
"""How much further than extrapolated: the first directions fall faster than the last."""
_FLOOR = 1e-13
"""A relative residual below which two solutions may be compared instead of bounding the error by the residual."""
_SAFETY = 10


class ProjectedSolution(NamedTuple):
    """Diagonal blocks of Q, the last one that of e, and what is known of their error."""

    blocks: Float[ndarray, "K1 n n"]
    residual: float
    """|F Q F' + G G' - Q| / |Q| in the Frobenius norm, estimated by random vectors."""
    error: float
    """Estimated relative error of the worst trace."""
    steps: int
    rank: int


def solve_projected(dynamics: ErrorDynamics, wanted: float) -> ProjectedSolution:
    """Solve Q = F Q F' + G G' for the diagonal blocks of Q until the estimated error of every trace is `wanted`.

    Assumes rho(F) < 1. Gives up where more steps gain nothing, with the best that it found: look at the error.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # growth shows as a value that is not finite
        return _solve(dynamics, wanted)


def _solve(dynamics: ErrorDynamics, wanted: float) -> ProjectedSolution:
    columns = _Columns(dynamics, _Probe(dynamics))
    width = max(_LEAST, dynamics.dimension // _SHARE)
    best = _nothing(dynamics)
    steps = _FIRST
    while steps <= _MOST:
        columns.propagate(steps)
        directions = min(width if steps < _PATIENCE else 2 * width, dynamics.dimension)
        last = columns.glance(directions)
        if not np.isfinite(last):
            break
        if last > _LOW_RANK and directions < dynamics.dimension:
            # singular values fall like powers: how many steps bring the last one down
            steps = int(steps * np.clip(_MARGIN * np.log(_LOW_RANK) / np.log(min(last, 0.5)), 1.2, 3.0))
            continue
        V, parts = columns.range(directions)
        found = _compare(_assemble(columns, _project(dynamics, columns, V, parts)), best)
        gained = found.error < 0.25 * best.error
        best = found if found.error < best.error else best
        if best.error <= wanted or (best.residual <= _FLOOR and not gained):
            break
        steps = int(1.5 * steps)
    return best


def _compare(found: ProjectedSolution, before: ProjectedSolution) -> ProjectedSolution:
    """Estimate the error by how far two solutions with different T and V differ, where that is the smaller estimate.

    Near the stability limit the residual is rounding, and how far it might be amplified says little.
    """
    if max(found.residual, before.residual) > _FLOOR:
        return found
    ratio = np.trace(found.blocks, axis1=1, axis2=2) / np.trace(before.blocks, axis1=1, axis2=2)
    return found._replace(error=min(found.error, _SAFETY * float(np.abs(ratio - 1).max())))


class _Probe:
    """Random vectors v, and F' v: what the residual of Q is measured with."""

    def __init__(self, dynamics: ErrorDynamics) -> None:
        shape = (dynamics.filters + 1, dynamics.n, _PROBES)
        self.dynamics = dynamics
        self.v = np.random.default_rng(1).normal(size=shape)
        self.back = dynamics.step_back(self.v)
        self.both = np.concatenate([self.v, self.back], axis=2)

    def residual(self, image: Float[ndarray, "K1 n p"]) -> float:
        """|residual| / |Q| from Q [v, F' v]: E |Z v|^2 = |Z|^2 for a standard normal v."""
        Qv, Qback = image[:, :, :_PROBES], image[:, :, _PROBES:]
        defect = self.dynamics.step(Qback) + self.dynamics.noise_product(self.v) - Qv
        return relative_size(defect, Qv)


class _Columns:
    """The columns of G on their way through F, with the sums that the steps behind them left."""

    def __init__(self, dynamics: ErrorDynamics, probe: _Probe) -> None:
        self.dynamics, self.probe, self.steps = dynamics, probe, 0
        each = _per_batch(dynamics)
        edges = range(0, dynamics.columns, each)
        self.batches = [dynamics.noise_columns(i, min(i + each, dynamics.columns)) for i in edges]
        self.blocks = np.zeros((dynamics.filters + 1, dynamics.n, dynamics.n))
        self.image = np.zeros_like(probe.both)

    def propagate(self, steps: int) -> None:
        """Step on until `steps`, adding up diagonal blocks of y y', and y y' times the probes, over all columns y."""
        K1, n, b = self.batches[0].shape
        buffer = np.empty(K1 * n * _TOGETHER * b)
        for i, Y in enumerate(self.batches):
            for start in range(self.steps, steps, _TOGETHER):
                count, b = min(_TOGETHER, steps - start), Y.shape[2]
                trail = buffer[: K1 * n * count * b].reshape(K1, n, count, b)
                for t in range(count):
                    trail[:, :, t] = Y
                    Y = self.dynamics.step(Y)
                together = trail.reshape(K1, n, count * b)
                self.blocks += together @ together.mT
                # stacked on purpose: one large product of these shapes sets threads to work that costs less alone
                self.image += together @ (together.mT @ self.probe.both).sum(axis=0)
            self.batches[i] = Y
        self.steps = steps

    def wide(self) -> Iterator[Float[ndarray, "d w"]]:
        """Y, some hundred columns at a time: wide enough for fast products, and never a second Y."""
        each = max(1, _WIDE // self.batches[0].shape[2])
        for i in range(0, len(self.batches), each):
            yield np.concatenate(self.batches[i : i + each], axis=2).reshape(self.dynamics.dimension, -1)

    def glance(self, directions: int) -> float:
        """Which part of Y its last of so many directions adds to those before it, judged by some of the rows."""
        rng = np.random.default_rng(4)
        rows = rng.permutation(self.dynamics.dimension)[: 2 * directions]
        sketch = self._sketch(directions, rng, rows)
        if not np.isfinite(sketch).all():
            return np.inf
        pivots = np.abs(np.diagonal(np.linalg.qr(sketch, mode="r")))
        return float(pivots[-1] / pivots[0]) if pivots[0] > 0 else 0.0

    def range(self, directions: int) -> tuple[Float[ndarray, "d w"], Float[ndarray, " w"]]:
        """An orthonormal basis of the range of Y, and which part of Y each direction adds to those before it.

        From Y Omega with a standard normal Omega: the i-th pivot of its QR decomposition is what i - 1 random
        combinations of the columns leave of another one. All parts are zero where Y itself adds nothing to Q.
        """
        sketch = self._sketch(directions, np.random.default_rng(2))
        energy = float(sum(np.vdot(Y, Y) for Y in self.batches))
        if not energy > _NOTHING * np.trace(self.blocks.sum(axis=0)):
            return sketch, np.zeros(sketch.shape[1])
        V, parts = _orthonormal(sketch)
        rank = int(np.count_nonzero(parts > _CUTS[0]))
        # Y is used up, and there is room: add what follows it in time
        if 2 * rank <= directions or rank < directions == self.dynamics.dimension:
            later = [sketch[:, :rank]]
            while sum(part.shape[1] for part in later) < directions:
                later.append(_step(self.dynamics, later[-1]))
            V, parts = _orthonormal(np.concatenate(later, axis=1)[:, :directions])
        return V, parts

    def _sketch(
        self, directions: int, rng: np.random.Generator, rows: ndarray | slice = slice(None)
    ) -> Float[ndarray, "r w"]:
        """Some rows of Y Omega with a standard normal Omega."""
        width = min(directions, self.dynamics.columns)
        return np.sum([y[rows] @ rng.normal(size=(y.shape[1], width)) for y in self.wide()], axis=0)

    def gramian(self, V: Float[ndarray, "d r"]) -> Float[ndarray, "r r"]:
        """(V' Y) (V' Y)'."""
        parts = (V.T @ y for y in self.wide())
        return np.sum([C @ C.T for C in parts], axis=0)


def _per_batch(dynamics: ErrorDynamics) -> int:
    """How many columns stay in cache together."""
    return max(4, min(32, _BATCH_BYTES // (8 * dynamics.dimension)))


class _Tail(NamedTuple):
    V: Float[ndarray, "d r"]
    X: Float[ndarray, "r r"]
    amplification: float


def _project(
    dynamics: ErrorDynamics, columns: _Columns, V: Float[ndarray, "d w"], parts: Float[ndarray, " w"]
) -> _Tail:
    """The tail V X V', X = H X H' + C C', and the factor by which H may turn a residual into an error."""
    H, CC = V.T @ _step(dynamics, V), columns.gramian(V)
    kept, X = np.empty(0, dtype=int), np.zeros((0, 0))
    for cut in _CUTS:
        kept = np.flatnonzero(parts > cut)
        X = solve_smith(H[np.ix_(kept, kept)], CC[np.ix_(kept, kept)]).X
        if np.isfinite(X).all():
            break
    factor = amplification(H[np.ix_(kept, kept)]) if len(kept) and np.isfinite(X).all() else 1.0
    return _Tail(V[:, kept], X, factor)


def _orthonormal(sketch: Float[ndarray, "d w"]) -> tuple[Float[ndarray, "d w"], Float[ndarray, " w"]]:
    """Q of a QR decomposition, and its pivots in parts of the first."""
    V, upper = np.linalg.qr(sketch)
    pivots = np.abs(np.diagonal(upper))
    return V, pivots / pivots[0]


def _step(dynamics: ErrorDynamics, V: Float[ndarray, "d r"]) -> Float[ndarray, "d r"]:
    """F V, a few columns at a time."""
    each = _per_batch(dynamics)
    parts = [V[:, i : i + each] for i in range(0, V.shape[1], each)]
    blocks = (dynamics.filters + 1, dynamics.n, -1)
    return np.concatenate([dynamics.step(part.reshape(blocks)).reshape(part.shape) for part in parts], axis=1)


def _assemble(columns: _Columns, tail: _Tail) -> ProjectedSolution:
    """Blocks of the sum and of the tail together, and the residual of the equation at both together.

    The error of a trace is estimated as if it were spread over the nodes as Q is: amplified residual, over the
    smallest trace instead of the mean.
    """
    split = (len(columns.blocks), columns.blocks.shape[1], tail.V.shape[1])
    V, VX = tail.V.reshape(split), (tail.V @ tail.X).reshape(split)
    blocks = columns.blocks + VX @ V.mT
    residual = columns.probe.residual(columns.image + VX @ (V.mT @ columns.probe.both).sum(axis=0))
    traces = np.trace(blocks, axis1=1, axis2=2)
    error = tail.amplification * residual * traces.mean() / traces.min() if traces.min() > 0 else np.inf
    error *= 1 if residual <= _FLOOR else _SAFETY  # a truncation may favour single nodes, rounding does not
    blocks = (blocks + blocks.mT) / 2  # rounding only: the exact blocks are symmetric
    return ProjectedSolution(blocks, residual, float(error), columns.steps, tail.V.shape[1])


def _nothing(dynamics: ErrorDynamics) -> ProjectedSolution:
    nan = np.full((dynamics.filters + 1, dynamics.n, dynamics.n), np.nan)
    return ProjectedSolution(nan, np.inf, np.inf, 0, 0)
