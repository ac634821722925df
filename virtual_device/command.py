"""`lightpage virtual-device`: a simulated device as hardware, until it is told to stop."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import click

from lightpage.cli.main import RESUME_KEY
from lightpage.cli.paths import OutputFolder
from lightpage.device.profile import load_profile
from lightpage.device.state import Device, load_device
from lightpage.errors import InvalidInputError
from lightpage.virtual_device.device import VirtualDevice
from lightpage.virtual_device.namespace import go_on_inside

_END_S = 10.0
"""Time that the command gets to end once it has been told to."""


@click.command(context_settings={"ignore_unknown_options": True})
@click.option("--profile", "profile_name", default="bench", show_default=True, help="A shipped profile, or a file.")
@click.option(
    "--device",
    "device_file",
    type=click.Path(),
    help="True state of the device: `rough`, or TOML; a realistic one if absent.",
)
@click.option("--set", "settings", multiple=True, metavar="TABLE.KEY=VALUE", help="Change one number of that state.")
@click.option("--out", required=True, type=OutputFolder(), help="Folder for port, socket and device.toml.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Seed of noise and drift.")
@click.option("--pixel-format", default="Mono8", show_default=True, help="Pixel format of both cameras.")
@click.option("--black-level", default=0, show_default=True, type=click.IntRange(0, 1000), help="Counts in the dark.")
@click.argument("command", nargs=-1, type=click.UNPROCESSED)
def virtual_device(
    profile_name: str,
    device_file: str | None,
    settings: tuple[str, ...],
    out: Path,
    seed: int,
    pixel_format: str,
    black_level: int,
    command: tuple[str, ...],
) -> None:
    """Run a simulated device as hardware: two GigE cameras, a pulse generator on a serial port, a modulator.

    Read it with `camera:FOLDER/device.toml`. Its cameras need a network of their own, so it runs in a private one, and
    so does COMMAND, which is started there once the device is ready; the device ends with it. Without COMMAND a shell
    is started.
    """
    _make(out)
    go_on_inside("lightpage.cli.main")
    context = click.get_current_context()
    context.meta[RESUME_KEY] = "the simulated device has ended, and its command with it"
    profile = load_profile(profile_name)
    device = (load_device(device_file) if device_file else Device()).of_profile(profile).with_settings(list(settings))
    with VirtualDevice(profile, device, out, seed, pixel_format, black_level) as running:
        click.echo(f"simulated device at camera:{running.config}", err=True)
        status = run_to_its_end(command or (os.environ.get("SHELL", "/bin/sh"),))
        running.check()
    context.exit(status)


def _make(folder: Path) -> None:
    """Make the folder unless it is there.

    Raises:
        InvalidInputError: it cannot be made, or nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InvalidInputError(f"--out {folder}", error, "a folder that can be made and written") from None


def run_to_its_end(command: Sequence[str]) -> int:
    """Run a command, and return its exit status as shells have it; SIGTERM and SIGHUP end it too.

    Raises:
        InvalidInputError: there is no such command.
    """
    came: list[int] = []  # signals that come before the command is known, which would go on alone
    caught = [number for number in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(number) != signal.SIG_IGN]
    usual = {number: signal.signal(number, lambda got, _: came.append(got)) for number in caught}
    process: subprocess.Popen[bytes] | None = None
    before = signal.getsignal(signal.SIGINT)
    try:
        try:
            process = subprocess.Popen(command)
        except OSError as error:
            raise InvalidInputError(f"command {command[0]}", error, "a command that can be started") from None
        finally:
            for number, handler in usual.items():
                signal.signal(number, handler)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the command by itself
        if came:
            signal.raise_signal(came[0])
        status = process.wait()
    finally:
        signal.signal(signal.SIGINT, before)
        if process is not None and process.poll() is None:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(_END_S)
            process.kill()
            process.wait()
    return status if status >= 0 else 128 - status
