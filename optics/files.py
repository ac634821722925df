"""Files that are there whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import click

from optics.errors import InvalidInputError


def replace_text(path: str | Path, text: str, thing: str = "file") -> None:
    """Write `text` to `path` as UTF-8, replacing what is there in one step.

    Args:
        path: final name, in a folder that exists.
        text: the content.
        thing: what the file is, for the error message.

    Raises:
        InvalidInputError: the path cannot be written.
    """
    path = Path(path)
    try:
        descriptor, name = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
        try:
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                file.write(text)
            os.chmod(name, 0o644)
            os.replace(name, path)
        except BaseException:
            os.unlink(name)
            raise
    except OSError as error:
        raise InvalidInputError(f"{thing} {path}", error, "a path that can be written") from None


class OutputFile(click.ParamType[Path]):
    """An option that names a file to write: known before the work begins to be one that `replace_text` can write."""

    name = "file"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path.

        Raises:
            InvalidInputError: it is a folder, or its folder is missing or cannot be written.
        """
        path = Path(value)
        thing = f"{param.opts[0]} {path}" if param is not None else str(path)
        if path.is_dir():
            raise InvalidInputError(thing, "a folder", "a file")
        try:
            tempfile.TemporaryFile(dir=path.absolute().parent).close()
        except OSError as error:
            raise InvalidInputError(thing, error, "a path that can be written") from None
        return path
