"""The monitor says by many pages that a recalibration is due, and the service then recalibrates itself, seldom."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lightpage.codec.page_bytes import Loss, PageBytes
from lightpage.errors import CalibrationError, CallerLeft, InvalidInputError, Reason, SourceError, UnconfirmedPageError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_position import ImagePosition
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.recalibration.recalibration import Refit, RefitResult
from lightpage.runtime.service.caller import Caller, named_session
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.frames.frames import decode
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.jobs.self_calibration import SelfCalibration, SelfCalibrationSettings
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import Monitor, Monitors, MonitorSettings, PageFigures
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.runtime.service.pages.reading import read_page
from lightpage.runtime.service.settings import ServiceSettings
from tests.clock import HandClock
from tests.runtime import toy
from tests.runtime.slow_fit import SlowFit
from tests.waiting import eventually

MARGIN, NOISE = 0.126, 0.019
"""Of a quiet bench device."""


@pytest.fixture(scope="module")
def page(decoder: Decoder) -> DecodedPage:
    return decoder.decode(toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16, 0.5), 16)


def followed(monitor: Monitor, margins: np.ndarray | list[float], **others: float) -> list[bool]:
    """Whether a recalibration is due after each page."""
    due = []
    for margin in margins:
        monitor.follow("m", {"margin_bits": float(margin), "unread": float(margin < 0), **others})
        due.append(monitor.due)
    return due


def quiet(count: int, seed: int = 1, level: float = MARGIN) -> np.ndarray:
    return level + NOISE * np.random.default_rng(seed).standard_normal(count)


def test_a_quiet_week_raises_nothing_and_one_odd_page_neither() -> None:
    monitor, margins = Monitor(), quiet(2000)
    margins[100::50] = -1.0
    assert not any(followed(monitor, margins))
    assert monitor.state().pages == 2000


def test_a_gradual_drift_is_told_before_the_margin_is_gone() -> None:
    monitor, told = Monitor(), list[str]()
    monitor.listen(lambda: told.append("due"))
    followed(monitor, quiet(25))
    loss = MARGIN * (np.arange(60) / 60) ** 2
    due = followed(monitor, quiet(60, 3) - loss)
    assert 30 < due.index(True) < 55
    assert all(due[due.index(True) :])
    assert told == ["due"]


def test_a_knock_is_told_within_a_few_pages_and_a_device_that_reads_nothing_is_due_at_once() -> None:
    monitor = Monitor()
    followed(monitor, quiet(25))
    assert followed(monitor, [-0.5] * 6).index(True) <= 3
    assert followed(Monitor(), [-0.5] * 10).index(True) == 7
    assert followed(Monitor(), [MARGIN] * 10, page_due=1.0).index(True) == 7  # it had changed before the start


def test_hysteresis_it_is_taken_back_only_well_within_the_threshold() -> None:
    monitor = Monitor()
    followed(monitor, [MARGIN] * 20)
    (sign,) = [sign for sign in monitor.state().signs if sign.name == "margin_bits"]
    assert sign.raise_at == pytest.approx(0.5 * MARGIN)
    assert not any(followed(monitor, [0.6 * MARGIN] * 20))
    assert followed(monitor, [0.45 * MARGIN] * 10)[-1]
    assert all(followed(monitor, [0.6 * MARGIN] * 20))
    assert not followed(monitor, [0.8 * MARGIN] * 10)[-1]
    assert monitor.state().reasons == ()


def test_where_pages_differ_much_a_sign_is_raised_further_off() -> None:
    monitor, (sign,) = Monitor(), [sign for sign in MonitorSettings().signs if sign.name == "margin_bits"]
    followed(monitor, [0.1, 0.5] * 10)
    (found,) = [found for found in monitor.state().signs if found.name == "margin_bits"]
    noise = 1.25 * 1.4826 * 0.4 / math.sqrt(2 * sign.window)
    assert found.baseline == 0.5
    assert found.raise_at == pytest.approx(0.5 - sign.deviations * noise)


def test_a_new_model_starts_anew_and_pages_of_the_old_one_say_nothing() -> None:
    monitor = Monitor()
    followed(monitor, [*quiet(25), *([-0.5] * 10)])
    assert monitor.due
    monitor.begin("m+r1")
    assert (monitor.due, monitor.state().pages, monitor.state().model_version) == (False, 0, "m+r1")
    followed(monitor, [-0.5] * 10)
    assert monitor.state().pages == 0


@pytest.mark.parametrize(
    ("name", "usual", "drifted"),
    [
        *[("trust", 0.97, 0.8), ("share", 1.0, 0.9), ("air_bits", 7, 6.8)],
        *[("stroke_relative", -0.001, -0.004), ("stroke_relative", -0.001, 0.002)],
    ],
)
def test_pilots_tell_where_no_bytes_are_read(name: str, usual: float, drifted: float) -> None:
    monitor = Monitor()
    for value in [usual] * 40 + [drifted] * 30:
        monitor.follow("m", {name: value, "unread": 0.0})
    assert monitor.due
    assert monitor.state().reasons[0].startswith(name)


def test_a_restless_piston_is_shown_and_asks_for_no_recalibration() -> None:
    metrics = ServiceMetrics()
    monitor = Monitor(metrics=metrics)
    for step in [0.2] * 30 + [1.5] * 20:
        monitor.follow("m", {"piston_walk_rad": step, "unread": 0.0})
    assert not monitor.due
    value = metrics.registry.get_sample_value
    assert value("lightpage_monitor_sign_raised", {"sign": "piston_walk_rad"}) == 1
    assert value("lightpage_monitor_sign", {"sign": "piston_walk_rad"}) == 1.5
    assert value("lightpage_monitor_due") == 0


def observation(page: DecodedPage | None, **changes: object) -> Observation:
    return replace(Observation("p", 1, "m", 0.0, 0.1, page=page), **changes)  # type: ignore[arg-type]


def found(loss: Loss | None, margin: float) -> PageBytes:
    return PageBytes(None, None if loss else b"x", None, loss, 1.0, 0, 1, 0, margin)


def test_what_a_page_says_of_the_device(page: DecodedPage) -> None:
    figures = PageFigures()
    there = replace(page, piston_rad=3.0, image=ImagePosition(3.0, -4.0), stroke_relative=-0.01)
    told = figures.of(observation(there))
    assert (told["shift_px"], told["stroke_relative"]) == (5, -0.01)
    assert told["share"] == page.check.share
    assert told["page_due"] == 0
    assert not {"margin_bits", "piston_walk_rad"} & told.keys()
    poor = replace(page, check=replace(page.check, confirmed_bits=0.3 * page.check.claimed_bits))
    assert PageFigures().of(observation(poor))["page_due"] == poor.check.recalibration_due == 1
    assert "page_due" not in PageFigures().of(observation(poor, tells=False))
    assert told["air_bits"] == page.information_bits
    told = figures.of(observation(replace(page, piston_rad=-3.0), user_data=found(None, 0.1)))
    assert told["piston_walk_rad"] == pytest.approx(2 * math.pi - 6)
    assert (told["margin_bits"], told["unread"]) == (0.1, 0)
    told = figures.of(observation(page, user_data=found(Loss.BODY, 0.0)))
    assert (told["margin_bits"], told["unread"]) == (0, 1)
    told = figures.of(observation(page, user_data=found(Loss.HEADER, -0.3)))
    assert ("margin_bits" in told, told["unread"]) == (False, 0)
    lost = observation(page, lost=Reason.PILOTS_DISAGREE)
    assert figures.of(lost) == {"unread": 1}
    assert figures.of(replace(lost, tells=False)) == {}
    assert figures.of(observation(None, lost=Reason.MISSING_FRAME)) == {}


PAGES = 8
"""Of another device, after which there is no doubt."""


def another_devices(seed: int) -> FramePair:
    return toy.ToyDevice((230.0, 20.0), seed=seed).page(toy.symbols_of(16, seed)[0], 16)


def own(seed: int) -> FramePair:
    return toy.ToyDevice(seed=seed).page(toy.symbols_of(16, seed)[0], 16)


def plane_of(decoder: Decoder, *device_sessions: str) -> DataPlane:
    monitor, source = Monitor(MonitorSettings(3)), toy.ToySource(toy.ToyDevice())
    return DataPlane(Models(decoder), source, monitor=monitor, device_sessions=device_sessions)


def send(plane: DataPlane, pair: FramePair, session: str, stateless: bool = False) -> bool:
    """Whether a caller hears that a recalibration is due."""
    try:
        return decode(plane, pair, 16, Caller(session=session, stateless=stateless)).recalibration_due
    except UnconfirmedPageError as error:
        return error.recalibration_due


def due_sessions(plane: DataPlane) -> float | None:
    return plane.metrics.registry.get_sample_value("lightpage_sessions_due")


@pytest.mark.parametrize("session", ["session other", "connection ipv4:127.0.0.1:4000"])
def test_another_devices_frames_raise_their_own_sessions_flag_alone(session: str, decoder: Decoder) -> None:
    plane, woken = plane_of(decoder), list[bool]()
    assert plane.monitors.device is not None
    plane.monitors.device.listen(lambda: woken.append(True))
    for seed in range(PAGES):
        send(plane, another_devices(seed), session)
    assert send(plane, own(50), session)
    assert due_sessions(plane) == 1
    assert not send(plane, own(50), "session third")
    assert not plane.monitors.device.due
    assert not woken
    assert not read_page(plane, None, None, Caller()).answer.recalibration_due
    assert plane.monitors.device.state().pages == 1


def test_pages_of_the_source_feed_the_monitor_and_what_is_decoded_as_if_it_were_the_first_page_none(
    decoder: Decoder,
) -> None:
    plane, of_device = plane_of(decoder), list[bool]()
    assert plane.monitors.device is not None
    plane.monitors.observers = (SimpleNamespace(observe=lambda each: of_device.append(each.of_device)),)
    for caller in (Caller(), Caller(session="session a"), Caller(stateless=True)):
        read_page(plane, None, None, caller)
    assert plane.monitors.device.state().pages == 3
    send(plane, own(1), "session b")
    assert of_device == [True, True, True, False]
    for seed in range(PAGES):
        send(plane, another_devices(seed), "session a", stateless=True)
    assert not send(plane, own(50), "session a", stateless=True)
    assert due_sessions(plane) == 0


def test_a_session_that_is_named_as_the_device_feeds_the_monitor(decoder: Decoder) -> None:
    plane = plane_of(decoder, "session press-1")
    assert plane.monitors.device is not None
    for seed in range(PAGES):
        send(plane, another_devices(seed), "session press-1")
    assert plane.monitors.device.due
    assert due_sessions(plane) == 0
    assert read_page(plane, None, None, Caller()).answer.recalibration_due
    assert not send(plane, own(50), "session press-2")


def test_sessions_begin_anew_with_a_model_and_are_bounded() -> None:
    monitors = Monitors(Monitor(MonitorSettings(3)), most=5)

    def of(session: str) -> Monitor:
        found = monitors.of(Caller(session=session))
        assert found is not None
        return found

    monitors.begin("m")
    first = of("0")
    for number in map(str, range(20)):
        for _ in range(PAGES):
            of(number).follow("m", {"unread": 1.0})
    assert monitors.sessions_due() == 5
    assert of("19") is of("19")
    assert of("0") is not first
    monitors.begin("n")
    assert monitors.sessions_due() == 0
    of("19").follow("m", {"unread": 1.0})
    assert of("19").state().pages == 0


def test_the_setting_names_sessions_as_callers_do(tmp_path: Path) -> None:
    plain = ServiceSettings.model_validate({"self_calibration": {"device_sessions": ["press-1"]}})
    assert plain.device_sessions == [named_session("press-1", "")]
    tls = {name: str(tmp_path / name) for name in ("ca", "certificate", "key")}
    named = {"tls": tls, "self_calibration": {"device_sessions": ["controller/press-1"]}}
    assert ServiceSettings.model_validate(named).device_sessions == [named_session("press-1", "controller")]
    named["self_calibration"] = {"device_sessions": ["press-1"]}
    with pytest.raises(ValueError, match="device_sessions"):
        ServiceSettings.model_validate(named)


def test_figures_of_the_last_page_show_the_device(decoder: Decoder) -> None:
    plane = plane_of(decoder, "session press-1")
    value = plane.metrics.registry.get_sample_value
    read_page(plane, None, None, Caller())
    shown = value("lightpage_confidence_mean")
    dim = toy.ToyDevice(noise=60.0, seed=9).page(toy.symbols_of(16, 9)[0], 16)
    send(plane, dim, "session other")
    send(plane, another_devices(1), "session other")
    assert (value("lightpage_confidence_mean"), value("lightpage_recalibration_due")) == (shown, 0)
    assert value("lightpage_pages_total", {"model_version": "toy-1"}) == 2
    send(plane, dim, "session press-1")
    assert value("lightpage_confidence_mean") != shown


DRIFTED = (175.0, 110.0)
"""Frames contradict each other or pilots confirm nothing, and a re-fit reads all pages."""
BUSY_S = 5.0
OWN = SelfCalibrationSettings(pages=(100, 101), busy_s=BUSY_S)


@dataclass
class Loop:
    decoder: Decoder
    fit: Refit
    settings: SelfCalibrationSettings = OWN
    source: toy.ToySource = field(default_factory=lambda: toy.ToySource(toy.ToyDevice()))
    clock: HandClock = field(default_factory=HandClock)

    def __post_init__(self) -> None:
        self.monitor = Monitor(MonitorSettings(3))
        self.plane = DataPlane(Models(self.decoder), self.source, monitor=self.monitor)
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
                read_page(self.plane, None, None, Caller())
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
        return self.plane.models.current.version

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
    loop.plane.models.pin("toy-1+r1", True)
    with loop.running:  # a caller with lost pages is told at once
        assert loop.plane.heal is not None
        assert not loop.plane.heal(Caller(), "toy-1+r1", 2)


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


@pytest.mark.parametrize(("takes_s", "most_share", "pause_s"), [(0, 0.1, 60.0), (30, 0.05, 570.0)])
def test_a_success_is_followed_by_the_least_interval_and_takes_no_more_than_its_share_of_the_time(
    takes_s: float, most_share: float, pause_s: float, make: Make
) -> None:
    def slow(*given: Any) -> RefitResult:
        loop.clock.advance(takes_s)
        return toy.fit_references(*given)

    loop = make(slow, SelfCalibrationSettings(pages=(100, 101), most_share=most_share))
    loop.drift()
    assert loop.look() == "toy-1+r1"
    loop.source.device.offsets = toy.OFFSETS
    loop.read(10)
    assert loop.monitor.due
    assert loop.look(pause_s - 0.1) == "toy-1+r1"
    assert loop.look(0.1) == "toy-1+r2"


def test_one_that_brings_nothing_doubles_the_interval(loop: Loop) -> None:
    """Else a device that stays as it is would be recalibrated each minute, for ever."""
    loop.complain()
    assert loop.look() == "toy-1+r1"
    loop.complain()
    assert loop.look(119.9) == "toy-1+r1"
    assert loop.look(0.1) == "toy-1+r2"


def test_a_caller_who_has_lost_pages_waits_for_the_next_recalibration_and_for_none_that_may_not_begin_yet(
    loop: Loop,
) -> None:
    loop.drift()
    assert loop.monitor.due
    with loop.running:
        assert loop.plane.heal is not None
        assert not loop.plane.heal(Caller(), "toy-1", 1)  # one page may be spoilt
        assert loop.plane.heal(Caller(), "toy-1", 2)
        assert loop.version == "toy-1+r1"
        assert loop.plane.heal(Caller(), "toy-1", 2)  # somebody else had it healed
        assert not loop.plane.heal(Caller(), "toy-1+r1", 2)  # the last one was just now
        assert loop.version == "toy-1+r1"
    assert loop.plane.heal is None


def test_a_caller_waits_no_longer_than_it_has_time_and_not_where_it_has_left(make: Make) -> None:
    fit = SlowFit()
    loop = make(fit)
    with loop.running:
        loop.drift()
        assert fit.entered.wait(60)
        assert loop.plane.heal is not None
        with ThreadPoolExecutor(1) as pool:
            waits = pool.submit(loop.plane.heal, Caller(lambda: 5.0), "toy-1", 2)
            loop.clock.until_somebody_waits()
            loop.clock.advance(3.9)
            assert not waits.done()
            loop.clock.advance(0.2)
            assert waits.result(30) is False
        gone = Caller()
        gone.leave()
        with pytest.raises(CallerLeft):
            loop.plane.heal(gone, "toy-1", 2)


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
    with loop.running:
        loop.drift()
        assert fit.entered.wait(60)
        loop.source.device.offsets = toy.OFFSETS
        assert loop.read(5) == 0
    assert fit.ended.wait(60)
    assert loop.version == "toy-1"
    assert eventually(lambda: loop.count("dropped") == 1)
    assert not [each for each in threading.enumerate() if each.name == "lightpage-self-calibration"]


def test_pages_that_cannot_serve_are_refused_at_the_start(loop: Loop) -> None:
    loop.source.page_count = lambda: 102  # type: ignore[method-assign]
    SelfCalibration(loop.plane, loop.monitor, loop.recalibrator, SelfCalibrationSettings(pages=(100, 101)))
    with pytest.raises(InvalidInputError, match="calibration pages"):
        SelfCalibration(loop.plane, loop.monitor, loop.recalibrator, SelfCalibrationSettings(pages=(101, 102)))
