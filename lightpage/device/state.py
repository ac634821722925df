"""What one device truly is: its deviations from the nominal profile, known only to a simulator."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from lightpage.device.profile import Profile, TomlTable, validate
from lightpage.errors import ProfileError
from lightpage.files import read_text

# Bounds lie far beyond any device that can be built; they keep a slip of the pen from filling the machine's memory.
Angle = Annotated[float, Field(ge=-5, le=5, allow_inf_nan=False)]
Phase = Annotated[float, Field(ge=-10_000, le=10_000, allow_inf_nan=False)]
Pixels = Annotated[float, Field(ge=-500, le=500, allow_inf_nan=False)]
Few = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]


class Geometry(TomlTable):
    """Pipe, lenses and page against their nominal values."""

    pipe_angle_deg: Angle = -0.6
    focal_length_relative_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    pipe_length_relative_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    pipe_width_relative_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    page_shift_x_px: Pixels = 2.0
    """Centre of the page off the optical axis, SLM pixels."""
    page_shift_y_px: Pixels = 2.0
    pipe_roll_deg: Angle = 0.1
    modulator_axial_rad: Phase = 0.0
    """Axial place of the modulator off its focal plane: phase at the middle of the facet's wall."""


class CameraPose(TomlTable):
    """Where one camera truly sits: similarity transform about its centre, shift in camera pixels."""

    scale_relative_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    rotation_deg: Angle = 0.0
    shift_x_px: Pixels = 0.0
    shift_y_px: Pixels = 0.0
    axial_rad: Phase = 0.0
    """Axial place off the focal plane: phase at the middle of the facet's wall."""
    keystone_x_relative: Annotated[float, Field(ge=-0.1, le=0.1, allow_inf_nan=False)] = 0.0
    """Change of the scale from the centre to the right edge of the page's image, as a tilted sensor has."""
    keystone_y_relative: Annotated[float, Field(ge=-0.1, le=0.1, allow_inf_nan=False)] = 0.0
    """The same to the bottom edge."""


class Aberration(TomlTable):
    """Phase at the page's corner, and radial distortion of the image, common to both cameras."""

    distortion_relative: Annotated[float, Field(ge=-0.2, le=0.2, allow_inf_nan=False)] = 0.001
    """Relative radial displacement at the page's corner."""
    defocus_rad: Phase = 1.0
    astigmatism_rad: Phase = 1.0
    coma_rad: Phase = 1.0
    lens_path_relative_error: Annotated[float, Field(ge=-3, le=3, allow_inf_nan=False)] = 0.0
    """Of the lenses' path beyond the ideal one, against the profile's: -1 is an ideal lens."""


class Reference(TomlTable):
    """The reference beam at the cameras."""

    amplitude_ratio: Annotated[float, Field(ge=0.01, le=1000, allow_inf_nan=False)] = 1.6
    """Mean reference amplitude over the signal's root mean square amplitude."""
    ripple_relative: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.04
    ripple_seed: Annotated[int, Field(ge=0)] = 1
    """Draws the ripple's pattern, which belongs to the device and not to what is written."""
    tilt_x_rad: Phase = 1.0
    """Phase at the right edge of the page's image."""
    tilt_y_rad: Phase = 1.0
    curvature_rad: Phase = 1.0
    """Phase at the corner of the page's image."""


class Homodyne(TomlTable):
    """The quadrature arm against the in-phase arm."""

    quadrature_error_deg: Annotated[float, Field(ge=-89, le=89, allow_inf_nan=False)] = 3.0
    quadrature_gain: Annotated[float, Field(ge=0.01, le=100, allow_inf_nan=False)] = 0.95
    quadrature_sign: Literal[-1, 1] = 1

    @property
    def turn_rad(self) -> float:
        """Angle between the arms, sign of Q included."""
        return self.quadrature_sign * math.pi / 2 + math.radians(self.quadrature_error_deg)


class SlmDefects(TomlTable):
    """The modulator and its illumination."""

    phase_noise_rad: Few = 0.05
    blur_px: Few = 0.3
    falloff_relative: Annotated[float, Field(ge=0, lt=1)] = 0.15
    """Loss of illumination amplitude at the page's corner."""
    stroke_relative_error: Annotated[float, Field(ge=-0.5, le=0.5, allow_inf_nan=False)] = 0.0
    """Of the phase between the first level and one beyond the last, which is nominally 2 pi."""
    level_sine_rad: Annotated[float, Field(ge=-3, le=3, allow_inf_nan=False)] = 0.0
    """Smooth error over the levels: times the sine of the nominal phase."""
    level_cosine_rad: Annotated[float, Field(ge=-3, le=3, allow_inf_nan=False)] = 0.0
    level_sine_twice_rad: Annotated[float, Field(ge=-3, le=3, allow_inf_nan=False)] = 0.0
    """Times the sine of twice the nominal phase."""
    unmodulated_relative: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Amplitude of the light that is not modulated, over that of the light that is."""
    unmodulated_phase_rad: Phase = 0.0
    level_amplitude_relative: Annotated[float, Field(ge=-0.9, le=0.9, allow_inf_nan=False)] = 0.0
    """Change of amplitude that goes with the phase: times the cosine of the nominal phase."""


class Sensor(TomlTable):
    """Both cameras' electronics."""

    full_well_e: Annotated[float, Field(ge=1, le=1e12, allow_inf_nan=False)] = 15_000.0
    read_noise_e: Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)] = 2.5
    bit_depth: Annotated[int, Field(ge=8, le=16)] = 8
    exposure_relative: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] = 1.0
    """Light on both cameras, against what lets the brightest fringes just fill the well."""


class Drift(TomlTable):
    """Standard deviation of the change from one page to the next (a random walk)."""

    piston_rad: Few = 0.2
    shift_px: Few = 0.02


class Device(TomlTable):
    """The true state of a simulated device. The default is a realistic one."""

    geometry: Geometry = Geometry()
    in_phase_camera: CameraPose = CameraPose(scale_relative_error=0.005, rotation_deg=0.1, shift_x_px=4, shift_y_px=-3)
    quadrature_camera: CameraPose = CameraPose(
        scale_relative_error=-0.003, rotation_deg=-0.1, shift_x_px=-4, shift_y_px=2
    )
    aberration: Aberration = Aberration()
    reference: Reference = Reference()
    homodyne: Homodyne = Homodyne()
    slm: SlmDefects = SlmDefects()
    sensor: Sensor = Sensor()
    drift: Drift = Drift()

    def of_profile(self, profile: Profile) -> Device:
        """A copy whose pipe is off the angle of `profile` by its own angle, unless that was given.

        The default is a deviation: a device that is meant to be at 0.3 degree is not at -0.6 by default.
        """
        if "geometry" in self.model_fields_set and "pipe_angle_deg" in self.geometry.model_fields_set:
            return self
        angle = profile.pipe.angle_deg + self.geometry.pipe_angle_deg
        return self.model_copy(update={"geometry": self.geometry.model_copy(update={"pipe_angle_deg": angle})})

    def with_settings(self, settings: list[str]) -> Device:
        """A copy with `TABLE.KEY=VALUE` settings applied, values in TOML syntax.

        Raises:
            ProfileError: no such key, or a value that is not allowed.
        """
        data: dict[str, Any] = self.model_dump()
        for setting in settings:
            path, separator, value = setting.partition("=")
            table, dot, key = path.strip().partition(".")
            if not separator or not dot or key not in data.get(table, {}):
                raise ProfileError(f"--set {setting}", path, f"TABLE.KEY=VALUE, {_alike(path.strip(), data)}")
            try:
                data[table][key] = tomllib.loads(f"value = {value}")["value"]
            except tomllib.TOMLDecodeError:
                raise ProfileError(f"--set {setting}", value, "a number in TOML syntax") from None
        return validate(Device, data, "device settings")


def _alike(path: str, tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Which settings may have been meant by a TABLE.KEY that is none."""
    known = [f"{table}.{key}" for table, keys in tables.items() for key in keys]
    table, _, key = path.rpartition(".")
    by_key = {name.partition(".")[2]: name for name in known}
    close = [*get_close_matches(path, known, 3), *(by_key[name] for name in get_close_matches(key, by_key, 3))]
    if not close and table in tables:
        return f"KEY being one of {', '.join(tables[table])}"
    if not close:
        return f"TABLE being one of {', '.join(tables)}"
    return f"perhaps {' or '.join(dict.fromkeys(close))}"


def ideal_device() -> Device:
    """A device without any defect but camera noise, its pipe square: as its profile says."""
    pose = CameraPose()
    return Device(
        geometry=Geometry(pipe_angle_deg=0, page_shift_x_px=0, page_shift_y_px=0, pipe_roll_deg=0),
        in_phase_camera=pose,
        quadrature_camera=pose,
        aberration=Aberration(distortion_relative=0, defocus_rad=0, astigmatism_rad=0, coma_rad=0),
        reference=Reference(ripple_relative=0, tilt_x_rad=0, tilt_y_rad=0, curvature_rad=0),
        homodyne=Homodyne(quadrature_error_deg=0, quadrature_gain=1),
        slm=SlmDefects(phase_noise_rad=0, blur_px=0, falloff_relative=0),
        drift=Drift(piston_rad=0, shift_px=0),
    )


def parse_device(text: str, source: str = "device") -> Device:
    """Read a device state from TOML text; keys left out keep their realistic default.

    Raises:
        ProfileError: not TOML, or a key that does not validate.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ProfileError(source, f"text that is not TOML ({error})", "a TOML document") from None
    return validate(Device, data, source)


def load_device(path: str | Path) -> Device:
    """Load a device state from a TOML file; keys left out keep their realistic default.

    Raises:
        ProfileError: unreadable, not TOML, or a key that does not validate.
    """
    subject = f"device file {path}"
    return parse_device(read_text(path, subject, "a readable TOML file", ProfileError), subject)


def draw_device(rng: np.random.Generator) -> Device:
    """Draw a device uniformly over the whole range from which calibration must succeed."""

    def within(limit: float, centre: float = 0.0) -> float:
        return float(rng.uniform(centre - limit, centre + limit))

    def pose() -> CameraPose:
        return CameraPose(
            scale_relative_error=within(0.01), rotation_deg=within(0.3), shift_x_px=within(12), shift_y_px=within(12)
        )

    device = Device(
        geometry=Geometry(
            pipe_angle_deg=within(1),
            focal_length_relative_error=within(0.003),
            pipe_length_relative_error=within(0.005),
            pipe_width_relative_error=within(0.0005),
            page_shift_x_px=within(6),
            page_shift_y_px=within(6),
            pipe_roll_deg=within(0.4),
        ),
        in_phase_camera=pose(),
        quadrature_camera=pose(),
        aberration=Aberration(
            distortion_relative=within(0.003), defocus_rad=within(2), astigmatism_rad=within(2), coma_rad=within(2)
        ),
        reference=Reference(
            amplitude_ratio=float(rng.uniform(1.2, 3)),
            ripple_relative=float(rng.uniform(0, 0.1)),
            tilt_x_rad=within(3),
            tilt_y_rad=within(3),
            curvature_rad=within(3),
        ),
        homodyne=Homodyne(
            quadrature_error_deg=within(6),
            quadrature_gain=within(0.1, 1.0),
            quadrature_sign=1 if rng.random() < 0.5 else -1,
        ),
        slm=SlmDefects(
            phase_noise_rad=float(rng.uniform(0, 0.3)),
            blur_px=float(rng.uniform(0, 0.5)),
            falloff_relative=float(rng.uniform(0, 0.3)),
        ),
        sensor=Sensor(
            full_well_e=float(rng.uniform(3_000, 15_000)),
            read_noise_e=float(rng.uniform(0, 6)),
            bit_depth=int(rng.choice([8, 10, 12, 16])),
        ),
        drift=Drift(piston_rad=float(rng.uniform(0, 0.5)), shift_px=float(rng.uniform(0, 0.2))),
    )
    ripple = device.reference.model_copy(update={"ripple_seed": int(rng.integers(2**31))})
    lenses = device.aberration.model_copy(update={"lens_path_relative_error": within(0.3)})
    return device.model_copy(update={"reference": ripple, "aberration": lenses})
