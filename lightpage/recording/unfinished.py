"""Recordings that are not complete yet: where they lie, and whether the pages in them may be gone on with."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError, NoSuchPageError, RecordingError
from lightpage.failures import error_number, hdf5_failure, os_failure, short_resource
from lightpage.files import lock
from lightpage.recording.hdf5 import retried
from lightpage.recording.layout import FORMAT, FRAMES, SHOT_DATA, VERSION
from lightpage.systems import open_file
from lightpage.words import counted

Symbols = Callable[[int], NDArray[np.uint8]]
"""Of a page by its number; `NoSuchPageError` where there is none."""

CUT_OFF = (OSError, KeyError, RuntimeError, TypeError, ValueError)
"""What HDF5 raises of a file that was cut off while it was written; it is begun anew."""


@dataclass(frozen=True)
class Identity:
    """The origin of a recording's pages, by which an unfinished recording is known again.

    Attributes:
        profile: nominal profile.
        levels: M.
        bit_depth: bits of a camera count.
        code: what the pages hold, JSON text, where they were made by an encoder.
        symbols: of the pages, where they are known before they are recorded.
        black_level: counts of a camera in the dark, which frames still have.
    """

    profile: Profile
    levels: int
    bit_depth: int
    code: str | None = None
    symbols: Symbols | None = None
    black_level: int = 0

    def attributes(self) -> dict[str, object]:
        """The root attributes that say so."""
        told = {"format": FORMAT, "version": VERSION, "camera_bit_depth": self.bit_depth, "levels": self.levels}
        told |= {"profile": self.profile.to_toml()} | ({} if self.code is None else {"code": self.code})
        return told | ({"black_level": self.black_level} if self.black_level else {})

    def difference(self, file: h5py.File, pages: int) -> str:
        """Return the first difference between two origins in words; empty if they are the same."""
        own = self.attributes()
        for names, what in (
            (("profile",), "another profile"),
            (("camera_bit_depth",), "another bit depth"),
            (("black_level",), "another black level"),
            (("levels", "code"), "other symbols"),
            (("format", "version"), "another format"),
        ):
            if any(file.attrs.get(name) != own.get(name) for name in names):
                return what
        if self.symbols is None or not pages:
            return ""
        if "symbols" not in file:
            return "unknown symbols"
        try:
            same = all(np.array_equal(file["symbols"][page], self.symbols(page)) for page in range(pages))
        except NoSuchPageError:
            same = False
        return "" if same else "other symbols"


def partial_path(path: Path) -> Path:
    """Return where a recording lies until it is complete and gets its name `path`."""
    return path.with_name(path.name + ".partial")


def settings_path(path: Path) -> Path:
    """Return the file that says what the pages of the unfinished recording `path` are made of."""
    return path.with_name(path.name + ".partial.toml")


def claim(path: Path, settings: str, *, force: bool) -> None:
    """Note what the pages of the recording `path` are made of, until it is complete, unless others are begun there.

    Args:
        path: final name of the recording.
        settings: what its pages are made of, as text.
        force: whether pages of something else may be lost.

    Raises:
        InvalidInputError: there are pages of something else, they are being written, or the note cannot be.
    """
    partial, note = partial_path(path), settings_path(path)
    try:
        begun = note.read_text("utf-8") if note.exists() else None
        if partial.exists() and begun != settings:
            if not force and _pages_begun(partial):
                raise InvalidInputError(
                    f"--out {path}",
                    f"pages begun with other settings ({partial.name})",
                    "the same settings, to go on with them, or --force, to start anew",
                )
            discard_partial(path)
        note.write_text(settings, "utf-8")
    except OSError as error:
        raise os_failure(f"--out {path}", error, "a place that can be written") from None


def drop_claim(path: Path, *, pages: bool = False) -> None:
    """Remove the note of `claim`, and with `pages` the unfinished pages of the recording `path`."""
    if pages:
        discard_partial(path)
    settings_path(path).unlink(missing_ok=True)


def _pages_begun(partial: Path) -> bool:
    """Return whether an unfinished recording has pages that would be lost; what cannot be read may have some."""
    try:
        with retried(lambda: h5py.File(str(partial), "r", locking=False)) as file:
            return pages_of(file) > 0
    except CUT_OFF:
        return True


def pages_there(path: Path, identity: Identity, *, overwrite: bool = False) -> int:
    """Pages of the unfinished recording `path` that `RecordingWriter` would go on from.

    Raises:
        RecordingError: another process is writing them; or they are others, and `overwrite` is not asked for.
    """
    partial = partial_path(path)
    if not taken(partial, remove=False):
        return 0
    try:
        with retried(lambda: h5py.File(str(partial), "r", locking=False)) as file:
            pages = pages_of(file)
            other = identity.difference(file, pages)
    except CUT_OFF as error:
        check_damage(partial, error)
        return 0
    if pages and other and not overwrite:
        raise other_pages(partial, pages, other)
    return 0 if other else pages


def discard_partial(path: Path) -> None:
    """Remove the unfinished pages of the recording `path`, if there are any.

    Raises:
        RecordingError: another process is writing them, or they cannot be removed.
    """
    taken(partial_path(path), remove=True)


def taken(partial: Path, *, remove: bool) -> bool:
    """Return whether `partial` is there, writable and written by nobody else; `remove` unlinks it while that holds.

    HDF5 holds this same lock on a file as long as it is open for writing.

    Raises:
        RecordingError: another process is writing it, or it cannot be read and written.
        StorageError, SurroundingsError: storage fails, or a resource is short.
    """
    subject = f"recording {partial}"
    try:
        with os.fdopen(open_file(partial, make=False), "rb+") as file:
            lock(file.fileno(), subject)
            if remove:
                partial.unlink()
    except FileNotFoundError:
        return False
    except BlockingIOError:
        got = "pages that another process is writing now"
        raise RecordingError(subject, got, "another name, or to wait for its end") from None
    except OSError as error:
        raise os_failure(subject, error, "a file that can be read and written", RecordingError) from None
    return True


def check_damage(partial: Path, error: Exception) -> None:
    """Check that an error says something of an unfinished file, and not that it cannot be read now.

    Raises:
        StorageError, SurroundingsError, RecordingError: it cannot be read.
    """
    if error_number(error) is not None or short_resource("", error):
        expected = "a file that can be read: its pages are not begun anew"
        raise hdf5_failure(f"recording {partial}", error, expected, RecordingError) from None


def pages_of(file: h5py.File) -> int:
    """Pages that are complete; without its count a file was interrupted while it was completed: all of them are."""
    return int(file.attrs.get("pages_complete", file[FRAMES[0]].shape[0]))


def growing(file: h5py.File) -> list[str]:
    """Names of the arrays that grow by one with each page."""
    truth = file.get("truth")
    names = [f"truth/{name}" for name in truth] if isinstance(truth, h5py.Group) else []
    return [name for name in (*FRAMES, "symbols", *SHOT_DATA) if name in file] + names


def other_pages(partial: Path, pages: int, other: str) -> RecordingError:
    """The error of pages that are of something else, and may not be lost."""
    same = "--symbols" if other.endswith("symbols") else other.removeprefix("another ").removeprefix("other ")
    expected = f"the same {same}, another name, or --force"
    return RecordingError(f"recording {partial}", f"{counted(pages, 'page')} of {other}", expected)
