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


def read_archive(data: bytes) -> dict[str, ndarray]:
    """The arrays of an .npz file, read-only views of its bytes where nothing is compressed.

    Raises InputError for what is no such file, is truncated, or holds anything but numbers and texts; nothing in
    it is ever unpickled.
    """
    try:
        with warnings.catch_warnings(), zipfile.ZipFile(io.BytesIO(data)) as archive:
            warnings.simplefilter("error")
            return {info.filename.removesuffix(".npy"): _member(archive, info) for info in archive.infolist()}
    except InputError:
        raise
    except _MALFORMED as error:
        raise InputError(f"is no archive of arrays (.npz): {error or type(error).__name__}") from None


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> ndarray:
    name = info.filename.removesuffix(".npy")
    raw = archive.read(info)
    stream = io.BytesIO(raw)
    version = npy.read_magic(stream)
    if version not in _READERS:
        raise InputError(f"holds {name!r} in version {version} of the .npy format; 1.0 or 2.0 was expected")
    shape, fortran, dtype = _READERS[version](stream)
    if dtype.hasobject:
        raise InputError(f"holds {name!r} as pickled objects, which are never read; numbers or texts were expected")
    if dtype.kind not in "iufbU":
        raise InputError(f"holds {name!r} of type {dtype}; numbers or texts were expected")
    count, start = math.prod(shape), stream.tell()
    if dtype.itemsize == 0 or min(shape, default=0) < 0 or count * dtype.itemsize != len(raw) - start:
        raise InputError(f"holds {name!r} with {len(raw) - start} bytes of data, which is not {shape} of {dtype}")
    flat = np.frombuffer(raw, dtype, count, start) if count else np.empty(0, dtype)
    return flat.reshape(shape, order="F" if fortran else "C")


def archive_bytes(arrays: Mapping[str, ndarray]) -> bytes:
    """The same arrays as the bytes of an .npz file, equal for equal arrays."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                npy.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
    return stream.getvalue()
