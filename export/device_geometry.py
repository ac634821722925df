"""The geometry of a device, found in torch by known pages of it."""

from __future__ import annotations

from pathlib import Path

from lightpage.calibration.calibrate import calibrate
from lightpage.calibration.document import Calibration, load_calibration, parse_calibration
from lightpage.calibration.known_pages import known_pages
from lightpage.errors import CalibrationError
from lightpage.progress import Progress, note
from lightpage.recording.reader import Recording
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.known_pages import read_recorded
from lightpage.runtime.recalibration.refit import check_as_good, refit
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.twin import RayTwin, TorchTwin


def device_geometry(
    decoder: Decoder, recording: Recording, pages: list[int], kept: Path, progress: Progress
) -> Calibration:
    """The device's geometry by these pages: kept from before, near the bundle's, or else found from nominal.

    Raises:
        CalibrationError: the pages fit no geometry, or a wrong one where the bundle's is not.
    """
    hashes = tuple(recording.page_hash(page) for page in pages)
    if kept.exists() and (before := load_calibration(kept)).calibrated_pages[-len(hashes) :] == hashes:
        return before
    profile = decoder.bundle.profile
    twin, solve_field = TorchTwin(RayTwin(profile)), TorchFieldSolver(FieldRecovery(profile))
    try:
        near = refit(decoder.bundle, read_recorded(recording, pages), progress, decoder, twin, solve_field)
        found = parse_calibration(near.calibration_toml)
    except CalibrationError as error:
        note(f"{error}; calibrating from nominal")
        known = known_pages(recording, profile, pages)
        anew = calibrate(twin, solve_field, profile, recording.references(), known, progress)
        found = Calibration.from_registered(anew, profile, hashes)
        check_as_good(decoder.bundle.calibration, found)
    found.save(kept)
    return found
