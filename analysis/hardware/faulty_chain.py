"""Cameras, pulse generator and page on display as a chain in which each kind of fault can be made to happen."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile, load_profile
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.device.acquisition.camera_source import CameraSource, Exposures
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.pairing import PairingSettings
from lightpage.runtime.device.cameras.aravis import AravisCamera
from lightpage.runtime.device.cameras.camera import BrokenFrame, Frame
from lightpage.runtime.device.cameras.settings import CameraSettings
from lightpage.runtime.device.trigger.pulse_generator import PulseGenerator, PulseGeneratorSettings
from lightpage.virtual_device.fake_camera import FakeCamera
from lightpage.virtual_device.namespace import ADDRESSES
from lightpage.virtual_device.pulse_generator import PulseGeneratorEmulator
from lightpage.virtual_device.serial_port import Pty

SIDE_PX = 256


class HeldCamera(AravisCamera):
    """A camera whose frames may be delivered later than they came."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.hold_s = 0.0
        self._held: list[tuple[float, Frame | BrokenFrame]] = []

    def frame(self, timeout_s: float) -> Frame | BrokenFrame | None:
        """The next frame that is not held back any more."""
        end = time.monotonic() + timeout_s
        while True:
            wait = 0.0 if self._held or timeout_s == 0 else min(0.002, max(0.0, end - time.monotonic()))
            found = super().frame(wait)
            if found is not None:
                self._held.append((time.monotonic() + self.hold_s, found))
            if self._held and self._held[0][0] <= time.monotonic():
                return self._held.pop(0)[1]
            if time.monotonic() >= end and found is None:
                return None
            if self._held:
                time.sleep(0.001)


@dataclass
class Stage:
    """The chain, the page on display, and what is to go wrong with the next shot."""

    profile: Profile
    folder: Path
    page: int = 0
    fault: str = ""
    camera: int = 0
    delay_s: float = 0.0
    timers: list[threading.Timer] = field(default_factory=list)
    name: str = "stage"

    def __post_init__(self) -> None:
        self.fakes = [
            FakeCamera(address, f"CAM-{one}", self._picture(one), (SIDE_PX, SIDE_PX))
            for one, address in enumerate(ADDRESSES)
        ]
        self.generator = PulseGeneratorEmulator({1: lambda: self._wire(0), 2: lambda: self._wire(1)})
        self.port = Pty(self.generator.answer, self.folder / "pulse-generator")
        self.port.plug()
        self.cameras = tuple(
            HeldCamera(
                CameraSettings(address=ADDRESSES[one], trigger_source="Line1", packet_bytes=1400, buffers=30),
                (SIDE_PX, SIDE_PX),
                f"camera {one}",
            )
            for one in (0, 1)
        )

    def close(self) -> None:
        """Switch all of it off."""
        for timer in self.timers:
            timer.cancel()
        self.port.unplug()
        for camera in self.cameras:
            camera.close()
        for fake in self.fakes:
            fake.close()

    def show(self, symbols: NDArray[np.uint8], levels: int, page: int, timeout_s: float) -> None:
        """See `Modulator`."""
        self.page = page

    def open(self, timeout_s: float, levels: int | None = None) -> None:
        """See `Modulator`."""

    def shows(self) -> bool:
        """See `Modulator`."""
        return True

    def let_through(self, *, signal: bool, reference: bool) -> None:
        """See `Beams`: there are none."""

    def begin(self, fault: str, camera: int, delay_s: float) -> None:
        """Choose what goes wrong with the next shot."""
        self.fault, self.camera, self.delay_s = fault, camera, delay_s
        self.fakes[camera].lose({"packets lost": 0.03, "leader lost": 0.5}.get(fault, 0.0))
        for one, held in enumerate(self.cameras):
            held.hold_s = delay_s if fault == "both held" or (fault == "held" and one == camera) else 0.0
        if fault == "restarted":
            self.fakes[camera].close()
            self.fakes[camera].start()

    def end(self) -> None:
        """End all faults."""
        self.fakes[self.camera].lose(0.0)
        self.fault = ""
        for held in self.cameras:
            held.hold_s = 0.0

    def _picture(self, which: int) -> Callable[[], NDArray[np.uint8]]:
        def picture() -> NDArray[np.uint8]:
            image = np.full((SIDE_PX, SIDE_PX), 40 + which, np.uint8)
            image[0, :3] = [self.page & 255, self.page >> 8, which]
            return image

        return picture

    def _wire(self, camera: int) -> None:
        """The cable from the pulse generator to a camera."""
        hit = camera == self.camera
        edge = self.fakes[camera].edge
        if self.fault == "both missed" or (self.fault == "missed" and hit):
            return
        if self.fault == "both late" or (self.fault == "late" and hit):
            self._later(self.delay_s, edge)
            return
        edge()
        if self.fault == "doubled" and hit:
            self._later(0.03, edge)

    def _later(self, seconds: float, edge: Callable[[], bool]) -> None:
        timer = threading.Timer(seconds, edge)
        timer.daemon = True
        timer.start()
        self.timers = [one for one in self.timers if one.is_alive()] + [timer]


def source_of(stage: Stage, tolerance_s: float, repeats: int) -> CameraSource:
    """The chain as a source of endless pages."""
    profile = stage.profile
    first, second = stage.cameras
    pairing = PairingSettings(tolerance_s=tolerance_s, spacing_s=2.5 * tolerance_s + 0.01)
    port = PulseGeneratorSettings(port=str(stage.folder / "pulse-generator"), fire="software")
    store = PageStore(profile)
    symbols = np.zeros((1, *profile.page_shape), np.uint8)
    store.append(np.repeat(symbols, 2, axis=0), 2)
    exposures = Exposures(repeats=repeats)
    return CameraSource(
        profile, (first, second), PulseGenerator(port), stage, stage, _Endless(store), pairing, exposures
    )


class _Endless(PageStore):
    """Page store that has every page number."""

    def __init__(self, like: PageStore) -> None:
        self.__dict__.update(like.__dict__)

    def __len__(self) -> int:
        return 1 << 16

    def __getitem__(self, page: int) -> NDArray[np.uint8]:
        return super().__getitem__(0)


def small_cameras() -> Profile:
    """The bench profile with cameras that are as quick as the chain around them."""
    profile = load_profile("bench")
    camera = profile.camera.model_copy(update={"rows_px": SIDE_PX, "columns_px": SIDE_PX})
    return profile.model_copy(update={"camera": camera})


def numbers_shown(pair: FramePair) -> list[int]:
    """Return the page numbers that both frames of a pair show."""
    return [int(frame[0, 0]) | int(frame[0, 1]) << 8 for frame in (pair.in_phase, pair.quadrature)]
