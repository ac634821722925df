"""Device profiles: the nominal numbers of a storage device, read from TOML and checked on load."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Collection
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from lightpage.device.lens_path import SeidelTerms
from lightpage.device.problems import mistakes
from lightpage.errors import ProfileError
from lightpage.files import read_text
from lightpage.words import brief, sides

Wavelength = Annotated[float, Field(ge=1e-7, le=1e-4, allow_inf_nan=False)]
"""Metres; these bounds and the next ones refuse a number in another unit."""
Length = Annotated[float, Field(ge=1e-5, le=10, allow_inf_nan=False)]
"""Of a part of the device, metres."""
Pitch = Annotated[float, Field(ge=1e-8, le=1e-3, allow_inf_nan=False)]
"""Of pixels, metres."""
Finite = Annotated[float, Field(allow_inf_nan=False)]
Radians = Annotated[float, Field(ge=-50, le=50, allow_inf_nan=False)]
"""Of a term of a lens's path: more would take more memory to compute with than there is."""
Count = Annotated[int, Field(gt=0)]
Side = Annotated[int, Field(gt=0, le=30_000)]
"""Pixels along one side of a sensor: the largest that are made have some twenty thousand."""

_MOST_REFLECTIONS = 100

SHIPPED = ("bench", "paper")


class TomlTable(BaseModel):
    """A checked TOML table: frozen, no unknown keys, no NaN or infinity, and no text or truth value for a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class StrictTable(TomlTable):
    """A table in which the text below a key is its description."""

    model_config = ConfigDict(use_attribute_docstrings=True)


T = TypeVar("T", bound=TomlTable)


class Light(TomlTable):
    """The laser."""

    wavelength_m: Wavelength = Field(description="Wavelength in vacuum")


class Lens(TomlTable):
    """The launch and the de-launch lens, both in a 2f arrangement."""

    focal_length_m: Length = Field(description="Focal length of both lenses, or of the launch lens alone")
    camera_focal_length_m: Length | None = Field(None, description="Focal length of the de-launch lens, if it differs")


class Relay(TomlTable):
    """Lenses that show the image to the cameras at another size than the de-launch lens makes it."""

    magnification: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)] = Field(
        1.0,
        description="Size of the image on the sensors over that behind the de-launch lens; flips set it upright",
    )


class LensPath(TomlTable):
    """Optical path of either lens beyond an ideal one's, by its terms, for the page's corner at the pipe's wall."""

    piston_rad: Radians = Field(0.0, description="Term of the fourth power of the field")
    distortion_rad: Radians = Field(0.0, description="Term of the third power of the field")
    astigmatism_rad: Radians = Field(0.0, description="Term of the second power of the field, along it")
    field_curvature_rad: Radians = Field(0.0, description="Term of the second power of the field")
    coma_rad: Radians = Field(0.0, description="Term of the first power of the field")
    spherical_rad: Radians = Field(0.0, description="Term of the fourth power of the aperture")

    def at(self, share: float) -> LensPath:
        """The same lenses, stated for a page whose corner lies at that share of this one's distance."""
        powers = {"piston": 4, "distortion": 3, "astigmatism": 2, "field_curvature": 2, "coma": 1, "spherical": 0}
        return LensPath(
            **{f"{name}_rad": getattr(self, f"{name}_rad") * share**power for name, power in powers.items()}
        )

    def times(self, factor: float) -> LensPath:
        """Return the path of lenses so many times as large.

        Raises:
            ProfileError: a term that is more than a profile may state.
        """
        larger = {name: factor * value for name, value in self.model_dump().items()}
        return validate(LensPath, larger, f"lens_path of lenses {factor:g} times as large")


class Pipe(TomlTable):
    """The light-pipe: a glass prism whose cross-section is a rhombus of height `width_m`, sheared by `angle_deg`."""

    length_m: Length = Field(description="Length along the light")
    width_m: Length = Field(description="Distance of opposite walls")
    refractive_index: Annotated[float, Field(ge=1, le=4)] = Field(
        description="Refractive index of the glass at the wavelength"
    )
    angle_deg: Annotated[float, Field(ge=-5, le=5)] = Field(
        0.0, description="Angle by which the cross-section misses the right angle"
    )


class Slm(TomlTable):
    """The spatial light modulator."""

    pitch_m: Pitch = Field(description="Distance from one pixel to the next")


class PageLayout(TomlTable):
    """Layout of symbols on the SLM, and which of them are pilots."""

    columns: Count = Field(description="Symbols side by side")
    rows: Count = Field(description="Symbols above one another")
    symbol_size_px: Count = Field(description="Edge of a symbol, modulator pixels")
    pilot_fraction: Annotated[float, Field(gt=0, lt=0.5)] = Field(
        0.01, description="Share of known symbols, the pilots; those of a page must tell 13 bits before it is believed"
    )
    pilot_seed: Annotated[int, Field(ge=0)] = Field(0, description="Seed of the positions and values of pilots")


class Camera(TomlTable):
    """The sensor of both cameras."""

    columns_px: Side = Field(description="Width of a frame")
    rows_px: Side = Field(description="Height of a frame")
    pitch_m: Pitch = Field(description="Distance from one sensor pixel to the next")


class Profile(TomlTable):
    """Data sheet of a device. Lengths in metres, angles in degrees, pixels where the key says so."""

    schema_version: Literal[1] = Field(description="Version of this layout")
    name: Annotated[str, Field(min_length=1)] = Field(description="Name of the device, for messages")
    light: Light
    lens: Lens
    pipe: Pipe
    slm: Slm
    page: PageLayout
    camera: Camera
    relay: Relay = Relay()
    lens_path: LensPath = LensPath()

    def __repr__(self) -> str:
        lens = f"{1e9 * self.light.wavelength_m:g} nm, f {1e3 * self.lens.focal_length_m:g} mm"
        pipe = f"pipe {1e3 * self.pipe.length_m:g} mm by {1e3 * self.pipe.width_m:.4g} mm"
        return brief(self, self.name, lens, pipe, f"page of {sides(self.page_shape)} symbols")

    __str__ = __repr__  # pydantic's own tells every number

    @model_validator(mode="after")
    def _page_fits_the_optics(self) -> Self:
        half_m = max(self.page_width_m, self.page_height_m) / 2
        numerical_aperture = half_m / self.lens.focal_length_m
        if numerical_aperture >= 0.5:
            raise ValueError(
                f"page.columns, page.rows: the page's edge enters at {numerical_aperture:.2f} of the focal length, "
                f"wanted below 0.5: lens.focal_length_m above {2 * half_m:.4g}, or fewer symbols"
            )
        reflections = numerical_aperture * self.pipe.length_m / (self.pipe.refractive_index * self.pipe.width_m)
        if reflections > _MOST_REFLECTIONS:
            length_m = self.pipe.length_m * _MOST_REFLECTIONS / reflections
            raise ValueError(
                f"pipe.length_m, pipe.width_m: light of the page's edge meets a wall {reflections:.3g} times, "
                f"wanted at most {_MOST_REFLECTIONS}: pipe.length_m up to {length_m:.4g}"
            )
        if self.lens.camera_focal_length_m is not None and not self.ideal_lenses:
            raise ValueError(
                "lens.camera_focal_length_m, lens_path: a path of two equal lenses and a second focal length, "
                "wanted one of them"
            )
        return self

    @property
    def page_width_m(self) -> float:
        """Width of the page on the SLM, metres."""
        return self.page.columns * self.page.symbol_size_px * self.slm.pitch_m

    @property
    def corner_m(self) -> float:
        """Distance of the page's corner from its centre, metres: aberrations and distortions are stated there."""
        return math.hypot(self.page_width_m, self.page_height_m) / 2

    @property
    def light_curvature_rad(self) -> float:
        """Phase of the light of the page's corner, steeper in the pipe, against that of its centre, radians: negative.

        A reference beam of this `curvature_rad` is matched to it: against that beam light that met no wall is flat, and
        what walls reflected has only a ramp left, as from a source beside the pipe.
        """
        path_m = self.pipe.length_m * (self.corner_m / self.lens.focal_length_m) ** 2 / (2 * self.pipe.refractive_index)
        return -2 * math.pi / self.light.wavelength_m * path_m

    @property
    def page_height_m(self) -> float:
        """Height of the page on the SLM, metres."""
        return self.page.rows * self.page.symbol_size_px * self.slm.pitch_m

    @property
    def symbol_pitch_m(self) -> float:
        """Edge of one symbol on the SLM, metres."""
        return self.page.symbol_size_px * self.slm.pitch_m

    @property
    def camera_magnification(self) -> float:
        """Size of a page's image on the sensors over the page's own: that of two lenses f1, f2 is f2 / f1."""
        second = self.lens.camera_focal_length_m
        lenses = 1.0 if second is None else second / self.lens.focal_length_m
        return self.relay.magnification * lenses

    @property
    def image_pixel_m(self) -> float:
        """Edge of a camera pixel where the page's image has the page's own size, metres."""
        return self.camera.pitch_m / self.camera_magnification

    @property
    def page_shape(self) -> tuple[int, int]:
        """Symbols as (rows, columns)."""
        return self.page.rows, self.page.columns

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Camera pixels as (rows, columns)."""
        return self.camera.rows_px, self.camera.columns_px

    @property
    def ideal_lenses(self) -> bool:
        """Return whether the lenses have no path beyond the ideal one."""
        return self.lens_path == LensPath()

    def seidel_terms(self, share: Any = 1.0) -> SeidelTerms:
        """The lenses' path beyond the ideal one, and how much of it there is, as a number or a tensor."""
        field, aperture = self.corner_m, self.pipe.width_m / 2
        path = self.lens_path
        return SeidelTerms(
            piston=share * path.piston_rad / field**4,
            distortion=share * path.distortion_rad / (field**3 * aperture),
            astigmatism=share * path.astigmatism_rad / (field * aperture) ** 2,
            field_curvature=share * path.field_curvature_rad / (field * aperture) ** 2,
            coma=share * path.coma_rad / (field * aperture**3),
            spherical=share * path.spherical_rad / aperture**4,
        )

    def with_symbols_of(self, size_px: int) -> Profile:
        """The same device with symbols of another size, SLM pixels, on as much of its page as whole symbols cover."""
        page = self.page
        columns, rows = (count * page.symbol_size_px // size_px for count in (page.columns, page.rows))
        update = {"columns": columns, "rows": rows, "symbol_size_px": size_px}
        cut = self.model_copy(update={"page": page.model_copy(update=update)})
        return cut.model_copy(update={"lens_path": self.lens_path.at(cut.corner_m / self.corner_m)})

    def with_ideal_lenses(self) -> Profile:
        """The same device with lenses that have no path beyond the ideal one."""
        return self.model_copy(update={"lens_path": LensPath()})

    def to_toml(self) -> str:
        """The profile as TOML text, which `parse_profile` reads back to an equal one.

        Tables that the format had later are left out where they say nothing, so that earlier profiles keep their text.
        """
        return to_toml(self, without=[name for name in ("relay", "lens_path") if getattr(self, name) == _SILENT[name]])


_SILENT: dict[str, TomlTable] = {"relay": Relay(), "lens_path": LensPath()}


def to_toml(table: TomlTable, without: Collection[str] = ()) -> str:
    """Write a checked table (scalars first, then its sub-tables one level down) as TOML text, some keys left out."""
    scalars: list[str] = []
    tables: list[str] = []
    for key, value in table.model_dump(exclude=set(without), exclude_none=True).items():
        if isinstance(value, dict):
            tables += ["", f"[{key}]", *(f"{k} = {toml_value(v)}" for k, v in value.items())]
        else:
            scalars.append(f"{key} = {toml_value(value)}")
    return "\n".join([*scalars, *tables]) + "\n"


def toml_value(value: object) -> str:
    """A text, a truth value, a number, a list of such, or an inline table of them, as TOML writes it."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {toml_value(one)}' for key, one in value.items())}}}"
    if isinstance(value, str):
        # a JSON string is a TOML one but for this character
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)


def validate(model: type[T], data: dict[str, Any], source: str) -> T:
    """Check `data` against `model`; a `ProfileError` lists every offending key with what came and what was wanted."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ProfileError(source, mistakes(model, error), f"a valid {model.__name__.lower()}") from None


def parse_profile(text: str, source: str = "profile") -> Profile:
    """Read a profile from TOML text.

    Raises:
        ProfileError: not TOML, a missing, unknown or unphysical key.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ProfileError(source, f"text that is not TOML ({error})", "a TOML document") from None
    return validate(Profile, data, source)


def load_profile(name_or_path: str | Path) -> Profile:
    """Load a shipped profile by name (`bench`, `paper`) or any profile by path.

    Raises:
        ProfileError: no such profile, or it does not validate.
    """
    if str(name_or_path) in SHIPPED:
        text = resources.files("lightpage.device").joinpath("profiles", f"{name_or_path}.toml").read_text("utf-8")
        return parse_profile(text, f"profile {name_or_path}")
    subject, expected = f"profile {name_or_path}", f"a readable TOML file or one of {', '.join(SHIPPED)}"
    return parse_profile(read_text(name_or_path, subject, expected, ProfileError), subject)
