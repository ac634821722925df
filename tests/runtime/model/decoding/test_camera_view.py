"""A symbol whose image lies off a camera is claimed with nothing, whatever the network says of it."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from lightpage.calibration.sampling_table import monomial_powers, shifted, symbol_centres
from lightpage.device.profile import Profile, load_profile
from lightpage.runtime.model.decoding.camera_view import CameraView
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import Inference
from lightpage.waves.grid import field_grid
from tests.runtime import toy
from tests.runtime.model.decoding.test_image_tracker import FakeDevice

BENCH = load_profile("bench")
WIDE = toy.PROFILE.model_copy(update={"camera": BENCH.camera})


def nominal(profile: Profile) -> tuple[np.ndarray, np.ndarray]:
    """The registration of cameras that see the page's middle in theirs, and places of the direct branch."""
    grid = field_grid(profile)
    x_m, y_m = symbol_centres(profile).T.reshape(2, *profile.page_shape)
    places = np.stack([x_m - grid.x_m[0], y_m - grid.y_m[0]])[None] / grid.pitch_m
    registration, powers = np.zeros((2, 2, len(monomial_powers()))), monomial_powers()
    for axis, power in enumerate([(1, 0), (0, 1)]):
        registration[:, axis, powers.index((0, 0))] = (profile.frame_shape[1 - axis] - 1) / 2
        registration[:, axis, powers.index(power)] = profile.corner_m / profile.camera.pitch_m
    return registration, places


@pytest.mark.parametrize("camera", [0, 1])
def test_columns_that_leave_one_camera_are_not_claimed(camera: int) -> None:
    shape, (registration, places) = BENCH.page_shape, nominal(BENCH)
    view, length = CameraView(BENCH, registration, places), np.full(shape, 9, np.float32)
    said = Inference(np.ones((2, *shape), np.float32), np.zeros(shape, np.float32), length)
    assert view.seen(said) is said
    moved = registration.copy()
    moved[camera] = shifted(registration, np.array([100.0, 0.0]))[camera]
    off = symbol_centres(BENCH)[: shape[1], 0] / BENCH.camera.pitch_m + 100 > BENCH.frame_shape[1] / 2
    assert 0 < np.count_nonzero(off) < 10
    np.testing.assert_array_equal(view.seen(said, moved).concentration == 0, np.broadcast_to(off, shape))
    assert CameraView(BENCH, None, None).seen(said, moved) is said


def test_an_estimator_keeps_columns_that_the_calibration_saw_beside_a_camera() -> None:
    shape, (registration, places) = BENCH.page_shape, nominal(BENCH)
    calibrated = shifted(registration, np.array([100.0, 0.0]))
    view = CameraView(BENCH, calibrated.astype(np.float32), places, measured=True)
    said = Inference(np.ones((2, *shape), np.float32), np.zeros(shape, np.float32), np.full(shape, 9, np.float32))
    np.testing.assert_array_equal(view.seen(said).concentration, said.concentration)
    further = shifted(registration, np.array([130.0, 0.0])).astype(np.float32)
    lost = np.count_nonzero(view.seen(said, further).concentration[0] == 0)
    of_network = CameraView(BENCH, calibrated.astype(np.float32), places)
    both = np.count_nonzero(of_network.seen(said, further).concentration[0] == 0)
    assert 0 < lost < both


def test_no_decode_and_no_tracker_counts_pilots_that_a_camera_does_not_show(decoder: Decoder) -> None:
    blind, (registration, places) = decoder.with_table({}), nominal(WIDE)
    moved = shifted(registration, np.array([BENCH.frame_shape[1] / 2 - 100, 0.0]))
    blind.__dict__["view"] = CameraView(WIDE, moved, places)  # where a graph with places has it
    device, page = FakeDevice(blind), FakeDevice(blind).page()
    off = blind.infer(page).concentration == 0
    gathered = blind.with_table({})
    gathered.__dict__["view"], gathered.batches = blind.view, Mock(infer=Mock(return_value=decoder.infer(page)))
    np.testing.assert_array_equal(gathered.infer(page).concentration == 0, off)
    right = decoder.pilots(16)
    assert 0 < np.count_nonzero(off[right.mask]) < len(right.phases) / 2
    wrong = replace(right, phases=right.phases + np.pi * off[right.mask])
    for reader in (lambda: blind, lambda: device.tracker(search=False)):
        assert reader().decode(page, 16, wrong).check == reader().decode(page, 16, right).check
