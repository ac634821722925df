"""Errors of a command line that click refuses, in the words of all other errors."""

from __future__ import annotations

from difflib import get_close_matches

import click

from lightpage.errors import InvalidInputError

_NO_COMMAND = "No such command "


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
    return InvalidInputError(path, message, told)


def _of_parameter(path: str, told: str, error: click.BadParameter, param: click.Parameter) -> InvalidInputError:
    metavar = "" if error.ctx is None else param.make_metavar(error.ctx)
    name = param.opts[0] if isinstance(param, click.Option) else metavar
    if isinstance(error, click.MissingParameter):
        return InvalidInputError(path, f"no {name}", f"{name} {metavar}" if name != metavar else "one")
    got, _, wanted = error.message.rstrip(".").partition(" is not ")
    if isinstance(param.type, click.IntRange | click.FloatRange) and wanted.startswith("a valid "):
        wanted = "a whole number" if isinstance(param.type, click.IntRange) else "a number"
    return InvalidInputError(f"{path} {name}", got, wanted.removeprefix("in the range ") or told)
