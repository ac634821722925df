"""The main job on the simulated device: a picture goes through a service as bytes, while the device drifts.

Its bytes are encoded on pages in two groups, and one page is spoilt. The service reads them all from the simulated
device: as it was calibrated, after a drift that loses them, and healed by the pages that it lost.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from lightpage.demo.drift import drift_in_steps, simulated_device
from lightpage.demo.pages import write_pages
from lightpage.demo.picture import picture
from lightpage.demo.reading import read_picture
from lightpage.demo.result import DemoResult, Phase
from lightpage.errors import InvalidInputError
from lightpage.progress import Progress
from lightpage.runtime.client.client import LightpageClient
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
) -> DemoResult:
    """Write a picture and read it back in three states of the device, through a client of a service on this machine.

    Args:
        bundle: bundle of the bench device, with a code.
        out: folder that exists, for the pages and the pictures.
        seed: seed of the volume's number and the damage: other pages are written.
        progress: told of every step, with the share of all that is done.
        spec: see `simulated_device`.

    Raises:
        LightpageError: an unusable bundle, or a healing that the service refuses.
    """
    progress("load the bundle", 0.0)
    decoder = Decoder.load(bundle)
    written = picture()
    volume = write_pages(decoder, written, out / "pages.h5", seed)
    with ExitStack() as stack:
        source, drift = simulated_device(spec, decoder.bundle.profile, out / "pages.h5")
        stack.enter_context(source)
        kept = UserPages(_KEPT_BYTES)
        plane = DataPlane(Models(decoder, loader=Loader(tracker_for)), source, observers=(kept,), limits=_LIMITS)
        recalibrator = Recalibrator(plane)
        server = stack.enter_context(LightpageServer(plane, recalibrator, "127.0.0.1:0"))
        client = stack.enter_context(LightpageClient(server.target, _CALL_S))
        frames = source.shot(source.shot_s, 0).pair
        levels = decoder.page_codec.code.levels
        symbols = client.frames.decode(frames, levels).symbols

        def read(name: str, start: float, end: float) -> Phase:
            def told(share: float) -> None:
                progress(name, start + (end - start) * share)

            return read_picture(client, volume, written, out / f"{name.replace(' ', '-')}.pgm", name, told)

        fresh = read("as calibrated", 0.05, 0.25)
        steps = drift_in_steps(client, drift, lambda: progress("drift", 0.25))
        lost = read("after drift", 0.3, 0.5)
        healed = heal(recalibrator, kept, decoder, lambda step, share: progress(f"heal: {step}", 0.5 + 0.3 * share))
        again = read("healed", 0.8, 1.0)
    progress("done", 1.0)
    code = decoder.page_codec.code
    shots = dict(source.shots_by_outcome())
    phases = (fresh, lost, again)
    return DemoResult(phases, steps, healed, frames, symbols, code, volume, seed, source.name, shots)


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
