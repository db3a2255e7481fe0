"""Where analysis and design, which find candidates, meet the room of certificates, which decides on them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy import ndarray
from scipy import sparse

from tolnet.analysis.stability_candidates import (
    Alternatives,
    Growth,
    block_candidate,
    full_candidate,
    growth_candidate,
    leading_mode,
    network_matrix,
    network_radius,
    power_candidate,
    switching_candidate,
    wide_candidate,
)
from tolnet.certificates import statements
from tolnet.certificates.eigenpair import refute_by_eigenpair
from tolnet.certificates.exact_network import ExactNetwork
from tolnet.certificates.numerals import number_text
from tolnet.certificates.performance import MOST, ExactDynamics, prove_performance
from tolnet.certificates.stability import Candidate, prove_stability, refute_stability
from tolnet.certificates.switching import (
    Scenario,
    prove_link_losses,
    prove_scenarios,
    scenario_loops,
    scenario_weights,
)
from tolnet.certificates.verdicts import Proved, Refuted, Undecided, Verdict
from tolnet.model.link_loss import Losses, possible_losses

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from tolnet.certificates.deployed import Deployed
    from tolnet.design.stabilise import StableWeights

    Progress = Callable[[int, int], None]

_FULL_UP_TO = 1500
"""Dimension N n up to which one dense Lyapunov matrix is tried; it is part of the certificate."""
_PART = 0.5
"""Of the largest margin, for the dual matrices: mean square deviations need them far from singular too."""
_POWERS_UP_TO = 400
_POWERS = (2, 4)
_CLOSE = 1.002
"""A decay rate this much above the spectral radius is tried where nobody names one."""
_BISECTIONS = 8


@dataclass(eq=False)
class Evidence:
    """Everything that is known in floating point of one deployment, and what could be proved from it."""

    deployed: Deployed

    @cached_property
    def exact(self) -> ExactNetwork:
        """The exact matrices."""
        return ExactNetwork(self.deployed)

    @cached_property
    def loops(self) -> ndarray:
        """M_k in floating point."""
        return self.deployed.loops[0]

    @property
    def dimension(self) -> int:
        """N n."""
        return self.deployed.N * self.deployed.n

    @cached_property
    def matrix(self) -> ndarray:
        """The network block, dense; for small networks only."""
        return network_matrix(self.loops, self.deployed.mixing)

    @cached_property
    def centre_loop(self) -> ndarray | None:
        """F_e, where a least favourable model is stated."""
        return None if self.deployed.centre is None else self.exact.centre_loops[1].rounded()

    @cached_property
    def radius(self) -> float:
        """Spectral radius of the network block in floating point; NaN where it was not found."""
        return network_radius(self.loops, self.deployed.mixing)

    @cached_property
    def centre_radius(self) -> float:
        """Spectral radius of F_e in floating point; 0 where no least favourable model is stated."""
        return 0.0 if self.centre_loop is None else float(np.abs(np.linalg.eigvals(self.centre_loop)).max())

    @cached_property
    def primal(self) -> ndarray | None:
        """X with X - T(X) > 0."""
        return wide_candidate(self.loops, self.deployed.mixing)

    @cached_property
    def dual(self) -> ndarray | None:
        """Y with Y - T*(Y) > 0."""
        return wide_candidate(self.loops, self.deployed.mixing, dual=True, part=_PART)

    @cached_property
    def growth(self) -> tuple[Literal["network", "centre"], Growth] | None:
        """What shows that some eigenvalue lies outside the unit circle, where floating point sees one."""
        centre = None if self.centre_loop is None else growth_candidate(self.centre_loop)
        if centre is not None and centre.X is not None:
            return "centre", centre
        if self.dimension <= _FULL_UP_TO:
            found = growth_candidate(self.matrix)
        else:
            found = leading_mode(self.loops, self.deployed.mixing)
        return None if found is None else ("network", found)

    def stability(self, progress: Progress | None = None) -> Verdict:
        """The ladder: block by block, forwards and backwards; powers; one full matrix; or a refutation."""
        tried: list[str] = []
        centre = None if self.centre_loop is None else full_candidate(self.centre_loop)
        if self.deployed.centre is None or centre is not None:
            for candidate in self._candidates(centre):
                verdict = prove_stability(self.exact, candidate, progress=progress)
                if isinstance(verdict, Proved):
                    return verdict
                tried.append(verdict.reason)
        if self.growth is not None:
            of, growth = self.growth
            for verdict in self._refutations(of, growth):
                if isinstance(verdict, Refuted):
                    return verdict
                tried.append(verdict.reason)
        return self._undecided_stability(tried)

    def _candidates(self, centre: ndarray | None) -> Iterator[Candidate]:
        mixing = self.deployed.mixing
        if self.primal is not None:
            yield Candidate("primal", self.primal, centre)
        if self.dual is not None:
            yield Candidate("dual", self.dual, centre)
        if self.dimension > _FULL_UP_TO or not self.radius < 1:
            return
        for power in _POWERS if self.dimension <= _POWERS_UP_TO else ():
            if (found := power_candidate(self.loops, mixing, power)) is not None:
                yield Candidate("power", found.X, centre, found.power, found.shares)
        if (X := full_candidate(self.matrix)) is not None:
            yield Candidate("full", X, centre)

    def _refutations(self, of: Literal["network", "centre"], growth: Growth) -> Iterator[Refuted | Undecided]:
        if growth.X is not None:
            yield refute_stability(self.exact, of, growth.X, growth.v)
        if of == "network":
            yield refute_by_eigenpair(self.deployed, growth.eigenvalue, growth.mode)

    def _undecided_stability(self, tried: Sequence[str]) -> Undecided:
        block = "network" if self.deployed.centre is None else "F"
        seen = "was not found" if np.isnan(self.radius) else f"is {self.radius:.9g} in floating point"
        reasons = [f"the spectral radius of the network block {seen}", *(tried or ["no candidate was found"])]
        statement = statements.stability(block)
        return Undecided("schur-stability", statement, "; ".join(reasons), keys={"block": block})

    def stable_weights_nearby(self) -> StableWeights | None:
        """Weights on the same graph that are proved stable, as near to the proposed ones as was found; or None."""
        from tolnet.design.stabilise import stabilise_weights

        found = stabilise_weights(self.loops, self.deployed.mixing)
        if found is None:
            return None
        heard = self.deployed
        weights = np.asarray(found.W[heard.neighbours, heard.hearer]).ravel()
        other = Evidence(replace(heard, weights=weights))
        centre = None if self.centre_loop is None else full_candidate(self.centre_loop)
        X = found.X if other.primal is None else other.primal
        verdict = prove_stability(other.exact, Candidate("primal", X, centre))
        return found._replace(margin=verdict.margin or 0.0) if isinstance(verdict, Proved) else None

    def decay_rate(self, rate: float | None, progress: Progress | None = None) -> Verdict:
        """The smallest rate that is proved, or the one that was asked for."""
        verdict: Verdict | None = None
        r = rate or 1.0
        for r in [rate] if rate is not None else self._rates():
            for candidate in self._rate_candidates(r):
                verdict = prove_stability(self.exact, candidate, rate=r, progress=progress)
                if isinstance(verdict, Proved):
                    return verdict
        if verdict is not None:
            return verdict
        block = "network" if self.deployed.centre is None else "F"
        statement = statements.decay_rate(block, r)
        keys = {"block": block, "rate": number_text(r)}
        reason = f"no candidate was found; the spectral radius of the network block is {self.radius:.6g}"
        if self.centre_loop is not None:
            reason += f", of the least favourable block {self.centre_radius:.6g}"
        return Undecided("decay-rate", statement, f"{reason} in floating point", keys=keys)

    def _rates(self) -> Iterator[float]:
        """Rates to try, rising: close to the spectral radius, then what the block-wise condition reaches."""
        centre = self.centre_radius
        radius = max(self.radius, centre)
        if self.dimension <= _FULL_UP_TO and radius > 0:
            yield float(f"{_CLOSE * radius:.4g}")
        low, high = (radius if radius > 0 else 1e-6), 1.0
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            found = middle > centre and block_candidate(self.loops / middle, self.deployed.mixing) is not None
            low, high = (low, middle) if found else (middle, high)
        yield float(f"{high * 1.0005:.4g}")

    def _rate_candidates(self, r: float) -> Iterator[Candidate]:
        centre = None if self.centre_loop is None else full_candidate(self.centre_loop, r)
        if self.deployed.centre is not None and centre is None:
            return
        if self.dimension <= _FULL_UP_TO and (X := full_candidate(self.matrix, r)) is not None:
            yield Candidate("full", X, centre)
        if (X := block_candidate(self.loops / r, self.deployed.mixing)) is not None:
            yield Candidate("primal", X, centre)

    def performance(self) -> Proved | Undecided:
        """MSD of every node, enclosed."""
        Q = centre = None
        if self.centre_loop is not None:
            centre = full_candidate(self.centre_loop.T)
            if (self.deployed.N + 1) * self.deployed.n <= MOST and centre is not None and self.dual is not None:
                Q = self._covariance(self.dual)
        return prove_performance(self.exact, Q, self.dual, centre)

    def _covariance(self, dual: ndarray) -> ndarray:
        """Q = F Q F' + G G', by way of units in which the dual matrices are near I, so that F contracts."""
        from tolnet.analysis.lyapunov_dense import solve_smith

        F, noise = ExactDynamics(self.exact).rounded()
        one = np.exp2(np.round(np.log2(np.diagonal(dual, axis1=1, axis2=2).max(axis=0)) / 2))
        unit = np.tile(one, self.deployed.N + 1)
        both = unit[:, None] * unit
        return solve_smith(F * (unit[:, None] / unit), noise * both).X / both

    def link_losses(self, most: int, progress: Progress | None = None) -> Verdict:
        """One Y for every loss of at most `most` links."""
        deployed = self.deployed
        losses = possible_losses(deployed.offsets, deployed.neighbours, most, directed=deployed.network.directed)
        M, weights = self.loops[losses.node], deployed.weights
        C = deployed.network.C[deployed.sensor_rows]
        product = deployed.gains[:, :, None] * C[:, None, :]
        parts = np.zeros((len(weights) + 1, deployed.n, deployed.n))
        np.add.at(parts, np.repeat(np.arange(len(weights)), np.diff(deployed.columns)), product)
        M = M + parts[losses.lost].sum(axis=1)  # the last part is zero, and -1 names it
        sigma = np.asarray(abs(deployed.mixing).sum(axis=1))
        spread = self._spread(sigma, weights)[losses.node]
        rows, k, values = _changes(losses, sigma, weights, deployed.hearer)
        spread = spread + sparse.csr_array((values, (rows, k)), shape=spread.shape)
        found = switching_candidate(Alternatives(losses.node, M, sparse.csr_array(spread)), deployed.N, progress)
        if found is None:
            return self._undecided_switching(statements.link_losses(most), {"drop": most})
        return prove_link_losses(self.exact, found[0], losses, most, found[1])

    def scenarios(self, scenarios: Sequence[Scenario], progress: Progress | None = None) -> Verdict:
        """One Y for all scenarios and the nominal network."""
        deployed, each = self.deployed, [Scenario(), *scenarios]
        loops = np.concatenate([scenario_loops(self.exact, s).rounded() for s in each])
        spreads = []
        for scenario in each:
            weights = np.abs(scenario_weights(self.exact, scenario).rounded())
            sigma = np.add.reduceat(weights, deployed.offsets[:-1])
            spreads.append(self._spread(sigma, weights))
        forms = Alternatives(
            np.tile(np.arange(deployed.N), len(each)), loops, sparse.csr_array(sparse.vstack(spreads))
        )
        found = switching_candidate(forms, deployed.N, progress)
        if found is None:
            return self._undecided_switching(statements.scenarios(len(scenarios)), {})
        return prove_scenarios(self.exact, found[0], scenarios, found[1])

    def _spread(self, sigma: ndarray, weights: ndarray) -> sparse.csr_array:
        """(l, k): sigma_k |w_lk|."""
        deployed = self.deployed
        values = sigma[deployed.hearer] * np.abs(weights)
        shape = (deployed.N, deployed.N)
        return sparse.csr_array((values, (deployed.neighbours, deployed.hearer)), shape=shape)

    def _undecided_switching(self, statement: str, keys: dict) -> Undecided:
        reason = (
            "no common Lyapunov matrix of block-diagonal form was found; that does not say that none exists, nor that"
            " the network would be unstable"
        )
        return Undecided("switching", statement, reason, keys=keys)


def _changes(losses: Losses, sigma: ndarray, weights: ndarray, hearer: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Rows, columns and values by which losses change sigma_k |w_lk|: what a node keeps, and who hears it no more."""
    node, lost, returned = losses.node, losses.lost, losses.returned
    case, column = np.nonzero(lost >= 0)
    e = lost[case, column]
    kept = case, node[case], sigma[node[case]] * weights[e]
    case, column = np.nonzero(returned >= 0)
    e = returned[case, column]
    gone = case, hearer[e], -sigma[hearer[e]] * weights[e]
    rows, k, values = (np.concatenate(pair) for pair in zip(kept, gone, strict=True))
    return rows, k, values
