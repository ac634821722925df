"""Errors of a command line that click refuses, in the words of all other errors."""

from __future__ import annotations

import re
from difflib import get_close_matches

import click

from lightpage.errors import InvalidInputError, lowered

_NO_COMMAND = "No such command "
_EXTRA = re.compile(r"Got unexpected extra arguments? \((.*)\)")
_FILE = re.compile(r"(File|Directory|Path) '(.*)' (does not exist|is a file|is a directory|is not \w+)")
_FILES = {"does not exist": "nothing of this name", "is a file": "a file", "is a directory": "a folder"}
_WANTED = {"file": "a file", "directory": "a folder", "path": "a file or a folder"}


def misused(error: click.UsageError) -> InvalidInputError:
    """Return the error that names what came and what was wanted, in place of click's."""
    path = "lightpage" if error.ctx is None else error.ctx.command_path
    told = f"what {path} --help says"
    if isinstance(error, click.NoSuchOption):
        return InvalidInputError(path, f"option {error.option_name}", " or ".join(error.possibilities or [told]))
    if isinstance(error, click.BadParameter) and error.param is not None:
        return _of_parameter(path, told, error, error.param)
    message = error.message.rstrip(".")
    if error.ctx is not None and isinstance(error.ctx.command, click.Group) and message.startswith(_NO_COMMAND):
        name = message.removeprefix(_NO_COMMAND).split(".")[0].strip("'")
        close = get_close_matches(name, error.ctx.command.list_commands(error.ctx))
        return InvalidInputError(path, f"command {name}", " or ".join(close or [told]))
    if extra := _EXTRA.fullmatch(message):
        return InvalidInputError(path, f"one argument too many: {extra[1]}", told)
    return InvalidInputError(path, lowered(message), told)


def _of_parameter(path: str, told: str, error: click.BadParameter, param: click.Parameter) -> InvalidInputError:
    metavar = "" if error.ctx is None else param.make_metavar(error.ctx)
    name = param.opts[0] if isinstance(param, click.Option) else metavar
    if name == metavar and isinstance(param.type, click.Choice):  # of which all choices are told anyway
        name = (param.name or "").upper()
    if isinstance(error, click.MissingParameter):
        return InvalidInputError(path, f"no {name}", f"{name} {metavar}" if name != metavar else "one")
    if file := _FILE.match(error.message):
        kind, value, problem = file.groups()
        got = _FILES.get(problem) or f"one that {problem}"
        return InvalidInputError(f"{path} {name} {value}", got, _WANTED[kind.lower()])
    got, _, wanted = error.message.rstrip(".").partition(" is not ")
    if isinstance(param.type, click.IntRange | click.FloatRange) and wanted.startswith("a valid "):
        wanted = "a whole number" if isinstance(param.type, click.IntRange) else "a number"
    if wanted.startswith("in the range ") and isinstance(param.type, click.IntRange | click.FloatRange):
        wanted = _range(param.type)
    return InvalidInputError(f"{path} {name}", lowered(got), wanted or told)


def _range(kind: click.IntRange | click.FloatRange) -> str:
    """Return the bounds of a number in words."""
    above, below = "more than" if kind.min_open else "at least", "less than" if kind.max_open else "at most"
    if kind.min is not None and kind.max is not None and not kind.min_open and not kind.max_open:
        return f"{kind.min:g} to {kind.max:g}"
    ends = ((above, kind.min), (below, kind.max))
    return " and ".join(f"{word} {bound:g}" for word, bound in ends if bound is not None)
