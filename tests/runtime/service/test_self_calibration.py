"""A service recalibrates itself when the monitor says so, seldom, between reads, and no request fails because of it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest

from lightpage.errors import CalibrationError, InvalidInputError, LimitError
from runtime.acquisition.source import SHOT_S, Shot
from runtime.decoding.decoder import Decoder
from runtime.errors import SourceError, UnconfirmedPageError
from runtime.recalibration.outcome import Refit, RefitResult
from runtime.service.caller import Caller
from runtime.service.dataplane import DataPlane
from runtime.service.monitor import Monitor, MonitorSettings
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from runtime.service.self_calibration import SelfCalibration, SelfCalibrationSettings
from tests.clock import HandClock
from tests.runtime import toy
from tests.runtime.slow_fit import SlowFit
from tests.waiting import eventually

DRIFTED = (175.0, 110.0)
"""Frames contradict each other or pilots confirm nothing, and a re-fit reads all pages."""
BUSY_S = 5.0
OWN = SelfCalibrationSettings((100, 101), busy_s=BUSY_S)


class RecordedSource(toy.ToySource):
    def __init__(self) -> None:
        super().__init__(toy.ToyDevice())
        self.shown: list[int] = []

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        found = super().shot(timeout_s, page)
        self.shown.append(found.page_index)
        return found


@dataclass
class Loop:
    decoder: Decoder
    fit: Refit
    settings: SelfCalibrationSettings = OWN
    source: RecordedSource = field(default_factory=RecordedSource)
    clock: HandClock = field(default_factory=HandClock)

    def __post_init__(self) -> None:
        self.monitor = Monitor(MonitorSettings(3))
        self.plane = DataPlane(ModelRegistry(self.decoder), self.source, monitor=self.monitor)
        self.recalibrator = Recalibrator(self.plane, self.fit)
        self.running = SelfCalibration(self.plane, self.monitor, self.recalibrator, self.settings, self.clock)
        self.read(8)

    def look(self, later_s: float = 0.0) -> str:
        self.clock.advance(later_s)
        self.running.look()
        return self.version

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

    def complain(self) -> None:
        """Have the monitor say that a recalibration is due, though the device is as it was."""
        for _ in range(8):
            self.monitor.follow(self.version, {"unread": 1.0})

    @property
    def version(self) -> str:
        return self.plane.registry.current.version

    def count(self, result: str) -> float:
        value = self.plane.metrics.registry.get_sample_value
        return value("lightpage_recalibrations_total", {"result": result}) or 0.0


Make = Callable[..., Loop]


@pytest.fixture
def make(decoder: Decoder) -> Iterator[Make]:
    made: list[Loop] = []

    def begin(fit: Refit = toy.fit_references, settings: SelfCalibrationSettings = OWN) -> Loop:
        made.append(Loop(decoder, fit, settings))
        return made[-1]

    yield begin
    for loop in made:
        loop.recalibrator.close()


def test_a_drifted_device_is_recalibrated_and_read_again(loop: Loop, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    assert loop.look() == "toy-1"
    with loop.running:
        loop.drift()  # wakes it
        eventually(lambda: "toy-1+r1 in service" in caplog.text)
    assert loop.version == "toy-1+r1"
    assert [page for page in loop.source.shown if page >= 100] == [100, 101]
    assert not loop.monitor.due
    assert loop.read(8) == 0


def test_a_thread_looks_again_when_the_time_of_the_next_try_has_come(
    loop: Loop, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    loop.plane.models.pin("toy-1", True)
    loop.complain()
    with loop.running:
        eventually(lambda: "is pinned" in caplog.text)
        loop.clock.until_somebody_waits()
        loop.plane.models.pin("toy-1", False)
        loop.clock.advance(BUSY_S - 0.1)
        loop.clock.until_somebody_waits()
        assert loop.version == "toy-1"
        loop.clock.advance(0.1)
        eventually(lambda: loop.version == "toy-1+r1")


@pytest.fixture
def loop(make: Make) -> Loop:
    return make()


def test_without_pages_of_its_own_the_next_two_serve(make: Make) -> None:
    loop = make(settings=SelfCalibrationSettings())
    loop.drift()
    assert loop.look() == "toy-1+r1"
    assert loop.source.shown == list(range(18))


def test_a_pinned_model_stays_in_service_until_it_is_let_go_of(loop: Loop) -> None:
    loop.plane.models.pin("toy-1", True)
    loop.drift()
    assert {loop.look(BUSY_S) for _ in range(3)} == {"toy-1"}
    assert not [page for page in loop.source.shown if page >= 100]
    loop.plane.models.pin("toy-1", False)
    assert loop.look(BUSY_S) == "toy-1+r1"


def refusing(*_: object) -> RefitResult:
    raise CalibrationError("fit", "nothing", "a device within reach")


def test_after_a_refusal_it_waits_twice_as_long_each_time_and_nothing_changes(make: Make) -> None:
    loop = make(refusing)
    loop.drift()
    loop.look()
    for tries, wait_s in enumerate((120, 240, 480, 960, 1920, 3600, 3600), start=1):
        loop.look(wait_s - 0.1)
        assert loop.count("refused") == tries
        loop.look(0.1)
        assert loop.count("refused") == tries + 1
    assert loop.version == "toy-1"


def test_a_success_is_followed_by_the_least_interval(loop: Loop) -> None:
    loop.drift()
    assert loop.look() == "toy-1+r1"
    loop.source.device.offsets = toy.OFFSETS
    loop.read(10)
    assert loop.monitor.due
    assert loop.look(59.9) == "toy-1+r1"
    assert loop.look(0.1) == "toy-1+r2"


def test_one_that_brings_nothing_doubles_the_interval(loop: Loop) -> None:
    """Else a device that stays as it is would be recalibrated each minute, for ever."""
    loop.complain()
    assert loop.look() == "toy-1+r1"
    loop.complain()
    assert loop.look(119.9) == "toy-1+r1"
    assert loop.look(0.1) == "toy-1+r2"


def test_never_while_another_recalibration_runs(make: Make) -> None:
    fit = SlowFit()
    loop = make(fit)
    job = loop.recalibrator.start(loop.recalibrator.source_pages(2, [50, 51]))
    assert fit.entered.wait(60)
    loop.complain()
    loop.look()
    assert 100 not in loop.source.shown
    fit.go.set()
    assert loop.recalibrator.jobs.wait_idle(60)
    assert loop.recalibrator.jobs.job(job.id).result.model_version == loop.version == "toy-1+r1"
    loop.complain()
    assert loop.look(BUSY_S - 0.1) == "toy-1+r1"
    assert loop.look(0.1) == "toy-1+r2"


def test_reads_go_on_while_it_recalibrates_and_it_stops_in_the_middle(make: Make) -> None:
    fit = SlowFit()
    loop = make(fit)
    running = loop.running.start()
    loop.drift()
    assert fit.entered.wait(60)
    loop.source.device.offsets = toy.OFFSETS
    assert loop.read(5) == 0
    running.stop(60.0)
    assert fit.ended.wait(60)
    assert loop.version == "toy-1"
    assert eventually(lambda: loop.count("dropped") == 1)
    assert not [each for each in threading.enumerate() if each.name == "lightpage-self-calibration"]


def test_pages_that_cannot_serve_are_refused_at_the_start(loop: Loop) -> None:
    for pages in ((1,), (1, 1)):
        with pytest.raises(InvalidInputError, match="calibration pages"):
            SelfCalibrationSettings(pages)
    loop.source.page_count = lambda: 102  # type: ignore[method-assign]
    SelfCalibration(loop.plane, loop.monitor, loop.recalibrator, SelfCalibrationSettings((100, 101)))
    for pages, error in ((tuple(range(17)), LimitError), ((101, 102), InvalidInputError)):
        with pytest.raises(error, match="calibration pages"):
            SelfCalibration(loop.plane, loop.monitor, loop.recalibrator, SelfCalibrationSettings(pages))
