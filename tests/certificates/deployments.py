"""Deployments that several tests of certificates share, and the documents that their verdicts make."""

from __future__ import annotations

from typing import Any

import numpy as np

from tolnet import analysis, design
from tolnet.certificates.deployed import Centre, Deployed
from tolnet.certificates.document import SCHEMA
from tolnet.design.export.deployment import Deployment, central_gain_columns
from tolnet.model import Ambiguity, SensorNetwork
from tolnet.model.worst_case import psd_factor


def deployment_of(network: SensorNetwork, *, centre: bool = True) -> Deployed:
    """The gains and weights that a network's table leads to, with its least favourable model."""
    table = design.choose_tolerances(network)
    d = Deployment.of(table)
    worst = analysis.least_favourable_model(network, table.central)
    stated = None
    if centre and worst.exists:
        stated = Centre(central_gain_columns(network, table.central), psd_factor(worst.tilt))
    return Deployed(network, d.offsets, d.neighbours, d.weights, d.columns, d.gains, stated)


def random_network(seed: int, *, directed: bool = False, factors: bool = False) -> SensorNetwork:
    """A small network with a relay, different numbers of outputs, and either R or D, B or Q."""
    rng = np.random.default_rng(seed)
    n, N = int(rng.integers(1, 4)), int(rng.integers(3, 7))
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.5, 1.02) / np.abs(np.linalg.eigvals(A)).max()
    C = [rng.standard_normal((n if k % 2 else n + 1, n)) for k in range(N)]
    C[-1] = np.empty((0, n))
    root = [np.eye(len(c)) + 0.2 * rng.standard_normal((len(c), len(c))) for c in C]
    edges = [[k, k + 1] for k in range(N - 1)] + ([[N - 1, 0]] if directed else [])
    noise: dict[str, Any] = {"D": root} if factors else {"R": [D @ D.T / 2 + (D @ D.T).T / 2 for D in root]}
    process: dict[str, Any] = {"B": rng.standard_normal((n, n))} if factors else {"Q": np.eye(n)}
    return SensorNetwork(
        A=A, C=C, edges=edges, directed=directed, name="random", ambiguity=Ambiguity(0.01), **noise, **process
    )


def scalar(a: float, weight: float = 1.0) -> Deployed:
    """One node without a sensor: F = [weight a]."""
    network = SensorNetwork(A=[[a]], Q=[[1.0]], C=[np.empty((0, 1))], R=[np.empty((0, 0))], edges=[])
    return Deployed(network, np.array([0, 1]), np.array([0]), np.array([weight]), np.array([0, 0]), np.empty((0, 1)))


def document(deployed: Deployed, *verdicts: Any) -> dict[str, Any]:
    """The certificate of some verdicts, as it reads back."""
    return {
        "schema": SCHEMA,
        "tolnet": "0",
        "problem": {"name": "", "sha256": None},
        "convention": "gamma",
        "tau": 0.0,
        "tolerance": 0.01,
        "status": "ok",
        "data": deployed.data(),
        "claims": [verdict.entry() for verdict in verdicts],
    }
