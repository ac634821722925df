"""The TOML file that says how a device's cameras, trigger, modulator and shutters are wired: `camera:CONFIG.toml`."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, Self
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, ValidationError, model_validator

from lightpage.device.problems import Problem, problems_of
from lightpage.device.profile import Profile, TomlTable, load_profile
from lightpage.errors import InvalidInputError
from lightpage.files import read_text
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS
from lightpage.recording.pages import Pages
from lightpage.runtime.device.acquisition.camera_source import CameraSource, Exposures, View
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.pairing import PairingSettings
from lightpage.runtime.device.cameras.aravis import AravisCamera
from lightpage.runtime.device.cameras.camera import Camera
from lightpage.runtime.device.cameras.gentl import GenTLCamera
from lightpage.runtime.device.cameras.settings import CameraSettings
from lightpage.runtime.device.modulator.beam_state import OperatorBeams
from lightpage.runtime.device.modulator.external import ExternalBeams, ExternalModulator
from lightpage.runtime.device.modulator.lookup_table import linear_table, read_table
from lightpage.runtime.device.modulator.modulator import Beams, Modulator
from lightpage.runtime.device.modulator.screen.raster import ScreenSettings
from lightpage.runtime.device.modulator.screen.screen import ScreenModulator
from lightpage.runtime.device.modulator.shutters import Shutter, ShutterBeams
from lightpage.runtime.device.modulator.simulated import SimulatedModulator
from lightpage.runtime.device.trigger.pulse_generator import PulseGenerator, PulseGeneratorSettings
from lightpage.runtime.device.trigger.trigger import SoftwareTrigger, Trigger

KEYS = "docs/cameras.md, all keys"
"""Where what a file may say is explained."""


class CameraTable(View, CameraSettings):
    """One camera, and how it sees the image."""


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
    """That of a simulated device."""

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


class ExternalBeamsTable(TomlTable):
    """The controller moves the shutters, and says so over gRPC."""

    model_config = ConfigDict(strict=True)

    kind: Literal["external"]
    timeout_s: Annotated[float, Field(gt=0, le=600, allow_inf_nan=False)] = 10.0


class OperatorTable(TomlTable):
    """Somebody blocks the beams by hand when `lightpage record` asks."""

    kind: Literal["operator"] = "operator"


class DeviceTable(TomlTable):
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

    model_config = ConfigDict(strict=True)

    profile: str
    levels: Annotated[int, Field(ge=MIN_LEVELS, le=MAX_LEVELS)] | None = None
    pages: str | None = None
    in_phase: CameraTable
    quadrature: CameraTable
    trigger: Annotated[PulseGeneratorTable | SoftwareTriggerTable, Field(discriminator="kind")]
    modulator: Annotated[
        ScreenTable | ExternalModulatorTable | SimulatedTable | NoModulatorTable, Field(discriminator="kind")
    ] = NoModulatorTable()
    beams: Annotated[
        ShuttersTable | ExternalBeamsTable | SimulatedTable | OperatorTable, Field(discriminator="kind")
    ] = OperatorTable()
    pairing: PairingSettings = PairingSettings()
    exposures: Exposures = Exposures()

    @model_validator(mode="after")
    def _two_cameras(self) -> Self:
        for key in ("serial", "address"):
            first, second = (getattr(table, key) for table in (self.in_phase, self.quadrature))
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
    expected = "a TOML file that can be read"
    try:
        data = tomllib.loads(read_text(path, subject, expected))
    except tomllib.TOMLDecodeError as error:
        raise InvalidInputError(subject, error, expected) from None
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


def _camera(table: CameraTable, folder: Path, profile: Profile, role: str) -> Camera:
    if table.producer is None:
        return AravisCamera(table, profile.frame_shape, role)
    producer = str((folder / table.producer).resolve())
    return GenTLCamera(table.model_copy(update={"producer": producer}), profile.frame_shape, role)


def _trigger(
    table: PulseGeneratorTable | SoftwareTriggerTable, folder: Path, cameras: tuple[Camera, Camera]
) -> Trigger:
    if isinstance(table, SoftwareTriggerTable):
        return SoftwareTrigger(cameras)
    if "://" not in table.port:
        table = table.model_copy(update={"port": str(folder / table.port)})
    return PulseGenerator(table)


def _modulator(table: DeviceTable, folder: Path, profile: Profile, levels: int | None) -> Modulator | None:
    """What shows the pages, of so many levels where that is known yet."""
    match table.modulator:
        case NoModulatorTable():
            return None
        case ExternalModulatorTable():
            return ExternalModulator()
        case SimulatedTable(address=address):
            return SimulatedModulator(folder / address)
        case ScreenTable() as screen:
            return ScreenModulator(screen, profile, _greys(screen, folder, levels))


def _greys(table: ScreenTable, folder: Path, levels: int | None) -> Callable[[int], NDArray[np.uint8]]:
    """What makes a lookup table for the levels of the pages that are shown; tried with those that are known."""
    if table.lookup_table is None:
        return linear_table
    path = folder / table.lookup_table
    if levels is not None:
        read_table(path, levels)
    elif not path.is_file():
        raise InvalidInputError(f"lookup table {path}", "no such file", "a readable text file")
    return partial(read_table, path)


def _beams(table: DeviceTable, folder: Path, trigger: Trigger, ask: Callable[[str], None]) -> Beams:
    match table.beams:
        case OperatorTable():
            return OperatorBeams(ask)
        case ExternalBeamsTable(timeout_s=timeout_s):
            return ExternalBeams(timeout_s)
        case SimulatedTable(address=address):
            return SimulatedModulator(folder / address)
        case ShuttersTable(signal=signal, reference=reference):
            assert isinstance(trigger, PulseGenerator)  # as the table has checked
            return ShutterBeams(trigger, signal, reference)


def open_camera(rest: str) -> CameraSource:
    """The source `camera:REST`, REST being `CONFIG.toml` or `CONFIG.toml?pages=PAGES.h5`. Nothing is connected yet.

    Raises:
        InvalidInputError: a configuration that does not validate, or pages for another device.
    """
    path_text, _, query = rest.partition("?")
    asked = dict(parse_qsl(query, keep_blank_values=True))
    path = Path(path_text)
    table, folder = load_device_table(path), path.parent
    profile_path = folder / table.profile
    profile = load_profile(profile_path if profile_path.is_file() else table.profile)
    if set(asked) - {"pages"}:
        raise InvalidInputError(f"source camera:{rest}", sorted(asked), "pages only")
    named = asked.get("pages") or (None if table.pages is None else str(folder / table.pages))
    store = PageStore(profile, None if named is None else Pages.open(Path(named)), table.levels)
    with ExitStack() as stack:
        stack.callback(store.close)
        cameras = (
            _camera(table.in_phase, folder, profile, "in-phase camera"),
            _camera(table.quadrature, folder, profile, "quadrature camera"),
        )
        trigger = _trigger(table.trigger, folder, cameras)
        source = CameraSource(
            profile,
            cameras,
            trigger,
            _modulator(table, folder, profile, store.levels),
            _beams(table, folder, trigger, lambda text: source.operator(text)),
            store,
            table.pairing,
            table.exposures,
            (table.in_phase, table.quadrature),
            f"camera:{path_text}",
        )
        stack.pop_all()
    return source
