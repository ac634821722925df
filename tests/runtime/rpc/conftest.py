"""Services for tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from runtime.bundle.bundle import Bundle
from runtime.client.client import LightpageClient
from runtime.decoding.decoder import Decoder
from runtime.recalibration.outcome import Refit
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.limits import Limits
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry, TrackerFactory, no_tracker
from runtime.service.store import ModelStore
from tests.runtime import toy
from tests.runtime.rpc.stage import Running, Start


@pytest.fixture
def start(toy_zip: Path, tmp_path: Path) -> Iterator[Start]:
    """Starts services on free loopback ports and ends them."""
    running: list[Running] = []

    def begin(
        limits: Limits | None = None,
        fit: Refit = toy.fit_references,
        bundle: Path = toy_zip,
        store: Path | None = None,
        tracker: TrackerFactory = no_tracker,
        inference: bool = True,
    ) -> Running:
        source = toy.ToySource(toy.ToyDevice())
        registry = ModelRegistry(Decoder(Bundle.open(bundle), threads=1), tracker)
        models = ModelStore(store, registry.current.decoder.bundle) if store is not None else None
        plane = DataPlane(registry, source, models, limits)
        recalibrator = Recalibrator(plane, fit, tmp_path)
        server = LightpageServer(plane, recalibrator, inference=inference).start()
        client = LightpageClient(server.target, timeout_s=20)
        running.append(Running(plane, recalibrator, server, source, client))
        return running[-1]

    yield begin
    for service in running:
        service.client.close()
        service.server.stop(0.5)
