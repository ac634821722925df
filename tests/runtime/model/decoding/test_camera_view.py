"""A symbol whose image lies off a camera is claimed with nothing, whatever the network says of it."""

import numpy as np
import pytest

from lightpage.calibration.sampling_table import monomial_powers, shifted, symbol_centres
from lightpage.device.profile import load_profile
from lightpage.runtime.model.decoding.camera_view import CameraView
from lightpage.runtime.model.decoding.page import Inference
from lightpage.waves.grid import field_grid

BENCH = load_profile("bench")


@pytest.mark.parametrize("camera", [0, 1])
def test_columns_that_leave_one_camera_are_not_claimed(camera: int) -> None:
    shape, grid = BENCH.page_shape, field_grid(BENCH)
    x_m, y_m = symbol_centres(BENCH).T.reshape(2, *shape)
    places = np.stack([x_m - grid.x_m[0], y_m - grid.y_m[0]])[None] / grid.pitch_m
    registration, powers = np.zeros((2, 2, len(monomial_powers()))), monomial_powers()
    for axis, power in enumerate([(1, 0), (0, 1)]):
        registration[:, axis, powers.index((0, 0))] = (BENCH.frame_shape[1 - axis] - 1) / 2
        registration[:, axis, powers.index(power)] = BENCH.corner_m / BENCH.camera.pitch_m
    view, length = CameraView(BENCH, registration, places), np.full(shape, 9, np.float32)
    said = Inference(np.ones((2, *shape), np.float32), np.zeros(shape, np.float32), length)
    assert view.seen(said) is said
    moved = registration.copy()
    moved[camera] = shifted(registration, np.array([100.0, 0.0]))[camera]
    off = x_m[0] / BENCH.camera.pitch_m + 100 > BENCH.frame_shape[1] / 2
    assert 0 < np.count_nonzero(off) < 10
    np.testing.assert_array_equal(view.seen(said, moved).concentration == 0, np.broadcast_to(off, shape))
    assert CameraView(BENCH, None, None).seen(said, moved) is said
