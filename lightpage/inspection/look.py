"""Says what a file is by its first bytes, and has it looked at; trusts neither its name nor its content."""

from __future__ import annotations

import os
import stat
import zipfile
from contextlib import suppress
from pathlib import Path

from lightpage.device.profile import Profile
from lightpage.errors import BundleError, InvalidInputError
from lightpage.foreign.array import SEPARATOR, readable
from lightpage.foreign.opening import names_array
from lightpage.inspection.documents import MOST_BYTES, look_at_json, look_at_toml
from lightpage.inspection.finding import Finding
from lightpage.inspection.folders import look_at_bundle, look_at_folder
from lightpage.inspection.foreign_files import look_at_archive, look_at_array, look_at_mat
from lightpage.inspection.recordings import look_at as look_at_recording
from lightpage.runtime.model.bundle.manifest import MANIFEST
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.words import counted

_HEAD = 4096
_HDF5 = b"\x89HDF\r\n\x1a\n"
_PLACES = (0, 512, 1024, 2048)
"""Offsets at which an HDF5 file may begin, behind a block of a user's."""
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_KNOWN = "a recording, pages, a bundle, a run, a calibration, a profile, or frames of another program"
_LOOKING = ("lightpage profile check ", "lightpage report ")
"""Beginnings of commands that are of use for what is wrong too."""
_SPECIAL = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def look(path: Path, profile: Profile | None = None) -> Finding:
    """Return what a file or a folder is.

    Args:
        path: of it.
        profile: that it is to fit; its own where it has one if left out.

    Raises:
        InvalidInputError: it is not there, cannot be read, or is nothing that is known here.
        StorageError, SurroundingsError: storage fails, or a resource is short.
    """
    found = _look(path, profile)
    if found.problems:  # what is refused here is refused there
        found.next = [command for command in found.next if command.startswith(_LOOKING)]
    return found


def _look(path: Path, profile: Profile | None) -> Finding:
    subject = f"file {path}"
    if names_array(str(path)):
        return look_at_array(path, "array of a file" if SEPARATOR in str(path) else "pictures", profile)
    with readable(subject, "a file that can be read, or the name of a shipped bundle"):
        if not os.path.lexists(path):
            with suppress(BundleError):
                path = bundle_path(str(path))
        status = os.stat(path)
        if stat.S_ISDIR(status.st_mode):
            return look_at_folder(path, profile)
        if not stat.S_ISREG(status.st_mode):
            raise InvalidInputError(subject, _SPECIAL.get(stat.S_IFMT(status.st_mode), "no file"), "a file or a folder")
        if not status.st_size:
            raise InvalidInputError(subject, "an empty file", _KNOWN)
        with path.open("rb") as file:
            head = file.read(_HEAD)
        return _by_content(path, head, status.st_size, profile)


def _by_content(path: Path, head: bytes, size: int, profile: Profile | None) -> Finding:
    if head.startswith(b"MATLAB") or path.suffix.lower() == ".mat":
        return look_at_mat(path, profile)
    if any(head[place:].startswith(_HDF5) for place in _PLACES):
        return look_at_recording(path, profile)
    if head.startswith(b"PK"):
        return _zip(path, profile)
    if head.startswith(b"\x93NUMPY"):
        return _named(path, (".npy",), "array of NumPy", profile)
    if head.startswith(_TIFF):
        return _named(path, (".tif", ".tiff"), "TIFF", profile)
    if head.startswith((b"\x89PNG", b"BM", b"P5")):
        return _named(path, (".png", ".bmp", ".pgm"), "picture", profile)
    return _text(path, head, size, profile)


def _named(path: Path, suffixes: tuple[str, ...], kind: str, profile: Profile | None) -> Finding:
    """Look at a file that must have a name by which `import` knows it."""
    if path.suffix.lower() in suffixes:
        return look_at_array(path, kind, profile)
    found = Finding(path, kind)
    found.problems.append(f"its name ends with '{path.suffix}', and import knows it by {' or '.join(suffixes)}")
    return found


def _zip(path: Path, profile: Profile | None) -> Finding:
    with readable(f"file {path}", "a zip that is whole"), zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    if any(name.rpartition("/")[2] == MANIFEST for name in names):
        return look_at_bundle(path)
    if names and all(name.endswith(".npy") for name in names):
        return look_at_archive(path, profile)
    told = ", ".join(names[:8]) or "nothing"
    raise InvalidInputError(
        f"file {path}", f"a zip of {counted(len(names), 'file')}: {told}", f"a bundle, with its {MANIFEST}"
    )


def _text(path: Path, head: bytes, size: int, profile: Profile | None) -> Finding:
    subject = f"file {path}"
    if b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InvalidInputError(subject, f"bytes that begin with {head[:8].hex(' ')}", _KNOWN)
    if size > MOST_BYTES:
        raise InvalidInputError(subject, f"a text of {size / 1e6:.0f} MB", _KNOWN)
    if head.lstrip().startswith(b"{") or path.suffix.lower() == ".json":
        return look_at_json(path)
    return look_at_toml(path, profile)
