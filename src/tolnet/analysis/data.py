"""The tolerance from recorded states, inputs and outputs (docs/mathematics.md, section 9).

1.  residuals of the nominal model, z_t = [x_{t+1} - A x_t - r_t; y_t - C x_t], nominal covariance
    Sigma = diag(Q, R_1, ..., R_N); everything below is whitened by Sigma^-1/2
2.  regression on the state, z_t = E x_t + e_t, sample covariance Sigma^ of e_t
3.  c = tr(Sigma^ + E <x x'> E') - log det Sigma^ - dim z: twice the divergence in nats of the fitted Gaussian
    transition density from the nominal one, averaged over the recorded states. <x x'> is the second moment and
    not the covariance, since a bias counts
4.  even a nominal record shows a positive c: its mean, over records drawn from the nominal model at the same
    states, is the bias; pairs (x_t, z_t) drawn with replacement give the interval
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.model import Complaint, InputError, SensorNetwork, ShapeError, UnsupportedError
from tolnet.model.estimate import DataMethod, ToleranceEstimate

_LEVEL = 0.95
_LARGEST = 1e140
"""Residuals beyond this many standard deviations overflow when they are squared and summed."""


class Record(NamedTuple):
    """What was recorded: states x_0..x_T, outputs y_0..y_{T-1} stacked over the nodes, and known inputs r_t."""

    x: Float[ndarray, "T1 n"]
    y: Float[ndarray, "T M"]
    u: Float[ndarray, "T n"] | None = None
    """r_t of eq. (1) where it varies; without it the network's constant input."""


def tolerance_from_data(
    network: SensorNetwork,
    record: Record,
    *,
    method: DataMethod = "divergence",
    resamples: int = 400,
    rng: np.random.Generator | None = None,
) -> ToleranceEstimate:
    """Estimate the tolerance c of the whole network from one record, with its bias removed and an interval.

    `divergence` is lines 1-4. `likelihood` is the published choice, the negative log-likelihood of the nominal
    model per step (in nats, so twice that in gamma), which depends on the units of the data and can be negative:
    then it is refused. `rng` defaults to a fixed seed, so that a record gives one answer.
    The interval is a 95 % bootstrap interval and too narrow where the record spans few of the plant's time constants.
    Assumes Q positive definite (else the divergence is infinite) and a record longer than n + M + n steps.
    Raises ShapeError or InputError for a record that does not fit, UnsupportedError for a singular Q or a negative
    likelihood.
    Source: eq. (2) and Section 2 of the paper; docs/mathematics.md, section 9.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    x, z = _whitened_residuals(network, record)
    if method == "likelihood":
        return _likelihood(network, z, resamples, rng)
    if len(z) <= z.shape[1] + x.shape[1]:
        needed = z.shape[1] + x.shape[1] + 1
        raise InputError(
            [
                Complaint(
                    "x", f"holds {len(z)} transitions; at least {needed} are needed to fit {z.shape[1]} residuals"
                )
            ]
        )
    observed = _divergence(x, z)
    nominal = np.array([_divergence(x, rng.standard_normal(z.shape)) for _ in range(resamples)])
    drawn = np.array([_divergence(x[index], z[index]) for index in _resamples(len(z), resamples, rng)])
    bias = float(nominal.mean())
    spread = np.quantile(drawn - drawn.mean(), [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return _estimate(observed, bias, -spread[::-1], len(z), resamples, "divergence")


def _resamples(T: int, count: int, rng: np.random.Generator) -> Iterator[ndarray]:
    """Indices of moving-block bootstrap samples of T instants."""
    length = math.isqrt(T)
    for _ in range(count):
        starts = rng.integers(0, T - length + 1, -(-T // length))
        yield (starts[:, None] + np.arange(length)).ravel()[:T]


def _estimate(
    observed: float, bias: float, spread: ndarray, steps: int, resamples: int, method: DataMethod
) -> ToleranceEstimate:
    centre = observed - bias
    low, high = (max(0.0, centre + float(s)) for s in spread)
    return ToleranceEstimate(max(0.0, centre), (low, high), _LEVEL, observed, bias, steps, resamples, method)


def _whitened_residuals(
    network: SensorNetwork, record: Record
) -> tuple[Float[ndarray, "T n"], Float[ndarray, "T d"]]:
    """x_t and Sigma^-1/2 z_t (line 1)."""
    n, M = network.n, len(network.C)
    x, y = np.asarray(record.x, dtype=float), np.asarray(record.y, dtype=float)
    complaints = []
    if x.ndim != 2 or x.shape[1] != n or len(x) < 2:
        complaints.append(Complaint("x", f"has shape {x.shape}; T + 1 states of {n} numbers were expected"))
    elif y.shape != (len(x) - 1, M):
        complaints.append(Complaint("y", f"has shape {y.shape}; {len(x) - 1} x {M} was expected"))
    u = network.input if record.u is None else np.asarray(record.u, dtype=float)
    u = np.zeros(n) if u is None else u
    if not complaints and u.shape not in ((n,), (len(x) - 1, n)):
        complaints.append(Complaint("u", f"has shape {u.shape}; {len(x) - 1} x {n} was expected"))
    if complaints:
        raise ShapeError(complaints)
    for key, values in (("x", x), ("y", y), ("u", u)):
        if not np.isfinite(values).all():
            raise InputError([Complaint(key, "has a value that is not finite")])
    eigenvalues = np.linalg.eigvalsh(network.Q)
    if eigenvalues[0] <= n * np.finfo(float).eps * eigenvalues[-1]:
        raise UnsupportedError("plant.Q is singular: any deviation in a noiseless direction has infinite divergence")
    with np.errstate(over="ignore", invalid="ignore"):  # refused below
        process = x[1:] - x[:-1] @ network.A.T - u
        whitened = [np.linalg.solve(np.linalg.cholesky(network.Q), process.T).T]
        measured = y - x[:-1] @ network.C.T
        for nodes, _, R in network.sensors.groups():
            p = R.shape[-1]
            columns = network.rows[nodes, None] + np.arange(p)
            each = np.linalg.solve(np.linalg.cholesky(R), measured.T[columns])
            whitened.append(each.reshape(len(nodes) * p, -1).T)
    z = np.concatenate(whitened, axis=1)
    for key, values in (("x", x), ("x", z[:, :n]), ("y", z[:, n:])):
        if not np.abs(values).max(initial=0.0) < _LARGEST:
            raise InputError([Complaint(key, "is so far from the model that its squares overflow")])
    return x[:-1], z


def _divergence(x: Float[ndarray, "T n"], z: Float[ndarray, "T d"]) -> float:
    """Lines 2 and 3 for whitened residuals."""
    T, d = z.shape
    basis, sizes, _ = np.linalg.svd(x, full_matrices=False)  # a record that never leaves a subspace is allowed
    basis = basis[:, sizes > x.shape[1] * np.finfo(float).eps * sizes[0]]
    along = basis.T @ z
    fitted = basis @ along
    covariance = (z - fitted).T @ (z - fitted) / T
    sign, logdet = np.linalg.slogdet(covariance)
    if sign <= 0:
        raise InputError([Complaint("y", "leaves no residual in some direction: the record is not of this model")])
    return float(np.trace(covariance) + (along**2).sum() / T - logdet - d)


def _likelihood(network: SensorNetwork, z: ndarray, resamples: int, rng: np.random.Generator) -> ToleranceEstimate:
    """Twice the negative log-likelihood per step under the nominal density."""
    each = (z**2).sum(axis=1)
    constant = z.shape[1] * np.log(2 * np.pi) + np.linalg.slogdet(network.Q)[1]
    constant += sum(float(np.linalg.slogdet(R)[1].sum()) for _, _, R in network.sensors.groups())
    observed = float(each.mean() + constant)
    if observed < 0:
        raise UnsupportedError(
            f"the negative log-likelihood per step is {observed / 2:.6g}, below zero, and no tolerance:"
            " it depends on the units of the data; use method 'divergence'"
        )
    drawn = np.array([each[index].mean() for index in _resamples(len(each), resamples, rng)])
    spread = np.quantile(drawn - drawn.mean(), [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return _estimate(observed, 0.0, -spread[::-1], len(z), resamples, "likelihood")
