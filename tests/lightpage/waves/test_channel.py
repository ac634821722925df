"""Claims about the waves: what the pipe and the lenses keep, undo and image, against direct sums and other methods."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy import fft, integrate, linalg, ndimage

from lightpage.device.lens_path import SeidelTerms
from lightpage.waves.channel import WaveChannel
from lightpage.waves.geometry import WaveGeometry, facet_axis, modes_for, sine_matrix, taper_defocus
from lightpage.waves.lens import FourierLens
from lightpage.waves.pipe import PipePropagator

DEVICE = WaveGeometry(
    wavelength_m=532e-9, focal_length_m=10e-3, pipe_length_m=9.375e-3, pipe_width_m=0.444815e-3, refractive_index=1.461
)
GLASS = DEVICE.refractive_index * DEVICE.wave_number
CELLS = (46, 61)


def device(angle_deg: float = 0.0, roll_deg: float = 0.0, length_m: float = DEVICE.pipe_length_m) -> WaveGeometry:
    return replace(DEVICE, pipe_angle=np.deg2rad(angle_deg), pipe_roll=np.deg2rad(roll_deg), pipe_length_m=length_m)


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    """Complex white noise in single precision, the precision of the waves."""
    rng = np.random.default_rng(seed)
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


def off(a: np.ndarray, b: np.ndarray) -> float:
    """Relative distance of `a` from `b`."""
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def axis(count: int, pitch_m: float) -> np.ndarray:
    return (np.arange(count) - (count - 1) / 2) * pitch_m


@pytest.fixture(scope="module")
def facet() -> np.ndarray:
    """A field on the entrance facet that fills every mode."""
    return noise(CELLS[0] - 1, CELLS[1] - 1)


class TestPipe:
    @pytest.mark.parametrize("angle_deg", [0.0, -0.6, 3.0])
    def test_the_adjoint_undoes_the_pipe(self, angle_deg: float, facet: np.ndarray) -> None:
        pipe = PipePropagator(device(angle_deg), CELLS, 16)
        assert off(pipe.forward(facet), facet) > 1
        assert off(pipe.adjoint(pipe.forward(facet)), facet) < 1e-5
        other = noise(*facet.shape, seed=2)
        assert np.vdot(other, pipe.forward(facet)) == pytest.approx(np.vdot(pipe.adjoint(other), facet), rel=1e-4)

    @pytest.mark.parametrize(
        ("angle_deg", "length_m", "kept", "higher"),
        [(-10.0, 7e-5, 1.0, 0.0), (20.0, 7e-5, 1.0, 0.3), (4.0, 1e-3, 0.5, 0.0)],
    )
    def test_a_step_is_the_matrix_exponential_of_the_cross_term_between_half_steps(
        self, angle_deg: float, length_m: float, kept: float, higher: float
    ) -> None:
        cells, sides = (8, 11), ((1 + higher) * 30e-6, 30e-6)
        geometry = replace(device(angle_deg, length_m=length_m), pipe_width_m=sides[1], pipe_height_relative=higher)
        derivatives, coupled = [], []
        for n, w in zip(cells, sides, strict=True):
            squares = (np.pi * np.arange(1, n) / w) ** 2
            apart = np.abs(squares[:, None] - squares) * length_m / (2 * GLASS)
            derivative = _derivative_between_sines(n - 1) / w
            derivatives.append(derivative * np.clip(3 - apart / (0.4 * np.pi), 0, 1))
            coupled.append(np.linalg.norm(derivatives[-1]) / np.linalg.norm(derivative))
        assert min(coupled) == pytest.approx(kept, abs=0.25 if kept < 1 else 1e-12)
        laplacian = 2 * np.sin(geometry.pipe_angle) * np.kron(*derivatives)
        step = linalg.expm(1j * geometry.pipe_length_m / (2 * GLASS) * laplacian)
        numbers = [np.pi * np.arange(1, n) / w for n, w in zip(cells, sides, strict=True)]
        transverse = numbers[0][:, None] ** 2 + numbers[1][None, :] ** 2
        half = np.exp(0.5j * (np.sqrt(GLASS**2 - transverse) - GLASS) * geometry.pipe_length_m).ravel()
        field = noise(cells[0] - 1, cells[1] - 1)
        modes = fft.dstn(field, type=1, norm="ortho").ravel()
        expected = fft.dstn((half * (step @ (half * modes))).reshape(field.shape), type=1, norm="ortho")
        assert off(step, np.eye(len(step))) > 0.1
        assert off(PipePropagator(geometry, cells, 1).forward(field), expected) < 1e-5

    def test_a_taper_bends_light_as_a_staircase_of_even_pipes_does(self) -> None:
        count, taper, stairs = 23, 0.1, 400
        geometry = replace(DEVICE, pipe_width_m=0.2e-3, pipe_taper=taper)
        sides = [geometry.facet_sides_m(second=leaving)[1] for leaving in (False, True)]
        u, number = (np.arange(2000) + 0.5) / 2000, np.arange(1, count + 1)
        given = stepped = noise(count) * (number < 12)
        before = sides[0]
        for width in sides[0] * (1 + taper * (np.arange(stairs) + 0.5) / stairs):
            earlier = np.sin(np.pi * number * (0.5 + (u[:, None] - 0.5) * width / before)) @ stepped
            stepped = 2 / len(u) * np.sqrt(width / before) * np.sin(np.pi * number[:, None] * u) @ earlier
            stepped *= np.exp(-0.5j * (np.pi * number / width) ** 2 * geometry.pipe_length_m / stairs / GLASS)
            before = width
        factors, sines = taper_defocus(GLASS, geometry.pipe_length_m, taper), sine_matrix(count + 1)
        entrance, leaving = (
            np.exp(1j * f * facet_axis(count + 1, side) ** 2) for f, side in zip(factors, sides, strict=True)
        )
        field = PipePropagator(geometry, (2, count + 1), 1).forward((given @ sines * entrance)[None])[0]
        found = sines @ (field * leaving)
        piston = np.vdot(found, stepped)  # the mode along y' turns all of it
        assert off(found * piston / abs(piston), stepped) < 0.01

    def test_modes_that_the_glass_cannot_carry_are_refused(self) -> None:
        with pytest.raises(ValueError, match="wanted"):
            PipePropagator(replace(DEVICE, pipe_width_m=10e-6), (80, 8), 1)


def _derivative_between_sines(count: int) -> np.ndarray:
    """(2/w) times the integral of sin(m pi x/w) d/dx sin(n pi x/w) over the width, times w, by quadrature."""
    u = np.linspace(0, 1, 2001)
    number = np.arange(1, count + 1)
    sines = np.sin(np.pi * np.outer(number, u))
    slopes = np.pi * number[:, None] * np.cos(np.pi * np.outer(number, u))
    return np.array([[2 * integrate.simpson(s * d, x=u) for d in slopes] for s in sines])


def summed_directly(
    geometry: WaveGeometry, x: np.ndarray, y: np.ndarray, plane: np.ndarray, path: Callable[..., np.ndarray | float]
) -> Iterator[tuple[int, int, complex]]:
    """Light of a plane at some of the facet's samples (row, column); `path` is what a lens adds, radians."""
    rng, t, r = np.random.default_rng(4), geometry.pipe_angle, geometry.pipe_roll
    for _ in range(20):
        row, column = int(rng.integers(CELLS[0] - 1)), int(rng.integers(CELLS[1] - 1))
        # from the facet's oblique coordinates to the pipe's square ones, then rolled against the page
        across = ((column + 1) / CELLS[1] - 0.5) * geometry.pipe_width_m
        up = (((row + 1) / CELLS[0] - 0.5) * geometry.pipe_width_m - across * np.sin(t)) / np.cos(t)
        at_x, at_y = across * np.cos(r) - up * np.sin(r), across * np.sin(r) + up * np.cos(r)
        angle = -geometry.wave_number / geometry.focal_length_m * (x[None] * at_x + y[:, None] * at_y)
        wave = np.exp(1j * (angle + path(x[None], y[:, None], at_x, at_y)))
        cell = geometry.pipe_width_m**2 / CELLS[0] / CELLS[1] / np.cos(t)
        sample = (x[1] - x[0]) * (y[1] - y[0])
        unit = np.sqrt(cell * sample) / geometry.wavelength_m / geometry.focal_length_m
        yield row, column, complex(np.sum(plane * wave) * unit)


class TestLens:
    def test_the_two_directions_are_adjoint(self, facet: np.ndarray) -> None:
        lens = FourierLens(device(-0.6, roll_deg=0.4), axis(70, 9e-6) + 2e-5, axis(50, 9e-6), CELLS)
        plane = noise(50, 70, seed=3)
        assert np.vdot(facet, lens.to_facet(plane)) == pytest.approx(np.vdot(lens.to_plane(facet), plane), rel=1e-4)

    @pytest.mark.parametrize(("angle_deg", "roll_deg"), [(0.0, 0.0), (-0.6, 0.0), (0.0, 0.4), (-0.6, -0.4), (3.0, 5.0)])
    def test_the_low_rank_expansion_equals_the_kernel_summed_directly(self, angle_deg: float, roll_deg: float) -> None:
        geometry = device(angle_deg, roll_deg)
        x, y = axis(60, 27e-6) + 18e-6, axis(44, 23e-6) - 30e-6
        plane = noise(44, 60)
        got = FourierLens(geometry, x, y, CELLS).to_facet(plane)
        for row, column, expected in summed_directly(geometry, x, y, plane, lambda *points: 0.0):
            assert abs(got[row, column] - expected) < 2e-5 * np.abs(got).max()

    @pytest.mark.parametrize("second", [False, True])
    def test_a_real_lens_adds_its_path_to_every_ray_between_plane_and_facet(self, second: bool) -> None:
        page, wall = 0.95e-3, DEVICE.pipe_width_m / 2
        radians = {(4, 0): -5, (3, 1): -4, (2, 2): -3, (1, 3): -1.5, (0, 4): -1, (0, 2): 1.5, (1, 2): 0.8}
        of = {powers: value / page ** powers[0] / wall ** powers[1] for powers, value in radians.items()}
        even = of[4, 0], of[3, 1], of[2, 2], -of[2, 2], of[1, 3], of[0, 4], of[0, 2]
        terms = SeidelTerms(*even, of[1, 2], -of[1, 2])
        geometry = replace(device(-0.6, 0.2), lens_path=terms, camera_path=terms.mirrored())
        x, y = axis(60, 27e-6) + 18e-6, axis(44, 23e-6) - 30e-6
        plane = noise(44, 60)
        lens, ideal = (FourierLens(g, x, y, CELLS, second=second) for g in (geometry, device(-0.6, 0.2)))
        got = lens.to_facet(plane)
        assert off(ideal.to_facet(plane), got) > 0.5
        # the mirror image of a lens sends the same path the other way: through the facet's point to -x, -y
        sign = -1 if second else 1

        def path(x: np.ndarray, y: np.ndarray, at_x: float, at_y: float) -> np.ndarray:
            r2, aperture2, product = x**2 + y**2, at_x**2 + at_y**2, sign * (x * at_x + y * at_y)
            even = r2**2, r2 * product, product**2, r2 * aperture2, aperture2 * product, aperture2**2, aperture2
            powers = *even, sign * x * aperture2, sign * y * aperture2
            return np.asarray(sign * sum(term * power for term, power in zip(terms, powers, strict=True)))

        for row, column, expected in summed_directly(geometry, x, y, plane, path):
            assert abs(got[row, column] - expected) < 4e-3 * np.abs(got).max()

    def test_the_modes_counted_for_an_edge_reach_the_light_of_that_edge(self) -> None:
        edge = 0.6e-3
        x, y = axis(2, 2 * edge), axis(20, 9.2e-6)
        point = np.zeros((20, 2))
        point[10, 1] = 1
        cells = modes_for(edge, DEVICE, 1.03)
        light = FourierLens(DEVICE, x, y, (60, cells)).to_facet(point)
        by_mode = np.abs(sine_matrix(cells) @ light.T).sum(axis=1)
        strongest = 1 + int(np.argmax(by_mode))
        assert 0.95 * cells < strongest < cells
        # a mode is half a period in the pipe's width
        mode_edge = strongest * DEVICE.wavelength_m * DEVICE.focal_length_m / (2 * DEVICE.pipe_width_m)
        assert mode_edge == pytest.approx(edge, rel=0.01)


class TestChannel:
    @pytest.mark.parametrize(("angle_deg", "roll_deg"), [(0.0, 0.0), (-0.6, 0.3)])
    def test_without_a_pipe_the_page_is_imaged_upright_onto_itself(self, angle_deg: float, roll_deg: float) -> None:
        x, y = axis(160, 4e-6) + 8e-6, axis(120, 4e-6) - 12e-6
        # a lopsided pair of spots with different phases, inside the band
        page = np.exp(-((x[None] - 1.2e-4) ** 2 + (y[:, None] - 0.7e-4) ** 2) / (25e-6) ** 2)
        page = page + 0.6j * np.exp(-((x[None] + 0.9e-4) ** 2 + (y[:, None] - 1.1e-4) ** 2) / (25e-6) ** 2)
        geometry = device(angle_deg, roll_deg, length_m=0.0)
        channel = WaveChannel(geometry, x, y, x, y, cells=(46, 61), steps=4)
        assert off(channel.forward(page), page) < 0.01

    def test_the_pixel_envelope_is_that_of_square_pixels(self) -> None:
        pitch, fine = 9.2e-6, 5
        seen = axis(9, pitch), axis(9, pitch)
        page = noise(16, 20)
        coarse, finer = (
            WaveChannel(device(-2.0), axis(20 * n, pitch / n), axis(16 * n, pitch / n), *seen, CELLS, 1, pitch / n)
            for n in (1, fine)
        )
        split = np.kron(page, np.ones((fine, fine))) / fine
        assert off(coarse.exit_field(page), finer.exit_field(split)) < 1e-5

    def test_the_blur_is_a_gaussian_of_its_width(self) -> None:
        pitch, blur_px = 2.3e-6, 2.0
        page = np.zeros((80, 80), np.complex64)
        page[30:50, 30:50] = noise(20, 20)
        sharp = WaveChannel(DEVICE, axis(80, pitch), axis(80, pitch), axis(9, pitch), axis(9, pitch), CELLS, steps=4)
        blurred = replace(sharp, blur_m2=(blur_px * pitch) ** 2)
        by_hand = ndimage.gaussian_filter(page.real, blur_px, truncate=6) + 1j * ndimage.gaussian_filter(
            page.imag, blur_px, truncate=6
        )
        assert off(blurred.exit_field(page), sharp.exit_field(by_hand)) < 1e-4

    def test_the_chain_is_undone_by_its_adjoint_inside_the_band(self) -> None:
        x, y = axis(160, 4e-6), axis(120, 4e-6)
        page = np.exp(-((x[None] - 1e-4) ** 2 + (y[:, None] - 0.5e-4) ** 2) / (30e-6) ** 2)
        wide_x, wide_y = axis(182, 4e-6), axis(137, 4e-6)
        channel = WaveChannel(device(-0.6, 0.2), x, y, wide_x, wide_y, cells=(46, 61), steps=16)
        assert off(channel.adjoint(channel.forward(page)), page) < 0.01
