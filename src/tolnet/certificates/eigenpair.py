"""An eigenvalue outside the unit circle, validated in floating point with rounding bounds (docs/certificate.md).

    1.  f(z, l) = [A z - l z;  z_i - zeta_i],  J = [[A - l I, -z], [e_i', 0]],  B near J^-1, |.| the largest row sum
    2.  f(x) - f(x_0) - J (x - x_0) = [-dl dz; 0], at most r^2 in the ball of radius r around x_0
    3.  |B f| + |I - B J| r + |B| r^2 < r: the map x -> x - B f(x) sends the ball into itself, so a zero of f is in it
    4.  |l| - r > 1

A is sparse and B dense, so that networks of some thousand states can be refuted; every bound is raised by more than
the rounding of its own evaluation: fl(x y) = x y (1 + d) + e, |d| <= 2^-53, |e| <= 2^-1075, and e is not 0 where the
product underflows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import sparse

from tolnet.certificates import statements
from tolnet.certificates.deployed import Deployed
from tolnet.certificates.exact_network import unmixed_column
from tolnet.certificates.numerals import matrix_text
from tolnet.certificates.verdicts import Refuted, Undecided

_U = np.finfo(float).eps
_RAISED = 1 + 1e-9
_TINY = 1e-290
"""More than all that a sum of `MOST` products loses where they underflow, 2^-1074 each: rounding bounds that are
relative see nothing of it. What is added to an entry before it meets |B| counts there with |B|, as it must."""
MOST = 7000
"""Dimension up to which B, a dense complex matrix, is computed."""


def refute_by_eigenpair(deployed: Deployed, eigenvalue: complex, mode: ndarray) -> Refuted | Undecided:
    """Decide whether an exact eigenvalue of the network block lies near one found outside the unit circle."""
    block = {"block": "network" if deployed.centre is None else "F"}
    statement = statements.instability("network")
    if unmixed := unmixed_column(deployed.weights, deployed.offsets):
        return Undecided("schur-stability", statement, unmixed, keys=block)
    if len(mode) > MOST:
        reason = f"the network has {len(mode)} states; up to {MOST} an eigenvalue is validated"
        return Undecided("schur-stability", statement, reason, keys=block)
    found = validate(deployed, eigenvalue, _normalised(mode))
    if isinstance(found, str):
        return Undecided("schur-stability", statement, found, keys=block)
    return Refuted("schur-stability", statement, found, keys=block)


def _normalised(mode: ndarray) -> ndarray:
    """Its largest entry 1."""
    return mode / mode[int(np.argmax(np.abs(mode)))]


def validate(deployed: Deployed, eigenvalue: complex, z: ndarray) -> dict[str, Any] | str:
    """The witness of a validated eigenpair, or the reason why there is none. B is computed here and not trusted."""
    if not (np.isfinite(z).all() and np.isfinite(eigenvalue) and np.abs(z).max() >= 1e-100):
        return "the stated eigenvector or eigenvalue is not finite, or nearly zero"
    A, doubt = sparse_block(deployed)
    pivot, d = int(np.argmax(np.abs(z))), len(z)
    B = _approximate_inverse(A, eigenvalue, z, pivot)
    if B is None:
        return "the eigenvalue is not simple, as far as floating point can tell"
    most = int(np.diff(A.indptr).max(initial=0)) + 4
    size = abs(A)
    # 1. of the derivation, with the rounding of every product; the last entry of f is zero
    f = np.abs(A @ z - eigenvalue * z) + 4 * most * _U * (size @ np.abs(z) + abs(eigenvalue) * np.abs(z))
    f = f + doubt @ np.abs(z) + _TINY
    J = _bordered(A, eigenvalue, z, pivot)
    rows = np.abs(B).sum(axis=1)
    R = np.eye(d + 1) - (J.T @ B.T).T
    ones = np.ones(d + 1)
    doubts = np.append(doubt @ ones[:d], 0.0) + _TINY
    near = np.abs(R).sum(axis=1) + np.abs(B) @ (4 * (d + 8) * _U * (abs(J) @ ones) + doubts) + _TINY
    newton, contraction, norm = (_RAISED * float(bound.max()) for bound in (np.abs(B[:, :d]) @ f, near, rows))
    radius = float(f"{4 * newton + _TINY:.2e}")
    inside = newton + contraction * radius + norm * radius * radius
    if not _RAISED * inside < radius:
        return f"the eigenvalue {eigenvalue:.6g} that floating point found is not validated"
    if not abs(eigenvalue) - _RAISED * radius > 1 + 8 * _U:
        return f"the eigenvalue {eigenvalue:.9g} is not validated to lie outside the unit circle"
    return {
        "of": "network",
        "method": "eigenpair",
        "eigenvalue": matrix_text(np.array([eigenvalue.real, eigenvalue.imag])),
        "vector": matrix_text(np.concatenate([np.real(z), np.imag(z)])),
    }


def sparse_block(deployed: Deployed) -> tuple[sparse.csr_array, sparse.csr_array]:
    """The network block, and a bound on how far each entry is from the exact one."""
    M, size = deployed.loops
    outputs = int(np.diff(deployed.columns[deployed.offsets]).max(initial=0))
    doubts = 2 * (outputs + 4) * _U * size + _TINY
    doubt = _blocks(deployed, np.abs(deployed.weights), doubts)
    doubt.data += _TINY
    return _blocks(deployed, deployed.weights, M), doubt


def _blocks(deployed: Deployed, weights: Float[ndarray, " L"], M: Float[ndarray, "N n n"]) -> sparse.csr_array:
    N, n = deployed.N, deployed.n
    values = weights[:, None, None] * M[deployed.neighbours]
    rows = np.broadcast_to(deployed.hearer[:, None, None] * n + np.arange(n)[:, None], values.shape)
    columns = np.broadcast_to(deployed.neighbours[:, None, None] * n + np.arange(n), values.shape)
    entries = sparse.coo_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(N * n, N * n))
    return sparse.csr_array(entries)


def _bordered(A: sparse.csr_array, eigenvalue: complex, z: ndarray, pivot: int) -> sparse.csr_array:
    d = len(z)
    corner = sparse.coo_array((np.ones(1), ([0], [pivot])), shape=(1, d))
    shifted = A - eigenvalue * sparse.eye_array(d)
    return sparse.csr_array(sparse.block_array([[shifted, -sparse.csr_array(z[:, None])], [corner, None]]))


def _approximate_inverse(A: sparse.csr_array, eigenvalue: complex, z: ndarray, pivot: int) -> ndarray | None:
    try:
        B = np.linalg.inv(_bordered(A, eigenvalue, z, pivot).toarray())
    except np.linalg.LinAlgError:
        return None
    return B if np.isfinite(B).all() else None
