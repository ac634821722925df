"""Arrays of HDF5 files under any name."""

from __future__ import annotations

from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError, RecordingError
from lightpage.foreign.array import ForeignArray, chosen, readable
from lightpage.recording.hdf5 import DATA, find, hdf, open_hdf5, patiently
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
                self._name = "" if name is None else name.strip("/")
                named = self._file.array(self._name) if self._name else None  # which may be a second name, or a link
                if named is None or not _holds_numbers(named.dataset):
                    self._name = chosen(f"file {path}", name, arrays_in(file, reversed_axes))
            stored = self._file.array(self._name)
            assert stored is not None  # it is among those that were found
        except BaseException:
            self._file.close()
            raise
        self._array: StoredArray = stored
        holds = Path(stored.dataset.file.filename)
        self.files = (path,) if holds == path.absolute() else (path, holds)
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
    """Return the shapes of the arrays of numbers in a file that have two to four axes, by name; links are followed.

    Raises:
        RecordingError: there is none, but a link that leads to nothing.
        StorageError, SurroundingsError: a linked file cannot be read.
    """
    found: dict[str, tuple[int, ...]] = {}
    seen: set[int] = set()
    links: list[str] = []
    kept: list[Any] = []  # a linked file that is closed and opened again would have other hashes

    def look(name: str, item: Any) -> bool | None:
        if len(seen) > _MOST_OBJECTS or hash(item) in seen:
            return len(seen) > _MOST_OBJECTS or None
        seen.add(hash(item))
        if isinstance(item, h5py.Dataset) and _holds_numbers(item):
            found[name] = item.shape[::-1] if reversed_axes else item.shape
        elif isinstance(item, h5py.Group):
            names = (each for each in islice(item, _MOST_OBJECTS) if _is_link(item, each))
            links.extend(f"{name}/{each}".strip("/") for each in names)
        return None

    def look_below(group: str, name: str, item: Any) -> bool | None:
        return look(f"{group}/{name}", item)

    look("", file)
    file.visititems(look)
    broken = None
    for name in links:  # which grow while groups behind them are looked at
        try:
            linked = find(file, name, f"file {file.filename}: {name}")
        except RecordingError as error:
            broken = error
            continue
        kept.append(linked)
        if linked is None or hash(linked) in seen or look(name, linked):
            continue
        if isinstance(linked, h5py.Group):
            linked.visititems(partial(look_below, name))
    if broken is not None and not found:
        raise broken
    return found


def _is_link(group: Any, name: str) -> bool:
    return not isinstance(group.get(name, getlink=True), hdf.HardLink)


def _holds_numbers(item: h5py.Dataset) -> bool:
    if item.shape is None or not 2 <= len(item.shape) <= 4:
        return False
    return item.dtype.kind in _NUMBERS and 0 not in item.shape
