"""Reading HDF5 files: opening, links and attributes, tried again where storage fails, and errors in plain words."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import Cause, LightpageError, RecordingError, StorageError
from lightpage.failures import cause_of, error_number, hdf5_failure

T = TypeVar("T")

hdf: Any = h5py
"""The stubs of h5py know little of links and of its low level."""

PAUSES_S = (0.1, 0.5)
"""Before the second and the third try."""

clock: Clock = SYSTEM
"""The clock that every try waits by."""

DATA = "data that can be read"
READABLE = "a readable, complete HDF5 file"

_UNFINISHED = ("unable to lock file", "already open for", "truncated file")
"""What HDF5 says of a file that is not closed, or not whole."""


def retried(call: Callable[[], T], renew: Callable[[], object] = lambda: None) -> T:
    """Return what `call` returns, tried up to three times where storage fails for a moment.

    Args:
        call: reads or writes, by HDF5 or the system.
        renew: called before another try.

    Raises:
        OSError, KeyError, RuntimeError: what the last try raised.
    """
    for number, pause in enumerate((*PAUSES_S, None)):
        try:
            if number:
                renew()
            return call()
        except (OSError, KeyError, RuntimeError) as error:
            if pause is None or cause_of(error) is not Cause.STORAGE:
                raise
            clock.sleep(pause)
    raise AssertionError  # the last pause is None


def patiently(
    read: Callable[[], T],
    subject: str,
    expected: str = DATA,
    otherwise: type[LightpageError] = StorageError,
    renew: Callable[[], object] = lambda: None,
) -> T:
    """The same, with its failure in plain words.

    Args:
        read, renew: see `retried`.
        subject, expected, otherwise: see `lightpage.failures.hdf5_failure`.

    Raises:
        StorageError: the storage fails on.
        SurroundingsError: a resource is short.
        LightpageError: of class `otherwise`, for any other failure of HDF5; and what `read` or `renew` raises itself.
    """
    try:
        return retried(read, renew)
    except (OSError, KeyError, RuntimeError) as error:
        raise hdf5_failure(subject, error, expected, otherwise) from None


def open_hdf5(path: Path, subject: str) -> h5py.File:
    """An HDF5 file opened for reading.

    Raises:
        RecordingError: missing, truncated, being written, or something else.
        StorageError, SurroundingsError: the storage fails, or a resource is short.
    """
    return patiently(lambda: open_once(path, subject), subject, READABLE, RecordingError)


def open_once(path: Path, subject: str) -> h5py.File:
    """The same, tried once.

    Raises:
        RecordingError: as there.
        OSError: what HDF5 or the system says of storage and resources.
    """
    if not path.is_file():
        got = "a folder" if path.is_dir() else "no regular file" if path.exists() else "no such file"
        unfinished = Path(f"{path}.partial")
        if unfinished.is_file():
            raise RecordingError(subject, f"{got}, only {unfinished.name}", f"{READABLE}: write it to its end")
        raise RecordingError(subject, got, READABLE)
    try:
        return h5py.File(str(path.absolute()), "r")  # its sources are found from any folder
    except OSError as error:
        if _lacks_locks(error):  # reading needs none
            return h5py.File(str(path.absolute()), "r", locking=False)
        if not path.stat().st_size or any(words in str(error) for words in _UNFINISHED):
            raise RecordingError(
                subject,
                "an unfinished file: another program still writes it, or was stopped while writing or copying it",
                f"{READABLE}: wait for its end, or write or copy it anew; where nobody writes it any more, "
                "'h5clear --status FILE' may open it",
            ) from None
        if "signature not found" in str(error):
            raise RecordingError(subject, "no HDF5 file", READABLE) from None
        raise


def _lacks_locks(error: OSError) -> bool:
    """Return whether opening failed since the file system has no locks, or the file is open without one already."""
    text = str(error)
    return "locking flag" in text or ("unable to lock file" in text and error_number(error) != errno.EAGAIN)


def open_named(path: Path, subject: str, variable: str) -> h5py.File:
    """The same of a file that another one names; `variable` of the environment says where else it may lie."""
    if not _may_be(path):
        expected = f"the file, copied along to there or to a folder that {variable} names"
        raise RecordingError(subject, "no such file", expected)
    return open_hdf5(path, subject)


def find(file: h5py.File, name: str, subject: str) -> Any:
    """Return what lies under a path in a file, or None where nothing is there, or HDF5's null.

    Raises:
        RecordingError: a link that leads to nothing.
        StorageError: it cannot be read.
    """
    place: Any = file
    for part in name.split("/"):
        links = getattr(place.id, "links", None)  # a dataset has none
        if links is None or not patiently(partial(links.exists, part.encode()), subject):
            return None
        place = _linked(place, part, subject)
    return None if isinstance(place, h5py.Dataset) and place.shape is None else place


def _linked(group: Any, part: str, subject: str) -> Any:
    link = patiently(lambda: group.get(part, getlink=True), subject)
    try:
        return patiently(lambda: group[part], subject)
    except StorageError as error:
        if error.__context__ is not None and cause_of(error.__context__) is Cause.STORAGE:
            raise  # that says nothing of the link
        if isinstance(link, hdf.ExternalLink):
            path = resolved(link.filename, Path(group.file.filename), os.environ.get("HDF5_EXT_PREFIX", ""))
            open_named(path, f"{subject}: linked file {path}", "HDF5_EXT_PREFIX").close()
        elif not isinstance(link, hdf.SoftLink):
            raise
        expected = "a link to an array: copy the file that holds it along, or link it anew"
        raise RecordingError(subject, f"a link to '{link.path}', which is not there", expected) from None


def resolved(name: str, file: Path, prefixes: str) -> Path:
    """The path of a file that an HDF5 file names, by HDF5's rules.

    Args:
        name: as it stands in `file`.
        file: absolute path of the file that names it.
        prefixes: folders to look in, from the environment; `${ORIGIN}` is the folder of `file`.

    Returns:
        The first place that exists, else the one beside `file`.
    """
    base = os.path.basename(name) if os.path.isabs(name) else name
    beside = file.parent / base
    places = [
        *([Path(name)] if os.path.isabs(name) else []),
        *(Path(prefix.replace("${ORIGIN}", str(file.parent)), base) for prefix in prefixes.split(os.pathsep) if prefix),
        beside,
        Path(base).absolute(),
        Path(os.path.realpath(file)).parent / base,
    ]
    return next((place for place in places if _may_be(place)), beside)


def _may_be(path: Path) -> bool:
    """Return whether a file is there; where the system does not say, opening it will tell why."""
    try:
        path.stat()
    except OSError as error:
        return cause_of(error) is Cause.STORAGE or isinstance(error, PermissionError)
    return True


def read_attribute(place: h5py.Group, name: str, subject: str, default: object = None) -> Any:
    """An attribute of a file or a group as a plain Python value; `default` where it is absent, or HDF5's null.

    Raises:
        RecordingError: a value of a type that numpy knows not.
        StorageError: it cannot be read.
    """
    subject = f"{subject}: attribute '{name}'"
    if not patiently(lambda: name in place.attrs, subject):
        return default
    try:
        value = patiently(lambda: place.attrs[name], subject)
    except (TypeError, ValueError):
        raise RecordingError(subject, "a value of a type that cannot be read", "a number or text") from None
    if isinstance(value, hdf.Empty):
        return default
    if isinstance(value, (np.generic, np.ndarray)) and value.size == 1:
        value = value.item()
    elif isinstance(value, np.ndarray) and value.dtype.kind == "S":
        value = np.char.decode(value, "utf-8", "replace")
    if isinstance(value, str):  # what is no UTF-8 comes as lone surrogates, which cannot be printed
        value = value.encode("utf-8", "surrogateescape")
    return value.decode("utf-8", "replace").rstrip("\0 ") if isinstance(value, bytes) else value
