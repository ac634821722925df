"""Claims about the simulated device: its light, its frames, its drift, and the truth that it tells of itself."""

from functools import cache
from itertools import product

import numpy as np
import pytest

from lightpage.calibration.interfaces import BRANCHES
from lightpage.calibration.parameters import NAMES
from lightpage.device.profile import PageLayout, Profile, load_profile
from lightpage.device.state import (
    Aberration,
    CameraPose,
    Device,
    Drift,
    Geometry,
    Homodyne,
    Reference,
    Sensor,
    SlmDefects,
    ideal_device,
)
from lightpage.errors import PageError, ProfileError
from lightpage.simulator.cameras import resample
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import TrueOptics, true_parameters
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.waves import lens
from lightpage.waves.grid import splitting_steps
from lightpage.waves.lens import FourierLens
from tests.lightpage.refused import refused
from tests.lightpage.small import THICK, on_slm, perfect_device, random_phases, small_profile

FINE_SENSOR = Sensor(full_well_e=1e9, read_noise_e=0, bit_depth=16)
"""Hardly any noise: one electron in thirty thousand, one count in 65,535."""
TINY = small_profile().model_copy(
    update={
        "page": PageLayout(columns=8, rows=6, symbol_size_px=4, pilot_fraction=0.1),
        "camera": small_profile().camera.model_copy(update={"columns_px": 124, "rows_px": 92}),
    }
)
TALL = small_profile().model_copy(
    update={
        "page": PageLayout(columns=44, rows=40, symbol_size_px=4),
        "camera": small_profile().camera.model_copy(update={"rows_px": 660}),
    }
)
"""Rows enough that light which met one horizontal wall leaves through the middle of its cell."""


def symbols(profile: Profile, levels: int = 16, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(levels, size=profile.page_shape).astype(np.uint8)


def gentle(**tables: object) -> Device:
    """The realistic device without noise, phase noise or drift."""
    quiet = {"sensor": FINE_SENSOR, "drift": Drift(piston_rad=0, shift_px=0), "slm": SlmDefects(phase_noise_rad=0)}
    return Device().model_copy(update=quiet | tables)


@pytest.mark.parametrize(("name", "cells"), [("bench", (188, 285)), ("paper", (748, 1139))])
def test_the_shipped_devices_are_computed_with_the_modes_that_their_recordings_were_made_with(
    name: str, cells: tuple[int, int]
) -> None:
    # other numbers would change recordings, and with them every figure that was measured on one
    assert TrueOptics(load_profile(name), Device()).channel.cells == cells


def test_level_counts_and_cameras_that_cannot_be_are_refused_at_once() -> None:
    with refused("levels", 1, PageError):
        Simulator(TINY, Device(), levels=1)
    narrow = TINY.model_copy(update={"camera": TINY.camera.model_copy(update={"columns_px": 100})})
    with refused("camera.columns_px", 100, ProfileError):
        Simulator(narrow, Device())


class TestRandomness:
    def test_the_same_seed_gives_the_same_frames_and_another_seed_others(self) -> None:
        pages = [symbols(TINY, seed=s) for s in (1, 2)]

        def recorded(seed: int) -> list[np.ndarray]:
            simulator = Simulator(TINY, Device(), levels=16, seed=seed, steps=8)
            pairs = [*(simulator.page(page) for page in pages), simulator.references()]
            return [frame for pair in pairs for frame in (pair.in_phase, pair.quadrature)]

        first, again, other = recorded(5), recorded(5), recorded(6)
        assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
        # the references, last, are the device's own
        assert not any(np.array_equal(a, b) for a, b in zip(first[:-2], other[:-2], strict=True))

    def test_every_page_has_noise_of_its_own_which_references_do_not_disturb(self) -> None:
        page, still = symbols(TINY), Device(drift=Drift(piston_rad=0, shift_px=0))
        plain, interrupted = (Simulator(TINY, still, levels=16, seed=5, steps=8) for _ in range(2))
        interrupted.references()
        one, two = plain.page(page), plain.page(page)
        assert np.array_equal(one.in_phase, interrupted.page(page).in_phase)
        assert not np.array_equal(one.in_phase, two.in_phase)
        assert np.corrcoef(one.in_phase.ravel(), two.in_phase.ravel())[0, 1] > 0.9

    def test_pages_that_are_skipped_leave_the_later_ones_as_they_would_have_been(self) -> None:
        page, other = symbols(TINY), symbols(TINY, seed=1)
        watched, skipped = (Simulator(TINY, Device(), levels=16, seed=1, steps=8) for _ in range(2))
        for _ in range(3):
            watched.page(other)
        skipped.skip(3)
        one, two = watched.simulate(page), skipped.simulate(page)
        assert (one.piston, one.shift_px) == (two.piston, two.shift_px)
        assert np.array_equal(one.pair.quadrature, two.pair.quadrature)
        assert not np.array_equal(one.pair.quadrature, skipped.page(page).quadrature)

    def test_piston_and_shift_walk_by_independent_normal_steps(self) -> None:
        pages, law = 100, Drift(piston_rad=0.2, shift_px=0.05)
        device = perfect_device(drift=law)
        simulator = Simulator(TINY, device, levels=16, seed=3, steps=1)
        seen = [simulator.simulate(symbols(TINY)) for _ in range(pages)]
        walk = np.array([(s.piston, *s.shift_px) for s in seen])
        steps = np.diff(walk, axis=0) / (law.piston_rad, law.shift_px, law.shift_px)
        within = 4 / np.sqrt(pages)
        assert np.abs(steps.mean(0)).max() < within
        assert np.abs(steps.std(0) - 1).max() < within / np.sqrt(2)
        assert np.abs(np.corrcoef(steps.T) - np.eye(3)).max() < within
        neighbours = np.mean(steps[1:] * steps[:-1], axis=0)
        assert np.abs(neighbours).max() < within

    def test_a_reference_that_stays_is_not_moved_by_a_knock_and_one_that_comes_along_is(self) -> None:
        seen = {}
        for stays in (False, True):
            simulator = Simulator(TINY, gentle(), levels=16, seed=2, steps=8, reference_stays=stays)
            before = simulator.references()
            simulator.knock((3.0, -2.0))
            seen[stays] = before, simulator.references(), simulator.page(symbols(TINY))
        assert np.array_equal(seen[True][0].in_phase, seen[True][1].in_phase)
        # either way it is the same signal; the reference's phase under it differs
        assert not np.array_equal(seen[True][2].in_phase, seen[False][2].in_phase)


class TestFrames:
    @pytest.mark.parametrize("exposure", [1.0, 0.25])
    def test_references_are_the_reference_beam_and_nothing_else(self, exposure: float) -> None:
        device = gentle(
            reference=Reference(amplitude_ratio=2, ripple_relative=0),
            homodyne=Homodyne(quadrature_gain=0.9),
            sensor=FINE_SENSOR.model_copy(update={"exposure_relative": exposure}),
        )
        whole = Simulator(TINY, device.model_copy(update={"sensor": FINE_SENSOR}), levels=16)
        per_unit = exposure * whole.optics.electrons_per_unit * 65_535 / FINE_SENSOR.full_well_e
        pair = Simulator(TINY, device, levels=16).references()
        np.testing.assert_allclose(pair.in_phase, 4 * per_unit, atol=2)
        np.testing.assert_allclose(pair.quadrature, 0.9 * 4 * per_unit, atol=2)

    def test_the_reference_ripples_by_its_share(self) -> None:
        rippled = gentle(reference=Reference(amplitude_ratio=2, ripple_relative=0.1))
        beam = TrueOptics(small_profile(), rippled).reference()
        assert np.abs(beam).std() == pytest.approx(0.2, rel=0.3)

    @pytest.mark.parametrize(("sign", "gain"), [(1, 1.0), (-1, 0.9)])
    def test_frames_are_field_and_reference_interfering_with_the_signals_own_light(
        self, sign: int, gain: float
    ) -> None:
        profile = small_profile()
        arms = Homodyne(quadrature_error_deg=0, quadrature_sign=sign, quadrature_gain=gain)
        simulator = Simulator(profile, perfect_device(sensor=FINE_SENSOR, homodyne=arms), levels=16, seed=1)
        page, references = simulator.simulate(symbols(profile)), simulator.references()
        optics = simulator.optics
        field = optics.camera_field(page.exit_field) * np.exp(1j * page.piston)
        expected = field * optics.reference().conj()
        per_unit = optics.electrons_per_unit * 65_535 / FINE_SENSOR.full_well_e
        view = optics.view(CameraPose())

        def seen(image: np.ndarray) -> np.ndarray:
            return resample(image, *optics.camera_axes_m, *view)

        own_light = seen(np.abs(field) ** 2)
        for frame, reference, part in (
            (page.pair.in_phase, references.in_phase, expected.real),
            (page.pair.quadrature, references.quadrature, sign * expected.imag),
        ):
            clear = frame < 65_535
            assert clear.mean() > 0.99
            brighter = gain if reference is references.quadrature else 1.0
            difference = (frame.astype(float) - reference) / per_unit / brighter
            np.testing.assert_allclose(difference[clear], (2 * seen(part) + own_light)[clear], atol=0.012)
            assert np.mean(difference[clear] - 2 * seen(part)[clear]) > 0.3


class TestLight:
    @pytest.mark.parametrize("device", [perfect_device(), Device()], ids=["perfect", "realistic"])
    def test_the_signals_mean_power_over_the_pages_image_is_one(self, device: Device) -> None:
        profile = small_profile()
        optics = TrueOptics(profile, device)
        field = optics.camera_field(optics.exit_field(on_slm(random_phases(profile, 3), profile)))
        x, y = optics.camera_axes_m
        # samples of the facet repeat the image with this period, just wider than the page
        geometry, cells = optics.geometry, optics.channel.cells
        periods = np.array(cells) * geometry.wavelength_m * geometry.focal_length_m / geometry.pipe_width_m
        image = field[np.abs(y) < periods[0] / 2][:, np.abs(x) < periods[1] / 2]
        power = np.sum(np.abs(image) ** 2) * profile.camera.pitch_m**2
        # what the pipe's band holds differs by a hundredth from page to page
        assert power == pytest.approx(profile.page_width_m * profile.page_height_m, rel=0.02)
        on_page = field[np.abs(y) < profile.page_height_m / 2][:, np.abs(x) < profile.page_width_m / 2]
        assert np.mean(np.abs(on_page) ** 2) == pytest.approx(1, rel=0.05)

    @pytest.mark.parametrize("gain", [Homodyne().quadrature_gain, 2.5])
    def test_hardly_any_pixel_is_clipped_and_the_range_is_used(self, gain: float) -> None:
        profile, device = small_profile(), Device(homodyne=Homodyne(quadrature_gain=gain))
        pair = Simulator(profile, device, levels=16, seed=1, steps=16).page(symbols(profile))
        assert (pair.in_phase == 255).mean() < 0.01
        assert (pair.quadrature == 255).mean() < 0.01
        assert np.quantile(pair.quadrature, 0.99) > 128

    @pytest.mark.parametrize(
        ("angle_deg", "share", "error"), [(-0.6, 1.0, 0.0014), (-0.6, 0.375, 0.0102), (-5.0, 1.0, 0.039)]
    )
    def test_splitting_errs_as_little_as_was_measured(self, angle_deg: float, share: float, error: float) -> None:
        device, written = Device(geometry=Geometry(pipe_angle_deg=angle_deg)), on_slm(random_phases(TALL, 0), TALL)
        found, many = (
            TrueOptics(TALL, device, splitting_steps(TALL, part)).exit_field(written) for part in (share, 6.0)
        )
        assert np.linalg.norm(found - many) / np.linalg.norm(many) == pytest.approx(error, rel=0.1)

    @pytest.mark.parametrize(
        ("lenses", "geometry"),
        [
            ("ideal", {"pipe_width_relative_error": 0.4}),
            ("ideal", {"focal_length_relative_error": -0.3}),
            ("ideal", {"pipe_angle_deg": -5.0, "pipe_roll_deg": 5.0}),
            ("real", {}),
        ],
    )
    def test_light_between_the_computed_samples_is_what_the_lens_makes_there(
        self, lenses: str, geometry: dict[str, float], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(lens, "TOLERANCE_WITH_PATH", 1e-6)  # both have other terms, which must not show
        profile = TALL if lenses == "ideal" else TALL.model_copy(update={"lens_path": THICK})
        device = mishandled()
        device = device.model_copy(update={"geometry": device.geometry.model_copy(update=geometry)})
        optics = TrueOptics(profile, device)
        page_x, page_y = optics.page_axes_m
        exit_field = optics.exit_field(on_slm(random_phases(profile, 0), profile))
        x, y = optics.camera_axes_m
        fine = FourierLens(optics.geometry, x, y, optics.channel.cells, second=True).to_plane(exit_field)
        inside = np.ix_(np.abs(y) < np.ptp(page_y) / 2, np.abs(x) < np.ptp(page_x) / 2)
        off = np.linalg.norm((optics.camera_field(exit_field) - fine)[inside]) / np.linalg.norm(fine[inside])
        assert off < 1e-4

    def test_illumination_falls_off_and_aberrations_bend_the_phase_towards_the_corner(self) -> None:
        profile = small_profile()
        device = perfect_device(
            slm=SlmDefects(phase_noise_rad=0, blur_px=0, falloff_relative=0.2),
            aberration=Aberration(distortion_relative=0, defocus_rad=0.5, astigmatism_rad=0.3, coma_rad=0.2),
            geometry=Geometry(pipe_angle_deg=0, page_shift_x_px=5, page_shift_y_px=-3, pipe_roll_deg=0),
        )
        factor = TrueOptics(profile, device).slm_factor
        half_x, half_y = profile.page_width_m / 2, profile.page_height_m / 2
        corner2 = half_x**2 + half_y**2
        # the outermost pixel centres lie half a pixel inside the corner
        assert abs(factor[0, 0]) == pytest.approx(0.8, abs=0.005)
        assert np.abs(factor).max() == pytest.approx(1, abs=0.001)
        expected = 0.5 + 0.3 * (half_x**2 - half_y**2) / corner2 + 0.2 * half_x / np.sqrt(corner2)
        assert np.angle(factor[-1, -1]) == pytest.approx(expected, abs=0.02)
        assert np.angle(factor[-1, 0]) == pytest.approx(expected - 0.4 * half_x / np.sqrt(corner2), abs=0.02)

    def test_a_tilted_camera_sees_each_place_out_of_focus_by_so_much(self) -> None:
        tilted, profile, place = CameraPose(tilt_x_rad=1.0), small_profile(), 0.7
        optics, flat = (TrueOptics(profile, perfect_device(in_phase_camera=pose)) for pose in (tilted, CameraPose()))
        exit_field = flat.exit_field(on_slm(random_phases(profile, 3), profile))
        at = np.argmin(np.abs(flat.camera_axes_m[0] - place * profile.page_width_m / 2))
        seen, there, focused = (
            found.camera_field(exit_field, pose)[:, at]
            for found, pose in ((optics, tilted), (flat, CameraPose(axial_rad=place)), (flat, CameraPose()))
        )
        assert np.linalg.norm(seen - there) < 0.02 * np.linalg.norm(there) < 0.1 * np.linalg.norm(seen - focused)

    @pytest.mark.parametrize(
        ("knob", "value", "decibel"),
        [
            ("geometry.pipe_height_relative_error", 0.001, -19.0),
            ("geometry.pipe_taper_relative", 0.0005, -31.4),
            ("geometry.ghost_relative", 0.035, -29.1),  # its own square
            ("geometry.modulator_tilt_x_rad", 0.1, -38.6),
            ("in_phase_camera.tilt_y_rad", 0.1, -26.8),  # a third of its square, times the mean of (2 R / w)^4, 0.62
            ("slm.crosstalk_relative", 0.02, -26.0),  # its square times that of a step, (2 pi)^2 / 6
            ("slm.flicker_rad", 0.01, -44.0),  # a third of its square; this page's is 1.2 deviations
            ("slm.dead_pixel_share", 0.001, -31.7),  # 1.5 times the share, half of which light misses the pipe
            ("slm.dead_pixel_seed", 7, -np.inf),
            ("sensor.nonlinearity_relative", -0.03, -33.6),
            ("sensor.hot_pixel_share", 0.0002, -23.4),
            ("sensor.dust_specks", 25, -22.5),
            ("sensor.blemish_seed", 7, -np.inf),
        ],
    )
    def test_a_fault_changes_as_much_of_the_frames_as_it_should(self, knob: str, value: float, decibel: float) -> None:
        plain = quiet_frame()
        signal, change = plain - quiet_frame(written=False), quiet_frame(f"{knob}={value}") - plain
        assert np.sum(change**2) == pytest.approx(10 ** (decibel / 10) * np.sum(signal**2), rel=0.07)

    def test_dust_that_settles_later_is_on_pages_and_not_on_references(self) -> None:
        late, plain = (quiet_frame(*settings, written=False) for settings in (("sensor.late_dust_specks=8",), ()))
        assert np.array_equal(late, plain)
        late, plain = quiet_frame("sensor.late_dust_specks=8"), quiet_frame()
        bright = plain > 0.2 * plain.max()
        assert 0.1 < np.min(late[bright] / plain[bright]) < 0.7
        assert np.mean(late == plain) > 0.7

    def test_references_may_have_another_exposure_than_pages(self) -> None:
        setting = "reference.recorded_exposure_relative=0.8"
        longer, plain = (quiet_frame(*settings, written=False) for settings in ((setting,), ()))
        np.testing.assert_allclose(longer, 0.8 * plain, atol=1)
        assert np.array_equal(quiet_frame(setting), quiet_frame())


@cache
def quiet_frame(*settings: str, written: bool = True) -> np.ndarray:
    """The in-phase frame of a page, or of the reference, counts."""
    simulator = Simulator(small_profile(), gentle().with_settings([*settings]), levels=16, seed=7, steps=16)
    pair = simulator.page(symbols(simulator.profile)) if written else simulator.references()
    return pair.in_phase.astype(float)


@cache
def mishandled() -> Device:
    """Every knob of the geometry and the cameras at about half of its capture range."""
    return Device(
        geometry=Geometry(
            pipe_angle_deg=-0.6,
            focal_length_relative_error=0.002,
            pipe_length_relative_error=-0.003,
            pipe_width_relative_error=0.0003,
            page_shift_x_px=3,
            page_shift_y_px=-2,
            pipe_roll_deg=0.2,
        ),
        aberration=Aberration(distortion_relative=0.0015, defocus_rad=1, astigmatism_rad=-1, coma_rad=0.7),
        in_phase_camera=CameraPose(scale_relative_error=0.006, rotation_deg=0.2, shift_x_px=6, shift_y_px=-4),
        quadrature_camera=CameraPose(scale_relative_error=-0.004, rotation_deg=-0.15, shift_x_px=-7, shift_y_px=5),
        slm=SlmDefects(phase_noise_rad=0, falloff_relative=0),
    )


class TestTruth:
    def test_the_truth_is_told_against_the_nominal_angle(self) -> None:
        bent = TINY.model_copy(update={"pipe": TINY.pipe.model_copy(update={"angle_deg": -0.4})})
        angle = true_parameters(bent, Device())[NAMES.index("pipe_angle_rad")]
        assert angle == pytest.approx(np.deg2rad(-0.2))

    @pytest.mark.parametrize("name", ["mishandled", "real lenses"])
    def test_light_arrives_where_the_rays_say_and_with_the_phase_that_they_say(self, name: str) -> None:
        profile = TALL.model_copy(update={"lens_path": THICK}) if name == "real lenses" else TALL
        device = mishandled()
        optics, twin = TrueOptics(profile, device), TorchTwin(RayTwin(profile))
        page_x, page_y = optics.page_axes_m
        points = np.stack(np.meshgrid(page_x - page_x.mean(), page_y - page_y.mean()), axis=-1).reshape(-1, 2)
        rays = twin.trace(true_parameters(profile, device), points)
        reference = optics.reference()
        away = np.abs(rays.positions)
        pages = [on_slm(random_phases(profile, seed), profile) for seed in range(2)]
        # the field is known against the reference
        fields = [optics.camera_field(optics.exit_field(page)) * np.exp(-1j * np.angle(reference)) for page in pages]
        # a wavefront that real lenses have bent is no single ray's any more
        lost, turned = (0.1, 0.08) if name == "real lenses" else (0.0, 0.05)
        rings = ((0.0, 0.2, 0.9), (0.2, 0.4, 0.83))
        for (branch, cell), (low, high, whole) in product((("direct", (0, 0)), ("x", (1, 0)), ("y", (0, 1))), rings):
            off_centre = np.abs(away - cell).max(axis=1)
            chosen = (low <= off_centre) & (off_centre < high)
            assert chosen.sum() > 500
            b = BRANCHES.index(branch)
            x, y = rays.places[b, chosen].T
            light = []
            for page, field in zip(pages, fields, strict=True):
                parts = (resample(part, *optics.camera_axes_m, x, y) for part in (field.real, field.imag))
                arrived = np.array([1, 1j]) @ np.stack(list(parts))
                light.append(arrived * np.exp(-1j * (rays.phases[b, chosen] + page.ravel()[chosen])))
            mean = np.mean(light)
            assert abs(mean) / np.sqrt(np.mean(np.abs(light) ** 2)) > whole - lost, (branch, low)
            assert abs(np.angle(mean)) < turned, (branch, low)


def test_against_a_matched_reference_light_that_met_no_wall_is_flat() -> None:
    profile = small_profile()

    def model_match(curvature: float) -> float:
        """Return how well an even page's light matches the reference in the middle of the page, 0 to 1."""
        optics = TrueOptics(profile, ideal_device().with_settings([f"reference.curvature_rad={curvature}"]))
        light = optics.camera_field(optics.exit_field(np.zeros((28 * 4, 44 * 4)))) / optics.reference()
        x, y = optics.camera_axes_m
        middle = light[np.ix_(np.abs(y) < 0.25e-3, np.abs(x) < 0.25e-3)]  # beyond 0.35 mm light meets a wall
        return float(abs(middle.sum()) / np.abs(middle).sum())

    assert model_match(profile.light_curvature_rad) > 0.95
    assert model_match(0) < 0.2
