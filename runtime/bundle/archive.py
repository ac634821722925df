"""Reads the files of a bundle, a flat folder or one zip, into memory, trusting no name, size or link in it."""

from __future__ import annotations

import io
import os
import stat
import struct
import zipfile
import zlib
from pathlib import Path
from typing import IO

from lightpage.errors import BundleError
from runtime.bundle.manifest import MANIFEST

MAX_FILES = 32
"""A bundle has a handful of files; more is something else."""

MAX_BYTES = 1 << 30
"""All files together, unpacked: a full-scale decoder with two float32 reference frames needs about 200 MB."""

_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    OSError,
    NotImplementedError,
    RuntimeError,
    EOFError,
    ValueError,
)
"""What zipfile raises on damaged, encrypted or exotic archives."""


def read_files(path: Path, max_bytes: int = MAX_BYTES, content: bytes | None = None) -> dict[str, bytes]:
    """All files of the folder or zip at `path`, by their plain names.

    Args:
        path: a folder or a zip file.
        max_bytes: most bytes taken into memory.
        content: of the zip, where it has been read.

    Raises:
        BundleError: nothing there, not a zip, a name that is a path, a link, a folder inside, or too much data.
    """
    if content is not None:
        return _read_zip(path, max_bytes, io.BytesIO(content))
    if path.is_dir():
        return _read_folder(path, max_bytes)
    if not path.is_file():
        raise BundleError(f"bundle {path}", "nothing", "a folder or a zip file")
    return _read_zip(path, max_bytes, path)


def check_name(name: str, subject: str) -> None:
    """Refuse a name that could lead out of a bundle.

    Raises:
        BundleError: empty, with a separator, a drive or a NUL, or hidden.
    """
    if not name or name.startswith(".") or any(mark in name for mark in "/\\:\0"):
        raise BundleError(f"{subject}: file name", repr(name), "a plain file name without a path")


def _read_folder(path: Path, max_bytes: int) -> dict[str, bytes]:
    subject = f"bundle {path}"
    names = sorted(os.listdir(path))
    if MANIFEST not in names:
        raise BundleError(subject, f"a folder without {MANIFEST}", "a bundle: a folder that has one, or a zip file")
    _check_count(len(names), subject)
    files: dict[str, bytes] = {}
    left = max_bytes
    for name in names:
        check_name(name, subject)
        try:
            # O_NOFOLLOW: a link is refused by the kernel, with no gap between a check and the use.
            descriptor = os.open(path / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            with os.fdopen(descriptor, "rb") as file:
                if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                    raise BundleError(f"{subject}: {name}", "no plain file", "a plain file")
                files[name] = file.read(left + 1)
        except OSError as error:
            raise BundleError(f"{subject}: {name}", error, "a readable plain file, no link or folder") from None
        left -= len(files[name])
        _check_left(left, max_bytes, subject)
    return files


def _read_zip(path: Path, max_bytes: int, source: Path | IO[bytes]) -> dict[str, bytes]:
    subject = f"bundle {path}"
    files: dict[str, bytes] = {}
    left = max_bytes
    try:
        with zipfile.ZipFile(source) as archive:
            entries = archive.infolist()
            _check_count(len(entries), subject)
            for entry in entries:
                # filename is cut at a NUL and made portable by zipfile; orig_filename is what was written.
                check_name(entry.orig_filename, subject)
                check_name(entry.filename, subject)
                if entry.filename in files:
                    raise BundleError(f"{subject}: {entry.filename}", "the same name twice", "one file of each name")
                kind = stat.S_IFMT(entry.external_attr >> 16)
                if kind not in (0, stat.S_IFREG):
                    raise BundleError(f"{subject}: {entry.filename}", "a link or special file", "a plain file")
                # The size in the header may lie: read at most what is left, whatever it says.
                with archive.open(entry) as file:
                    files[entry.filename] = file.read(left + 1)
                left -= len(files[entry.filename])
                _check_left(left, max_bytes, subject)
    except _DAMAGE as error:
        raise BundleError(subject, error, "a sound zip file") from None
    return files


def _check_count(count: int, subject: str) -> None:
    if count > MAX_FILES:
        raise BundleError(subject, f"{count} files", f"at most {MAX_FILES}")


def _check_left(left: int, max_bytes: int, subject: str) -> None:
    if left < 0:
        raise BundleError(subject, f"more than {max_bytes} bytes unpacked", f"at most {max_bytes}")
