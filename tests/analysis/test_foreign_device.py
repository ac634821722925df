"""Faults of the other simulator change its light as they should, and its laboratory's pictures are imported."""

from dataclasses import fields
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from analysis.foreign_device import (
    GLASS_INDEX,
    HALF,
    REFERENCE_EXPOSURES,
    WAVENUMBER,
    ForeignDevice,
    Parameters,
    Pipe,
    out_of_focus,
)
from analysis.foreign_laboratory import CAMERAS, LEVELS, hand_over
from lightpage.cli.import_frames import import_frames
from tests.lightpage.small import small_profile

WIDTH, LENGTH = HALF.pipe_width, HALF.pipe_length
K_GLASS = GLASS_INDEX * WAVENUMBER
WAIST = 0.05 * WIDTH
LATER = ("wall_y_error", "taper", "ghost", "polarisation_rad", "hot_pixels", "dust")
"""Faults that no drawn device has."""


def pipe(**changes: float) -> Pipe:
    nominal: dict[str, float] = {"length": LENGTH, "angle": 0.01, **changes}
    return Pipe(widths=(WIDTH, WIDTH), samples=HALF.facet, steps=HALF.steps, **nominal)


def beam(of: Pipe, cells_x: float, cells_y: float) -> np.ndarray:
    """A narrow beam from the middle of the entrance that ends so many pipe widths away."""
    (y, x), slope = of.entrance.coordinates, WIDTH / LENGTH
    phase = K_GLASS * slope * (cells_x * x[None, :] + cells_y * y[:, None])
    return np.asarray(np.exp(1j * phase - (x[None, :] ** 2 + y[:, None] ** 2) / (2 * WAIST**2)))


@pytest.fixture(scope="module")
def page() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, HALF.page_shape)


def light_of(device: ForeignDevice, page: np.ndarray) -> np.ndarray:
    """The field that enters the pipe."""
    return device.launch(device.modulate(page, 256, np.random.default_rng(1)))


def test_drawn_devices_stay_what_they_were() -> None:
    drawn = ForeignDevice.draw(1, HALF).parameters
    assert drawn.shift_drift_px == 0.012548942681718045  # the last number that is drawn
    default = Parameters()
    assert {each.name for each in fields(Parameters)} >= {*LATER}
    assert all(getattr(drawn, name) == getattr(default, name) == 0 for name in LATER)


@pytest.mark.parametrize(
    ("angle", "cells", "bounces"),
    [
        (0.01, (0.1, 0.2), 0),
        (0.01, (1.0, 0.1), 1),
        (0.01, (-1.0, 0.1), 1),
        (0.01, (0.1, 0.75), -1),
        (0.0, (0.9, -0.75), 0),
    ],
)
def test_each_reflection_has_the_phase_of_its_polarisation(
    angle: float, cells: tuple[float, float], bounces: int
) -> None:
    usual, polarised = pipe(angle=angle), pipe(angle=angle, polarisation=0.3)
    expected, found = (one.through(beam(one, *cells)) for one in (usual, polarised))
    expected = expected * np.exp(0.3j * bounces)
    # measured: 1.4e-3, from the beam's tail in other cells
    assert np.linalg.norm(found - expected) < 2e-3 * np.linalg.norm(expected)


def test_an_unfolded_pipe_is_the_folded_one(page: np.ndarray) -> None:
    device = ForeignDevice.draw(1, HALF)
    entering, unfolded = light_of(device, page), device.with_parameters(polarisation_rad=1e-12)
    expected = device.pipe.through(entering)
    # single precision; measured: 5e-7
    assert np.linalg.norm(unfolded.pipe.through(entering) - expected) < 1e-6 * np.linalg.norm(expected)


def test_walls_that_open_turn_light_twice_as_far() -> None:
    angles = []
    for taper in (0.0, 0.02):
        tapered = pipe(taper=taper, angle=0.0)
        leaving = tapered.through(beam(tapered, 0.8, 0.0))
        pitch = tapered.exit.pitches[1]
        along = np.angle(np.sum(leaving[:, 1:] * np.conj(leaving[:, :-1]))) / pitch
        angles.append(along / K_GLASS)
    slope = 0.02 * WIDTH / 2 / LENGTH
    assert angles[1] - angles[0] == pytest.approx(2 * slope, rel=0.02)


def test_a_taper_is_nothing_to_light_that_meets_no_wall() -> None:
    tapered = pipe(taper=0.02, angle=0.0)
    leaving = tapered.through(beam(tapered, 0.0, 0.0))
    x, y = tapered.exit.points
    spread = WAIST**2 + 1j * LENGTH / K_GLASS
    free = WAIST**2 / spread * np.exp(-(x**2 + y**2) / (2 * spread))
    # paraxial
    assert np.linalg.norm(leaving - free) < 1e-3 * np.linalg.norm(free)


def test_a_mode_has_the_wave_number_of_either_pair_of_walls() -> None:
    unequal = ForeignDevice(Parameters(wall_y_error=0.01), HALF).pipe
    waves = np.array([20, 7]) * np.pi / np.array([1.01 * WIDTH, WIDTH])
    y, x = (each + width / 2 for each, width in zip(unequal.entrance.coordinates, unequal.widths, strict=True))
    mode = np.outer(np.sin(waves[0] * y), np.sin(waves[1] * x))
    turned = np.exp(1j * LENGTH * (np.sqrt(K_GLASS**2 - waves @ waves) - K_GLASS))
    assert unequal.through(mode) == pytest.approx(turned * mode, abs=1e-9)


def test_pipe_keeps_the_power_between_unequal_walls_and_a_ghost_has_the_square_of_its_amplitude(
    page: np.ndarray,
) -> None:
    device = ForeignDevice.draw(1, HALF).with_parameters(wall_y_error=0.001)
    entering, ghostly = light_of(device, page), device.with_parameters(ghost=0.03)
    leaving = device.pipe.through(entering)
    power = device.pipe.exit.power(leaving)
    # samples on a wall, which are dark in the pipe, hold the rest
    assert power == pytest.approx(device.pipe.entrance.power(entering), rel=1e-3)
    ghost = ghostly.pipe.through(entering) - leaving
    assert device.pipe.exit.power(ghost) == pytest.approx(0.03**2 * power, rel=1e-3)


def test_hot_pixels_show_full_scale_on_pages_and_references(page: np.ndarray) -> None:
    device = ForeignDevice.draw(1, HALF).with_parameters(hot_pixels=1e-4, reference_ratio=3.0, full_well_e=15_000.0)
    rng = np.random.default_rng(2)
    references = list(device.frames([], rng, exposures=REFERENCE_EXPOSURES))
    shown = list(device.frames(device.images(page, 256, rng), rng))
    full_scale = 2**device.parameters.bit_depth - 1
    for reference, frame in zip(references, shown, strict=True):
        hot = reference == full_scale
        assert np.count_nonzero(hot) == round(1e-4 * hot.size)
        assert (frame[hot] == full_scale).all()
    assert not np.array_equal(references[0] == full_scale, references[1] == full_scale)


@pytest.mark.parametrize("on_references", [True, False])
def test_dust_takes_light_in_few_places(page: np.ndarray, on_references: bool) -> None:
    device = ForeignDevice.draw(1, HALF)
    dusty = device.with_parameters(dust=5, dust_on_references=on_references)
    images = device.images(page, 256, np.random.default_rng(2))
    for of, there in (([], on_references), (images, True)):
        for clean, light in zip(device.intensities(of), dusty.intensities(of), strict=True):
            passed = light / clean
            assert (passed.min() < 0.71) == there
            assert passed.min() >= 0.29  # no two specks overlap here
            assert np.count_nonzero(passed < 1) <= 5 * np.pi * 7**2


def test_faults_scale_and_planes_are_told_in_radians_at_the_wall() -> None:
    device = ForeignDevice(design=HALF).with_faults(0.5)
    wall = np.array(WIDTH / 2), np.array(0.0)
    p = device.parameters
    for behind, radians in (
        (p.modulator_behind_mm, 1.2),
        (p.in_phase_camera.behind_mm, 0.8),
        (p.quadrature_camera.behind_mm, -0.7),
    ):
        assert np.angle(out_of_focus(wall, HALF.focal_length, behind)) == pytest.approx(-0.5 * radians)
    assert device.with_faults(0).parameters == Parameters()


def test_pictures_of_the_laboratory_are_imported(tmp_path: Path) -> None:
    device = ForeignDevice.draw(1, HALF).with_faults(1 / 3).with_parameters(bit_depth=12)
    laboratory = tmp_path / "laboratory"
    withheld = hand_over(device, 2, 7, laboratory)
    symbols = device.write(tmp_path / "expected.h5", 2, LEVELS, 7)
    assert np.array_equal(withheld.symbols, symbols[1:])
    (tmp_path / "small.toml").write_text(small_profile().to_toml())
    words = ["--profile", str(tmp_path / "small.toml"), f"--flip-{CAMERAS[withheld.mirrored].replace('_', '-')}", "x"]
    for camera, name in CAMERAS.items():
        option = name.replace("_", "-")
        words += [f"--{option}", str(laboratory / "monday" / camera)]
        words += [f"--reference-{option}", str(laboratory / "references" / camera)]
    words += ["--symbols", str(laboratory / "monday" / "log.npy"), "--out", str(tmp_path / "R.h5")]
    CliRunner().invoke(import_frames, words, standalone_mode=False, catch_exceptions=False)
    with h5py.File(str(tmp_path / "R.h5")) as found, h5py.File(str(tmp_path / "expected.h5")) as expected:
        assert found.attrs["camera_bit_depth"] == 12
        for name in CAMERAS.values():
            assert np.array_equal(found[name][()], expected[name][:1])
            assert np.array_equal(found[f"reference_{name}"][()], expected[f"reference_{name}"][()])
        assert np.array_equal(found["symbols"][()], symbols[:1])
