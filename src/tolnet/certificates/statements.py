"""The sentences of a certificate, fixed by the other keys of a claim (docs/certificate.md, Statements)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

BLOCKS = {"F": "the network's error dynamics F", "network": "the network block of the error dynamics"}
_LEAST_FAVOURABLE = "the least favourable block of the error dynamics"


def stability(block: str) -> str:
    """Of a proved `schur-stability`."""
    return f"Every eigenvalue of {BLOCKS[block]} lies inside the unit circle: errors die out."


def instability(of: str) -> str:
    """Of a refuted `schur-stability`; `of` is "network" or "centre"."""
    return f"Some eigenvalue of {BLOCKS.get(of, _LEAST_FAVOURABLE)} lies outside the unit circle: errors grow."


def decay_rate(block: str, rate: float) -> str:
    """Of `decay-rate`."""
    return f"Every eigenvalue of {BLOCKS[block]} lies inside the circle of radius {rate!r}."


def link_losses(most: int) -> str:
    """Of `switching` with `drop`."""
    return f"{_stays_stable()} however links drop and return, at most {most} at once."


def scenarios(number: int) -> str:
    """Of `switching` with `scenarios`."""
    return f"{_stays_stable()} however the nominal network and {number} scenarios alternate."


def _stays_stable() -> str:
    return "The network block of the error dynamics stays stable"


def performance(low: float, high: float) -> str:
    """Of `performance`."""
    return (
        f"Under the stated least favourable model the mean square deviation of the network lies in [{low!r}, {high!r}],"
        " and that of every node in its interval."
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


def steady_state(node: int | str, c: float, radius: float) -> str:
    """Of `steady-state`."""
    return f"An exact steady state of {who(node)} at the tolerance {c!r} lies within {radius!r} of the stated one."


def attraction(node: int | str, c: float, rate: float) -> str:
    """Of a proved `attraction`."""
    return f"The steady state of {who(node)} at the tolerance {c!r} attracts, by a factor of at most {rate!r} a step."


def repulsion(node: int | str, c: float) -> str:
    """Of a refuted `attraction`."""
    return f"The steady state of {who(node)} at the tolerance {c!r} does not attract."


def tolerance(node: int | str, c: float, low: float, high: float) -> str:
    """Of `tolerance`."""
    return f"The tolerance of {who(node)} for a network at {c!r} lies in [{low!r}, {high!r}]."


def convergence(node: int | str, c: float) -> str:
    """Of `convergence`."""
    return (
        f"The filter of {who(node)} at the tolerance {c!r}, started at the stated covariance, converges to its steady"
        " state."
    )


def convergence_all(node: int | str, c: float) -> str:
    """Of `convergence-all`."""
    return f"The filter of {who(node)} at the tolerance {c!r} converges to one steady state from every start."


def of_filter_claim(claim: Mapping[str, Any]) -> str:
    """The sentence that the keys of a claim about one filter fix. Raises KeyError, ValueError or TypeError."""
    node, c = claim["node"], float.fromhex(claim["c"])
    match claim["claim"], claim["verdict"]:
        case "steady-state", "proved":
            return steady_state(node, c, float.fromhex(claim["proof"]["box"]["radius"]))
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
