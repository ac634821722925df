"""A device in memory, by a clock that tests move, with every fault that real ones were seen to have."""

import heapq
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import LostShotError, Reason
from lightpage.recording.layout import FrameInfo
from lightpage.recording.pages import Pages, PagesWriter
from lightpage.runtime.device.acquisition.camera_image import View
from lightpage.runtime.device.acquisition.camera_source import CameraSource, Exposures
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.pairing import PairingSettings
from lightpage.runtime.device.cameras.camera import BrokenFrame, Frame
from tests.clock import HandClock
from tests.runtime import toy

PAIRING = PairingSettings(tolerance_s=0.012, frame_s=0.15, quiet_s=0.04, spacing_s=0.032)


class LabDevice:
    """Answers until it is gone."""

    name: str
    gone, lost = False, Reason.CAMERA_GONE

    def must_answer(self) -> None:
        if self.gone:
            raise LostShotError(self.name, "no answer", "one", self.lost)

    arm = must_answer

    def close(self) -> None:
        pass

    disarm = close


class LabCamera(LabDevice):
    """Frames become due some time after their trigger; each shows what is on display when it is exposed."""

    bit_depth, frame_numbers, frame_shape = 8, 65535, (4, 4)

    def __init__(self, name: str, scene: Callable[[], np.ndarray], clock: HandClock) -> None:
        self.name, self.scene, self.clock = name, scene, clock
        self.opened = 0
        self.id = 65529
        self.follows: Callable[[int], int] = lambda number: number % 65535 + 1
        self.clock_s, self.pace = 1e6, 1.00005
        self.queue: list[tuple[float, int, Frame | BrokenFrame]] = []
        self.exposures: list[tuple[float, bool, float]] = []
        self._count = 0

    def arm(self) -> None:
        self.must_answer()
        self.opened = max(1, self.opened)

    def restart(self) -> None:
        """Switched off and on: numbers and clock begin again."""
        self.opened += 1
        self.id, self.clock_s = 0, np.random.default_rng(self.opened).uniform(0, 1e6)
        self.queue.clear()
        self.exposures.clear()

    def edge(self, after_s: float = 0.0, delivery_s: float = 0.001, whole: bool = True) -> None:
        """A trigger edge that exposes after a while and delivers a while later."""
        heapq.heappush(self.exposures, (self.clock.now() + after_s, whole, delivery_s))

    def poll(self) -> None:
        """Expose what is due."""
        while self.exposures and self.exposures[0][0] <= self.clock.now():
            at, whole, delivery_s = heapq.heappop(self.exposures)
            self.id = self.follows(self.id)
            info = FrameInfo(self.name, self.id, self.clock_s + at * self.pace, at, "Mono8", 1e-4)
            self._count += 1
            frame = Frame(self.scene(), info) if whole else BrokenFrame("packets missing")
            heapq.heappush(self.queue, (at + delivery_s, self._count, frame))

    def fire(self) -> None:
        self.must_answer()
        self.edge()

    def frame(self, timeout_s: float) -> Frame | BrokenFrame | None:
        self.must_answer()
        end = self.clock.now() + timeout_s
        while True:
            self.poll()
            now = self.clock.now()
            if self.queue and self.queue[0][0] <= now:
                return heapq.heappop(self.queue)[2]
            if now >= end:
                return None
            coming = [first[0][0] for first in (self.queue, self.exposures) if first]
            self.clock.advance(min([end, *coming]) - now)


class Lab(LabDevice):
    """Both cameras behind one trigger; `plan` says what becomes of the next edge, `fired` when there were any."""

    name, lost = "lab trigger", Reason.TRIGGER_GONE

    def __init__(self) -> None:
        self.clock = HandClock()
        self.page = 0
        self.cameras = [
            LabCamera(name, lambda: np.full((4, 4), self.page % 251, np.uint8), self.clock) for name in ("I", "Q")
        ]
        self.plan: Callable[[], None] | None = None
        self.fired: list[float] = []

    def poll(self) -> None:
        """Expose what is due, while the page on display is still the one of before."""
        for camera in self.cameras:
            camera.poll()

    def display(self) -> None:
        self.poll()
        self.page += 1

    def fire(self) -> float:
        self.must_answer()
        self.fired.append(self.clock.now())
        plan, self.plan = self.plan, None
        if plan is not None:
            plan()
        else:
            for camera in self.cameras:
                camera.edge()
        return self.fired[-1]


class LabModulator(LabDevice):
    """Shows pages and blocks beams in the lab."""

    name = "lab modulator"

    def __init__(self, lab: Lab, device: toy.ToyDevice) -> None:
        self.lab, self.device = lab, device
        self.shown: list[int] = []
        self.opened_for: list[int | None] = []
        self.beams: list[tuple[bool, bool]] = []
        self.pair = device.references()
        lab.cameras[0].scene = lambda: self.pair.in_phase
        lab.cameras[1].scene = lambda: self.pair.quadrature
        for camera in lab.cameras:
            camera.frame_shape = toy.SHAPE

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


def pages_of(folder: Path, count: int = 3) -> PageStore:
    """Pages 0, 1, ... of 16 levels, from a file."""
    path = folder / "pages.h5"
    with PagesWriter(path, toy.PROFILE, 16, {}) as writer:
        writer.append(np.stack([toy.symbols_of(16, number)[0] for number in range(count)]))
    return PageStore(toy.PROFILE, Pages.open(path))


def source_of(
    lab: Lab, pages: PageStore, views: tuple[View, View] = (View(), View()), **exposures: int
) -> tuple[CameraSource, LabModulator]:
    """The lab as a source of toy pages."""
    modulator = LabModulator(lab, toy.ToyDevice())
    cameras = (lab.cameras[0], lab.cameras[1])
    given = (pages, PAIRING, Exposures(**exposures), views, "camera:lab", lab.clock)
    return CameraSource(toy.PROFILE, cameras, lab, modulator, modulator, *given), modulator


def reason_of(take: Callable[[], object], subject: str = "") -> Reason:
    """Why a shot is lost; what is said of it begins with the subject."""
    with pytest.raises(LostShotError) as raised:
        take()
    assert raised.value.subject.startswith(subject)
    return raised.value.reason
