"""Differences of Linux, macOS and Windows: files that are renamed while open, locks, signals, cores."""

from __future__ import annotations

import errno
import os
import platform
import signal
import socket
import sys
from pathlib import Path

from lightpage.errors import SurroundingsError

try:
    import fcntl
except ModuleNotFoundError:  # as on Windows
    fcntl = None  # type: ignore[assignment]

LINUX_MODULES = frozenset({"fcntl", "termios"})
"""Modules of Python that Windows lacks."""

ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals by which a system asks a program to end."""

INHERITS_SOCKETS = hasattr(socket, "AF_UNIX")
"""Whether a process may have a socket for its standard input, as helper processes do; not on Windows."""

NEEDS_LINUX = "Linux: a container or WSL will do"

_BEYOND = 1 << 60
"""Place of the byte that Windows locks: nobody reads or writes a locked one, and no file is so long."""


def check_linux(subject: str) -> None:
    """Check that this system is Linux.

    Raises:
        SurroundingsError: it is another one.
    """
    if not hasattr(os, "memfd_create"):
        raise SurroundingsError(subject, platform.system(), NEEDS_LINUX)


def open_file(path: str | Path, *, make: bool = True, new: bool = False) -> int:
    """Return a descriptor to read and write a file by, which may be renamed and removed while it is open.

    Args:
        path: path of the file.
        make: whether it is made where it is not there, with the modes that the process's umask leaves.
        new: whether it must not be there.

    Raises:
        OSError: the system does not let it.
    """
    if sys.platform == "win32":
        import _winapi
        import msvcrt

        access, share = _winapi.GENERIC_READ | _winapi.GENERIC_WRITE, 0x7  # to read, to write, to rename and remove
        disposition = 1 if new else 4 if make else 3  # CREATE_NEW, OPEN_ALWAYS, OPEN_EXISTING of the Windows API
        handle = _winapi.CreateFile(str(path), access, share, 0, disposition, 0, 0)
        return msvcrt.open_osfhandle(handle, os.O_RDWR | os.O_BINARY)
    return os.open(path, os.O_RDWR | (os.O_CREAT if make or new else 0) | (os.O_EXCL if new else 0), 0o666)


def open_folder_to_lock(folder: Path) -> int:
    """Return a descriptor to lock a folder by: its own, or that of a file in it, which goes when it is closed.

    Raises:
        OSError: the system does not let it.
    """
    if sys.platform == "win32":
        return os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_TEMPORARY)
    return os.open(folder, os.O_RDONLY)


def try_lock(descriptor: int, *, shared: bool = False, ranges: bool = False) -> None:
    """Lock a file until its descriptor is closed; arguments as those of `lightpage.files.lock`.

    Raises:
        BlockingIOError: another process has it locked.
        OSError: storage fails, or there are no such locks, as shared ones on Windows.
    """
    try:
        if fcntl is not None:
            how = fcntl.LOCK_NB | (fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
            (fcntl.lockf if ranges else fcntl.flock)(descriptor, how)
        elif sys.platform == "win32" and not shared:
            import msvcrt

            place = os.lseek(descriptor, 0, os.SEEK_CUR)
            os.lseek(descriptor, _BEYOND, os.SEEK_SET)
            try:
                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            finally:
                os.lseek(descriptor, place, os.SEEK_SET)
        else:
            raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
    except OSError as error:
        if error.errno == errno.EACCES:  # so Windows, and some shares, say that another has it
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN)) from None
        raise


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
