"""Fusion weights in exact rational arithmetic: what a lower bound has to be below, to the last digit."""

from __future__ import annotations

from fractions import Fraction

import flint
import numpy as np
from numpy import ndarray
from numpy.typing import ArrayLike

Rational = flint.fmpq_mat


def rational(x: float) -> flint.fmpq:
    """The number that the double is."""
    return flint.fmpq(*Fraction(float(x)).as_integer_ratio())


def combined(information: ndarray, weights: ndarray) -> Rational:
    """Omega(delta) for the weights divided by their exact sum."""
    shares = [rational(w) for w in weights]
    total = sum(shares, flint.fmpq(0))
    n = information.shape[-1]
    entries = [
        sum((s * rational(Omega[k, l]) for s, Omega in zip(shares, information, strict=True)), flint.fmpq(0)) / total
        for k in range(n)
        for l in range(n)
    ]
    return flint.fmpq_mat(n, n, entries)


def exact_trace(information: ndarray, weights: ndarray) -> Fraction:
    """tr Omega(delta)^-1."""
    P = combined(information, weights).inv()
    total = sum((P[k, k] for k in range(P.nrows())), flint.fmpq(0))
    return Fraction(int(total.p), int(total.q))


def exactly_allowed(information: ndarray, weights: ndarray, reference: ndarray) -> bool:
    """Whether Omega(delta) - Omega(a) >= 0: all coefficients of its characteristic polynomial at -x have one sign."""
    slack = combined(information, weights) - combined(information, reference)
    return all((c if k % 2 == 0 else -c) >= 0 for k, c in enumerate(reversed(slack.charpoly().coeffs())))


def is_below(bound: ArrayLike, information: ArrayLike, weights: ArrayLike) -> bool:
    """Whether every bound of a stack is at most the exact trace of the weights beside it."""
    stack = zip(np.asarray(bound), np.asarray(information), np.asarray(weights), strict=True)
    return all(Fraction(float(b)) <= exact_trace(Omega, delta) for b, Omega, delta in stack)


def traces(information: ndarray, weights: ndarray) -> ndarray:
    """The nearest doubles of the exact traces of a stack."""
    return np.array([float(exact_trace(O, w)) for O, w in zip(information, weights, strict=True)])
