"""MATLAB files, format 5 (what MATLAB calls -v6 and -v7), read without trusting what they say about themselves.

scipy's reader is not used here: damaged bytes make it crash the interpreter, and nothing of ours can catch that.
Source: The MathWorks, MAT-File Format, 2019, chapter 1 (level 5).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy import ndarray
from scipy import sparse

from tolnet.model._checks import shown
from tolnet.model.bounded_reading import check_inflation
from tolnet.model.errors import InputError

NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""NumPy's name for each numeric type of a data element."""
CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
"""NumPy's name for each numeric class of an array, whose data may be stored in a smaller type."""
ENCODINGS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
MATRIX, COMPRESSED = 14, 15
CELL, CHAR, SPARSE = 1, 4, 5
OPAQUE = 17
OTHERS = {2: "a structure", 3: "an object", 16: "a function", OPAQUE: "an object, such as a string in double quotes"}
_TAG = 8
"""Bytes before the data of an element: its type and size."""
DEEPEST = 20
"""How deep cells may hold cells."""


def read_mat(data: bytes) -> dict[str, Any]:
    """The variables of a MATLAB file by name.

    Numbers are arrays of MATLAB's class and shape, logical ones booleans, sparse ones `csc_array`; a text is a str, a
    text of several rows and a cell array a tuple, column by column.
    Raises InputError for other formats, for damaged files, and for structures, objects and functions.
    """
    if data[:10] == b"MATLAB 7.3" or data[512:516] == b"\x89HDF":
        raise InputError("is in MATLAB's format 7.3, which is not read; save it with -v7")
    mark = data[126:128]
    if len(data) < 128 or mark not in (b"IM", b"MI"):
        raise InputError("is no MATLAB file of format 5 to 7; save it with -v7")
    reader = _Reader("<" if mark == b"IM" else ">", len(data))
    try:
        return reader.named(data[128:])
    except (zlib.error, _Damaged, UnicodeDecodeError) as error:
        raise InputError(f"is a damaged MATLAB file: {error}") from None


class _Damaged(Exception):
    """Bytes that are not what the ones before them promise."""


class _Reader:
    """Reads elements in one byte order."""

    def __init__(self, order: str, size: int) -> None:
        self.order, self.size = order, size
        self.unpacked = 0

    def named(self, data: bytes) -> dict[str, Any]:
        """Every variable by its name. Raises InputError where a name stands twice."""
        found: dict[str, Any] = {}
        for name, value in self.variables(data):
            if name in found:
                raise InputError(f"holds {shown(name)} twice")
            found[name] = value
        return found

    def variables(self, data: bytes) -> Iterator[tuple[str, Any]]:
        """Every named array, compressed or not."""
        for kind, part in self.elements(data):
            if kind == COMPRESSED:
                kind, part = self.inflated(part)
            if kind != MATRIX:
                raise _Damaged(f"an element of type {kind} stands where a variable was expected")
            name, value = self.matrix(part, 0)
            if name:  # what has none is MATLAB's own
                yield name, value

    def inflated(self, data: bytes) -> tuple[int, bytes]:
        """The one element in a compressed one, whose size is judged before it is unpacked."""
        stream = zlib.decompressobj()
        head = stream.decompress(data, _TAG)
        if len(head) < _TAG:
            raise _Damaged("it ends in the middle of an element")
        kind, size = (int(x) for x in np.frombuffer(head, self.order + "u4", 2))
        self.take(size)
        part = stream.decompress(stream.unconsumed_tail, size) if size else b""
        more = stream.decompress(stream.unconsumed_tail, 1)
        if len(part) != size or more or not stream.eof:
            raise _Damaged("a compressed element is not as long as it says")
        return kind, part

    def take(self, size: int) -> None:
        """Account for so many bytes of memory. Raises InputError where they grow beyond what the file can mean."""
        self.unpacked += size
        check_inflation(self.unpacked, self.size)

    def elements(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Type and data of each element, one after the other; short ones carry both in eight bytes."""
        at = 0
        while at < len(data):
            if len(data) < at + 8:
                raise _Damaged("it ends in the middle of an element")
            first, second = (int(x) for x in np.frombuffer(data, self.order + "u4", 2, at))
            if first >> 16:
                kind, size, start, after = first & 0xFFFF, first >> 16, at + 4, at + 8
            else:
                kind, size, start = first, second, at + 8
                after = start + size + (0 if kind == COMPRESSED else -size % 8)
            if start + size > min(after, len(data)):
                raise _Damaged("an element is longer than what holds it")
            yield kind, data[start : start + size]
            at = after

    def matrix(self, data: bytes, depth: int) -> tuple[str, Any]:
        """Name and value of an array."""
        parts = self.elements(data)
        flags = self.numbers(parts, "u4")
        if depth > DEEPEST or len(flags) != 2:
            raise _Damaged("an array has no header")
        kind, logical, imaginary = int(flags[0]) & 0xFF, bool(flags[0] & 0x200), bool(flags[0] & 0x800)
        shape = (0, 0) if kind == OPAQUE else tuple(int(x) for x in self.numbers(parts, "i8"))
        if len(shape) < 2 or min(shape) < 0:
            raise _Damaged(f"an array has the shape {shape}")
        name = self.text(parts)
        if kind in OTHERS:
            raise InputError(f"holds {name!r}, {OTHERS[kind]}; numbers, texts and cell arrays of them are read")
        if imaginary:
            raise InputError(f"holds {name!r} as complex numbers; real ones were expected")
        if kind == CELL:
            return name, tuple(self.cells(parts, math.prod(shape), depth))
        if kind == CHAR:
            return name, _rows(self.text(parts), shape)
        if kind == SPARSE:
            return name, self.sparse(parts, shape, logical)
        if kind not in CLASSES:
            raise _Damaged(f"an array is of class {kind}")
        values = self.numbers(parts, CLASSES[kind])
        if len(values) != math.prod(shape):
            raise _Damaged(f"an array of shape {shape} has {len(values)} values")
        return name, values.astype(bool if logical else values.dtype).reshape(shape, order="F")

    def numbers(self, parts: Iterator[tuple[int, bytes]], wanted: str) -> ndarray:
        """The next element as numbers."""
        kind, data = next(parts, (0, b""))
        stored = np.dtype(self.order + NUMBERS[kind]) if kind in NUMBERS else None
        if stored is None or len(data) % stored.itemsize:
            raise _Damaged(f"an element of type {kind} and {len(data)} bytes stands where numbers were expected")
        self.take(len(data) // stored.itemsize * np.dtype(wanted).itemsize)
        return np.frombuffer(data, stored).astype(wanted)

    def text(self, parts: Iterator[tuple[int, bytes]]) -> str:
        """The next element as text."""
        kind, data = next(parts, (0, b""))
        if kind not in ENCODINGS:
            raise _Damaged(f"an element of type {kind} stands where a text was expected")
        suffix = {"utf-16": "-le", "utf-32": "-le"} if self.order == "<" else {"utf-16": "-be", "utf-32": "-be"}
        return data.decode(ENCODINGS[kind] + suffix.get(ENCODINGS[kind], ""))

    def cells(self, parts: Iterator[tuple[int, bytes]], count: int, depth: int) -> Iterator[Any]:
        """The arrays in a cell array."""
        found = 0
        for kind, data in parts:
            if kind != MATRIX:
                raise _Damaged(f"an element of type {kind} stands in a cell")
            found += 1
            yield self.matrix(data, depth + 1)[1] if data else np.empty((0, 0))
        if found != count:
            raise _Damaged(f"a cell array of {count} has {found} cells")

    def sparse(self, parts: Iterator[tuple[int, bytes]], shape: tuple[int, ...], logical: bool) -> sparse.csc_array:
        """A sparse matrix, stored by columns."""
        rows, starts = self.numbers(parts, "i8"), self.numbers(parts, "i8")
        count = int(starts[-1]) if len(starts) else -1
        kind, data = next(parts, (0, b""))
        if logical and len(data) == count:  # a byte for each, whatever the type says
            kind = 2
        values = self.numbers(iter([(kind, data)]), "f8")
        if len(shape) != 2 or len(starts) != shape[1] + 1 or starts[0] != 0 or (np.diff(starts) < 0).any():
            raise _Damaged("a sparse matrix has columns that overlap")
        if count > min(len(rows), len(values)) or ((rows[:count] < 0) | (rows[:count] >= shape[0])).any():
            raise _Damaged("a sparse matrix has entries outside")
        kept = values[:count].astype(bool) if logical else values[:count]
        return sparse.csc_array((kept, rows[:count], starts), shape=shape)


def _rows(text: str, shape: tuple[int, ...]) -> str | tuple[str, ...]:
    """Characters stored column by column, as the texts of the rows without the blanks that fill them up."""
    if len(shape) != 2 or len(text) != math.prod(shape):
        raise _Damaged(f"a text of shape {shape} has {len(text)} characters")
    if shape[0] <= 1:
        return text
    return tuple(text[i :: shape[0]].rstrip() for i in range(shape[0]))
