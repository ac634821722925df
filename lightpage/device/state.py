"""The true state of one device: its deviations from the nominal profile, known only to a simulator."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

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
Tilt = Annotated[float, Field(ge=-20, le=20, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Seed = Annotated[int, Field(ge=0)]

SHIPPED_STATES = ("rough",)


class Geometry(TomlTable):
    """Pipe, lenses and page against their nominal values."""

    pipe_angle_deg: Angle = -0.6
    focal_length_relative_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    pipe_length_relative_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    pipe_width_relative_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    pipe_height_relative_error: Annotated[float, Field(ge=-0.1, le=0.1, allow_inf_nan=False)] = 0.0
    """Of the walls' distance along y', against that along x."""
    pipe_taper_relative: Annotated[float, Field(ge=-0.1, le=0.1, allow_inf_nan=False)] = 0.0
    """Both distances at the exit against those at the entrance; `pipe_width_relative_error` holds between them."""
    ghost_relative: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Amplitude of the light that both facets reflect once, and that so passes the pipe three times."""
    page_shift_x_px: Pixels = 2.0
    """Centre of the page off the optical axis, SLM pixels."""
    page_shift_y_px: Pixels = 2.0
    pipe_roll_deg: Angle = 0.1
    modulator_axial_rad: Phase = 0.0
    """Axial place of the modulator off its focal plane: phase at the middle of the facet's wall."""
    modulator_tilt_x_rad: Tilt = 0.0
    """By how much that phase is larger at the page's right edge than in its middle, as a tilted modulator has it."""
    modulator_tilt_y_rad: Tilt = 0.0
    """The same at the lower edge."""


class CameraPose(TomlTable):
    """The true pose of one camera: similarity transform about its centre, shift in camera pixels."""

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
    tilt_x_rad: Tilt = 0.0
    """By how much the phase of `axial_rad` is larger at the right edge of the page's image than in its middle."""
    tilt_y_rad: Tilt = 0.0
    """The same at the lower edge."""


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
    ripple_seed: Seed = 1
    """Draws the ripple's pattern, which belongs to the device and not to what is written."""
    tilt_x_rad: Phase = 1.0
    """Phase at the right edge of the page's image."""
    tilt_y_rad: Phase = 1.0
    curvature_rad: Phase = 1.0
    """Phase at the corner of the page's image."""
    recorded_exposure_relative: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)] = 1.0
    """Exposure of the reference frames over that of pages, which is meant to be the same."""


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
    level_ripple_rad: Annotated[float, Field(ge=-3, le=3, allow_inf_nan=False)] = 0.0
    """Times the sine of twenty times the nominal phase, as a lookup table of few entries has."""
    unmodulated_relative: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Amplitude of the light that is not modulated, over that of the light that is."""
    unmodulated_phase_rad: Phase = 0.0
    level_amplitude_relative: Annotated[float, Field(ge=-0.9, le=0.9, allow_inf_nan=False)] = 0.0
    """Change of amplitude that goes with the phase: times the cosine of the nominal phase."""
    crosstalk_relative: Annotated[float, Field(ge=0, le=0.25)] = 0.0
    """Share of the step in phase to each of its four neighbours that a pixel takes over, as fringing fields make it."""
    flicker_rad: Few = 0.0
    """Standard deviation, from page to page, of a phase of 2 pi; smaller ones flicker along in proportion."""
    dead_pixel_share: Share = 0.0
    """Of the modulator's pixels: half of the dead ones stay at some phase, half are dark."""
    dead_pixel_seed: Seed = 1
    """Draws which; a larger share adds pixels to those of a smaller one."""


class Sensor(TomlTable):
    """Both cameras' electronics."""

    full_well_e: Annotated[float, Field(ge=1, le=1e12, allow_inf_nan=False)] = 15_000.0
    read_noise_e: Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)] = 2.5
    bit_depth: Annotated[int, Field(ge=8, le=16)] = 8
    exposure_relative: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] = 1.0
    """Light on both cameras, against what lets the brightest fringes just fill the well."""
    nonlinearity_relative: Annotated[float, Field(ge=-0.3, le=0.3, allow_inf_nan=False)] = 0.0
    """Error of the counts of a full well; that of less light falls in proportion to it."""
    hot_pixel_share: Share = 0.0
    """Of either camera's pixels, that are always at full scale."""
    dust_specks: Annotated[int, Field(ge=0, le=10_000)] = 0
    """On either camera: each darkens some pixels about it, signal and reference alike."""
    late_dust_specks: Annotated[int, Field(ge=0, le=10_000)] = 0
    """Further specks, which settled after the references were recorded."""
    blemish_seed: Seed = 1
    """Draws where all these are; more of them are added to those of fewer."""
    black_level_relative: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = 0.0
    """Counts without any light, in pages and references alike, over full scale."""


class Drift(TomlTable):
    """Standard deviation of the change from one page to the next (a random walk)."""

    piston_rad: Few = 0.2
    shift_px: Few = 0.02
    vibration_rad: Few = 0.0
    """Standard deviation of the piston within an exposure: it takes contrast from the fringes."""

    @property
    def contrast(self) -> float:
        """Contrast of the fringes over that without vibration."""
        return math.exp(-(self.vibration_rad**2) / 2)


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
        values: dict[str, Any] = {}
        known = self.model_dump()
        for setting in settings:
            path, separator, value = setting.partition("=")
            table, dot, key = path.strip().partition(".")
            if not separator or not dot or key not in known.get(table, {}):
                there = dot and key in known.get(table, {})
                wanted = f"{path.strip()}=VALUE" if there else f"TABLE.KEY=VALUE, {_alike(path.strip(), known)}"
                raise ProfileError(f"--set {setting}", path, wanted)
            try:
                values[path.strip()] = tomllib.loads(f"value = {value}")["value"]
            except tomllib.TOMLDecodeError:
                raise ProfileError(f"--set {setting}", value, "a number in TOML syntax") from None
        return self.with_values(values)

    def with_values(self, values: Mapping[str, Any]) -> Device:
        """A copy with other values of known `TABLE.KEY`s.

        Raises:
            ProfileError: a value that is not allowed.
        """
        data: dict[str, Any] = self.model_dump()
        for path, value in values.items():
            table, _, key = path.partition(".")
            data[table][key] = value
        return validate(Device, data, "device settings")


def _alike(path: str, tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the settings that a wrong TABLE.KEY may have meant."""
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


def load_device(name_or_path: str | Path) -> Device:
    """Load a shipped device state by name (`rough`), or any by the path of a TOML file.

    Keys left out keep their realistic default, those of a camera's table that of a camera without error.

    Raises:
        ProfileError: unreadable, not TOML, or a key that does not validate.
    """
    if str(name_or_path) in SHIPPED_STATES:
        text = resources.files("lightpage.device").joinpath("states", f"{name_or_path}.toml").read_text("utf-8")
        return parse_device(text, f"device {name_or_path}")
    subject, expected = f"device file {name_or_path}", f"a readable TOML file or one of {', '.join(SHIPPED_STATES)}"
    return parse_device(read_text(name_or_path, subject, expected, ProfileError), subject)


class Spread(NamedTuple):
    """The range in which calibration must find a number, and the scatter of that number among rough devices.

    Attributes:
        low, high: ends of the range.
        deviation: standard deviation about `centre`; 0 where rough devices have what the realistic one has.
        centre: centre of a rough device. Numbers that cannot be negative scatter to one side of it.
    """

    low: float
    high: float
    deviation: float = 0.0
    centre: float = 0.0

    def even(self, rng: np.random.Generator) -> float:
        """Draw a number anywhere in the range."""
        return float(rng.uniform(self.low, self.high))

    def normal(self, rng: np.random.Generator, share: float = 1.0) -> float:
        """Draw a number of a rough device, within the range; it scatters by a share of the deviation."""
        drawn = rng.normal(self.centre, share * self.deviation)
        return float(np.clip(drawn if self.low else abs(drawn), self.low, self.high))


def _either_way(limit: float, deviation: float) -> Spread:
    return Spread(-limit, limit, deviation)


_POSE = {
    "scale_relative_error": _either_way(0.01, 0.005),
    "rotation_deg": _either_way(0.3, 0.1),
    "shift_x_px": _either_way(12, 4),
    "shift_y_px": _either_way(12, 4),
}
CAPTURE_RANGE: dict[str, Spread | Callable[[np.random.Generator], float]] = {
    "geometry.pipe_angle_deg": _either_way(1, 0.6),
    "geometry.focal_length_relative_error": _either_way(0.003, 0.001),
    "geometry.pipe_length_relative_error": _either_way(0.005, 0.005 / 3),
    "geometry.pipe_width_relative_error": _either_way(0.0005, 0.0005 / 3),
    "geometry.page_shift_x_px": _either_way(6, 2),
    "geometry.page_shift_y_px": _either_way(6, 2),
    "geometry.pipe_roll_deg": _either_way(0.4, 0.1),
    **{f"in_phase_camera.{key}": spread for key, spread in _POSE.items()},
    **{f"quadrature_camera.{key}": spread for key, spread in _POSE.items()},
    "aberration.distortion_relative": _either_way(0.003, 0.001),
    "aberration.defocus_rad": _either_way(2, 1),
    "aberration.astigmatism_rad": _either_way(2, 1),
    "aberration.coma_rad": _either_way(2, 1),
    "reference.amplitude_ratio": Spread(1.2, 3),
    "reference.ripple_relative": Spread(0, 0.1),
    "reference.tilt_x_rad": _either_way(3, 1),
    "reference.tilt_y_rad": _either_way(3, 1),
    "reference.curvature_rad": _either_way(3, 1),
    "homodyne.quadrature_error_deg": _either_way(6, 3),
    "homodyne.quadrature_gain": Spread(0.9, 1.1, 0.05, 1),
    "homodyne.quadrature_sign": lambda rng: 1 if rng.random() < 0.5 else -1,
    "slm.phase_noise_rad": Spread(0, 0.3),
    "slm.blur_px": Spread(0, 0.5),
    "slm.falloff_relative": Spread(0, 0.3),
    "sensor.full_well_e": Spread(3_000, 15_000),
    "sensor.read_noise_e": Spread(0, 6),
    "sensor.bit_depth": lambda rng: int(rng.choice([8, 10, 12, 16])),
    "drift.piston_rad": Spread(0, 0.5),
    "drift.shift_px": Spread(0, 0.2),
    "reference.ripple_seed": lambda rng: int(rng.integers(2**31)),
    "aberration.lens_path_relative_error": _either_way(0.3, 0.1),
    "slm.stroke_relative_error": _either_way(0.03, 0.005),
    "slm.unmodulated_relative": Spread(0, 0.2, 0.05),
    "slm.unmodulated_phase_rad": lambda rng: float(rng.uniform(-math.pi, math.pi)),
    "slm.level_amplitude_relative": _either_way(0.1, 0),
    "geometry.modulator_axial_rad": _either_way(1.5, 0.3),
    "in_phase_camera.axial_rad": _either_way(1.5, 0.3),
    "quadrature_camera.axial_rad": _either_way(1.5, 0.3),
}
"""From where calibration must succeed, in the order of drawing; what is no range is drawn as it says."""
_SMOOTH_ERROR = Spread(0, 0.3, 0.05)
"""The same for the largest smooth error over the levels, which sine, cosine and sine twice share."""


def draw_device(rng: np.random.Generator) -> Device:
    """Draw a device uniformly over the whole range from which calibration must succeed."""
    values = {key: knob.even(rng) if isinstance(knob, Spread) else knob(rng) for key, knob in CAPTURE_RANGE.items()}
    return Device().with_values(values | _smooth_error(_SMOOTH_ERROR.even(rng), rng))


def draw_rough(rng: np.random.Generator, share: float = 1.0) -> Device:
    """Draw a device whose numbers scatter as on a bench: normally, clipped at the range that `draw_device` fills.

    Noise, drift and illumination are those of the realistic device.

    Args:
        rng: draws.
        share: share of a rough device's deviations.
    """
    values: dict[str, float] = {}
    for key, knob in CAPTURE_RANGE.items():
        if not isinstance(knob, Spread):
            values[key] = knob(rng)
        elif knob.deviation:
            values[key] = knob.normal(rng, share)
    del values["sensor.bit_depth"]  # the electronics are those of the realistic device
    return Device().with_values(values | _smooth_error(_SMOOTH_ERROR.normal(rng, share), rng))


def _smooth_error(largest: float, rng: np.random.Generator) -> dict[str, float]:
    """A smooth error over the levels of at most so many radians, split at random."""
    shares = rng.standard_normal(3)
    shares *= largest / np.abs(shares).sum()
    keys = ("slm.level_sine_rad", "slm.level_cosine_rad", "slm.level_sine_twice_rad")
    return dict(zip(keys, shares.tolist(), strict=True))
