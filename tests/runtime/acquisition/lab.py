"""Two cameras and a trigger that exist in memory only, with every fault that real ones were seen to have."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable

import numpy as np

from lightpage.recording.layout import FrameInfo
from runtime.cameras.camera import Frame, FrameStatus
from runtime.errors import LostShotError, Reason


class LabCamera:
    """Frames become due some time after their trigger; each shows what is on display when it is exposed."""

    bit_depth, frame_numbers = 8, 65535

    def __init__(self, name: str, scene: Callable[[], np.ndarray], first_id: int = 65530) -> None:
        self.name, self._scene = name, scene
        self.frame_shape = (4, 4)
        self.opened = 0
        self.gone = False
        self.id = first_id - 1
        self.clock_s, self.pace = 1e6, 1.00005
        self.queue: list[tuple[float, int, Frame]] = []
        self.exposures: list[tuple[float, FrameStatus]] = []
        self._count = 0

    def arm(self) -> None:
        if self.gone:
            raise LostShotError(self.name, "no answer", "a camera", Reason.CAMERA_GONE)
        if not self.opened:
            self.opened = 1

    def restart(self) -> None:
        """Switched off and on: numbers and clock begin again."""
        self.opened += 1
        self.id, self.clock_s = 0, np.random.default_rng(self.opened).uniform(0, 1e6)
        self.queue.clear()
        self.exposures.clear()

    def edge(self, after_s: float = 0.0, delivery_s: float = 0.001, status: FrameStatus = FrameStatus.COMPLETE) -> None:
        """A trigger edge that exposes after a while and delivers a while later."""
        heapq.heappush(self.exposures, (time.monotonic() + after_s, status))
        self.delivery_s = delivery_s

    def poll(self) -> None:
        while self.exposures and self.exposures[0][0] <= time.monotonic():
            at, status = heapq.heappop(self.exposures)
            self.id = self.id % 65535 + 1
            info = FrameInfo(self.name, self.id, self.clock_s + at * self.pace, time.time(), "Mono8", 1e-4)
            whole = Frame(status, self._scene(), info)
            self._count += 1
            frame = whole if status is FrameStatus.COMPLETE else Frame(status, detail="packets missing")
            heapq.heappush(self.queue, (at + self.delivery_s, self._count, frame))

    def fire(self) -> None:
        self.edge()

    def frame(self, timeout_s: float) -> Frame | None:
        if self.gone:
            raise LostShotError(self.name, "no answer", "a camera", Reason.CAMERA_GONE)
        end = time.monotonic() + timeout_s
        while True:
            self.poll()
            if self.queue and self.queue[0][0] <= time.monotonic():
                return heapq.heappop(self.queue)[2]
            if time.monotonic() >= end:
                return None
            time.sleep(0.0005)

    def disarm(self) -> None:
        pass

    def close(self) -> None:
        pass


class Lab:
    """Both cameras behind one trigger; `plan` says what becomes of the next edge."""

    name = "lab trigger"

    def __init__(self) -> None:
        self.page = 0
        self.gone = False
        self.cameras = [LabCamera(name, lambda: np.full((4, 4), self.page % 251, np.uint8)) for name in ("I", "Q")]
        self.plan: Callable[[], None] | None = None
        self.fired = 0

    def poll(self) -> None:
        """Expose what is due, while the page on display is still the one of before."""
        for camera in self.cameras:
            camera.poll()

    def display(self) -> None:
        self.poll()
        self.page += 1

    def arm(self) -> None:
        if self.gone:
            raise LostShotError(self.name, "no answer", "a trigger", Reason.TRIGGER_GONE)

    def fire(self) -> float:
        if self.gone:
            raise LostShotError(self.name, "no answer", "a trigger", Reason.TRIGGER_GONE)
        self.fired += 1
        at = time.monotonic()
        plan, self.plan = self.plan, None
        if plan is not None:
            plan()
        else:
            for camera in self.cameras:
                camera.edge()
        return at

    def disarm(self) -> None:
        pass

    def close(self) -> None:
        pass
