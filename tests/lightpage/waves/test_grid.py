"""Claims about the common grid: it covers the page's image, and its filters pass the pipe's light and stop the rest."""

import numpy as np
import pytest

from lightpage.device.profile import Profile, load_profile
from lightpage.errors import ProfileError
from lightpage.waves.grid import FieldGrid, check_camera, field_grid, splitting_steps
from tests.lightpage.refused import refused
from tests.lightpage.small import small_profile

PROFILES = [small_profile(), load_profile("bench"), load_profile("paper")]


@pytest.fixture(params=PROFILES, ids=lambda p: p.name)
def profile(request: pytest.FixtureRequest) -> Profile:
    assert isinstance(request.param, Profile)
    return request.param


@pytest.fixture
def grid(profile: Profile) -> FieldGrid:
    return field_grid(profile)


def gain(taps: np.ndarray, cycles_per_sample: np.ndarray) -> np.ndarray:
    """Response of symmetric taps."""
    offsets = np.arange(len(taps)) - len(taps) // 2
    return np.cos(2 * np.pi * np.outer(cycles_per_sample, offsets)) @ taps


def band_edge(profile: Profile) -> float:
    """Highest spatial frequency that leaves the pipe's facet, cycles a metre on the camera plane."""
    return profile.pipe.width_m / 2 / (profile.light.wavelength_m * profile.lens.focal_length_m)


@pytest.mark.parametrize("step_px", [2, 3])
def test_axes_are_uniform_centred_and_reach_past_the_page(profile: Profile, step_px: int) -> None:
    grid = field_grid(profile, step_px)
    for axis, extent in ((grid.x_m, profile.page_width_m), (grid.y_m, profile.page_height_m)):
        np.testing.assert_allclose(np.diff(axis), grid.pitch_m)
        assert axis[0] == pytest.approx(-axis[-1])
        margin_px = (axis[-1] - extent / 2) / profile.camera.pitch_m
        assert 60 < margin_px < 80
    assert grid.shape == (len(grid.y_m), len(grid.x_m))


def test_a_grid_too_coarse_for_the_pipes_light_or_finer_than_the_usual_one_is_refused(profile: Profile) -> None:
    for step_px in (1, 4):
        with refused("common grid", step_px, wanted="2 to 3"):
            field_grid(profile, step_px)


@pytest.mark.parametrize("step_px", [2, 3])
def test_the_band_filter_is_flat_on_the_pipes_light_and_stops_what_the_pipe_cannot_carry(
    profile: Profile, step_px: int
) -> None:
    grid = field_grid(profile, step_px)
    edge = band_edge(profile) * grid.pitch_m
    assert np.abs(gain(grid.band, np.linspace(0, edge, 200)) - 1).max() < 0.02
    assert np.abs(gain(grid.band, np.linspace(1.4 * edge, 0.5, 200))).max() < 0.03


def test_the_prefilter_keeps_the_frames_signal_and_stops_what_would_fold_onto_the_field(
    profile: Profile, grid: FieldGrid
) -> None:
    edge = band_edge(profile) * profile.camera.pitch_m
    passed = np.linspace(0, 2 * edge, 200)  # sinc^2: what linear interpolation then takes off on average
    assert np.abs(gain(grid.prefilter, passed) * np.sinc(passed) ** 2 - 1).max() < 0.03
    # sampling every second pixel folds the frequencies above half a cycle minus the edge onto the field
    stopped = np.linspace(max(0.5 - edge, 0.36), 0.5, 200)
    assert np.abs(gain(grid.prefilter, stopped) * np.sinc(stopped) ** 2).max() < 0.02


def test_filters_keep_the_mean_and_shift_nothing(grid: FieldGrid) -> None:
    for taps in (grid.prefilter, grid.band):
        assert taps.sum() == pytest.approx(1)
        assert len(taps) % 2 == 1
        np.testing.assert_allclose(taps, taps[::-1], atol=1e-12)


def with_camera(**changes: float) -> Profile:
    bench = load_profile("bench")
    return bench.model_copy(update={"camera": bench.camera.model_copy(update=changes)})


def test_a_camera_too_coarse_for_the_pipes_light_is_refused_with_the_pitch_that_would_do() -> None:
    with refused("camera.pitch_m", 4.8e-06, ProfileError, wanted=2.99e-06):
        field_grid(with_camera(pitch_m=4.8e-6))
    coarsest = 532e-9 * 20e-3 / (4 * 0.88963e-3)
    with pytest.raises(ProfileError):
        check_camera(with_camera(pitch_m=1.001 * coarsest))
    grid = field_grid(with_camera(pitch_m=coarsest))
    # two samples for each period of the intensity, whose frequencies are twice the field's
    assert grid.pitch_m == pytest.approx(1 / (2 * 2 * band_edge(load_profile("bench"))))


def test_a_camera_that_does_not_see_the_whole_page_is_refused_with_the_pixels_that_would_do() -> None:
    # 87 x 56 symbols of 36.8 um on pixels of 2.4 um: 1334 x 858.7
    for key, least in (("columns_px", 1334), ("rows_px", 859)):
        check_camera(with_camera(**{key: least}))
        with refused(f"camera.{key}", least - 1, ProfileError, wanted=least):
            field_grid(with_camera(**{key: least - 1}))


def test_a_longer_pipe_takes_more_steps() -> None:
    assert [splitting_steps(profile) for profile in PROFILES] == [32, 32, 127]
