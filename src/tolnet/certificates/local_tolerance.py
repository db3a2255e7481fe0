"""The tolerance of a node, enclosed: eq. (42) at the exact steady state of the centre, in balls.

With the centre's P and theta, V - P = theta P H P for H = (I - theta P)^-1, V = H P, and the node's S_k,

    P_k = A (V^-1 + S_k)^-1 A' + Q,  M = P_k^-1 (V - P),   c_k = tr M - log det(I + M)

(docs/mathematics.md, sections 3.2 and 11.7).
"""

from __future__ import annotations

from typing import Any

from tolnet.certificates import balls
from tolnet.certificates.balls import Ball, NotProved
from tolnet.certificates.exact_filter import ExactFilter, Sensor, information
from tolnet.certificates.fixed_point import Box, Enclosure, enclose
from tolnet.certificates.numerals import number_text, vector


def local_tolerance(centre: Enclosure, sensors: tuple[Sensor, ...]) -> Ball:
    """c_k of a node that hears these sensors. Assumes the working precision of `centre`. Raises ZeroDivisionError."""
    equations = centre.equations
    n = equations.n
    one = balls.identity(n)
    H = (one - centre.P * centre.theta).inv()
    V = balls.symmetric_part(H * centre.P)
    excess = balls.congruence(centre.P, H) * centre.theta
    Z = (one + V * information(sensors, n)).inv() * V
    M = (balls.congruence(equations.A, Z) + equations.Q).inv() * excess
    return M.trace() - (one + M).det().log()


def prove_tolerance(
    centre: ExactFilter, box: Box, sensors: tuple[Sensor, ...], enclosed: Enclosure | None = None
) -> dict[str, Any] | NotProved:
    """Keys of a proved `tolerance` claim, `c`, `interval` and `proof`, for a node that hears these sensors.

    `box` is one of `find_box` for the centre. `enclosed`, what `enclose` says of it, saves that work where many nodes
    share one centre.
    """
    found = enclosed or enclose(centre, box)
    if isinstance(found, NotProved):
        return found
    with balls.working_precision(found.bits):
        try:
            tolerance = local_tolerance(found, sensors)
        except ZeroDivisionError:
            return NotProved("a matrix that must be inverted may be singular")
        lo, hi = (0.0, 0.0) if tolerance.is_zero() else (balls.below(tolerance), balls.above(tolerance))
    if not 0 <= hi < float("inf"):
        return NotProved("the node's tolerance was not enclosed")
    keys = {
        "c": number_text(centre.c),
        "interval": f"{number_text(max(lo, 0.0))} {number_text(hi)}",
        "proof": {"box": box.text()},
    }
    reason = verify_tolerance(centre, keys, sensors, found)
    return keys if reason is None else NotProved(reason)


def verify_tolerance(
    centre: ExactFilter, claim: dict[str, Any], sensors: tuple[Sensor, ...], enclosed: Enclosure | None = None
) -> str | None:
    """Why a `tolerance` claim does not hold as far as can be shown; None where it does.

    `enclosed`, what `enclose` says of the centre and of the box of this very claim, saves that work.
    """
    interval = vector(claim["interval"])
    if interval.shape != (2,):
        return "the interval is not two numbers"
    lo, hi = interval.tolist()
    found = enclosed or enclose(centre, Box.read(claim["proof"]["box"]))
    if isinstance(found, NotProved):
        return found.reason
    with balls.working_precision(found.bits):
        try:
            tolerance = local_tolerance(found, sensors)
        except ZeroDivisionError:
            return "a matrix that must be inverted may be singular"
        # c_k is never negative (section 3.2), so that 0 is always a lower bound.
        if not ((lo <= 0 or tolerance >= lo) and tolerance <= hi):
            return f"the node's tolerance was not shown to lie between {lo} and {hi}"
    return None
