"""Options that name files and folders to write, known before the work begins to be ones that can be written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from lightpage.errors import InvalidInputError
from lightpage.failures import os_failure
from lightpage.files import STDOUT, is_special, new_file

if TYPE_CHECKING:
    _PathType = click.ParamType[Path]
else:
    _PathType = click.ParamType  # earlier versions of click have no type behind it


class _Completed(_PathType):
    """An option whose value a shell completes as it does files."""

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType.shell_complete`."""
        return [CompletionItem(incomplete, type="file")]


class NewPath(_Completed):
    """An option that names a new file or folder: known before the work begins to be one that can be made."""

    name = "path"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path.

        Raises:
            InvalidInputError: it is there, or its folder cannot be written.
        """
        path = _file(value, param)
        with _told(path, param):
            if path.exists() or path.is_symlink():
                raise InvalidInputError(_option(path, param), "something that exists", "a new path")
            folder = path.absolute().parent
            while not folder.exists():
                folder = folder.parent
            _check_writable(folder, path)
        return path


class OutputFile(_Completed):
    """An option that names a file to write: known before the work begins to be one that `replace_text` can write.

    `--json` may name `STDOUT`.
    """

    name = "file"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path.

        Raises:
            InvalidInputError: it is a folder, or its folder is missing or cannot be written.
        """
        path = _file(value, param)
        if path == STDOUT:
            return path
        with _told(path, param):
            if path.is_dir():
                raise InvalidInputError(_option(path, param), "a folder", "a file")
            _check_writable(path.absolute().parent, path)
        return path


class OutputFolder(_Completed):
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
        with _told(path, param):
            if path.exists() and not path.is_dir():
                raise InvalidInputError(_option(path, param), "a file", "a folder")
        return path


def writes_to_stdout(context: click.Context) -> bool:
    """Return whether an option of a command names `STDOUT` for writing."""
    outputs = (param.name or "" for param in context.command.params if isinstance(param.type, OutputFile))
    return any(context.params.get(name) == STDOUT for name in outputs)


def check_new(out: Path | None, force: bool) -> None:
    """Check that `--out` overwrites nothing unasked.

    Raises:
        InvalidInputError: there is a file, and no `--force`.
    """
    if out is not None and not force and out.exists() and not is_special(out):
        raise InvalidInputError(f"--out {out}", "a file that exists", "a new name, or --force")


def check_outputs(context: click.Context) -> None:
    """Check that no option of a command names for writing what another one names.

    Raises:
        InvalidInputError: the same file is to be read and written, or written twice.
    """
    given = [(param, context.params.get(param.name or "")) for param in context.command.params]
    paths = [(param, path) for param, value in given if (path := _named_file(param, value)) is not None]
    for param, path in paths:
        for other, there in paths:
            if param is other or not isinstance(param.type, NewPath | OutputFile):
                continue
            if path.resolve() == there.resolve() and path != STDOUT:
                named = other.opts[0] if isinstance(other, click.Option) else other.make_metavar(context)
                raise InvalidInputError(_option(path, param), f"the same file as {named}", "another name")


def _named_file(param: click.Parameter, value: object) -> Path | None:
    """Return the file that the value of an option names; a bare text names one where there is a file of that name."""
    if isinstance(value, Path):
        return value
    text = isinstance(value, str) and not isinstance(param.type, click.Choice) and os.path.exists(value)
    return Path(str(value)) if text else None


def _file(value: Any, param: click.Parameter | None) -> Path:
    """The path that an option names; stdout for `--json` alone.

    Raises:
        InvalidInputError: `-` for another option, which would be a file of that name.
    """
    path = Path(value)
    if str(value) == str(STDOUT) and param is not None and param.opts[0] != "--json":
        raise InvalidInputError(f"{param.opts[0]} -", "stdout", "a file (./- for one of that name)")
    return path


def _option(path: Path, param: click.Parameter | None) -> str:
    return f"{param.opts[0]} {path}" if param is not None else str(path)


@contextmanager
def _told(path: Path, param: click.Parameter | None) -> Iterator[None]:
    """Name the option in failures of the system, e.g. of a name that is too long."""
    try:
        yield
    except OSError as error:
        raise os_failure(_option(path, param), error, "a path that can be written") from None


def _check_writable(folder: Path, path: Path) -> None:
    """Check that a file can be made in `folder`, and be called as `path` is.

    Raises:
        OSError: it cannot.
    """
    if is_special(path):
        return
    descriptor, made = new_file(folder, path.name)
    os.close(descriptor)
    made.unlink()
