"""No two frames of different shots ever make a pair, whatever goes wrong."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from pydantic import ValidationError

from lightpage.recording.layout import FrameInfo
from runtime.acquisition.pairing import Pairing, PairingSettings
from runtime.cameras.camera import Frame, FrameStatus
from runtime.errors import LostShotError, Reason
from tests.runtime.acquisition.lab import Lab, LabCamera

SETTINGS = PairingSettings(tolerance_s=0.012, frame_s=0.15, quiet_s=0.05, spacing_s=0.032)


def pairing_of(lab: Lab) -> Pairing:
    return Pairing(lab.cameras, lab, SETTINGS)


def shoot(pairing: Pairing, lab: Lab, seconds: float = 10.0) -> tuple[int, int]:
    first, second = pairing.shot(time.monotonic() + seconds, lab.display, lambda: True)
    assert first.pixels is not None
    assert second.pixels is not None
    return int(first.pixels[0, 0]), int(second.pixels[0, 0])


def tried(pairing: Pairing, lab: Lab) -> Reason | None:
    """Why a shot was lost; None for a pair, which shows the page."""
    try:
        pair = shoot(pairing, lab)
    except LostShotError as error:
        return error.reason
    assert pair == (lab.page % 251, lab.page % 251)
    return None


def test_pairs_show_the_page_over_the_wrap_of_numbers() -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    for _ in range(12):
        assert shoot(pairing, lab) == (lab.page, lab.page)
    assert lab.fired == 12 + 3
    assert lab.cameras[0].id < 20


def faults(lab: Lab) -> dict[str, tuple[Callable[[], None], set[Reason]]]:
    first, second = lab.cameras

    def both(**how: float) -> None:
        for camera in lab.cameras:
            camera.edge(**how)  # type: ignore[arg-type]

    def doubled() -> None:
        both()
        first.edge(after_s=0.004)

    def incomplete() -> None:
        first.edge()
        second.edge(status=FrameStatus.INCOMPLETE)

    def missed_and_late() -> None:
        first.edge(after_s=0.04)
        second.edge()

    return {
        "missed by one": (lambda: first.edge(), {Reason.MISSING_FRAME}),
        "missed by both": (lambda: None, {Reason.MISSING_FRAME}),
        "one late": (missed_and_late, {Reason.OTHER_SHOT}),
        "both late": (lambda: both(after_s=0.05), {Reason.OTHER_SHOT}),
        "doubled": (doubled, {Reason.STRAY_FRAME, Reason.SKIPPED_FRAME}),
        "packets lost": (incomplete, {Reason.INCOMPLETE_FRAME}),
        "delivered too late": (lambda: both(delivery_s=0.3), {Reason.MISSING_FRAME}),
    }


@pytest.mark.parametrize("fault", list(faults(Lab())))
def test_each_fault_is_named_and_the_shot_after_it_is_right(fault: str) -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    shoot(pairing, lab)
    lab.plan, reasons = faults(lab)[fault]
    outcome = tried(pairing, lab)
    assert outcome in reasons or (fault == "doubled" and outcome is None)  # its second edge may spoil the next shot
    after = [tried(pairing, lab) for _ in range(9)]
    spoilt = {Reason.STRAY_FRAME, Reason.SKIPPED_FRAME} if fault in ("doubled", "delivered too late") else set()
    assert set(after) <= {None, *spoilt}
    assert after[-1] is None


def test_a_camera_that_was_restarted_is_synchronised_anew() -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    shoot(pairing, lab)
    lab.cameras[1].restart()
    before = lab.fired
    assert shoot(pairing, lab) == (lab.page, lab.page)
    assert lab.fired == before + 4


def test_a_queue_that_is_one_frame_behind_is_never_believed() -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    shoot(pairing, lab)
    for camera in lab.cameras:
        camera.edge(after_s=0.03)  # a trigger from elsewhere
    assert {tried(pairing, lab) for _ in range(2)} & {Reason.STRAY_FRAME, Reason.SKIPPED_FRAME}
    assert shoot(pairing, lab) == (lab.page, lab.page)


def test_a_page_that_is_taken_away_is_not_given_out() -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    with pytest.raises(LostShotError) as raised:
        pairing.shot(time.monotonic() + 5, lab.display, lambda: False)
    assert raised.value.reason is Reason.NOT_ON_DISPLAY


def test_devices_that_are_gone_are_named_at_once() -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    lab.gone = True
    begun = time.monotonic()
    with pytest.raises(LostShotError) as raised:
        shoot(pairing, lab)
    assert raised.value.reason is Reason.TRIGGER_GONE
    lab.gone, lab.cameras[0].gone = False, True
    with pytest.raises(LostShotError) as raised:
        shoot(pairing, lab)
    assert raised.value.reason is Reason.CAMERA_GONE
    assert time.monotonic() - begun < 5
    lab.cameras[0].gone = False
    assert shoot(pairing, lab) == (lab.page, lab.page)


def test_cameras_that_never_answer_end_with_the_time_of_the_shot() -> None:
    lab = Lab()
    for camera in lab.cameras:
        camera.edge = lambda *_, **__: None  # type: ignore[method-assign]
    begun = time.monotonic()
    with pytest.raises(LostShotError) as raised:
        shoot(pairing_of(lab), lab, seconds=1.0)
    assert raised.value.reason is Reason.MISSING_FRAME
    assert time.monotonic() - begun < 5


def test_a_clock_whose_times_jump_is_not_synchronised() -> None:
    lab = Lab()
    rng = np.random.default_rng(0)
    first = lab.cameras[0]
    edge = first.edge

    def jumping(after_s: float = 0.0, delivery_s: float = 0.001, status: FrameStatus = FrameStatus.COMPLETE) -> None:
        first.clock_s += float(rng.uniform(0.1, 1))
        edge(after_s, delivery_s, status)

    first.edge = jumping  # type: ignore[method-assign]
    with pytest.raises(LostShotError) as raised:
        shoot(pairing_of(lab), lab, seconds=1.0)
    assert raised.value.reason is Reason.NOT_SYNCHRONISED


def test_a_spacing_that_does_not_tell_shots_apart_is_refused() -> None:
    with pytest.raises(ValidationError, match="spacing"):
        PairingSettings(tolerance_s=0.05, spacing_s=0.06)


def test_no_wrong_pair_among_shots_with_many_faults() -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    rng = np.random.default_rng(5)
    outcome: Counter[str] = Counter()
    for _ in range(40):
        known = faults(lab)
        if rng.random() < 0.4:
            lab.plan = known[str(rng.choice(list(known)))][0]
        if rng.random() < 0.05:
            lab.cameras[int(rng.integers(2))].restart()
        lost = tried(pairing, lab)
        outcome["taken" if lost is None else lost.value] += 1
    assert outcome["taken"] >= 15
    assert sum(outcome.values()) == 40


def test_the_lab_itself_shows_what_is_on_display() -> None:
    camera = LabCamera("I", lambda: np.full((4, 4), 7, np.uint8))
    camera.edge(after_s=0.01)
    frame = camera.frame(0.0)
    assert frame is None
    frame = camera.frame(1.0)
    assert frame is not None
    assert frame.pixels is not None
    assert frame.pixels[0, 0] == 7


def clock_steps_back(camera: LabCamera) -> None:
    camera.clock_s -= 3.0


def clock_begins_anew(camera: LabCamera) -> None:
    camera.id, camera.clock_s = 0, 5.0


def clock_steps_by_a_little(camera: LabCamera) -> None:
    camera.clock_s += 0.05


@pytest.mark.parametrize("change", [clock_steps_back, clock_begins_anew, clock_steps_by_a_little])
@pytest.mark.parametrize("both", [False, True])
def test_what_three_shots_contradict_is_learnt_anew(change: Callable[[LabCamera], None], both: bool) -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    shoot(pairing, lab)
    for camera in lab.cameras[: 1 + both]:
        change(camera)
    outcomes = [tried(pairing, lab) for _ in range(5)]
    assert set(outcomes[:3]) <= {Reason.OTHER_SHOT, Reason.SKIPPED_FRAME}
    assert outcomes[3:] == [None, None]


def test_single_contradictions_change_nothing() -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    shoot(pairing, lab)
    for _ in range(3):
        for _ in range(2):
            lab.plan = faults(lab)["both late"][0]
            assert tried(pairing, lab) is Reason.OTHER_SHOT
        before = lab.fired
        assert tried(pairing, lab) is None
        assert lab.fired == before + 1  # and no synchronisation


@pytest.mark.parametrize(("last", "then"), [(65535, 0), (65535, 1), (2**32 - 1, 0), (2**32 - 1, 1)])
def test_a_counter_may_wrap_sooner_than_its_driver_says(last: int, then: int) -> None:
    lab = Lab()
    for camera in lab.cameras:
        camera.frame_numbers = 2**64 - 1
    channel = pairing_of(lab)._channels[0]
    channel.last_id, channel.step = last, 1
    pairing_of(lab)._checked(channel, frame_of(then))
    for other in (2, last, last - 1):
        with pytest.raises(LostShotError):
            pairing_of(lab)._checked(channel, frame_of(other))


@pytest.mark.parametrize("frames_s", [0.0, 0.001])
def test_frames_without_end_end_the_shot(frames_s: float) -> None:
    """A frame is there whenever one is asked for, as of a camera that runs faster than its frames are fetched."""
    lab = Lab()
    pairing = pairing_of(lab)
    asked: list[float] = []

    def flooding(timeout_s: float) -> Frame:
        asked.append(timeout_s)
        time.sleep(frames_s)
        return frame_of(len(asked))

    lab.cameras[1].frame = flooding  # type: ignore[method-assign]
    with pytest.raises(LostShotError) as raised:
        shoot(pairing, lab, seconds=0.3)
    assert raised.value.reason in (Reason.STRAY_FRAME, Reason.NOT_SYNCHRONISED)
    assert lab.fired == 0
    del lab.cameras[1].frame
    assert shoot(pairing, lab) == (lab.page, lab.page)


def test_a_flood_that_begins_behind_a_trigger_ends_the_shot() -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    shoot(pairing, lab)
    lab.plan = lambda: setattr(lab.cameras[0], "frame", lambda timeout_s: frame_of(lab.cameras[0].id))
    assert tried(pairing, lab) in (Reason.STRAY_FRAME, Reason.SKIPPED_FRAME, Reason.MISSING_FRAME)
    with pytest.raises(LostShotError):
        shoot(pairing, lab, seconds=0.3)
    del lab.cameras[0].frame
    assert shoot(pairing, lab) == (lab.page, lab.page)


def counting_by(camera: LabCamera, step: int) -> None:
    poll = camera.poll

    def polled() -> None:
        before = camera.id
        poll()
        if camera.id != before:
            camera.id = (camera.id + step - 2) % 65535 + 1

    camera.poll = polled  # type: ignore[method-assign]


@pytest.mark.parametrize("step", [2, 3])
def test_numbers_may_grow_by_more_than_one(step: int) -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    counting_by(lab.cameras[1], step)
    assert [tried(pairing, lab) for _ in range(6)] == 6 * [None]
    assert lab.fired == 6 + 3


def test_a_step_of_numbers_that_changes_is_learnt_anew() -> None:
    lab = Lab()
    pairing = pairing_of(lab)
    shoot(pairing, lab)
    counting_by(lab.cameras[0], 2)
    outcomes = [tried(pairing, lab) for _ in range(10)]
    assert outcomes.count(Reason.SKIPPED_FRAME) == 3
    assert outcomes[-4:] == 4 * [None]


def frame_of(number: int) -> Frame:
    info = FrameInfo("I", number, time.monotonic(), time.time(), "Mono8")
    return Frame(FrameStatus.COMPLETE, np.zeros((4, 4), np.uint8), info)
