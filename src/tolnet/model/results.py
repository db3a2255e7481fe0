"""The results that travel between rooms. Frozen; each can recompute how well it satisfies its equations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from tolnet.model.ambiguity import Convention, gamma_per
from tolnet.model.network import SensorNetwork
from tolnet.model.status import Status


class _ReadOnly:
    """Makes the arrays of a frozen dataclass read-only once it is built."""

    def __post_init__(self) -> None:
        for item in fields(self):  # pyright: ignore[reportArgumentType]
            value = getattr(self, item.name)
            if isinstance(value, ndarray) and value.flags.writeable:
                value = value.view()
                value.setflags(write=False)
                object.__setattr__(self, item.name, value)


@dataclass(frozen=True, eq=False, repr=False)
class SteadyState(_ReadOnly):
    """Fixed points of the robust covariance recursion, one filter or a stack of them (leading axes).

        P = A (V^-1 + S)^-1 A' + Q,   gamma(P, theta) = c,   V = (P^-1 - theta I)^-1,        eqs. (4), (8)

    Where `status` is not `ok` or `oscillates` there is no answer: the numbers are NaN.
    Shapes: (*stack, n, n) for matrices, (*stack,) for numbers; the central filter has an empty stack.
    `tolerance` is on the gamma scale. Units: those of the state squared for P and V, the inverse for theta.
    """

    A: Float[ndarray, "n n"]
    Q: Float[ndarray, "n n"]
    S: Float[ndarray, "*K n n"]
    tolerance: Float[ndarray, "*K"]
    tau: float
    P: Float[ndarray, "*K n n"]
    V: Float[ndarray, "*K n n"]
    theta: Float[ndarray, "*K"]
    spectral_radius: Float[ndarray, "*K"]
    """Of the local closed loop M = A (V^-1 + S)^-1 V^-1."""
    attraction: Float[ndarray, "*K"]
    """Spectral radius of the derivative of V_t -> V_{t+1} at the fixed point; at least 1 means `oscillates`."""
    riccati_residual: Float[ndarray, "*K"]
    """The largest |P - A (V^-1 + S)^-1 A' - Q|_ij / sqrt(P_ii P_jj): in the units of each state."""
    tolerance_residual: Float[ndarray, "*K"]
    """|gamma(P, theta) - c| / c (0 at c = 0), gamma recomputed from V and P as a divergence."""
    error: Float[ndarray, "*K"]
    """Estimated relative error of all of these: of P and V in the units of each state, of the gain in those of its noise."""
    iterations: Int[ndarray, "*K"]
    """Doubling solves plus Newton steps."""
    filtered: Float[ndarray, "*K n n"]
    """Z = (V^-1 + S)^-1, the covariance once the measurements are in; a singular V is allowed."""
    gains: Mapping[int, ndarray]
    """G_k = A Z C_loc' R_loc^-1, columns by neighbour, of filters k that were solved in extended precision: there the
    product of Z and C' R^-1 may cancel. A filter without a stack is number 0."""
    status: ndarray
    """One of `Status` as text, (*stack,)."""
    reason: ndarray
    """What ended the search where there is no answer, as text, (*stack,); empty elsewhere and where `status` says it."""

    @cached_property
    def settles(self) -> Bool[ndarray, "*K"]:
        """Where the answer is `ok`."""
        return np.asarray(self.status == Status.OK.value)

    @cached_property
    def exists(self) -> Bool[ndarray, "*K"]:
        """Where there are numbers: a steady state was found, attracting or not."""
        return np.asarray(np.isfinite(self.theta))

    @property
    def trace_P(self) -> Float[ndarray, "*K"]:
        """Trace of P: the nominal prediction error variance."""
        return np.asarray(np.trace(self.P, axis1=-2, axis2=-1))

    @property
    def trace_V(self) -> Float[ndarray, "*K"]:
        """Trace of V: the prediction error variance under the least favourable model of one step."""
        return np.asarray(np.trace(self.V, axis1=-2, axis2=-1))

    def gain(self, C: Float[ndarray, "p n"], R: Float[ndarray, "p p"], k: int | None = None) -> Float[ndarray, "n p"]:
        """G = A (V^-1 + S)^-1 C' R^-1 of filter k for sensors C, R stacked, eqs. (7), (44); k = None for no stack."""
        Z = self.filtered if k is None else self.filtered[k]
        return self.A @ Z @ np.linalg.solve(R, C).T

    def __getitem__(self, k: int | slice | ndarray) -> SteadyState:
        """Part of a stack, as a SteadyState of its own."""
        shared = {"A", "Q", "tau"}
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "gains"}
        part: dict[str, Any] = {name: v if name in shared else np.asarray(v[k]) for name, v in values.items()}
        chosen = np.atleast_1d(np.arange(len(self))[k]).tolist() if self.gains else []
        gains = {new: self.gains[old] for new, old in enumerate(chosen) if old in self.gains}
        return SteadyState(**part, gains=gains)

    def __len__(self) -> int:
        return len(self.theta)

    def __iter__(self) -> Iterator[SteadyState]:
        return (self[k] for k in range(len(self)))

    def __repr__(self) -> str:
        stack = self.theta.shape
        if stack:
            return f"<SteadyState of {stack} filters, {int(self.settles.sum())} ok>"
        return f"<SteadyState {self.status}: theta = {float(self.theta):.6g}, tr V = {float(self.trace_V):.6g}>"


@dataclass(frozen=True, eq=False, repr=False)
class ToleranceTable(_ReadOnly):
    """The table that is deployed: one tolerance c_k a node, with the filter that it gives (Algorithm 3, eq. (42)).

    Tolerances are in `convention`; everything inside `central` and `local` is on the gamma scale.
    """

    network: SensorNetwork
    convention: Convention
    central: SteadyState
    """The centralised filter at the network's tolerance: no stack."""
    local: SteadyState
    """The node's filters at their c_k: a stack of N."""

    @property
    def tolerance(self) -> float:
        """The tolerance c of the whole network, in `convention`."""
        return float(self.central.tolerance) / gamma_per(self.convention)

    @property
    def tau(self) -> float:
        """Member of the tau-divergence family; 0 is Kullback-Leibler."""
        return self.central.tau

    @cached_property
    def tolerances(self) -> Float[ndarray, " N"]:
        """c_k of every node, in `convention`; NaN where the centre has no steady state to derive it from."""
        return self.local.tolerance / gamma_per(self.convention)

    @property
    def ok(self) -> bool:
        """Whether the centre and every node have an answer without reservation."""
        return bool(self.central.settles) and bool(self.local.settles.all())

    def gain(self, k: int) -> tuple[Int[ndarray, " d"], Float[ndarray, "n p"]]:
        """Neighbours of node k and G_k = A (V_k^-1 + S_k)^-1 C_loc' R_loc^-1, columns by neighbour in that order."""
        neighbours = self.network.neighbours(k)
        if k % self.network.N in self.local.gains:
            return neighbours, self.local.gains[k % self.network.N]
        AZ = self.network.A @ self.local.filtered[k]
        columns = [AZ @ np.linalg.solve(R_l, C_l).T for C_l, R_l in map(self.network.sensor, neighbours.tolist())]
        return neighbours, np.concatenate(columns, axis=1)

    def __repr__(self) -> str:
        good = int(self.local.settles.sum())
        return f"<ToleranceTable c = {self.tolerance:g} ({self.convention}): {good} of {len(self.local)} nodes ok>"


@dataclass(frozen=True, eq=False)
class ToleranceLimits(_ReadOnly):
    """How large the tolerance of each filter may be; gamma scale, inf where nothing was found up to `largest`.

    Shapes (*stack,); the central filter has an empty stack.
    """

    fold: Float[ndarray, "*K"]
    """Where theta stops rising with c; the least favourable model of a centre exists only below (section 7)."""
    attracts: Float[ndarray, "*K"]
    """The smallest c at which the steady state stops attracting: below it, a deployed filter settles."""
    exists: Float[ndarray, "*K"]
    """The largest c with a steady state on the path that starts at the Kalman filter."""
    published: Float[ndarray, "*K"]
    """The sufficient bound of the literature (block contraction over `window` steps)."""
    window: int
    largest: float
