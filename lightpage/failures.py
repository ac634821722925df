"""Causes of failures: the one place where light, content, storage and surroundings are told apart."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager

from lightpage.errors import Cause, InvalidInputError, LightpageError, NoRoomError, StorageError, SurroundingsError

_STORAGE = frozenset(
    getattr(errno, name)
    for name in (
        "EIO",
        "ESTALE",
        "ETIMEDOUT",
        "ENXIO",
        "ENODEV",
        "EREMOTEIO",
        "ENOLINK",
        "ENOTCONN",
        "ECONNRESET",
        "ECONNABORTED",
        "ECONNREFUSED",
        "ENETDOWN",
        "ENETUNREACH",
        "ENETRESET",
        "EHOSTDOWN",
        "EHOSTUNREACH",
        "EPROTO",
        "EBADMSG",
        "EUCLEAN",
        "EINTR",
        "EKEYEXPIRED",
        "EKEYREVOKED",
        "ENOKEY",
        "ENOMEDIUM",
        "ESHUTDOWN",
    )
    if hasattr(errno, name)
)
"""Error numbers of a disk or a share that fails: another try may go well, and nothing is said of a file's content."""

_THREADS = "threads or processes (ulimit -u), or memory for them"
_SHORT = {
    errno.ENOMEM: "memory",
    errno.EMFILE: "open files of the process (ulimit -n)",
    errno.ENFILE: "open files of the machine",
    errno.EAGAIN: _THREADS,
    errno.ENOSPC: "room on the disk",
    errno.EFBIG: "room in a file (ulimit -f, or another file system)",
    errno.EDQUOT: "room in the quota",
    errno.ENOBUFS: "buffers of the network",
}
"""Error numbers of a resource that is short, and which it is."""
_FULL = frozenset({errno.ENOSPC, errno.EFBIG, errno.EDQUOT})
"""Those of storage without room."""

_HDF5_ERRNO = re.compile(r"\berrno = (\d+)")
"""HDF5 tells the number in its message alone."""

_SHORT_WORDS = {
    "bad_alloc": "memory",
    "failed to allocate memory": "memory",
    "memory allocation failed": "memory",
    "unable to allocate": "memory",
    "cannot allocate memory": "memory",
    "failed to map segment": "memory",
    "out of memory": "memory",
    "can't start new thread": _THREADS,
    "resource temporarily unavailable": _THREADS,
    "pthread_create": _THREADS,
    "too many open files": "open files of the process (ulimit -n)",
}
"""Words of libraries that have no type of their own for a short resource."""


def cause_of(error: BaseException) -> Cause:
    """The cause of any failure; `Cause.SURROUNDINGS` for one that nobody foresaw."""
    if isinstance(error, LightpageError):
        return error.cause
    if error_number(error) in _STORAGE:
        return Cause.STORAGE
    return Cause.SURROUNDINGS


def may_pass(error: BaseException) -> bool:
    """Return whether a failure finds nothing about a page, so that the same work may succeed a moment later."""
    return isinstance(error, (StorageError, SurroundingsError))


def understood(subject: str, error: BaseException) -> LightpageError | None:
    """The error that an exception of another library means; None where it is a mistake of the program.

    Args:
        subject: work that was being done.
        error: failure of that work.
    """
    if isinstance(error, LightpageError):
        return error
    if isinstance(error, OSError) and error_number(error) in _STORAGE:
        return os_failure(subject, error, "storage that answers")
    return short_resource(subject, error)


def error_number(error: BaseException) -> int | None:
    """The `errno` of an error, of HDF5 too; None where there is none."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    told = _HDF5_ERRNO.search(str(error))
    return int(told[1]) if told else None


def os_failure(
    subject: str, error: OSError, expected: object, otherwise: type[LightpageError] = InvalidInputError
) -> LightpageError:
    """The error that a failure of the operating system, or of HDF5, means.

    Args:
        subject: thing that was to be read or written.
        error: failure of that.
        expected: state that would have been right.
        otherwise: class of the error where neither storage nor a short resource is the cause, e.g. no such file.

    Returns:
        A `StorageError`, a `SurroundingsError` or `NoRoomError` that names what is short, or one of class `otherwise`.
    """
    number = error_number(error)
    if number is not None and number in _STORAGE:
        return StorageError(subject, OSError(number, os.strerror(number)), expected)
    if number is not None and number in _SHORT:
        return _short_of(subject, OSError(number, os.strerror(number)), number)
    if number == errno.ENOLCK:
        remedy = "a file system with locks, or HDF5_USE_FILE_LOCKING=FALSE in the environment"
        return SurroundingsError(subject, OSError(number, os.strerror(number)), remedy)
    if (short := short_resource(subject, error)) is not None:
        return short
    if number is None:
        return otherwise(subject, error, expected)
    return otherwise(subject, OSError(number, os.strerror(number)), expected)


@contextmanager
def os_errors(subject: str, expected: object, otherwise: type[LightpageError] = InvalidInputError) -> Iterator[None]:
    """Raise what failures of the operating system mean, see `os_failure`."""
    try:
        yield
    except OSError as error:
        raise os_failure(subject, error, expected, otherwise) from None


def hdf5_failure(
    subject: str, error: Exception, expected: object, otherwise: type[LightpageError] = StorageError
) -> LightpageError:
    """Return the error that a failure of HDF5 means; damaged data if it has no number and no resource is short."""
    number = error_number(error)
    if number is not None:
        return os_failure(subject, OSError(number, os.strerror(number)), expected, otherwise)
    if short := short_resource(subject, error):
        return SurroundingsError(subject, "too little", short.expected)
    return otherwise(subject, "damaged data", expected)


def _short_of(subject: str, got: object, number: int) -> SurroundingsError:
    """Return the error of a resource by the number of `_SHORT`."""
    return (NoRoomError if number in _FULL else SurroundingsError)(subject, got, f"more {_SHORT[number]}")


def short_resource(subject: str, error: BaseException) -> SurroundingsError | None:
    """The error of a short resource, however a library says it; None where the failure is another one."""
    text = " ".join(str(error).split())
    number = error_number(error) if isinstance(error, OSError) else None
    if number is not None and number in _SHORT:
        return _short_of(subject, error, number)
    if isinstance(error, MemoryError):
        return SurroundingsError(subject, text or "too little memory", "more memory")
    if "no usable temporary directory" in text.lower():
        got = "no folder for temporary files that can be written"
        return SurroundingsError(subject, got, "one: name it in the variable TMPDIR")
    for words, what in _SHORT_WORDS.items():
        if words in text.lower():
            return SurroundingsError(subject, text, f"more {what}")
    return None


def lacks_memory(error: BaseException) -> bool:
    """Return whether a failure says that memory is short, this machine's or a device's."""
    short = error if isinstance(error, SurroundingsError) else short_resource("", error)
    return short is not None and short.expected == "more memory"
