"""Diffusion weights by rule: how node k mixes what its neighbours send, from degrees or from variances (eq. (11))."""

from __future__ import annotations

import difflib
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.analysis.curvature import columns_of
from tolnet.analysis.stacked import smallest_unit_eigenvalue
from tolnet.design.tolerances import choose_tolerances
from tolnet.design.weights.intersection import intersect_covariances
from tolnet.model import DIFFUSION_RULES, Complaint, InputError, SensorNetwork, ToleranceTable, UnsupportedError

_Links = tuple[Int[ndarray, " E"], Int[ndarray, " E"]]
"""The indices l and k of every pair in which node k hears node l, self-loops included, sorted by l."""


def diffusion_matrix(
    network: SensorNetwork, rule: str | None = None, table: ToleranceTable | None = None
) -> sparse.csr_array:
    """W = [w_lk], where w_lk weighs neighbour l at node k: x_k = sum_l w_lk psi_l, eqs. (11), (13), (45).

    Every rule gives w_lk >= 0, w_lk = 0 where node k does not hear node l, and sum_l w_lk = 1, from the counts
    n_k = |N_k| of nodes that node k hears, itself included, or from the V_l of the nodes' filters:

        uniform           w_lk = 1 / n_k
        relative-degree   w_lk = n_l / sum_{m in N_k} n_m                      a neighbour that hears more counts more
        metropolis        w_lk = 1 / max(n_l, n_k), l != k; w_kk = 1 - the rest     symmetric, so W averages
        laplacian         w_lk = 1 / max_m n_m, l != k; w_kk = 1 - the rest         symmetric, W = I - L / max_m n_m
        none              w_kk = 1                                             every node keeps its own estimate
        relative-variance w_lk = (1 / tr V_l) / sum_{m in N_k} 1 / tr V_m      who estimates better counts more
        covariance-intersection   column k minimises tr (sum_l w_lk V_l^-1)^-1      as if correlations were unknown

    `rule` None takes the network's own: its rule, or its W as it is. The last two take V_l from `table`, which is
    computed at the network's own tolerance where it is not given. In a directed graph n_k counts what node k hears;
    `metropolis` and `laplacian` average only where every link works both ways, so they are refused elsewhere.

    Shape (N, N), sparse; no unit. Raises InputError for an unknown rule or a missing tolerance, UnsupportedError for
    `metropolis` and `laplacian` on a graph with one-way links, and where some V_l does not exist.
    Source: eq. (11) and Section 5 (relative degree); F. S. Cattivelli, A. H. Sayed, IEEE Trans. Automatic Control
    55(9):2069-2084, 2010, Table I (from degrees); A. H. Sayed, Foundations and Trends in Machine Learning 7(4-5),
    2014, Table 14.1 (relative variance); S. J. Julier, J. K. Uhlmann, Proc. American Control Conference, 1997.
    """
    if rule is None:
        if not isinstance(network.diffusion, str):
            return network.diffusion
        rule = network.diffusion
    check_rule(network, rule)
    J, n = network.adjacency, network.degree
    l, k = np.repeat(np.arange(network.N), np.diff(J.indptr)), J.indices
    if rule in _FROM_VARIANCES:
        weights = _from_variances(network, rule, table)[l, k]
        values = np.asarray(weights).ravel()
    else:
        values = _RULES[rule]((l, k), n)
    W = sparse.csr_array((values, J.indices, J.indptr), shape=J.shape, copy=True)
    W.eliminate_zeros()
    return W


def check_rule(network: SensorNetwork, rule: str) -> None:
    """Raise what `diffusion_matrix` raises for a rule that does not exist, or that this graph refuses."""
    if rule not in DIFFUSION_RULES:
        nearest = difflib.get_close_matches(rule, DIFFUSION_RULES, n=1)
        hint = f"did you mean {nearest[0]!r}? The rules are" if nearest else "expected one of"
        raise InputError([Complaint("diffusion.rule", f"is {rule!r}; {hint} {', '.join(DIFFUSION_RULES)}")])
    if rule in _NEED_SYMMETRY and network.directed and (network.adjacency != network.adjacency.T).nnz:
        raise UnsupportedError(
            f"the diffusion rule {rule!r} needs links that work both ways, and this network has one-way links;"
            " use 'relative-degree', 'uniform' or weights of your own"
        )


def _from_variances(network: SensorNetwork, rule: str, table: ToleranceTable | None) -> sparse.csr_array:
    """The rules that look at V_l."""
    local = (choose_tolerances(network) if table is None else table).local
    if not local.exists.all():
        k = int(np.argmin(local.exists))
        raise UnsupportedError(
            f"the diffusion rule {rule!r} needs every V_l, and node {network.label(k)} has none ({local.status[k]})"
        )
    columns = columns_of(network.adjacency)
    if rule == "relative-variance":
        precision = 1.0 / np.maximum(local.trace_V, np.finfo(float).tiny)
        w = precision[columns.sender]
        w = w / columns.sums(w)[columns.hearer]
    else:
        singular = np.flatnonzero(smallest_unit_eigenvalue(local.V) <= network.n * np.finfo(float).eps)
        if singular.size:
            raise UnsupportedError(
                f"the diffusion rule {rule!r} needs every V_l^-1, and V of node {network.label(int(singular[0]))} is"
                " singular: a direction of the state is known exactly"
            )
        w = intersect_covariances(columns, local.V)
    return sparse.csr_array(sparse.coo_array((w, (columns.sender, columns.hearer)), shape=network.adjacency.shape))


def _uniform(links: _Links, n: Int[ndarray, " N"]) -> Float[ndarray, " E"]:
    _, k = links
    return 1.0 / n[k]


def _relative_degree(links: _Links, n: Int[ndarray, " N"]) -> Float[ndarray, " E"]:
    l, k = links
    return n[l] / np.bincount(k, weights=n[l], minlength=len(n))[k]


def _metropolis(links: _Links, n: Int[ndarray, " N"]) -> Float[ndarray, " E"]:
    l, k = links
    return _keep_the_rest(links, 1.0 / np.maximum(n[l], n[k]), len(n))


def _laplacian(links: _Links, n: Int[ndarray, " N"]) -> Float[ndarray, " E"]:
    return _keep_the_rest(links, np.full(len(links[0]), 1.0 / n.max()), len(n))


def _none(links: _Links, n: Int[ndarray, " N"]) -> Float[ndarray, " E"]:
    l, k = links
    return (l == k).astype(float)


def _keep_the_rest(links: _Links, weights: Float[ndarray, " E"], N: int) -> Float[ndarray, " E"]:
    """The weights of the others as given, and w_kk what they leave."""
    l, k = links
    others = np.where(l == k, 0.0, weights)
    return np.where(l == k, 1.0 - np.bincount(k, weights=others, minlength=N)[k], others)


_RULES: dict[str, Callable[[_Links, Int[ndarray, " N"]], Float[ndarray, " E"]]] = {
    "uniform": _uniform,
    "relative-degree": _relative_degree,
    "metropolis": _metropolis,
    "laplacian": _laplacian,
    "none": _none,
}
_NEED_SYMMETRY = ("metropolis", "laplacian")
_FROM_VARIANCES = ("relative-variance", "covariance-intersection")
