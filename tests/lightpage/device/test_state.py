"""Device state: its settings are checked like a profile's, and drawn devices stay within the capture range."""

from pathlib import Path

import numpy as np
import pytest

from lightpage.device.profile import load_profile, to_toml
from lightpage.device.state import Device, Geometry, draw_device, draw_rough, load_device, parse_device
from lightpage.errors import ProfileError
from tests.lightpage.refused import refused


def test_device_survives_the_round_trip_through_toml(tmp_path: Path) -> None:
    device = draw_device(np.random.default_rng(3))
    path = tmp_path / "device.toml"
    path.write_text(to_toml(device), "utf-8")
    assert load_device(path) == device


def test_the_rough_device_is_the_realistic_one_with_more_faults() -> None:
    rough, plain = load_device("rough").model_dump(), Device().model_dump()
    changed = {(table, key) for table, keys in plain.items() for key in keys if keys[key] != rough[table][key]}
    assert {plain[table][key] for table, key in changed} == {0}
    assert len(changed) == 21


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
BAD_VALUES = [
    *(f"geometry.pipe_angle_deg={value}" for value in ("", "one", "nan", "[1]", "60")),
    "homodyne.quadrature_sign=0",
    "sensor.bit_depth=17",
    "slm.falloff_relative=1.0",
]


@pytest.mark.parametrize("setting", [*NO_SETTINGS, *BAD_VALUES])
def test_a_bad_setting_is_refused_and_named(setting: str) -> None:
    with pytest.raises(ProfileError) as caught:
        Device().with_settings([setting])
    assert setting.partition("=")[0] in str(caught.value)


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("geometry.pipe_angel_deg=1", "geometry.pipe_angle_deg"),
        ("drift.colour=1", "piston_rad, shift_px"),
        ("weather=1", "geometry, "),
    ],
)
def test_an_unknown_setting_names_what_may_have_been_meant(setting: str, told: str) -> None:
    with refused(kind=ProfileError, wanted=told):
        Device().with_settings([setting])


@pytest.mark.parametrize("text", [None, "[geometry]\ncolour = 1", "not toml"])
def test_a_bad_device_file_and_one_that_is_not_there_are_refused_and_named(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "device.toml"
    if text is not None:
        path.write_text(text, "utf-8")
    with refused("device.toml", kind=ProfileError):
        load_device(path)


def test_drawn_devices_fill_the_capture_range_and_rough_ones_scatter_within_it() -> None:
    rng = np.random.default_rng(1)
    devices, rough = ([draw(rng) for _ in range(200)] for draw in (draw_device, draw_rough))
    for table, key, limit, deviation in (
        ("geometry", "pipe_angle_deg", 1.0, 0.6),
        ("geometry", "focal_length_relative_error", 0.003, 0.001),
        ("geometry", "pipe_roll_deg", 0.4, 0.1),
        ("in_phase_camera", "shift_y_px", 12.0, 4),
        ("quadrature_camera", "scale_relative_error", 0.01, 0.005),
        ("aberration", "distortion_relative", 0.003, 0.001),
        ("reference", "tilt_x_rad", 3.0, 1),
        ("homodyne", "quadrature_error_deg", 6.0, 3),
        ("slm", "stroke_relative_error", 0.03, 0.005),
        ("quadrature_camera", "axial_rad", 1.5, 0.3),
    ):
        values, scattered = ([getattr(getattr(each, table), key) for each in some] for some in (devices, rough))
        assert 0.9 * limit < -min(values) <= limit, key
        assert 0.9 * limit < max(values) <= limit, key
        assert np.abs(scattered).max() <= limit, key
        # clipping takes at most an eighth off, and that of 200 is off by 5% as a rule
        assert 0.75 * deviation < np.std(scattered) < 1.2 * deviation, key
    assert {d.homodyne.quadrature_sign for d in devices} == {-1, 1}
    errors = [
        abs(d.slm.level_sine_rad) + abs(d.slm.level_cosine_rad) + abs(d.slm.level_sine_twice_rad) for d in devices
    ]
    assert 0.27 < max(errors) <= 0.3 + 1e-12
    half = np.std([draw_rough(rng, 0.5).geometry.pipe_angle_deg for _ in range(200)])
    assert 0.25 < half < 0.35


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
