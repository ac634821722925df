"""Device state: its settings are checked like a profile's, and drawn devices stay within the capture range."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightpage.device.profile import load_profile, to_toml
from lightpage.device.state import Device, Geometry, draw_device, load_device, parse_device
from lightpage.errors import ProfileError
from tests.lightpage.refused import refused


def test_device_survives_the_round_trip_through_toml(tmp_path: Path) -> None:
    device = draw_device(np.random.default_rng(3))
    path = tmp_path / "device.toml"
    path.write_text(to_toml(device), "utf-8")
    assert load_device(path) == device


def test_keys_left_out_keep_their_realistic_default(tmp_path: Path) -> None:
    path = tmp_path / "device.toml"
    path.write_text("[geometry]\npipe_angle_deg = 0.25\n", "utf-8")
    assert load_device(path) == Device().with_settings(["geometry.pipe_angle_deg=0.25"])


def test_settings_change_what_they_name_and_nothing_else() -> None:
    device = Device().with_settings(
        ["geometry.pipe_angle_deg=-0.3", " homodyne.quadrature_sign = -1", "sensor.bit_depth=12"]
    )
    assert device.geometry.pipe_angle_deg == -0.3
    assert device.homodyne.quadrature_sign == -1
    assert device.sensor.bit_depth == 12
    back = ["geometry.pipe_angle_deg=-0.6", "homodyne.quadrature_sign=1", "sensor.bit_depth=8"]
    assert device.with_settings(back) == Device().with_settings([]) == Device()


NO_SETTINGS = ["", "=", "geometry.pipe_angle_deg", "pipe_angle_deg=1", "geometry=1", "geometry.colour=1", "lamp=1"]
BAD_VALUES = {
    "geometry.pipe_angle_deg": ("", "one", "nan", "inf", "[1]", "60"),
    "geometry.page_shift_x_px": ("1e6",),
    "geometry.focal_length_relative_error": ("0.7",),
    "homodyne.quadrature_sign": ("0",),
    "homodyne.quadrature_gain": ("-1",),
    "sensor.bit_depth": ("7", "17", "8.5"),
    "sensor.full_well_e": ("0", "1e300"),
    "sensor.read_noise_e": ("-1",),
    "sensor.exposure_relative": ("0",),
    "slm.falloff_relative": ("1.0",),
    "drift.piston_rad": ("-0.1", "1e308"),
    "reference.amplitude_ratio": ("0",),
}


@pytest.mark.parametrize(
    "setting", [*NO_SETTINGS, *(f"{key}={value}" for key in BAD_VALUES for value in BAD_VALUES[key])]
)
def test_a_bad_setting_is_refused_and_named(setting: str) -> None:
    with pytest.raises(ProfileError) as caught:
        Device().with_settings([setting])
    assert setting.partition("=")[0] in str(caught.value)


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("geometry.pipe_angel_deg=1", "geometry.pipe_angle_deg"),
        ("pipe_angle_deg=1", "geometry.pipe_angle_deg"),
        ("sensor.full_well=1", "sensor.full_well_e"),
        ("drift.colour=1", "piston_rad, shift_px"),
        ("weather=1", "geometry, "),
    ],
)
def test_an_unknown_setting_names_what_may_have_been_meant(setting: str, told: str) -> None:
    with refused(kind=ProfileError, wanted=told):
        Device().with_settings([setting])


@pytest.mark.parametrize(
    "text",
    [None, "[geometry]\npipe_angle_deg = nan", "[geometry]\ncolour = 1", "[lamp]\npower = 1", "not toml"],
)
def test_a_bad_device_file_and_one_that_is_not_there_are_refused_and_named(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "device.toml"
    if text is not None:
        path.write_text(text, "utf-8")
    with refused("device.toml", kind=ProfileError):
        load_device(path)


def test_drawn_devices_fill_the_capture_range_and_stay_inside() -> None:
    rng = np.random.default_rng(1)
    devices = [draw_device(rng) for _ in range(200)]
    spans = {
        "pipe_angle_deg": (1.0, [d.geometry.pipe_angle_deg for d in devices]),
        "focal_length": (0.003, [d.geometry.focal_length_relative_error for d in devices]),
        "pipe_length": (0.005, [d.geometry.pipe_length_relative_error for d in devices]),
        "pipe_width": (0.0005, [d.geometry.pipe_width_relative_error for d in devices]),
        "page_shift": (6.0, [d.geometry.page_shift_x_px for d in devices]),
        "roll": (0.4, [d.geometry.pipe_roll_deg for d in devices]),
        "camera_scale": (0.01, [d.quadrature_camera.scale_relative_error for d in devices]),
        "camera_rotation": (0.3, [d.in_phase_camera.rotation_deg for d in devices]),
        "camera_shift": (12.0, [d.in_phase_camera.shift_y_px for d in devices]),
        "distortion": (0.003, [d.aberration.distortion_relative for d in devices]),
        "aberration": (2.0, [d.aberration.coma_rad for d in devices]),
        "reference_tilt": (3.0, [d.reference.tilt_x_rad for d in devices]),
        "quadrature_error": (6.0, [d.homodyne.quadrature_error_deg for d in devices]),
        "quadrature_gain": (0.1, [d.homodyne.quadrature_gain - 1 for d in devices]),
    }
    for name, (limit, values) in spans.items():
        assert max(np.abs(values)) <= limit, name
        assert min(values) < -0.9 * limit, name
        assert max(values) > 0.9 * limit, name
    assert {d.homodyne.quadrature_sign for d in devices} == {-1, 1}


def test_the_same_seed_draws_the_same_device() -> None:
    assert draw_device(np.random.default_rng(7)) == draw_device(np.random.default_rng(7))
    assert draw_device(np.random.default_rng(7)) != draw_device(np.random.default_rng(8))


def test_a_pipe_deviates_from_the_angle_of_its_profile_unless_its_own_is_given() -> None:
    profile = load_profile("bench")
    sheared = profile.model_copy(update={"pipe": profile.pipe.model_copy(update={"angle_deg": 0.3})})
    assert Device().of_profile(profile) == Device()
    assert Device().of_profile(sheared).geometry.pipe_angle_deg == pytest.approx(0.3 - 0.6)
    assert parse_device("[geometry]\nfocal_length_relative_error = 0.001").of_profile(sheared).geometry == Geometry(
        pipe_angle_deg=0.3 - 0.6, focal_length_relative_error=0.001
    )
    given = parse_device("[geometry]\npipe_angle_deg = -0.6")
    assert given.of_profile(sheared) == given
