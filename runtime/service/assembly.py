"""Builds what a service decodes with from its settings: models, source, data plane and recalibrator."""

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from lightpage.errors import LightpageError, LostShotError, SourceError
from lightpage.recording.pages import Pages
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.source import FrameSource, open_source
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.bundle.signature import BundleKey
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.model.execution.page_graph import check_steps
from lightpage.runtime.model.execution.providers import Provider
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.kept_pages import KeptPages
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.audit import AuditLog
from lightpage.runtime.service.models.loader import Loader
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.store import Store
from lightpage.runtime.service.monitoring.flight_recorder import FlightRecorder
from lightpage.runtime.service.monitoring.logs import PageLog
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.monitoring.observation import Observer
from lightpage.runtime.service.settings import ServiceSettings

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Assembly:
    """A service that nobody can call yet.

    Attributes:
        plane: its logic.
        recalibrator: recalibrator of its models.
        monitor: monitor of its device.
        kept: the last pages of its device, where it recalibrates itself by them; else None.
        source_name: name for people.
    """

    plane: DataPlane
    recalibrator: Recalibrator
    monitor: Monitor
    kept: KeptPages | None
    source_name: str


@contextmanager
def assembled(settings: ServiceSettings, observer: Observer) -> Iterator[Assembly]:
    """Yield the service that is meant by settings; what it holds is closed at the end.

    Args:
        settings: settings of the service.
        observer: observer of every page, told, before log and flight recorder are.

    Raises:
        LightpageError: bundle, store or source are not there, or do not go together.
    """
    service, flight = settings.service, settings.flight_recorder
    key = None if service.bundle_key is None else BundleKey(service.bundle_key)
    provider = Provider.parse(service.provider, service.engine_cache)
    bundle = Bundle.open(bundle_path(service.bundle), key=key)
    if bundle.is_estimator:
        check_steps(bundle, service.steps)
    elif service.steps is not None:
        _log.warning(
            "%s is of a network, so a limit of %d steps holds for other models alone", bundle.subject, service.steps
        )
    together, codes = settings.batches.batching(), service.code_threads
    base = Decoder(
        bundle, service.threads, provider=provider, code_threads=codes, batching=together, steps=service.steps
    )
    metrics = ServiceMetrics()
    monitor = Monitor(metrics=metrics)
    own = settings.self_calibration
    kept = KeptPages(settings.limits.kept_bytes) if own.is_on and not own.pages else None
    observers = [observer, PageLog(), *([] if kept is None else [kept])]
    with ExitStack() as stack:
        source = None
        store = stack.enter_context(Store(service.store, base.bundle))
        audit = AuditLog(store, settings.audit_file, settings.audit.file_bytes, settings.audit.kept)
        models = Models(base, store, Loader(tracker_for if service.tracking else NoTracker, key), audit)
        if service.source is not None:
            source = stack.enter_context(checked_source(service.source, service.pages, base))
            take_dark_frames(source)
        if flight.folder is not None:
            recorder = FlightRecorder(flight.folder, models, flight, monitor, metrics)
            observers.append(stack.enter_context(recorder))
        plane = DataPlane(
            models,
            source,
            settings.limits,
            metrics=metrics,
            observers=observers,
            monitor=monitor,
            device_sessions=settings.device_sessions,
        )
        together.pages.waits = plane.heart.waits
        if together.largest > 1:  # another model may have batches
            metrics.watch_batches(together.pages, lambda: plane.together)
        recalibrator = Recalibrator(plane, recordings=service.recordings)
        try:
            recalibrator.check_start()
        except LightpageError as error:
            _log.warning("recalibrations will be refused: %s", error)
        yield Assembly(plane, recalibrator, monitor, kept, "no source" if source is None else source.name)


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


def take_dark_frames(source: FrameSource) -> None:
    """Have a source mend its hot pixels; without dark frames they stay, and a page is read all the same."""
    try:
        source.dark_frames()
    except (LostShotError, SourceError) as error:
        _log.warning("no dark frames, so hot pixels are not mended: %s", error)
