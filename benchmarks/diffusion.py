"""The gradient of MSD in W against central differences and a dense adjoint by scipy; seconds to convergence.

Networks of the published plant (n = 6, three groups of two states) on a random geometric graph of degree about 12.
On the smallest one a value and a gradient by `NetworkErrors` is compared with scipy's Lyapunov solver for Q and for
the adjoint on the whole F, and with one central difference a weight (a sample, multiplied). `to convergence` is all
of `design.optimise_diffusion`, starts and final evaluation included; IPOPT, on the smallest, gets the same starts.
"""

from __future__ import annotations

import time
from typing import Literal

import numpy as np
from numpy import ndarray
from scipy import sparse
from scipy.linalg import solve_discrete_lyapunov

from benchmarks.harness import Measurement, measure, show
from benchmarks.performance import geometric
from tolnet import analysis, design
from tolnet.analysis.msd_gradient import NetworkErrors
from tolnet.model import Diffusion, SensorNetwork, ToleranceTable

SIZES = (20, 100, 500)
TOLERANCE = 0.02
SAMPLE = 3


def run() -> None:
    """Three sizes of network."""
    for N in SIZES:
        compare(N)


def compare(N: int) -> None:
    """Time a gradient and a whole design on one network."""
    network = geometric(N)
    table = design.choose_tolerances(network, TOLERANCE)
    worst = analysis.least_favourable_model(network, table.central)
    errors = NetworkErrors(network, table.local, worst)
    columns, a = errors.columns, np.full(N, 1 / N)
    w = 1.0 / columns.degree[columns.hearer]

    def gradient() -> ndarray:
        return errors.gradient(errors.solve(w), a)[0]

    lines = [measure("value and gradient", gradient, 5 if N <= 100 else 1)]
    if min(SIZES) == N:
        found, peer = gradient(), dense_adjoint(network, table, errors, w, a)
        np.testing.assert_allclose(found, peer, rtol=1e-7, atol=1e-9 * np.abs(peer).max())
        lines.append(measure("scipy, Q and adjoint", lambda: dense_adjoint(network, table, errors, w, a), 3))
        sample = measure("central differences", lambda: differences(errors, w, a, SAMPLE), 3)
        lines.append(sample.scaled(len(w) / SAMPLE))
    title = f"Diffusion weights, N = {N:,}, {len(w):,} weights"
    whole, result = converge("to convergence", network, table, "auto")
    lines.append(whole)
    if min(SIZES) == N:
        ipopt, other = converge("to convergence, IPOPT", network, table, "ipopt")
        lines.append(ipopt)
        print(f"  IPOPT ends {other.value / result.value - 1:+.1e} from the quasi-Newton method")
    show(title, lines)
    print(
        f"  MSD {result.baseline:.6g} -> {result.value:.6g}, bound {result.bound:.6g}:"
        f" gap closed {result.gap_closed:.1%}, {result.evaluations} evaluations, converged: {result.converged}"
    )


def converge(
    name: str, network: SensorNetwork, table: ToleranceTable, method: Literal["auto", "ipopt"]
) -> tuple[Measurement, Diffusion]:
    """One design, timed, and then what it found. Its memory is not watched, which would slow it down."""
    cpu, wall = time.process_time(), time.perf_counter()
    found = design.optimise_diffusion(network, table, method=method)
    return Measurement(name, time.process_time() - cpu, time.perf_counter() - wall, 0), found


def dense_adjoint(
    network: SensorNetwork, table: ToleranceTable, errors: NetworkErrors, w: ndarray, a: ndarray
) -> ndarray:
    """Eq. (12.2) of docs/mathematics.md with scipy on the whole F."""
    columns, N, n = errors.columns, network.N, network.n
    worst = analysis.least_favourable_model(network, table.central)
    W = sparse.csr_array((w, (columns.sender, columns.hearer)), shape=(N, N))
    mixed = analysis.error_dynamics(network, table.local, W, worst)
    alone = analysis.error_dynamics(network, table.local, sparse.csr_array(sparse.eye_array(N)), worst)
    F, D, F0, D0 = mixed.matrix(), mixed.noise_matrix(), alone.matrix(), alone.noise_matrix()
    Q = solve_discrete_lyapunov(F, D)
    C = np.diag(np.concatenate([np.repeat(a, n), np.zeros(n)]))
    Y = solve_discrete_lyapunov(F.T, C)
    U = np.eye(len(F))
    U[: N * n, : N * n] = np.kron(W.toarray().T, np.eye(n))
    change = (Y @ U @ (F0 @ Q @ F0.T + D0)).reshape(N + 1, n, N + 1, n)
    return 2 * np.einsum("tii->t", change[columns.hearer, :, columns.sender, :])


def differences(errors: NetworkErrors, w: ndarray, a: ndarray, count: int) -> list[float]:
    """The first few derivatives by central differences."""
    found = []
    for i in range(count):
        h = np.zeros_like(w)
        h[i] = 1e-6
        found.append(float(a @ (errors.solve(w + h).node_msd - errors.solve(w - h).node_msd)) / 2e-6)
    return found
