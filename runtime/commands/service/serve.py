"""`lightpage serve`: the service until it is told to stop."""

from __future__ import annotations

import logging
import os
import platform
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from lightpage.errors import InvalidInputError, LostShotError, SourceError
from lightpage.progress import reporting
from lightpage.recording.pages import Pages
from lightpage.runtime.client.shared_memory import memory_path
from lightpage.runtime.client.wire.address import check_free, host_and_port, is_local
from lightpage.runtime.commands.execution import ENGINE_CACHE, THREADS
from lightpage.runtime.commands.provider_option import PROVIDER
from lightpage.runtime.console.actions import Actions
from lightpage.runtime.console.history import History
from lightpage.runtime.console.server import Console, ConsoleServer
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.source import FrameSource, open_source
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.bundle.signature import BundleKey
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.execution.memory import share_freed_memory
from lightpage.runtime.model.execution.providers import Provider
from lightpage.runtime.model.execution.session import VERSION as RUNTIME_VERSION
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.frames.shared_memory import SharedMemory
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.jobs.self_calibration import SelfCalibration
from lightpage.runtime.service.models.audit import AuditLog
from lightpage.runtime.service.models.incoming import Incoming
from lightpage.runtime.service.models.registry import ModelRegistry, no_tracker
from lightpage.runtime.service.models.store import ModelStore
from lightpage.runtime.service.monitoring.flight_recorder import PAGES, FlightRecorder
from lightpage.runtime.service.monitoring.logs import PageLog, logging_to_stderr
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.monitoring.observation import Observer
from lightpage.runtime.service.monitoring.traces import Traces
from lightpage.runtime.service.server.certificates import Certificates
from lightpage.runtime.service.server.health_server import HealthServer, next_port
from lightpage.runtime.service.server.server import LightpageServer
from lightpage.runtime.service.settings import (
    ADDRESS,
    OFF,
    STORE_VARIABLE,
    Effective,
    MetricsTable,
    Option,
    ServiceSettings,
    service_settings,
)

_log = logging.getLogger(__name__)

REST_S = 3.0
"""For what still computes once all calls have ended."""

_HANGUP = getattr(signal, "SIGHUP", None)
_STOPS = [kind for kind in (signal.SIGTERM, signal.SIGINT, _HANGUP) if kind is not None]

_KEYS = {
    "bundle": ("service", "bundle"),
    "bundle_key": ("service", "bundle_key"),
    "source": ("service", "source"),
    "pages_file": ("service", "pages"),
    "address": ("service", "address"),
    "health_address": ("service", "health_address"),
    "ca": ("tls", "ca"),
    "certificate": ("tls", "certificate"),
    "key": ("tls", "key"),
    "metrics_port": ("metrics", "port"),
    "metrics_host": ("metrics", "host"),
    "shared_memory": ("service", "shared_memory"),
    "store": ("service", "store"),
    "incoming": ("service", "incoming"),
    "recordings": ("service", "recordings"),
    "threads": ("service", "threads"),
    "provider": ("service", "provider"),
    "engine_cache": ("service", "engine_cache"),
    "tracking": ("service", "tracking"),
    "self_calibrate": ("self_calibration", "enabled"),
    "calibration_pages": ("self_calibration", "pages"),
    "flight_recorder": ("flight_recorder", "folder"),
    "flight_recorder_pages": ("flight_recorder", "pages"),
}
"""Of each option the setting that it is above of."""


@click.command()
@click.option(
    "--config",
    type=click.Path(path_type=Path),
    envvar="LIGHTPAGE_CONFIG",
    show_envvar=True,
    help="Settings, SERVICE.toml; variables of the environment and options count before them.",
)
@click.option("--print-config", is_flag=True, help="Print the settings in effect and where they come from, and end.")
@click.option("--bundle", show_default=DEFAULT, help="A bundle's path, or the name of a shipped one.")
@click.option(
    "--bundle-key", type=click.Path(path_type=Path), help="Public key, PEM, that bundles must be signed with."
)
@click.option(
    "--source", help="simulator:PROFILE, recording:FILE, camera:CONFIG.toml; without it only sent frames decode."
)
@click.option(
    "--pages", "pages_file", type=click.Path(path_type=Path), help="Pages that the source is to show, PAGES.h5."
)
@click.option("--address", show_default=ADDRESS, help="HOST:PORT to listen on; port 0 takes a free one.")
@click.option(
    "--health-address",
    help="HOST:PORT of health checks, answered by a process of their own; by default the next port. off: none.",
)
@click.option("--ca", type=click.Path(path_type=Path), help="TLS: authorities of the callers' certificates, PEM.")
@click.option("--certificate", type=click.Path(path_type=Path), help="TLS: certificate of the service, PEM.")
@click.option("--key", type=click.Path(path_type=Path), help="TLS: its private key, PEM.")
@click.option("--metrics-port", type=click.IntRange(0, 65535), help="Show metrics and console on this port.")
@click.option("--metrics-host", show_default="127.0.0.1", help="Where the figures are shown.")
@click.option(
    "--shared-memory/--no-shared-memory", default=None, help="Share memory with clients at the service's Unix socket."
)
@click.option(
    "--store",
    type=click.Path(file_okay=False, path_type=Path),
    help=f"Folder of recalibrated and uploaded bundles; it remembers which one serves. {STORE_VARIABLE} too.",
)
@click.option(
    "--incoming",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder whose bundles are taken into the store, as uploads are.",
)
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
@click.option(
    "--flight-recorder",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder in which the frames of lost and weak pages are kept.",
)
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
    given = [name for name in _KEYS if context.get_parameter_source(name) is ParameterSource.COMMANDLINE]
    return [Option(names[name], _KEYS[name], context.params[name]) for name in given]


def _serve(effective: Effective[ServiceSettings], wait_for_stop: Callable[[], None]) -> None:
    settings = effective.settings
    service, audit = settings.service, settings.audit
    files = settings.tls.files()
    certificates = None if files is None else Certificates(files)
    provider = Provider.parse(service.provider, service.engine_cache)
    key = None if service.bundle_key is None else BundleKey(service.bundle_key)
    base = Decoder(Bundle.open(bundle_path(service.bundle), key=key), service.threads, provider=provider)
    registry = ModelRegistry(base, tracker_for if service.tracking else no_tracker, key=key)
    metrics = ServiceMetrics()
    monitor = Monitor(metrics=metrics)
    with ExitStack() as stack:
        models = None
        if service.store is not None:
            models = ModelStore(service.store, base.bundle)
            stack.enter_context(models.locked())
        pages = None
        if service.source is not None:
            pages = stack.enter_context(checked_source(service.source, service.pages, base))
            _take_dark_frames(pages)
        history = History()
        observers: list[Observer] = [history, PageLog()]
        if settings.flight_recorder.folder is not None:
            folder, kept = settings.flight_recorder.folder, settings.flight_recorder.settings()
            observers.append(stack.enter_context(FlightRecorder(folder, registry, kept, monitor, metrics)))
        plane = DataPlane(
            registry,
            pages,
            models,
            settings.limits,
            metrics=metrics,
            observers=observers,
            monitor=monitor,
            audit=AuditLog(settings.audit_file, audit.file_bytes, audit.kept),
            device_sessions=settings.device_sessions,
        )
        plane.models.resume()
        source_name = pages.name if pages is not None else "no source"
        recalibrator = Recalibrator(plane, recordings=service.recordings)
        if (trouble := recalibrator.no_room()) is not None:
            _log.warning("recalibrations will be refused: %s", trouble)
        actions = Actions(plane, recalibrator, settings.self_calibration.pages)
        console = Console(metrics, history, registry, monitor, source_name, actions)
        stack.enter_context(_shown(console, settings.metrics, certificates))
        traces = None
        if settings.traces.endpoint is not None:
            traces = stack.enter_context(Traces(settings.traces.endpoint, settings.traces.share))
        server = LightpageServer(
            plane,
            recalibrator,
            service.address,
            certificates=certificates,
            inference=settings.inference.enabled,
            traces=traces,
        )
        check_free("address", service.address)  # before anything else takes a port
        if service.shared_memory:
            limits, path = settings.limits, memory_path(service.address)
            memory = SharedMemory(path, limits.shared_bytes, limits.shared_regions, limits.stall_s)
            plane.shared = stack.enter_context(memory)
        if service.health_address != OFF:  # entered first: it says NOT_SERVING until the last call has ended
            address = service.health_address or next_port(service.address)
            plain = settings.tls.plain_health or (is_local(address) and service.health_address is None)
            health = stack.enter_context(HealthServer(address, server.health, None if plain else files))
            click.echo(f"health checks at {health.target}")
        stack.enter_context(server)
        if service.incoming is not None:
            stack.enter_context(Incoming(plane, service.incoming))
        if settings.self_calibrates:
            stack.enter_context(SelfCalibration(plane, monitor, recalibrator, settings.self_calibration.settings()))
        click.echo(f"serving {registry.current.version} from {source_name} at {server.target}")
        _log_start(registry.current.version, source_name, server.target, provider, len(effective.origins))
        wait_for_stop()
        with suppress(OSError):  # the terminal may have gone, and sent the signal
            click.echo("stopping")
        _log.info("stopping with model %s", registry.current.version)
    _log.info("stopped")


def leave_the_rest(rest_s: float = REST_S, leave: Callable[[int], object] = os._exit) -> None:
    """End the process if its threads do not: a decode that has hung would keep it for ever.

    Args:
        rest_s: time that they have.
        leave: ends the process with a status.
    """
    until = time.monotonic() + rest_s
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join(max(0.0, until - time.monotonic()))
            if thread.is_alive():
                _log.warning("ended while %s was still at work", thread.name)
                for stream in (sys.stdout, sys.stderr):
                    stream.flush()
                leave(0)


def _log_start(model: str, source: str, address: str, provider: Provider, given: int) -> None:
    versions = {name: installed_version(name) for name in ("lightpage", "grpcio", "numpy")}
    versions["onnxruntime"] = RUNTIME_VERSION
    versions["python"] = platform.python_version()
    text = "serving %s from %s at %s on %s, %d settings given"
    _log.info(text, model, source, address, provider, given, extra={"told": versions})


def checked_source(name: str, pages_file: Path | None, base: Decoder) -> FrameSource:
    """Open a source, check it, and give it its pages to show.

    Raises:
        InvalidInputError: it is not there, or not for this device.
    """
    source = open_source(name)
    try:
        source.check_against(base.bundle.profile)
        if pages_file is not None:
            source.show_pages(PageStore(base.bundle.profile, Pages.open(pages_file)))
        if source.page_count() == 0:
            _log.warning("%s shows pages and has none: name some with --pages, or upload them", source.name)
    except BaseException:
        source.close()
        raise
    return source


def _take_dark_frames(source: FrameSource) -> None:
    """Without them hot pixels stay as they are, and a page is read all the same."""
    try:
        source.dark_frames()
    except (LostShotError, SourceError) as error:
        _log.warning("no dark frames, so hot pixels are not mended: %s", error)


@contextmanager
def stop_signals() -> Iterator[Callable[[], None]]:
    """Yields what waits for SIGTERM, SIGINT or SIGHUP; a second SIGTERM or SIGINT ends the process as usual.

    SIGHUP comes when a terminal is closed. Where it was to be ignored, as under nohup, it is.
    It waits for the byte that the interpreter's own handler writes. Waiting for a lock that a Python handler releases
    would miss a signal that comes between the last look for one and the sleep.
    """
    before: dict[int, Any] = {}
    receiver, sender = socket.socketpair()
    sender.setblocking(False)

    def no_more(number: int, _: object) -> None:
        for kind in before:  # a hangup may come with the first signal, and is not impatience
            signal.signal(kind, signal.SIG_IGN if kind == _HANGUP else signal.SIG_DFL)

    def wait() -> None:
        while receiver.recv(1)[0] not in before:
            pass

    with receiver, sender:
        waking = signal.set_wakeup_fd(sender.fileno())
        try:
            for kind in _STOPS:
                if kind != _HANGUP or signal.getsignal(kind) != signal.SIG_IGN:
                    before[kind] = signal.signal(kind, no_more)
            yield wait
        finally:
            signal.set_wakeup_fd(waking)
            for number, handler in before.items():
                signal.signal(number, handler)


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
