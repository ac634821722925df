"""Opens the source `camera:CONFIG.toml`: cameras, trigger, modulator and shutters, as the file says."""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile, load_profile
from lightpage.errors import InvalidInputError
from lightpage.recording.pages import Pages
from lightpage.runtime.device.acquisition.camera_config import (
    CameraTable,
    DeviceTable,
    ExternalBeamsTable,
    ExternalModulatorTable,
    NoModulatorTable,
    OperatorTable,
    PluginCameraTable,
    PluginTable,
    PulseGeneratorTable,
    ScreenTable,
    ShuttersTable,
    SimulatedTable,
    SoftwareTriggerTable,
    load_device_table,
)
from lightpage.runtime.device.acquisition.camera_source import CameraSource
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.cameras.aravis import AravisCamera
from lightpage.runtime.device.cameras.camera import Camera
from lightpage.runtime.device.cameras.gentl import GenTLCamera
from lightpage.runtime.device.modulator.external import ExternalBeams, ExternalModulator
from lightpage.runtime.device.modulator.lookup_table import linear_table, read_table
from lightpage.runtime.device.modulator.modulator import Beams, Modulator, OperatorBeams
from lightpage.runtime.device.modulator.screen.screen import ScreenModulator
from lightpage.runtime.device.modulator.shutters import ShutterBeams
from lightpage.runtime.device.modulator.simulated import SimulatedModulator
from lightpage.runtime.device.plugins import CAMERAS, MODULATORS, TRIGGERS, opened_by_driver
from lightpage.runtime.device.trigger.pulse_generator import PulseGenerator
from lightpage.runtime.device.trigger.trigger import SoftwareTrigger, Trigger


def _camera(table: CameraTable | PluginCameraTable, place: str, folder: Path, profile: Profile, role: str) -> Camera:
    if isinstance(table, PluginCameraTable):
        return opened_by_driver(CAMERAS, table.driver, place, Camera, table.options, profile.frame_shape, role)
    if table.producer is None:
        return AravisCamera(table, profile.frame_shape, role)
    producer = str((folder / table.producer).resolve())
    return GenTLCamera(table.model_copy(update={"producer": producer}), profile.frame_shape, role)


def _trigger(
    table: PulseGeneratorTable | SoftwareTriggerTable | PluginTable,
    place: str,
    folder: Path,
    cameras: tuple[Camera, ...],
) -> Trigger:
    if isinstance(table, PluginTable):
        return opened_by_driver(TRIGGERS, table.driver, place, Trigger, table.options, cameras)
    if isinstance(table, SoftwareTriggerTable):
        return SoftwareTrigger(cameras)
    if "://" not in table.port:
        table = table.model_copy(update={"port": str(folder / table.port)})
    return PulseGenerator(table)


def _modulator(table: DeviceTable, place: str, folder: Path, profile: Profile, levels: int | None) -> Modulator | None:
    """Return what shows the pages, of so many levels where that is known yet."""
    match table.modulator:
        case NoModulatorTable():
            return None
        case ExternalModulatorTable():
            return ExternalModulator()
        case SimulatedTable(address=address):
            return SimulatedModulator(folder / address)
        case ScreenTable() as screen:
            return ScreenModulator(screen, profile, _greys(screen, folder, levels))
        case PluginTable(driver=driver, options=options):
            return opened_by_driver(MODULATORS, driver, place, Modulator, options, profile)


def _greys(table: ScreenTable, folder: Path, levels: int | None) -> Callable[[int], NDArray[np.uint8]]:
    """Return what makes a lookup table for the levels of the pages that are shown; tried with those that are known."""
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
    table, folder, place = load_device_table(path), path.parent, f"camera configuration {path}"
    profile_path = folder / table.profile
    profile = load_profile(profile_path if profile_path.is_file() else table.profile)
    if set(asked) - {"pages"}:
        raise InvalidInputError(f"source camera:{rest}", sorted(asked), "pages only")
    named = asked.get("pages") or (None if table.pages is None else str(folder / table.pages))
    store = PageStore(profile, None if named is None else Pages.open(Path(named)), table.levels)
    with ExitStack() as stack:
        stack.callback(store.close)
        cameras = (
            _camera(table.in_phase, f"{place}: in_phase", folder, profile, "in-phase camera"),
            _camera(table.quadrature, f"{place}: quadrature", folder, profile, "quadrature camera"),
        )
        trigger = _trigger(table.trigger, f"{place}: trigger", folder, cameras)
        source = CameraSource(
            profile,
            cameras,
            trigger,
            _modulator(table, f"{place}: modulator", folder, profile, store.levels),
            _beams(table, folder, trigger, lambda text: source.operator(text)),
            store,
            table.pairing,
            table.exposures,
            (table.in_phase, table.quadrature),
            f"camera:{path_text}",
        )
        stack.pop_all()
    return source
