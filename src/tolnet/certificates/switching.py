"""Stability however a network switches among scenarios, or loses links and finds them again (docs/certificate.md).

One Y for all:  Y_l > 0,  (1 - d) Y_l - M_l' (sum_k sigma_k |w_lk| Y_k) M_l > 0  for every node l and scenario, so
x' diag(Y) x falls in every step, whatever the order. When links drop, the condition of l changes with its own only:

    w_ll + sum_lost w_jl,   M_l + sum_lost G_lj C_j,   and no term of a k that hears l no more
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.certificates import statements
from tolnet.certificates.exact import Exact, segment_sums
from tolnet.certificates.exact_network import ExactNetwork, unmixed_column
from tolnet.certificates.numerals import matrix_text, shortened, symmetric_text
from tolnet.certificates.stability import has_positive_diagonal
from tolnet.certificates.verdicts import Proved, Undecided
from tolnet.model.link_loss import Losses, reverse_entries

_CASES_AT_A_TIME = 20_000
_TRIED = (0.9, 0.5, 0.1, 0.0)
"""Parts of the margin that floating point sees, tried one after the other."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """A state of the network: the entries (k hears l) whose links dropped; or other weights, other gains, or both."""

    dropped: Int[ndarray, " m"] | None = None
    weights: Float[ndarray, " L"] | None = None
    gains: Float[ndarray, "M n"] | None = None


def prove_link_losses(
    network: ExactNetwork, Y: Float[ndarray, "N n n"], losses: Losses, most: int, margin: float
) -> Proved | Undecided:
    """Decide exactly whether Y proves stability however at most `most` links at once drop and return.

    `losses` are all cases of `possible_losses`; `margin` is what floating point sees of d.
    """
    statement = statements.link_losses(most)
    keys = {"drop": most}
    if network.unmixed:
        return Undecided("switching", statement, network.unmixed, keys=keys)
    if (network.deployed.weights < 0).any():
        return Undecided("switching", statement, "some weights are negative", keys=keys)
    if not has_positive_diagonal(Y):
        return Undecided("switching", statement, "the candidate is not positive definite", keys=keys)
    short = shortened(Y, 24)
    exact = Exact.of(short)
    if not exact.definite().all():
        return Undecided("switching", statement, "the candidate is not positive definite", keys=keys)
    bad = 0
    for part in _TRIED:
        d = float(f"{part * max(margin, 0.0):.2e}")
        bad = _first_failure(_LossImages(network, exact, losses), exact, losses.node, d)
        if bad is None:
            proof = {"Y": [symmetric_text(X) for X in short]}
            return Proved("switching", statement, proof, d, keys=keys)
    lost = network.deployed.neighbours[losses.lost[bad][losses.lost[bad] >= 0]].tolist()
    reason = f"the inequality of node {losses.node[bad]} does not hold when it loses the links to {lost}"
    return Undecided("switching", statement, reason, keys=keys)


class _LossImages:
    """M' (sum_k sigma_k w_lk Y_k) M of the cases of lost links."""

    def __init__(self, network: ExactNetwork, Y: Exact, losses: Losses) -> None:
        deployed, self.losses, self.Y = network.deployed, losses, Y
        self.M, self.weights, self.sigma = network.loops, network.sizes, network.totals
        C = Exact.of(deployed.network.C)[deployed.sensor_rows]
        product = Exact.of(deployed.gains).reshape(-1, deployed.n, 1) * C.reshape(-1, 1, deployed.n)
        self.parts = segment_sums(product, deployed.columns)
        self.hearer, self.neighbours = deployed.hearer, deployed.neighbours
        offsets, order = network.hearers
        spread = (network.totals.reshape(-1, 1, 1) * Y)[deployed.hearer[order]]
        self.whole = segment_sums(network.sizes[order].reshape(-1, 1, 1) * spread, offsets)
        self.returned = reverse_entries(deployed.offsets, deployed.neighbours)

    def __call__(self, cases: slice) -> Exact:
        node, lost, returned = (x[cases] for x in (self.losses.node, self.losses.lost, self.losses.returned))
        M, spread = self.M[node], self.whole[node]
        for column in range(lost.shape[1]):
            e, back = lost[:, column], returned[:, column]
            M = M + _where(e >= 0, self.parts[e])
            own = (self.sigma[node] * self.weights[e]).reshape(-1, 1, 1) * self.Y[node]
            spread = spread + _where(e >= 0, own)
            other = self.hearer[back]
            gone = (self.sigma[other] * self.weights[back]).reshape(-1, 1, 1) * self.Y[other]
            spread = spread - _where(back >= 0, gone)
        return M.T @ spread @ M


def _where(condition: ndarray, values: Exact) -> Exact:
    return Exact(np.where(condition[:, None, None], values.ints, 0), values.exponent)


def _first_failure(images: _LossImages, Y: Exact, node: ndarray, d: float) -> int | None:
    kept = Exact.of(1.0) - Exact.of(d)
    for start in range(0, len(node), _CASES_AT_A_TIME):
        cases = slice(start, start + _CASES_AT_A_TIME)
        good = (kept * Y[node[cases]] - images(cases)).definite()
        if not good.all():
            return start + int(np.argmin(good))
    return None


def prove_scenarios(
    network: ExactNetwork, Y: Float[ndarray, "N n n"], scenarios: Sequence[Scenario], margin: float
) -> Proved | Undecided:
    """Decide exactly whether Y proves stability under switching at will among the scenarios and the nominal network.

    Source: docs/certificate.md, `switching`.
    """
    statement = statements.scenarios(len(scenarios))
    keys = {"scenarios": [_entry(network, each) for each in scenarios]}
    given = (scenario.weights for scenario in scenarios if scenario.weights is not None)
    unmixed = [network.unmixed, *(unmixed_column(w, network.deployed.offsets) for w in given)]
    reason = next(filter(None, unmixed), "the candidate is not positive definite")
    if any(unmixed) or not has_positive_diagonal(Y):
        return Undecided("switching", statement, reason, keys=keys)
    reason = "the candidate is not positive definite"
    short = shortened(Y, 24)
    exact = Exact.of(short)
    good = bool(exact.definite().all())
    for part in _TRIED if good else ():
        d = float(f"{part * max(margin, 0.0):.2e}")
        kept = Exact.of(1.0) - Exact.of(d)
        reason = ""
        for number, scenario in enumerate([Scenario(), *scenarios]):
            held = (kept * exact - _image(network, scenario, exact)).definite()
            if not held.all():
                which = "the nominal network" if number == 0 else f"scenario {number - 1}"
                reason = f"the inequality of node {int(np.argmin(held))} does not hold in {which}"
                break
        if not reason:
            return Proved("switching", statement, {"Y": [symmetric_text(X) for X in short]}, d, keys=keys)
    return Undecided("switching", statement, reason, keys=keys)


def scenario_weights(network: ExactNetwork, scenario: Scenario) -> Exact:
    """The weights of a scenario, exactly."""
    deployed = network.deployed
    w = Exact.of(deployed.weights if scenario.weights is None else scenario.weights)
    if scenario.dropped is None or not len(scenario.dropped):
        return w
    ints = w.ints.copy()
    own = np.flatnonzero(deployed.neighbours == deployed.hearer)
    for e in scenario.dropped.tolist():
        ints[own[deployed.hearer[e]]] += ints[e]
        ints[e] = 0
    return Exact(ints, w.exponent)


def scenario_loops(network: ExactNetwork, scenario: Scenario) -> Exact:
    """The loops M_k of a scenario, exactly."""
    deployed = network.deployed
    gains = (deployed.gains if scenario.gains is None else scenario.gains).copy()
    for e in [] if scenario.dropped is None else scenario.dropped.tolist():
        gains[deployed.columns[e] : deployed.columns[e + 1]] = 0.0
    C = Exact.of(deployed.network.C)[deployed.sensor_rows]
    product = Exact.of(gains).reshape(-1, deployed.n, 1) * C.reshape(-1, 1, deployed.n)
    return Exact.of(deployed.network.A) - segment_sums(product, deployed.columns[deployed.offsets])


def _image(network: ExactNetwork, scenario: Scenario, Y: Exact) -> Exact:
    deployed = network.deployed
    sizes, M = abs(scenario_weights(network, scenario)), scenario_loops(network, scenario)
    sigma = segment_sums(sizes, deployed.offsets)
    offsets, order = network.hearers
    spread = (sigma.reshape(-1, 1, 1) * Y)[deployed.hearer[order]]
    return M.T @ segment_sums(sizes[order].reshape(-1, 1, 1) * spread, offsets) @ M


def _entry(network: ExactNetwork, scenario: Scenario) -> dict[str, Any]:
    deployed = network.deployed
    entry: dict[str, Any] = {}
    if scenario.dropped is not None:
        pairs = {
            _link(int(deployed.neighbours[e]), int(deployed.hearer[e]), deployed.network.directed)
            for e in scenario.dropped.tolist()
        }
        entry["drop"] = [list(pair) for pair in sorted(pairs)]
    offsets = deployed.offsets
    if scenario.weights is not None:
        entry["weights"] = [matrix_text(part) for part in np.split(scenario.weights, offsets[1:-1])]
    if scenario.gains is not None:
        parts = np.split(scenario.gains, deployed.columns[offsets[1:-1]])
        entry["gains"] = [matrix_text(part.T) for part in parts]
    return entry


def _link(l: int, k: int, directed: bool) -> tuple[int, int]:
    return (l, k) if directed or l < k else (k, l)
