"""Certify and check against ARPACK's time for the bare spectral radius, which proves nothing.

Random geometric networks with about 8 neighbours a node, and the projectile.
Finding is an iteration in floating point, proving exact arithmetic; check.py is the whole process with the standard
library alone, reading of the file included. ARPACK computes the leading eigenvalues of the same sparse matrix.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse.linalg import eigs

import tolnet.certificates
from benchmarks.harness import Measurement, measure_process, show
from tolnet import analysis, design
from tolnet.analysis.stability_candidates import block_candidate
from tolnet.certificates.deployed import Centre, Deployed
from tolnet.certificates.document import certificate_json
from tolnet.certificates.eigenpair import sparse_block
from tolnet.certificates.exact_network import ExactNetwork
from tolnet.certificates.stability import Candidate, prove_stability
from tolnet.certificates.verdicts import Proved
from tolnet.cli.evidence import Evidence
from tolnet.design.export import opening
from tolnet.design.export.deployment import Deployment, central_gain_columns
from tolnet.model import SensorNetwork
from tolnet.model.examples import projectile, random_network
from tolnet.model.worst_case import psd_factor

SIZES = ((1_000, 6), (100_000, 4))
"""Nodes and states."""
CHECKER = Path(tolnet.certificates.__file__).with_name("check.py")


def run() -> None:
    """The projectile and two random networks; mean square deviations of the smaller ones."""
    compare(projectile())
    for N, n in SIZES:
        compare(random_network(N, 1, n))
    enclose(projectile())
    N, n = SIZES[0]
    enclose(random_network(N, 1, n))


def enclose(network: SensorNetwork) -> None:
    """Time an enclosure of the mean square deviations against their evaluation, which proves nothing."""
    table = design.choose_tolerances(network)
    d, worst = Deployment.of(table), analysis.least_favourable_model(network, table.central)
    centre = Centre(central_gain_columns(network, table.central), psd_factor(worst.tilt))
    deployed = Deployed(network, d.offsets, d.neighbours, d.weights, d.columns, d.gains, centre)
    found: list[Any] = []
    weights = design.diffusion_matrix(network)
    lines = [
        _timed(
            "evaluate them, in floating point",
            lambda: found.append(analysis.evaluate_filters(table, weights, filters=["RKFDNU2"])),
        ),
        _timed("enclose them", lambda: found.append(Evidence(deployed).performance())),
    ]
    verdict = found[1]
    if not isinstance(verdict, Proved):
        raise SystemExit(f"not proved: {verdict.reason}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "certificate.json"
        path.write_text(
            "".join(certificate_json(opening("tolnet.certificate/1", network, "ok"), deployed.data(), [verdict]))
        )
        size = path.stat().st_size
        lines.append(measure_process("tolnet check", ["-m", "tolnet", "check", str(path), "--quiet"], repeats=1))
    show(f"Mean square deviations of {network.N:,} nodes, n = {network.n}", lines)
    low, high = map(float.fromhex, verdict.keys["network"].split(" "))
    way = "exactly" if verdict.proof["Q"] is not None else "with bounds on rounding"
    print(f"  {way}: {(low + high) / 2:.9g} within {(high - low) / 2:.2g}, certificate of {size / 2**20:.3g} MB")


def compare(network: SensorNetwork) -> None:
    """Time finding, proving and checking a proof of Schur stability of the network block."""
    d = Deployment.of(design.choose_tolerances(network))
    deployed = Deployed(network, d.offsets, d.neighbours, d.weights, d.columns, d.gains)
    lines, found = [], []
    F, _ = sparse_block(deployed)
    start = np.random.default_rng(0).normal(size=network.N * network.n)
    lines.append(
        _timed(
            "ARPACK, spectral radius only",
            lambda: found.append(np.asarray(eigs(F, k=4, v0=start, ncv=40, return_eigenvectors=False))),
        )
    )
    M = deployed.loops[0]
    lines.append(_timed("find the proof", lambda: found.append(block_candidate(M, deployed.mixing))))
    candidate = Candidate("primal", found[1])
    lines.append(
        _timed("prove it, exactly", lambda: found.append(prove_stability(ExactNetwork(deployed), candidate)))
    )
    verdict = found[2]
    if not isinstance(verdict, Proved):
        raise SystemExit(f"not proved: {verdict.reason}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "certificate.json"
        pieces = certificate_json(opening("tolnet.certificate/1", network, "ok"), deployed.data(), [verdict])
        lines.append(_timed("write the certificate", lambda: path.write_text("".join(pieces))))
        size = path.stat().st_size
        lines.append(measure_process("check.py, the whole process", ["-I", str(CHECKER), str(path)], repeats=1))
    radius = float(np.abs(found[0]).max())
    show(f"Stability of {network.N:,} nodes, n = {network.n}, spectral radius {radius:.4f}", lines)
    print(f"  margin {verdict.margin:g}, certificate of {size / 2**20:.3g} MB")


def _timed(name: str, call: Callable[[], object]) -> Measurement:
    """One call; memory is not watched, since that would slow exact arithmetic down several times."""
    cpu, wall = time.process_time(), time.perf_counter()
    call()
    return Measurement(name, time.process_time() - cpu, time.perf_counter() - wall, 0)
