"""Per-node MSD in the steady state against `scipy.linalg.solve_discrete_lyapunov` and dense squared Smith.

Networks of the published plant (n = 6) on a random geometric graph of degree about 12. Every solver gets the same
error dynamics; the dense ones are given F and G G' ready made. `coupled` is the same network with its state in a
random orthonormal basis: MSD does not change, but the axes of the target can no longer be solved apart. The dense
solvers are timed once per network, up to 500 nodes (scipy takes minutes).
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable

import numpy as np
from numpy import ndarray
from scipy import sparse
from scipy.linalg import solve_discrete_lyapunov

from benchmarks.harness import Measurement, measure, show
from tolnet import analysis, design, model
from tolnet.analysis.lyapunov_dense import solve_smith
from tolnet.model import ErrorDynamics, SensorNetwork

SIZES = (100, 500, 1_000)
LARGEST_DENSE = 500
DEGREE = 12
TOLERANCE = 0.02


def run() -> None:
    """Three sizes of network."""
    for N in SIZES:
        compare(N)


def compare(N: int) -> None:
    """Time the solvers on one network, and make sure that they agree."""
    plain, coupled = dynamics_of(geometric(N)), dynamics_of(geometric(N, mixed=True))
    repeats = 5 if N <= 100 else 3
    lines = [
        measure("analysis.solve_lyapunov", lambda: analysis.solve_lyapunov(plain), repeats),
        measure("analysis.solve_lyapunov, coupled", lambda: analysis.solve_lyapunov(coupled), repeats),
    ]
    wanted = analysis.solve_lyapunov(plain)
    found = {"coupled": analysis.solve_lyapunov(coupled).node_msd}
    if N <= LARGEST_DENSE:
        F, D = plain.matrix(), plain.noise_matrix()
        for name, solve in (("squared Smith", lambda: solve_smith(F, D).X), ("scipy", lambda: scipy_solution(F, D))):
            line, Q = measure_once(f"{name}, dimension {len(F):,}", solve)
            lines.append(line)
            found[name] = np.diagonal(Q).reshape(-1, plain.n).sum(axis=1)[:-1]
    off = {name: float(np.abs(msd / wanted.node_msd - 1).max()) for name, msd in found.items()}
    links = (plain.mixing.nnz - N) / N
    title = (
        f"Per-node MSD, N = {N:,}, n = {plain.n}, degree {links:.1f}, spectral radius {wanted.spectral_radius:.4f}"
    )
    show(title, lines)
    print("  MSD_k differ by at most " + ", ".join(f"{value:.1g} ({name})" for name, value in off.items()))
    print(f"  error estimate {wanted.error_estimate:.1g}, residual {wanted.residual:.1g}, {wanted.iterations} steps")


def scipy_solution(F: ndarray, D: ndarray) -> ndarray:
    """The peer."""
    return np.asarray(solve_discrete_lyapunov(F, D))


def measure_once(name: str, call: Callable[[], ndarray]) -> tuple[Measurement, ndarray]:
    """One call, timed while its memory is watched; for what takes too long to repeat."""
    tracemalloc.start()
    cpu, wall = time.process_time(), time.perf_counter()
    result = call()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return Measurement(name, cpu, wall, peak), result


def dynamics_of(network: SensorNetwork) -> ErrorDynamics:
    """The network's table under the relative-degree rule."""
    table = design.choose_tolerances(network, TOLERANCE)
    if not table.ok:
        raise RuntimeError(f"the benchmark's own network {network.name} has no table: {table}")
    worst = analysis.least_favourable_model(network, table.central)
    return analysis.error_dynamics(network, table.local, design.diffusion_matrix(network, "relative-degree"), worst)


def geometric(N: int, *, mixed: bool = False) -> SensorNetwork:
    """N position sensors with R_k = sqrt(k + 1) R0, R0 permuted, on a connected geometric graph in a unit square."""
    rng = np.random.default_rng(N)
    plant = model.example("projectile")
    C = np.broadcast_to(np.hstack([np.zeros((3, 3)), np.eye(3)]), (N, 3, 6))
    noise = 0.5 * rng.permuted(np.tile([1.0, 4.0, 7.0], (N, 1)), axis=1) * np.sqrt(np.arange(1, N + 1))[:, None]
    basis = np.linalg.qr(rng.normal(size=(6, 6)))[0] if mixed else np.eye(6)
    return SensorNetwork(
        A=basis @ plant.A @ basis.T,
        Q=plant.Q,  # a multiple of the identity
        C=C @ basis.T,
        R=noise[:, :, None] * np.eye(3),
        adjacency=graph(N, np.random.default_rng(N + 1)),
        name=f"geometric-{N}",
    )


def graph(N: int, rng: np.random.Generator) -> sparse.csr_array:
    """Points that are closer than a distance, which gives `DEGREE` others on average, and grows until all connect."""
    points = rng.random((N, 2))
    squares = ((points[:, None] - points) ** 2).sum(axis=2)
    radius = np.sqrt(DEGREE / (np.pi * N))
    while True:
        linked = sparse.csr_array(squares < radius**2)
        if sparse.csgraph.connected_components(linked)[0] == 1:
            return linked
        radius *= 1.02
