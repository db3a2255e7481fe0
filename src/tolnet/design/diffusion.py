"""Diffusion weights by rule: how node k mixes what its neighbours send, from the degrees alone (eq. (11))."""

from __future__ import annotations

import difflib
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.model import Complaint, InputError, SensorNetwork, UnsupportedError

_Links = tuple[Int[ndarray, " E"], Int[ndarray, " E"]]
"""The indices l and k of every pair in which node k hears node l, self-loops included, sorted by l."""


def diffusion_matrix(network: SensorNetwork, rule: str | None = None) -> sparse.csr_array:
    """W = [w_lk], where w_lk weighs neighbour l at node k: x_k = sum_l w_lk psi_l, eqs. (11), (13), (45).

    Every rule gives w_lk >= 0, w_lk = 0 where node k does not hear node l, and sum_l w_lk = 1, from the counts
    n_k = |N_k| of nodes that node k hears, itself included:

        uniform           w_lk = 1 / n_k
        relative-degree   w_lk = n_l / sum_{m in N_k} n_m                      a neighbour that hears more counts more
        metropolis        w_lk = 1 / max(n_l, n_k), l != k; w_kk = 1 - the rest     symmetric, so W averages
        laplacian         w_lk = 1 / max_m n_m, l != k; w_kk = 1 - the rest         symmetric, W = I - L / max_m n_m
        none              w_kk = 1                                             every node keeps its own estimate

    `rule` None takes the network's own: its rule, or its W as it is. In a directed graph n_k counts what node k
    hears, and the first two rules and `none` read as above; `metropolis` and `laplacian` average only where every
    link works both ways, so they are refused elsewhere.

    Shape (N, N), sparse; no unit. Raises InputError for an unknown rule, UnsupportedError for `metropolis` and
    `laplacian` on a graph with one-way links.
    Source: eq. (11) and Section 5 (relative degree); F. S. Cattivelli, A. H. Sayed, IEEE Trans. Automatic Control
    55(9):2069-2084, 2010, Table I (the others).
    """
    if rule is None:
        if not isinstance(network.diffusion, str):
            return network.diffusion
        rule = network.diffusion
    if rule not in _RULES:
        nearest = difflib.get_close_matches(rule, _RULES, n=1)
        hint = f"did you mean {nearest[0]!r}? The rules are" if nearest else "expected one of"
        raise InputError([Complaint("diffusion.rule", f"is {rule!r}; {hint} {', '.join(_RULES)}")])
    J, n = network.adjacency, network.degree
    if rule in _NEED_SYMMETRY and network.directed and (J != J.T).nnz:
        raise UnsupportedError(
            f"the diffusion rule {rule!r} needs links that work both ways, and this network has one-way links;"
            " use 'relative-degree', 'uniform' or weights of your own"
        )
    l, k = np.repeat(np.arange(network.N), np.diff(J.indptr)), J.indices
    W = sparse.csr_array((_RULES[rule]((l, k), n), J.indices, J.indptr), shape=J.shape, copy=True)
    W.eliminate_zeros()
    return W


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
