"""Files that are there whole or not at all."""

from __future__ import annotations

import errno
import json
import math
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from lightpage.errors import InvalidInputError


def replace_file(path: str | Path, write: Callable[[IO[bytes]], object], subject: str = "file") -> None:
    """Have `write` fill a file, and replace what is at `path` by it in one step.

    Content and name are on the disk when this returns: a power cut leaves the earlier file or the new one, whole.

    Args:
        path: final name, in a folder that exists.
        write: writes the content.
        subject: what the file is, for the error message.

    Raises:
        InvalidInputError: the path cannot be written.
    """
    path = Path(path)
    try:
        descriptor, name = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
        try:
            with os.fdopen(descriptor, "wb") as file:
                write(file)
                os.fchmod(file.fileno(), 0o644)
            move_into_place(name, path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InvalidInputError(f"{subject} {path}", error, "a path that can be written") from None


def move_into_place(made: str | Path, path: Path) -> None:
    """Give a file that is closed its final name, replacing what has it; both are on the disk when this returns.

    Raises:
        OSError: the system does not let it.
    """
    with open(made, "rb") as file:
        os.fsync(file.fileno())
    os.replace(made, path)
    sync_folder(path.parent)


def move_to_new_name(made: str | Path, path: Path) -> None:
    """The same where nothing has the final name.

    Raises:
        FileExistsError: something has it; both files stay as they are.
        OSError: the system does not let it.
    """
    with open(made, "rb") as file:
        os.fsync(file.fileno())
    try:
        os.link(made, path)  # in one step, unlike a look whether it is there
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
        os.replace(made, path)
    else:
        os.unlink(made)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Write the names in `folder` to the disk where its file system can; the files themselves are whole without."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def replace_text(path: str | Path, text: str, subject: str = "file") -> None:
    """Write `text` to `path` as UTF-8, replacing what is there in one step; see `replace_file`."""
    replace_file(path, lambda file: file.write(text.encode()), subject)


def write_json(path: str | Path, data: Any) -> None:
    """Write `data` to `path` as JSON, null for what is not a number, replacing what is there in one step.

    Raises:
        InvalidInputError: the path cannot be written.
    """
    replace_text(path, json.dumps(_plain(data), indent=2, allow_nan=False) + "\n", "JSON file")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
