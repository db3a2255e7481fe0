"""Doubles as hexadecimal text, exactly; matrices as one line of it (docs/certificate.md)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def number_text(x: float) -> str:
    """One double as `float.hex` writes it, without the zeros at its end. Raises ValueError where it is not finite."""
    if not np.isfinite(x):
        raise ValueError(f"{x} is no finite number")
    mantissa, _, exponent = float(x).hex().partition("p")
    return f"{mantissa.rstrip('0').rstrip('.')}p{exponent}" if "." in mantissa else f"{mantissa}p{exponent}"


def matrix_text(X: Float[ndarray, "*shape"]) -> str:
    """All entries, row by row."""
    return " ".join(map(number_text, np.asarray(X, dtype=float).ravel().tolist()))


def symmetric_text(X: Float[ndarray, "n n"]) -> str:
    """The upper triangle, row by row. Assumes X symmetric."""
    return matrix_text(X[np.triu_indices(len(X))])


def symmetric_matrix(text: str) -> Float[ndarray, "n n"]:
    """The symmetric matrix of such a text. Raises ValueError where it is none."""
    entries = vector(text)
    n = int((np.sqrt(8 * len(entries) + 1) - 1) / 2)
    if n * (n + 1) // 2 != len(entries):
        raise ValueError(f"{len(entries)} numbers are no upper triangle")
    X = np.zeros((n, n))
    X[np.triu_indices(n)] = entries
    return X + np.triu(X, 1).T


def vector(text: str) -> Float[ndarray, " m"]:
    """The numbers of a text."""
    return np.array([float.fromhex(word) for word in text.split(" ")] if text else [], dtype=float)


def require_exact(text: str) -> None:
    """Raise ValueError unless the text is of finite doubles as `float.hex` writes them: others would be rounded."""
    entries = vector(text)
    if text not in (" ".join(map(float.hex, entries.tolist())), matrix_text(entries)):
        raise ValueError(f"{text[:60]!r} is not written as float.hex writes doubles")


def shortened(X: Float[ndarray, "*K n n"], bits: int) -> Float[ndarray, "*K n n"]:
    """X with entries rounded to multiples of 2^-bits of the size that the diagonal gives them: short numerals.

    Entry (i, j) keeps `bits` bits below sqrt(X_ii X_jj), so that states in small units keep theirs.
    """
    exponent = np.frexp(np.sqrt(np.maximum(np.diagonal(X, axis1=-2, axis2=-1), 1e-300)))[1]
    unit = np.ldexp(1.0, exponent[..., :, None] + exponent[..., None, :] - bits)
    return np.round(X / unit) * unit
