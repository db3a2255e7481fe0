"""Whether eq. (17) leaves room for any weights but the reference a: mostly not, and then a short proof says so.

    1.  X > 0,   <Omega_j, X> = c where a_j > 0,   <Omega_j, X> <= c elsewhere

gives <Omega(delta) - Omega(a), X> <= 0 for all weights: then Omega(delta) >= Omega(a) is Omega(delta) = Omega(a), and
P = P_0 is all that there is. Such an X is sought where log det Omega(nu) is greatest over sum_j nu_j = 1, nu free in
sign where a_j > 0 and 0 elsewhere: there X = Omega(nu)^-1. In coordinates in which Omega(nu) = I, Newton's step is

    2.  sum_k <Omega_j, Omega_k> d_k + c = tr Omega_j where a_j > 0,   sum_j d_j = 0,   D = sum_j d_j Omega_j

and X = I - D has the equalities of 1 long before the maximum is reached; only D < I has to come true. Where D >= 0
there is room, and no X. The bound (13.6) is tr P_0 itself with V = P_0 and

    3.  Z = t X - P_0 P_0 > 0,   t = 2 tr(X^-1 P_0 P_0)

Source: docs/mathematics.md, section 13.6.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from tolnet.analysis.fusion_frame import Frame, frame
from tolnet.analysis.stacked import cholesky, eigenvalues, inverse, solve, symmetric_part
from tolnet.model.fusion_weights import lower_bound

_ROUNDS = 4
"""Newton steps. The first settles three in four of random problems, the second nearly all others that are settled."""
_HALVINGS = 10
_CLEAR = 1e-6
"""How far X has to be from singular, in parts of Omega(nu)^-1."""
_RIDGE = 1e-14
"""Pairs that are alike leave equation 2 without a single answer; any will do."""


class Room(NamedTuple):
    """What was found out about the room beside the reference weights."""

    bound: Float[ndarray, " B"]
    """Below tr P: tr P_0 up to rounding where P = P_0 is all, less where there is hardly any room; NaN without X."""
    none: Bool[ndarray, " B"]
    """Where the bound says that the reference weights are optimal."""


def prove_no_room(information: Float[ndarray, "B J n n"], reference: Float[ndarray, "B J"], gap: float) -> Room:
    """Seek an X for every problem, until the reference weights are optimal up to a relative `gap`.

    Assumes finite, symmetric matrices and Omega(a) > 0; finds nothing otherwise.
    """
    bound, nu, rest = np.full(len(reference), np.nan), np.array(reference), np.arange(len(reference))
    within = frame(information, nu)
    P_0 = within.P
    wanted = (1 - gap) * np.trace(P_0, axis1=1, axis2=2)
    for number in range(_ROUNDS):
        if number:
            within = frame(information[rest], nu[rest])
        d, D = _step(within, reference[rest] > 0)
        spectrum = eigenvalues(D)
        clear = spectrum[:, -1] < 1 - _CLEAR
        members = rest[clear]
        X = within.T[clear] @ (np.eye(D.shape[-1]) - D[clear]) @ within.T[clear].mT
        proved = _bound(information[members], reference[members], P_0[members], symmetric_part(X))
        bound[members] = np.fmax(bound[members], proved)
        going = ~(bound[rest] >= wanted[rest]) & (spectrum[:, 0] < 0)
        rest = rest[going]
        if not rest.size:
            break
        nu[rest] += _length(spectrum[going])[:, None] * d[going]
    return Room(bound, bound >= wanted)


def _step(within: Frame, free: Bool[ndarray, "B J"]) -> tuple[Float[ndarray, "B J"], Float[ndarray, "B n n"]]:
    """d and D of equation 2."""
    B, J, n, _ = within.Omega.shape
    flat = within.Omega.reshape(B, J, n * n) * free[:, :, None]
    H = flat @ flat.mT
    size = np.trace(H, axis1=1, axis2=2)
    H[:, np.arange(J), np.arange(J)] += np.where(free, _RIDGE * size[:, None], size[:, None])
    right = np.stack([flat[:, :, :: n + 1].sum(axis=2), free.astype(float)], axis=2)
    x, unity = np.moveaxis(solve(H, right), 2, 0)
    d = x - (x.sum(axis=1) / unity.sum(axis=1))[:, None] * unity
    return d, (d[:, None, :] @ flat).reshape(B, n, n)


def _bound(
    information: Float[ndarray, "K J n n"],
    reference: Float[ndarray, "K J"],
    P_0: Float[ndarray, "K n n"],
    X: Float[ndarray, "K n n"],
) -> Float[ndarray, " K"]:
    """The bound (13.6) with the Z of equation 3."""
    root = inverse(cholesky(X)) @ P_0
    t = 2 * np.einsum("kij,kij->k", root, root)
    return lower_bound(information, reference, P_0, t[:, None, None] * X - P_0 @ P_0)


def _length(spectrum: Float[ndarray, "K n"]) -> Float[ndarray, " K"]:
    """The s > 0 with the greatest log det(I + s D), from the eigenvalues of D, of which one is negative."""
    low, high = np.zeros(len(spectrum)), -1 / spectrum[:, 0]
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        rising = (spectrum / (1 + middle[:, None] * spectrum)).sum(axis=1) > 0
        low, high = np.where(rising, middle, low), np.where(rising, high, middle)
    return low
