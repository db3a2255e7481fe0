"""Fastest mixing: W with the least |W - 11'/N|, a semidefinite program."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from tolnet.analysis.curvature import Columns
from tolnet.design.weights.admissible import Admissible, Constraints, make_admissible
from tolnet.design.weights.mixing_interior import ColumnProgram, LinkProgram, Watch, solve_program_inside
from tolnet.design.weights.programs import solve_program
from tolnet.model import InputError, SensorNetwork, UnsupportedError

LARGEST, LARGEST_SYMMETRIC = 300, 600
"""Nodes; more take minutes and gigabytes."""
LARGEST_SDP, LARGEST_SDP_SYMMETRIC = 60, 120
"""The same for the general solver."""
_LEAST_TOLERANCE = 1e-10
"""What HiGHS takes at least."""
_START = 1.1
"""The first t, relative to the norm there."""


class MixingDesign(NamedTuple):
    """W and its norm, and a bound that no admissible W is below."""

    W: sparse.csr_array
    value: float
    bound: float
    before: float
    """The norm as the solver left it, before the last step made W exactly admissible."""


def design_mixing(
    network: SensorNetwork,
    among: Admissible,
    constraints: Constraints,
    *,
    sdp: bool = False,
    watch: Watch = lambda what, value: None,
) -> MixingDesign:
    """Minimise |W - 11'/N| (spectral norm) over admissible W; symmetric W give the fastest mixing Markov chain.

    By interior points made for this program, or with `sdp` by CVXPY and Clarabel, which is their reference. The bound
    is the dual: |W - 11'/N| >= <Z, W - 11'/N> for every Z of nuclear norm 1, and the least <Z, W> over the admissible
    W is found column by column, or by a linear program where W is symmetric. Value and bound are recomputed here,
    whatever gave W and Z.
    Raises InputError for a graph that is not connected, UnsupportedError for one that is too large.
    Source: S. Boyd, P. Diaconis, L. Xiao, SIAM Review 46(4):667-689, 2004.
    """
    check_connected(network)
    symmetric = constraints.symmetric
    _check_size(network.N, symmetric, sdp)
    if network.N == 1:
        return MixingDesign(sparse.csr_array(np.ones((1, 1))), 0.0, 0.0, 0.0)
    if sdp:
        w, Z = (_solve_symmetric if symmetric else _solve)(among)
    else:
        w, Z = (_inside_symmetric if symmetric else _inside)(among, watch)
    W = make_admissible(among, w if symmetric else among.project(w), symmetric=symmetric)
    least = _least_symmetric if symmetric else _least
    mean = np.full((network.N, network.N), 1 / network.N)
    bound = max((least(among, X) - float((X * mean).sum())) / np.linalg.norm(X, "nuc") for X in (Z, -Z))
    raw = np.zeros_like(mean)
    raw[among.columns.sender, among.columns.hearer] = w
    value = distance_from_average(W)
    bound = min(max(float(bound), 0.0), value)  # both are right to rounding
    return MixingDesign(W, value, bound, float(np.linalg.norm(raw - mean, 2)))


def _check_size(N: int, symmetric: bool, sdp: bool) -> None:
    free, paired = (LARGEST_SDP, LARGEST_SDP_SYMMETRIC) if sdp else (LARGEST, LARGEST_SYMMETRIC)
    most = paired if symmetric else free
    if most < N:
        advice = "" if symmetric else f"; symmetric weights are found up to {paired} nodes"
        raise UnsupportedError(f"the fastest mixing weights of {N} nodes are too much: at most {most}{advice}")


def distance_from_average(W: sparse.csr_array) -> float:
    """|W - 11'/N| in the spectral norm."""
    dense = W.toarray()
    return float(np.linalg.norm(dense - 1 / len(dense), 2))


def is_connected(network: SensorNetwork) -> bool:
    """Whether every node hears every other one, directly or by way of others."""
    count, _ = connected_components(network.adjacency, directed=True, connection="strong")
    return count == 1


def check_connected(network: SensorNetwork) -> None:
    """Raise InputError unless every node hears every other one, directly or by way of others."""
    count, part = connected_components(network.adjacency, directed=True, connection="strong")
    if count > 1:
        other = int(np.flatnonzero(part != part[0])[0])
        raise InputError(
            f"the graph is not connected: nodes {network.label(0)} and {network.label(other)} do not hear each other,"
            " by whatever way, so that no W averages over all nodes; use another objective, or add links"
        )


def _inside(among: Admissible, watch: Watch) -> tuple[Float[ndarray, " L"], Float[ndarray, "N N"]]:
    """Weights link by link, and the dual matrix, by interior points. Columns without a choice stay out of it."""
    columns, N, L = among.columns, among.columns.nodes, len(among.columns.sender)
    least = np.zeros(L)
    least[columns.own] = among.lower
    w = least + ((1 - among.lower) / columns.degree)[columns.hearer]
    free = np.flatnonzero(((columns.degree > 1) & (among.lower < 1))[columns.hearer])
    X = np.full((N, N), -1 / N)
    X[columns.sender, columns.hearer] += w
    t = max(_START * float(np.linalg.norm(X, 2)), 1 / N)
    X[columns.sender[free], columns.hearer[free]] = -1 / N
    sums = np.zeros((N, len(free)))
    sums[columns.hearer[free], np.arange(len(free))] = 1.0
    program = ColumnProgram(
        X, columns.sender[free], columns.hearer[free], least[free], sums[np.unique(columns.hearer[free])]
    )
    w[free], (Z,) = solve_program_inside(program, w[free], t, watch)
    return w, Z[:N, N:]


def _inside_symmetric(among: Admissible, watch: Watch) -> tuple[Float[ndarray, " L"], Float[ndarray, "N N"]]:
    """The same for symmetric weights. Links of nodes without a choice stay out of it."""
    columns, N, room = among.columns, among.columns.nodes, 1 - among.lower
    first, second = _edges(columns)
    free = (room[first] > 0) & (room[second] > 0)
    first, second, each = first[free], second[free], np.arange(int(free.sum()))
    difference = np.zeros((N, len(each)))
    difference[first, each], difference[second, each] = 1.0, -1.0
    share = room / np.maximum(np.abs(difference).sum(axis=1), 1.0)
    program = LinkProgram(difference, room)
    u = np.minimum(share[first], share[second]) / 2
    t = max(_START * float(np.linalg.norm(program.matrices(u, 0.0)[1], 2)), 1 / N)
    u, (above, below) = solve_program_inside(program, u, t, watch)
    W = np.eye(N) - (difference * u) @ difference.T
    return W[columns.sender, columns.hearer], above - below


def _solve(among: Admissible) -> tuple[Float[ndarray, " L"], Float[ndarray, "N N"]]:
    """Weights link by link, and the dual matrix, of min t: [t I, W - 11'/N; (W - 11'/N)', t I] >= 0."""
    import cvxpy as cp

    columns, N = among.columns, among.columns.nodes
    w, t, lower = cp.Variable(len(columns.sender)), cp.Variable(), cp.Parameter(N, nonneg=True)
    X = _matrix(columns, w) - np.full((N, N), 1 / N)
    norm = cp.bmat([[t * np.eye(N), X], [X.T, t * np.eye(N)]]) >> 0
    sums = sparse.csr_array((np.ones(len(columns.hearer)), (columns.hearer, np.arange(len(columns.hearer)))))
    limits: list[Any] = [norm, w >= 0, w[columns.own] >= lower, sums @ w == 1]
    problem = cp.Problem(cp.Minimize(t), limits)
    lower.value = among.lower
    _solved(problem)
    return np.asarray(w.value), np.asarray(norm.dual_value)[:N, N:]


def _solve_symmetric(among: Admissible) -> tuple[Float[ndarray, " L"], Float[ndarray, "N N"]]:
    """The same for W = I - sum_e u_e (e_l - e_k)(e_l - e_k)', with -t I <= W - 11'/N <= t I."""
    import cvxpy as cp

    columns, N = among.columns, among.columns.nodes
    first, second = _edges(columns)
    u, t, room = cp.Variable(len(first)), cp.Variable(), cp.Parameter(N, nonneg=True)
    each = np.arange(len(first))
    ends = sparse.csr_array(
        (np.ones(2 * len(first)), (np.concatenate([first, second]), np.concatenate([each, each]))),
        shape=(N, len(first)),
    )
    difference = sparse.csr_array(
        (np.repeat([1.0, -1.0], len(first)), (np.concatenate([first, second]), np.concatenate([each, each]))),
        shape=(N, len(first)),
    )
    W = np.eye(N) - difference @ cp.diag(u) @ difference.T
    X = W - np.full((N, N), 1 / N)
    above, below = t * np.eye(N) - X >> 0, t * np.eye(N) + X >> 0
    limits: list[Any] = [above, below, u >= 0, ends @ u <= room]
    problem = cp.Problem(cp.Minimize(t), limits)
    room.value = 1 - among.lower
    _solved(problem)
    found = np.asarray(W.value)
    return found[columns.sender, columns.hearer], np.asarray(above.dual_value) - np.asarray(below.dual_value)


def _solved(problem: Any) -> None:
    if not solve_program(problem):
        raise UnsupportedError(f"the semidefinite program of the mixing weights has no solution ({problem.status})")


def _matrix(columns: Columns, w: Any) -> Any:
    """W as an expression in the weights of its links."""
    import cvxpy as cp

    N, L = columns.nodes, len(columns.sender)
    place = columns.sender + N * columns.hearer  # columns first
    spread = sparse.csr_array((np.ones(L), (place, np.arange(L))), shape=(N * N, L))
    return cp.reshape(spread @ w, (N, N), order="F")


def _edges(columns: Columns) -> tuple[ndarray, ndarray]:
    """The two ends of every link, each link once."""
    once = columns.sender < columns.hearer
    return columns.sender[once], columns.hearer[once]


def _least(among: Admissible, Z: Float[ndarray, "N N"]) -> float:
    """min <Z, W> over the admissible W: column by column all that is free goes where Z is least."""
    columns = among.columns
    cost = Z[columns.sender, columns.hearer]
    best = np.where(columns.present, columns.spread(cost, np.inf), np.inf).min(axis=1)
    return float(among.lower @ np.diagonal(Z) + (1 - among.lower) @ best)


def _least_symmetric(among: Admissible, Z: Float[ndarray, "N N"]) -> float:
    """A bound on min <Z, W> over the symmetric admissible W, a linear program in the weights u >= 0 of the links.

        min cost'u, ends u <= room  >=  -room'y  for every y >= 0 with cost + ends'y >= 0

    y comes from the solver and is raised until it satisfies this to rounding: the bound does not rest on the solver.
    """
    from scipy.optimize import linprog

    first, second = _edges(among.columns)
    cost = Z[first, second] + Z[second, first] - Z[first, first] - Z[second, second]
    each = np.arange(len(first))
    ends = sparse.csr_array(
        (np.ones(2 * len(first)), (np.concatenate([first, second]), np.concatenate([each, each]))),
        shape=(len(Z), len(first)),
    )
    options = {"dual_feasibility_tolerance": _LEAST_TOLERANCE}
    found = linprog(cost, A_ub=ends, b_ub=1 - among.lower, bounds=(0, None), method="highs", options=options)
    if not found.success:
        return -np.inf
    y = np.maximum(-found.ineqlin.marginals, 0.0)
    lacking = np.maximum(-cost - y[first] - y[second], 0.0) / 2
    raised = np.zeros_like(y)
    np.maximum.at(raised, first, lacking)
    np.maximum.at(raised, second, lacking)
    y += raised
    return float(np.trace(Z) - (1 - among.lower) @ y)
