"""Projected quasi-Newton: few gradients, which are dear, for many projections, which are cheap.

    1.  model J(z + d) ~ J + g'd + d' H d / 2,  H = gamma B_0 corrected by the last changes of the gradient (BFGS)
    2.  d = argmin of the model over the admissible set, by spectral projected gradients: no new J is needed
    3.  step along d, halved until J falls enough

B_0 is what the network itself says of its curvature, node by node (analysis/curvature.py), anew in every step.
Source: M. Schmidt, E. van den Berg, M. P. Friedlander, K. Murphy, AISTATS 2009 (the model and the inner method);
docs/decisions/0020-quasi-newton.md (B_0, and what it was compared with).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.curvature import Curvature

_MEMORY = 20
_LEAST = 1e-150
"""Change of the gradient along a step below which its reciprocal may overflow."""
_INNER = 60
_ENOUGH = 1e-4
"""A step must gain this part of what the gradient promises."""
_SHORTEST = 1e-6
_NEGLIGIBLE = 1e-4
"""A step within the model that promises less than this part of its first one is its last."""


@runtime_checkable
class Objective(Protocol):
    """What is minimised."""

    def value(self, z: Float[ndarray, " z"]) -> tuple[float, Any]:
        """J(z), infinite where z is of no use, and what the gradient is then computed from."""
        ...

    def gradient(self, at: Any) -> tuple[Float[ndarray, " z"], Curvature]:
        """The gradient and B_0 there."""
        ...


Map = Callable[[Float[ndarray, " z"]], Float[ndarray, " z"]]


class Minimum(NamedTuple):
    """Where the search ended."""

    z: Float[ndarray, " z"]
    value: float
    evaluations: int
    converged: bool
    """Whether the model promises less than the tolerance; False where steps ran out."""


@dataclass
class _Memory:
    """The last changes of z and of the gradient, and the matrix that they make of B_0."""

    changes: deque[tuple[ndarray, ndarray]]

    @classmethod
    def empty(cls) -> _Memory:
        return cls(deque(maxlen=_MEMORY))

    def add(self, s: Float[ndarray, " z"], y: Float[ndarray, " z"]) -> None:
        """Keep a pair along which the gradient grew: others would make the model indefinite, or have no inverse."""
        if s @ y > max(1e-10 * np.linalg.norm(s) * np.linalg.norm(y), _LEAST):
            self.changes.append((s, y))

    def hessian(self, B: Curvature) -> Map:
        """v -> H v in compact form, R. H. Byrd, J. Nocedal, R. B. Schnabel, Math. Programming 63, 1994, (2.17)."""
        if not self.changes:
            return B.times
        s, y = self.changes[-1]
        gamma = float(s @ y) / max(float(s @ B.times(s)), np.finfo(float).tiny)
        S, Y = (np.array(pair) for pair in zip(*self.changes, strict=True))
        BS = np.array([gamma * B.times(row) for row in S])
        SY = S @ Y.T
        lower = np.tril(SY, -1)
        middle = np.block([[BS @ S.T, lower], [lower.T, -np.diag(np.diag(SY))]])
        outer = np.concatenate([BS, Y])
        inverse = np.linalg.pinv(middle, hermitian=True)
        return lambda v: gamma * B.times(v) - outer.T @ (inverse @ (outer @ v))


def minimise(
    objective: Objective,
    z: Float[ndarray, " z"],
    project: Map,
    *,
    tolerance: float = 1e-7,
    steps: int = 200,
    centre: Map = lambda v: v,
    watch: Callable[[Float[ndarray, " z"], float], None] = lambda z, value: None,
) -> Minimum:
    """Minimise J over a convex set from the admissible z, until the model promises less than `tolerance` times J.

    `centre` takes from changes of the gradient what no admissible step can feel. `watch(z, J)` is told every point
    that is better than the last. Local: where J is not convex, the minimum depends on z. A start with infinite J is
    handed back as it is.
    """
    value, at = objective.value(z)
    evaluations, memory = 1, _Memory.empty()
    if not np.isfinite(value):
        return Minimum(z, value, evaluations, False)
    watch(z, value)
    g, B = objective.gradient(at)
    for _ in range(steps):
        d = _minimise_model(z, g, B, memory.hessian(B), project) - z
        slope = float(g @ d)
        if not -slope > tolerance * abs(value):
            return Minimum(z, value, evaluations, True)
        length = 1.0
        while True:
            trial = z + length * d
            tried, at = objective.value(trial)
            evaluations += 1
            if tried <= value + _ENOUGH * length * slope:
                break
            length /= 2
            if length < _SHORTEST:
                return Minimum(z, value, evaluations, -slope <= 10 * tolerance * abs(value))
        before = g
        z, value = trial, tried
        watch(z, value)
        g, B = objective.gradient(at)
        memory.add(length * d, centre(g - before))
    return Minimum(z, value, evaluations, False)


def _minimise_model(
    start: Float[ndarray, " z"],
    g: Float[ndarray, " z"],
    B: Curvature,
    hessian: Map,
    project: Map,
) -> Float[ndarray, " z"]:
    """argmin g'd + d'Hd/2 over the admissible set, by projected gradients with spectral steps in the scale of B."""
    z, slope_at, step, first = start, g, 1.0, 0.0
    for _ in range(_INNER):
        d = project(z - step * B.descent(slope_at)) - z
        slope = float(slope_at @ d)
        if not slope < 0 or -slope <= _NEGLIGIBLE * first:
            break
        first = first or -slope
        Hd = hessian(d)
        curvature = float(d @ Hd)
        length = 1.0 if curvature <= 0 else min(1.0, -slope / curvature)
        z = z + length * d
        slope_at = slope_at + length * Hd
        step = float(np.clip(B.length(d) / curvature, 1e-3, 1e3)) if curvature > 0 else 1.0
    return z
