"""Whether a steady state attracts: Lyapunov matrices of the derivative J of P_t -> P_{t+1}, in balls.

r^2 Y - J' Y J > 0 with Y > 0 proves rho(J) < r. J' X J - X > 0 with v' X v > 0 proves rho(J) > 1: along x+ = J x
from v, x' X x > 0 rises, and an eigenvector of modulus 1 would give 0 > 0. docs/mathematics.md, section 11.6.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from tolnet.certificates import balls
from tolnet.certificates.balls import BallMatrix, NotProved
from tolnet.certificates.exact_filter import ExactFilter, frobenius_weights
from tolnet.certificates.fixed_point import Box, Enclosure, enclose
from tolnet.certificates.numerals import matrix_text, number_text, symmetric_matrix, symmetric_text, vector

_SLACK = 0.01
"""Of the distance from the radius to 1, given away to have a well-conditioned Y."""
_MOST_DOUBLINGS = 60


def derivative_at(found: Enclosure) -> BallMatrix:
    """J at the steady state, in the coordinates P_ii, sqrt(2) P_ij."""
    at = found.equations.at(found.P, found.theta)
    return found.equations.derivative(at, frobenius_weights(found.equations.n)).of_the_recursion()


def lyapunov(J: Float[ndarray, "d d"], rate: float) -> Float[ndarray, "d d"] | None:
    """Y = I + J'J / r^2 + J'^2 J^2 / r^4 + ..., so that r^2 Y - J' Y J = r^2 I > 0, by doubling; None if infinite."""
    X, power = np.eye(len(J)), J / rate
    with np.errstate(all="ignore"):
        for _ in range(_MOST_DOUBLINGS):
            growth = power.T @ X @ power
            X = X + growth
            power = power @ power
            if not np.isfinite(X).all():
                return None
            if np.abs(growth).max() <= 1e-17 * np.abs(X).max():
                return (X + X.T) / 2
    return None


def _units(P: Float[ndarray, "n n"]) -> Float[ndarray, " d"]:
    """Powers of two near sqrt(P_ii P_jj): in these units of the coordinates, those of the states do not matter."""
    root = np.exp2(np.round(np.log2(np.diag(P)) / 2))
    return np.outer(root, root)[np.triu_indices(len(P))]


def prove_attraction(exact: ExactFilter, box: Box) -> dict[str, Any] | NotProved:
    """Keys of a proved `attraction` claim: `c`, `rate`, `proof`; `box` is one of `find_box`."""
    found = enclose(exact, box)
    if isinstance(found, NotProved):
        return found
    with balls.working_precision(found.bits):
        J = balls.midpoints(derivative_at(found))
    radius = spectral_radius(J)
    rate = radius + _SLACK * (1 - radius)
    if not rate < 1:
        return NotProved(f"the spectral radius of the derivative is about {radius:.6g}")
    s = _units(box.P)
    Y = lyapunov(J * s / s[:, None], radius + _SLACK / 2 * (1 - radius))
    if Y is None:
        return NotProved(f"no Lyapunov matrix was found for the rate {rate:.6g}")
    keys = {
        "c": number_text(exact.c),
        "rate": number_text(rate),
        "proof": {"box": box.text(), "Y": symmetric_text(Y / s / s[:, None])},
    }
    reason = verify_attraction(exact, keys)
    return keys if reason is None else NotProved(reason)


def spectral_radius(J: Float[ndarray, "d d"]) -> float:
    """The largest modulus of an eigenvalue, in floating point; infinite where J is not finite."""
    return float(np.abs(np.linalg.eigvals(J)).max()) if np.isfinite(J).all() else np.inf


def verify_attraction(exact: ExactFilter, claim: dict[str, Any]) -> str | None:
    """Why a proved `attraction` claim does not hold as far as can be shown; None where it does."""
    proof, rate = claim["proof"], float.fromhex(claim["rate"])
    if not 0 < rate < 1:
        return f"the rate {rate} does not lie between 0 and 1"
    found = enclose(exact, Box.read(proof["box"]))
    if isinstance(found, NotProved):
        return found.reason
    with balls.working_precision(found.bits):
        J, Y = derivative_at(found), symmetric_matrix(proof["Y"])
        if Y.shape != (J.nrows(), J.nrows()) or not np.isfinite(Y).all():
            return f"Y is no finite symmetric {J.nrows()} x {J.nrows()} matrix"
        if not contracts(J, balls.matrix(Y), rate):
            return "Y > 0 and r^2 Y - J' Y J > 0 were not shown"
    return None


def contracts(J: BallMatrix, Y: BallMatrix, rate: float) -> bool:
    """Whether Y > 0 and rate^2 Y - J' Y J > 0 were shown."""
    return balls.is_positive(Y) and balls.is_positive(Y * balls.ball(rate) ** 2 - balls.congruence(J.transpose(), Y))


def refute_attraction(exact: ExactFilter, box: Box) -> dict[str, Any] | NotProved:
    """Keys of a refuted `attraction` claim: `c`, `witness`; `box` is one of `find_box`."""
    found = enclose(exact, box)
    if isinstance(found, NotProved):
        return found
    with balls.working_precision(found.bits):
        J = balls.midpoints(derivative_at(found))
    if not spectral_radius(J) > 1:
        return NotProved("no eigenvalue of the derivative lies outside the unit circle in floating point")
    s = _units(box.P)
    values, T = np.linalg.eig(J * s / s[:, None])
    try:
        inverse = np.linalg.inv(T)
    except np.linalg.LinAlgError:
        return NotProved("the derivative has no basis of eigenvectors")
    # J' X J - X = I, entry by entry in the eigenbasis of J.
    pairs = values.conj()[:, None] * values - 1
    X = (inverse.conj().T @ (1 / np.where(pairs == 0, 1.0, pairs) * (T.conj().T @ T)) @ inverse).real
    X = (X + X.T) / 2
    z = T[:, np.argmax(np.abs(values))]
    v = max((np.real(z), np.imag(z)), key=lambda v: float(v @ X @ v))
    keys = {
        "c": number_text(exact.c),
        "witness": {"box": box.text(), "X": symmetric_text(X / s / s[:, None]), "v": matrix_text(v * s)},
    }
    reason = verify_refuted_attraction(exact, keys)
    return keys if reason is None else NotProved(reason)


def verify_refuted_attraction(exact: ExactFilter, claim: dict[str, Any]) -> str | None:
    """Why a witness against attraction does not hold as far as can be shown; None where it does."""
    witness = claim["witness"]
    found = enclose(exact, Box.read(witness["box"]))
    if isinstance(found, NotProved):
        return found.reason
    with balls.working_precision(found.bits):
        J, X, v = derivative_at(found), symmetric_matrix(witness["X"]), vector(witness["v"])
        d = J.nrows()
        if X.shape != (d, d) or v.shape != (d,) or not (np.isfinite(X).all() and np.isfinite(v).all()):
            return f"X and v are no finite symmetric {d} x {d} matrix and no vector of {d}"
        X, x = balls.matrix(X), balls.matrix(v[:, None])
        if not balls.is_positive(balls.congruence(J.transpose(), X) - X):
            return "J' X J - X > 0 was not shown"
        if not (x.transpose() * X * x)[0, 0] > 0:
            return "v' X v > 0 was not shown"
    return None
