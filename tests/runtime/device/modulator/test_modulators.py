"""A monitor, a controller or a person shows pages and moves beams; what goes wrong loses that page alone."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray

from lightpage.errors import LostShotError, Reason, SourceError, WorkerError
from lightpage.helper_process import HelperProcess
from lightpage.runtime.device.modulator.external import ExternalBeams, ExternalModulator
from lightpage.runtime.device.modulator.lookup_table import linear_table
from lightpage.runtime.device.modulator.modulator import BeamState, OperatorBeams
from lightpage.runtime.device.modulator.screen.raster import Raster, ScreenSettings
from lightpage.runtime.device.modulator.screen.screen import ScreenModulator
from tests.clock import HandClock
from tests.lightpage.small import small_profile
from tests.runtime.device.acquisition.lab import reason_of
from tests.waiting import eventually

PROFILE = small_profile()
LEVELS = 16
SYMBOLS = np.random.default_rng(1).integers(0, LEVELS, PROFILE.page_shape, dtype=np.uint8)


@dataclass
class Window:
    """A window in memory: `fault` is what comes of the next thing that it is asked for."""

    clock: HandClock
    opens_s: float = 0.0
    refusal: str = ""
    fault: Callable[[], bool] | None = None
    dead: bool = False
    closed: bool = False
    pictures: list[NDArray[np.uint8]] = field(default_factory=list)

    def poll(self, timeout_s: float) -> bool:
        return timeout_s >= self.opens_s

    def answer(self) -> None:
        if self.refusal:
            raise SourceError("screen", self.refusal, "another")

    def ask(self, method: str, *image: NDArray[np.uint8], timeout_s: float) -> bool:
        if self.fault is not None:
            return self.fault()
        self.pictures.extend(image)
        return True

    def ended(self) -> bool:
        return self.dead

    def end(self) -> None:
        self.dead = self.closed = True


class Lab:
    def __init__(self) -> None:
        self.clock = HandClock()
        self.windows: list[Window] = []
        self.next = Window(self.clock)
        self.settings = ScreenSettings(rows_px=800, columns_px=1280, settle_s=0.5, x_display=":5")
        self.screen = ScreenModulator(self.settings, PROFILE, linear_table, self._open, self.clock)

    def _open(self, settings: ScreenSettings) -> HelperProcess:
        assert settings is self.settings
        if self.next.dead:
            raise WorkerError("window", "no process", "one")
        self.windows.append(self.next)
        self.next = Window(self.clock)
        return self.windows[-1]  # type: ignore[return-value]

    def show(self, timeout_s: float = 10.0) -> None:
        self.screen.show(SYMBOLS, LEVELS, 1, timeout_s)

    def lost(self, timeout_s: float = 10.0) -> None:
        assert reason_of(lambda: self.show(timeout_s), "page 1 ") is Reason.NOT_ON_DISPLAY
        assert not self.screen.shows()


@pytest.fixture
def lab() -> Lab:
    return Lab()


def test_a_page_counts_as_shown_when_the_liquid_crystal_has_settled(lab: Lab) -> None:
    assert not lab.screen.shows()
    begun = lab.clock.now()
    lab.show()
    assert lab.clock.now() - begun == 0.5
    assert lab.screen.shows()
    greys = linear_table(LEVELS)[SYMBOLS]
    assert (lab.windows[0].pictures[0] == Raster(PROFILE, lab.settings).image(greys)).all()
    lab.lost(0.45)
    lab.show(0.5)
    assert len(lab.windows) == 1


@pytest.mark.parametrize("fault", [Mock(side_effect=WorkerError("window", "nothing", "an answer")), lambda: False])
@pytest.mark.parametrize("behind", [True, False])
def test_a_window_that_fails_loses_a_page_and_is_opened_again(
    lab: Lab, fault: Callable[[], bool], behind: bool
) -> None:
    lab.show()
    lab.windows[0].fault = fault
    if behind:
        assert not lab.screen.shows()
    lab.lost()
    assert lab.windows[0].closed
    lab.show()
    assert (len(lab.windows), len(lab.windows[1].pictures)) == (2, 1)
    lab.windows[1].fault = lambda: False
    assert not lab.screen.shows()
    lab.windows[1].fault = None  # what covered it has gone
    assert lab.screen.shows()


def test_a_window_that_is_slow_to_open_is_waited_for_by_the_next_page(lab: Lab) -> None:
    lab.next.opens_s = 5.0
    lab.lost(4.9)
    lab.show(5.0)
    assert len(lab.windows) == 1


def test_a_server_that_was_never_there_is_the_sources_fault_and_one_that_has_gone_loses_pages(lab: Lab) -> None:
    lab.next.refusal = "no server"
    with pytest.raises(SourceError, match=r"^screen :5,"):
        lab.show()
    lab.show()
    lab.windows[-1].dead = True
    lab.next.refusal = "no server"
    for _ in range(2):
        lab.lost()
    lab.show()
    lab.screen.close()
    assert lab.windows[-1].closed
    assert not lab.screen.shows()
    lab.next.dead = True
    lab.lost()
    lab.next.dead = False
    lab.show()
    assert lab.screen.shows()


WAIT_S = 60.0

Start = Callable[..., "Future[None]"]


@pytest.fixture
def start() -> Iterator[Start]:
    """Runs a call in another thread."""
    with ThreadPoolExecutor() as pool:
        yield pool.submit


def show(modulator: ExternalModulator, page: int, timeout_s: float = WAIT_S) -> None:
    modulator.show(SYMBOLS, 4, page, timeout_s)


def test_show_waits_until_the_controller_says_that_the_page_is_on_display(start: Start) -> None:
    modulator = ExternalModulator()
    assert modulator.wanted() is None
    shown = start(show, modulator, 5)
    assert eventually(modulator.wanted) == 5
    modulator.announce(4)
    assert modulator.wanted() == 5
    assert not shown.done()
    assert not modulator.shows()
    modulator.announce(5)
    shown.result(WAIT_S)
    assert modulator.shows()
    assert modulator.wanted() is None
    modulator.announce(5)  # said twice
    assert modulator.shows()
    show(modulator, 5, 0.0)  # it needs no wait


@pytest.mark.parametrize("leave", [lambda m: m.announce(None), lambda m: m.announce(6), lambda m: m.close()])
def test_a_page_is_on_display_until_it_is_withdrawn_or_another_one_announced(
    leave: Callable[[ExternalModulator], None],
) -> None:
    modulator = ExternalModulator()
    modulator.announce(5)
    show(modulator, 5, 0.0)
    leave(modulator)
    assert not modulator.shows()
    modulator.announce(5)  # back again, but it was away
    assert not modulator.shows()
    show(modulator, 5)
    assert modulator.shows()


def test_a_page_that_nobody_shows_in_time_is_lost_and_named(start: Start) -> None:
    clock = HandClock()
    modulator = ExternalModulator(clock)
    shown = start(show, modulator, 7)
    clock.until_somebody_waits()
    modulator.announce(8)
    clock.advance(WAIT_S - 1)
    assert modulator.wanted() == 7
    clock.advance(1)
    with pytest.raises(LostShotError, match=r"^page 7") as lost:
        shown.result(WAIT_S)
    assert lost.value.reason is Reason.NOT_ON_DISPLAY
    assert lost.value.got.startswith("page 8")
    assert not modulator.shows()
    assert modulator.wanted() is None


def test_beams_are_waited_for_in_the_same_way(start: Start) -> None:
    beams = ExternalBeams(WAIT_S)
    moved = start(beams.let_through, signal=False, reference=True)
    assert eventually(beams.wanted) == BeamState(signal=False, reference=True)
    beams.announce(BeamState(signal=True, reference=True))
    assert not moved.done()
    beams.announce(BeamState(signal=False, reference=True))
    moved.result(WAIT_S)
    assert beams.wanted() is None
    beams.close()
    assert beams.wanted() == BeamState(signal=True, reference=True)
    beams.announce(BeamState(signal=True, reference=True))
    assert beams.wanted() is None
    beams.close()
    assert beams.wanted() is None


def test_beams_that_nobody_hears_of_are_named_and_open() -> None:
    beams = ExternalBeams(0.0)
    lost = reason_of(lambda: beams.let_through(signal=False, reference=True), beams.name)
    assert lost is Reason.BEAM_CONTROL_FAILED
    beams.close()
    assert beams.wanted() is None
    beams.let_through(signal=True, reference=True)
    assert beams.wanted() is None


def test_a_controller_that_may_have_blocked_a_beam_is_asked_to_open_it(start: Start) -> None:
    clock = HandClock()
    beams = ExternalBeams(10.0, clock)
    for order in (BeamState(signal=False, reference=True), BeamState(signal=True, reference=True)):
        moved = start(beams.let_through, signal=order.signal, reference=order.reference)
        clock.until_somebody_waits()
        assert beams.wanted() == order
        clock.advance(10.0)
        with pytest.raises(LostShotError):
            moved.result(WAIT_S)
        assert beams.wanted() == BeamState(signal=True, reference=True)
    beams.announce(BeamState(signal=True, reference=True))
    beams.let_through(signal=True, reference=True)
    assert beams.wanted() is None


def test_a_person_is_asked_for_what_is_to_change_and_for_nothing_else() -> None:
    asked: list[str] = []

    def ask(sentence: str) -> None:
        asked.append(sentence)
        if len(asked) == 1:
            raise SourceError("beams", "nobody to ask", "a terminal")

    beams = OperatorBeams(ask)
    beams.let_through(signal=True, reference=True)
    with pytest.raises(SourceError):
        beams.let_through(signal=False, reference=True)
    beams.close()  # they count as they were
    for signal, reference in ((False, True), (False, True), (True, False), (False, False)):
        beams.let_through(signal=signal, reference=reference)
    beams.close()
    beams.close()
    assert asked[1:] == [
        "Block the signal beam",
        "Let the signal beam through and block the reference beam",
        "Block the signal beam",
        "Let the signal beam through and let the reference beam through",
    ]
