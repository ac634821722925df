"""A service recalibrates itself when the monitor says so, seldom, between reads, and no request fails because of it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import CalibrationError, InvalidInputError, LimitError
from runtime.acquisition.source import SHOT_S, Shot
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from runtime.errors import SourceError, UnconfirmedPageError
from runtime.recalibration.outcome import Refit, RefitResult
from runtime.service.caller import Caller
from runtime.service.dataplane import DataPlane
from runtime.service.monitor import Monitor, MonitorSettings
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from runtime.service.self_calibration import SelfCalibration, SelfCalibrationSettings
from tests.runtime import toy
from tests.runtime.rpc.test_service import slow_fit, wait_until

DRIFTED = (175.0, 110.0)
"""Frames contradict each other or pilots confirm nothing, and a re-fit reads all pages."""


class RecordedSource(toy.ToySource):
    """Knows which pages were photographed."""

    def __init__(self) -> None:
        super().__init__(toy.ToyDevice())
        self.shown: list[int] = []

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        found = super().shot(timeout_s, page)
        self.shown.append(found.page_index)
        return found


@dataclass
class Loop:
    plane: DataPlane
    monitor: Monitor
    recalibrator: Recalibrator
    source: RecordedSource
    seconds: float = 0.0
    running: list[SelfCalibration] = field(default_factory=list)

    def start(self, settings: SelfCalibrationSettings | None = None) -> SelfCalibration:
        settings = settings or SelfCalibrationSettings((100, 101), busy_s=0.02)
        self.running.append(SelfCalibration(self.plane, self.monitor, self.recalibrator, settings, self.clock))
        return self.running[-1].start()

    def clock(self) -> float:
        return self.seconds

    def read(self, count: int = 1) -> int:
        """Read pages; returns how many were lost."""
        lost = 0
        for _ in range(count):
            try:
                self.plane.read_page(None, None, Caller())
            except (UnconfirmedPageError, SourceError):
                lost += 1
        return lost

    def drift(self) -> None:
        self.source.device.offsets = DRIFTED
        self.read(8)

    @property
    def version(self) -> str:
        return self.plane.registry.current.version

    def count(self, result: str) -> float:
        value = self.plane.metrics.registry.get_sample_value
        return value("lightpage_recalibrations_total", {"result": result}) or 0.0


Make = Callable[..., Loop]


@pytest.fixture
def make(toy_zip: Path) -> Iterator[Make]:
    made: list[Loop] = []

    def begin(fit: Refit = toy.fit_references) -> Loop:
        registry, monitor = ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)), Monitor(MonitorSettings(3))
        source = RecordedSource()
        plane = DataPlane(registry, source, monitor=monitor)
        made.append(Loop(plane, monitor, Recalibrator(plane, fit), source))
        made[-1].read(8)
        return made[-1]

    yield begin
    for loop in made:
        for running in loop.running:
            running.stop()
        loop.recalibrator.close()


def test_a_drifted_device_is_recalibrated_and_read_again(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    loop = make()
    loop.start()
    assert loop.version == "toy-1"
    loop.drift()
    assert wait_until(lambda: loop.version == "toy-1+r1")
    assert [page for page in loop.source.shown if page >= 100] == [100, 101]  # reads may come between and behind
    assert wait_until(lambda: "toy-1+r1 in service" in caplog.text)
    assert not loop.monitor.due
    assert loop.monitor.state().model_version == "toy-1+r1"
    assert loop.read(8) == 0
    assert "begins, since unread" in caplog.text


def test_without_pages_of_its_own_the_next_two_serve(make: Make) -> None:
    loop = make()
    loop.start(SelfCalibrationSettings(busy_s=0.02))
    loop.drift()
    assert wait_until(lambda: loop.version == "toy-1+r1")
    assert loop.source.shown == list(range(18))


def test_a_pinned_model_stays_in_service_until_it_is_let_go_of(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    loop = make()
    loop.plane.models.pin("toy-1", True)
    loop.start(SelfCalibrationSettings(pages=(100, 101), busy_s=0.02))
    loop.drift()
    assert loop.monitor.due
    for _ in range(10):  # looked at again and again
        loop.seconds += 1
        time.sleep(0.03)
    assert loop.version == "toy-1"
    assert caplog.text.count("since the model in service is pinned") == 1
    assert not [page for page in loop.source.shown if page >= 100]
    loop.plane.models.pin("toy-1", False)
    loop.seconds += 1
    assert wait_until(lambda: loop.version == "toy-1+r1")


def refusing(*_: object) -> RefitResult:
    raise CalibrationError("known pages", "no significant peak", "a device within the capture range")


def test_after_a_refusal_it_waits_twice_as_long_each_time_and_nothing_changes(make: Make) -> None:
    loop = make(refusing)
    loop.start()
    loop.drift()
    for tries, wait_s in enumerate((120, 240, 480, 960, 1920, 3600, 3600), start=1):
        assert wait_until(lambda tries=tries: loop.count("refused") == tries)
        time.sleep(0.05)
        loop.seconds += wait_s - 1
        time.sleep(0.1)
        assert loop.count("refused") == tries
        loop.seconds += 1.5
    assert loop.version == "toy-1"
    assert loop.plane.registry.models == (loop.plane.registry.current,)


def test_a_success_is_followed_by_the_least_interval(make: Make) -> None:
    loop = make()
    loop.start()
    for number, offsets in enumerate((DRIFTED, toy.OFFSETS), start=1):
        loop.source.device.offsets = offsets
        loop.read(10)
        assert loop.monitor.due
        if number > 1:
            time.sleep(0.1)
            assert loop.version == f"toy-1+r{number - 1}"
            loop.seconds += 61
        assert wait_until(lambda number=number: loop.version == f"toy-1+r{number}")


def test_one_that_brings_nothing_doubles_the_interval(make: Make) -> None:
    """Else a device that stays as it is would be recalibrated each minute, for ever."""
    loop = make()
    loop.start()

    def complain() -> None:
        for _ in range(8):
            loop.monitor.follow(loop.version, {"unread": 1.0})

    complain()
    assert wait_until(lambda: loop.version == "toy-1+r1")
    complain()
    time.sleep(0.05)
    loop.seconds += 119
    time.sleep(0.2)
    assert loop.version == "toy-1+r1"
    loop.seconds += 2
    assert wait_until(lambda: loop.version == "toy-1+r2")


def test_a_device_that_had_changed_before_the_start_is_recalibrated(make: Make) -> None:
    """Its first pages are its baseline, so no sign that is measured from there can tell."""
    loop = make()
    loop.start()
    loop.monitor.begin(loop.version)
    for _ in range(7):
        loop.monitor.follow(loop.version, {"unread": 0.0, "share": 0.5, "page_due": 1.0})
    assert not loop.monitor.due
    loop.monitor.follow(loop.version, {"unread": 0.0, "share": 0.5, "page_due": 1.0})
    assert wait_until(lambda: loop.version == "toy-1+r1")


def test_a_source_without_known_symbols_fails_quietly_and_reads_go_on(
    make: Make, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    loop = make()
    shot = loop.source.shot

    def unknown(timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        found = shot(timeout_s, page)
        return Shot(found.pair, found.page_index)

    monkeypatch.setattr(loop.source, "shot", unknown)
    loop.start()
    loop.drift()
    assert wait_until(lambda: loop.count("failed") == 1)
    assert wait_until(lambda: "self-calibration: failed, next in 120 s" in caplog.text)
    loop.source.device.offsets = toy.OFFSETS
    assert loop.read(3) == 0


def test_never_while_another_recalibration_runs(make: Make) -> None:
    fit = slow_fit()
    loop = make(fit)

    def by_hand() -> None:
        with suppress(Exception):
            list(loop.recalibrator.from_source(2, [50, 51], Caller()))

    other = threading.Thread(target=by_hand)
    other.start()
    assert fit.entered.wait(10)
    loop.start()
    loop.drift()
    time.sleep(0.1)
    assert 100 not in loop.source.shown
    fit.go.set()
    other.join(10)
    assert loop.version == "toy-1+r1"


def test_it_stops_at_once_in_the_middle_of_a_recalibration(make: Make) -> None:
    fit = slow_fit()
    loop = make(fit)
    running = loop.start()
    loop.drift()
    assert fit.entered.wait(10)
    start = time.monotonic()
    running.stop()
    assert time.monotonic() - start < 5
    assert not running._thread.is_alive()
    assert fit.ended.wait(5)
    assert loop.version == "toy-1"
    assert wait_until(lambda: loop.count("dropped") == 1)


def test_reads_go_on_while_it_recalibrates(make: Make) -> None:
    fit = slow_fit()
    loop = make(fit)
    loop.start()
    loop.drift()
    assert fit.entered.wait(10)
    loop.source.device.offsets = toy.OFFSETS
    assert loop.read(5) == 0
    fit.go.set()


def test_pages_that_cannot_serve_are_refused_at_the_start(make: Make) -> None:
    for pages in ((1,), (1, 1)):
        with pytest.raises(InvalidInputError, match="calibration pages"):
            SelfCalibrationSettings(pages)
    loop = make()
    with pytest.raises(LimitError, match="calibration pages"):
        SelfCalibration(loop.plane, loop.monitor, loop.recalibrator, SelfCalibrationSettings(tuple(range(17))))
    loop.source.page_count = lambda: 102  # type: ignore[method-assign]
    with pytest.raises(InvalidInputError, match=r"calibration pages: got 102, wanted pages of .* 0\.\.101"):
        SelfCalibration(loop.plane, loop.monitor, loop.recalibrator, SelfCalibrationSettings((101, 102)))
    SelfCalibration(loop.plane, loop.monitor, loop.recalibrator, SelfCalibrationSettings((100, 101)))
    assert np.all(np.diff(loop.source.shown) == 1)
