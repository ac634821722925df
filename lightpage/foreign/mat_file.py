"""Arrays of MATLAB's .mat files: version 7.3, which is HDF5, and level 5 before it.

scipy.io.loadmat is not used: a damaged file of level 5 ends its process. The format is that of "MAT-File Format" by The
MathWorks: tagged elements, each of them padded to eight bytes, those of variables compressed or not.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError
from lightpage.foreign.array import MOST_BYTES, ForeignArray, chosen, readable
from lightpage.foreign.hdf5_file import Hdf5Array
from lightpage.recording.hdf5 import hdf

_EXPECTED = "a .mat file of MATLAB, version 5 or later"
_HEADER = 128
_ORDERS = {b"IM": "<", b"MI": ">"}
_MATRIX, _COMPRESSED = 14, 15
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_NUMBERS = range(6, 16)
"""Classes of arrays that are numbers."""
_COMPLEX = 0x0800
_HEAD_BYTES = 1 << 12
"""Bytes at the start of a variable that hold all but its values."""
_MOST_VARIABLES = 10_000


@dataclass(frozen=True)
class _Variable:
    """An array of numbers in a file.

    Attributes:
        shape: of the array.
        dtype: of the stored values, which may be shorter than their class.
        place: offset of its element's data in the file, bytes.
        size: length of that data.
        values: offset of the values in that data, once it is decompressed.
        compressed: whether it is.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    place: int
    size: int
    values: int
    compressed: bool


class MatArray(ForeignArray):
    """An array of a file of level 5; values lie column by column, so that pages along the last axis lie together."""

    pages_last = True

    def __init__(self, path: Path, name: str | None) -> None:
        subject = f"file {path}"
        with readable(subject, _EXPECTED):
            found = _variables(path)
        name = chosen(subject, name, {each: one.shape for each, one in found.items()})
        self.subject, self._path, self._variable = f"{subject}: array '{name}'", path, found[name]
        self.shape, self.dtype = self._variable.shape, self._variable.dtype
        self._data: NDArray[Any] | None = None

    def take(self, axis: int, start: int, stop: int) -> NDArray[Any]:
        """See `ForeignArray`; a compressed array is read whole."""
        with readable(self.subject, _EXPECTED):
            if self._variable.compressed and self._data is None:
                self._data = self._decompressed()
            data = self._mapped() if self._data is None else self._data
            return np.array(data[(slice(None),) * axis + (slice(start, stop),)])

    def _mapped(self) -> NDArray[Any]:
        offset = self._variable.place + self._variable.values
        return np.memmap(self._path, self.dtype, "r", offset, self.shape, "F")

    def _decompressed(self) -> NDArray[Any]:
        one, size = self._variable, math.prod(self.shape) * self.dtype.itemsize
        if size > MOST_BYTES:
            got = f"a compressed array of {size / 1e9:.3g} GB, which can only be read whole"
            raise InvalidInputError(self.subject, got, "save(..., '-v7.3')")
        with self._path.open("rb") as file:
            file.seek(one.place)
            data = zlib.decompressobj().decompress(file.read(one.size), one.values + size)
        return np.frombuffer(data, self.dtype, math.prod(self.shape), one.values).reshape(self.shape, order="F")


def open_mat(path: Path, name: str | None) -> ForeignArray:
    """Open an array of a .mat file.

    Raises:
        InvalidInputError: damaged, of level 4, or no such array.
        StorageError, SurroundingsError: it cannot be read.
    """
    return Hdf5Array(path, name, reversed_axes=True) if hdf.is_hdf5(path) else MatArray(path, name)


def mat_arrays(path: Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of numbers in a file of level 5, by name.

    Raises:
        InvalidInputError: the file is damaged, or none.
    """
    with readable(f"file {path}", _EXPECTED):
        return {name: one.shape for name, one in _variables(path).items()}


def _variables(path: Path) -> dict[str, _Variable]:
    """Return the arrays of numbers in a file; its values are not read."""
    found: dict[str, _Variable] = {}
    end = path.stat().st_size
    with path.open("rb") as file:
        order = _ORDERS.get(file.read(_HEADER)[-2:])
        if order is None:
            raise ValueError("no header of level 5")
        for _ in range(_MOST_VARIABLES):
            if len(tag := file.read(8)) < 8:
                break
            kind, size = struct.unpack(f"{order}II", tag)
            place = file.tell()
            if place + size > end:
                raise ValueError("a file that ends too early")
            if kind in (_MATRIX, _COMPRESSED) and (one := _variable(file, order, place, size, kind == _COMPRESSED)):
                found[one[0]] = one[1]
            file.seek(place + size)
    return found


def _variable(file: IO[bytes], order: str, place: int, size: int, compressed: bool) -> tuple[str, _Variable] | None:
    """Return name and place of a variable; None of one that is no array of real numbers."""
    head = file.read(min(size, _HEAD_BYTES))
    if compressed:
        head = zlib.decompressobj().decompress(head, _HEAD_BYTES)
    at = 8 if compressed else 0  # what is decompressed has a tag of its own
    _, start, length, at = _element(head, at, order)
    flags = struct.unpack_from(f"{order}I", head, start)[0]
    _, start, length, at = _element(head, at, order)
    shape = struct.unpack_from(f"{order}{length // 4}i", head, start)
    _, start, length, at = _element(head, at, order)
    name = head[start : start + length].decode("latin-1")
    if flags & 0xFF not in _NUMBERS or flags & _COMPLEX:
        return None
    kind, start, length, _ = _element(head, at, order)
    dtype = np.dtype(_STORED[kind]).newbyteorder("<" if order == "<" else ">")
    if not shape or min(shape) < 0 or math.prod(shape) * dtype.itemsize != length:
        raise ValueError(f"{length} bytes of shape {shape}")
    if not compressed and start + length > size:
        raise ValueError("values beyond the end of their element")
    return name, _Variable(shape, dtype, place, size, start, compressed)


def _element(data: bytes, at: int, order: str) -> tuple[int, int, int, int]:
    """Return type, start and length of an element's data, and the start of the next element."""
    kind, length = struct.unpack_from(f"{order}II", data, at)
    if kind >> 16:  # a short one holds its data in its tag
        return kind & 0xFFFF, at + 4, kind >> 16, at + 8
    return kind, at + 8, length, at + 8 + -(-length // 8) * 8
