"""The noise-free optics of one device in its true state, and that state as a twin's parameters."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

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
from lightpage.simulator.cameras import Blemishes, CameraView
from lightpage.simulator.engine import NUMPY, Engine
from lightpage.simulator.modulator import dead_pixels, modulated, with_crosstalk
from lightpage.waves.channel import WaveChannel
from lightpage.waves.geometry import WaveGeometry, cells_for, taper_defocus
from lightpage.waves.grid import splitting_steps

Real = NDArray[np.floating]
Complex = NDArray[np.complexfloating]

_CLIPPING_AMPLITUDE = 2.4
"""Signal amplitude over its root mean square that, in phase with the reference, just fills the well: about one sample
in twenty thousand clips."""

_GRID_MARGIN = 1.04
"""Computed camera plane over the sensor, so that rotated and shifted pixels still look inside."""

_CAMERA_TILTS = "cameras_axial_x_rad", "cameras_axial_y_rad"
"""Parameters of both cameras' tilt on average."""
_TILTS_APART = "cameras_apart_x_rad", "cameras_apart_y_rad"
"""Parameters of what the cameras' tilts differ in."""

_RIPPLE = 1
"""The random stream of the reference's ripple; a simulator draws others from a seed of its own."""

_STEP = 1e-4
"""Step of a derivative, radians; exact to 1e-8 in double precision."""


class Place(NamedTuple):
    """Place of a camera against its focal plane, by the numbers of its pose."""

    axial_rad: float
    tilt_x_rad: float
    tilt_y_rad: float

    @classmethod
    def of(cls, pose: CameraPose) -> Place:
        """The place of a camera."""
        return cls(pose.axial_rad, pose.tilt_x_rad, pose.tilt_y_rad)

    @property
    def tilt_rad(self) -> tuple[float, float]:
        """Tilts about both axes, radians."""
        return self.tilt_x_rad, self.tilt_y_rad


class TrueOptics:
    """The noise-free optics of one device: what a simulator, or an oracle that may know the truth, computes with.

    Args:
        profile, device: nominal and true.
        steps: splitting steps of a sheared pipe; `splitting_steps` if left out.
        engine: what computes; phases and light that are given and returned are its arrays.
    """

    def __init__(self, profile: Profile, device: Device, steps: int | None = None, engine: Engine = NUMPY) -> None:
        self.profile = profile
        self.device = device
        self.engine = engine
        self._steps = splitting_steps(profile) if steps is None else steps
        self._tilted: dict[tuple[float, float], WaveChannel] = {}

    @cached_property
    def geometry(self) -> WaveGeometry:
        """The true geometry; its cameras stand where they do on average."""
        return true_geometry(self.profile, self.device, self._mean_place.tilt_rad)

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
            return np.asarray((np.arange(count) - (count - 1) / 2) * self.profile.image_pixel_m)

        return axis(camera.columns_px), axis(camera.rows_px)

    @cached_property
    def channel(self) -> WaveChannel:
        """SLM to camera plane."""
        page_x, page_y = self.page_axes_m
        camera_x, camera_y = self.camera_axes_m
        camera, pitch = self.profile.camera, self.profile.slm.pitch_m
        pixel = self.profile.image_pixel_m
        sensor = camera.columns_px * pixel / 2, camera.rows_px * pixel / 2
        return WaveChannel(
            self.geometry,
            page_x,
            page_y,
            camera_x,
            camera_y,
            cells=cells_for(self.geometry, page_x, page_y, *sensor),
            steps=self._steps,
            envelope_m=pitch,
            blur_m2=(self.device.slm.blur_px * pitch) ** 2,
            arrays=self.engine,
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
        factor: Complex = self.engine.array(amplitude * np.exp(1j * phase))
        return factor

    @cached_property
    def signal_scale(self) -> float:
        """Factor that makes the signal's mean power over the page's image one."""
        size = self.profile.page.symbol_size_px
        symbols = np.exp(2j * np.pi * np.random.default_rng(0).random(self.profile.page_shape))
        field = self._through(self.engine.array(np.kron(symbols, np.ones((size, size)))))
        # the de-launch is unitary on samples of the camera's pitch, and the page is imaged at its own size
        samples = self.profile.page_width_m * self.profile.page_height_m / self.profile.image_pixel_m**2
        return float(np.sqrt(samples) / float(self.engine.xp.linalg.norm(field)))

    def exit_field(self, page_phase: Real, noise_rad: Real | float = 0.0, flicker_rad: float = 0.0) -> Complex:
        """Nominal phase written on the SLM [ny, nx], radians, to the field on the exit facet.

        Args:
            page_phase: nominal phases of the levels, as their numbers say.
            noise_rad: phase that is added to what the SLM makes of them.
            flicker_rad: phase that is added to one of 2 pi, and to others in proportion.
        """
        slm = self.device.slm
        if flicker_rad:
            stroke = slm.stroke_relative_error + flicker_rad / (2 * np.pi)
            slm = slm.model_copy(update={"stroke_relative_error": stroke})
        return self.signal_scale * self._through(self._shown(slm, page_phase, noise_rad))

    def exit_field_change(self, page_phase: Real, direction: Real) -> Complex:
        """Derivative of `exit_field` at phases [ny, nx] along a direction of them [ny, nx], per radian."""
        ahead, behind = (self._shown(self.device.slm, page_phase + step * direction) for step in (_STEP, -_STEP))
        return self.signal_scale * self._through((ahead - behind) / (2 * _STEP))

    def _shown(self, slm: SlmDefects, page_phase: Real, noise_rad: Real | float = 0.0) -> Complex:
        """Light that the SLM makes of nominal phases, [ny, nx]."""
        xp = self.engine.xp
        noise = np.exp(1j * noise_rad) if isinstance(noise_rad, float) else xp.exp(1j * noise_rad)
        shown: Complex = modulated(slm, with_crosstalk(page_phase, slm.crosstalk_relative, xp), xp) * noise
        if self._dead_pixels is not None:
            dead, light = self._dead_pixels
            shown[dead] = xp.asarray(light, dtype=shown.dtype)
        return shown

    @cached_property
    def _dead_pixels(self) -> tuple[NDArray[np.bool_], Complex] | None:
        if not self.device.slm.dead_pixel_share:
            return None
        page_x, page_y = self.page_axes_m
        dead, light = map(self.engine.array, dead_pixels(self.device.slm, (len(page_y), len(page_x))))
        return dead, light

    def _through(self, light: Complex) -> Complex:
        """Light on the SLM [ny, nx], illuminated evenly, to the exit facet, what the facets reflect included."""
        field, ghost = self.channel.exit_field(self.slm_factor * light), self.device.geometry.ghost_relative
        if ghost:
            back = self.channel.pipe.forward(field)
            field = field + ghost * self.channel.pipe.forward(back)
        return field

    @cached_property
    def blemishes(self) -> tuple[Blemishes, Blemishes]:
        """Hot pixels and dust of the in-phase and of the quadrature camera."""
        camera, sensor = self.profile.camera, self.device.sensor
        return Blemishes.of(camera, sensor, 0, self.engine), Blemishes.of(camera, sensor, 1, self.engine)

    def camera_field(self, exit_field: Complex, camera: CameraPose | None = None) -> Complex:
        """Field on the exit facet to the computed camera plane, of one camera, or of where both stand on average."""
        place = self._mean_place if camera is None else Place.of(camera)
        beyond = defocus(place.axial_rad - self._mean_place.axial_rad, self.geometry.pipe_width_m)
        return self._channel_to(place.tilt_rad).camera_field(exit_field, float(beyond))

    def _channel_to(self, tilt_rad: tuple[float, float]) -> WaveChannel:
        """The channel to a camera plane that is tilted like this."""
        if tilt_rad == self._mean_place.tilt_rad:
            return self.channel
        if tilt_rad not in self._tilted:
            geometry = true_geometry(self.profile, self.device, tilt_rad)
            self._tilted[tilt_rad] = replace(self.channel, geometry=geometry)
        return self._tilted[tilt_rad]

    @cached_property
    def _mean_place(self) -> Place:
        """The middle between the places of both cameras."""
        both = (Place.of(pose) for pose in (self.device.in_phase_camera, self.device.quadrature_camera))
        return Place(*((one + other) / 2 for one, other in zip(*both, strict=True)))

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
        beam = knobs.amplitude_ratio * (1 + ripple) * np.exp(1j * phase)
        taken: Complex = self.engine.array(beam.astype(np.complex64))
        return taken

    def view(self, pose: CameraPose, shift_px: tuple[float, float] = (0.0, 0.0)) -> tuple[Real, Real]:
        """Camera-plane points (x, y) of one camera's pixels, with the drift's shift added to its pose."""
        moved = pose.model_copy(
            update={"shift_x_px": pose.shift_x_px + shift_px[0], "shift_y_px": pose.shift_y_px + shift_px[1]}
        )
        distortion = self.device.aberration.distortion_relative
        edges = self.profile.page_width_m / 2, self.profile.page_height_m / 2
        camera = self.profile.camera.model_copy(update={"pitch_m": self.profile.image_pixel_m})
        return CameraView(camera, moved, distortion, self.profile.corner_m, edges).positions_m(self.engine)

    @property
    def electrons_per_unit(self) -> float:
        """Electrons per unit intensity (mean signal power is one)."""
        brightest = (self.device.reference.amplitude_ratio + _CLIPPING_AMPLITUDE) ** 2
        sensor = self.device.sensor
        full = sensor.full_well_e * sensor.exposure_relative
        return full / brightest / max(1.0, self.device.homodyne.quadrature_gain)


def perfectly_calibrated(profile: Profile, device: Device, references: FramePair) -> CalibratedDevice:
    """A device as a calibration without any error would find it."""
    parameters, modulation = true_parameters(profile, device), true_modulation(device.slm, profile)
    return CalibratedDevice(profile, parameters, device.homodyne.turn_rad, references, modulation)


def true_modulation(slm: SlmDefects, profile: Profile) -> Modulation:
    """The truth as a calibration without any error would tell it: what its few coefficients can."""
    phases = symbol_phases(np.arange(MAX_LEVELS), MAX_LEVELS)
    # Of a symbol's pixels, one in so many has a neighbour of the symbol beside.
    crosstalk = slm.crosstalk_relative / profile.page.symbol_size_px
    shown, (stroke, *series) = modulated(slm, phases - 4 * crosstalk * (phases - np.pi)), basis(phases)
    if np.allclose(shown, np.exp(1j * phases), rtol=0, atol=1e-12):
        return NOMINAL
    even = np.ones(len(phases))
    off = np.unwrap(np.angle(shown * np.exp(-1j * phases)))
    phase = np.linalg.lstsq(np.stack([stroke, *series, even], axis=1), off, rcond=None)[0]
    amplitude = np.linalg.lstsq(np.stack([*series, even], axis=1), np.log(np.abs(shown)), rcond=None)[0]
    return Modulation((*phase[:-1].tolist(), *amplitude[:-1].tolist(), crosstalk, crosstalk))


def true_geometry(profile: Profile, device: Device, camera_tilt_rad: tuple[float, float]) -> WaveGeometry:
    """The geometry with all that the twin's parameters lack, and with cameras in their mean place, tilted like this."""
    g, tilts = device.geometry, dict(zip(_CAMERA_TILTS, camera_tilt_rad, strict=True))
    return replace(
        fitted_geometry(profile, as_dict(true_parameters(profile, device)) | tilts),
        focal_length_m=profile.lens.focal_length_m * (1 + g.focal_length_relative_error),
        pipe_height_relative=g.pipe_height_relative_error,
        pipe_taper=g.pipe_taper_relative,
    )


def _like_taper(profile: Profile, device: Device) -> tuple[float, float, float]:
    """Express a taper by parameters that a twin has, to first order.

    Returns:
        Relative change of the focal length, and what is added to the axial places of modulator and cameras, radians.
        The cameras' scale is that over 1 + taper.
    """
    g, light = device.geometry, profile.light
    length = profile.pipe.length_m * (1 + g.pipe_length_relative_error)
    width = profile.pipe.width_m * (1 + g.pipe_width_relative_error)
    in_glass = profile.pipe.refractive_index * 2 * np.pi / light.wavelength_m
    bent = taper_defocus(in_glass, length, g.pipe_taper_relative)
    at_entrance, at_exit = (float(factor) * (width / 2) ** 2 for factor in bent)
    return (1 + g.pipe_taper_relative) ** 0.5 - 1, at_entrance, at_exit


def true_parameters(profile: Profile, device: Device) -> NDArray[np.float64]:
    """The truth as a ray twin's parameter vector [P] (see `lightpage.calibration.parameters`).

    A taper is told by what it does to other parameters. Walls of two distances and ghosts have none.
    """
    g, pitch = device.geometry, profile.slm.pitch_m
    longer, at_modulator, at_cameras = _like_taper(profile, device)
    values = dict.fromkeys(NAMES, 0.0)
    values |= {
        "pipe_angle_rad": np.deg2rad(g.pipe_angle_deg - profile.pipe.angle_deg),
        "focal_length_relative": g.focal_length_relative_error + (1 + g.focal_length_relative_error) * longer,
        "pipe_length_relative": g.pipe_length_relative_error,
        "pipe_width_relative": g.pipe_width_relative_error,
        "page_centre_x_m": g.page_shift_x_px * pitch,
        "page_centre_y_m": g.page_shift_y_px * pitch,
        "pipe_roll_rad": np.deg2rad(g.pipe_roll_deg),
        "modulator_axial_rad": g.modulator_axial_rad + at_modulator,
        "modulator_axial_x_rad": g.modulator_tilt_x_rad,
        "modulator_axial_y_rad": g.modulator_tilt_y_rad,
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
        scale = (1 + pose.scale_relative_error) / (1 + g.pipe_taper_relative)
        rotation = np.deg2rad(pose.rotation_deg)
        values |= {
            f"{camera}_shift_x_px": pose.shift_x_px,
            f"{camera}_shift_y_px": pose.shift_y_px,
            f"{camera}_scale_x_relative": scale * np.cos(rotation) - 1,
            f"{camera}_scale_y_relative": scale * np.cos(rotation) - 1,
            f"{camera}_turn_xy_slope": -scale * np.sin(rotation),
            f"{camera}_turn_yx_slope": scale * np.sin(rotation),
            f"{camera}_axial_rad": pose.axial_rad + at_cameras,
            f"{camera}_keystone_x_relative": pose.keystone_x_relative,
            f"{camera}_keystone_y_relative": pose.keystone_y_relative,
        }
    one, other = (
        np.array([pose.tilt_x_rad, pose.tilt_y_rad]) for pose in (device.in_phase_camera, device.quadrature_camera)
    )
    values |= zip(_CAMERA_TILTS, ((one + other) / 2).tolist(), strict=True)
    values |= zip(_TILTS_APART, ((one - other) / 2).tolist(), strict=True)
    return as_vector(values)
