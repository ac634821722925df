"""The simulated device: pages in, frame pairs out, with every imperfection of its state and drift from page to page."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.parameters import NAMES, as_dict, as_vector
from lightpage.calibration.wave_model import fitted_geometry
from lightpage.device.profile import Profile
from lightpage.device.state import CameraPose, Device
from lightpage.page.symbols import check_levels, check_symbols, symbol_phases
from lightpage.recording.layout import frame_type
from lightpage.recording.reader import FramePair
from lightpage.simulator.cameras import (
    CameraView,
    expose,
    in_phase_intensity,
    quadrature_intensity,
    resample,
    to_counts,
)
from lightpage.waves.channel import WaveChannel
from lightpage.waves.geometry import WaveGeometry, cells_for
from lightpage.waves.grid import check_camera, splitting_steps

Real = NDArray[np.floating]
Complex = NDArray[np.complexfloating]

LIGHT = 1
"""Raised when the same device and pages give other frames: what an earlier version began is then not gone on with."""
_CLIPPING_AMPLITUDE = 2.4
"""Signal amplitude over its root mean square that, in phase with the reference, just fills the well: about one sample
in twenty thousand clips."""
_GRID_MARGIN = 1.04
"""Computed camera plane over the sensor, so that rotated and shifted pixels still look inside."""
_WALK, _RIPPLE, _NOISE = 0, 1, 2
"""Independent random streams drawn from one seed; the last has one for each page."""


@dataclass(frozen=True)
class SimulatedPage:
    """One page as recorded, with what only the simulator knows.

    Attributes:
        pair: the frames.
        exit_field: signal on the exit facet's grid, complex64 [cells_y - 1, cells_x - 1], before piston.
        piston: phase of the signal against the reference, radians.
        shift_px: drift of the image (x, y), camera pixels.
    """

    pair: FramePair
    exit_field: Complex
    piston: float
    shift_px: tuple[float, float]


class TrueOptics:
    """The noise-free optics of one device: what a simulator, or an oracle that may know the truth, computes with."""

    def __init__(self, profile: Profile, device: Device, steps: int | None = None) -> None:
        self.profile = profile
        self.device = device
        self._steps = splitting_steps(profile) if steps is None else steps

    @cached_property
    def geometry(self) -> WaveGeometry:
        """The true geometry."""
        return fitted_geometry(self.profile, as_dict(true_parameters(self.profile, self.device)))

    @cached_property
    def page_axes_m(self) -> tuple[Real, Real]:
        """Centres of the SLM pixels (x, y) against the optical axis."""
        page, pitch = self.profile.page, self.profile.slm.pitch_m
        columns, rows = page.columns * page.symbol_size_px, page.rows * page.symbol_size_px
        x = (np.arange(columns) - (columns - 1) / 2 + self.device.geometry.page_shift_x_px) * pitch
        y = (np.arange(rows) - (rows - 1) / 2 + self.device.geometry.page_shift_y_px) * pitch
        return x, y

    @cached_property
    def camera_axes_m(self) -> tuple[Real, Real]:
        """Uniform axes (x, y) of the computed camera plane, at the cameras' pitch."""
        camera = self.profile.camera

        def axis(pixels: int) -> Real:
            count = int(pixels * _GRID_MARGIN) + 48
            return np.asarray((np.arange(count) - (count - 1) / 2) * camera.pitch_m)

        return axis(camera.columns_px), axis(camera.rows_px)

    @cached_property
    def channel(self) -> WaveChannel:
        """SLM to camera plane."""
        page_x, page_y = self.page_axes_m
        camera_x, camera_y = self.camera_axes_m
        camera, pitch = self.profile.camera, self.profile.slm.pitch_m
        sensor = camera.columns_px * camera.pitch_m / 2, camera.rows_px * camera.pitch_m / 2
        return WaveChannel(
            self.geometry,
            page_x,
            page_y,
            camera_x,
            camera_y,
            cells=cells_for(self.geometry, page_x, page_y, *sensor),
            steps=self._steps,
            envelope_m=pitch,
            blur_m=self.device.slm.blur_px * pitch,
        )

    @cached_property
    def slm_factor(self) -> Complex:
        """Illumination and the launch side's aberrations on the SLM's pixels [ny, nx], complex."""
        page_x, page_y = self.page_axes_m
        x = (page_x - page_x.mean())[None, :] / self.profile.corner_m
        y = (page_y - page_y.mean())[:, None] / self.profile.corner_m
        radius2 = x**2 + y**2
        aberration = self.device.aberration
        phase = (
            aberration.defocus_rad * radius2
            + aberration.astigmatism_rad * (x**2 - y**2)
            + aberration.coma_rad * radius2 * x
        )
        amplitude = 1 - self.device.slm.falloff_relative * radius2
        return np.asarray(amplitude * np.exp(1j * phase))

    @cached_property
    def signal_scale(self) -> float:
        """Factor that makes the signal's mean power over the page's image one."""
        size = self.profile.page.symbol_size_px
        symbols = np.exp(2j * np.pi * np.random.default_rng(0).random(self.profile.page_shape))
        field = self.channel.exit_field(self.slm_factor * np.kron(symbols, np.ones((size, size))))
        # the de-launch is unitary on samples of the camera's pitch, and the page is imaged at its own size
        samples = self.profile.page_width_m * self.profile.page_height_m / self.profile.camera.pitch_m**2
        return float(np.sqrt(samples) / np.linalg.norm(field))

    def exit_field(self, page_phase: Real) -> Complex:
        """Phase written on the SLM [ny, nx], radians, to the field on the exit facet."""
        return self.signal_scale * self.channel.exit_field(self.slm_factor * np.exp(1j * page_phase))

    def camera_field(self, exit_field: Complex) -> Complex:
        """Field on the exit facet to the computed camera plane."""
        return self.channel.camera_field(exit_field)

    @cached_property
    def reference_in_place(self) -> Complex:
        """Reference beam on the computed camera plane."""
        return self.reference()

    def reference(self, offset_m: tuple[float, float] = (0.0, 0.0)) -> Complex:
        """Reference beam on the computed camera plane, or `offset_m` (x, y) from there."""
        knobs = self.device.reference
        axis_x, axis_y = self.camera_axes_m
        half_width, half_height = self.profile.page_width_m / 2, self.profile.page_height_m / 2
        x, y = axis_x[None, :] + offset_m[0], axis_y[:, None] + offset_m[1]
        phase = (
            knobs.tilt_x_rad * x / half_width
            + knobs.tilt_y_rad * y / half_height
            + knobs.curvature_rad * (x**2 + y**2) / self.profile.corner_m**2
        )
        rng = np.random.default_rng([knobs.ripple_seed, _RIPPLE])
        ripple = np.zeros((len(axis_y), len(axis_x)))
        for _ in range(6):
            turns_x, turns_y = rng.uniform(-3, 3, 2)
            ripple += np.cos(2 * np.pi * (turns_x * x / half_width + turns_y * y / half_height + rng.random()))
        ripple *= knobs.ripple_relative / np.sqrt(3)
        return np.asarray(knobs.amplitude_ratio * (1 + ripple) * np.exp(1j * phase), dtype=np.complex64)

    def view(self, pose: CameraPose, shift_px: tuple[float, float] = (0.0, 0.0)) -> tuple[Real, Real]:
        """Camera-plane points (x, y) of one camera's pixels, with the drift's shift added to its pose."""
        moved = pose.model_copy(
            update={"shift_x_px": pose.shift_x_px + shift_px[0], "shift_y_px": pose.shift_y_px + shift_px[1]}
        )
        distortion = self.device.aberration.distortion_relative
        return CameraView(self.profile.camera, moved, distortion, self.profile.corner_m).positions_m()

    @property
    def electrons_per_unit(self) -> float:
        """Electrons per unit intensity (mean signal power is one)."""
        brightest = (self.device.reference.amplitude_ratio + _CLIPPING_AMPLITUDE) ** 2
        sensor = self.device.sensor
        full = sensor.full_well_e * sensor.exposure_relative
        return full / brightest / max(1.0, self.device.homodyne.quadrature_gain)


class Simulator:
    """A device with a memory: its piston and image shift walk from page to page, and it may be knocked.

    Args:
        profile: nominal device.
        device: true state.
        levels: levels M of the symbols it will be given.
        seed: of noise and drift from page to page; the same seed and calls give the same frames. The ripple of the
            reference belongs to the device (`reference.ripple_seed`).
        steps: splitting steps of a sheared pipe; `splitting_steps` if left out.
        reference_stays: whether the image moves over the reference, as when page or pipe move, and not with it, as when
            the cameras do.

    Raises:
        PageError: a level count outside 2..256.
        ProfileError: the profile's camera is too coarse or too small for its page.
    """

    def __init__(
        self,
        profile: Profile,
        device: Device,
        levels: int = 256,
        seed: int = 0,
        steps: int | None = None,
        *,
        reference_stays: bool = False,
    ) -> None:
        check_levels(levels)
        check_camera(profile)
        self.optics = TrueOptics(profile, device, steps)
        self.levels = levels
        self.seed = seed
        self.reference_stays = reference_stays
        self._walk = np.random.default_rng([seed, _WALK])
        self._piston = float(self._walk.uniform(-np.pi, np.pi))
        self._shift = np.zeros(2)
        self._page = 0

    @property
    def profile(self) -> Profile:
        """The nominal device."""
        return self.optics.profile

    @property
    def device(self) -> Device:
        """The true state."""
        return self.optics.device

    def set_device(self, device: Device) -> None:
        """Move the device to another true state (slow drift); piston and shift go on from where they are."""
        self.optics = TrueOptics(self.profile, device, self.optics.channel.steps)

    def knock(self, shift_px: tuple[float, float]) -> None:
        """Move the image at once by (x, y) camera pixels, on both cameras; it walks on from there."""
        self._shift = self._shift + np.asarray(shift_px)

    def skip(self, pages: int) -> None:
        """Let `pages` pages pass unseen: what follows is what would have followed had they been simulated."""
        for _ in range(pages):
            self._drift()

    def page(self, symbols: NDArray[np.uint8]) -> FramePair:
        """Write a page of symbols [ny, nx] and record its frame pair."""
        return self.simulate(symbols).pair

    def simulate(self, symbols: NDArray[np.uint8]) -> SimulatedPage:
        """Write a page of symbols [ny, nx]; the frames together with the truth.

        Raises:
            PageError: symbols of the wrong shape, type or range.
        """
        check_symbols(symbols, self.profile.page_shape, self.levels, "symbols to simulate")
        device, rng = self.device, np.random.default_rng([self.seed, _NOISE, self._page])
        self._drift()
        shift = (float(self._shift[0]), float(self._shift[1]))
        size = self.profile.page.symbol_size_px
        phase = np.kron(symbol_phases(symbols, self.levels), np.ones((size, size)))
        phase = phase + device.slm.phase_noise_rad * rng.standard_normal(phase.shape)
        exit_field = self.optics.exit_field(phase)
        field = self.optics.camera_field(exit_field) * np.complex64(np.exp(1j * self._piston))
        frames = self._frames(field, shift, rng)
        return SimulatedPage(frames, exit_field, self._piston, shift)

    def references(self) -> FramePair:
        """Reference-only frames, the mean of so many exposures that only quantisation is left."""
        return self._frames(np.zeros_like(self.optics.reference_in_place), (0.0, 0.0), None)

    def _drift(self) -> None:
        """Walk on by one page; its noise has a stream of its own, so that pages can pass without being computed."""
        drift = self.device.drift
        self._piston += drift.piston_rad * self._walk.standard_normal()
        self._shift = self._shift + drift.shift_px * self._walk.standard_normal(2)
        self._page += 1

    def _frames(self, field: Complex, shift: tuple[float, float], noise: np.random.Generator | None) -> FramePair:
        device = self.device
        homodyne = device.homodyne
        error, sign = np.deg2rad(homodyne.quadrature_error_deg), homodyne.quadrature_sign
        frames = []
        for pose, quadrature in ((device.in_phase_camera, False), (device.quadrature_camera, True)):
            reference = self._reference_behind(pose, shift)
            if quadrature:
                intensity = homodyne.quadrature_gain * quadrature_intensity(field, reference, error, sign)
            else:
                intensity = in_phase_intensity(field, reference)
            seen = resample(intensity, *self.optics.camera_axes_m, *self.optics.view(pose, shift))
            if noise is None:
                counts = to_counts(seen * self.optics.electrons_per_unit, device.sensor)
            else:
                counts = expose(seen, self.optics.electrons_per_unit, device.sensor, noise)
            frames.append(counts.astype(frame_type(device.sensor.bit_depth)))
        return FramePair(*frames)

    def _reference_behind(self, pose: CameraPose, shift: tuple[float, float]) -> Complex:
        """The reference where a camera sees it behind an image that has moved by `shift`, on the image's plane."""
        if not self.reference_stays or shift == (0.0, 0.0):
            return self.optics.reference_in_place
        middle = tuple(count // 2 for count in self.profile.frame_shape)
        still, moved = ([float(axis[middle]) for axis in self.optics.view(pose, by)] for by in ((0.0, 0.0), shift))
        return self.optics.reference((still[0] - moved[0], still[1] - moved[1]))


def true_parameters(profile: Profile, device: Device) -> NDArray[np.float64]:
    """The truth as a ray twin's parameter vector [P] (see `lightpage.calibration.parameters`)."""
    g, pitch = device.geometry, profile.slm.pitch_m
    values = dict.fromkeys(NAMES, 0.0)
    values |= {
        "pipe_angle_rad": np.deg2rad(g.pipe_angle_deg - profile.pipe.angle_deg),
        "focal_length_relative": g.focal_length_relative_error,
        "pipe_length_relative": g.pipe_length_relative_error,
        "pipe_width_relative": g.pipe_width_relative_error,
        "page_centre_x_m": g.page_shift_x_px * pitch,
        "page_centre_y_m": g.page_shift_y_px * pitch,
        "pipe_roll_rad": np.deg2rad(g.pipe_roll_deg),
        "launch_defocus_rad": device.aberration.defocus_rad,
        "launch_astigmatism_0_rad": device.aberration.astigmatism_rad,
        "launch_coma_x_rad": device.aberration.coma_rad,
        "lens_path_relative": device.aberration.lens_path_relative_error,
        # the field is measured against the reference, so the reference's phase comes off
        "camera_tilt_x_rad": -device.reference.tilt_x_rad,
        "camera_tilt_y_rad": -device.reference.tilt_y_rad,
        "camera_curvature_rad": -device.reference.curvature_rad,
        "distortion_relative": device.aberration.distortion_relative,
    }
    for camera, pose in (("in_phase", device.in_phase_camera), ("quadrature", device.quadrature_camera)):
        scale, turn = 1 + pose.scale_relative_error, np.deg2rad(pose.rotation_deg)
        values |= {
            f"{camera}_shift_x_px": pose.shift_x_px,
            f"{camera}_shift_y_px": pose.shift_y_px,
            f"{camera}_scale_x_relative": scale * np.cos(turn) - 1,
            f"{camera}_scale_y_relative": scale * np.cos(turn) - 1,
            f"{camera}_turn_xy_slope": -scale * np.sin(turn),
            f"{camera}_turn_yx_slope": scale * np.sin(turn),
        }
    return as_vector(values)
