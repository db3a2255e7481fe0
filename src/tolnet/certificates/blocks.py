"""Many steps at once: a bracket around the orbit, pushed on by doubling at its two bounds of theta.

T(P, theta) = A (P^-1 - theta I + S)^-1 A' + Q rises with both. Let P_s lie in [L, U] and, with a <= theta(U) and
b >= theta(L), L < T(L, a), T(U, b) < U and U^-1 - b I + S > 0. Since gamma rises with P:

1.  a <= theta_t <= b and L <= P_t <= U for all t >= s; T_a^j(L) rises with j, and T_b^j(U) falls.
2.  T_a^m(L) <= P_t <= T_b^m(U) for all t >= s + m. At m = 2^k it is k steps of doubling and one linear fraction,
    however slow the filter is. Its theta bounds are nearer to each other: the same again.

docs/mathematics.md, section 11.8.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import balls
from tolnet.certificates.balls import Ball, BallMatrix, NotProved
from tolnet.certificates.exact_filter import Equations
from tolnet.certificates.numerals import symmetric_matrix, symmetric_text
from tolnet.certificates.recursion import enclose_kappa, enclose_theta, without_H

MOST_BLOCKS = 64
MOST_DOUBLINGS = 40
"""Of one block: 10^12 steps."""
_KEPT = 2.0**-12
"""Of the way that the ends go in a block, not taken: L < T(L, a) and T(U, b) < U stay strict, also for singular A."""


class Bracket(NamedTuple):
    """[lower, upper], which an orbit does not leave, and by how many doublings each block pushes it on."""

    lower: Float[ndarray, "n n"]
    upper: Float[ndarray, "n n"]
    blocks: tuple[int, ...]

    @classmethod
    def read(cls, proof: dict[str, Any]) -> Bracket:
        """That of a certificate. Raises ValueError where a text is no matrix or `blocks` no list of whole numbers."""
        blocks = proof["blocks"]
        if not (isinstance(blocks, list) and all(type(k) is int for k in blocks)):
            raise ValueError("blocks is no list of whole numbers")
        return cls(symmetric_matrix(proof["lower"]), symmetric_matrix(proof["upper"]), tuple(blocks))

    def text(self) -> dict[str, Any]:
        """The bracket as a certificate holds it."""
        return {
            "lower": symmetric_text(self.lower),
            "upper": symmetric_text(self.upper),
            "blocks": list(self.blocks),
        }

    def complaint(self, n: int) -> str | None:
        """What makes it meaningless."""
        if not (self.lower.shape == self.upper.shape == (n, n)):
            return f"the bracket is no pair of symmetric {n} x {n} matrices"
        if not (np.isfinite(self.lower).all() and np.isfinite(self.upper).all()):
            return "the bracket is not finite"
        if len(self.blocks) > MOST_BLOCKS or not all(0 <= k <= MOST_DOUBLINGS for k in self.blocks):
            return f"more than {MOST_BLOCKS} blocks, or {MOST_DOUBLINGS} doublings in one, are not tried"
        return None


def end_of(
    bracket: Bracket, equations: Equations, c: float, P: BallMatrix
) -> tuple[BallMatrix, BallMatrix] | NotProved:
    """Exact (L, U) between which the orbit from P lies for ever from some step on. Raises ZeroDivisionError.

    Verified: 0 < L < P < U and, before every block, what it needs.
    """
    L, U = balls.matrix(bracket.lower), balls.matrix(bracket.upper)
    if not (balls.is_positive(L) and balls.is_positive(P - L) and balls.is_positive(U - P)):
        return NotProved("the orbit was not shown to lie between the ends of the bracket")
    for number, doublings in enumerate(bracket.blocks, start=1):
        found = _bounds(equations, c, L, U)
        if isinstance(found, NotProved):
            return NotProved(f"block {number} of the bracket: {found.reason}")
        least, most = found
        below, above = _pushed(*least, L, doublings), _pushed(*most, U, doublings)
        L = balls.outward(below - (below - L) * balls.ball(_KEPT), -1)
        U = balls.outward(above + (U - above) * balls.ball(_KEPT), 1)
    return L, U


_Bound = tuple[Equations, Ball]
"""T( . , theta): below or above every step of the recursion in a bracket."""


def _bounds(equations: Equations, c: float, L: BallMatrix, U: BallMatrix) -> tuple[_Bound, _Bound] | NotProved:
    """Such bounds, for which [L, U] was shown to be mapped into itself. Assumes Pi = I."""
    if equations.n == 1:
        found = _bounds_for_one_state(equations, c)
    else:
        least, most = enclose_theta(equations, U, c), enclose_theta(equations, L, c)
        if isinstance(least, NotProved) or isinstance(most, NotProved):
            return NotProved("theta was not enclosed")
        found = (equations, least.lower()), (equations, most.upper())
    if isinstance(found, NotProved):
        return found
    (below, a), (above, b) = found
    # The congruence with U of U^-1 - b I + S > 0 needs no inverse of U.
    if not balls.is_positive(U + balls.congruence(U, above.S - above.metric * b)):
        return NotProved("U^-1 - theta(L) I + S > 0 was not shown")
    if not balls.is_positive(below.following(without_H(below, L, a)) - L):
        return NotProved("L < T(L, theta(U)) was not shown")
    if not balls.is_positive(U - above.following(without_H(above, U, b))):
        return NotProved("T(U, theta(L)) < U was not shown")
    return found


def _bounds_for_one_state(equations: Equations, c: float) -> tuple[_Bound, _Bound] | NotProved:
    """With one state V = kappa P for the root of kappa - 1 - log kappa = c, which A and S take in; theta is 0."""
    kappas = enclose_kappa(equations, c)
    if isinstance(kappas, NotProved):
        return kappas
    inflated = [replace(equations, A=equations.A * kappa.sqrt(), S=equations.S * kappa) for kappa in kappas]
    return (inflated[0], balls.ball(0)), (inflated[1], balls.ball(0))


def _pushed(equations: Equations, theta: Ball, P: BallMatrix, doublings: int) -> BallMatrix:
    """T^m(P) = H + F' P (I + G P)^-1 F for this theta at m = 2^doublings, with F, G and H doubled so many times."""
    one = balls.identity(equations.n)
    F, G, H = equations.A.transpose(), equations.S - equations.metric * theta, equations.Q
    for _ in range(doublings):
        W = (one + G * H).inv()
        FW = F * W
        G = balls.symmetric_part(G + FW * G * F.transpose())
        H = balls.symmetric_part(H + F.transpose() * H * W * F)
        F = FW * F
    return balls.symmetric_part(H + F.transpose() * P * (one + G * P).inv() * F)


def between(L: BallMatrix, U: BallMatrix) -> BallMatrix:
    """Every symmetric P with L <= P <= U: |P - (L + U) / 2|_ij <= sqrt(W_ii W_jj) with W = (U - L) / 2."""
    n, half = L.nrows(), balls.ball(0.5)
    W = [(abs(U[i, i] - L[i, i]).upper() * half).sqrt() for i in range(n)]
    reach = balls.matrix_of(n, n, [balls.ball(0, (W[i] * W[j]).upper()) for i in range(n) for j in range(n)])
    return (L + U) * half + reach
