"""A fake camera and what it sees, for tests in a private network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.recording.layout import FrameInfo
from runtime.cameras.aravis import AravisCamera
from runtime.cameras.camera import Frame, FrameStatus
from runtime.cameras.pixel_formats import bit_depth
from runtime.cameras.settings import CameraSettings
from runtime.virtual_device.fake_camera import FakeCamera

SENSOR = (96, 128)
ADDRESS = "127.0.0.1"
SERIAL = "CAM-I"
WAIT_S = 30.0
"""Bounds every wait for something that comes within milliseconds."""

Counts = NDArray[np.unsignedinteger[Any]]


def noise(pixel_format: str, seed: int, shape: tuple[int, int] = SENSOR) -> Counts:
    """Counts of every size that the format has."""
    depth = bit_depth(pixel_format)
    return np.random.default_rng(seed).integers(0, 2**depth, shape, dtype=np.uint8 if depth == 8 else np.uint16)


@dataclass
class Scene:
    """A fake camera, its driver, and what the sensor sees."""

    fake: FakeCamera
    camera: AravisCamera
    seen: list[Counts]
    pixel_format: str

    def take(self) -> Frame:
        """One edge, one frame."""
        assert self.fake.edge()
        frame = self.camera.frame(WAIT_S)
        assert frame is not None
        return frame


@contextmanager
def scene(shape: tuple[int, int] = SENSOR, more_bytes: int = 0, **settings: Any) -> Iterator[Scene]:
    """A fake camera at ADDRESS, and a driver that is not armed yet."""
    given = {"address": ADDRESS, "trigger_source": "Line1", **settings}
    camera = AravisCamera(CameraSettings.model_validate(given), shape, "in-phase camera")
    pixel_format = settings.get("pixel_format", "Mono8")
    seen = [noise(pixel_format, 0)]
    with FakeCamera(ADDRESS, SERIAL, lambda: seen[0], SENSOR, more_bytes) as fake:
        try:
            yield Scene(fake, camera, seen, pixel_format)
            fake.check()
        finally:
            camera.close()


def info_of(frame: Frame) -> FrameInfo:
    """Of a complete frame."""
    assert frame.status is FrameStatus.COMPLETE, frame.detail
    assert frame.info is not None
    return frame.info
