"""Parts that options of several commands share: `--json`, types, and what stands for their values in help."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from functools import wraps
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from lightpage.cli.paths import NewPath, OutputFile, OutputFolder, check_new
from lightpage.device.profile import SHIPPED, Profile, load_profile
from lightpage.errors import InvalidInputError, LightpageError

JSON = click.option(
    "--json", "json_path", type=OutputFile(), help="Write the figures to this file as JSON; - is stdout."
)
"""Option of every command that reports something; the command's argument is `json_path`."""

_NAMED = {
    "--address": "HOST:PORT",
    "--bundle": "BUNDLE",
    "--health-address": "HOST:PORT",
    "--like": "PROFILE",
    "--metrics-host": "HOST",
    "--name": "NAME",
    "--pixel-format": "FORMAT",
    "--profile": "PROFILE",
    "--provider": "PROVIDER",
    "--recording": "RECORDING",
    "--source": "SOURCE",
    "--version": "VERSION",
}
"""Stand-ins for the value of an option of this name, whichever command has it."""


_COMPLETED: dict[str, Sequence[str]] = {
    "--bundle": SHIPPED[:1],
    "--like": SHIPPED,
    "--profile": SHIPPED,
    "--provider": ("cpu", "cuda", "tensorrt"),
    "--source": ("camera:", "recording:", "simulator:"),
    **dict.fromkeys(("--symbols", "--pilots", "--frames", "--in-phase", "--quadrature"), ()),
    **dict.fromkeys(("--references", "--reference-in-phase", "--reference-quadrature"), ()),
}
"""Names that an option of this name takes, beside files but for the provider."""


def new_file(
    told: str, *, required: bool = True, read: Callable[[Path], object] | None = None
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Options of a command that writes a file `out`: `--out`, and `--force`.

    Without that it overwrites none, but for one of its own kind where it is told how to read those.

    Args:
        told: help of `--out`.
        required: whether the command always writes it; else `out` may be None.
        read: reads a file of this kind, or raises a `LightpageError`.
    """

    def with_options(command: Callable[..., Any]) -> Callable[..., Any]:
        @click.option("--out", required=required, type=OutputFile(), help=told)
        @click.option("--force", is_flag=True, help=f"Overwrite a file {'of another kind' if read else 'that exists'}.")
        @wraps(command)
        def checked(*words: Any, out: Path | None, force: bool, **options: Any) -> Any:
            with suppress(LightpageError):
                force = force or (read is not None and out is not None and out.is_file() and read(out) is not None)
            check_new(out, force)
            return command(*words, out=out, **options)

        return checked

    return with_options


class _FileOrName(click.types.StringParamType):
    """A text that is one of some names, or a file.

    Args:
        names: the names.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = names

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return the names that begin so, and whatever files the shell finds where there is none."""
        scheme, colon, path = incomplete.partition(":")
        if f"{scheme}:" in self.names and colon:
            return [CompletionItem(path, type="file")]
        names = [CompletionItem(name) for name in self.names if name.startswith(incomplete)]
        return names if param.opts[0] == "--provider" else [CompletionItem(incomplete, type="file"), *names]


def completed(command: click.Command) -> click.Command:
    """Have a command that a shell asks for offer names and files for options that are texts; it comes back."""
    for each in command.commands.values() if isinstance(command, click.Group) else ():
        completed(each)
    for param in command.params:
        if type(param.type) is click.types.StringParamType and (names := _COMPLETED.get(param.opts[0])) is not None:
            param.type = _FileOrName(names)
    return command


class FiniteRange(click.FloatRange):
    """A number within bounds, and a number: infinity and NaN are within none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


class _NamedPath(click.Path):
    """A path that is named: an empty one would be the working folder."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path.

        Raises:
            InvalidInputError: it is empty.
        """
        if not os.fspath(value):
            what = "a folder" if not self.file_okay else "a path"
            raise InvalidInputError(param.opts[0] if param is not None else "path", "an empty name", what)
        return super().convert(value, param, ctx)


def alike(param: click.Parameter) -> None:
    """Have a parameter of a command show its value as others do, and refuse an empty path."""
    if type(param.type) is click.Path:
        param.type = copy(param.type)
        param.type.__class__ = _NamedPath
    if isinstance(param, click.Option) and not param.is_flag:
        param.metavar = _NAMED.get(param.opts[0]) or param.metavar or _metavar(param.type)


def _metavar(kind: click.ParamType[Any]) -> str | None:
    match kind:
        case click.IntRange() | click.types.IntParamType():
            return "N"
        case click.FloatRange() | click.types.FloatParamType():
            return "X"
        case OutputFile():
            return "FILE"
        case OutputFolder():
            return "FOLDER"
        case NewPath():
            return "PATH"
        case click.Path():
            return "FILE" if kind.file_okay else "FOLDER"
    return None  # choices show themselves


profile_option = click.option(
    "--profile",
    "profile_name",
    metavar="P",
    help="Nominal device: a shipped name or a file.  [default: the recording's own]",
)


def named_profile(name: str | None) -> Profile | None:
    """Return the profile that `profile_option` names; None where it names none."""
    return None if name is None else load_profile(name)
