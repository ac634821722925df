"""The TOML file that says how a device's cameras, trigger, modulator and shutters are wired: `camera:CONFIG.toml`."""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, Tag, ValidationError, model_validator

from lightpage.device.problems import Problem, problems_of
from lightpage.device.profile import StrictTable
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

KEYS = "reference/camera-keys, a page of the site that `make site` builds"
"""Page that lists the keys, in words of an error."""


class CameraTable(View, CameraSettings):
    """A camera, and its view of the image."""

    kind: Literal["genicam"] = "genicam"
    """A camera that Lightpage drives."""


class PluginTable(StrictTable):
    """A device by a driver that another package brings, an entry point."""

    kind: Literal["plugin"]
    """A driver of another package."""
    driver: Annotated[str, Field(min_length=1)]
    """Name of the driver among the entry points."""
    options: dict[str, Any] = {}  # noqa: RUF012  # pydantic copies it
    """A table that is handed to the driver."""


class PluginCameraTable(View, PluginTable):
    """A camera by a driver of another package, and its view of the image."""


def _kind_of_camera(table: object) -> object:
    return table.get("kind", "genicam") if isinstance(table, dict) else getattr(table, "kind", "genicam")


AnyCameraTable = Annotated[
    Annotated[CameraTable, Tag("genicam")] | Annotated[PluginCameraTable, Tag("plugin")], Discriminator(_kind_of_camera)
]


class PulseGeneratorTable(PulseGeneratorSettings):
    """A pulse generator with one channel for each camera."""

    kind: Literal["pulse_generator"]
    """A pulse generator with a channel for each camera."""


class SoftwareTriggerTable(StrictTable):
    """The cameras are told over their own lines, one after the other."""

    kind: Literal["software"]
    """A command to each camera, one after the other. Both need `trigger_source = "Software"`."""


class ScreenTable(ScreenSettings):
    """A modulator that is a monitor."""

    kind: Literal["screen"]
    """A monitor of an X server."""
    lookup_table: Annotated[str, Field(min_length=1)] | None = None
    """File of grey values. Without it 256 grey values are one wave."""


class ExternalModulatorTable(StrictTable):
    """The controller shows the pages, and says so over gRPC."""

    kind: Literal["external"]
    """The controller shows the pages, and says so over gRPC."""


class SimulatedTable(StrictTable):
    """The modulator, or the shutters, of a simulated device."""

    kind: Literal["simulated"]
    """Part of a simulated device."""
    address: Annotated[str, Field(min_length=1)]
    """Unix socket of the simulated device."""


class NoModulatorTable(StrictTable):
    """Something else shows pages and knows nothing of shots: a page stands for as long as it is photographed."""

    kind: Literal["none"] = "none"
    """Something else shows the pages."""


class ShuttersTable(StrictTable):
    """Shutters in both beams, on channels of the pulse generator."""

    kind: Literal["shutters"]
    """Shutters on channels of the pulse generator."""
    signal: Shutter
    """Shutter of the signal beam."""
    reference: Shutter
    """Shutter of the reference beam, with the keys of `signal`."""


class ExternalBeamsTable(StrictTable):
    """The controller moves the shutters, and says so over gRPC."""

    kind: Literal["external"]
    """The controller moves the shutters, and says so over gRPC."""
    timeout_s: Annotated[float, Field(gt=0, le=600, allow_inf_nan=False)] = 10.0
    """Longest wait for the controller."""


class OperatorTable(StrictTable):
    """Somebody blocks the beams by hand when `lightpage record` asks."""

    kind: Literal["operator"] = "operator"
    """`record` asks you to block the beams."""


class DeviceTable(StrictTable):
    """The file of a device, with a table for each of its parts."""

    profile: str
    """Nominal device: a shipped name, or a file."""
    levels: Annotated[int, Field(ge=MIN_LEVELS, le=MAX_LEVELS)] | None = None
    """Number of levels of the pages, where no file of pages says it."""
    pages: str | None = None
    """File of pages to show. `--symbols` and `--pages` override it."""
    in_phase: AnyCameraTable
    """The in-phase camera."""
    quadrature: AnyCameraTable
    """The quadrature camera, with the keys of `in_phase`."""
    trigger: Annotated[PulseGeneratorTable | SoftwareTriggerTable | PluginTable, Field(discriminator="kind")]
    """Trigger of both cameras."""
    modulator: Annotated[
        ScreenTable | ExternalModulatorTable | SimulatedTable | NoModulatorTable | PluginTable,
        Field(discriminator="kind"),
    ] = NoModulatorTable()
    """Display of the pages."""
    beams: Annotated[
        ShuttersTable | ExternalBeamsTable | SimulatedTable | OperatorTable, Field(discriminator="kind")
    ] = OperatorTable()
    """Shutters of both beams, for dark and reference frames."""
    pairing: PairingSettings = PairingSettings()
    """Tolerances that tell frames of one shot from others."""
    exposures: Exposures = Exposures()
    """Numbers and times of exposures."""

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
    return InvalidInputError(subject, f"{len(problems)} mistakes: {'; '.join(told)}", f"what {KEYS}, lists")
