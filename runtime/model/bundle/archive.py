"""Reads the files of a bundle, a flat folder or one zip, into memory, trusting no name, size or link in it."""

import io
import os
import stat
import struct
import zipfile
import zlib
from pathlib import Path
from typing import IO

from lightpage.errors import BundleError
from lightpage.failures import os_errors, os_failure
from lightpage.runtime.model.bundle.manifest import MANIFEST
from lightpage.runtime.model.bundle.signature_file import read_plain_file

MAX_FILES = 32
"""A bundle has a handful of files; more is something else."""

MAX_BYTES = 1 << 30
"""All files together, unpacked: a full-scale decoder with two float32 reference frames needs about 200 MB."""

_LITTER = {
    "__macosx",
    "icon\r",
    "thumbs.db",
    "desktop.ini",
    "$recycle.bin",
    "system volume information",
    "@eadir",
    "lost+found",
}
"""Names that systems put beside files, in lower case; names that begin with a dot are litter too."""

_MAX_LITTER = 4 * MAX_FILES

_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, NotImplementedError, RuntimeError, EOFError, ValueError)
"""What zipfile raises on damaged, encrypted or exotic archives."""


def read_files(path: Path, content: bytes | None = None) -> dict[str, bytes]:
    """All files of the folder or zip at `path`, by their plain names.

    Args:
        path: a folder or a zip file.
        content: content of the zip, where it has been read.

    Raises:
        BundleError: nothing there, not a zip, a name that is a path, a link, a folder inside, or too much data.
    """
    if content is not None:
        return _read_zip(path, io.BytesIO(content))
    expected = "a folder or a zip file"
    with os_errors(f"bundle {path}", expected, BundleError):
        if path.is_dir():
            return _read_folder(path)
        if path.is_file():
            return _read_zip(path, path)
    raise BundleError(f"bundle {path}", "no such file", expected)


def check_name(name: str, subject: str) -> None:
    """Refuse a name that could lead out of a bundle.

    Raises:
        BundleError: empty, with a separator, a drive or a NUL, or hidden.
    """
    if not name or name.startswith(".") or any(mark in name for mark in "/\\:\0"):
        raise BundleError(f"{subject}: file name", repr(name), "a plain file name without a path")


def is_litter(name: str) -> bool:
    """Return whether systems put such a name beside files, e.g. `.DS_Store`, or `..data` of a mounted ConfigMap."""
    hidden = name.startswith(".") and name not in (".", "..") and not any(mark in name for mark in "\\:\0")
    return hidden or name.lower() in _LITTER


def _read_folder(path: Path) -> dict[str, bytes]:
    subject, real = f"bundle {path}", os.path.realpath(path)
    there = sorted(os.listdir(path))
    _check_count(len(there), subject, _MAX_LITTER)
    names = [name for name in there if not is_litter(name)]
    if MANIFEST not in names:
        raise BundleError(subject, f"a folder without {MANIFEST}", "a bundle: a folder that has one, or a zip file")
    _check_count(len(names), subject)
    files: dict[str, bytes] = {}
    left = MAX_BYTES
    for name in names:
        check_name(name, subject)
        with os_errors(f"{subject}: {name}", "a readable plain file, no link or folder", BundleError):
            # Kubernetes mounts files as links into a hidden folder beside them. Any other link is refused by the
            # kernel, with no gap between a check and the use.
            target = os.path.realpath(path / name)
            inside = os.path.dirname(os.path.dirname(target)) == real and is_litter(Path(target).parent.name)
            files[name] = read_plain_file(target if inside else path / name, left + 1, f"{subject}: {name}")
        left -= len(files[name])
        _check_left(left, subject)
    return files


def _read_zip(path: Path, source: Path | IO[bytes]) -> dict[str, bytes]:
    subject = f"bundle {path}"
    files: dict[str, bytes] = {}
    left = MAX_BYTES
    try:
        with zipfile.ZipFile(source) as archive:
            entries = archive.infolist()
            _check_count(len(entries), subject, _MAX_LITTER)
            # orig_filename is what was written; zipfile cuts filename at a NUL and makes it portable.
            entries = [entry for entry in entries if not any(map(is_litter, entry.orig_filename.split("/")))]
            top = _top_folder([entry.orig_filename for entry in entries])
            entries = [entry for entry in entries if entry.orig_filename != top]
            _check_count(len(entries), subject, MAX_FILES)
            for entry in entries:
                name = entry.filename.removeprefix(top)
                check_name(entry.orig_filename.removeprefix(top), subject)
                check_name(name, subject)
                if name in files:
                    raise BundleError(f"{subject}: {name}", "the same name twice", "one file of each name")
                kind = stat.S_IFMT(entry.external_attr >> 16)
                if kind not in (0, stat.S_IFREG):
                    raise BundleError(f"{subject}: {entry.filename}", "a link or special file", "a plain file")
                # The size in the header may lie: read at most what is left, whatever it says.
                with archive.open(entry) as file:
                    files[name] = file.read(left + 1)
                left -= len(files[name])
                _check_left(left, subject)
    except OSError as error:
        raise os_failure(subject, error, "a sound zip file", BundleError) from None
    except _DAMAGE as error:
        raise BundleError(subject, error, "a sound zip file") from None
    return files


def _top_folder(names: list[str]) -> str:
    """The folder, with a slash, that holds a bundle packed with its folder; empty where there is none."""
    top = next((name.partition("/")[0] + "/" for name in names if name.endswith(f"/{MANIFEST}")), "")
    whole = MANIFEST not in names and all(name.startswith(top) for name in names)
    return top if whole and not top.startswith("/") else ""


def _check_count(count: int, subject: str, most: int = MAX_FILES) -> None:
    if count > most:
        raise BundleError(subject, f"{count} files", f"at most {most}")


def _check_left(left: int, subject: str) -> None:
    if left < 0:
        raise BundleError(subject, f"more than {MAX_BYTES} bytes unpacked", f"at most {MAX_BYTES}")
