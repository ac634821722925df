"""The main job on the simulated device: it is calibrated, then a picture goes through a service while it drifts.

Two known pages calibrate the device. The picture's bytes are encoded on pages in two groups, and one page is spoilt.
The service reads all pages three times: after the calibration, after a drift that loses them, and after a healing by
the lost pages.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from lightpage.demo.calibration import KNOWN_PAGES, calibrated_decoder, record_known_pages
from lightpage.demo.drift import drift_in_steps, simulated_device
from lightpage.demo.pages import write_pages
from lightpage.demo.picture import picture
from lightpage.demo.reading import read_picture
from lightpage.demo.result import DemoCalibration, DemoResult, Phase
from lightpage.errors import InvalidInputError
from lightpage.progress import Progress
from lightpage.recording.pages import Pages
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.kept_pages import KeptPages
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.models.loader import Loader
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.runtime.service.server.server import LightpageServer

_KEPT_BYTES = 1 << 28
BUNDLE = "device.zip"
"""Name of the calibrated device's bundle."""
_CALIBRATION_SHARE = 0.4
"""Share of the demo's time until the device is calibrated."""
_CALL_S = 600.0
_LIMITS = Limits(deadline_s=_CALL_S, recalibration_s=6 * _CALL_S)
"""Times above a service's own, since the machine may be busy with other things."""


class UserPages(KeptPages):
    """Keeps pages of a device that does not know what it shows, though the simulated one does."""

    def observe(self, observation: Observation) -> None:
        """See `Observer`."""
        super().observe(replace(observation, symbols=None))


def run_demo(
    bundle: Path,
    out: Path,
    seed: int,
    progress: Progress = lambda what, share: None,
    spec: str | None = None,
    *,
    calibrate: bool = True,
) -> DemoResult:
    """Write a picture and read it back in three states of the device, through a client of a service on this machine.

    Args:
        bundle: bundle of the device, or of another one of its profile, whose graphs then calibrate the device.
        out: folder that exists, for recording, bundle, pages and pictures.
        seed: seed of the volume's number and the damage: other pages are written.
        progress: told of every step, with the share of all that is done.
        spec: see `simulated_device`.
        calibrate: whether the device is calibrated first; else the bundle must be its own.

    Raises:
        LightpageError: an unusable bundle, or a healing that the service refuses.
    """
    progress("load the bundle", 0.0)
    decoder = Decoder.load(bundle)
    written = picture()
    volume = None if calibrate else write_pages(decoder, written, out / "pages.h5", seed)
    with ExitStack() as stack:
        source, drift, device = simulated_device(spec, decoder.bundle.profile, known=not calibrate)
        stack.enter_context(source)
        calibrated_s = None
        if volume is None:
            begun = time.perf_counter()
            recording = out / "known.h5"
            record_known_pages(source, decoder, recording, seed)
            (out / BUNDLE).unlink(missing_ok=True)
            decoder = calibrated_decoder(
                decoder,
                recording,
                out / BUNDLE,
                lambda what, share: progress(f"calibrate: {what}", _CALIBRATION_SHARE * share),
            )
            calibrated_s = time.perf_counter() - begun
            volume = write_pages(decoder, written, out / "pages.h5", seed)
        source.show_pages(PageStore(decoder.bundle.profile, Pages.open(out / "pages.h5")))
        kept = UserPages(_KEPT_BYTES)
        plane = DataPlane(Models(decoder, loader=Loader(tracker_for)), source, observers=(kept,), limits=_LIMITS)
        recalibrator = Recalibrator(plane)
        server = stack.enter_context(LightpageServer(plane, recalibrator, "127.0.0.1:0"))
        client = stack.enter_context(LightpageClient(server.target, _CALL_S))
        frames = source.shot(source.shot_s, 0).pair
        levels = decoder.page_codec.code.levels
        begin = _CALIBRATION_SHARE if calibrate else 0.0
        symbols = client.frames.decode(frames, levels).symbols

        def read(name: str, start: float, end: float) -> Phase:
            def told(share: float) -> None:
                progress(name, begin + (1 - begin) * (start + (end - start) * share))

            return read_picture(client, volume, written, out / f"{name.replace(' ', '-')}.pgm", name, told)

        fresh = read("as calibrated", 0.0, 0.25)
        steps = drift_in_steps(client, drift, device, lambda: progress("drift", begin + (1 - begin) * 0.25))
        lost = read("after drift", 0.3, 0.4)
        healed = heal(
            recalibrator,
            kept,
            decoder,
            lambda step, share: progress(f"heal: {step}", begin + (1 - begin) * (0.4 + 0.5 * share)),
        )
        again = read("healed", 0.9, 1.0)
    progress("done", 1.0)
    code = decoder.page_codec.code
    shots = dict(source.shots_by_outcome())
    phases = (fresh, lost, again)
    angle_deg = decoder.bundle.calibration.angle_deg(decoder.bundle.profile)
    calibration = None if calibrated_s is None else DemoCalibration(KNOWN_PAGES, calibrated_s, angle_deg)
    return DemoResult(phases, steps, healed, frames, symbols, code, volume, seed, source.name, shots, calibration)


def heal(recalibrator: Recalibrator, kept: KeptPages, decoder: Decoder, progress: Progress) -> RecalibrationOutcome:
    """Recalibrate by the pages that were lost last, as a service does with `--self-calibrate`.

    Raises:
        RecalibrationRefusedError: too few of them come right.
        InvalidInputError: none was lost.
    """
    pages = recalibrator.kept_pages(kept)
    if pages is None or not kept.enough_for_lost(decoder):
        raise InvalidInputError(
            "demo, after the drift", "no page that was lost", "a device that this drift is too much for"
        )
    for told in recalibrator.follow(pages, Caller()):
        if isinstance(told, RecalibrationOutcome):
            return told
        progress(told.name, told.fraction)
    raise AssertionError("a job ends with its outcome")
