"""No two frames of different shots ever make a pair, whatever goes wrong."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from lightpage.errors import LostShotError, Reason
from lightpage.recording.layout import FrameInfo
from lightpage.runtime.device.acquisition.pairing import Pairing, PairingSettings
from lightpage.runtime.device.cameras.camera import Frame
from tests.runtime.device.acquisition.lab import Lab

SETTINGS = PairingSettings(tolerance_s=0.012, frame_s=0.15, quiet_s=0.05, spacing_s=0.032)
SYNCHRONISING = 3  # shots
SUBJECTS = ("I", "frame", "frame number", "frames", "page", "shot", "cameras", "synchronisation", "lab trigger")


class Bench:
    def __init__(self) -> None:
        self.lab = Lab()
        self.clock = self.lab.clock
        self.cameras = self.lab.cameras
        self.pairing = Pairing(self.cameras, self.lab, SETTINGS, self.clock)

    def shot(self, seconds: float = 10.0, displayed: Callable[[], bool] = lambda: True) -> Reason | None:
        """Why a shot was lost; None for a pair, which must show the page."""
        try:
            frames = self.pairing.shot(self.clock.now() + seconds, self.lab.display, displayed)
        except LostShotError as error:
            assert error.subject.removeprefix("I: ").removeprefix("Q: ") in SUBJECTS  # noqa: PT017
            return error.reason
        for frame in frames:
            assert frame.pixels[0, 0] == self.lab.page % 251
        return None

    def fired(self) -> int:
        """How often the trigger has fired since this was asked last."""
        count = len(self.lab.fired)
        self.lab.fired.clear()
        return count

    def plan(self, *edges: dict[str, Any] | None, twice_s: float | None = None) -> None:
        """What becomes of the next edge at each camera, and when the first camera has another one."""

        def plan() -> None:
            for camera, edge in zip(self.cameras, edges, strict=True):
                if edge is not None:
                    camera.edge(**edge)
            if twice_s is not None:
                self.cameras[0].edge(twice_s)

        self.lab.plan = plan

    def late(self, first_s: float, second_s: float) -> None:
        """The next edge exposes each camera so much later."""
        self.plan({"after_s": first_s}, {"after_s": second_s})


@pytest.fixture
def bench() -> Bench:
    """A lab whose first pair was taken."""
    made = Bench()
    assert made.shot() is None
    made.fired()
    return made


def test_pairs_show_the_page_over_the_wrap_of_numbers_after_triggers_at_unequal_distances() -> None:
    bench = Bench()
    begun = bench.clock.now()
    bench.shot()
    times = np.array(bench.lab.fired)
    assert times[0] - begun == pytest.approx(2 * SETTINGS.quiet_s)
    assert np.diff(times) == pytest.approx([0.032 + 3 * 0.012, 0.032 + 7 * 0.012, 0.032])
    assert [bench.shot() for _ in range(11)] == 11 * [None]
    assert bench.fired() == 12 + SYNCHRONISING
    assert bench.cameras[0].id == 9


def test_a_page_stands_for_the_tolerance_before_its_trigger_and_triggers_keep_their_distance(bench: Bench) -> None:
    last = bench.lab.fired
    bench.clock.advance(1.0)
    displayed = bench.clock.now()
    bench.shot()
    bench.shot()
    assert last == pytest.approx([displayed + SETTINGS.tolerance_s, displayed + 0.012 + SETTINGS.spacing_s])


FAULTS: dict[str, tuple[Sequence[dict[str, Any] | None], dict[str, float], list[Reason | None]]] = {
    "missed by one": ([{}, None], {}, [Reason.MISSING_FRAME]),
    "missed by both": ([None, None], {}, [Reason.MISSING_FRAME]),
    "one late": ([{"after_s": 0.04}, {}], {}, [Reason.OTHER_SHOT]),
    "both late": (2 * [{"after_s": 0.05}], {}, [Reason.OTHER_SHOT]),
    "doubled": ([{}, {}], {"twice_s": 0.004}, [None, Reason.STRAY_FRAME]),
    "packets lost": ([{}, {"whole": False}], {}, [Reason.INCOMPLETE_FRAME]),
    "too late": (2 * [{"delivery_s": 0.3}], {}, [Reason.MISSING_FRAME, None, None, None, None, Reason.STRAY_FRAME]),
}
"""What becomes of an edge, and of the shots from then on until one is right again."""


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_named_and_the_shots_after_it_are_right(bench: Bench, fault: str) -> None:
    edges, more, outcomes = FAULTS[fault]
    bench.plan(*edges, **more)
    assert [bench.shot() for _ in range(9)] == outcomes + (9 - len(outcomes)) * [None]


def test_no_wrong_pair_among_shots_with_many_faults() -> None:
    bench, rng, outcomes = Bench(), np.random.default_rng(5), Counter[Reason | None]()
    for _ in range(400):
        if rng.random() < 0.4:
            edges, more, _ = FAULTS[str(rng.choice(list(FAULTS)))]
            bench.plan(*edges, **more)
        if rng.random() < 0.05:
            bench.cameras[int(rng.integers(2))].restart()
        outcomes[bench.shot()] += 1
    assert outcomes[None] > 200
    assert {Reason.MISSING_FRAME, Reason.OTHER_SHOT, Reason.STRAY_FRAME, Reason.INCOMPLETE_FRAME} < set(outcomes)


@pytest.mark.parametrize(("first_s", "second_s", "taken"), [(0.0119, 0, True), (0, 0.0119, True), (0, 0.0121, False)])
def test_a_frame_counts_within_the_tolerance(bench: Bench, first_s: float, second_s: float, taken: bool) -> None:
    bench.late(first_s, second_s)
    assert bench.shot() is (None if taken else Reason.OTHER_SHOT)


@pytest.mark.parametrize(("after_s", "taken"), [(0.0129, True), (0.0131, False)])
def test_the_reference_follows_by_a_tenth(bench: Bench, after_s: float, taken: bool) -> None:
    for camera in bench.cameras:
        camera.pace = 1.0
    bench.pairing.forget()
    assert bench.shot() is None
    bench.late(0.01, 0.01)
    assert bench.shot() is None
    bench.late(after_s, after_s)
    assert bench.shot() is (None if taken else Reason.OTHER_SHOT)


def test_a_reference_expires_before_clocks_can_have_drifted_by_a_quarter_of_the_tolerance(bench: Bench) -> None:
    assert SETTINGS.expires_s == pytest.approx(0.012 / 4 / 1e-4)
    PairingSettings(tolerance_s=0.04, spacing_s=0.1)  # just far enough
    with pytest.raises(ValidationError, match="spacing"):
        PairingSettings(tolerance_s=0.041, spacing_s=0.1)
    for waited, shots in ((SETTINGS.expires_s - 1, 1), (SETTINGS.expires_s + 1, 1 + SYNCHRONISING)):
        bench.clock.advance(waited)
        assert bench.shot() is None
        assert bench.fired() == shots


def test_a_trigger_from_elsewhere_is_never_believed(bench: Bench) -> None:
    for camera in bench.cameras:
        camera.edge(after_s=0.025)
    assert [bench.shot() for _ in range(2)] == [Reason.STRAY_FRAME, None]


def test_a_page_that_is_taken_away_is_not_given_out(bench: Bench) -> None:
    assert bench.shot(displayed=lambda: False) is Reason.NOT_ON_DISPLAY


def test_devices_that_are_gone_are_named_at_once_and_synchronised_when_they_are_back(bench: Bench) -> None:
    begun = bench.clock.now()
    bench.lab.gone = True
    assert bench.shot() is Reason.TRIGGER_GONE
    bench.lab.gone, bench.cameras[0].gone = False, True
    assert bench.shot() is Reason.CAMERA_GONE
    assert bench.clock.now() - begun < 0.1
    bench.cameras[0].gone = False
    assert bench.shot() is None
    assert bench.fired() == 1 + SYNCHRONISING
    bench.cameras[1].restart()
    assert bench.shot() is None
    assert bench.fired() == 1 + SYNCHRONISING


def test_nothing_is_fired_after_the_deadline(bench: Bench) -> None:
    bench.clock.advance(1.0)
    assert bench.shot(0.011) is Reason.MISSING_FRAME  # the page is not on display for long enough by then
    assert bench.fired() == 0


def test_a_camera_that_no_trigger_has_ever_reached_is_given_up_after_three(bench: Bench) -> None:
    bench = Bench()
    bench.cameras[1].edge = lambda *_, **__: None  # type: ignore[method-assign]
    with pytest.raises(LostShotError) as raised:
        bench.pairing.shot(bench.clock.now() + 60)
    assert (raised.value.reason, raised.value.subject) == (Reason.MISSING_FRAME, "Q")
    assert bench.pairing.silent == ["Q"]
    assert bench.fired() == 3


def test_a_clock_whose_times_jump_is_not_synchronised() -> None:
    bench, rng = Bench(), np.random.default_rng(0)
    first, edge = bench.cameras[0], bench.cameras[0].edge

    def jumping() -> None:
        first.clock_s += float(rng.uniform(0.1, 1))
        edge()

    first.edge = jumping  # type: ignore[assignment,method-assign]
    assert bench.shot(60.0) is Reason.NOT_SYNCHRONISED
    assert bench.fired() == 8 * SYNCHRONISING
    assert bench.shot(1.0) is Reason.NOT_SYNCHRONISED
    assert bench.fired() == 4 * SYNCHRONISING


@pytest.mark.parametrize("change", [{"clock_s": 1e6 - 3.0}, {"id": 0, "clock_s": 5.0}, {"clock_s": 1e6 + 0.05}])
@pytest.mark.parametrize("both", [False, True])
def test_what_three_shots_contradict_is_learnt_anew(bench: Bench, change: dict[str, float], both: bool) -> None:
    for camera in bench.cameras[: 1 + both]:
        vars(camera).update(change)
    outcomes = [bench.shot() for _ in range(5)]
    assert set(outcomes[:3]) <= {Reason.OTHER_SHOT, Reason.SKIPPED_FRAME}
    assert outcomes[3:] == [None, None]


def test_single_contradictions_change_nothing(bench: Bench) -> None:
    for _ in range(3):
        for _ in range(2):
            bench.late(0.05, 0.05)
            assert bench.shot() is Reason.OTHER_SHOT
        bench.fired()
        assert bench.shot() is None
        assert bench.fired() == 1  # and no synchronisation
        assert not bench.pairing.distrusted


@pytest.mark.parametrize("last", [65535, 2**32 - 1])
@pytest.mark.parametrize("then", [0, 1, 2])
def test_a_counter_may_wrap_sooner_than_its_driver_says(last: int, then: int) -> None:
    bench = Bench()
    for camera in bench.cameras:
        camera.frame_numbers = 2**64 - 1
        camera.id = last - 4
        camera.follows = lambda number: then if number == last else number + 1
    assert bench.shot() is None
    assert bench.shot() is (None if then < 2 else Reason.SKIPPED_FRAME)


@pytest.mark.parametrize("frames_s", [0.0, 0.001])
def test_frames_without_end_end_the_shot(frames_s: float) -> None:
    """A frame is there whenever one is asked for, as of a camera that runs faster than its frames are fetched."""
    bench = Bench()

    def flooding(timeout_s: float) -> Frame:
        bench.clock.advance(frames_s)
        camera.id += 1
        info = FrameInfo("Q", camera.id, 0.0, 0.0, "Mono8")
        return Frame(np.zeros((4, 4), np.uint8), info)

    camera = bench.cameras[1]
    camera.frame = flooding  # type: ignore[method-assign]
    assert bench.shot(10.0) is Reason.STRAY_FRAME
    assert bench.shot(0.3) is Reason.STRAY_FRAME
    assert bench.fired() == 0
    del camera.frame
    assert bench.shot() is None
    bench.lab.plan = lambda: setattr(camera, "frame", flooding)  # it begins behind a trigger
    assert bench.shot() is Reason.MISSING_FRAME  # of the other camera
    assert bench.shot(0.3) is Reason.STRAY_FRAME
    del camera.frame
    assert bench.shot() is None


@pytest.mark.parametrize(("step", "outcome"), [(2, None), (16, None), (17, Reason.NOT_SYNCHRONISED)])
def test_numbers_may_grow_by_more_than_one(step: int, outcome: Reason | None) -> None:
    bench = Bench()
    bench.cameras[1].follows = lambda number: (number + step - 1) % 65535 + 1
    assert [bench.shot() for _ in range(3)] == 3 * [outcome]


def test_a_step_of_numbers_that_changes_is_learnt_anew(bench: Bench) -> None:
    bench.cameras[0].follows = lambda number: (number + 1) % 65535 + 1
    outcomes = [bench.shot() for _ in range(10)]
    assert outcomes.count(Reason.SKIPPED_FRAME) == 3
    assert outcomes[-4:] == 4 * [None]
