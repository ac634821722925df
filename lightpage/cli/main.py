"""The `lightpage` command: finds subcommands by name, loads only the one called, ends every failure in a line."""

from __future__ import annotations

import os
import platform
import signal
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext, suppress
from copy import copy
from functools import wraps
from importlib.metadata import EntryPoint, entry_points, version
from types import FrameType
from typing import Any, NoReturn, Self

import click
from click.shell_completion import CompletionItem, shell_complete

from lightpage.cli.groups import help_at
from lightpage.cli.options import alike, completed
from lightpage.cli.paths import check_outputs, writes_to_stdout
from lightpage.cli.progress_bar import Bars
from lightpage.cli.stand_ins import stand_ins
from lightpage.cli.streams import LastingStream, take_streams
from lightpage.cli.usage import misused
from lightpage.errors import (
    LightpageError,
    LostDataError,
    MissingResultsError,
    NoRoomError,
    StorageError,
    SurroundingsError,
    TakenError,
)
from lightpage.failures import os_failure, understood
from lightpage.files import results_on_stdout
from lightpage.progress import reporting
from lightpage.systems import ENDING, LINUX_MODULES, NEEDS_LINUX
from lightpage.temporary import settle_matplotlib

GROUP = "lightpage.commands"

RESUME_KEY = "lightpage.resume"
"""A command that can resume says how under this key of `click.get_current_context().meta`."""

HELP_KEY = "lightpage.help"
"""Whether help is asked for, in `meta` too."""

RESUME = "run the same command again; no file is half-written"

EXIT_ERROR = 2
EXIT_LOST = 3
"""Data are lost."""
EXIT_AGAIN = 75
"""The same command may go well later: EX_TEMPFAIL of sysexits.h."""
EXIT_INTERRUPTED = 128 + signal.SIGINT
"""As shells have it; likewise for other signals."""

COMPLETE = "_LIGHTPAGE_COMPLETE"
"""Variable by which a shell asks what may follow: `eval "$(_LIGHTPAGE_COMPLETE=bash_source lightpage)"`."""

RUNTIME = "onnxruntime"
"""What computes pages; either of two extras brings it."""
EXTRAS = {
    "train": frozenset({"torch", "torchmetrics", "lightning", "tensorboard", "onnx", "onnxscript"}),
    "report": frozenset({"jinja2"}),
    "import": frozenset({"tifffile"}),
    "camera": frozenset({"harvesters", "genicam"}),
    "cluster": frozenset({"ray"}),
}
EXTRA_MODULES = frozenset({RUNTIME}).union(*EXTRAS.values())
SLOW = frozenset({"h5py", "matplotlib", "scipy"})
"""Packages that take long to import, and that no help needs."""

SUMMARIES = {
    "bench": "Measure speed: inference alone, whole decode, through gRPC.",
    "bulk": "Read archives of recordings, or recalibrate a fleet, with many workers.",
    "console": "Open the web page of a running service.",
    "top": "Show live how a running service fares.",
    "code": "Choose how user bytes are protected on a device's pages.",
    "calibrate": "Find a device's geometry from nominal with a few known pages.",
    "decode": "Decode a recording, or pages of the service's source, with a running service.",
    "demo": "Store, lose and heal a picture on the simulated device.",
    "encode": "Put a file on pages to write.",
    "evaluate": "Measure a bundle on a recording with known symbols.",
    "export": "Turn a training run into a bundle.",
    "import": "Make a recording of frames and symbols that other programs have written.",
    "inspect": "Say what a file is, what is wrong with it, and what can be done with it next.",
    "jobs": "Show, follow or cancel the recalibrations of a running service.",
    "lookup-table": "Correct a modulator's lookup table by a calibration.",
    "models": "List, add and change the models of a running service.",
    "profile": "Make the profile of a device, check it, and see what follows from it.",
    "recalibrate": "Re-fit a drifted device's geometry and write a new bundle.",
    "record": "Record pages of cameras, or of any other source.",
    "recover": "Read a file back from recorded pages.",
    "report": "Show a training run, an evaluation, a recovery or a bulk run as an HTML page.",
    "rollback": "Put a service's previous model back in service.",
    "serve": "Run the service.",
    "simulate": "Record pages of a simulated device.",
    "study": "Answer a question about the device or its decoders in a table and a picture.",
    "unpack": "Write frames and symbols of a recording as files that other programs read.",
    "virtual-device": "Run a simulated device that looks like hardware: cameras, pulse generator, modulator.",
    "train": "Train a decoder on a recording.",
}
"""What the overview says of a command, so that it need not be imported to be listed."""


THREADS = {"OPENBLAS_NUM_THREADS": "1", "GOMP_SPINCOUNT": "1000"}
"""Variables with which libraries of linear algebra do not spin on cores that other work needs. A second thread brings
their products a tenth at full size and nothing on the bench; beside other work it costs several times their time."""
_OWN_CHOICE = {"OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}
"""Variables by which a user chooses threads; then all stays as it was chosen."""


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
        if ctx.resilient_parsing:  # a shell asks what may follow, and somebody waits
            with stand_ins(LINUX_MODULES), stand_ins(EXTRA_MODULES | SLOW, even_installed=True):
                found: click.Command = self.points[cmd_name].load()
            return completed(found)
        try:
            command = self.points[cmd_name].load()
        except ModuleNotFoundError as error:
            if not ctx.meta.get(HELP_KEY):
                raise missing(f"lightpage {cmd_name}", error) from error
            with stand_ins(EXTRA_MODULES | LINUX_MODULES):
                command = self.points[cmd_name].load()
        if not isinstance(command, click.Command):
            raise LightpageError(f"command {cmd_name}", type(command).__name__, "a click command")
        return _checked(command)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Return what may follow, without importing a command."""
        names = [name for name in self.list_commands(ctx) if name.startswith(incomplete)]
        options = click.Command.shell_complete(self, ctx, incomplete)
        return [*(CompletionItem(name, help=SUMMARIES.get(name)) for name in names), *options]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the overview without importing a command."""
        rows = [(name, SUMMARIES.get(name, "")) for name in self.list_commands(ctx)]
        if rows:
            with formatter.section("Commands"):
                formatter.write_dl(rows)


def _checked(command: click.Command) -> click.Command:
    """The command, which sees to it that it overwrites nothing that it reads, and what it may print on stdout."""
    for param in command.params:
        alike(param)
    checked, run_it = copy(command), command.callback
    if isinstance(checked, click.Group):
        checked.commands = {name: _checked(each) for name, each in checked.commands.items()}
    if run_it is None:
        return checked

    @wraps(run_it)
    def run_checked(*args: object, **options: object) -> object:
        context = click.get_current_context()
        check_outputs(context)
        with results_on_stdout() if writes_to_stdout(context) else nullcontext():
            return run_it(*args, **options)

    checked.callback = run_checked
    return checked


def missing(subject: str, error: ModuleNotFoundError) -> LightpageError:
    """The error that says which extra to install for a module that is not there."""
    top = (error.name or "").partition(".")[0]
    if top in LINUX_MODULES:
        return SurroundingsError(subject, f"{platform.system()} without Python's module {top}", NEEDS_LINUX)
    if top == RUNTIME:
        expected = "the extra cpu, or the extra gpu on a machine with an NVIDIA GPU: pip install 'lightpage[cpu]'"
        return LightpageError(subject, f"no module {top}", expected)
    for extra, modules in EXTRAS.items():
        if top in modules:
            return LightpageError(subject, f"no module {top}", f"the extra {extra}: pip install 'lightpage[{extra}]'")
    return LightpageError(subject, f"no module {error.name}", "a complete installation of lightpage")


def _show_version(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from lightpage.codec.compiled.choice import in_use

        click.echo(f"lightpage, version {version('lightpage')}\npage code: {in_use()}")
        context.exit()


@click.command(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_show_version,
    help="Show the version, and what computes the page code.",
)
def lightpage() -> None:
    """Decode phase pages read through a glass light-pipe, and keep the decoder calibrated to its device."""


def run(command: click.Command, arguments: Sequence[str] | None = None, name: str = "lightpage") -> int:
    """Run a command line and return its exit status.

    That is 0, 2 for a foreseen error, 3 where data are lost, 75 where the same command may go well later, 130 after
    Ctrl-C, 143 after SIGTERM, 129 after SIGHUP.

    SIGTERM and SIGHUP end a command as Ctrl-C does, so that it clears up behind itself.

    An error that nobody foresaw is raised: its traceback is what helps to mend it.

    Args:
        command: command to run.
        arguments: arguments of the command; those of this process if left out.
        name: name that it was started as.
    """
    meta: dict[str, object] = {}
    termination = _Termination()
    try:
        arguments = list(sys.argv[1:] if arguments is None else arguments)
        with termination, reporting(Bars()), command.make_context(name, arguments) as ctx:
            meta = ctx.meta
            meta[HELP_KEY] = help_at(arguments) is not None
            command.invoke(ctx)
    except click.exceptions.Exit as end:
        return end.exit_code
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return error.exit_code
    except click.UsageError as error:
        return _fail(misused(error))
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except LightpageError as error:
        return _fail(error)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in EXTRA_MODULES | LINUX_MODULES:
            raise
        return _fail(missing("lightpage", error))
    except (KeyboardInterrupt, click.Abort):
        click.echo(f"\nlightpage: interrupted; {meta.get(RESUME_KEY, RESUME)}", err=True)
        return EXIT_INTERRUPTED if termination.came is None else 128 + termination.came
    except Exception as error:
        if (failure := understood("lightpage", error)) is None:
            raise
        return _fail(failure)
    return 0


class _Termination:
    """While its block runs in the main thread, the first SIGTERM or SIGHUP interrupts it, a later SIGTERM ends it.

    A signal that the process was told to ignore, as `nohup` tells it of SIGHUP, stays ignored.

    Attributes:
        came: number of the signal that came; None before.
    """

    came: int | None = None

    def __enter__(self) -> Self:
        self._before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            for number in ENDING:
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._interrupt)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _interrupt(self, number: int, _: FrameType | None) -> NoReturn:
        self.came = number
        for other in ENDING:  # a hangup may come with SIGTERM, and is not impatience
            signal.signal(other, signal.SIG_DFL if other == signal.SIGTERM else signal.SIG_IGN)
        raise KeyboardInterrupt


def _fail(error: LightpageError) -> int:
    click.echo("lightpage: error: " + " ".join(str(error).split()), err=True)
    if isinstance(error, LostDataError):
        return EXIT_LOST
    return EXIT_AGAIN if isinstance(error, (MissingResultsError, NoRoomError, StorageError, TakenError)) else EXIT_ERROR


def main() -> NoReturn:
    """The console script."""
    streams = take_streams()
    with suppress(LightpageError):  # a command that draws says what it lacks
        settle_matplotlib()
    if os.environ.keys().isdisjoint(_OWN_CHOICE):
        os.environ.update(THREADS)
    if instruction := os.environ.get(COMPLETE):
        sys.exit(_complete(instruction))
    status = run(lightpage)
    for stream in streams:
        stream.flush()
    if status == 0 and (told := sys.stdout.failure if isinstance(sys.stdout, LastingStream) else None):
        status = _fail(os_failure("stdout", told, "a stream that takes the result"))
    sys.exit(status)


def _complete(instruction: str) -> int:
    try:
        return shell_complete(lightpage, {}, "lightpage", COMPLETE, instruction)
    except LightpageError:  # what a command needs is not installed
        return EXIT_ERROR


if __name__ == "__main__":
    main()
