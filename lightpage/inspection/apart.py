"""Looks at a file in a process of its own: libraries that read files crash or hang at some damaged ones."""

from __future__ import annotations

from pathlib import Path

from lightpage.cli.main import missing
from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError, StorageError, SurroundingsError, WorkerError
from lightpage.helper_process import Helper, HelperProcess, same_packages
from lightpage.inspection.finding import Finding, Picture
from lightpage.systems import INHERITS_SOCKETS

_KILLED = -9
"""Exit status of a process that the system has ended since memory was short; not every system names the signal."""
LONGEST_S = 60.0
"""Time that looking at a file may take: it reads samples, and a share may be slow."""


class Inspector(Helper):
    """The helper in that process."""

    def look(self, path: Path, profile: Profile | None, drawn: bool) -> tuple[Finding, list[Picture]]:
        """Return what was found, and what is to be drawn of it.

        Raises:
            LightpageError: what `lightpage.inspection.look` raises, or a library is missing.
        """
        from lightpage.inspection.look import look

        try:
            found = look(path, profile)
            pictures = found.pictures() if drawn and found.pictures is not None else []
        except ModuleNotFoundError as error:
            raise missing(f"file {path}", error) from None
        found.pictures = None  # a function does not cross
        return found, pictures


def look_apart(
    path: Path, profile: Profile | None, *, drawn: bool, longest_s: float = LONGEST_S
) -> tuple[Finding, list[Picture]]:
    """Look at a file in another process, and return what was found and what is to be drawn of it.

    Args:
        path: the file or folder.
        profile: the device that it is to fit; its own where it has one if left out.
        drawn: whether pictures are wanted.
        longest_s: time after which the process is ended.

    Raises:
        InvalidInputError: it is nothing that is known here, or reading it crashes.
        StorageError: it cannot be read, or not in time.
        SurroundingsError: a resource is short.
        WorkerError: the process cannot be started, or fails by itself.
    """
    if not INHERITS_SOCKETS:  # then a damaged file may end this process
        return Inspector().look(path, profile, drawn)
    subject = f"file {path}"
    process = HelperProcess(f"{__name__}:Inspector", subject=subject, environment=same_packages(1))
    try:
        process.send("look", path, profile, drawn)
        if not process.poll(longest_s):
            got = f"no end within {longest_s:g} s"
            expected = "one that takes less: not damaged, not huge, not on slow storage"
            raise StorageError(subject, got, expected)
        found, pictures = process.answer()
        return found, pictures
    except WorkerError as error:
        if process.status == _KILLED:
            raise SurroundingsError(subject, error.got, "more memory") from None
        if process.status is not None and process.status < 0:
            got = f"data at which reading crashes ({error.got})"
            raise InvalidInputError(subject, got, "a file that is whole") from None
        raise
    finally:
        process.end()
