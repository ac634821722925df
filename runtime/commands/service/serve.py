"""`lightpage serve`: the service until it is told to stop."""

from __future__ import annotations

import logging
import platform
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from lightpage.errors import InvalidInputError
from lightpage.progress import reporting
from lightpage.runtime.client.wire.address import host_and_port
from lightpage.runtime.commands.execution import ENGINE_CACHE, THREADS
from lightpage.runtime.commands.provider_option import PROVIDER
from lightpage.runtime.commands.service.ending import leave_the_rest, stop_signals
from lightpage.runtime.console.actions import Actions
from lightpage.runtime.console.history import History
from lightpage.runtime.console.server import Console, ConsoleServer
from lightpage.runtime.model.bundle.shipped import DEFAULT
from lightpage.runtime.model.execution.memory import share_freed_memory
from lightpage.runtime.model.execution.session import VERSION as RUNTIME_VERSION
from lightpage.runtime.service.assembly import assembled
from lightpage.runtime.service.endpoints import listening
from lightpage.runtime.service.monitoring.flight_recorder import PAGES
from lightpage.runtime.service.monitoring.logs import logging_to_stderr
from lightpage.runtime.service.server.certificates import Certificates
from lightpage.runtime.service.settings import (
    ADDRESS,
    STORE_VARIABLE,
    Effective,
    MetricsTable,
    Option,
    service_settings,
)

_log = logging.getLogger(__name__)

_KEYS = {
    "pages_file": ("service", "pages"),
    "ca": ("tls", "ca"),
    "certificate": ("tls", "certificate"),
    "key": ("tls", "key"),
    "metrics_port": ("metrics", "port"),
    "metrics_host": ("metrics", "host"),
    "self_calibrate": ("self_calibration", "enabled"),
    "calibration_pages": ("self_calibration", "pages"),
    "flight_recorder": ("flight_recorder", "folder"),
    "flight_recorder_pages": ("flight_recorder", "pages"),
}
"""Of options the settings that they are above of; all others are above of those of their name in [service]."""

_FILE, _FOLDER = click.Path(path_type=Path), click.Path(file_okay=False, path_type=Path)


@click.command()
@click.option(
    "--config",
    type=_FILE,
    envvar="LIGHTPAGE_CONFIG",
    show_envvar=True,
    help="Settings, SERVICE.toml; variables of the environment and options count before them.",
)
@click.option("--print-config", is_flag=True, help="Print the settings in effect and where they come from, and end.")
@click.option("--bundle", show_default=DEFAULT, help="A bundle's path, or the name of a shipped one.")
@click.option("--bundle-key", type=_FILE, help="Public key, PEM, that bundles must be signed with.")
@click.option(
    "--source", help="simulator:PROFILE, recording:FILE, camera:CONFIG.toml; without it only sent frames decode."
)
@click.option("--pages", "pages_file", type=_FILE, help="Pages that the source is to show, PAGES.h5.")
@click.option("--address", show_default=ADDRESS, help="HOST:PORT to listen on; port 0 takes a free one.")
@click.option(
    "--health-address",
    help="HOST:PORT of health checks, answered by a process of their own; by default the next port. off: none.",
)
@click.option("--ca", type=_FILE, help="TLS: authorities of the callers' certificates, PEM.")
@click.option("--certificate", type=_FILE, help="TLS: certificate of the service, PEM.")
@click.option("--key", type=_FILE, help="TLS: its private key, PEM.")
@click.option("--metrics-port", type=click.IntRange(0, 65535), help="Show metrics and console on this port.")
@click.option("--metrics-host", show_default="127.0.0.1", help="Where the figures are shown.")
@click.option(
    "--shared-memory/--no-shared-memory", default=None, help="Share memory with clients at the service's Unix socket."
)
@click.option(
    "--store",
    type=_FOLDER,
    help=f"Folder of recalibrated and uploaded bundles; it remembers which one serves. {STORE_VARIABLE} too.",
)
@click.option("--incoming", type=_FOLDER, help="Folder whose bundles are taken into the store, as uploads are.")
@click.option(
    "--recordings",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder whose recordings a caller may name to recalibrate with.",
)
@THREADS
@PROVIDER
@ENGINE_CACHE
@click.option(
    "--tracking/--no-tracking", default=None, show_default="tracking", help="Follow the image, and find it again."
)
@click.option(
    "--self-calibrate/--no-self-calibrate",
    default=None,
    help="Recalibrate when the monitor says so; by default where calibration pages are named.",
)
@click.option(
    "--calibration-page",
    "calibration_pages",
    type=click.IntRange(0, 2**32 - 1),
    multiple=True,
    help="Number of a page of the source whose symbols are known; repeat it. Without, the next two pages serve.",
)
@click.option("--flight-recorder", type=_FOLDER, help="Folder in which the frames of lost and weak pages are kept.")
@click.option("--flight-recorder-pages", show_default=str(PAGES), type=click.IntRange(1), help="Kept there at most.")
@click.pass_context
def serve(context: click.Context, /, config: Path | None, print_config: bool, **_: Any) -> None:
    """Run the service until SIGTERM, Ctrl-C or SIGHUP; calls in flight are finished first."""
    effective = service_settings(config, options=_given(context))
    if print_config:
        click.echo(effective.to_toml(), nl=False)
        return
    settings = effective.settings
    settings.check_paths()
    share_freed_memory()
    logs = settings.logs
    written = logging_to_stderr(logs.format, logs.level, logs.lines_per_second)
    with stop_signals() as wait_for_stop, written, reporting(None):  # what work tells of itself is logged too
        _serve(effective, wait_for_stop)
        leave_the_rest()


def _given(context: click.Context) -> list[Option]:
    """The options that somebody gave."""
    names = {parameter.name: parameter.opts[0] for parameter in context.command.params}
    given = [name for name in context.params if context.get_parameter_source(name) is ParameterSource.COMMANDLINE]
    return [
        Option(names[name], _KEYS.get(name, ("service", name)), context.params[name])
        for name in given
        if name not in ("config", "print_config")
    ]


def _serve(effective: Effective, wait_for_stop: Callable[[], None]) -> None:
    settings = effective.settings
    files = settings.tls.files()
    certificates = None if files is None else Certificates(files)
    history = History()
    with ExitStack() as stack:
        own = stack.enter_context(assembled(settings, history))
        plane, models = own.plane, own.plane.models
        actions = Actions(plane, own.recalibrator, settings.self_calibration.pages)
        console = Console(plane.metrics, history, models, own.monitor, own.source_name, actions)
        stack.enter_context(_shown(console, settings.metrics, certificates))
        endpoints = stack.enter_context(listening(settings, own, certificates))
        if endpoints.health is not None:
            click.echo(f"health checks at {endpoints.health}")
        told = f"serving {models.current.version} from {own.source_name} at {endpoints.target}"
        click.echo(told)
        provider = models.current.decoder.graph.provider
        _log.info("%s on %s, %d settings given", told, provider, len(effective.origins), extra={"told": _versions()})
        wait_for_stop()
        with suppress(OSError):  # the terminal may have gone, and sent the signal
            click.echo("stopping")
        _log.info("stopping with model %s", models.current.version)
    _log.info("stopped")


def _versions() -> dict[str, str]:
    versions = {name: installed_version(name) for name in ("lightpage", "grpcio", "numpy")}
    return versions | {"onnxruntime": RUNTIME_VERSION, "python": platform.python_version()}


@contextmanager
def _shown(console: Console, settings: MetricsTable, certificates: Certificates | None) -> Iterator[None]:
    if settings.port is None:
        yield
        return
    try:
        server = ConsoleServer(console, settings.port, settings.host, certificates, settings.names)
    except OSError as error:
        got, expected = error.strerror or error, "an address of this machine and a free port"
        raise InvalidInputError(f"metrics at {host_and_port(settings.host, settings.port)}", got, expected) from None
    root = f"{'http' if certificates is None else 'https'}://{host_and_port(settings.host, server.port)}"
    click.echo(f"metrics at {root}/metrics, console at {root}/")
    with server:
        yield
