"""The sentences of a certificate, fixed by the other keys of a claim (docs/certificate.md, Statements).

They say what someone who reads them alone would otherwise take for granted: that gains are constant, which model is
the least favourable one, that tolerances are on the gamma scale, that attraction is local, what a radius is part of.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

BLOCKS = {
    "F": "the network's error dynamics F under the stated least favourable model",
    "network": "the network block of the error dynamics",
}
_LEAST_FAVOURABLE = "the least favourable block of the error dynamics"
_AS_STATED = "With the stated weights and constant gains"
_STAYS_STABLE = "With constant gains in each state, the network block of the error dynamics stays stable"


def stability(block: str) -> str:
    """Of a proved `schur-stability`."""
    return f"{_AS_STATED}, every eigenvalue of {BLOCKS[block]} lies inside the unit circle: errors die out."


def instability(of: str) -> str:
    """Of a refuted `schur-stability`; `of` is "network" or "centre"."""
    block = BLOCKS.get(of, _LEAST_FAVOURABLE)
    return f"{_AS_STATED}, some eigenvalue of {block} lies outside the unit circle: errors grow."


def decay_rate(block: str, rate: float) -> str:
    """Of `decay-rate`."""
    return f"{_AS_STATED}, every eigenvalue of {BLOCKS[block]} lies inside the circle of radius {rate!r}."


def link_losses(most: int) -> str:
    """Of `switching` with `drop`."""
    how = "each losing estimate and measurement together"
    return f"{_STAYS_STABLE} however links drop and return, at most {most} at once, {how}."


def scenarios(number: int) -> str:
    """Of `switching` with `scenarios`."""
    how = "a link that drops loses both estimate and measurement"
    return f"{_STAYS_STABLE} however the nominal network and {number} scenarios alternate ({how})."


def performance(low: float, high: float) -> str:
    """Of `performance`."""
    return (
        f"{_AS_STATED}, under the stated least favourable model, the steady mean square deviation of the network lies"
        f" in [{low!r}, {high!r}], and that of every node in its interval."
    )


def observability(alpha: float | None, *, window: int, form: str, horizon: int | None) -> str:
    """Of `observability`; without alpha, what was tried."""
    least = "some alpha I with alpha > 0" if alpha is None else f"{alpha!r} I"
    return f"Over every window of {_instants(window, horizon)} the {_GRAMIANS[form]} Gramian exceeds {least}."


def blindness(*, window: int, form: str, horizon: int | None) -> str:
    """Of a refuted `observability`."""
    return (
        f"Over some window of {_instants(window, horizon)} no sensor sees a certain direction at all: the"
        f" {_GRAMIANS[form]} Gramian is singular."
    )


_GRAMIANS = {"sharp": "robust", "classical": "classical"}


def _instants(window: int, horizon: int | None) -> str:
    within = "" if horizon is None else f" within k = 0..{horizon}"
    return f"{window} instant{'' if window == 1 else 's'}{within}"


def who(node: int | str) -> str:
    """A node, or the centre."""
    return "the centre" if node == "centre" else f"node {node}"


def steady_state(node: int | str, c: float, radius: float, gain_error: float) -> str:
    """Of `steady-state`."""
    return (
        f"An exact steady state of {who(node)} at the tolerance {c!r} (gamma) lies within {radius!r} of the stated"
        f" one, relative to sqrt(P_ii P_jj) and to theta, and its gain within {gain_error!r} of the stated one,"
        " relative to the largest entry."
    )


def attraction(node: int | str, c: float, rate: float) -> str:
    """Of a proved `attraction`."""
    return (
        f"The steady state of {who(node)} at the tolerance {c!r} (gamma) attracts locally: covariances that start"
        f" near it approach it, in the end by a factor of at most {rate!r} a step."
    )


def repulsion(node: int | str, c: float) -> str:
    """Of a refuted `attraction`."""
    return (
        f"The steady state of {who(node)} at the tolerance {c!r} (gamma) does not attract: some covariances that"
        " start as near to it as you like move away."
    )


def tolerance(node: int | str, c: float, low: float, high: float) -> str:
    """Of `tolerance`."""
    return (
        f"The tolerance of {who(node)} that follows from the centre's steady state at {c!r} (gamma) lies in"
        f" [{low!r}, {high!r}]."
    )


def convergence(node: int | str, c: float) -> str:
    """Of `convergence`."""
    return (
        f"The covariances of the filter of {who(node)} at the tolerance {c!r} (gamma), started at the stated one,"
        " converge to its steady state."
    )


def convergence_all(node: int | str, c: float) -> str:
    """Of `convergence-all`."""
    return (
        f"The covariances of the filter of {who(node)} at the tolerance {c!r} (gamma) converge to one steady state"
        " from every start."
    )


def of_filter_claim(claim: Mapping[str, Any]) -> str:
    """The sentence that the keys of a claim about one filter fix. Raises KeyError, ValueError or TypeError."""
    node, c = claim["node"], float.fromhex(claim["c"])
    match claim["claim"], claim["verdict"]:
        case "steady-state", "proved":
            radius, error = claim["proof"]["box"]["radius"], claim["gain_error"]
            return steady_state(node, c, float.fromhex(radius), float.fromhex(error))
        case "attraction", "proved":
            return attraction(node, c, float.fromhex(claim["rate"]))
        case "attraction", "refuted":
            return repulsion(node, c)
        case "tolerance", "proved":
            low, high = map(float.fromhex, claim["interval"].split(" "))
            return tolerance(node, c, low, high)
        case "convergence", "proved":
            return convergence(node, c)
        case "convergence-all", "proved":
            return convergence_all(node, c)
    raise ValueError(f"{claim['claim']} cannot be {claim['verdict']}")
