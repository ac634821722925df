"""Pages that went wrong are kept in a bounded ring that other programs open, and no read waits for the disk."""

import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from lightpage.codec.page_bytes import Loss, PageBytes
from lightpage.errors import InvalidInputError, LimitError, Reason, UnconfirmedPageError
from lightpage.recording.reader import Recording
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.flight_recorder import FileRing, FlightRecorder, FlightSettings
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.runtime.service.pages.reading import read_page
from tests.runtime import toy
from tests.waiting import eventually

LOST = (230.0, 20.0)


@pytest.fixture
def registry(decoder: Decoder) -> Models:
    return Models(decoder)


def kept(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


def count(metrics: ServiceMetrics, result: str) -> float:
    return metrics.registry.get_sample_value("lightpage_flight_pages_total", {"result": result}) or 0.0


def read_lost(plane: DataPlane, pages: int) -> None:
    for _ in range(pages):
        with suppress(UnconfirmedPageError):
            read_page(plane, None, None, Caller())


def test_a_lost_page_is_kept_with_why(registry: Models, tmp_path: Path) -> None:
    source = toy.ToySource(toy.ToyDevice())
    with FlightRecorder(tmp_path / "flight", registry) as recorder:
        plane = DataPlane(registry, source, observers=[recorder])
        read_lost(plane, 2)
        source.device.offsets = LOST
        read_lost(plane, 1)
    (path,) = kept(tmp_path / "flight")
    with Recording.open(path) as recording:
        assert (recording.pages, recording.levels) == (1, 16)
        assert np.array_equal(recording.symbols(0), toy.symbols_of(16, 2)[0])  # type: ignore[arg-type]
        references = toy.ToyDevice().references()
        assert np.array_equal(recording.references().in_phase, references.in_phase)
    with h5py.File(path) as file:
        note = dict(file["flight"].attrs)
    told = [note[name] for name in ("reason", "subject", "model_version", "page_index")]
    assert told == ["PILOTS_DISAGREE", "page 2 of toy:device", "toy-1", 2]
    assert note["time_s"] > 1e9


@pytest.fixture
def seen(registry: Models) -> Observation:
    pair = toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16, 0.5)
    page = registry.current.decoder.decode(pair, 16)
    return Observation("page 1 of toy", 1, "toy-1", 1e9, 0.1, pair=pair, page=page)


def test_what_is_kept_and_what_not(registry: Models, seen: Observation, tmp_path: Path) -> None:
    monitor, metrics = Monitor(), ServiceMetrics()

    def at(step: float, loss: Loss | None = None, margin: float = 1.0) -> Observation:
        data = PageBytes(None, None if loss else b"x", None, loss, 1.0, 3, 4, 0, margin)
        return replace(seen, time_s=1e9 + step, user_data=data)

    with FlightRecorder(tmp_path, registry, monitor=monitor, metrics=metrics) as recorder:
        for one in (seen, at(0), replace(seen, lost=Reason.MISSING_FRAME, pair=None, page=None)):
            recorder.observe(one)
        recorder.observe(at(1, Loss.BODY))
        recorder.observe(at(2, None, 0.05))
        recorder.observe(at(3, None, 0.049))
        eventually(lambda: count(metrics, "kept") == 2)
        for _ in range(8):
            monitor.follow("toy-1", {"unread": 1.0})
        for one in (at(62.9), at(63), at(122.9), replace(at(200), of_device=False), at(123)):
            recorder.observe(one)
    assert count(metrics, "dropped") == 0
    kept_at = ["014641.000000-BODY_LOST", "014643.000000-LOW_MARGIN"]
    kept_at += ["014743.000000-RECALIBRATION_DUE", "014843.000000-RECALIBRATION_DUE"]
    assert [path.stem.partition("T")[2] for path in kept(tmp_path)] == kept_at
    with h5py.File(kept(tmp_path)[1]) as file:
        assert file["flight"].attrs["margin_bits"] == 0.049


def test_the_ring_is_bounded_and_goes_on_after_a_restart(registry: Models, tmp_path: Path) -> None:
    source = toy.ToySource(toy.ToyDevice(LOST))
    (tmp_path / "mine.txt").write_text("stays")
    (tmp_path / "page-x.h5.partial").write_text("cut off")
    for _ in range(2):
        with FlightRecorder(tmp_path, registry, FlightSettings(pages=3)) as recorder:
            plane = DataPlane(registry, source, observers=[recorder])
            read_lost(plane, 2)
    mine, *pages = kept(tmp_path)
    assert mine.name == "mine.txt"
    for number, path in enumerate(pages):
        with h5py.File(path) as file:
            assert file["flight"].attrs["page_index"] == 1 + number
    assert len(pages) == 3


def test_the_ring_is_bounded_in_bytes(tmp_path: Path) -> None:
    ring = FileRing(tmp_path, 10, 250)
    for second in range(4):
        ring.add(second, "A", lambda path: path.write_bytes(bytes(100)) and None)
    assert [path.name[:22] for path in ring.files()] == ["page-19700101T000002.0", "page-19700101T000003.0"]
    assert ring.add(3, "A", lambda path: path.write_bytes(bytes(100)) and None).name.endswith("-A-1.h5")
    with pytest.raises(LimitError, match="file"):
        ring.add(9, "A", lambda path: path.write_bytes(bytes(300)) and None)
    assert len(ring.files()) == 2
    with pytest.raises(KeyError):
        ring.add(9, "A", lambda path: dict[int, None]()[path.write_bytes(b"half")])


def test_a_disk_that_takes_nothing_hurts_no_read(registry: Models, tmp_path: Path) -> None:
    metrics, source = ServiceMetrics(), toy.ToySource(toy.ToyDevice(LOST))
    folder = tmp_path / "flight"
    with FlightRecorder(folder, registry, metrics=metrics) as recorder:
        plane = DataPlane(registry, source, observers=[recorder], metrics=metrics)
        folder.rmdir()
        folder.write_text("no folder")
        read_lost(plane, 3)
        source.device.offsets = toy.OFFSETS
        read_page(plane, None, None, Caller())
    assert count(metrics, "failed") + count(metrics, "dropped") == 3


def test_pages_are_dropped_where_the_disk_is_behind(
    registry: Models, seen: Observation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go, metrics = threading.Event(), ServiceMetrics()
    monkeypatch.setattr(FileRing, "add", lambda *_: go.wait())
    with FlightRecorder(tmp_path, registry, metrics=metrics) as recorder:
        for _ in range(20):
            recorder.observe(replace(seen, lost=Reason.PILOTS_DISAGREE))
        assert count(metrics, "dropped") >= 15
        go.set()
    assert count(metrics, "dropped") + count(metrics, "kept") == 20


def test_a_folder_that_cannot_be_made_is_refused(registry: Models, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInputError, match="folder"):
        FlightRecorder(tmp_path / "file" / "folder", registry)
