"""The `lightpage` command: finds subcommands by name, loads only the one called, ends every failure in a line."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from functools import wraps
from importlib.metadata import EntryPoint, entry_points
from types import FrameType
from typing import Any, NoReturn, Self

import click

from lightpage.cli.paths import check_outputs
from lightpage.cli.progress_bar import Bars
from lightpage.errors import LightpageError, LostDataError, MissingResultsError, StorageError, TakenError
from lightpage.progress import reporting

GROUP = "lightpage.commands"

RESUME_KEY = "lightpage.resume"
"""A command that can resume says how under this key of `click.get_current_context().meta`."""

RESUME = "run the same command again; nothing half-written was left under a final name"

EXIT_ERROR = 2
EXIT_LOST = 3
"""Data are lost."""
EXIT_AGAIN = 75
"""The same command may go well later: EX_TEMPFAIL of sysexits.h."""
EXIT_INTERRUPTED, EXIT_TERMINATED = 130, 143
"""128 + SIGINT, 128 + SIGTERM, as shells have it."""

RUNTIME = "onnxruntime"
"""What computes pages; either of two extras brings it."""
EXTRAS = {
    "train": frozenset({"torch", "torchmetrics", "lightning", "tensorboard", "jinja2", "onnx", "onnxscript"}),
    "camera": frozenset({"harvesters", "genicam"}),
    "cluster": frozenset({"ray"}),
}

SUMMARIES = {
    "bench": "Measure speed: inference alone, whole decode, through gRPC.",
    "bulk": "Read archives of recordings, or recalibrate a fleet, with many workers.",
    "console": "Open the web page of a running service.",
    "top": "Show live how a running service fares.",
    "code": "Choose how user bytes are protected on a device's pages.",
    "calibrate": "Find a device's geometry from nominal with a few known pages.",
    "decode": "Decode a recording, or pages of the service's source, with a running service.",
    "demo": "See it all work on the simulated device.",
    "encode": "Put a file on pages to write.",
    "evaluate": "Measure a bundle on a recording with known symbols.",
    "export": "Turn a training run into a bundle.",
    "jobs": "Show, follow or cancel the recalibrations of a running service.",
    "models": "List, add and change the models of a running service.",
    "recalibrate": "Re-fit a drifted device's geometry and write a new bundle.",
    "record": "Record pages of cameras, or of any other source.",
    "recover": "Read a file back from recorded pages.",
    "report": "Show a training run, an evaluation, a recovery or a bulk run as an HTML page.",
    "rollback": "Put a service's previous model back in service.",
    "serve": "Run the service.",
    "simulate": "Record pages of a simulated device.",
    "study": "Answer a question about the device or its decoders in a table and a picture.",
    "virtual-device": "Run a simulated device that looks like hardware: cameras, pulse generator, modulator.",
    "train": "Train a decoder on a recording.",
}
"""What the overview says of a command, so that it need not be imported to be listed."""


class LazyGroup(click.Group):
    """A group whose commands are entry points, imported when called and not before."""

    def __init__(self, points: Iterable[EntryPoint] | None = None, **settings: object) -> None:
        super().__init__(**settings)  # type: ignore[arg-type]
        found = entry_points(group=GROUP) if points is None else points
        self.points: Mapping[str, EntryPoint] = {point.name: point for point in found}

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of all commands."""
        return sorted(self.points)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return one command.

        Raises:
            LightpageError: what it needs is not installed.
        """
        if cmd_name not in self.points:
            return None
        try:
            command = self.points[cmd_name].load()
        except ModuleNotFoundError as error:
            raise missing(f"lightpage {cmd_name}", error) from error
        if not isinstance(command, click.Command):
            raise LightpageError(f"command {cmd_name}", type(command).__name__, "a click command")
        return _checked(command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the overview without importing a command."""
        rows = [(name, SUMMARIES.get(name, "")) for name in self.list_commands(ctx)]
        if rows:
            with formatter.section("Commands"):
                formatter.write_dl(rows)


def _checked(command: click.Command) -> click.Command:
    """The command, which first sees to it that it overwrites nothing that it reads."""
    run_it = command.callback
    if run_it is None:
        return command

    @wraps(run_it)
    def run_checked(*args: object, **options: object) -> object:
        check_outputs(click.get_current_context())
        return run_it(*args, **options)

    checked = copy(command)
    checked.callback = run_checked
    return checked


def missing(subject: str, error: ModuleNotFoundError) -> LightpageError:
    """The error that says which extra to install for a module that is not there."""
    top = (error.name or "").partition(".")[0]
    if top == RUNTIME:
        expected = "the extra cpu, or the extra gpu on a machine with an NVIDIA GPU: pip install 'lightpage[cpu]'"
        return LightpageError(subject, f"no module {top}", expected)
    for extra, modules in EXTRAS.items():
        if top in modules:
            return LightpageError(subject, f"no module {top}", f"the extra {extra}: pip install 'lightpage[{extra}]'")
    return LightpageError(subject, f"no module {error.name}", "a complete installation of lightpage")


@click.command(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="lightpage")
def lightpage() -> None:
    """Decode phase pages read through a glass light-pipe, and keep the decoder calibrated to its device."""


def run(command: click.Command, arguments: Sequence[str] | None = None, name: str = "lightpage") -> int:
    """Run a command line and return its exit status.

    That is 0, 2 for a foreseen error, 3 where data are lost, 75 where the same command may go well later, 130 after
    Ctrl-C, 143 after SIGTERM.

    SIGTERM ends a command as Ctrl-C does, so that it clears up behind itself.

    An error that nobody foresaw is raised: its traceback is what helps to mend it.

    Args:
        command: what to run.
        arguments: of it; those of this process if left out.
        name: what it was started as.
    """
    meta: dict[str, object] = {}
    termination = _Termination()
    try:
        arguments = list(sys.argv[1:] if arguments is None else arguments)
        with termination, reporting(Bars()), command.make_context(name, arguments) as ctx:
            meta = ctx.meta
            command.invoke(ctx)
    except click.exceptions.Exit as end:
        return end.exit_code
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except LightpageError as error:
        return _fail(error)
    except ModuleNotFoundError as error:
        if not any((error.name or "").partition(".")[0] in modules for modules in ({RUNTIME}, *EXTRAS.values())):
            raise
        return _fail(missing("lightpage", error))
    except MemoryError as error:
        return _fail(LightpageError("memory", str(error) or "too little", "a machine or a device that fits the other"))
    except (KeyboardInterrupt, click.Abort):
        click.echo(f"\nlightpage: interrupted; {meta.get(RESUME_KEY, RESUME)}", err=True)
        return EXIT_TERMINATED if termination.came else EXIT_INTERRUPTED
    return 0


class _Termination:
    """While its block runs in the main thread, the first SIGTERM interrupts it; a second ends the process as usual."""

    came = False

    def __enter__(self) -> Self:
        self._before: Any = None
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGTERM, self._interrupt)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)

    def _interrupt(self, number: int, _: FrameType | None) -> NoReturn:
        self.came = True
        signal.signal(number, signal.SIG_DFL)
        raise KeyboardInterrupt


def _fail(error: LightpageError) -> int:
    click.echo("lightpage: error: " + " ".join(str(error).split()), err=True)
    if isinstance(error, LostDataError):
        return EXIT_LOST
    return EXIT_AGAIN if isinstance(error, (MissingResultsError, StorageError, TakenError)) else EXIT_ERROR


def main() -> NoReturn:
    """The console script."""
    sys.exit(run(lightpage))


if __name__ == "__main__":
    main()
