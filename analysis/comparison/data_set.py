"""The data sets of a comparison: a device with its noise, exposure and symbols, its recording and its calibration."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lightpage.calibration.calibrate import calibrate
from lightpage.calibration.document import Calibration, load_calibration
from lightpage.calibration.known_pages import known_pages
from lightpage.cli.progress_bar import percent_bar
from lightpage.device.profile import Profile, parse_profile
from lightpage.device.state import Device, Sensor
from lightpage.errors import InvalidInputError
from lightpage.export.from_calibration import export_calibration
from lightpage.recording.layout import hash_frames
from lightpage.recording.reader import Recording
from lightpage.run_files import BEGUN
from lightpage.simulator.recording_job import RecordingJob
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.runs import begin
from lightpage.train.trainers.calibration import calibrate_recording

LEVELS = 256
CALIBRATED = 2


def calibrated(profile: Profile, recording: Recording, path: Path) -> Calibration:
    """The calibration from nominal on the recording's first pages, kept in `path`."""
    if not path.exists():
        pages = known_pages(recording, profile, range(CALIBRATED))
        twin, solver = TorchTwin(RayTwin(profile)), TorchFieldSolver(FieldRecovery(profile))
        with percent_bar() as progress:
            fitted = calibrate(twin, solver, profile, recording.references(), pages, progress)
        hashes = [hash_frames(page.pair) for page in pages]
        Calibration.from_registered(fitted, profile, hashes).save(path)
    return load_calibration(path)


def data_set_name(device: Device, symbol_size_px: int, apart: str = "") -> str:
    """Name of the folder of a data set; `apart` says what else sets it apart."""
    geometry, sensor = device.geometry, device.sensor
    dimmed = "" if sensor.exposure_relative == Sensor().exposure_relative else f"-{sensor.exposure_relative:g}x"
    return f"{geometry.pipe_angle_deg:g}deg-{sensor.full_well_e:g}e-{symbol_size_px}px{dimmed}{apart}"


def data_set_of(kept: Path) -> tuple[Profile, Device, int]:
    """Profile, true device and seed of a kept data set.

    Raises:
        InvalidInputError: nothing is kept there.
    """
    try:
        begun = json.loads((kept / BEGUN).read_text())
        profile = parse_profile(begun["--profile"], f"{kept / BEGUN}: profile")
        return profile, Device.model_validate(begun["device"]), int(begun["--seed"])
    except KeyError as error:
        expected = "that of a data set, as analysis/weights has them"
        raise InvalidInputError(f"{kept / BEGUN}", f"no key {error}", expected) from None
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"--kept {kept}", error, f"the folder of a kept data set with its {BEGUN}") from None


def simulate(
    out: Path, profile: Profile, device: Device, pages: int, seed: int, levels: int = LEVELS, *, truth: bool = False
) -> None:
    """Simulate a recording of random symbols; one that is there stays."""
    if not out.exists():
        job = RecordingJob(profile, device, levels, seed, truth, out)
        job.claim(force=False)
        job.run(pages)


def bundle_by_waves(
    folder: Path,
    profile: Profile,
    device: Device,
    pages: int,
    seed: int,
    levels: int = LEVELS,
    near: Path | None = None,
) -> tuple[Path, Path]:
    """Make a bundle of a calibration by two pages; what is there already stays.

    Args:
        folder: folder of recording, calibration and bundle.
        profile: nominal device.
        device: true device.
        pages: pages of the recording after those of the calibration; a code is chosen by them.
        seed: seed of pages and noise.
        levels: levels of the pages.
        near: calibration of the device from which the fit starts; nominal if left out.

    Returns:
        Paths of the recording and of the bundle.
    """
    folder.mkdir(parents=True, exist_ok=True)
    recording = folder / "recording.h5"
    calibration = folder / "calibration.toml"
    bundle = folder / "bundle.zip"
    simulate(recording, profile, device, CALIBRATED + pages, seed, levels)
    with Recording.open(recording) as file, percent_bar() as progress:
        if not calibration.exists():
            start = None if near is None else load_calibration(near)
            calibrate_recording(file, profile, range(CALIBRATED), progress, near=start).save(calibration)
        if not bundle.exists():
            export_calibration(load_calibration(calibration), file, profile, bundle, progress=progress)
    return recording, bundle


@contextmanager
def recorded(
    profile: Profile, device: Device, pages: int, seed: int, folder: Path, levels: int = LEVELS
) -> Iterator[Recording]:
    """The recording of a data set, of so many pages and some to calibrate on before them; made if it is not there."""
    folder.mkdir(parents=True, exist_ok=True)
    begin(folder, {"--profile": profile.to_toml(), "device": device.model_dump(), "--pages": pages, "--seed": seed})
    path = folder / "recording.h5"
    simulate(path, profile, device, CALIBRATED + pages, seed, levels, truth=True)
    with Recording.open(path) as recording:
        yield recording
