"""The foreign device is itself held to physics: closed forms, reflected beams, noise statistics, upright images."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from analysis import foreign_device as fd
from analysis.foreign_device import Camera, ForeignDevice, PageDrift, Parameters

GLASS = fd.GLASS_INDEX * fd.WAVENUMBER
PERFECT = ForeignDevice()


def power(field: np.ndarray) -> float:
    return float(np.sum(np.abs(field) ** 2))


def coherence(a: np.ndarray, b: np.ndarray) -> complex:
    """Normalised overlap of two complex arrays."""
    return complex(np.vdot(b, a) / np.sqrt(power(a) * power(b)))


def modes(numbers: list[tuple[int, int]], amplitudes: np.ndarray, length: float) -> np.ndarray:
    """Sine modes (m along x, n along y) of the square pipe after `length` mm, in closed form."""
    width = fd.NOMINAL_PIPE_WIDTH
    y, x = (np.arange(n)[:, None] / n for n in fd.FACET)
    field = np.zeros(fd.FACET, complex)
    for (m, n), amplitude in zip(numbers, amplitudes, strict=True):
        kz = np.sqrt(GLASS**2 - (np.pi * m / width) ** 2 - (np.pi * n / width) ** 2)
        field += amplitude * np.exp(1j * (kz - GLASS) * length) * np.sin(np.pi * n * y) @ np.sin(np.pi * m * x).T
    return field


def test_nothing_of_the_project_is_imported() -> None:
    code = (
        "import sys, analysis.foreign_device;"
        "print([m for m in sys.modules if m.split('.')[0] in ('lightpage', 'train', 'export', 'runtime', 'torch')])"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.strip() == "[]"


class TestPipe:
    def test_the_square_pipe_carries_sine_modes_as_the_closed_form_says(self) -> None:
        numbers = [(1, 1), (3, 70), (90, 2), (140, 110)]
        amplitudes = np.array([1, 0.5j, -0.7, 0.3 + 0.4j])
        entered = modes(numbers, amplitudes, 0.0)
        left = fd.propagate_pipe(entered, fd.NOMINAL_PIPE_WIDTH, 18.75, 0.0, 1)
        assert np.abs(left - modes(numbers, amplitudes, 18.75)).max() < 1e-9

    def test_a_vanishing_angle_gives_the_square_pipe(self) -> None:
        facet = PERFECT.launch(PERFECT.modulate(np.zeros(fd.PAGE_SHAPE, int), 2, np.random.default_rng(0)))
        square = fd.propagate_pipe(facet, fd.NOMINAL_PIPE_WIDTH, 18.75, 0.0, 1)
        sheared = fd.propagate_pipe(facet, fd.NOMINAL_PIPE_WIDTH, 18.75, 1e-9, 8)
        assert power(square - sheared) < 1e-9 * power(square)

    @pytest.mark.parametrize("angle_deg", [0.0, -1.0])
    def test_power_is_kept(self, angle_deg: float, random_facet: np.ndarray) -> None:
        left = fd.propagate_pipe(random_facet, fd.NOMINAL_PIPE_WIDTH, 18.75, np.deg2rad(angle_deg), fd.STEPS)
        # Row and column 0 lie on the walls, where the field is zero.
        assert power(left) == pytest.approx(power(random_facet[1:, 1:]), rel=3e-3)

    def test_twice_as_many_steps_change_nothing_that_matters(self, random_facet: np.ndarray) -> None:
        angle = np.deg2rad(1.0)
        usual = fd.propagate_pipe(random_facet, fd.NOMINAL_PIPE_WIDTH, 18.75, angle, fd.STEPS)
        finer = fd.propagate_pipe(random_facet, fd.NOMINAL_PIPE_WIDTH, 18.75, angle, 2 * fd.STEPS)
        assert power(usual - finer) < 1e-3 * power(finer)

    @pytest.mark.parametrize("angle_deg", [-1.0, 0.0, 0.6])
    @pytest.mark.parametrize(
        ("source_px", "normal_axis"), [((20.0, 106.0), "y"), ((-12.0, -104.0), "y"), ((146.0, 9.0), "x")]
    )
    def test_a_beam_lands_where_and_with_the_phase_that_reflection_says(
        self, angle_deg: float, source_px: tuple[float, float], normal_axis: str
    ) -> None:
        """k -> k - 2 (k.n) n and 2 (k.n) c + pi at a wall n.r = c; (kz - nk) L in the glass; out at x = -f k / k0."""
        device = PERFECT.with_parameters(pipe_angle_deg=angle_deg)
        f, width, length = device.focal_length, device.pipe_width, device.pipe_length
        angle = np.deg2rad(angle_deg)
        source = np.array(source_px) * fd.SLM_PITCH
        k = -fd.WAVENUMBER / f * source
        normal = np.array([np.sin(angle), np.cos(angle)]) if normal_axis == "y" else np.array([1.0, 0.0])
        wall = np.sign(k @ normal) * width / 2
        phase = 2 * (k @ normal) * wall + np.pi + (np.sqrt(GLASS**2 - k @ k) - GLASS) * length
        landing = -f / fd.WAVENUMBER * (k - 2 * (k @ normal) * normal)

        facet_y, facet_x = device.facet_coordinates
        y = (facet_y[:, None] - facet_x[None, :] * np.sin(angle)) / np.cos(angle)
        plane_wave = np.exp(1j * (k[0] * facet_x[None, :] + k[1] * y))
        image = device.delaunch(device.propagate(plane_wave))
        brightest = np.unravel_index(np.argmax(np.abs(image.field)), image.field.shape)
        found = np.array([image.x0 + brightest[1] * fd.IMAGE_PITCH, image.y0 + brightest[0] * fd.IMAGE_PITCH])
        assert np.abs(found - landing).max() < fd.IMAGE_PITCH
        there = complex(image.at(landing[:1], landing[1:])[0])
        # The beam fills only a part of the exit facet: take the same part of a plane wave.
        k_out = -fd.WAVENUMBER / f * landing
        shift = length * k / np.sqrt(GLASS**2 - k @ k)
        lit = reflected_once(device, shift, normal_axis)
        ideal = device.delaunch(np.exp(1j * (phase + k_out[0] * facet_x[None, :] + k_out[1] * y)) * lit)
        expected = complex(ideal.at(landing[:1], landing[1:])[0])
        assert abs(there) == pytest.approx(abs(expected), rel=0.08)
        assert abs(np.angle(there / expected)) < 0.1


def reflected_once(device: ForeignDevice, shift: np.ndarray, normal_axis: str) -> np.ndarray:
    """The part of the exit facet that rays reach after one reflection on that axis and none on the other, [y', x]."""
    angle = device.angle
    along = {"x": shift[0], "y": shift[0] * np.sin(angle) + shift[1] * np.cos(angle)}
    facet_y, facet_x = device.facet_coordinates
    half = device.pipe_width / 2
    masks = {}
    for axis, facet in (("x", facet_x), ("y", facet_y)):
        direction = np.sign(along[axis])
        # Unfolded, an exit point that was mirrored lies in the next cell.
        unfolded = direction * 2 * half - facet if axis == normal_axis else facet
        masks[axis] = np.abs(unfolded - along[axis]) <= half
    return np.outer(masks["y"], masks["x"])


@pytest.fixture(scope="module")
def random_facet() -> np.ndarray:
    rng = np.random.default_rng(0)
    return PERFECT.launch(PERFECT.modulate(rng.integers(0, 256, fd.PAGE_SHAPE), 256, rng))


class TestLenses:
    def test_a_page_turned_by_shears_is_the_page_seen_from_turned_axes(self) -> None:
        """The launched field of a rolled pipe, read at turned places, is that of a pipe without roll."""
        rng = np.random.default_rng(1)
        page = PERFECT.modulate(rng.integers(0, 16, fd.PAGE_SHAPE), 16, rng)
        straight = PERFECT.launch(page)
        rolled = PERFECT.with_parameters(pipe_roll_deg=0.4).launch(page)
        facet_y, facet_x = PERFECT.facet_coordinates
        dy, dx = PERFECT.pitches
        x, y = fd.rotate(facet_x[None, 40:-40], facet_y[40:-40, None], np.deg2rad(0.4))
        where = np.stack([(y - facet_y[0]) / dy, (x - facet_x[0]) / dx])
        turned = sum(
            unit * map_coordinates(part, where, order=5) for unit, part in ((1, straight.real), (1j, straight.imag))
        )
        # The facet is sampled near its own band limit: splines leave a few per cent.
        assert abs(coherence(turned, rolled[40:-40, 40:-40])) > 0.995

    def test_without_a_pipe_the_page_is_imaged_upright_and_in_phase(self) -> None:
        rng = np.random.default_rng(2)
        symbols = rng.integers(0, 16, fd.PAGE_SHAPE)
        device = PERFECT.with_parameters(pipe_angle_deg=0.7, page_centre_px=(5.5, -3.25), focal_length_error=0.002)
        image = device.delaunch(device.launch(device.modulate(symbols, 16, rng)))
        seen = image.at(*symbol_places((5.5, -3.25)))
        assert abs(coherence(seen, np.exp(2j * np.pi * symbols / 16)) - 1) < 0.05

    def test_power_that_enters_the_facet_reaches_the_camera_plane(self, random_facet: np.ndarray) -> None:
        image = PERFECT.delaunch(random_facet)
        in_image = power(image.field) * fd.IMAGE_PITCH**2
        on_facet = power(random_facet) * np.prod(PERFECT.pitches)
        assert in_image == pytest.approx(on_facet, rel=0.02)
        assert in_image <= on_facet


def symbol_places(centre_px: tuple[float, float] = (0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """(x, y) of the symbols' centres, mm."""
    rows, columns = fd.PAGE_SHAPE
    pitch = fd.SYMBOL_PX * fd.SLM_PITCH
    x = (np.arange(columns) - (columns - 1) / 2) * pitch + centre_px[0] * fd.SLM_PITCH
    y = (np.arange(rows) - (rows - 1) / 2) * pitch + centre_px[1] * fd.SLM_PITCH
    return np.broadcast_arrays(x[None, :], y[:, None])  # type: ignore[return-value]


def demodulate(frames: list[np.ndarray], references: list[np.ndarray]) -> np.ndarray:
    """I + iQ, the |E|^2 term taken for noise and the camera's pixels averaged."""
    parts = [
        (f.astype(float) - r) / (2 * np.sqrt(np.maximum(r.astype(float), 1)))
        for f, r in zip(frames, references, strict=True)
    ]
    return gaussian_filter(parts[0], 2) + 1j * gaussian_filter(parts[1], 2)


class Written:
    """One recorded page of a device, with its light."""

    def __init__(self, device: ForeignDevice, path: Path) -> None:
        self.device, self.path = device, path
        self.symbols = device.write(path, 1, 16, seed=4)
        with h5py.File(path) as file:
            self.frames = [file[name][0] for name in ("in_phase", "quadrature")]
            self.references = [file[f"reference_{name}"][()] for name in ("in_phase", "quadrature")]

    def central_coherence(self, sign: int = 1) -> complex:
        """Overlap of the frames with the symbols in the middle of the page, where light meets no wall."""
        field = demodulate(self.frames, self.references)
        x, y = symbol_places(self.device.parameters.page_centre_px)
        rows, columns = ((n - 1) / 2 for n in fd.FRAME_SHAPE)
        where = np.stack([y / fd.CAMERA_PITCH + rows, x / fd.CAMERA_PITCH + columns])
        seen = map_coordinates(field.real, where, order=1) + 1j * sign * map_coordinates(field.imag, where, order=1)
        k2 = (fd.WAVENUMBER / self.device.focal_length) ** 2 * (x**2 + y**2)
        seen = seen * np.exp(-1j * (np.sqrt(GLASS**2 - k2) - GLASS) * self.device.pipe_length)
        middle = np.s_[22:34, 36:51]
        return coherence(seen[middle], np.exp(2j * np.pi * self.symbols[0] / 16)[middle])


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    device = PERFECT.with_parameters(pipe_angle_deg=-0.6, pipe_roll_deg=0.1, page_centre_px=(3.0, -4.0))
    return Written(device, tmp_path_factory.mktemp("foreign") / "upright.h5")


class TestCameras:
    def test_the_middle_of_the_page_is_upright_and_in_phase_on_the_frames(self, written: Written) -> None:
        found = written.central_coherence()
        assert abs(found) > 0.8
        # The piston of the first page is random by design.
        assert abs(written.central_coherence(sign=-1)) < 0.3

    def test_a_quadrature_camera_of_the_other_sign_turns_the_other_way(self, tmp_path: Path, written: Written) -> None:
        other = Written(written.device.with_parameters(quadrature_sign=-1), tmp_path / "other.h5")
        assert abs(other.central_coherence(sign=-1)) > 0.8
        assert abs(other.central_coherence()) < 0.3

    def test_light_on_the_upper_left_of_the_page_arrives_at_the_upper_left_of_the_frame(self) -> None:
        lit = np.zeros(fd.PAGE_PX, complex)
        lit[60:80, 100:130] = 1
        image = PERFECT.delaunch(PERFECT.propagate(PERFECT.launch(lit)))
        seen = np.abs(PERFECT.signal(image, Camera(), PageDrift())) ** 2
        row, column = np.unravel_index(np.argmax(gaussian_filter(seen, 20)), seen.shape)
        scale = fd.SLM_PITCH / fd.CAMERA_PITCH
        assert row == pytest.approx((69.5 - 111.5) * scale + 455.5, abs=15)
        assert column == pytest.approx((114.5 - 173.5) * scale + 683.5, abs=15)

    @pytest.mark.parametrize(
        ("camera", "moved"),
        [
            (Camera(shift_px=(5, -3)), lambda x, y: (x + 5, y - 3)),
            (Camera(scale=0.01), lambda x, y: (x * 1.01, y * 1.01)),
            (Camera(rotation_deg=0.3), lambda x, y: (x - y * np.deg2rad(0.3), y + x * np.deg2rad(0.3))),
        ],
    )
    def test_a_camera_moves_the_image_as_its_pose_says(self, camera: Camera, moved: object) -> None:
        """A Gaussian spot in the camera plane is found at the moved place."""
        spot_px = np.array([220.0, -140.0])
        grid = 401
        axis = (np.arange(grid) - 200) * fd.IMAGE_PITCH
        x0, y0 = spot_px * fd.CAMERA_PITCH
        spot = np.exp(-(axis[None, :] ** 2 + axis[:, None] ** 2) / (2 * 0.03**2)).astype(complex)
        image = fd.Image(spot, y0 + axis[0], x0 + axis[0])
        seen = np.abs(PERFECT.signal(image, camera, PageDrift()))
        row, column = (np.average(np.arange(n), weights=seen.sum(axis=1 - a)) for a, n in enumerate(fd.FRAME_SHAPE))
        wanted_x, wanted_y = moved(*spot_px)  # type: ignore[operator]
        assert column - 683.5 == pytest.approx(wanted_x, abs=0.02)
        assert row - 455.5 == pytest.approx(wanted_y, abs=0.02)

    def test_frames_are_signal_and_reference_interfering_in_quadrature(self, random_facet: np.ndarray) -> None:
        """in-phase = |E+R|^2, quadrature = |E+iR|^2: their light less |E|^2 and |R|^2 is twice E R*."""
        device = PERFECT.with_parameters(tilt_rad=(2.0, -1.0), curvature_rad=1.5, ripple=0.1)
        image = device.delaunch(random_facet)
        signal, reference = device.signal(image, Camera(), PageDrift()), device.reference(Camera())
        direct = np.abs(signal) ** 2 + np.abs(reference) ** 2
        in_phase, quadrature = device.intensities(image)
        product = (in_phase - direct) + 1j * (quadrature - direct)
        assert np.abs(product - 2 * signal * reference.conj()).max() < 1e-5

    def test_reference_is_as_strong_as_its_ratio_says(self) -> None:
        device = PERFECT.with_parameters(reference_ratio=2.0)
        image = device.image(np.random.default_rng(0).integers(0, 16, fd.PAGE_SHAPE), 16, np.random.default_rng(1))
        half_height, half_width = (int(n * fd.SLM_PITCH / fd.CAMERA_PITCH / 2) for n in fd.PAGE_PX)
        lit = np.s_[455 - half_height : 455 + half_height, 683 - half_width : 683 + half_width]
        signal = np.sqrt(np.mean(np.abs(device.signal(image, Camera(), PageDrift())[lit]) ** 2))
        assert np.abs(device.reference(Camera())).mean() / signal == pytest.approx(2.0, rel=0.04)


class TestNoise:
    @pytest.mark.parametrize(("bit_depth", "read_noise"), [(12, 0.0), (12, 40.0), (8, 2.5)])
    def test_counts_have_the_mean_and_variance_of_shot_read_and_rounding_noise(
        self, bit_depth: int, read_noise: float
    ) -> None:
        device = PERFECT.with_parameters(bit_depth=bit_depth, read_noise_e=read_noise, full_well_e=8000.0)
        electrons = 3000.0
        intensity = np.full((300, 400), electrons / device.electrons_per_intensity)
        counts = device.expose(intensity, np.random.default_rng(0)).astype(float)
        gain = (2**bit_depth - 1) / 8000.0
        assert counts.mean() == pytest.approx(electrons * gain, rel=1e-3)
        assert counts.var() == pytest.approx((electrons + read_noise**2) * gain**2 + 1 / 12, rel=0.03)

    def test_averaging_takes_the_noise_out_of_reference_frames(self) -> None:
        device = PERFECT.with_parameters(bit_depth=16, read_noise_e=60.0)
        intensity = np.full((200, 200), 5000.0 / device.electrons_per_intensity)
        one, many = (device.expose(intensity, np.random.default_rng(0), n).astype(float) for n in (1, 64))
        assert many.mean() == pytest.approx(one.mean(), rel=1e-3)
        assert many.var() == pytest.approx(one.var() / 64, rel=0.1)

    def test_too_much_light_clips_at_full_scale(self) -> None:
        device = PERFECT.with_parameters(bit_depth=10)
        counts = device.expose(np.full((4, 4), 1e3), np.random.default_rng(0))
        assert counts.dtype == np.uint16
        assert (counts == 1023).all()

    def test_drift_walks_with_the_steps_that_the_device_says(self) -> None:
        device = PERFECT.with_parameters(piston_drift_rad=0.5, shift_drift_px=0.2)
        walk = device.walk(2000, np.random.default_rng(0))
        pistons = np.diff([drift.piston_rad for drift in walk])
        shifts = np.diff([drift.shift_px for drift in walk], axis=0)
        assert pistons.std() == pytest.approx(0.5, rel=0.1)
        assert shifts.std(axis=0) == pytest.approx([0.2, 0.2], rel=0.1)
        jumped = device.walk(2000, np.random.default_rng(0), {0: (5.0, 0.0), 3: (-2.0, 7.0)})
        moved = np.array([drift.shift_px for drift in jumped]) - [drift.shift_px for drift in walk]
        np.testing.assert_allclose(moved[[0, 2, 3, 1999]], [(5, 0), (5, 0), (3, 7), (3, 7)], atol=1e-9)


class TestRecording:
    def test_the_same_seeds_give_the_same_file_and_others_another(self, tmp_path: Path) -> None:
        device = ForeignDevice.draw(11)
        assert device == ForeignDevice.draw(11)
        assert device != ForeignDevice.draw(12)
        contents = []
        for name, seed in (("a", 5), ("b", 5), ("c", 6)):
            device.write(tmp_path / name, 1, 16, seed)
            with h5py.File(tmp_path / name) as file:
                contents.append({key: file[key][()] for key in file})
        assert all(np.array_equal(contents[0][key], contents[1][key]) for key in contents[0])
        assert not np.array_equal(contents[0]["in_phase"], contents[2]["in_phase"])
        assert not np.array_equal(contents[0]["symbols"], contents[2]["symbols"])

    def test_the_file_has_the_documented_layout_and_tells_nothing_else(self, written: Written) -> None:
        with h5py.File(written.path) as file:
            assert dict(file.attrs) == {
                "format": "lightpage-recording",
                "version": 1,
                "camera_bit_depth": 8,
                "levels": 16,
            }
            assert set(file) == {"symbols", "in_phase", "quadrature", "reference_in_phase", "reference_quadrature"}
            assert file["symbols"].shape == (1, 56, 87)
            assert file["in_phase"].shape == (1, 912, 1368)
            assert file["in_phase"].dtype == file["reference_quadrature"].dtype == np.uint8
            assert np.array_equal(file["symbols"], written.symbols)

    def test_few_pixels_clip_and_the_range_is_used(self, written: Written) -> None:
        for frame in written.frames:
            assert np.mean(frame == 255) < 1e-3
            assert np.percentile(frame, 99.9) > 120

    def test_drawn_devices_fill_the_capture_range(self) -> None:
        drawn = [ForeignDevice.draw(seed).parameters for seed in range(200)]
        for name, limit in (
            ("pipe_angle_deg", 1.0),
            ("focal_length_error", 0.003),
            ("pipe_length_error", 0.005),
            ("pipe_width_error", 0.0005),
            ("pipe_roll_deg", 0.4),
            ("distortion", 0.003),
            ("coma_rad", 2.0),
            ("quadrature_error_deg", 6.0),
        ):
            values = np.array([getattr(p, name) for p in drawn])
            assert np.abs(values).max() <= limit, name
            assert values.min() < -0.9 * limit, name
            assert values.max() > 0.9 * limit, name
        assert {p.quadrature_sign for p in drawn} == {-1, 1}
        assert Parameters() != drawn[0]
