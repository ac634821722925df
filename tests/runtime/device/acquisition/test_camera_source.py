"""Cameras, trigger, modulator and beams make pages; what goes wrong is repeated or mended, named and counted."""

import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from lightpage.errors import LostShotError, PageError, Reason, SourceError
from lightpage.progress import reporting
from lightpage.runtime.device.acquisition.beam_keeper import BeamKeeper
from lightpage.runtime.device.acquisition.camera_image import View
from lightpage.runtime.device.acquisition.camera_source import CameraSource
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.modulator.modulator import OperatorBeams
from lightpage.runtime.service.assembly import take_dark_frames
from tests.clock import HandClock
from tests.runtime import toy
from tests.runtime.device.acquisition.lab import PAIRING, Lab, pages_of, reason_of, source_of
from tests.told import Told
from tests.waiting import eventually


@pytest.fixture
def lab() -> Lab:
    return Lab()


@pytest.fixture
def pages(tmp_path: Path) -> PageStore:
    return pages_of(tmp_path)


def test_pages_are_shown_and_photographed_by_number_or_in_turn(lab: Lab, pages: PageStore) -> None:
    source, modulator = source_of(lab, pages, (View(flip_y=True), View()))
    told = Told()
    with source, reporting(told):
        source.check_against(toy.PROFILE)
        assert (source.levels, source.bit_depth) == (16, 8)
        shots = [source.shot() for _ in range(4)] + [source.shot(page=2)]
        assert [shot.page_index for shot in shots] == modulator.shown == [0, 1, 2, 0, 2]
        assert shots[1].symbols is not None
        assert (shots[1].symbols == toy.symbols_of(16, 1)[0]).all()
        assert (shots[-1].pair.in_phase == modulator.pair.in_phase[::-1]).all()
        assert (shots[-1].pair.quadrature == modulator.pair.quadrature).all()
        assert shots[0].infos is not None
        assert [info.serial for info in shots[0].infos] == ["I", "Q"]
        assert source.shots_by_outcome() == {"TAKEN": 5}
        full = float((modulator.pair.in_phase == 255).mean())
        assert source.saturated_shares() == {"I": full, "Q": float((modulator.pair.quadrature == 255).mean())}
        assert len(told.notes) == 1  # of the synchronisation
        with pytest.raises(PageError):
            source.shot(page=3)


@pytest.mark.parametrize("repeats", [0, 1])
def test_a_lost_shot_is_repeated_while_the_page_is_on_display(lab: Lab, pages: PageStore, repeats: int) -> None:
    source, modulator = source_of(lab, pages, repeats=repeats)
    told: list[tuple[int, Reason]] = []
    source.on_lost = lambda page, error: told.append((page, error.reason))
    with source:
        source.shot()
        lab.plan = lambda: lab.cameras[0].edge()
        if repeats:
            assert source.shot(page=1).page_index == 1
        else:
            with pytest.raises(LostShotError, match=r"^page 1"):
                source.shot(page=1)
        assert source.shots_by_outcome() == {"TAKEN": 1 + repeats, "MISSING_FRAME": 1}
        assert told == [(1, Reason.MISSING_FRAME)]
        assert modulator.shown == [0, 1]


def test_a_device_that_comes_back_within_the_time_costs_no_page(lab: Lab, pages: PageStore) -> None:
    source, _ = source_of(lab, pages)
    camera = lab.cameras[1]
    tried: list[float] = []

    def lost(page: int, error: LostShotError) -> None:
        tried.append(lab.clock.now())
        if len(tried) == 3:
            camera.gone = False
            camera.restart()

    with source:
        source.shot()
        camera.gone, source.on_lost = True, lost
        assert source.shot(10.0, page=1).page_index == 1
        assert np.diff(tried) == pytest.approx([0.5, 0.5])
        source.on_lost, lab.gone = (lambda page, error: None), True
        begun = lab.clock.now()
        assert reason_of(lambda: source.shot(1.4, page=1)) is Reason.TRIGGER_GONE
        assert 1.0 < lab.clock.now() - begun < 1.4


def test_a_camera_that_was_never_there_is_the_sources_fault(lab: Lab, pages: PageStore) -> None:
    source, modulator = source_of(lab, pages)
    camera = lab.cameras[0]

    def absent(*_: float) -> None:
        raise SourceError("in-phase camera", "no camera", "one with serial 1")

    camera.arm = absent  # type: ignore[method-assign]
    with pytest.raises(SourceError, match=r"^in-phase camera"):
        source.arm()
    del camera.arm
    source.arm()
    camera.frame = absent  # type: ignore[method-assign,assignment]
    with pytest.raises(SourceError):
        source.shot(page=0)
    camera.arm = absent  # type: ignore[method-assign]
    # It was there before, and may come back.
    assert reason_of(lambda: source.shot(0.1, page=0)) is Reason.CAMERA_GONE
    del camera.arm, camera.frame
    assert source.shot(page=0).page_index == 0
    assert modulator.opened_for == [16, 16]  # of both first attempts, and never again


def test_references_and_dark_frames_block_their_beams(lab: Lab, pages: PageStore) -> None:
    source, modulator = source_of(lab, pages, (View(), View(flip_x=True)), reference_frames=2, dark_frames=3)
    with source:
        references = source.references()
        assert modulator.beams == [(False, True), (True, True)]
        assert len(lab.fired) == 3 + 2
        before = modulator.device.references()
        assert (references.in_phase == before.in_phase).all()
        assert (references.quadrature == before.quadrature[:, ::-1]).all()
        first, _ = source.dark_frames()
        assert modulator.beams[2:] == [(False, False), (True, True)]
        assert len(lab.fired) == 3 + 2 + 3
        assert first.black_level == 3
        assert first.hot.tolist() == [[2, 3]]
        shot = source.shot(page=0)
        raw = modulator.pair.in_phase
        assert (shot.pair.in_phase[0] == np.maximum(raw[0], 3) - 3).all()
        assert shot.pair.in_phase[2, 3] <= np.sort(raw[1:4, 2:5].ravel())[-2]


def test_light_where_none_should_be_is_the_sources_fault_and_changes_nothing(lab: Lab, pages: PageStore) -> None:
    source, modulator = source_of(lab, pages, reference_frames=1, dark_frames=1)
    with source:
        source.dark_frames()
        lit = modulator.device.references().in_phase
        lab.cameras[0].scene = lambda: lit
        with pytest.raises(SourceError, match=r"^I: dark"):
            source.dark_frames()
        lab.cameras[0].scene = lambda: np.zeros_like(lit)
        with pytest.raises(SourceError, match=r"^camera:lab: reference"):
            source.references()
        lab.cameras[0].scene = lambda: modulator.pair.in_phase
        assert (source.shot(page=0).pair.in_phase[0] == np.maximum(modulator.pair.in_phase[0], 3) - 3).all()


def test_cameras_of_different_depths_are_the_sources_fault(lab: Lab, pages: PageStore) -> None:
    source, _ = source_of(lab, pages)
    lab.cameras[1].bit_depth = 12
    with pytest.raises(SourceError, match=r"^camera: cameras"):
        CameraSource(toy.PROFILE, (lab.cameras[0], lab.cameras[1]), lab, None, source.beams, pages, PAIRING)


def test_a_trigger_that_never_arrives_is_told_soon(lab: Lab, pages: PageStore) -> None:
    source, _ = source_of(lab, pages, repeats=50)
    lab.cameras[1].edge = lambda *_, **__: None  # type: ignore[method-assign]  # its trigger is on another line
    lost: list[int] = []
    with source:
        source.on_lost = lambda page, error: lost.append(page)
        for take in (source.dark_frames, source.references, source.shot):
            lab.fired.clear()
            assert reason_of(take) is Reason.MISSING_FRAME
            assert len(lab.fired) == 3
        assert lost == [-1, -1, 0]
        del lab.cameras[1].edge
        assert source.shot(page=0).page_index == 0


def test_pages_are_counted_where_they_are_shown(lab: Lab, pages: PageStore) -> None:
    source, _ = source_of(lab, PageStore(toy.PROFILE))
    assert (source.levels, source.page_count()) == (256, 0)
    source.pages.append(toy.symbols_of(16, 1), 16)
    assert source.page_count() == 1
    source.show_pages(pages)
    assert source.page_count() == 3
    source.modulator, source.pages = None, PageStore(toy.PROFILE)
    assert source.page_count() is None
    with source:
        assert [source.shot().page_index for _ in range(2)] == [0, 1]
        assert source.shot(page=7).symbols is None


def test_a_modulator_that_does_not_open_is_told_before_a_camera_is_looked_for(lab: Lab) -> None:
    source, modulator = source_of(lab, PageStore(toy.PROFILE))

    def absent(timeout_s: float, levels: int | None = None) -> None:
        raise LostShotError("screen", "no window", "one", Reason.NOT_ON_DISPLAY)

    modulator.open = absent  # type: ignore[method-assign]
    with pytest.raises(SourceError, match=r"^screen"):
        source.arm()
    assert not any(camera.opened for camera in lab.cameras)


refusing = Mock(side_effect=LostShotError("trigger", "?8", "no refusal", Reason.TRIGGER_REFUSED))


def test_devices_are_set_up_again_after_three_contradictions_in_a_row_and_a_refusal(lab: Lab, pages: PageStore) -> None:
    """As a camera whose trigger somebody has switched off: it sends frames that nobody asked for."""
    source, _ = source_of(lab, pages, repeats=0)
    camera, free = lab.cameras[0], list[bool]()
    edge = camera.edge
    camera.edge = lambda: [edge() for _ in range(1 + len(free))]  # type: ignore[assignment,method-assign,misc]
    camera.arm = free.clear  # type: ignore[method-assign]
    with source:
        source.shot(page=0)
        free.append(True)
        for _ in range(3):
            assert reason_of(lambda: source.shot(page=0)) is Reason.STRAY_FRAME
        assert source.shot(page=0).page_index == 0
        lab.fire = refusing  # type: ignore[method-assign]
        lab.arm = lambda: vars(lab).pop("fire", None)  # type: ignore[method-assign]
        assert reason_of(lambda: source.shot(page=1)) is Reason.TRIGGER_REFUSED
        assert source.shot(page=1).page_index == 1


@pytest.mark.parametrize(("bits", "told"), [(12, True), (16, False)])
def test_left_aligned_counts_are_told_once_and_saturate(lab: Lab, pages: PageStore, bits: int, told: bool) -> None:
    heard = Told()
    rng = np.random.default_rng(0)
    plain = np.minimum(rng.integers(0, 2**bits, toy.SHAPE), int(0.7 * 2**bits)).astype(np.uint16)
    clipped = np.where(plain > 0.5 * 2**bits, 2**bits - 1, plain).astype(np.uint16)
    few = np.full(toy.SHAPE, 2**bits - 1, np.uint16)  # too few counts to tell by
    seen = [plain]
    for camera in lab.cameras:
        camera.bit_depth = 16
    source, _ = source_of(lab, pages)
    for camera in lab.cameras:
        camera.scene = lambda: seen[0] << (16 - bits)
    with source, reporting(heard):
        _, shot = source.shot(page=0), source.shot(page=0)
        assert (shot.pair.in_phase == plain << (16 - bits)).all()
        seen[0] = clipped
        shot = source.shot(page=0)
        share = float((clipped == 2**bits - 1).mean())
        assert list(source.saturated_shares().values()) == [share, share]
        assert ((shot.pair.in_phase == 65535) == (clipped == 2**bits - 1)).all()
        seen[0] = few
        source.shot(page=0)
        assert list(source.saturated_shares().values()) == [1.0, 1.0]
    warned = [note for note in heard.notes if "left-aligned" in note]
    assert len(warned) == (2 if told else 0)  # of two cameras
    assert all(f" {bits} bits" in note for note in warned)


@pytest.mark.parametrize("seconds", [-1.0, 0.0])
def test_a_shot_without_time_is_lost(lab: Lab, pages: PageStore, seconds: float) -> None:
    source, _ = source_of(lab, pages)
    with source:
        assert reason_of(lambda: source.shot(seconds, page=0)) is Reason.MISSING_FRAME
        assert not lab.fired
        assert source.shot(float("inf"), page=0).page_index == 0


def test_everything_is_closed_whatever_becomes_of_the_others(lab: Lab, pages: PageStore) -> None:
    source, modulator = source_of(lab, pages)
    closed: list[str] = []

    def failing(name: str) -> None:
        closed.append(name)
        raise RuntimeError(name)

    for name, device in (("modulator", modulator), ("trigger", lab), *zip("IQ", lab.cameras, strict=True)):
        device.close = partial(failing, name)  # type: ignore[method-assign]
    with pytest.raises(RuntimeError):
        source.close()
    assert sorted(closed) == ["I", "Q", "modulator", "modulator", "trigger"]  # it moves the beams too


class LabBeams:
    """Two shutters; `failures` are what the next orders end with, each after the first shutter has moved."""

    name = "beams"

    def __init__(self) -> None:
        self.open = {"signal": False, "reference": True}
        self.failures: list[BaseException | None] = []
        self.orders: list[tuple[bool, bool]] = []
        self.clock = HandClock()
        self.keeper = BeamKeeper(self, threading.RLock(), "source", self.clock)

    def let_through(self, *, signal: bool, reference: bool) -> None:
        self.orders.append((signal, reference))
        self.open["signal"] = signal
        if self.failures and (failure := self.failures.pop(0)) is not None:
            raise failure
        self.open["reference"] = reference

    def close(self) -> None:
        pass


def lost() -> LostShotError:
    return LostShotError("beams", "no answer", "ok", Reason.BEAM_CONTROL_FAILED)


FAILURES = [lost, lambda: SourceError("beams", "OFF after ON was set", "ON"), KeyboardInterrupt]


@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.parametrize("while_blocked", [False, True])
def test_both_are_open_after_every_failure(failure: Callable[[], BaseException], while_blocked: bool) -> None:
    beams, error = LabBeams(), failure()
    beams.keeper.ensure_open()
    assert (all(beams.open.values()), beams.orders) == (True, [(True, True)])  # an earlier process may have blocked one
    beams.keeper.ensure_open()
    assert len(beams.orders) == 1
    beams.failures = [] if while_blocked else [error]
    with pytest.raises(type(error)), beams.keeper.blocked(signal=False, reference=False):
        raise error
    assert all(beams.open.values())
    assert beams.keeper.trouble == ""


@pytest.mark.parametrize("failure", FAILURES)
def test_what_could_not_be_opened_is_tried_until_it_is(
    failure: Callable[[], BaseException], caplog: pytest.LogCaptureFixture
) -> None:
    beams, error = LabBeams(), failure()
    beams.failures = [None, error, lost(), RuntimeError("a fault of the program"), lost()]
    expected = LostShotError if isinstance(error, SourceError) else type(error)
    with pytest.raises(expected), beams.keeper.blocked(signal=False, reference=False):
        pass
    for tried, pause_s in enumerate((0.5, 1.0, 2.0, 4.0), 2):
        beams.clock.until_somebody_waits()
        assert (len(beams.orders), beams.keeper.trouble == "") == (tried, False)
        beams.clock.advance(pause_s)
        eventually(lambda tried=tried: len(beams.orders) > tried)  # type: ignore[misc]
    eventually(lambda: len(caplog.records) == 2)
    assert beams.keeper.trouble == ""
    assert beams.orders == [(False, False)] + 5 * [(True, True)]
    assert [record.levelname for record in caplog.records] == ["ERROR", "WARNING"]


def test_nobody_asks_a_person_from_another_thread() -> None:
    def ask(sentence: str) -> None:
        if "through" in sentence:
            raise SourceError("operator", "nobody", "somebody")

    before = threading.active_count()
    keeper = BeamKeeper(OperatorBeams(ask), threading.RLock(), "source")
    with pytest.raises(LostShotError), keeper.blocked(signal=False, reference=True):
        pass
    assert keeper.trouble
    assert threading.active_count() == before


def test_closed_it_tries_no_more() -> None:
    beams = LabBeams()
    beams.failures = [None, lost()]
    with pytest.raises(LostShotError), beams.keeper.blocked(signal=False, reference=True):
        pass
    beams.clock.until_somebody_waits()
    beams.keeper.close()
    eventually(lambda: not any(thread.name == "lightpage-beams" for thread in threading.enumerate()))
    assert beams.keeper.trouble
    assert len(beams.orders) == 2


def test_no_page_is_taken_while_a_beam_may_be_blocked(lab: Lab, pages: PageStore) -> None:
    source, modulator = source_of(lab, pages, dark_frames=1, reference_frames=1)
    let_through, fails = modulator.let_through, [True]
    seen: list[str] = []
    scene = lab.cameras[0].scene
    lab.cameras[0].scene = lambda: (seen.append(source.trouble()), scene())[1]  # type: ignore[func-returns-value]

    def failing(*, signal: bool, reference: bool) -> None:
        if signal and fails:
            raise lost()
        let_through(signal=signal, reference=reference)

    modulator.let_through = failing  # type: ignore[method-assign]
    with source:
        take_dark_frames(source)  # as the service does when it starts
        assert set(seen) == {""}  # what is blocked for a purpose is no trouble
        assert source.trouble()
        fired = len(lab.fired)
        assert reason_of(lambda: source.shot(0.05, page=0)) is Reason.BEAM_CONTROL_FAILED
        assert len(lab.fired) == fired
        fails.clear()
        assert source.shot(5.0, page=0).page_index == 0
        assert (source.trouble(), modulator.beams[-1]) == ("", (True, True))


def test_whoever_waits_for_others_waits_no_longer_than_it_wants_and_hears_of_the_beams(
    lab: Lab, pages: PageStore
) -> None:
    source, modulator = source_of(lab, pages, reference_frames=1)
    moves, leave = threading.Semaphore(0), threading.Semaphore(0)

    def failing(*, signal: bool, reference: bool) -> None:
        moves.release()
        assert leave.acquire(timeout=60)
        if signal:
            raise lost()

    modulator.let_through = failing  # type: ignore[method-assign]
    with source:
        other = threading.Thread(target=reason_of, args=(source.references,))
        other.start()
        assert moves.acquire(timeout=60)
        assert reason_of(lambda: source.shot(0.01, page=0), source.name) is Reason.MISSING_FRAME
        leave.release(2)
        other.join(60)
        lab.clock.until_somebody_waits()
        lab.clock.advance(0.5)
        assert all(moves.acquire(timeout=60) for _ in range(2))
        assert reason_of(lambda: source.shot(0.01, page=0), source.name) is Reason.BEAM_CONTROL_FAILED
        leave.release(100)
