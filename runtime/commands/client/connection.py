"""Options of the commands that talk to a running service."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from lightpage.errors import InvalidInputError
from lightpage.runtime.client.wire.channel import TlsFiles

_Command = TypeVar("_Command", bound=Callable[..., Any])


def target_option(*, required: bool, help: str = "The running service.") -> Callable[[_Command], _Command]:
    """Gives a command the option that names a service, which a variable of the environment gives too."""
    return click.option(
        "--target",
        metavar="HOST:PORT",
        required=required,
        envvar="LIGHTPAGE_CLIENT_TARGET",
        show_envvar=True,
        help=help,
    )


def from_environment(name: str) -> bool:
    """Return whether a variable of the environment gave an argument of the command that runs."""
    return click.get_current_context().get_parameter_source(name) is ParameterSource.ENVIRONMENT


TARGET = target_option(required=True)

_FILES = {
    "ca": "authorities that the service's certificate may come from",
    "certificate": "certificate of this caller",
    "key": "its private key",
}


def tls_options(*, environment: bool) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Gives a command three options for certificates, and their files as its argument `tls`; None for no TLS.

    The command raises `InvalidInputError` where some of the three are given, and not all.

    Args:
        environment: whether variables of the environment give them too.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def with_files(*arguments: Any, **options: Any) -> None:
            paths = {name: options.pop(name) for name in _FILES}
            lacking = [f"--{name}" for name, path in paths.items() if path is None]
            if len(lacking) not in (0, len(_FILES)):
                raise InvalidInputError("options", f"no {', '.join(lacking)}", "--ca, --certificate and --key, or none")
            command(*arguments, tls=None if lacking else TlsFiles(**paths), **options)

        for name, meaning in reversed(_FILES.items()):
            with_files = click.option(
                f"--{name}",
                type=click.Path(path_type=Path),
                envvar=f"LIGHTPAGE_CLIENT_{name.upper()}" if environment else None,
                show_envvar=environment,
                help=f"TLS: {meaning}, PEM.",
            )(with_files)
        return with_files

    return decorate


with_tls = tls_options(environment=True)
"""Of the commands that a person calls."""
