"""A smaller tolerance that leads somewhere: advice for a table, or a performance, that has no answer.

What has no answer at hardly any tolerance (what no sensor sees, what falls to zero without noise) has none at any
that is worth trying, and nothing is advised for it. For the rest, every tolerance that is advised was tried: all that
can settle settles there, and it lies below the limits that `tolerance_limits` gives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from tolnet.analysis import least_favourable_model, solve_steady_state, tolerance_limits
from tolnet.analysis.least_favourable import fold_tolerance
from tolnet.design.tolerances import choose_tolerances
from tolnet.model import Ambiguity, Status, ToleranceTable, gamma_per
from tolnet.model.ambiguity import SMALLEST

_LITTLE = 1e-6
"""Hardly any tolerance: so much of the one that was asked for, and of 1."""
_LIMITS_UP_TO = 200
"""Nodes up to which the limits are computed: they say where to begin, and keep the advice below them."""
_LEAST_LIMIT = 1e-8
"""The path of the limits begins a decade below."""
_FALLING = (0.9, 0.5, 0.2, 0.1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10)
"""What is tried, relative to what is known to be too much."""
_BISECTIONS = 3


def settling_tolerance(answer: ToleranceTable, *, uniform: bool = False) -> float | None:
    """A tolerance, in the table's convention, at which every filter settles that settles at hardly any tolerance.

    None where that is no more than settles already: no smaller tolerance helps then. `uniform` is what the table was
    made with. Of two digits, and not far below the largest there is.
    """
    scale, hopeless = gamma_per(answer.convention), ~_settled(at_little_tolerance(answer, uniform=uniform))
    if not (~_settled(answer) & ~hopeless).any():
        return None
    limits = _limits(answer) / scale
    limits[hopeless] = np.inf

    def good(c: float) -> bool:
        found = _again(answer, c, uniform)
        own = np.append(found.central.tolerance, found.local.tolerance) / scale
        return bool((_settled(found) | hopeless).all()) and not (own >= limits).any()

    high = min(float(answer.tolerance), float((limits if uniform else limits[:1]).min()))
    return _largest(good, high)


def answering_tolerance(answer: ToleranceTable, *, uniform: bool = False) -> float | None:
    """A tolerance at which a performance has more numbers: more filters settle, or it is below the fold; or None.

    With `uniform` the filters with c_k = c at every node count as well.
    """
    smaller, there = None, answer
    for alike in (False, True) if uniform else (False,):
        at = _again(answer, there.tolerance, uniform=True) if alike else there
        if not at.ok and (settling := settling_tolerance(at, uniform=alike)) is not None:
            smaller, there = settling, _again(answer, settling, uniform=False)
    return performing_tolerance(there) or smaller


def at_little_tolerance(answer: ToleranceTable, *, uniform: bool = False) -> ToleranceTable:
    """The same table at hardly any tolerance: what does not settle there is not helped by a smaller one."""
    return _again(answer, _LITTLE * min(answer.tolerance, 1.0), uniform)


def _again(answer: ToleranceTable, c: float, uniform: bool) -> ToleranceTable:
    ambiguity = Ambiguity(c if c >= SMALLEST else 0.0, answer.convention, answer.tau)
    return choose_tolerances(answer.network, ambiguity, uniform=uniform)


def performing_tolerance(answer: ToleranceTable) -> float | None:
    """A tolerance, in the table's convention, below the centre's fold: there its least favourable model exists.

    None where the table's own tolerance is not at or beyond the fold, or where no smaller one was found.
    Source: docs/mathematics.md, section 7.3.
    """
    network, scale = answer.network, gamma_per(answer.convention)
    if least_favourable_model(network, answer.central).status != Status.FOLD:
        return None

    def good(c: float) -> bool:
        return least_favourable_model(network, solve_steady_state(network, Ambiguity(c, answer.convention))).exists

    return _largest(good, fold_tolerance(network, float(answer.central.tolerance)) / scale)


def _settled(table: ToleranceTable) -> Bool[ndarray, " N1"]:
    """The centre and the nodes."""
    return np.append(table.central.settles, table.local.settles)


def _limits(answer: ToleranceTable) -> Float[ndarray, " N1"]:
    """How large the tolerance of the centre and of every node may be, gamma scale; infinite where nobody says."""
    network, c = answer.network, float(answer.tolerance) * gamma_per(answer.convention)
    if answer.tau != 0 or network.N > _LIMITS_UP_TO or c < _LEAST_LIMIT:
        return np.full(network.N + 1, np.inf)
    centre, nodes = tolerance_limits(network, largest=c)
    return np.append(centre.attracts, nodes.attracts)


def _largest(good: Callable[[float], bool], high: float) -> float | None:
    """A good number of two digits below `high`: the first that is found, then nearer to the last that was not."""
    bad = high
    for c in _falling(high):
        if not good(c):
            bad = c
            continue
        for _ in range(_BISECTIONS):
            middle = _rounded_down(math.sqrt(c * bad))
            if not c < middle < bad:
                break
            c, bad = (middle, bad) if good(middle) else (c, middle)
        return c
    return None


def _falling(high: float) -> Iterator[float]:
    """Ever smaller numbers of two digits, all of which a tolerance may be."""
    for part in _FALLING:
        c = _rounded_down(part * high)
        if c >= SMALLEST:
            yield c


def _rounded_down(x: float) -> float:
    """To two digits."""
    if not x > 0:
        return 0.0
    exponent = math.floor(math.log10(x)) - 1
    return float(f"{math.floor(x / 10.0**exponent)}e{exponent}")
