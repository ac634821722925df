"""Cameras, trigger, modulator and shutters make pages; what is lost is repeated, named and counted."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError, LimitError, PageError
from lightpage.progress import reporting
from lightpage.recording.pages import Pages, PagesWriter
from runtime.acquisition.camera_source import CameraSource, Exposures, View
from runtime.acquisition.page_store import PageStore
from runtime.acquisition.pairing import PairingSettings
from runtime.errors import LostShotError, Reason, SourceError
from tests.runtime import toy
from tests.runtime.acquisition.lab import Lab
from tests.told import Told

PAIRING = PairingSettings(tolerance_s=0.012, frame_s=0.15, quiet_s=0.04, spacing_s=0.032)


class LabModulator:
    """Shows pages and blocks beams in the lab."""

    name = "lab modulator"

    def __init__(self, lab: Lab, device: toy.ToyDevice) -> None:
        self.lab, self.device = lab, device
        self.shown: list[int] = []
        self.opened_for: list[int | None] = []
        self.beams: list[tuple[bool, bool]] = []
        self.pair = device.references()
        for which, camera in zip(("in_phase", "quadrature"), lab.cameras, strict=True):
            camera.frame_shape = toy.SHAPE
            camera._scene = lambda which=which: getattr(self.pair, which)  # type: ignore[misc]

    def show(self, symbols: np.ndarray, levels: int, page: int, timeout_s: float) -> None:
        self.lab.poll()
        self.shown.append(page)
        self.pair = self.device.page(symbols, levels, 0.1)

    def open(self, timeout_s: float, levels: int | None = None) -> None:
        self.opened_for.append(levels)

    def shows(self) -> bool:
        return True

    def let_through(self, *, signal: bool, reference: bool) -> None:
        self.lab.poll()
        self.beams.append((signal, reference))
        if not signal:
            self.pair = self.device.references()
        if not reference:
            dark = np.full(toy.SHAPE, 3, np.uint8)
            dark[2, 3] = 200
            self.pair = type(self.pair)(dark, dark.copy())

    def close(self) -> None:
        pass


def pages_of(tmp_path: Path, count: int = 3) -> Path:
    path = tmp_path / "pages.h5"
    with PagesWriter(path, toy.PROFILE, 16, {}) as writer:
        writer.append(np.stack([toy.symbols_of(16, number)[0] for number in range(count)]))
    return path


def source_of(
    lab: Lab, pages: PageStore, views: tuple[View, View] = (View(), View()), **exposures: int
) -> tuple[CameraSource, LabModulator]:
    modulator = LabModulator(lab, toy.ToyDevice())
    source = CameraSource(
        toy.PROFILE,
        (lab.cameras[0], lab.cameras[1]),
        lab,
        modulator,
        modulator,
        pages,
        PAIRING,
        Exposures(**exposures),
        views,
        "camera:lab",
    )
    return source, modulator


def test_pages_are_shown_and_photographed_by_number_or_in_turn(tmp_path: Path) -> None:
    lab = Lab()
    source, modulator = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))
    with source:
        source.check_against(toy.PROFILE)
        assert (source.levels, source.bit_depth) == (16, 8)
        shots = [source.shot() for _ in range(4)] + [source.shot(page=2)]
        assert [shot.page_index for shot in shots] == modulator.shown == [0, 1, 2, 0, 2]
        assert shots[1].symbols is not None
        assert (shots[1].symbols == toy.symbols_of(16, 1)[0]).all()
        expected = modulator.device.page(toy.symbols_of(16, 2)[0], 16, 0.1)
        assert shots[2].pair.in_phase.shape == expected.in_phase.shape
        assert shots[0].infos is not None
        assert [info.serial for info in shots[0].infos] == ["I", "Q"]
        assert source.shots_by_outcome() == {"TAKEN": 5}
        assert set(source.saturated_shares()) == {"I", "Q"}
        with pytest.raises(PageError, match=r"0\.\.2"):
            source.shot(page=3)


def test_a_lost_shot_is_repeated_while_the_page_is_on_display(tmp_path: Path) -> None:
    lab = Lab()
    source, _ = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))
    told: list[Reason] = []
    source.on_lost = lambda page, error: told.append(error.reason)
    with source:
        source.shot()
        lab.plan = lambda: lab.cameras[0].edge()
        assert source.shot(page=1).page_index == 1
        assert source.shots_by_outcome() == {"TAKEN": 2, "MISSING_FRAME": 1}
        assert told == [Reason.MISSING_FRAME]


def test_without_a_repeat_the_lost_page_is_named(tmp_path: Path) -> None:
    lab = Lab()
    source, _ = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))), repeats=0)
    with source:
        source.shot()
        lab.plan = lambda: None
        with pytest.raises(LostShotError, match=r"page 2 of camera:lab: I: frame") as raised:
            source.shot(page=2)
        assert raised.value.reason is Reason.MISSING_FRAME


def test_a_device_that_comes_back_within_the_time_costs_no_page(tmp_path: Path) -> None:
    lab = Lab()
    source, _ = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))
    with source:
        source.shot()
        lab.cameras[1].gone = True

        def plug() -> None:
            lab.cameras[1].gone = False
            lab.cameras[1].restart()

        timer = threading.Timer(0.7, plug)
        timer.start()
        assert source.shot(10.0, page=1).page_index == 1
        timer.join()
        lab.gone = True
        begun = time.monotonic()
        with pytest.raises(LostShotError) as raised:
            source.shot(1.0, page=1)
        assert raised.value.reason is Reason.TRIGGER_GONE
        assert time.monotonic() - begun < 5


def test_a_camera_that_was_never_there_is_the_sources_fault(tmp_path: Path) -> None:
    lab = Lab()
    source, _ = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))

    def absent() -> None:
        raise SourceError("in-phase camera", "no camera", "one with serial 1")

    present, lab.cameras[0].arm = lab.cameras[0].arm, absent  # type: ignore[method-assign]
    with pytest.raises(SourceError, match="serial 1"):
        source.arm()
    lab.cameras[0].arm = present  # type: ignore[method-assign]
    source.arm()
    source._armed = False
    lab.cameras[0].arm = absent  # type: ignore[method-assign]
    with pytest.raises(LostShotError) as raised:  # it was there before, and may come back
        source.shot(0.1, page=0)
    assert raised.value.reason is Reason.CAMERA_GONE


def test_references_and_dark_frames_block_their_beams(tmp_path: Path) -> None:
    lab = Lab()
    source, modulator = source_of(
        lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))), reference_frames=2, dark_frames=2
    )
    with source:
        references = source.references()
        assert modulator.beams == [(False, True), (True, True)]
        before = modulator.device.references()
        assert (references.in_phase == before.in_phase).all()
        first, _ = source.dark_frames()
        assert modulator.beams[2:] == [(False, False), (True, True)]
        assert first.black_level == 3
        assert first.hot.tolist() == [[2, 3]]
        shot = source.shot(page=0)
        raw = modulator.pair.in_phase
        assert (shot.pair.in_phase[0] == np.maximum(raw[0], 3) - 3).all()
        assert shot.pair.in_phase[2, 3] <= np.sort(raw[1:4, 2:5].ravel())[-2]


def test_mirrored_cameras_are_set_upright(tmp_path: Path) -> None:
    lab = Lab()
    pages = PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path)))
    source, modulator = source_of(lab, pages, (View(flip_x=True), View(flip_y=True)))
    with source:
        shot = source.shot(page=0)
        assert (shot.pair.in_phase == modulator.pair.in_phase[:, ::-1]).all()
        assert (shot.pair.quadrature == modulator.pair.quadrature[::-1]).all()


def test_uploaded_pages_follow_those_of_the_file(tmp_path: Path) -> None:
    store = PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path, 2)))
    more = np.stack([toy.symbols_of(16, number)[0] for number in (7, 8)])
    assert store.append(more, 16) == 2
    assert len(store) == 4
    assert (store[3] == more[1]).all()
    with pytest.raises(InvalidInputError, match="16, as the pages before"):
        store.append(more % 8, 8)
    with pytest.raises(PageError):
        store.append(more, 4)
    with pytest.raises(PageError):
        store.append(more[:, :-1], 16)
    store.most_bytes = more.nbytes
    with pytest.raises(LimitError, match="uploaded pages"):
        store.append(more, 16)
    store.close()


def test_pages_for_another_profile_are_refused(tmp_path: Path) -> None:
    other = toy.PROFILE.model_copy(
        update={"page": toy.PROFILE.page.model_copy(update={"rows": toy.PROFILE.page.rows + 1})}
    )
    assert isinstance(other, Profile)
    with pytest.raises(InvalidInputError, match="symbols"):
        PageStore(other, Pages.open(pages_of(tmp_path)))


def test_an_empty_store_says_that_it_has_none() -> None:
    with pytest.raises(PageError, match="none was given or uploaded"):
        PageStore(toy.PROFILE)[0]


def test_a_trigger_that_never_arrives_is_told_soon(tmp_path: Path) -> None:
    lab = Lab()
    source, _ = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))), repeats=50)
    lab.cameras[1].edge = lambda *_, **__: None  # type: ignore[method-assign]  # its trigger is on another line
    with source:
        for take in (source.dark_frames, source.references, source.shot):
            begun = time.monotonic()
            with pytest.raises(LostShotError, match=r"Q: got no frame since.*trigger_source.*cable") as raised:
                take()
            assert raised.value.reason is Reason.MISSING_FRAME
            assert str(raised.value).endswith("(MISSING_FRAME)")
            assert time.monotonic() - begun < 3
        del lab.cameras[1].edge
        assert source.shot(page=0).page_index == 0


def test_what_is_done_is_told(tmp_path: Path) -> None:
    lab, told = Lab(), Told()
    source, _ = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))
    with source, reporting(told):
        source.shot()
        assert told.notes == ["cameras and trigger are synchronised"]


def test_pages_are_counted_where_they_are_shown() -> None:
    lab = Lab()
    source, _ = source_of(lab, PageStore(toy.PROFILE))
    assert source.page_count() == 0
    source.pages.append(toy.symbols_of(16, 1), 16)
    assert source.page_count() == 1
    source.modulator, source.pages = None, PageStore(toy.PROFILE)
    assert source.page_count() is None


def test_a_modulator_is_opened_for_its_pages_before_the_cameras(tmp_path: Path) -> None:
    lab = Lab()
    source, modulator = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))
    source.arm()
    source._armed = False
    source.arm()
    assert modulator.opened_for == [16]
    other, modulator = source_of(Lab(), PageStore(toy.PROFILE))

    def absent(timeout_s: float, levels: int | None = None) -> None:
        raise LostShotError("screen", "no window", "one", Reason.NOT_ON_DISPLAY)

    modulator.open = absent  # type: ignore[method-assign]
    with pytest.raises(SourceError, match="no window"):
        other.arm()
    assert not any(camera.opened for camera in other._cameras)


def test_devices_are_set_up_again_after_three_contradictions_in_a_row(tmp_path: Path) -> None:
    """As a camera whose trigger somebody has switched off: it sends frames that nobody asked for."""
    lab = Lab()
    source, _ = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))), repeats=0)
    camera = lab.cameras[0]
    free: list[bool] = []
    edge, arm = camera.edge, camera.arm

    def sent(*given: float, **how: float) -> None:
        for _ in range(1 + len(free)):
            edge(*given, **how)  # type: ignore[arg-type]

    def armed() -> None:
        free.clear()
        arm()

    camera.edge, camera.arm = sent, armed  # type: ignore[method-assign]
    with source:
        source.shot(page=0)
        free.append(True)
        for _ in range(3):
            with pytest.raises(LostShotError) as raised:
                source.shot(page=0)
            assert raised.value.reason is Reason.STRAY_FRAME
        assert source.shot(page=0).page_index == 0


def test_a_trigger_that_refuses_is_set_up_again(tmp_path: Path) -> None:
    lab = Lab()
    source, _ = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))
    fire, arm, refuses = lab.fire, lab.arm, [False]

    def fired() -> float:
        if refuses[0]:
            raise LostShotError(lab.name, "?8", "no refusal", Reason.TRIGGER_REFUSED)
        return fire()

    def armed() -> None:
        refuses[0] = False
        arm()

    lab.fire, lab.arm = fired, armed  # type: ignore[method-assign]
    with source:
        source.shot(page=0)
        refuses[0] = True
        assert source.shot(page=1).page_index == 1


@pytest.mark.parametrize(("bits", "told"), [(12, True), (10, True), (14, True), (16, False)])
def test_left_aligned_counts_are_told_once_and_saturate(tmp_path: Path, bits: int, told: bool) -> None:
    lab, heard = Lab(), Told()
    for camera in lab.cameras:
        camera.bit_depth = 16  # type: ignore[misc]
    source, _ = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))
    rng = np.random.default_rng(0)
    plain = np.minimum(rng.integers(0, 2**bits, toy.SHAPE), int(0.7 * 2**bits)).astype(np.uint16)
    clipped = np.where(plain > 0.5 * 2**bits, 2**bits - 1, plain).astype(np.uint16)
    seen = [plain << (16 - bits)]
    for camera in lab.cameras:
        camera._scene = lambda: seen[0]
    with source, reporting(heard):
        for _ in range(2):
            shot = source.shot(page=0)
        assert (shot.pair.in_phase == seen[0]).all()
        warned = [note for note in heard.notes if "left-aligned" in note]
        assert len(warned) == (2 if told else 0)  # of two cameras
        assert all(f"pixel_format of {bits} bits" in note for note in warned)
        seen[0] = clipped << (16 - bits)
        shot = source.shot(page=0)
        share = float((clipped == 2**bits - 1).mean())
        assert list(source.saturated_shares().values()) == [share, share]
        assert ((shot.pair.in_phase == 65535) == (clipped == 2**bits - 1)).all()
        seen[0] = np.full(toy.SHAPE, 65535 >> (16 - bits) << (16 - bits), np.uint16)  # too few counts to tell by
        source.shot(page=0)
        assert list(source.saturated_shares().values()) == [1.0, 1.0]
        assert len([note for note in heard.notes if "left-aligned" in note]) == len(warned)


def test_what_refuses_is_set_up_again_before_the_next_shot(tmp_path: Path) -> None:
    lab = Lab()
    source, _ = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))
    camera = lab.cameras[1]
    arm = camera.arm

    def refusing(timeout_s: float) -> None:
        raise SourceError("Q", "a refusal", "none")

    def armed() -> None:
        camera.__dict__.pop("frame", None)
        arm()

    camera.arm = armed  # type: ignore[method-assign]
    with source:
        source.shot(page=0)
        camera.frame = refusing  # type: ignore[assignment,method-assign]
        with pytest.raises(SourceError, match="a refusal"):
            source.shot(page=0)
        assert source.shot(page=0).page_index == 0


def test_nobody_waits_for_others_longer_than_it_wants(tmp_path: Path) -> None:
    source, modulator = source_of(Lab(), PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))
    held, leave = threading.Event(), threading.Event()
    show = modulator.show

    def slow(*given: Any) -> None:
        held.set()
        assert leave.wait(20)
        show(*given)

    modulator.show = slow  # type: ignore[method-assign]
    with source:
        other = threading.Thread(target=source.shot)
        other.start()
        assert held.wait(20)
        with pytest.raises(LostShotError) as raised:
            source.shot(0.05, page=1)
        assert raised.value.reason is Reason.MISSING_FRAME
        leave.set()
        other.join(20)


@pytest.mark.parametrize("seconds", [-1.0, 0.0])
def test_a_shot_without_time_is_lost(tmp_path: Path, seconds: float) -> None:
    source, _ = source_of(Lab(), PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))
    with source:
        with pytest.raises(LostShotError) as raised:
            source.shot(seconds, page=0)
        assert raised.value.reason in (Reason.MISSING_FRAME, Reason.NOT_SYNCHRONISED)
        assert source.shot(float("inf"), page=0).page_index == 0
