"""Services for tests."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.recalibration.recalibration import Refit
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.models.audit import AuditLog
from lightpage.runtime.service.models.loader import Loader, TrackerFactory
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.store import Store
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.server.server import LightpageServer
from tests.runtime import toy
from tests.runtime.service.stage import Running, Start


def begun(
    decoder: Decoder,
    recordings: Path | None = None,
    *,
    limits: Limits | None = None,
    fit: Refit = toy.fit_references,
    store: Path | None = None,
    tracker: TrackerFactory = NoTracker,
    source: Any = "toy",
    monitor: Monitor | None = None,
    audit: Path | None = None,
    **server: Any,
) -> Running:
    """A service, as `lightpage serve` starts one; further arguments are of `LightpageServer`."""
    shown = toy.ToySource(toy.ToyDevice()) if source == "toy" else source
    kept = Store(store, decoder.bundle)
    models = Models(decoder, kept, Loader(tracker), AuditLog(kept, audit))
    plane = DataPlane(models, shown, limits, monitor=monitor)
    recalibrator = Recalibrator(plane, fit, recordings)
    running = LightpageServer(plane, recalibrator, **server).start()
    return Running(plane, recalibrator, running, shown, LightpageClient(running.target, timeout_s=20))


@pytest.fixture
def start(decoder: Decoder, tmp_path: Path) -> Iterator[Start]:
    """Starts services on free loopback ports, whose recordings lie in the test's folder, and ends them."""
    running: list[Running] = []

    def begin(bundle: Path | None = None, **options: Any) -> Running:
        made = decoder if bundle is None else Decoder.load(bundle, threads=1)
        running.append(begun(made, **{"recordings": tmp_path, **options}))
        return running[-1]

    yield begin
    for service in running:
        service.end()


@pytest.fixture(scope="session")
def service(decoder: Decoder) -> Iterator[Running]:
    """One service for all tests that leave its models, its limits and its source as they are."""
    running = begun(decoder)
    yield running
    running.end()
