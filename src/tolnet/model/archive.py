"""Side archives: named arrays in an .npz file, read without pickle and without trusting what it says about itself."""

from __future__ import annotations

import io
import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Mapping

import numpy as np
from numpy import ndarray
from numpy.lib import format as npy

from tolnet.model._checks import shown
from tolnet.model.bounded_reading import check_inflation
from tolnet.model.errors import InputError

_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_MALFORMED = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    NotImplementedError,  # a compression that Python does not know
    RuntimeError,  # encrypted
    # A .npy header is Python source: what parsing any text as that may raise.
    tokenize.TokenError,
    SyntaxError,
    RecursionError,
    MemoryError,
    TypeError,
    ValueError,
    Warning,
)
"""What zipfile and NumPy raise on bytes that are no archive of arrays, as found by feeding them such."""
LONGEST = 300
"""How much of what they say is passed on: they quote what they could not read."""


def read_archive(data: bytes) -> dict[str, ndarray]:
    """The arrays of an .npz file, read-only.

    Raises InputError for what is no such file, is truncated, holds anything but numbers and texts or one name twice,
    and for one that would unpack to many times its size; nothing in it is ever unpickled, and sizes are judged by the
    headers before anything is unpacked.
    """
    try:
        with warnings.catch_warnings(), zipfile.ZipFile(io.BytesIO(data)) as archive:
            warnings.simplefilter("error")
            members = archive.infolist()
            _check_names([_name(info) for info in members])
            check_inflation(sum(info.file_size for info in members), len(data))
            return {_name(info): _member(archive, info) for info in members}
    except InputError:
        raise
    except _MALFORMED as error:
        raise InputError(f"is no archive of arrays (.npz): {str(error)[:LONGEST] or type(error).__name__}") from None


def _name(info: zipfile.ZipInfo) -> str:
    return info.filename.removesuffix(".npy")


def _check_names(names: list[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(f"holds {shown(name)} twice")
        seen.add(name)


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> ndarray:
    """One array: what its header says is held against the size of the member before the rest of it is read."""
    name = shown(_name(info))
    with archive.open(info) as member:
        version = npy.read_magic(member)
        if version not in _READERS:
            raise InputError(f"holds {name} in version {version} of the .npy format; 1.0 or 2.0 was expected")
        shape, fortran, dtype = _READERS[version](member)
        if dtype.hasobject:
            raise InputError(f"holds {name} as pickled objects, which are never read; numbers or texts were expected")
        if dtype.kind not in "iufbU":
            raise InputError(f"holds {name} of type {dtype}; numbers or texts were expected")
        count, size = math.prod(shape), info.file_size - member.tell()
        if dtype.itemsize == 0 or min(shape, default=0) < 0 or count * dtype.itemsize != size:
            raise InputError(f"holds {name} with {size} bytes of data, which is not {shape} of {dtype}")
        raw = member.read()
    if len(raw) != size:
        raise InputError(f"holds {name} with {len(raw)} bytes of data, which is not {shape} of {dtype}")
    flat = np.frombuffer(raw, dtype, count) if count else np.empty(0, dtype)
    return flat.reshape(shape, order="F" if fortran else "C")


def archive_bytes(arrays: Mapping[str, ndarray]) -> bytes:
    """The same arrays as the bytes of an .npz file, equal for equal arrays."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                npy.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
    return stream.getvalue()
