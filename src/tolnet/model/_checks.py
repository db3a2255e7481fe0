"""Turning what a user wrote into arrays, with a complaint for each thing that is wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray

from tolnet.model.errors import Complaint, InputError, ShapeError


class Complaints:
    """Collects complaints, so that a user sees all of them at once."""

    def __init__(self) -> None:
        self.found: list[Complaint] = []
        self.only_shapes = True

    def add(self, key: str, message: str, *, shape: bool = False) -> None:
        """Note that `key` is wrong; `shape` says that only shapes are to blame."""
        self.found.append(Complaint(key, message))
        self.only_shapes &= shape

    def raise_if_any(self, source: str | None = None) -> None:
        """Raise one InputError (ShapeError where only shapes are wrong) that carries everything found."""
        if self.found:
            raise (ShapeError if self.only_shapes else InputError)(self.found, source=source)


def real_array(value: Any, key: str, complaints: Complaints) -> ndarray | None:
    """A private, contiguous copy of `value` in doubles; None, with a complaint, if it is no array of numbers."""
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "biuf" and given.size:
            raise TypeError
        array = np.array(given, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        complaints.add(key, "is not a rectangular array of real numbers")
        return None
    if not np.isfinite(array).all():
        where = "".join(f"[{i}]" for i in np.argwhere(~np.isfinite(array))[0])
        complaints.add(key, f"has a value that is not finite at {where or 'its only entry'}")
        return None
    return array


def shaped(value: Any, shape: tuple[int | None, ...], key: str, meant: str, complaints: Complaints) -> ndarray | None:
    """`real_array` that also wants `shape` (None: any length), which `meant` says in words."""
    array = real_array(value, key, complaints)
    if array is None:
        return None
    fits = array.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, array.shape, strict=True))
    if not fits:
        complaints.add(key, f"is {by(array.shape)}; {meant} was expected", shape=True)
        return None
    return array


def by(shape: tuple[int, ...]) -> str:
    """A shape as people say it: `4 x 3`, `a vector of 4`, `a number`."""
    if len(shape) == 0:
        return "a number"
    return f"a vector of {shape[0]}" if len(shape) == 1 else " x ".join(map(str, shape))


def symmetric(matrix: ndarray, key: str, complaints: Complaints) -> bool:
    """Whether a matrix equals its transpose to the last bit; complains where it does not."""
    skew = np.abs(matrix - matrix.T)
    if not skew.any():
        return True
    i, j = (int(x) for x in np.unravel_index(skew.argmax(), skew.shape))
    i, j = min(i, j), max(i, j)
    complaints.add(
        key,
        f"is not symmetric: [{i}][{j}] is {matrix[i, j]!r}, [{j}][{i}] is {matrix[j, i]!r}"
        " (if that is rounding, write (M + M')/2)".replace("np.float64", ""),
    )
    return False


def positive(matrix: ndarray, key: str, complaints: Complaints, *, definite: bool) -> None:
    """Complain unless a symmetric matrix is positive (semi)definite, judged after scaling its diagonal to one."""
    diagonal = np.diag(matrix)
    word = "definite" if definite else "semidefinite"
    if (diagonal < 0).any() or (definite and (diagonal == 0).any()):
        i = int(np.flatnonzero((diagonal < 0) | (definite & (diagonal == 0)))[0])
        complaints.add(key, f"is not positive {word}: [{i}][{i}] is {float(diagonal[i])!r}")
        return
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    smallest = float(np.linalg.eigvalsh(matrix / scale / scale[:, None])[0]) if matrix.size else 1.0
    rounding = len(matrix) * np.finfo(float).eps
    if smallest <= rounding if definite else smallest < -10 * rounding:
        complaints.add(
            key,
            f"is not positive {word}: scaled to a unit diagonal, its smallest eigenvalue is {smallest:.3g}",
        )


def frozen(array: ndarray) -> ndarray:
    """The same array, read-only from now on."""
    array.setflags(write=False)
    return array
