"""Files that are there whole or not at all, on file systems that may lack modes, locks, links or synchronisation."""

from __future__ import annotations

import codecs
import errno
import glob
import json
import math
import os
import secrets
import shutil
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import IO, Any, TextIO

from lightpage.errors import InvalidInputError, LightpageError
from lightpage.failures import os_failure
from lightpage.progress import warn
from lightpage.systems import open_file, try_lock

STDOUT = Path("-")
"""Name that users write for stdout in place of a JSON file, and for stdin in place of a file to read."""

_results: ContextVar[TextIO | None] = ContextVar("results", default=None)

_NAME_BYTES = 255
"""Longest name of a file on the file systems of Linux."""

_LACKING = frozenset({errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL, errno.EPERM})
"""Error numbers of a file system that lacks what was asked of it, e.g. locks or synchronisation."""

WITHOUT_LOCKS = set[int]()
"""Devices that have no locks, of which a warning was given."""

_ENCODINGS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # which begins as the next one does
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
    (codecs.BOM_UTF32_BE, "utf-32"),
)


_BINARY = {
    b"\x89HDF": "an HDF5 file",
    b"PK": "a zip file",
    b"\x93NUMPY": "an array of NumPy",
    b"\x89PNG": "a picture",
    b"II*\0": "a TIFF",
    b"MM\0*": "a TIFF",
}
"""Kinds of files that are no text, by their first bytes."""


def new_file(folder: Path, name: str) -> tuple[int, Path]:
    """Make an empty file of a new name in `folder`, with the modes that the process's umask leaves.

    Args:
        folder: folder of the file.
        name: beginning of the new name, behind a dot; it is cut where the whole would be too long.

    Returns:
        A descriptor that is open for reading and writing, and the path.

    Raises:
        OSError: the system does not let it.
    """
    while True:
        end = f"-{secrets.token_hex(6)}"
        begin = os.fsencode(f".{name}")[: _NAME_BYTES - len(end)]
        path = folder / (os.fsdecode(begin).encode("utf-8", "surrogateescape").decode("utf-8", "ignore") + end)
        with suppress(FileExistsError):
            return open_file(path, new=True), path


def lock(descriptor: int, subject: str, *, shared: bool = False, ranges: bool = False) -> bool:
    """Lock a file until its descriptor is closed; where its file system has no locks, warn once and go without.

    Args:
        descriptor: descriptor of the file.
        subject: name of the file, for the warning.
        shared: whether others may have it locked so too.
        ranges: whether with a lock of the kind that ranges of bytes have, which some file systems lack alone.

    Returns:
        Whether the file is locked.

    Raises:
        BlockingIOError: another process has it locked.
        OSError: storage fails.
    """
    try:
        try_lock(descriptor, shared=shared, ranges=ranges)
    except BlockingIOError:
        raise
    except OSError as error:
        if error.errno not in _LACKING:
            raise
        if (device := os.fstat(descriptor).st_dev) not in WITHOUT_LOCKS:
            WITHOUT_LOCKS.add(device)
            warn(f"{subject}: no lock ({error.strerror}); see to it that no other process writes on this file system")
        return False
    return True


def replace_file(path: str | Path, write: Callable[[IO[bytes]], object], subject: str = "file") -> None:
    """Have `write` fill a file, and replace what is at `path` by it in one step.

    Content and name are on the disk when this returns: a power cut leaves the earlier file or the new one, whole. What
    is at `path` and is no file, e.g. ``/dev/null``, is written to.

    Args:
        path: final name, in a folder that exists.
        write: writes the content.
        subject: name of the file, for the error message.

    Raises:
        InvalidInputError: the path cannot be written.
        StorageError, SurroundingsError: storage fails, or has no room.
    """
    path = Path(path)
    try:
        if is_special(path):
            with path.open("wb") as special:
                write(special)
            return
        descriptor, made = new_file(path.parent, path.name)
        try:
            with os.fdopen(descriptor, "wb") as file:
                write(file)
            try:
                move_into_place(made, path)
            except OSError as error:
                if error.errno != errno.EBUSY:
                    raise
                shutil.copyfile(made, path)  # a file that is mounted by itself, as into a container, cannot be replaced
                made.unlink()
        except BaseException:
            made.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise os_failure(f"{subject} {path}", error, "a path that can be written") from None


def is_special(path: Path) -> bool:
    """Return whether `path` is a device, a pipe or a socket, which is written to and not replaced.

    Raises:
        OSError: the system does not say, e.g. since the name is too long.
    """
    return path.exists() and not path.is_file() and not path.is_dir()


def move_into_place(made: str | Path, path: Path) -> None:
    """Give a file that is closed its final name, replacing what has it; both are on the disk when this returns.

    Raises:
        OSError: the system does not let it.
    """
    with open(made, "r+b") as file:  # shares synchronise only what is open for writing
        synchronise(file.fileno())
    os.replace(made, path)
    sync_folder(path.parent)


def move_to_new_name(made: str | Path, path: Path) -> None:
    """Give a file that is closed its final name, which nothing may have; both are on the disk when this returns.

    Raises:
        FileExistsError: something has it; both files stay as they are.
        OSError: the system does not let it.
    """
    give_new_name(made, path)
    Path(made).unlink(missing_ok=True)
    sync_folder(path.parent)


def give_new_name(made: str | Path, path: Path) -> None:
    """Give a file its final name beside that which it has, and which it loses where the file system has no links.

    It raises what `move_to_new_name` does. The names are on the disk once `sync_folder` has been called.
    """
    with open(made, "r+b") as file:
        synchronise(file.fileno())
    try:
        os.link(made, path)  # in one step, unlike a look whether it is there
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
        os.replace(made, path)


def synchronise(descriptor: int) -> None:
    """Write a file to the disk, where its file system can.

    Raises:
        OSError: the disk does not take it.
    """
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _LACKING:
            raise


def reserve(path: Path) -> None:
    """Have room on the disk for all of a file, where its file system can.

    Whoever writes to a hole of a file that is mapped into memory, on a disk that is full, is killed.

    Raises:
        OSError: there is no room.
    """
    with path.open("r+b") as file:
        try:
            if not hasattr(os, "posix_fallocate"):  # Windows keeps room for all of a file, macOS for none
                return
            os.posix_fallocate(file.fileno(), 0, os.fstat(file.fileno()).st_size)
        except OSError as error:
            if error.errno not in _LACKING:
                raise


def sync_folder(folder: Path) -> None:
    """Write the names in `folder` to the disk where its file system can; the files themselves are whole without."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_text(path: str | Path, subject: str, expected: str, failure: type[LightpageError] = InvalidInputError) -> str:
    """The text of a file in UTF-8, or in UTF-16 or UTF-32 with a byte order mark; its lines end with LF alone.

    Args:
        path: path of the file.
        subject: name of the file, for an error.
        expected: file that would be right, for an error.
        failure: class of the error.

    Raises:
        LightpageError: of class `failure`, where the file cannot be read or is in another encoding.
        StorageError, SurroundingsError: storage fails, or a resource is short.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise os_failure(subject, error, expected, failure) from None
    except ValueError as error:  # a null in the name
        raise failure(subject, error, expected) from None
    encoding = next((encoding for mark, encoding in _ENCODINGS if data.startswith(mark)), "utf-8")
    try:
        return data.decode(encoding).replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        line, column = data.count(b"\n", 0, error.start) + 1, error.start - data.rfind(b"\n", 0, error.start)
        if known := next((kind for start, kind in _BINARY.items() if data.startswith(start)), None):
            got = f"{known}: `lightpage inspect` says what is in it"
        elif b"\0" in data[:64]:
            got = "zero bytes, as in UTF-16 without a byte order mark"
        else:
            got = f"byte 0x{data[error.start]:02x} in line {line}, column {column}, which is no {encoding.upper()}"
        raise failure(subject, got, f"{expected}, in UTF-8") from None


def read_toml(path: str | Path, subject: str, expected: str) -> dict[str, Any]:
    """Read a TOML file into a dictionary.

    Raises:
        InvalidInputError, StorageError, SurroundingsError: it cannot be read, or is no TOML.
    """
    try:
        return tomllib.loads(read_text(path, subject, expected))
    except tomllib.TOMLDecodeError as error:
        raise InvalidInputError(subject, error, expected) from None


def matching(pattern: str) -> list[str]:
    """Names that a pattern matches, sorted; what exists under exactly that name, or a folder on its way, is no pattern.

    Names come as they do from `glob.glob`; there are none where nothing matches.
    """
    path = Path(pattern)
    there = next((part for part in (path, *path.parents) if os.path.lexists(part)), Path())
    if there == path:
        return [pattern]
    return sorted(glob.glob(os.path.join(glob.escape(str(there)), path.relative_to(there)), recursive=True))


def check_utf8(path: str | Path, subject: str) -> None:
    """Check that a path is text, which JSON and messages between processes can hold.

    Raises:
        InvalidInputError: its bytes are not UTF-8.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        told = ascii(os.fsencode(path))[2:-1]
        raise InvalidInputError(subject, f"the name {told}, which is not UTF-8", "another name, or a link") from None


def replace_text(path: str | Path, text: str, subject: str = "file") -> None:
    """Write `text` to `path` as UTF-8, replacing what is there in one step; see `replace_file`.

    Bytes of a name that are no text are escaped.
    """
    replace_file(path, lambda file: file.write(text.encode(errors="backslashreplace")), subject)


@contextmanager
def results_on_stdout() -> Iterator[None]:
    """Keep stdout for `write_json` while the `with` statement lasts; all else that is printed goes to stderr."""
    token = _results.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _results.reset(token)


def write_json(path: str | Path | None, data: Any) -> None:
    """Write `data` to `path` as JSON, null for what is not a number, replacing what is there in one step.

    Args:
        path: path of the file, or `STDOUT`; None where nobody wants it.
        data: value that JSON can hold.

    Raises:
        InvalidInputError: the path cannot be written.
    """
    if path is None:
        return
    text = json.dumps(_plain(data), indent=2, allow_nan=False) + "\n"
    if Path(path) == STDOUT:
        print(text, end="", file=_results.get() or sys.stdout, flush=True)
    else:
        replace_text(path, text, "JSON file")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
