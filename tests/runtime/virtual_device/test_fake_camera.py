"""A fake camera is two of its kind on two addresses, and says what went wrong with its pictures."""

from __future__ import annotations

import numpy as np
import pytest

from lightpage.errors import FrameError
from runtime.errors import SourceError
from runtime.virtual_device.fake_camera import FakeCamera
from runtime.virtual_device.namespace import ADDRESSES
from tests.runtime.cameras.scene import SENSOR, noise, scene

pytestmark = pytest.mark.own_network


def test_an_address_is_taken_once_and_must_be_here() -> None:
    with FakeCamera(ADDRESSES[0], "A", lambda: noise("Mono8", 0), SENSOR):
        for address in (ADDRESSES[0], "192.0.2.1"):
            with pytest.raises(SourceError, match=f"^fake camera on {address}"):
                FakeCamera(address, "B", lambda: noise("Mono8", 0), SENSOR)
    FakeCamera(ADDRESSES[0], "B", lambda: noise("Mono8", 0), SENSOR).close()


def test_what_went_wrong_with_a_picture_is_kept_until_it_is_told() -> None:
    with scene() as stage:
        stage.camera.arm()
        stage.fake.check()
        for wrong, named in ((np.zeros((3, 3), np.uint8), r"\(3, 3\)"), (np.full(SENSOR, 300, np.uint16), "300")):
            stage.seen[0] = wrong
            stage.take()
            with pytest.raises(FrameError, match=named):
                stage.fake.check()
        stage.fake.check()
