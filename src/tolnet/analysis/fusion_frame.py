"""Coordinates in which a combination of information matrices is the identity, whatever the units of the states."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from tolnet.analysis.stacked import cholesky, inverse, symmetric_part


class Frame(NamedTuple):
    """The problem in the coordinates x = T y in which Omega of the start is the identity (section 13.6).

    There tr P is tr(M P), M = T' T, which is divided by its trace: the objective starts at 1.
    """

    T: Float[ndarray, "B n n"]
    Omega: Float[ndarray, "B J n n"]
    M: Float[ndarray, "B n n"]
    scale: Float[ndarray, " B"]
    """tr P at the start."""

    @property
    def P(self) -> Float[ndarray, "B n n"]:
        """T T', the inverse of Omega of the start."""
        return self.T @ self.T.mT

    def back(self, Z: Float[ndarray, "K n n"], members: Int[ndarray, " K"]) -> Float[ndarray, "K n n"]:
        """A multiplier of some members' constraint, in the coordinates of the problem."""
        T = self.T[members]
        return symmetric_part(T @ (self.scale[members, None, None] * Z) @ T.mT)


def frame(information: Float[ndarray, "B J n n"], start: Float[ndarray, "B J"]) -> Frame:
    """Change the coordinates; NaN where Omega(start) is not positive definite."""
    T = inverse(cholesky(np.einsum("bj,bjkl->bkl", start, information))).mT
    Omega = symmetric_part(T.mT[:, None] @ information @ T[:, None])
    M = T.mT @ T
    scale = np.trace(M, axis1=1, axis2=2)
    return Frame(T, Omega, M / scale[:, None, None], scale)
