"""The tolerance table against the naive way: per node, determinants for c_k and the recursion with bisection.

The peer is NumPy as one would write it from the paper: c_k by eq. (31) with matrices of size n + p_k, then eq. (8)
step by step with explicit inverses and theta by bisection, until V moves by less than 1e-10. It is handed the
centre's steady state. For more than 50 nodes it is timed on 30 of them and multiplied.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy import ndarray
from numpy.linalg import inv, norm, slogdet
from tests.reference.determinants import information, stacked
from tests.reference.recursion import step

from benchmarks.harness import measure, measure_process, show
from tolnet import analysis, design, model
from tolnet.model import SensorNetwork, SteadyState

SIZES = (20, 1_000, 20_000)
SAMPLE = 30
TOLERANCE = 0.02


def run() -> None:
    """Three sizes of network, then the command as a whole process."""
    for N in SIZES:
        compare(geometric_projectile(N))
    with tempfile.TemporaryDirectory() as folder:
        problem = str(Path(folder) / "projectile.toml")
        model.save(model.example("projectile"), problem)
        empty = measure_process("python -c 'import numpy'", ["-c", "import numpy"])
        table = measure_process("tolnet table projectile.toml", ["-m", "tolnet", "table", problem])
    show("The command, as a whole process", [empty, table])


def compare(network: SensorNetwork) -> None:
    """Time both on one network, after making sure that they agree."""
    N = network.N
    centre = analysis.solve_steady_state(network, TOLERANCE)
    nodes = np.arange(N) if N <= 50 else np.random.default_rng(0).choice(N, SAMPLE, replace=False)
    rows = np.array([naive_row(network, centre, k) for k in nodes.tolist()])
    table = design.choose_tolerances(network, TOLERANCE)
    np.testing.assert_allclose(table.tolerances[nodes], rows[:, 0], rtol=1e-7)
    np.testing.assert_allclose(table.local.theta[nodes], rows[:, 1], rtol=1e-7)
    ours = measure(
        "design.choose_tolerances", lambda: design.choose_tolerances(network, TOLERANCE), 5 if N <= 1000 else 3
    )
    naive = measure(
        "naive fixed point, bisection", lambda: [naive_row(network, centre, k) for k in nodes.tolist()], 1
    )
    show(f"Tolerance table, N = {N:,}, n = {network.n}", [ours, naive.scaled(N / len(nodes))])


def naive_row(network: SensorNetwork, centre: SteadyState, k: int) -> tuple[float, float]:
    """c_k and theta_k of one node."""
    C, R = stacked(network, network.neighbours(k).tolist())
    c_k = naive_tolerance(network, centre, C, R)
    A, Q, S, V = network.A, network.Q, information(C, R), np.eye(network.n)
    while True:
        _, theta, following = step(A, Q, S, c_k, V)
        moved, V = norm(following - V), following
        if moved < 1e-10 * norm(V):
            return c_k, theta


def naive_tolerance(network: SensorNetwork, centre: SteadyState, C: ndarray, R: ndarray) -> float:
    """Eq. (31) with the neighbourhood's outputs; the global K_xy K_y^-1 K_yx is K_x - P, eq. (19)."""
    A, V = network.A, centre.V
    K_x, K_xy, K_y = A @ V @ A.T + network.Q, A @ V @ C.T, C @ V @ C.T + R
    K = np.block([[K_x, K_xy], [K_xy.T, K_y]])
    tilde_K = np.block([[K_x - centre.P + V, K_xy], [K_xy.T, K_y]])
    return float(slogdet(K)[1] - slogdet(tilde_K)[1] + np.trace(tilde_K @ inv(K)) - len(K))


def geometric_projectile(N: int) -> SensorNetwork:
    """The published plant (n = 6) seen by N position sensors of unequal noise on a random geometric graph."""
    plant, graph = model.example("projectile"), model.example("random", nodes=N, seed=0)
    noise = np.random.default_rng(1).uniform(0.5, 4.0, (N, 3)) * np.sqrt(N / 20)
    return SensorNetwork(
        A=plant.A,
        Q=plant.Q,
        C=np.broadcast_to(np.hstack([np.zeros((3, 3)), np.eye(3)]), (N, 3, 6)).copy(),
        R=noise[:, :, None] * np.eye(3),
        adjacency=graph.adjacency,
        name=f"geometric-projectile-{N}",
    )
