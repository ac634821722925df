"""A storage device by other hands: a simulator that shares no code and few conventions with the project's own.

It stands for "somebody else's device" in the end-to-end test: a recording made here must be decoded from the
documented file layout alone. Lengths are millimetres inside. The pipe is propagated on its odd, periodic, 2w x 2w
extension by FFT, in the oblique coordinates (x, y') of its walls; lenses are chirp-z transforms (zero-padded FFTs with
a free scale) onto grids of another pitch for x and y; cameras look at the field through cubic splines. Nothing of the
project is imported.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter
from scipy.signal import CZT

ComplexArray = NDArray[np.complexfloating]
FloatArray = NDArray[np.floating]

WAVELENGTH = 532e-6
WAVENUMBER = 2 * np.pi / WAVELENGTH
GLASS_INDEX = 1.461
SLM_PITCH = 9.2e-3
SYMBOL_PX = 4
CAMERA_PITCH = 2.4e-3
IMAGE_PITCH = 3e-3
"""Pitch of the camera-plane field, a quarter of what its band asks for, so that cubic splines are good to -60 dB."""
IMAGE_MARGIN = 0.09
"""Margin of the computed camera-plane field around the nominal frame, mm: shift, scale, rotation and distortion."""
TAYLOR_TERMS = 4
REFERENCE_EXPOSURES = 64


@dataclass(frozen=True)
class Design:
    """Nominal values of a device, and how finely it is computed.

    Attributes:
        focal_length, pipe_length, pipe_width: mm.
        page_shape: symbols (y, x).
        frame_shape: camera pixels (y, x).
        padded_px: SLM pixels with a dark border, in which the page is turned against the pipe.
        facet: samples from wall to wall in (y', x), 25% more than the page's angles fill.
        steps: through the pipe.
    """

    focal_length: float = 20.0
    pipe_length: float = 18.75
    pipe_width: float = 0.88963
    page_shape: tuple[int, int] = (56, 87)
    frame_shape: tuple[int, int] = (912, 1368)
    padded_px: tuple[int, int] = (270, 400)
    facet: tuple[int, int] = (225, 320)
    steps: int = 64

    @property
    def page_px(self) -> tuple[int, int]:
        """The page's SLM pixels (y, x)."""
        return self.page_shape[0] * SYMBOL_PX, self.page_shape[1] * SYMBOL_PX

    @property
    def corner(self) -> float:
        """Distance of the page's corner from its centre, mm."""
        return float(np.hypot(*self.page_px)) * SLM_PITCH / 2


BENCH = Design()
HALF = Design(
    focal_length=10.0,
    pipe_length=9.375,
    pipe_width=0.444815,
    page_shape=(28, 44),
    frame_shape=(456, 684),
    padded_px=(136, 200),
    facet=(112, 160),
    steps=32,
)
"""The bench device with a page a quarter as large; light takes a tenth of the time."""


@dataclass(frozen=True)
class Camera:
    """Place of a camera: the image is scaled and turned about the frame's centre, then shifted."""

    scale: float = 0.0
    rotation_deg: float = 0.0
    shift_px: tuple[float, float] = (0.0, 0.0)
    """(x, y)."""
    behind_mm: float = 0.0
    """Distance from the focal plane."""
    keystone: tuple[float, float] = (0.0, 0.0)
    """Relative growth of the scale from the image's centre to its edge, along x and y."""


@dataclass(frozen=True)
class Parameters:
    """Everything that is true of one device. The defaults are a perfect one; errors are relative to nominal."""

    pipe_angle_deg: float = 0.0
    focal_length_error: float = 0.0
    pipe_length_error: float = 0.0
    pipe_width_error: float = 0.0
    page_centre_px: tuple[float, float] = (0.0, 0.0)
    """(x, y) of the page's centre off the optical axis, SLM pixels."""
    pipe_roll_deg: float = 0.0
    in_phase_camera: Camera = Camera()
    quadrature_camera: Camera = Camera()
    distortion: float = 0.0
    """Relative radial displacement at the page's corner."""
    defocus_rad: float = 0.0
    astigmatism_rad: float = 0.0
    astigmatism_axis_deg: float = 0.0
    coma_rad: float = 0.0
    coma_axis_deg: float = 0.0
    reference_ratio: float = 1.6
    """Mean amplitude of the reference over the root mean square of the signal's."""
    ripple: float = 0.0
    """Amplitude of the reference's fringes, relative."""
    ripple_seed: int = 0
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    """(x, y): phase of the reference at the page's right and lower edge."""
    curvature_rad: float = 0.0
    """Phase of the reference at the page's corner."""
    quadrature_error_deg: float = 0.0
    quadrature_gain: float = 1.0
    quadrature_sign: int = 1
    stroke_error: float = 0.0
    """Stroke error of the modulator, relative to a whole turn."""
    level_sine_rad: float = 0.0
    level_cosine_rad: float = 0.0
    """Amplitudes of a smooth error of its phase over the levels."""
    unmodulated: float = 0.0
    """Amplitude of the light that it leaves as it is, relative."""
    modulator_behind_mm: float = 0.0
    """Distance from the focal plane."""
    nonlinearity: float = 0.0
    """Counts that a camera lacks at its full well, relative."""
    phase_noise_rad: float = 0.0
    blur_px: float = 0.0
    falloff: float = 0.0
    """Loss of the illumination's amplitude at the page's corner."""
    full_well_e: float = 15_000.0
    read_noise_e: float = 2.5
    bit_depth: int = 8
    piston_drift_rad: float = 0.0
    shift_drift_px: float = 0.0
    """Standard deviations of the steps of two random walks from page to page; the shift is in camera pixels."""
    wall_y_error: float = 0.0
    """Excess of the distance of the oblique walls over that of the x walls, relative."""
    taper: float = 0.0
    """Growth of both distances from entrance to exit, relative; their means stay."""
    ghost: float = 0.0
    """Amplitude of the light that both facets reflect once, and that passes the pipe three times."""
    polarisation_rad: float = 0.0
    """Phase that a reflection at an x wall adds and one at an oblique wall subtracts.

    Light is polarised along x: p at x walls, s at oblique ones.
    """
    hot_pixels: float = 0.0
    """Share of a camera's pixels that always show full scale."""
    dust: int = 0
    """Number of specks on each camera."""
    dust_on_references: bool = True
    """Whether the dust was there when the references were taken."""
    blemish_seed: int = 0
    """Seed of the places of hot pixels and dust."""


def draw_parameters(rng: np.random.Generator) -> Parameters:
    """Draw a device uniformly from the whole range from which calibration must succeed; Q's sign is a coin's.

    Faults that came later, from `wall_y_error` on, stay off: seeds give the devices that they always gave.
    """

    def within(limit: float) -> float:
        return float(rng.uniform(-limit, limit))

    def camera() -> Camera:
        return Camera(scale=within(0.01), rotation_deg=within(0.3), shift_px=(within(12), within(12)))

    return Parameters(
        pipe_angle_deg=within(1.0),
        focal_length_error=within(0.003),
        pipe_length_error=within(0.005),
        pipe_width_error=within(0.0005),
        page_centre_px=(within(6), within(6)),
        pipe_roll_deg=within(0.4),
        in_phase_camera=camera(),
        quadrature_camera=camera(),
        distortion=within(0.003),
        defocus_rad=within(2),
        astigmatism_rad=within(2),
        astigmatism_axis_deg=within(90),
        coma_rad=within(2),
        coma_axis_deg=within(180),
        reference_ratio=float(rng.uniform(1.2, 3.0)),
        ripple=float(rng.uniform(0, 0.1)),
        ripple_seed=int(rng.integers(2**31)),
        tilt_rad=(within(3), within(3)),
        curvature_rad=within(3),
        quadrature_error_deg=within(6),
        quadrature_gain=1 + within(0.1),
        quadrature_sign=1 if rng.random() < 0.5 else -1,
        phase_noise_rad=float(rng.uniform(0, 0.3)),
        blur_px=float(rng.uniform(0, 0.5)),
        falloff=float(rng.uniform(0, 0.3)),
        full_well_e=float(rng.uniform(3_000, 15_000)),
        read_noise_e=float(rng.uniform(0, 6)),
        bit_depth=int(rng.choice([8, 10, 12, 14, 16])),
        piston_drift_rad=float(rng.uniform(0, 0.5)),
        shift_drift_px=float(rng.uniform(0, 0.2)),
    )


@dataclass(frozen=True)
class PageDrift:
    """State of the random walks on one page."""

    piston_rad: float = 0.0
    shift_px: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Facet:
    """An end of the pipe, with its samples.

    Attributes:
        widths: distances of the oblique and of the x walls, mm.
        samples: from wall to wall in (y', x).
        angle: of the pipe, radians.
        scale: widths over the mean widths of the pipe.
    """

    widths: tuple[float, float]
    samples: tuple[int, int]
    angle: float
    scale: float = 1.0

    @property
    def pitches(self) -> tuple[float, float]:
        """Sample pitches (y', x), mm."""
        return self.widths[0] / self.samples[0], self.widths[1] / self.samples[1]

    @cached_property
    def coordinates(self) -> tuple[FloatArray, FloatArray]:
        """(y', x) of the samples, mm; the first sample of each lies on a wall."""
        return tuple(
            np.arange(n) * d - width / 2 for n, d, width in zip(self.samples, self.pitches, self.widths, strict=True)
        )  # type: ignore[return-value]

    @cached_property
    def points(self) -> tuple[FloatArray, FloatArray]:
        """(x, y) of the samples along the axes of the page's rows and columns before its roll, [y', x], mm."""
        oblique, across = self.coordinates
        y = (oblique[:, None] - across[None, :] * np.sin(self.angle)) / np.cos(self.angle)
        return np.broadcast_to(across, y.shape), y

    def power(self, field: ComplexArray) -> float:
        """Return the power of a field [y', x] on the facet."""
        return float(np.sum(np.abs(field) ** 2) * np.prod(self.pitches) / np.cos(self.angle))


@dataclass(frozen=True)
class Pipe:
    """A rhombic pipe.

    Attributes:
        widths: mean distances of the oblique and of the x walls, mm.
        length: mm.
        angle: radians.
        samples: from wall to wall in (y', x).
        steps: of the computation.
        taper, ghost, polarisation: see `Parameters`.
    """

    widths: tuple[float, float]
    length: float
    angle: float
    samples: tuple[int, int]
    steps: int
    taper: float = 0.0
    ghost: float = 0.0
    polarisation: float = 0.0

    @cached_property
    def entrance(self) -> Facet:
        """Facet where light enters."""
        return self._end(2 / (2 + self.taper))

    @cached_property
    def exit(self) -> Facet:
        """Facet where light leaves."""
        return self._end((1 + self.taper) * 2 / (2 + self.taper))

    def _end(self, scale: float) -> Facet:
        return Facet((scale * self.widths[0], scale * self.widths[1]), self.samples, self.angle, scale)

    def through(self, field: ComplexArray) -> ComplexArray:
        """Return the field at the exit of the light at the entrance, the ghost included.

        The ghost is coherent: its way is longer by twice the length of the pipe.
        """
        field = self.one_pass(field, self.entrance, self.exit)
        if self.ghost:
            again = self.one_pass(self.one_pass(field, self.exit, self.entrance), self.entrance, self.exit)
            field = field + self.ghost * np.exp(2j * GLASS_INDEX * WAVENUMBER * self.length) * again
        return field

    def one_pass(self, field: ComplexArray, start: Facet, end: Facet) -> ComplexArray:
        """Return the field at `end` of the light that starts at `start`.

        A tapered pipe is straight in coordinates that grow with its walls. The paraxial wave equation keeps its form if
        the curvature of a wave that spreads with the walls is taken off the field, and dz becomes dz / scale^2.
        """
        growth = (end.scale - start.scale) / self.length
        if growth:
            field = field * spreading(start, -growth)
        scaled = self.length / (start.scale * end.scale)
        field = propagate_pipe(field, self.widths, scaled, self.angle, self.steps, self.polarisation)
        return field * (start.scale / end.scale) * spreading(end, growth) if growth else field


@dataclass(frozen=True)
class ForeignDevice:
    """A device with its optics, cameras and noise."""

    parameters: Parameters = Parameters()
    design: Design = BENCH

    @classmethod
    def draw(cls, seed: int, design: Design = BENCH) -> ForeignDevice:
        """Draw a device from anywhere within the capture range."""
        return cls(draw_parameters(np.random.default_rng([seed, 1])), design)

    def with_parameters(self, **changes: object) -> ForeignDevice:
        """Return this device with some parameters changed."""
        return dataclasses.replace(self, parameters=dataclasses.replace(self.parameters, **changes))  # type: ignore[arg-type]

    def with_faults(self, share: float) -> ForeignDevice:
        """Return this device with a share of the usual size of each fault of pipe, planes, modulator and cameras."""
        p = self.parameters
        sine = self.design.pipe_width / 2 / self.design.focal_length
        mm = share / float(WAVENUMBER * (1 - np.sqrt(1 - sine**2)))  # times a radian at the middle of the facet's wall
        return self.with_parameters(
            wall_y_error=0.001 * share,
            taper=0.0005 * share,
            ghost=0.03 * share,
            polarisation_rad=0.1 * share,
            modulator_behind_mm=1.2 * mm,
            in_phase_camera=dataclasses.replace(p.in_phase_camera, behind_mm=0.8 * mm),
            quadrature_camera=dataclasses.replace(p.quadrature_camera, behind_mm=-0.7 * mm),
            level_sine_rad=0.15 * share,
            stroke_error=-0.015 * share,
            hot_pixels=5e-5 * share,
            dust=round(6 * share),
        )

    # --- geometry -----------------------------------------------------------------------------------------------------

    @property
    def angle(self) -> float:
        """Pipe angle t, radians: the walls are x = +-w/2 and x sin t + y cos t = +-w/2."""
        return float(np.deg2rad(self.parameters.pipe_angle_deg))

    @property
    def focal_length(self) -> float:
        """True focal length of both lenses, mm."""
        return self.design.focal_length * (1 + self.parameters.focal_length_error)

    @cached_property
    def pipe(self) -> Pipe:
        """The true pipe."""
        p, design = self.parameters, self.design
        width = design.pipe_width * (1 + p.pipe_width_error)
        return Pipe(
            widths=(width * (1 + p.wall_y_error), width),
            length=design.pipe_length * (1 + p.pipe_length_error),
            angle=self.angle,
            samples=design.facet,
            steps=design.steps,
            taper=p.taper,
            ghost=p.ghost,
            polarisation=p.polarisation_rad,
        )

    # --- light --------------------------------------------------------------------------------------------------------

    def modulate(self, symbols: NDArray[np.integer], levels: int, rng: np.random.Generator) -> ComplexArray:
        """The field on the SLM's pixels, with illumination, phase noise and aberrations."""
        p = self.parameters
        turn = symbols * (2 * np.pi / levels)
        shown = turn * (1 + p.stroke_error) + p.level_sine_rad * np.sin(turn) + p.level_cosine_rad * np.cos(turn)
        written = np.kron(shown, np.ones((SYMBOL_PX, SYMBOL_PX)))
        written = written + p.phase_noise_rad * rng.standard_normal(written.shape)
        light = np.exp(1j * written) + p.unmodulated
        phase = np.zeros(light.shape)
        y, x = np.meshgrid(*((np.arange(n) - (n - 1) / 2) * SLM_PITCH for n in self.design.page_px), indexing="ij")
        rho, phi = np.hypot(x, y) / self.design.corner, np.arctan2(y, x)
        phase += p.defocus_rad * rho**2
        phase += p.astigmatism_rad * rho**2 * np.cos(2 * (phi - np.deg2rad(p.astigmatism_axis_deg)))
        phase += p.coma_rad * rho**3 * np.cos(phi - np.deg2rad(p.coma_axis_deg))
        return np.asarray((1 - p.falloff * rho**2) * light * np.exp(1j * phase))

    def launch(self, page: ComplexArray) -> ComplexArray:
        """Return the field on the entrance facet [y', x] of SLM pixels, as the pipe sees it."""
        roll, f = np.deg2rad(self.parameters.pipe_roll_deg), self.focal_length
        padded = np.zeros(self.design.padded_px, complex)
        top, left = ((a - b) // 2 for a, b in zip(self.design.padded_px, self.design.page_px, strict=True))
        padded[top : top + self.design.page_px[0], left : left + self.design.page_px[1]] = page
        turned = rotated(padded, -roll)
        right, down = self.parameters.page_centre_px
        centre_x, centre_y = rotate(right * SLM_PITCH, down * SLM_PITCH, -roll)
        y0, x0 = (
            float(c) - (n - 1) / 2 * SLM_PITCH for c, n in zip((centre_y, centre_x), self.design.padded_px, strict=True)
        )
        entrance = self.pipe.entrance
        (facet_y, facet_x), (dy, dx) = entrance.coordinates, entrance.pitches
        tangent, cosine = np.tan(self.angle), np.cos(self.angle)
        field = fourier_sum(turned, (x0, SLM_PITCH), (facet_x[0], dx, self.design.facet[1]), -WAVENUMBER / f, axis=1)
        page_y = y0 + np.arange(self.design.padded_px[0]) * SLM_PITCH
        field *= np.exp(1j * WAVENUMBER / f * tangent * np.outer(page_y, facet_x))
        field = fourier_sum(
            field, (y0, SLM_PITCH), (facet_y[0], dy, self.design.facet[0]), -WAVENUMBER / (f * cosine), axis=0
        )
        x, y = entrance.points
        # Cycles a pixel along the SLM's own axes: they set what a square pixel and the blur let through.
        u, v = (c * SLM_PITCH / (WAVELENGTH * f) for c in rotate(x, y, roll))
        field *= np.sinc(u) * np.sinc(v) * np.exp(-2 * (np.pi * self.parameters.blur_px) ** 2 * (u**2 + v**2))
        return (
            field
            * out_of_focus(entrance.points, f, self.parameters.modulator_behind_mm)
            * SLM_PITCH**2
            / (WAVELENGTH * f)
        )

    def delaunch(self, facet: ComplexArray) -> Image:
        """Return the field on the camera plane of that on the exit facet, in the pipe's axes."""
        f, (facet_y, facet_x), (dy, dx) = self.focal_length, self.pipe.exit.coordinates, self.pipe.exit.pitches
        counts = [
            int(np.ceil((n * CAMERA_PITCH / 2 + IMAGE_MARGIN) / IMAGE_PITCH)) * 2 + 1 for n in self.design.frame_shape
        ]
        y0, x0 = (-(n - 1) / 2 * IMAGE_PITCH for n in counts)
        tangent, cosine = np.tan(self.angle), np.cos(self.angle)
        to_y = (y0, IMAGE_PITCH, counts[0])
        field = fourier_sum(facet, (facet_y[0], dy), to_y, WAVENUMBER / (f * cosine), axis=0)
        image_y = y0 + np.arange(counts[0]) * IMAGE_PITCH
        field *= np.exp(-1j * WAVENUMBER / f * tangent * np.outer(image_y, facet_x))
        field = fourier_sum(field, (facet_x[0], dx), (x0, IMAGE_PITCH, counts[1]), WAVENUMBER / f, axis=1)
        return Image(field * (dy * dx / cosine / (WAVELENGTH * f)), y0, x0)

    def images(self, symbols: NDArray[np.integer], levels: int, rng: np.random.Generator) -> list[Image]:
        """The whole way of one page's light, from symbols to the planes of the in-phase and the quadrature camera."""
        leaving = self.pipe.through(self.launch(self.modulate(symbols, levels, rng)))
        behind = [camera.behind_mm for camera in (self.parameters.in_phase_camera, self.parameters.quadrature_camera)]
        made = {
            distance: self.delaunch(leaving * out_of_focus(self.pipe.exit.points, self.focal_length, distance))
            for distance in behind
        }
        return [made[distance] for distance in behind]

    # --- cameras ------------------------------------------------------------------------------------------------------

    @cached_property
    def signal_rms(self) -> float:
        """Root mean square amplitude of the signal over the page's image: pipe and lenses keep the power."""
        rng = np.random.default_rng(0)
        facet = self.launch(self.modulate(rng.integers(0, 256, self.design.page_shape), 256, rng))
        power = self.pipe.entrance.power(facet)
        return float(np.sqrt(power / (np.prod(self.design.page_px) * SLM_PITCH**2)))

    def signal(self, image: Image, camera: Camera, drift: PageDrift) -> ComplexArray:
        """The signal on a camera's pixels."""
        x, y = plane_coordinates(self.design, camera, drift)
        stretch = 1 + self.parameters.distortion * (x**2 + y**2) / self.design.corner**2
        x, y = rotate(x * stretch, y * stretch, -np.deg2rad(self.parameters.pipe_roll_deg))
        return np.asarray(image.at(x, y) * np.exp(1j * drift.piston_rad))

    def reference(self, camera: Camera) -> ComplexArray:
        """The reference on a camera's pixels."""
        p = self.parameters
        x, y = plane_coordinates(self.design, camera, PageDrift())
        rng = np.random.default_rng(p.ripple_seed)
        fringes = np.zeros(self.design.frame_shape)
        for amplitude in (0.5, 0.3, 0.2):
            direction, period, phase = rng.uniform(0, np.pi), rng.uniform(0.4, 3.0), rng.uniform(0, 2 * np.pi)
            along = x * np.cos(direction) + y * np.sin(direction)
            fringes += amplitude * np.cos(2 * np.pi * along / period + phase)
        half_height, half_width = (n * SLM_PITCH / 2 for n in self.design.page_px)
        front = p.tilt_rad[0] * x / half_width + p.tilt_rad[1] * y / half_height
        front = front + p.curvature_rad * (x**2 + y**2) / self.design.corner**2
        return np.asarray(self.signal_rms * p.reference_ratio * (1 + p.ripple * fringes) * np.exp(1j * front))

    @property
    def electrons_per_intensity(self) -> float:
        """Exposure: the full well takes the reference plus 2.3 times the signal, so that few pixels clip."""
        p = self.parameters
        brightest = self.signal_rms * (p.reference_ratio * (1 + p.ripple) + 2.3)
        return p.full_well_e / (brightest**2 * max(1.0, p.quadrature_gain))

    def expose(
        self, intensity: FloatArray, rng: np.random.Generator, exposures: int = 1
    ) -> NDArray[np.unsignedinteger]:
        """Counts of a frame, or of the mean of several exposures: shot noise, read noise, full well, quantisation."""
        p = self.parameters
        electrons = rng.poisson(intensity * (self.electrons_per_intensity * exposures)).astype(np.float32)
        electrons += np.float32(p.read_noise_e * np.sqrt(exposures)) * rng.standard_normal(
            intensity.shape, dtype=np.float32
        )
        full_scale = 2**p.bit_depth - 1
        electrons *= 1 - np.float32(p.nonlinearity / (p.full_well_e * exposures)) * np.abs(electrons)
        counts = np.rint(electrons * (full_scale / (p.full_well_e * exposures)))
        frame_type = np.uint8 if p.bit_depth == 8 else np.uint16
        return np.asarray(np.clip(counts, 0, full_scale).astype(frame_type), frame_type)

    def intensities(self, images: list[Image], drift: PageDrift = PageDrift()) -> tuple[FloatArray, FloatArray]:
        """Light on the in-phase and the quadrature camera; of the reference alone where there are no images."""
        p = self.parameters
        result = []
        for number, (camera, phase, gain) in enumerate(
            (
                (p.in_phase_camera, 0.0, 1.0),
                (
                    p.quadrature_camera,
                    p.quadrature_sign * (np.pi / 2 + np.deg2rad(p.quadrature_error_deg)),
                    p.quadrature_gain,
                ),
            )
        ):
            field = self.reference(camera) * np.exp(1j * phase)
            if images:
                field += self.signal(images[number], camera, drift)
            light = gain * (field.real**2 + field.imag**2)
            if p.dust and (images or p.dust_on_references):
                light = light * behind_dust(p, number, self.design.frame_shape)
            result.append(light)
        return result[0], result[1]

    def frames(
        self, images: list[Image], rng: np.random.Generator, drift: PageDrift = PageDrift(), exposures: int = 1
    ) -> Iterator[NDArray[np.unsignedinteger]]:
        """Yield the frame of each camera: see `intensities` and `expose`."""
        for number, intensity in enumerate(self.intensities(images, drift)):
            counts = self.expose(intensity, rng, exposures)
            if self.parameters.hot_pixels:
                counts.flat[hot_pixels(self.parameters, number, counts.size)] = 2**self.parameters.bit_depth - 1
            yield counts

    # --- recordings ---------------------------------------------------------------------------------------------------

    def write(
        self,
        path: str | Path,
        pages: int,
        levels: int,
        seed: int,
        pilots: NDArray[np.bool_] | None = None,
        with_symbols: bool = True,
        jumps_px: Mapping[int, tuple[float, float]] | None = None,
        symbols: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.uint8]:
        """Record pages, without a profile; returns the symbols [page, ny, nx].

        Args:
            path: HDF5 file, overwritten.
            pages: how many.
            levels: M, 2 to 256.
            seed: seed of symbols, noise and drift.
            pilots: boolean [ny, nx], written as it is.
            with_symbols: whether the file tells the symbols.
            jumps_px: see `walk`.
            symbols: symbols that the modulator shows, uint8 [pages, ny, nx]; drawn if left out.
        """
        rng = np.random.default_rng([seed, 2])
        drawn = rng.integers(0, levels, size=(pages, *self.design.page_shape), dtype=np.uint8)
        symbols = drawn if symbols is None else symbols
        drifts = walk(self.parameters, pages, rng, jumps_px)
        with h5py.File(str(path), "w") as file:
            file.attrs["format"] = "lightpage-recording"
            file.attrs["version"] = 1
            file.attrs["camera_bit_depth"] = self.parameters.bit_depth
            file.attrs["levels"] = levels
            if with_symbols:
                file["symbols"] = symbols
            if pilots is not None:
                file["pilots"] = pilots
            names = ("in_phase", "quadrature")
            dtype = np.uint8 if self.parameters.bit_depth == 8 else np.uint16
            for name, frame in zip(names, self.frames([], rng, exposures=REFERENCE_EXPOSURES), strict=True):
                file[f"reference_{name}"] = frame
                file.create_dataset(
                    name, (pages, *self.design.frame_shape), dtype, chunks=(1, *self.design.frame_shape)
                )
            for page in range(pages):
                images = self.images(symbols[page], levels, rng)
                for name, frame in zip(names, self.frames(images, rng, drifts[page]), strict=True):
                    file[name][page] = frame
        return symbols


def plane_coordinates(design: Design, camera: Camera, drift: PageDrift) -> tuple[FloatArray, FloatArray]:
    """(x, y) in the camera plane, mm, that each pixel of a frame looks at."""
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in design.frame_shape)
    x = columns[None, :] - camera.shift_px[0] - drift.shift_px[0]
    y = rows[:, None] - camera.shift_px[1] - drift.shift_px[1]
    half_height, half_width = (n * SLM_PITCH / CAMERA_PITCH / 2 for n in design.page_px)
    growth = camera.keystone[0] * columns[None, :] / half_width + camera.keystone[1] * rows[:, None] / half_height
    scale = CAMERA_PITCH / (1 + camera.scale) * (1 + growth)
    return rotate(x * scale, y * scale, -np.deg2rad(camera.rotation_deg))


def out_of_focus(points: tuple[FloatArray, FloatArray], focal_length: float, distance: float) -> ComplexArray:
    """Return the factors by which a defocus of `distance` mm changes the field at points (x, y) mm of a facet."""
    sine2 = (points[0] ** 2 + points[1] ** 2) / focal_length**2
    return np.asarray(np.exp(1j * WAVENUMBER * distance * (np.sqrt(1 - sine2) - 1)))


def spreading(end: Facet, growth: float) -> ComplexArray:
    """Return the factors of a wave in glass that spreads as walls do whose scale grows by `growth` a millimetre."""
    x, y = end.points
    return np.asarray(np.exp(0.5j * GLASS_INDEX * WAVENUMBER * growth / end.scale * (x**2 + y**2)))


def hot_pixels(p: Parameters, camera: int, pixels: int) -> NDArray[np.integer]:
    """Return the numbers of a camera's hot pixels."""
    rng = np.random.default_rng([p.blemish_seed, camera])
    return rng.choice(pixels, round(p.hot_pixels * pixels), replace=False)


def behind_dust(p: Parameters, camera: int, shape: tuple[int, int]) -> FloatArray:
    """Return the share of the light that a camera's dust lets through: 0.3 to 0.7 in discs of 1.5 to 6 pixels."""
    rng = np.random.default_rng([p.blemish_seed, camera, 1])
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    passed = np.ones(shape)
    for _ in range(p.dust):
        row, column = rng.uniform(0, shape[0]), rng.uniform(0, shape[1])
        radius, transmission = rng.uniform(1.5, 6.0), rng.uniform(0.3, 0.7)
        covered = np.clip(radius + 0.5 - np.hypot(rows - row, columns - column), 0, 1)
        passed *= 1 - (1 - transmission) * covered
    return passed


def walk(
    p: Parameters, pages: int, rng: np.random.Generator, jumps_px: Mapping[int, tuple[float, float]] | None = None
) -> list[PageDrift]:
    """Piston and shift of each page: random walks from a random piston.

    Args:
        p: parameters of the device.
        pages: how many.
        rng: generator of the steps.
        jumps_px: (x, y) by which the image jumps before a page, beside its walk; before page 0, while nobody read.
    """
    pistons = rng.uniform(-np.pi, np.pi) + np.cumsum(p.piston_drift_rad * rng.standard_normal(pages))
    steps = p.shift_drift_px * rng.standard_normal((pages, 2))
    for page, jump in (jumps_px or {}).items():
        steps[page] += jump
    shifts = np.cumsum(steps, axis=0)
    return [PageDrift(float(a), (float(s[0]), float(s[1]))) for a, s in zip(pistons, shifts, strict=True)]


@dataclass(frozen=True)
class Image:
    """The field in the camera plane on an even grid [y, x], first sample at (y0, x0), mm."""

    field: ComplexArray
    y0: float
    x0: float

    @cached_property
    def _splines(self) -> tuple[FloatArray, FloatArray]:
        real, imaginary = (
            spline_filter(part, order=3, output=np.float32, mode="mirror")
            for part in (self.field.real, self.field.imag)
        )
        return real, imaginary

    def at(self, x: FloatArray, y: FloatArray) -> ComplexArray:
        """The field at points (x, y), mm, by cubic splines; dark outside the grid."""
        where = np.stack([(y - self.y0) / IMAGE_PITCH, (x - self.x0) / IMAGE_PITCH])
        real, imaginary = (
            map_coordinates(part, where, order=3, prefilter=False, mode="constant", output=np.float32)
            for part in self._splines
        )
        return np.asarray(real + 1j * imaginary)


def rotate(x: FloatArray | float, y: FloatArray | float, angle: float) -> tuple[FloatArray, FloatArray]:
    """Turn (x, y) by `angle` radians from the x axis towards the y axis."""
    return (
        np.asarray(x * np.cos(angle) - y * np.sin(angle)),
        np.asarray(x * np.sin(angle) + y * np.cos(angle)),
    )


def rotated(page: ComplexArray, angle: float) -> ComplexArray:
    """Turn a sampled field about its centre from x towards y by three shears, exact for band-limited lines."""
    if angle == 0:
        return page.copy()
    for axis, slope in ((1, -np.tan(angle / 2)), (0, np.sin(angle)), (1, -np.tan(angle / 2))):
        along, across = page.shape[axis], page.shape[1 - axis]
        shift = slope * (np.arange(across) - (across - 1) / 2)
        ramp = np.exp(-2j * np.pi * np.outer(shift, scipy.fft.fftfreq(along)))
        lines = scipy.fft.fft(page, axis=axis) * (ramp if axis == 1 else ramp.T)
        page = scipy.fft.ifft(lines, axis=axis)
    return page


def fourier_sum(
    field: ComplexArray, source: tuple[float, float], target: tuple[float, float, int], wavenumber: float, axis: int
) -> ComplexArray:
    """Sum over one axis of field(a) exp(i wavenumber a b); a: (start, step), b: (start, step, count)."""
    (a0, da), (b0, db, count) = source, target
    n = field.shape[axis]
    transform = CZT(n, count, w=np.exp(1j * wavenumber * da * db), a=np.exp(-1j * wavenumber * da * b0))
    b = b0 + np.arange(count) * db
    carrier = np.exp(1j * wavenumber * a0 * b)
    return np.asarray(transform(field, axis=axis) * (carrier if axis == field.ndim - 1 else carrier[:, None]))


def odd_extension(facet: ComplexArray) -> ComplexArray:
    """Mirror a facet, whose first row and column lie on walls, to the periodic cell twice as wide, odd in both axes."""
    for axis in (0, 1):
        first = [slice(None)] * 2
        first[axis] = slice(0, 1)
        facet = facet.copy()
        facet[tuple(first)] = 0
        rest = [slice(None)] * 2
        rest[axis] = slice(None, 0, -1)
        facet = np.concatenate([facet, np.zeros_like(facet[tuple(first)]), -facet[tuple(rest)]], axis=axis)
    return facet


def unfolded(facet: ComplexArray, reach: tuple[float, float]) -> ComplexArray:
    """Put a facet into the first cell of a periodic grid in which light of this reach, in cells, never overlaps."""
    light = facet.copy()
    light[0], light[:, 0] = 0, 0  # walls
    return np.pad(light, [(0, (2 * int(np.ceil(r)) - 1) * n) for n, r in zip(facet.shape, reach, strict=True)])


def folded(light: ComplexArray, shape: tuple[int, int], polarisation: float) -> ComplexArray:
    """Fold unfolded cells onto the first; each fold is a reflection, with a change of sign and its phase."""
    for axis, phase in ((0, -polarisation), (1, polarisation)):
        n, total = shape[axis], light.shape[axis]
        cells = total // n
        inside = np.arange(n)
        # Cells of the second half are those of light that goes the other way.
        light = sum(
            (-np.exp(1j * phase)) ** min(cell, cells - cell)
            * np.take(light, cell * n + inside if cell % 2 == 0 else ((cell + 1) * n - inside) % total, axis=axis)
            for cell in range(cells)
        )
    return light


def propagate_pipe(
    facet: ComplexArray,
    widths: tuple[float, float],
    length: float,
    angle: float,
    steps: int,
    polarisation: float = 0.0,
) -> ComplexArray:
    """Propagate a facet field [y', x] through a rhombic pipe whose walls reflect with a change of sign.

    In the oblique coordinates (x, y') the transverse Laplacian is d_x^2 + d_y'^2 + 2 sin(angle) d_x d_y'. The first two
    terms are exact in the extension's Fourier space. The last changes its sign from cell to cell; it goes between half
    steps of the others, as an exponential series of P (s d_x d_y') P, s the sign of the cell and P = kz^(-1/2), which
    is the first-order term of the square root and keeps the power. Phases are relative to the glass wave number.

    Walls that change the phase too, by `polarisation` at x walls and its negative at oblique ones, are unfolded: light
    starts in one cell, and its cell at the end tells how often either pair has reflected it. That is exact where the
    phase does not depend on the angle of incidence, but for light that the pipe's edges scatter.
    """
    rows, columns = facet.shape
    k_glass = GLASS_INDEX * WAVENUMBER
    bands = [np.pi / width * n for n, width in zip(facet.shape, widths, strict=True)]
    if polarisation:
        reach_y, reach_x = (length * k / k_glass / width for k, width in zip(bands, widths, strict=True))
        extended = unfolded(facet, (reach_y, reach_x))
    else:
        extended = odd_extension(facet)

    def at_exit(spectrum: ComplexArray) -> ComplexArray:
        light = scipy.fft.ifft2(spectrum, workers=2)
        return np.asarray(folded(light, (rows, columns), polarisation) if polarisation else light[:rows, :columns])

    ky, kx = np.meshgrid(
        *(k * scipy.fft.fftfreq(n) * 2 for n, k in zip(extended.shape, bands, strict=True)), indexing="ij"
    )
    kz = np.sqrt(k_glass**2 - kx**2 - ky**2)
    # kz - nk without cancellation, so that single precision serves afterwards.
    relative = -(kx**2 + ky**2) / (kz + k_glass)
    spectrum = scipy.fft.fft2(extended, workers=2)
    if angle == 0:
        return at_exit(spectrum * np.exp(1j * relative * length))
    dz = length / steps
    half = np.exp(0.5j * relative * dz).astype(np.complex64)
    whole = np.exp(1j * relative * dz).astype(np.complex64)
    root = (kz / k_glass) ** -0.5
    cross = (-np.sin(angle) * dz / k_glass * kx * ky * root).astype(np.float32)
    if polarisation:  # the highest frequency of an even count has no sign; an odd extension has no such light
        cross[extended.shape[0] // 2], cross[:, extended.shape[1] // 2] = 0, 0
    signs = [
        np.sign(np.where(i == 0, 0, np.where(i == n, 0, n - i)))
        for i, n in ((np.arange(total) % (2 * n), n) for total, n in zip(extended.shape, facet.shape, strict=True))
    ]
    cells = np.outer(*signs).astype(np.float32)
    root = root.astype(np.float32)
    spectrum = spectrum.astype(np.complex64) * half
    for step in range(steps):
        term = spectrum
        for order in range(1, TAYLOR_TERMS + 1):
            kicked = scipy.fft.ifft2(term * cross, workers=2, overwrite_x=True)
            kicked *= cells
            term = scipy.fft.fft2(kicked, workers=2, overwrite_x=True)
            term *= root * np.complex64(1j / order)
            spectrum = spectrum + term
        spectrum *= whole if step < steps - 1 else half
    return at_exit(spectrum)
