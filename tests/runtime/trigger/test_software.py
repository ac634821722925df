"""Cameras without a pulse generator are fired one after another."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.errors import LostShotError, Reason
from runtime.trigger.software import SoftwareTrigger
from runtime.trigger.trigger import Trigger
from tests.clock import HandClock
from tests.runtime.acquisition.lab import LabCamera


class SlowCamera(LabCamera):
    def fire(self) -> None:
        super().fire()
        self.clock.advance(0.25)


def test_every_camera_is_fired_once_and_the_shot_was_in_the_middle() -> None:
    clock = HandClock()
    cameras = [SlowCamera(name, lambda: np.zeros((4, 4), np.uint8), clock) for name in ("first", "second")]
    trigger: Trigger = SoftwareTrigger(cameras, clock.now)
    trigger.arm()
    begun = clock.now()
    assert trigger.fire() - begun == 0.25
    assert [camera.frame(1.0) is not None for camera in cameras] == [True, True]
    assert [camera.frame(0.0) for camera in cameras] == [None, None]
    cameras[1].gone = True
    with pytest.raises(LostShotError) as raised:
        trigger.fire()
    assert raised.value.reason is Reason.CAMERA_GONE
    trigger.disarm()
    trigger.close()
