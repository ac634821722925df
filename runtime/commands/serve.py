"""`lightpage serve`: the service until it is told to stop."""

from __future__ import annotations

import logging
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import click

from lightpage.errors import BundleError, CalibrationError, InvalidInputError
from lightpage.recording.pages import Pages
from runtime.acquisition.page_store import PageStore
from runtime.acquisition.source import FrameSource
from runtime.acquisition.sources import open_source
from runtime.bundle.shipped import DEFAULT, bundle_path
from runtime.console.history import History
from runtime.console.server import Console, ConsoleServer
from runtime.decoding.decoder import Decoder
from runtime.decoding.image_tracker import tracker_for
from runtime.errors import LostShotError, SourceError
from runtime.rpc.health_server import HealthServer, next_port
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.flight_recorder import PAGES, FlightRecorder, FlightSettings
from runtime.service.metrics import ServiceMetrics
from runtime.service.monitor import Monitor
from runtime.service.observation import Observer
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from runtime.service.self_calibration import SelfCalibration, SelfCalibrationSettings
from runtime.service.store import ModelStore
from runtime.wire.address import check_address

ADDRESS = "127.0.0.1:50051"

_log = logging.getLogger(__name__)


@click.command()
@click.option("--bundle", default=DEFAULT, show_default=True, help="A bundle's path, or the name of a shipped one.")
@click.option(
    "--source", help="simulator:PROFILE, recording:FILE, camera:CONFIG.toml; without it only sent frames decode."
)
@click.option(
    "--pages", "pages_file", type=click.Path(path_type=Path), help="Pages that the source is to show, PAGES.h5."
)
@click.option("--address", default=ADDRESS, show_default=True, help="HOST:PORT to listen on; port 0 takes a free one.")
@click.option(
    "--health-address",
    help="HOST:PORT of health checks, answered by a process of their own; by default the next port. off: none.",
)
@click.option("--metrics-port", type=click.IntRange(0, 65535), help="Show metrics and console on this port.")
@click.option("--metrics-host", default="127.0.0.1", show_default=True, help="Where the figures are shown.")
@click.option(
    "--store",
    type=click.Path(file_okay=False, path_type=Path),
    envvar="LIGHTPAGE_STORE",
    show_envvar=True,
    help="Folder for recalibrated bundles; the one in service is used again after a restart.",
)
@click.option(
    "--recordings",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder whose recordings a caller may name to recalibrate with.",
)
@click.option("--threads", type=click.IntRange(1), help="Threads of an inference; by default all cores.")
@click.option("--tracking/--no-tracking", default=True, show_default=True, help="Follow the image, and find it again.")
@click.option(
    "--self-calibrate/--no-self-calibrate",
    default=None,
    help="Recalibrate when the monitor says so; by default where calibration pages are named.",
)
@click.option(
    "--calibration-page",
    "calibration_pages",
    type=click.IntRange(0),
    multiple=True,
    help="Number of a page of the source whose symbols are known; repeat it. Without, the next two pages serve.",
)
@click.option(
    "--flight-recorder",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder in which the frames of lost and weak pages are kept.",
)
@click.option(
    "--flight-recorder-pages", default=PAGES, show_default=True, type=click.IntRange(1), help="Kept there at most."
)
def serve(
    bundle: str,
    source: str | None,
    pages_file: Path | None,
    address: str,
    health_address: str | None,
    metrics_port: int | None,
    metrics_host: str,
    store: Path | None,
    recordings: Path | None,
    threads: int | None,
    tracking: bool,
    self_calibrate: bool | None,
    calibration_pages: tuple[int, ...],
    flight_recorder: Path | None,
    flight_recorder_pages: int,
) -> None:
    """Run the service until SIGTERM or Ctrl-C; calls in flight are finished first."""
    check_address("--address", address, least_port=0)
    self_calibrate = bool(calibration_pages) if self_calibrate is None else self_calibrate
    if self_calibrate and source is None:
        raise InvalidInputError("--self-calibrate", "no --source", "a source that shows known pages")
    calibrating = SelfCalibrationSettings(calibration_pages)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    with stop_signals() as wait_for_stop:
        base = Decoder.load(bundle_path(bundle), threads)
        models = ModelStore(store, base.bundle) if store is not None else None
        registry = ModelRegistry(base, tracker_for) if tracking else ModelRegistry(base)
        if models is not None:
            _resume(registry, models, threads)
        metrics = ServiceMetrics()
        monitor = Monitor(metrics=metrics)
        with ExitStack() as stack:
            pages = None if source is None else stack.enter_context(_source(source, pages_file, base))
            if pages is not None:
                _take_dark_frames(pages)
            recorder = None
            if flight_recorder is not None:
                kept = FlightSettings(flight_recorder_pages)
                recorder = stack.enter_context(FlightRecorder(flight_recorder, registry, kept, monitor, metrics))
            history = History()
            observers: list[Observer] = [history] if recorder is None else [history, recorder]
            plane = DataPlane(registry, pages, models, metrics=metrics, observers=observers, monitor=monitor)
            source_name = pages.name if pages is not None else "no source"
            console = Console(metrics, history, registry, monitor, source_name)
            stack.enter_context(_shown(console, metrics_port, metrics_host))
            recalibrator = Recalibrator(plane, recordings=recordings)
            server = LightpageServer(plane, recalibrator, address)
            if health_address != "off":  # entered first: it says NOT_SERVING until the last call has ended
                health = stack.enter_context(HealthServer(health_address or next_port(address), server.health))
                click.echo(f"health checks at {health.target}")
            stack.enter_context(server)
            if self_calibrate:
                stack.enter_context(SelfCalibration(plane, monitor, recalibrator, calibrating))
            click.echo(f"serving {registry.current.version} from {source_name} at {server.target}")
            wait_for_stop()
            click.echo("stopping")


def _source(name: str, pages_file: Path | None, base: Decoder) -> FrameSource:
    """The source, checked, with its pages to show.

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
    """Yields what waits for SIGTERM or SIGINT; a second one of either ends the process the usual way.

    It waits for the byte that the interpreter's own handler writes. Waiting for a lock that a Python handler releases
    would miss a signal that comes between the last look for one and the sleep.
    """
    before: dict[int, Any] = {}
    receiver, sender = socket.socketpair()
    sender.setblocking(False)

    def no_more(number: int, _: object) -> None:
        for kind in before:
            signal.signal(kind, signal.SIG_DFL)

    def wait() -> None:
        while receiver.recv(1)[0] not in before:
            pass

    with receiver, sender:
        waking = signal.set_wakeup_fd(sender.fileno())
        try:
            for kind in (signal.SIGTERM, signal.SIGINT):
                before[kind] = signal.signal(kind, no_more)
            yield wait
        finally:
            signal.set_wakeup_fd(waking)
            for number, handler in before.items():
                signal.signal(number, handler)


def _resume(registry: ModelRegistry, store: ModelStore, threads: int | None) -> None:
    """Put the model back in service that was recalibrated from this bundle before a restart, if it can be used."""
    path = store.last()
    if path is None:
        return
    try:
        registry.swap(Decoder.load(path, threads))
    except (BundleError, CalibrationError) as error:
        _log.warning("serving %s as it was given: %s", registry.current.version, error)


@contextmanager
def _shown(console: Console, port: int | None, host: str) -> Iterator[None]:
    if port is None:
        yield
        return
    try:
        server = ConsoleServer(console, port, host)
    except OSError as error:
        raise InvalidInputError(f"--metrics-port {port}", error, "a free port of this machine") from None
    click.echo(f"metrics at http://{host}:{server.port}/metrics, console at http://{host}:{server.port}/")
    with server:
        yield
