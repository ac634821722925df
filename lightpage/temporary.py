"""Temporary folders, where a system may have no place for them: no /tmp, no home, all of it read-only."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from lightpage.errors import SurroundingsError
from lightpage.failures import os_failure

_MEMORY = "/dev/shm"
"""A container that is read-only has this at least."""

SOCKET_BYTES = 107
"""Longest path of a Unix socket: the system keeps it in 108 bytes, the last of which is 0."""

_RANDOM = 8
"""Characters that are added to the prefix of a temporary folder's name."""

_kept: list[tempfile.TemporaryDirectory[str]] = []
"""Folders that stay as long as the process."""


def temporary_folder(
    subject: str, prefix: str = "lightpage-", within: Path | None = None
) -> tempfile.TemporaryDirectory[str]:
    """An empty folder that this user alone sees; it goes with the `with` statement, or with the process.

    Args:
        subject: user of the folder, for the error.
        prefix: beginning of its name.
        within: the folder that it is made in; by default that for temporary files.

    Raises:
        SurroundingsError: there is none, and TMPDIR is to name one, or it has no room.
    """
    try:
        return tempfile.TemporaryDirectory(prefix=prefix, dir=within, ignore_cleanup_errors=True)
    except OSError as error:
        expected = "a folder for temporary files that can be written: name it in the variable TMPDIR"
        raise os_failure(subject, error, expected, SurroundingsError) from None


def short_folder(subject: str, prefix: str, longest: int) -> tempfile.TemporaryDirectory[str]:
    """A `temporary_folder` for sockets, the path of which may have only so many bytes.

    It lies elsewhere than other temporary files where their folder has a long name.

    Args:
        subject, prefix: see `temporary_folder`.
        longest: bytes of its path.

    Raises:
        SurroundingsError: no folder for temporary files is short enough.
    """
    places = [os.path.abspath(tempfile.tempdir or os.environ.get("TMPDIR", "/tmp")), "/tmp", "/var/tmp", _MEMORY]
    room = longest - len(f"/{prefix}") - _RANDOM
    for place in places:
        if len(os.fsencode(place)) <= room and os.path.isdir(place) and os.access(place, os.W_OK):
            return temporary_folder(subject, prefix, Path(place))
    expected = f"one whose path has at most {room} bytes, for sockets: name it in the variable TMPDIR"
    raise SurroundingsError(subject, f"no folder for temporary files, or too long a path ({places[0]})", expected)


def settle_matplotlib() -> None:
    """Give matplotlib a temporary folder for its caches, before it is imported, where the user's own cannot be written.

    It would do so itself, and warn of it.

    Raises:
        SurroundingsError: see `temporary_folder`.
    """
    if "matplotlib" in sys.modules or all(map(_can_be_written, _folders_of_matplotlib())):
        return
    try:
        folder = temporary_folder("matplotlib", "matplotlib-")
    except SurroundingsError:
        if not os.access(_MEMORY, os.W_OK):
            raise
        folder = temporary_folder("matplotlib", "matplotlib-", Path(_MEMORY))
    os.environ["MPLCONFIGDIR"] = folder.name
    _kept.append(folder)


def _folders_of_matplotlib() -> list[str]:
    if own := os.environ.get("MPLCONFIGDIR"):
        return [own]
    homes = [("XDG_CONFIG_HOME", "~/.config"), ("XDG_CACHE_HOME", "~/.cache")]
    return [os.path.join(os.environ.get(name) or os.path.expanduser(home), "matplotlib") for name, home in homes]


def _can_be_written(folder: str) -> bool:
    if folder.startswith("~"):  # a user without a home
        return False
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)
