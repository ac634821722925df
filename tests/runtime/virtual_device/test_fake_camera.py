"""A fake camera is two of its kind on two addresses, and says what went wrong with its pictures."""

from __future__ import annotations

import numpy as np
import pytest

from lightpage.errors import FrameError
from runtime.cameras.aravis import AravisCamera
from runtime.cameras.settings import CameraSettings
from runtime.errors import SourceError
from runtime.virtual_device.fake_camera import FakeCamera
from runtime.virtual_device.namespace import ADDRESSES
from tests.runtime.cameras.scene import SENSOR, WAIT_S, info_of, noise, scene

pytestmark = pytest.mark.own_network


def test_two_cameras_with_one_edge_send_each_its_own_picture() -> None:
    pictures = [noise("Mono12", 1), noise("Mono12", 2)]
    fakes = [FakeCamera(ADDRESSES[i], f"CAM-{i}", lambda i=i: pictures[i], SENSOR) for i in (0, 1)]  # type: ignore[misc]
    given = {"pixel_format": "Mono12", "trigger_source": "Line1"}
    settings = [CameraSettings.model_validate({"address": address, **given}) for address in ADDRESSES]
    cameras = [AravisCamera(each, SENSOR) for each in settings]
    try:
        for camera in cameras:
            camera.arm()
        for turn in range(3):
            pictures[:] = [noise("Mono12", 10 * turn + i) for i in (0, 1)]
            assert all([fake.edge() for fake in fakes])
            for i, camera in enumerate(cameras):
                frame = camera.frame(WAIT_S)
                assert frame is not None
                assert info_of(frame).serial == f"CAM-{i}"
                assert frame.pixels is not None
                assert (frame.pixels == pictures[i]).all()
    finally:
        for device in (*cameras, *fakes):
            device.close()


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


def test_an_edge_before_it_waits_is_forgotten() -> None:
    with scene() as stage:
        assert not stage.fake.waits
        assert not stage.fake.edge()
        stage.camera.arm()
        assert stage.fake.waits
        assert stage.camera.frame(0.1) is None
        stage.fake.close()
        stage.fake.close()
        assert not stage.fake.edge()
