"""Knobs of the simulated device that a builder of such devices can turn, with ranges up to where decoding breaks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device

_CAMERAS = ("in_phase_camera", "quadrature_camera")


@dataclass(frozen=True)
class Knob:
    """Knob: a deviation of a device that one number sets; all else stays as on the device that decoders are trained on.

    Attributes:
        name: name on the command line.
        title: deviation, in words.
        unit: unit of the number.
        values: values that are measured, ascending.
        settings: settings of the device's state by `TABLE.KEY`, each as a factor on the number.
        full_size: value of a unit on the full-size device, and the unit that this is told in; None where it is the
            same.
        logarithmic: whether values are ratios, not differences.
    """

    name: str
    title: str
    unit: str
    values: tuple[float, ...]
    settings: Mapping[str, float] = field(hash=False)
    full_size: tuple[float, str] | None = None
    logarithmic: bool = False

    def turned(self, device: Device, value: float) -> Device:
        """Return the device with this knob at a value."""
        values = {key: float(factor * value) for key, factor in self.settings.items()}
        return device.with_values({key: int(one) if one.is_integer() else one for key, one in values.items()})

    def at(self, device: Device) -> float:
        """Return the number that a device has, by the first of the settings."""
        key, factor = next(iter(self.settings.items()))
        table, _, name = key.partition(".")
        return float(getattr(getattr(device, table), name)) / factor


@dataclass(frozen=True)
class _FullSize:
    """Conversion of the knobs' numbers to millimetres and degrees of the full-size device."""

    profile: Profile

    @cached_property
    def axial(self) -> tuple[float, str]:
        """Distance from the focal plane of a radian of defocus at the middle of the facet's wall."""
        half = self.profile.pipe.width_m / 2
        return 1e3 * 2 * self._focal_m**2 / (self._wave_number * half**2), "mm"

    @cached_property
    def length(self) -> tuple[float, str]:
        """A relative error of the pipe's length."""
        return 1e3 * self.profile.pipe.length_m, "mm"

    @cached_property
    def width(self) -> tuple[float, str]:
        """A relative error of the pipe's width."""
        return 1e6 * self.profile.pipe.width_m, "um"

    @cached_property
    def focal(self) -> tuple[float, str]:
        """A relative error of the focal length."""
        return 1e3 * self._focal_m, "mm"

    @cached_property
    def tilt(self) -> tuple[float, str]:
        """Tilt of a sensor that changes the scale by all of it from the page's centre to its right edge."""
        return math.degrees(self._focal_m / (self.profile.page_width_m / 2)), "degrees"

    @cached_property
    def axial_tilt(self) -> tuple[float, str]:
        """Tilt of a plane whose right edge is a radian of defocus further off than its middle."""
        return math.degrees(1e-3 * self.axial[0] / (self.profile.page_width_m / 2)), "degrees"

    @cached_property
    def beam(self) -> tuple[float, str]:
        """Angle of a beam whose phase is a radian at the right edge of the page's image."""
        return 1e3 / (self._wave_number * self.profile.page_width_m / 2), "mrad"

    @cached_property
    def camera_pixels(self) -> tuple[float, str]:
        """A pixel of a camera."""
        return 1e6 * self.profile.camera.pitch_m, "um"

    @cached_property
    def modulator_pixels(self) -> tuple[float, str]:
        """A pixel of the modulator."""
        return 1e6 * self.profile.slm.pitch_m, "um"

    @property
    def _wave_number(self) -> float:
        return 2 * math.pi / self.profile.light.wavelength_m

    @property
    def _focal_m(self) -> float:
        return self.profile.lens.focal_length_m


def _both(key: str, other: float = 1.0) -> dict[str, float]:
    """A setting of both cameras; the quadrature camera's is `other` times the in-phase camera's."""
    return {f"{_CAMERAS[0]}.{key}": 1.0, f"{_CAMERAS[1]}.{key}": other}


def _knobs() -> tuple[Knob, ...]:
    full = _FullSize(load_profile("paper"))
    waves = 1 / (2 * math.pi), "waves"
    opposite = -1.0
    return (
        # what a mount, a focus or a lookup table leaves; ordinary and dear
        Knob(
            "stroke",
            "phase stroke of the modulator, error",
            "of 2 pi",
            (-0.3, -0.15, -0.06, 0.06, 0.15, 0.3),
            {"slm.stroke_relative_error": 1.0},
        ),
        Knob(
            "level-sine",
            "smooth error over the levels, sine",
            "rad",
            (0.1, 0.2, 0.4, 0.7, 1.1, 1.6),
            {"slm.level_sine_rad": 1.0},
        ),
        Knob(
            "unmodulated",
            "unmodulated light, amplitude",
            "relative",
            (0.05, 0.1, 0.15, 0.3, 0.5, 0.8),
            {"slm.unmodulated_relative": 1.0},
        ),
        Knob(
            "modulator-axial",
            "modulator off its focal plane",
            "rad at the wall",
            (-6.0, -3.0, -1.5, 1.5, 3.0, 6.0),
            {"geometry.modulator_axial_rad": 1.0},
            full.axial,
        ),
        Knob(
            "cameras-axial",
            "both cameras off their focal plane",
            "rad at the wall",
            (-6.0, -3.0, -1.5, 1.5, 3.0, 6.0),
            _both("axial_rad"),
            full.axial,
        ),
        Knob(
            "cameras-apart",
            "cameras off their focal plane, opposite",
            "rad at the wall",
            (0.1, 0.2, 0.4, 0.8, 1.5, 2.5),
            _both("axial_rad", opposite),
            full.axial,
        ),
        Knob(
            "keystone",
            "keystone along x, cameras opposite",
            "relative",
            (0.002, 0.005, 0.01, 0.02, 0.04, 0.08),
            _both("keystone_x_relative", opposite),
            full.tilt,
        ),
        Knob(
            "pipe-angle",
            "pipe angle",
            "degrees",
            (-2.4, -1.6, -1.0, -0.2, 0.4, 1.2, 2.0),
            {"geometry.pipe_angle_deg": 1.0},
        ),
        Knob(
            "phase-noise",
            "phase noise of a modulator pixel",
            "rad",
            (0.0, 0.1, 0.2, 0.3, 0.45, 0.7, 1.0),
            {"slm.phase_noise_rad": 1.0},
        ),
        Knob(
            "full-well",
            "full well",
            "electrons",
            (100.0, 300.0, 1_000.0, 3_000.0, 8_000.0, 30_000.0, 100_000.0),
            {"sensor.full_well_e": 1.0},
            logarithmic=True,
        ),
        # pipe and lenses
        Knob(
            "pipe-width",
            "pipe width, error",
            "relative",
            (-0.004, -0.002, -0.0008, 0.0008, 0.002, 0.004),
            {"geometry.pipe_width_relative_error": 1.0},
            full.width,
        ),
        Knob(
            "pipe-length",
            "pipe length, error",
            "relative",
            (-0.02, -0.01, -0.004, 0.004, 0.01, 0.02),
            {"geometry.pipe_length_relative_error": 1.0},
            full.length,
        ),
        Knob(
            "pipe-height",
            "wall distance along y against x",
            "relative",
            (-0.006, -0.003, -0.001, 0.001, 0.003, 0.006),
            {"geometry.pipe_height_relative_error": 1.0},
            full.width,
        ),
        Knob(
            "taper",
            "taper of the pipe",
            "relative",
            (-0.02, -0.005, -0.001, 0.001, 0.005, 0.02),
            {"geometry.pipe_taper_relative": 1.0},
            full.width,
        ),
        Knob(
            "ghost",
            "light that passes the pipe three times",
            "relative",
            (0.02, 0.035, 0.07, 0.12, 0.2, 0.35),
            {"geometry.ghost_relative": 1.0},
        ),
        Knob(
            "pipe-roll",
            "roll of the pipe against the page",
            "degrees",
            (0.0, 0.3, 0.6, 1.0, 1.5, 2.2, 3.0),
            {"geometry.pipe_roll_deg": 1.0},
        ),
        Knob(
            "focal-length",
            "focal length, error",
            "relative",
            (-0.01, -0.005, -0.002, 0.002, 0.005, 0.01),
            {"geometry.focal_length_relative_error": 1.0},
            full.focal,
        ),
        Knob(
            "page-shift",
            "page off the axis, along x and y",
            "modulator px",
            (0.0, 4.0, 8.0, 12.0, 20.0, 30.0, 45.0),
            {"geometry.page_shift_x_px": 1.0, "geometry.page_shift_y_px": 1.0},
            full.modulator_pixels,
        ),
        Knob(
            "distortion",
            "distortion at the page's corner",
            "relative",
            (-0.02, -0.01, -0.004, 0.0, 0.004, 0.01, 0.02),
            {"aberration.distortion_relative": 1.0},
        ),
        *(
            Knob(
                name,
                f"{name} over the page, at its corner",
                "rad",
                (-12.0, -6.0, -3.0, 0.0, 3.0, 6.0, 12.0),
                {f"aberration.{name}_rad": 1.0},
                waves,
            )
            for name in ("defocus", "astigmatism", "coma")
        ),
        # tilted planes
        Knob(
            "modulator-tilt",
            "tilt of the modulator",
            "rad at the wall",
            (0.2, 0.5, 1.0, 1.5, 2.5, 4.0),
            {"geometry.modulator_tilt_x_rad": 1.0},
            full.axial_tilt,
        ),
        Knob(
            "camera-tilt",
            "defocus of tilted cameras, opposite",
            "rad at the wall",
            (0.2, 0.5, 1.0, 1.5, 2.5, 4.0),
            _both("tilt_x_rad", opposite),
            full.axial_tilt,
        ),
        # cameras
        Knob(
            "camera-shift",
            "shift of the cameras, opposite",
            "camera px",
            (0.0, 8.0, 12.0, 16.0, 24.0, 36.0),
            {**_both("shift_x_px", opposite), **_both("shift_y_px", opposite)},
            full.camera_pixels,
        ),
        Knob(
            "camera-rotation",
            "rotation of the cameras, opposite",
            "degrees",
            (0.0, 0.3, 0.6, 1.0, 1.5, 2.2, 3.0),
            _both("rotation_deg", opposite),
        ),
        Knob(
            "camera-scale",
            "scale of the cameras, opposite",
            "relative",
            (0.0, 0.008, 0.015, 0.025, 0.04, 0.06, 0.09),
            _both("scale_relative_error", opposite),
        ),
        # reference beam and homodyne arms
        Knob(
            "reference-amplitude",
            "amplitude of the reference over the signal's",
            "ratio",
            (0.6, 0.9, 1.2, 2.5, 4.0, 8.0),
            {"reference.amplitude_ratio": 1.0},
            logarithmic=True,
        ),
        Knob(
            "reference-ripple",
            "ripple of the reference",
            "relative",
            (0.0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6),
            {"reference.ripple_relative": 1.0},
        ),
        Knob(
            "reference-tilt",
            "tilt of the reference, along x",
            "rad at the edge",
            (-20.0, -10.0, -4.0, 0.0, 4.0, 10.0, 20.0),
            {"reference.tilt_x_rad": 1.0},
            full.beam,
        ),
        Knob(
            "reference-curvature",
            "curvature of the reference",
            "rad at the corner",
            (-20.0, -10.0, -4.0, 0.0, 4.0, 10.0, 20.0),
            {"reference.curvature_rad": 1.0},
            waves,
        ),
        Knob(
            "quadrature-error",
            "angle between the arms beyond 90 degrees",
            "degrees",
            (-25.0, -15.0, -8.0, 0.0, 8.0, 15.0, 25.0),
            {"homodyne.quadrature_error_deg": 1.0},
        ),
        Knob(
            "quadrature-gain",
            "gain of the quadrature arm",
            "ratio",
            (0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0),
            {"homodyne.quadrature_gain": 1.0},
            logarithmic=True,
        ),
        # modulator
        Knob(
            "level-cosine",
            "smooth error over the levels, cosine",
            "rad",
            (0.1, 0.2, 0.4, 0.7, 1.1, 1.6),
            {"slm.level_cosine_rad": 1.0},
        ),
        Knob(
            "level-sine-twice",
            "smooth error over the levels, sine of twice",
            "rad",
            (0.05, 0.1, 0.2, 0.4, 0.7, 1.1),
            {"slm.level_sine_twice_rad": 1.0},
        ),
        Knob(
            "level-amplitude",
            "amplitude that goes with the level",
            "relative",
            (0.1, 0.2, 0.3, 0.45, 0.6, 0.8),
            {"slm.level_amplitude_relative": 1.0},
        ),
        Knob(
            "modulator-blur",
            "blur of the modulator's light",
            "modulator px",
            (0.0, 0.4, 0.6, 0.9, 1.2, 1.6, 2.2),
            {"slm.blur_px": 1.0},
            full.modulator_pixels,
        ),
        Knob(
            "falloff",
            "loss of amplitude at the page's corner",
            "relative",
            (0.0, 0.25, 0.4, 0.55, 0.7, 0.8, 0.9),
            {"slm.falloff_relative": 1.0},
        ),
        Knob(
            "crosstalk",
            "step in phase that a neighbour takes over",
            "relative",
            (0.01, 0.02, 0.04, 0.07, 0.12, 0.2),
            {"slm.crosstalk_relative": 1.0},
        ),
        Knob(
            "flicker",
            "flicker of 2 pi from page to page",
            "rad",
            (0.02, 0.05, 0.1, 0.15, 0.25, 0.4),
            {"slm.flicker_rad": 1.0},
        ),
        Knob(
            "dead-pixels",
            "dead pixels of the modulator",
            "share",
            (0.0005, 0.002, 0.005, 0.01, 0.03, 0.1),
            {"slm.dead_pixel_share": 1.0},
        ),
        # sensors
        Knob(
            "read-noise",
            "read noise",
            "electrons",
            (0.0, 10.0, 25.0, 50.0, 100.0, 200.0, 400.0),
            {"sensor.read_noise_e": 1.0},
        ),
        Knob(
            "exposure",
            "exposure, over that which just fills the well",
            "ratio",
            (0.02, 0.06, 0.2, 0.5, 1.5, 2.5, 5.0),
            {"sensor.exposure_relative": 1.0},
            logarithmic=True,
        ),
        Knob(
            "nonlinearity",
            "error of a full well's counts",
            "relative",
            (-0.2, -0.08, -0.03, 0.03, 0.08, 0.2),
            {"sensor.nonlinearity_relative": 1.0},
        ),
        Knob(
            "hot-pixels",
            "hot pixels of a camera",
            "share",
            (0.0002, 0.001, 0.003, 0.01, 0.03, 0.1),
            {"sensor.hot_pixel_share": 1.0},
        ),
        Knob(
            "dust",
            "specks of dust on a camera",
            "specks",
            (10.0, 25.0, 60.0, 150.0, 400.0, 1_000.0),
            {"sensor.dust_specks": 1.0},
        ),
    )


KNOBS = {knob.name: knob for knob in _knobs()}
"""Knobs by name, those that cost a usual device most first."""
