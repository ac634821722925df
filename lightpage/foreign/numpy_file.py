"""Arrays that NumPy saved: .npy and .npz. Pickled objects are never loaded."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError
from lightpage.foreign.array import MOST_BYTES, ForeignArray, chosen, readable

_EXPECTED = "an array that numpy.save or numpy.savez wrote"
_SUFFIX = ".npy"
Header = tuple[tuple[int, ...], bool, np.dtype[Any]]


class NumpyArray(ForeignArray):
    """An array as NumPy writes it.

    Args:
        subject: for errors.
        opened: opens the bytes of the array, its header first.
        path: of the file that holds just these bytes, which can be mapped; None for a member of an archive.

    Raises:
        InvalidInputError: they are no array, or one of Python objects.
    """

    def __init__(self, subject: str, opened: Callable[[], IO[bytes]], path: Path | None) -> None:
        self.subject, self._path, self.in_sequence = subject, path, path is None
        with readable(subject, _EXPECTED):
            self._file = opened()  # kept open: a compressed one would be read from its start for each part
        with self._closed_if_refused(), readable(subject, _EXPECTED):
            self.shape, self._fortran, self.dtype = header_of(self._file, subject)
            self._start, self.pages_last = self._file.tell(), self._fortran
            self._check_size()

    @contextmanager
    def _closed_if_refused(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.close()
            raise

    def _check_size(self) -> None:
        path = self._path
        if path is not None and path.stat().st_size < self._start + math.prod(self.shape) * self.dtype.itemsize:
            got = f"a file of {path.stat().st_size} bytes"
            raise InvalidInputError(self.subject, got, f"all of shape {self.shape}")

    def take(self, axis: int, start: int, stop: int) -> NDArray[Any]:
        """See `ForeignArray`; what lies together is read, else the file is mapped for a moment."""
        outermost = len(self.shape) - 1 if self._fortran else 0
        with readable(self.subject, _EXPECTED):
            if axis == outermost:
                return self._together(start, stop)
            if self._path is None:
                return self._all()[(slice(None),) * axis + (slice(start, stop),)]
            mapped = np.load(self._path, mmap_mode="r", allow_pickle=False)
            return np.array(mapped[(slice(None),) * axis + (slice(start, stop),)])

    def _together(self, start: int, stop: int) -> NDArray[Any]:
        shape = (*self.shape[:-1], stop - start) if self._fortran else (stop - start, *self.shape[1:])
        inner = math.prod(self.shape[:-1] if self._fortran else self.shape[1:]) * self.dtype.itemsize
        self._file.seek(self._start + start * inner)
        data = self._file.read((stop - start) * inner)
        if len(data) < (stop - start) * inner:
            raise InvalidInputError(self.subject, "a file that ends too early", f"all of shape {self.shape}")
        return np.frombuffer(data, self.dtype).reshape(shape, order="F" if self._fortran else "C")

    def close(self) -> None:
        """See `ForeignArray`."""
        self._file.close()

    def _all(self) -> NDArray[Any]:
        if (size := math.prod(self.shape) * self.dtype.itemsize) > MOST_BYTES:
            got = f"an array of {size / 1e9:.3g} GB in an archive, whose pages do not lie together"
            raise InvalidInputError(self.subject, got, "pages along the first axis, or an .npy")
        return self._together(0, self.shape[-1 if self._fortran else 0])


def open_npy(path: Path, name: str | None) -> ForeignArray:
    """Open an .npy file.

    Raises:
        InvalidInputError: it is none, is cut off, or holds Python objects.
    """
    subject = f"file {path}"
    if name is not None:
        raise InvalidInputError(f"{subject}: array '{name}'", "a file of a single array without a name", "no name")
    return NumpyArray(subject, lambda: path.open("rb"), path)


def open_npz(path: Path, name: str | None) -> ForeignArray:
    """Open an array of an .npz file.

    Raises:
        InvalidInputError: see `open_npy` and `chosen`.
    """
    found = arrays_of(path)
    member = f"{chosen(f'file {path}', name, found)}{_SUFFIX}"

    def opened() -> IO[bytes]:
        archive = zipfile.ZipFile(path)
        return archive.open(member)  # which keeps the archive's file open as long as it is

    return NumpyArray(f"file {path}: array '{member.removesuffix(_SUFFIX)}'", opened, None)


def arrays_of(path: Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays in an .npz file, by name; those of Python objects are left out.

    Raises:
        InvalidInputError: the file is damaged.
    """
    found = {}
    with readable(f"file {path}", _EXPECTED), zipfile.ZipFile(path) as archive:
        for member in archive.namelist():
            if member.endswith(_SUFFIX):
                with archive.open(member) as file:
                    shape, _, dtype = _header(file)
                if not dtype.hasobject:
                    found[member.removesuffix(_SUFFIX)] = shape
    return found


def header_of(file: IO[bytes], subject: str) -> Header:
    """Return shape, whether the order is Fortran's, and type; `file` stands behind the header then.

    Raises:
        InvalidInputError: the array is of Python objects.
        ValueError: no such header.
    """
    header = _header(file)
    if header[2].hasobject:
        raise InvalidInputError(subject, "pickled Python objects, which are not loaded", "an array of numbers")
    return header


def _header(file: IO[bytes]) -> Header:
    version = npy.read_magic(file)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, fortran, dtype = read(file)
    if any(size < 0 for size in shape):
        raise ValueError(f"shape {shape}")
    return shape, fortran, dtype
