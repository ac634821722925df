"""Cameras without a pulse generator are fired one after another."""

from __future__ import annotations

import time

import numpy as np
import pytest

from runtime.errors import LostShotError, Reason
from runtime.trigger.software import SoftwareTrigger
from runtime.trigger.trigger import Trigger
from tests.runtime.acquisition.lab import LabCamera


def test_every_camera_is_fired_once() -> None:
    cameras = [LabCamera(name, lambda: np.zeros((4, 4), np.uint8)) for name in ("first", "second")]
    trigger: Trigger = SoftwareTrigger(cameras)
    trigger.arm()
    before = time.monotonic()
    assert before <= trigger.fire() <= time.monotonic()
    assert [camera.frame(1.0) is not None for camera in cameras] == [True, True]
    assert [camera.frame(0.0) for camera in cameras] == [None, None]
    trigger.disarm()
    trigger.close()


def test_a_camera_that_has_gone_is_told() -> None:
    class Gone(LabCamera):
        def fire(self) -> None:
            raise LostShotError(self.name, "no answer", "a camera", Reason.CAMERA_GONE)

    trigger = SoftwareTrigger([Gone("gone", lambda: np.zeros((4, 4), np.uint8))])
    with pytest.raises(LostShotError) as raised:
        trigger.fire()
    assert raised.value.reason is Reason.CAMERA_GONE
