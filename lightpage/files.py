"""Files that are there whole or not at all."""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import click

from lightpage.errors import InvalidInputError


def replace_file(path: str | Path, write: Callable[[IO[bytes]], object], thing: str = "file") -> None:
    """Have `write` fill a file, and replace what is at `path` by it in one step.

    Content and name are on the disk when this returns: a power cut leaves the earlier file or the new one, whole.

    Args:
        path: final name, in a folder that exists.
        write: writes the content.
        thing: what the file is, for the error message.

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
        raise InvalidInputError(f"{thing} {path}", error, "a path that can be written") from None


def move_into_place(made: str | Path, path: Path) -> None:
    """Give a file that is closed its final name, replacing what has it; both are on the disk when this returns.

    Raises:
        OSError: the system does not let it.
    """
    with open(made, "rb") as file:
        os.fsync(file.fileno())
    os.replace(made, path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Write the names in `folder` to the disk where its file system can; the files themselves are whole without."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def replace_text(path: str | Path, text: str, thing: str = "file") -> None:
    """Write `text` to `path` as UTF-8, replacing what is there in one step; see `replace_file`."""
    replace_file(path, lambda file: file.write(text.encode()), thing)


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


class NewPath(click.ParamType[Path]):
    """An option that names a new file or folder: known before the work begins to be one that can be made."""

    name = "path"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path.

        Raises:
            InvalidInputError: its folder cannot be written.
        """
        path = Path(value)
        folder = path.absolute().parent
        while not folder.exists():
            folder = folder.parent
        _check_writable(folder, path, param)
        return path


class OutputFile(click.ParamType[Path]):
    """An option that names a file to write: known before the work begins to be one that `replace_text` can write."""

    name = "file"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path.

        Raises:
            InvalidInputError: it is a folder, or its folder is missing or cannot be written.
        """
        path = Path(value)
        if path.is_dir():
            raise InvalidInputError(_option(path, param), "a folder", "a file")
        _check_writable(path.absolute().parent, path, param)
        return path


class OutputFolder(click.ParamType[Path]):
    """An option that names the folder that a command works in, there or yet to be made."""

    name = "folder"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path.

        Raises:
            InvalidInputError: it is empty, or something else than a folder.
        """
        path = Path(value)
        if not str(value):
            raise InvalidInputError(param.opts[0] if param is not None else "path", "an empty name", "a folder")
        if path.exists() and not path.is_dir():
            raise InvalidInputError(_option(path, param), "a file", "a folder")
        return path


def check_outputs(context: click.Context) -> None:
    """Check that no option of a command names for writing what another one names.

    Raises:
        InvalidInputError: the same file is to be read and written, or written twice.
    """
    given = [(param, context.params.get(param.name or "")) for param in context.command.params]
    paths = [(param, Path(value)) for param, value in given if isinstance(value, str | Path) and str(value)]
    for param, path in paths:
        for other, there in paths:
            if param is other or not isinstance(param.type, NewPath | OutputFile):
                continue
            if path.resolve() == there.resolve():
                named = other.opts[0] if isinstance(other, click.Option) else other.make_metavar(context)
                raise InvalidInputError(_option(path, param), f"what {named} names", "a file of its own")


def _option(path: Path, param: click.Parameter | None) -> str:
    return f"{param.opts[0]} {path}" if param is not None else str(path)


def _check_writable(folder: Path, path: Path, param: click.Parameter | None) -> None:
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InvalidInputError(_option(path, param), error, "a path that can be written") from None
