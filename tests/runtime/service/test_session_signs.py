"""Signs belong to whose pages show them: a caller's frames say nothing of the service's own device."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightpage.recording.frame_pair import FramePair
from runtime.decoding.decoder import Decoder
from runtime.errors import UnconfirmedPageError
from runtime.service.caller import Caller
from runtime.service.dataplane import DataPlane
from runtime.service.monitor import Monitor, MonitorSettings, SessionMonitors
from runtime.service.registry import ModelRegistry
from runtime.service.sessions import named_session
from runtime.service.settings import ServiceSettings
from tests.runtime import toy

PAGES = 8
"""Of another device, after which there is no doubt."""


def another_devices(seed: int) -> FramePair:
    return toy.ToyDevice((230.0, 20.0), seed=seed).page(toy.symbols_of(16, seed)[0], 16)


def own(seed: int) -> FramePair:
    return toy.ToyDevice(seed=seed).page(toy.symbols_of(16, seed)[0], 16)


def plane_of(decoder: Decoder, *device_sessions: str) -> DataPlane:
    monitor, source = Monitor(MonitorSettings(3)), toy.ToySource(toy.ToyDevice())
    return DataPlane(ModelRegistry(decoder), source, monitor=monitor, device_sessions=device_sessions)


def send(plane: DataPlane, pair: FramePair, session: str, stateless: bool = False) -> bool:
    """Whether a caller hears that a recalibration is due."""
    try:
        return plane.decode(pair, 16, Caller(session=session, stateless=stateless)).recalibration_due
    except UnconfirmedPageError as error:
        return error.recalibration_due


def due_sessions(plane: DataPlane) -> float | None:
    return plane.metrics.registry.get_sample_value("lightpage_sessions_due")


@pytest.mark.parametrize("session", ["session other", "connection ipv4:127.0.0.1:4000"])
def test_another_devices_frames_raise_their_own_sessions_flag_alone(session: str, decoder: Decoder) -> None:
    plane, woken = plane_of(decoder), list[bool]()
    assert plane.monitor is not None
    plane.monitor.listen(lambda: woken.append(True))
    for seed in range(PAGES):
        send(plane, another_devices(seed), session)
    assert send(plane, own(50), session)
    assert due_sessions(plane) == 1
    assert not send(plane, own(50), "session third")
    assert not plane.monitor.due
    assert not woken
    assert not plane.read_page(None, None, Caller()).answer.recalibration_due
    assert plane.monitor.state().pages == 1


def test_pages_of_the_source_feed_the_monitor_whatever_their_session(decoder: Decoder) -> None:
    plane = plane_of(decoder)
    assert plane.monitor is not None
    for caller in (Caller(), Caller(session="session a"), Caller(stateless=True)):
        plane.read_page(None, None, caller)
    assert plane.monitor.state().pages == 3


def test_a_session_that_is_named_as_the_device_feeds_the_monitor(decoder: Decoder) -> None:
    plane = plane_of(decoder, "session press-1")
    assert plane.monitor is not None
    for seed in range(PAGES):
        send(plane, another_devices(seed), "session press-1")
    assert plane.monitor.due
    assert due_sessions(plane) == 0
    assert plane.read_page(None, None, Caller()).answer.recalibration_due
    assert not send(plane, own(50), "session press-2")


def test_what_is_decoded_as_if_it_were_the_first_page_has_no_history(decoder: Decoder) -> None:
    plane = plane_of(decoder)
    for seed in range(PAGES):
        send(plane, another_devices(seed), "session a", stateless=True)
    assert not send(plane, own(50), "session a", stateless=True)
    assert due_sessions(plane) == 0


def test_sessions_begin_anew_with_a_model_and_are_bounded() -> None:
    monitors = SessionMonitors(MonitorSettings(3), most=5)
    monitors.begin("m")
    first = monitors.of("0")
    for number in range(20):
        for _ in range(PAGES):
            monitors.of(str(number)).follow("m", {"unread": 1.0})
    assert monitors.due() == 5
    assert monitors.of("19") is monitors.of("19")
    assert monitors.of("0") is not first
    monitors.begin("n")
    assert monitors.due() == 0
    monitors.of("19").follow("m", {"unread": 1.0})
    assert monitors.of("19").state().pages == 0


def test_the_setting_names_sessions_as_callers_do(tmp_path: Path) -> None:
    plain = ServiceSettings.model_validate({"self_calibration": {"device_sessions": ["press-1"]}})
    assert plain.device_sessions == [named_session("press-1", "")]
    tls = {name: str(tmp_path / name) for name in ("ca", "certificate", "key")}
    named = {"tls": tls, "self_calibration": {"device_sessions": ["controller/press-1"]}}
    assert ServiceSettings.model_validate(named).device_sessions == [named_session("press-1", "controller")]
    named["self_calibration"] = {"device_sessions": ["press-1"]}
    with pytest.raises(ValueError, match="device_sessions"):
        ServiceSettings.model_validate(named)


def test_frames_of_a_session_that_is_due_are_not_kept_as_the_devices(decoder: Decoder) -> None:
    plane = plane_of(decoder)
    seen = list[bool]()

    class Notes:
        def observe(self, observation: object) -> None:
            seen.append(observation.of_device)  # type: ignore[attr-defined]

    plane.observers = (Notes(),)
    send(plane, own(1), "session a")
    plane.read_page(None, None, Caller())
    assert seen == [False, True]


def test_figures_of_the_last_page_show_the_device(decoder: Decoder) -> None:
    plane = plane_of(decoder, "session press-1")
    value = plane.metrics.registry.get_sample_value
    plane.read_page(None, None, Caller())
    shown = value("lightpage_confidence_mean")
    dim = toy.ToyDevice(noise=60.0, seed=9).page(toy.symbols_of(16, 9)[0], 16)
    send(plane, dim, "session other")
    send(plane, another_devices(1), "session other")
    assert (value("lightpage_confidence_mean"), value("lightpage_recalibration_due")) == (shown, 0)
    assert value("lightpage_pages_total", {"model_version": "toy-1"}) == 2
    send(plane, dim, "session press-1")
    assert value("lightpage_confidence_mean") != shown
