"""Arrays of HDF5 files under any name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError
from lightpage.foreign.array import ForeignArray, chosen, readable
from lightpage.recording.hdf5 import DATA, open_hdf5, patiently
from lightpage.recording.stored import ArrayFile, StoredArray

_MOST_OBJECTS = 10_000
"""Objects of a file that are looked at; nobody names more."""
_NUMBERS = "buif"


class Hdf5Array(ForeignArray):
    """An array of an HDF5 file.

    Args:
        path: of the file.
        name: of the array, or None for the only one.
        reversed_axes: whether the file has the axes in the other order than its program, as MATLAB's have.

    Raises:
        InvalidInputError: no such array, or its data are not all there.
    """

    def __init__(self, path: Path, name: str | None, *, reversed_axes: bool = False) -> None:
        self._reversed = self.pages_last = reversed_axes
        file = open_hdf5(path, f"file {path}")
        self._file = ArrayFile(file, f"file {path}")
        try:
            with readable(f"file {path}", DATA):
                self._name = chosen(f"file {path}", name, arrays_in(file, reversed_axes))
            stored = self._file.array(self._name)
            assert stored is not None  # it is among those that were found
        except BaseException:
            self._file.close()
            raise
        self._array: StoredArray = stored
        self.subject, self.dtype = stored.subject, stored.dtype
        self.shape = stored.shape[::-1] if reversed_axes else stored.shape

    def take(self, axis: int, start: int, stop: int) -> NDArray[Any]:
        """See `ForeignArray`."""
        inner = len(self.shape) - 1 - axis if self._reversed else axis
        with readable(self.subject, DATA):
            if inner == 0:
                part = self._file.rows(self._name, start, stop)
            elif self._array.dataset.is_virtual:
                raise InvalidInputError(self.subject, "a virtual dataset", "pages along its first axis")
            else:
                where = (slice(None),) * inner + (slice(start, stop),)
                part = patiently(lambda: np.asarray(self._array.dataset[where]), self.subject)
        return part.transpose() if self._reversed else part

    def close(self) -> None:
        """See `ForeignArray`."""
        self._file.close()


def arrays_in(file: h5py.File, reversed_axes: bool = False) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of numbers in a file that have two to four axes, by name."""
    found: dict[str, tuple[int, ...]] = {}
    looked_at = 0

    def look(name: str, item: object) -> bool | None:
        nonlocal looked_at
        looked_at += 1
        if isinstance(item, h5py.Dataset) and _holds_numbers(item):
            found[name] = item.shape[::-1] if reversed_axes else item.shape
        return True if looked_at > _MOST_OBJECTS else None

    file.visititems(look)
    return found


def _holds_numbers(item: h5py.Dataset) -> bool:
    if item.shape is None or not 2 <= len(item.shape) <= 4:
        return False
    return item.dtype.kind in _NUMBERS and 0 not in item.shape
