"""Turning what a user wrote into arrays, with a complaint for each thing that is wrong."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from tolnet.model.errors import MOST_COMPLAINTS, Complaint, InputError, Remainder, ShapeError

MOST_OF_A_KIND = MOST_COMPLAINTS
"""How many complaints of one kind are written out before the rest are only counted."""
MOST_KEPT = 1000
"""How many complaints are kept; they are sorted, and some are dropped, before the first of them are told."""
LONGEST_WORD = 60
"""How many characters of a text a message quotes, and how many count when the nearest known word is sought."""

_UNWRITABLE = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


class Complaints:
    """Collects complaints, so that a user sees all of them at once."""

    def __init__(self) -> None:
        self.found: list[Complaint] = []
        self.only_shapes = True
        self.untold = 0

    def add(self, key: str, message: str, *, shape: bool = False) -> None:
        """Note that `key` is wrong; `shape` says that only shapes are to blame."""
        self.keep(Complaint(key, message))
        self.only_shapes &= shape

    def add_each(self, pairs: Iterable[tuple[str, str]], count: int) -> None:
        """Note `count` complaints of one kind, of which only the first `MOST_OF_A_KIND` are written out."""
        for i, (key, message) in enumerate(pairs):
            if i == MOST_OF_A_KIND:
                self.more(count - i)
                break
            self.add(key, message)

    def more(self, count: int) -> None:
        """Note `count` complaints that are not written out."""
        self.untold += count

    def extend(self, error: InputError) -> None:
        """Note everything that an error carries."""
        for each in error.kept:
            self.keep(each)
        self.only_shapes &= isinstance(error, ShapeError)

    def keep(self, complaint: Complaint) -> None:
        """Note a complaint, or a number of them."""
        if isinstance(complaint, Remainder):
            self.more(complaint.count)
        elif len(self.found) < MOST_KEPT:
            self.found.append(complaint)
        else:
            self.more(1)

    def error(self, source: str | None = None) -> InputError:
        """One InputError (ShapeError where only shapes are wrong) that carries everything found."""
        rest = [Remainder("", "", self.untold)] if self.untold else []
        return (ShapeError if self.only_shapes else InputError)([*self.found, *rest], source=source)

    def raise_if_any(self) -> None:
        """Raise that error, if anything was found."""
        if self.found:
            raise self.error()


def real_array(value: Any, key: str, complaints: Complaints) -> ndarray | None:
    """A private, contiguous copy of `value` in doubles; None, with a complaint, if it is no array of numbers."""
    reason = no_number_in(value)
    try:
        if reason:
            raise TypeError
        given = np.asarray(value)
        if given.dtype.kind not in "iuf":
            reason = f"its type is {_TYPES.get(given.dtype.kind, given.dtype)}"
            raise TypeError
        with np.errstate(over="ignore"):  # an overflow is found below, as an infinity
            array = np.array(given, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        complaints.add(key, "is not a rectangular array of real numbers" + (f": {reason}" if reason else ""))
        return None
    if not np.isfinite(array).all():
        first = np.argwhere(~np.isfinite(array))[0]
        where = "".join(f"[{i}]" for i in first) or "its only entry"
        complaints.add(key, f"has {float(array[tuple(first)])} at {where}; finite numbers were expected")
        return None
    return array


_TYPES = {"b": "bool (true and false)", "c": "complex", "U": "text", "S": "bytes"}
"""NumPy's kinds of what is no real number, in words."""


_NO_NUMBERS = (bool, np.bool_, str, bytes, dict, type(None))
_LARGEST_EXPONENT = np.finfo(float).maxexp
"""An integer of more bits is no double."""


def no_number_in(value: Any) -> str:
    """What in nested lists is no number, for a message; empty where NumPy may look for itself.

    Asked before NumPy is, which would make room for the longest text as often as there are entries.
    """
    if not isinstance(value, list | tuple):
        return ""
    for item in value:
        if isinstance(item, list | tuple):
            if found := no_number_in(item):
                return found
        elif isinstance(item, _NO_NUMBERS) or (isinstance(item, int) and item.bit_length() > _LARGEST_EXPONENT):
            return f"it holds {shown(item)}"
        elif isinstance(item, ndarray) and item.dtype.kind not in "iuf":
            return f"it holds an array whose type is {_TYPES.get(item.dtype.kind, item.dtype)}"
    return ""


def numbers(value: Any) -> ndarray:
    """NumPy's array of a value; an empty one of objects where the value is no rectangular array of numbers."""
    try:
        found = np.empty(0, dtype=object) if no_number_in(value) else np.asarray(value)
    except ValueError:
        return np.empty(0, dtype=object)
    return found


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
    different = np.argwhere(matrix != matrix.T)
    if not len(different):
        return True
    i, j = (int(x) for x in different[0])
    complaints.add(
        key,
        f"is not symmetric: [{i}][{j}] is {float(matrix[i, j])!r}, [{j}][{i}] is {float(matrix[j, i])!r}"
        " (if that is rounding, write (M + M')/2)",
    )
    return False


def positive(matrix: ndarray, key: str, complaints: Complaints, *, definite: bool) -> None:
    """Complain unless a symmetric matrix is positive (semi)definite, judged after scaling its diagonal to one."""
    word = "definite" if definite else "semidefinite"
    diagonal = np.diag(matrix)
    # A zero on the diagonal of a semidefinite matrix has zeros beside it.
    low = np.flatnonzero((diagonal <= 0) if definite else (diagonal < 0) | ((diagonal == 0) & matrix.any(axis=1)))
    if low.size:
        i = int(low[0])
        complaints.add(key, f"is not positive {word}: [{i}][{i}] is {float(diagonal[i])!r}")
        return
    smallest = float(smallest_scaled_eigenvalue(matrix[None])[0])
    margin = cholesky_margin(len(matrix))
    if smallest <= margin if definite else smallest < -margin:
        complaints.add(
            key,
            f"is not positive {word}: scaled to a unit diagonal, its smallest eigenvalue is {smallest:.3g}",
        )


def covariance(value: Any, n: int | None, key: str, complaints: Complaints, *, definite: bool) -> ndarray | None:
    """A symmetric positive (semi)definite n x n matrix."""
    many = "n" if n is None else n
    matrix = shaped(value, (n, n), key, f"{many} x {many}", complaints)
    if matrix is None or matrix.shape[0] != matrix.shape[1]:
        return None
    if symmetric(matrix, key, complaints):
        positive(matrix, key, complaints, definite=definite)
    return matrix


def cholesky_margin(p: int) -> float:
    """How far from zero that eigenvalue must be for a Cholesky factorisation in doubles to succeed.

    Source: N. J. Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., Theorem 10.7, twice over since
    the eigenvalue is itself rounded.
    """
    return p * (p + 1) * float(np.finfo(float).eps)


def smallest_scaled_eigenvalue(stack: ndarray) -> ndarray:
    """The smallest eigenvalue of each symmetric matrix scaled to a unit diagonal; -inf where that overflows."""
    diagonal = np.diagonal(stack, axis1=1, axis2=2)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    with np.errstate(over="ignore"):
        unit = stack / scale[:, :, None] / scale[:, None, :]
    # An entry far above one already refutes definiteness, and eigvalsh could not take an infinite one.
    tame = (np.abs(unit) < 1e100).all(axis=(1, 2))
    smallest = np.full(len(stack), -np.inf)
    smallest[tame] = np.linalg.eigvalsh(unit[tame])[:, 0]
    return smallest


def number(value: Any, key: str, meant: str, complaints: Complaints) -> float | None:
    """`value` as a double; None, with a complaint that says what was `meant`, if it is no finite real number."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        complaints.add(key, f"is {shown(value)}; {meant} was expected")
        return None
    try:
        result = float(value)
    except OverflowError:  # an integer beyond the doubles
        result = math.inf
    if not math.isfinite(result):
        complaints.add(key, f"is {shown(value)}; {meant} was expected")
        return None
    return result


def labels(value: Any, count: int | None, key: str, meant: str, complaints: Complaints) -> tuple[str, ...] | None:
    """`count` texts without control characters, as a tuple; None, with a complaint, if they are not that."""
    if value is None:
        return None
    given = value.tolist() if isinstance(value, ndarray) else value
    if not isinstance(given, Sequence) or isinstance(given, str) or not all(isinstance(x, str) for x in given):
        complaints.add(key, "is not a list of texts")
        return None
    if count is not None and len(given) != count:
        complaints.add(key, f"has {len(given)} entries; {meant}", shape=True)
        return None
    if _UNWRITABLE.search("".join(given)):
        bad = next(i for i, x in enumerate(given) if _UNWRITABLE.search(x))
        complaints.add(f"{key}[{bad}]", f"is {shown(given[bad])}; text without control characters was expected")
        return None
    return tuple(given)


def distinct(names: tuple[str, ...] | None, key: str, complaints: Complaints) -> None:
    """Complain about each name that an earlier one is too: what is called alike cannot be told apart."""
    if names is None or len(set(names)) == len(names):
        return
    first: dict[str, int] = {}
    again = [(i, name) for i, name in enumerate(names) if first.setdefault(name, i) != i]
    each = (
        (f"{key}[{i}]", f"is {shown(name)}, which {key.rpartition('.')[2]}[{first[name]}] is already")
        for i, name in again
    )
    complaints.add_each(each, len(again))


def text(value: Any, key: str, complaints: Complaints, *, lines: bool = False) -> None:
    """Complain unless `value` is text that can be written to a file: no control characters, save `lines`' own."""
    plain = isinstance(value, str) and not _UNWRITABLE.search(re.sub("[\n\t]", "", value) if lines else value)
    if not plain:
        complaints.add(key, f"is {shown(value)}; text without control characters was expected")


def shown(value: Any) -> str:
    """A value as a message quotes it: short, and harmless whatever it is."""
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, int) and value.bit_length() > 70:
        return f"an integer of about {int(value.bit_length() * math.log10(2)) + 1} digits"
    if isinstance(value, int | float | np.integer | np.floating):
        return str(value)
    if isinstance(value, str):
        return repr(value) if len(value) <= LONGEST_WORD else f"{value[: LONGEST_WORD - 3]!r}..."
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    return {dict: "a table", type(None): "nothing"}.get(type(value), f"of type {type(value).__name__}")


def shown_key(key: str) -> str:
    """A key as a path quotes it: bare where it may be, and not too long."""
    bare = re.fullmatch(r"[\w-]+", key) and len(key) <= LONGEST_WORD
    return key if bare else shown(key)


def counted(count: int, what: str) -> str:
    """`1 sensor`, `2 sensors`."""
    return f"{count:,} {what}" + ("" if count == 1 else "s")


def there_are(count: int, what: str) -> str:
    """`there is 1 sensor`, `there are 2 sensors`."""
    return f"there {'is' if count == 1 else 'are'} {counted(count, what)}"


def nearest(word: str, known: Iterable[str]) -> str:
    """Which of the `known` words looks most like `word`, whatever the case; of a long one the beginning counts."""
    word = word[:LONGEST_WORD]

    def likeness(candidate: str) -> tuple[float, bool]:
        ratio = difflib.SequenceMatcher(None, word.casefold(), candidate.casefold()).ratio()
        return ratio, candidate == word

    return max(known, key=likeness)


def frozen(array: ndarray) -> ndarray:
    """The same array, read-only from now on."""
    array.setflags(write=False)
    return array
