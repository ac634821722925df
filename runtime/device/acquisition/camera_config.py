"""The TOML file that says how a device's cameras, trigger, modulator and shutters are wired: `camera:CONFIG.toml`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, Tag, ValidationError, model_validator

from lightpage.device.problems import Problem, problems_of
from lightpage.device.profile import StrictTable, TomlTable
from lightpage.errors import InvalidInputError
from lightpage.files import read_toml
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS
from lightpage.runtime.device.acquisition.camera_image import View
from lightpage.runtime.device.acquisition.camera_source import Exposures
from lightpage.runtime.device.acquisition.pairing import PairingSettings
from lightpage.runtime.device.cameras.settings import CameraSettings
from lightpage.runtime.device.modulator.screen.raster import ScreenSettings
from lightpage.runtime.device.modulator.shutters import Shutter
from lightpage.runtime.device.trigger.pulse_generator import PulseGeneratorSettings

KEYS = "docs/cameras.md, all keys"
"""Where what a file may say is explained."""


class CameraTable(View, CameraSettings):
    """A camera, and its view of the image."""

    kind: Literal["genicam"] = "genicam"


class PluginTable(StrictTable):
    """A device by a driver that another package brings, an entry point.

    Attributes:
        driver: its name.
        options: what it is to know, as it says itself.
    """

    kind: Literal["plugin"]
    driver: Annotated[str, Field(min_length=1)]
    options: dict[str, Any] = {}  # noqa: RUF012  # pydantic copies it


class PluginCameraTable(View, PluginTable):
    """Camera by such a driver, and how it sees the image."""


def _kind_of_camera(table: object) -> object:
    return table.get("kind", "genicam") if isinstance(table, dict) else getattr(table, "kind", "genicam")


AnyCameraTable = Annotated[
    Annotated[CameraTable, Tag("genicam")] | Annotated[PluginCameraTable, Tag("plugin")],
    Discriminator(_kind_of_camera),
]


class PulseGeneratorTable(PulseGeneratorSettings):
    """A pulse generator with one channel for each camera."""

    kind: Literal["pulse_generator"]


class SoftwareTriggerTable(TomlTable):
    """The cameras are told over their own lines, one after the other."""

    kind: Literal["software"]


class ScreenTable(ScreenSettings):
    """A modulator that is a monitor."""

    kind: Literal["screen"]
    lookup_table: Annotated[str, Field(min_length=1)] | None = None
    """File of grey values; without one, 256 grey values are one wave."""


class ExternalModulatorTable(TomlTable):
    """The controller shows the pages, and says so over gRPC."""

    kind: Literal["external"]


class SimulatedTable(TomlTable):
    """The modulator, or the shutters, of a simulated device."""

    kind: Literal["simulated"]
    address: Annotated[str, Field(min_length=1)]
    """Its Unix socket; as all paths here, relative to the folder of this file."""


class NoModulatorTable(TomlTable):
    """Something else shows pages and knows nothing of shots: a page stands for as long as it is photographed."""

    kind: Literal["none"] = "none"


class ShuttersTable(TomlTable):
    """Shutters in both beams, on channels of the pulse generator."""

    kind: Literal["shutters"]
    signal: Shutter
    reference: Shutter


class ExternalBeamsTable(StrictTable):
    """The controller moves the shutters, and says so over gRPC."""

    kind: Literal["external"]
    timeout_s: Annotated[float, Field(gt=0, le=600, allow_inf_nan=False)] = 10.0


class OperatorTable(TomlTable):
    """Somebody blocks the beams by hand when `lightpage record` asks."""

    kind: Literal["operator"] = "operator"


class DeviceTable(StrictTable):
    """The whole file.

    Attributes:
        profile: nominal device: a shipped name, or a file.
        levels: M of the pages, where no page file says it.
        pages: file of pages to show, or None: some are uploaded, or named with the source.
        in_phase, quadrature: the cameras.
        trigger: what fires them.
        modulator: what shows the pages.
        beams: what blocks signal and reference.
        pairing, exposures: how frames are taken and told apart.
    """

    profile: str
    levels: Annotated[int, Field(ge=MIN_LEVELS, le=MAX_LEVELS)] | None = None
    pages: str | None = None
    in_phase: AnyCameraTable
    quadrature: AnyCameraTable
    trigger: Annotated[PulseGeneratorTable | SoftwareTriggerTable | PluginTable, Field(discriminator="kind")]
    modulator: Annotated[
        ScreenTable | ExternalModulatorTable | SimulatedTable | NoModulatorTable | PluginTable,
        Field(discriminator="kind"),
    ] = NoModulatorTable()
    beams: Annotated[
        ShuttersTable | ExternalBeamsTable | SimulatedTable | OperatorTable, Field(discriminator="kind")
    ] = OperatorTable()
    pairing: PairingSettings = PairingSettings()
    exposures: Exposures = Exposures()

    @model_validator(mode="after")
    def _two_cameras(self) -> Self:
        for key in ("serial", "address"):
            first, second = (getattr(table, key, None) for table in (self.in_phase, self.quadrature))
            if first is not None and first == second:
                raise ValueError(f"{key} {first} for in_phase and for quadrature, wanted two cameras")
        return self

    @model_validator(mode="after")
    def _shutters_on_spare_channels(self) -> Self:
        if not isinstance(self.beams, ShuttersTable):
            return self
        if not isinstance(self.trigger, PulseGeneratorTable):
            raise ValueError('beams: shutters without a pulse generator, wanted trigger kind = "pulse_generator"')
        signal, reference = self.beams.signal.channel, self.beams.reference.channel
        for beam, channel in (("signal", signal), ("reference", reference)):
            if channel in self.trigger.channels:
                others = f"none of the cameras' ({', '.join(map(str, self.trigger.channels))})"
                raise ValueError(f"beams.{beam}.channel = {channel}, wanted {others}")
        if signal == reference:
            raise ValueError(f"beams: channel {signal} for both shutters, wanted two")
        return self


def load_device_table(path: Path) -> DeviceTable:
    """Read and check the file.

    Raises:
        InvalidInputError: it cannot be read, or a key does not validate.
    """
    subject = f"camera configuration {path}"
    data = read_toml(path, subject, "a TOML file that can be read")
    try:
        return DeviceTable.model_validate(data)
    except ValidationError as error:
        raise _told(subject, problems_of(DeviceTable, error)) from None


def _told(subject: str, problems: list[Problem]) -> InvalidInputError:
    """The error of a file with mistakes, of which a single one stands for itself."""
    if len(problems) == 1:
        place, got, expected = problems[0].parted()
        return InvalidInputError(f"{subject}: {place}" if place else subject, got, f"{expected} ({KEYS})")
    parts = (problem.parted() for problem in problems)
    told = (f"{place}: {got} (wanted {expected})".removeprefix(": ") for place, got, expected in parts)
    return InvalidInputError(subject, f"{len(problems)} mistakes: {'; '.join(told)}", f"what {KEYS}, says")
