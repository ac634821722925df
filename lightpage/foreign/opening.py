"""Opens an array of a file of another program, by what the file is."""

from __future__ import annotations

import os
from pathlib import Path

from lightpage.errors import InvalidInputError
from lightpage.failures import os_errors
from lightpage.files import matching
from lightpage.foreign.array import SEPARATOR, ForeignArray
from lightpage.foreign.hdf5_file import Hdf5Array
from lightpage.foreign.mat_file import open_mat
from lightpage.foreign.numpy_file import open_npy, open_npz
from lightpage.foreign.pictures import SUFFIXES, Pictures, natural, pictures_in
from lightpage.foreign.tiff_file import TiffArray

_READABLE = "a TIFF, .npy, .npz, .mat or HDF5 file, or a folder or pattern of pictures"
_MARKS = "*?["
"""Characters of a pattern."""
_HDF5 = (".h5", ".hdf5", ".hdf", ".he5", ".nxs", ".nc")


def open_array(named: str) -> ForeignArray:
    """Open the array that a user names.

    Args:
        named: FILE, FILE::NAME for one of several arrays, a folder of pictures, or a pattern that matches pictures.

    Raises:
        InvalidInputError: there is none, or the file is damaged or of no kind that is read here.
        StorageError, SurroundingsError: it cannot be read.
        ModuleNotFoundError: what reads it is not installed.
    """
    with os_errors(f"file {named}", _READABLE):
        path, name = _parted(named)
        if path.is_dir():
            if name is not None:
                raise InvalidInputError(f"folder {path}", f"the name '{name}' of an array", "a file that has it")
            return Pictures(f"folder {path}", pictures_in(path))
        if not path.exists():
            return _pattern(named)
        if not path.is_file():
            raise InvalidInputError(f"file {path}", "no regular file", _READABLE)
        array = _of_kind(path, name)
        array.files = array.files or (path,)
        return array


def names_array(named: str) -> bool:
    """Return whether a user means an array of a file, or pictures by a pattern, and not a file or a folder itself."""
    return not os.path.lexists(named) and (SEPARATOR in named or any(mark in named for mark in _MARKS))


def _parted(named: str) -> tuple[Path, str | None]:
    """Return file and array; a file whose own name has the separator is found too."""
    if Path(named).exists() or SEPARATOR not in named:
        return Path(named), None
    file, _, name = named.rpartition(SEPARATOR)
    return Path(file), name


def _pattern(pattern: str) -> ForeignArray:
    paths = sorted(map(Path, matching(pattern)), key=natural)
    if not paths or not any(mark in pattern for mark in _MARKS):
        raise InvalidInputError(f"file {pattern}", "no such file", _READABLE)
    if other := next((path for path in paths if path.suffix.lower() not in SUFFIXES), None):
        raise InvalidInputError(f"pattern {pattern}", other.name, f"pictures ({', '.join(sorted(SUFFIXES))})")
    return Pictures(f"pattern {pattern}", paths)


def _of_kind(path: Path, name: str | None) -> ForeignArray:
    suffix = path.suffix.lower()
    if suffix in (".tif", ".tiff"):
        return TiffArray(path, name)
    if suffix == ".npy":
        return open_npy(path, name)
    if suffix == ".npz":
        return open_npz(path, name)
    if suffix == ".mat":
        return open_mat(path, name)
    if suffix in _HDF5:
        return Hdf5Array(path, name)
    if suffix in SUFFIXES:
        return Pictures(f"file {path}", [path])
    raise InvalidInputError(f"file {path}", f"a name that ends with '{suffix}'", _READABLE)
