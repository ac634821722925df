"""The noise-free optics of one device in its true state, and that state as a twin's parameters."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.parameters import NAMES, as_dict, as_vector
from lightpage.calibration.waves.wave_model import defocus, fitted_geometry
from lightpage.device.profile import Profile
from lightpage.device.state import CameraPose, Device, SlmDefects
from lightpage.page.levels import MAX_LEVELS
from lightpage.page.modulation import NOMINAL, Modulation, basis
from lightpage.page.symbols import symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.cameras import CameraView
from lightpage.waves.channel import WaveChannel
from lightpage.waves.geometry import WaveGeometry, cells_for
from lightpage.waves.grid import splitting_steps

Real = NDArray[np.floating]
Complex = NDArray[np.complexfloating]

_CLIPPING_AMPLITUDE = 2.4
"""Signal amplitude over its root mean square that, in phase with the reference, just fills the well: about one sample
in twenty thousand clips."""

_GRID_MARGIN = 1.04
"""Computed camera plane over the sensor, so that rotated and shifted pixels still look inside."""

_RIPPLE = 1
"""The random stream of the reference's ripple; a simulator draws others from a seed of its own."""


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

    def exit_field(self, page_phase: Real, noise_rad: Real | float = 0.0) -> Complex:
        """Nominal phase written on the SLM [ny, nx], radians, to the field on the exit facet.

        Args:
            page_phase: of the levels, as their numbers say.
            noise_rad: phase that is added to what the SLM makes of them.
        """
        shown = modulated(self.device.slm, page_phase) * np.exp(1j * np.asarray(noise_rad))
        return self.signal_scale * self.channel.exit_field(self.slm_factor * shown)

    def camera_field(self, exit_field: Complex, camera: CameraPose | None = None) -> Complex:
        """Field on the exit facet to the computed camera plane, of one camera, or of where both stand on average."""
        return self.channel.camera_field(exit_field, 0.0 if camera is None else self._beyond_mean(camera))

    def _beyond_mean(self, camera: CameraPose) -> float:
        """Defocus of a camera beyond that of both on average, rad/m^2 of the facet."""
        mean = (self.device.in_phase_camera.axial_rad + self.device.quadrature_camera.axial_rad) / 2
        return float(defocus(camera.axial_rad - mean, self.geometry.pipe_width_m))

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
        edges = self.profile.page_width_m / 2, self.profile.page_height_m / 2
        return CameraView(self.profile.camera, moved, distortion, self.profile.corner_m, edges).positions_m()

    @property
    def electrons_per_unit(self) -> float:
        """Electrons per unit intensity (mean signal power is one)."""
        brightest = (self.device.reference.amplitude_ratio + _CLIPPING_AMPLITUDE) ** 2
        sensor = self.device.sensor
        full = sensor.full_well_e * sensor.exposure_relative
        return full / brightest / max(1.0, self.device.homodyne.quadrature_gain)


def modulated(slm: SlmDefects, phase: Real) -> Complex:
    """Light that a modulator makes of levels of so much nominal phase, radians; of unit amplitude on average nearly."""
    turn = phase + slm.stroke_relative_error * phase
    turn = turn + slm.level_sine_rad * np.sin(phase) + slm.level_cosine_rad * np.cos(phase)
    turn = turn + slm.level_sine_twice_rad * np.sin(2 * phase)
    amplitude = 1 + slm.level_amplitude_relative * np.cos(phase)
    return np.asarray(amplitude * np.exp(1j * turn) + slm.unmodulated_relative * np.exp(1j * slm.unmodulated_phase_rad))


def perfectly_calibrated(profile: Profile, device: Device, references: FramePair) -> CalibratedDevice:
    """A device as a calibration without any error would find it."""
    parameters, modulation = true_parameters(profile, device), true_modulation(device.slm)
    return CalibratedDevice(profile, parameters, device.homodyne.turn_rad, references, modulation)


def true_modulation(slm: SlmDefects) -> Modulation:
    """The truth as a calibration without any error would tell it: what its few coefficients can."""
    phases = symbol_phases(np.arange(MAX_LEVELS), MAX_LEVELS)
    shown, (stroke, *series) = modulated(slm, phases), basis(phases)
    if np.allclose(shown, np.exp(1j * phases), rtol=0, atol=1e-12):
        return NOMINAL
    even = np.ones(len(phases))
    off = np.unwrap(np.angle(shown * np.exp(-1j * phases)))
    phase = np.linalg.lstsq(np.stack([stroke, *series, even], axis=1), off, rcond=None)[0]
    amplitude = np.linalg.lstsq(np.stack([*series, even], axis=1), np.log(np.abs(shown)), rcond=None)[0]
    return Modulation((*phase[:-1].tolist(), *amplitude[:-1].tolist()))


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
        "modulator_axial_rad": g.modulator_axial_rad,
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
        scale, rotation = 1 + pose.scale_relative_error, np.deg2rad(pose.rotation_deg)
        values |= {
            f"{camera}_shift_x_px": pose.shift_x_px,
            f"{camera}_shift_y_px": pose.shift_y_px,
            f"{camera}_scale_x_relative": scale * np.cos(rotation) - 1,
            f"{camera}_scale_y_relative": scale * np.cos(rotation) - 1,
            f"{camera}_turn_xy_slope": -scale * np.sin(rotation),
            f"{camera}_turn_yx_slope": scale * np.sin(rotation),
            f"{camera}_axial_rad": pose.axial_rad,
            f"{camera}_keystone_x_relative": pose.keystone_x_relative,
            f"{camera}_keystone_y_relative": pose.keystone_y_relative,
        }
    return as_vector(values)
