"""A decoder that one device has taught, kept as it is, and what it reads of others."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np
import torch

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.document import Calibration, load_calibration
from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.metrics.information import achievable_rate
from lightpage.page.correction import PhaseRefit, corrected
from lightpage.page.levels import MAX_LEVELS
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import pilot_mask
from lightpage.progress import reporting
from lightpage.recording.reader import Recording
from lightpage.simulator.recording_job import RecordingJob
from lightpage.study.known import Known
from lightpage.train.data.features import FeatureExtractor
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.presets import PRESETS, STANDARD
from lightpage.train.runs import Run, load_decoder, load_run
from lightpage.train.trainers.symbols import SymbolTrainer
from lightpage.train.trainers.whole_run import Split, make_run, usable_pages

_VALIDATION_SHARE = 0.1


@dataclass(frozen=True)
class Teaching:
    """Amount of training of a decoder.

    Attributes:
        pages: recorded pages.
        synthetic_pages: beside them, of the same device after drifts: they teach what other geometries have in common.
        steps: steps of the optimiser.
    """

    pages: int
    synthetic_pages: int
    steps: int


@dataclass(frozen=True)
class KeptDecoder:
    """A trained decoder whose weights stay, whatever device it reads.

    Attributes:
        run: run of its training.
        decoder: trained.
    """

    run: Run
    decoder: SymbolDecoder

    @classmethod
    def of(cls, folder: Path) -> Self:
        """Read the decoder of a finished run.

        Raises:
            InvalidInputError: there is none.
        """
        run = load_run(folder)
        return cls(run, load_decoder(folder, run))

    def air(self, device: CalibratedDevice, pages: Known) -> float:
        """Measure what is read of known pages, bits a data symbol, with a device's geometry, levels and references.

        Piston, smooth phase errors, flicker and trust come from the pilots, as in service; each page's image shift from
        its symbols, since a service follows it.
        """
        profile, mask = device.profile, pilot_mask(device.profile)
        levels = device.modulation.page_levels(MAX_LEVELS)
        extractor = FeatureExtractor(device, self.run.localizer, self.decoder.choices)
        refit = PhaseRefit(profile.page_shape, extractor.table["positions"])
        shift, rates = np.zeros(2), []
        for pair, symbols in zip(pages.pairs, pages.symbols, strict=True):
            with torch.no_grad():
                shown, shift = extractor.page(extractor.field(pair), levels.phases[symbols], shift)
                light, positions = torch.from_numpy(shown.light).float(), torch.from_numpy(shown.positions)
                p = self.decoder.network(light.flatten(0, 2)[None], positions[None])[0].numpy() * self.run.kappa_scale
            pilots = Pilots.of_symbols(mask, symbols, levels)
            page = corrected(np.arctan2(p[1], p[0]), np.hypot(p[0], p[1]), levels, pilots, refit)
            air = achievable_rate(page.phase[~mask], page.concentration[~mask], symbols[~mask], levels)
            rates.append(air.mean())
        return float(np.mean(rates))


def taught(
    folder: Path,
    profile: Profile,
    device: Device,
    teaching: Teaching,
    seed: int,
    calibration: Callable[[Recording], Calibration],
    start: Path | None = None,
) -> KeptDecoder:
    """Train a decoder of one pass on pages of a simulated device, or go on with it; only its run stays in `folder`.

    Args:
        folder: folder of recording and run.
        profile, device: nominal and true.
        teaching: how much.
        seed: seed of pages and training.
        calibration: calibration of the device.
        start: finished run whose weights are begun with.

    Raises:
        CalibrationError: the calibration does not explain the pages.
    """
    run, path = folder / "run", folder / "recording.h5"
    preset = PRESETS[STANDARD]
    choices = replace(preset.choices, steps=teaching.steps, seed=seed)
    trainer = SymbolTrainer(preset.localizer, choices, teaching.synthetic_pages, start)
    run.mkdir(parents=True, exist_ok=True)
    with reporting(None):  # the case's own progress is shown
        job = RecordingJob(profile, device, MAX_LEVELS, seed, truth=False, out=path)
        if not path.exists():
            job.claim(force=True)
            job.run(teaching.pages)
        kept = partial(_kept, folder / "calibration.toml", calibrate=calibration)
        with Recording.open(path) as recording:
            usable = usable_pages(recording)
            split = Split.of(recording, list(usable), _VALIDATION_SHARE, 0.0)
            make_run(run, recording, profile, trainer, usable, split, lambda: kept(recording))
    path.unlink()
    for features in ("features", "synthetic", "checkpoints"):
        shutil.rmtree(run / features, ignore_errors=True)
    return KeptDecoder.of(run)


def _kept(path: Path, recording: Recording, calibrate: Callable[[Recording], Calibration]) -> Calibration:
    """The calibration that is kept there; made and kept if it is not: made again, it would differ in a last digit."""
    if not path.exists():
        calibrate(recording).save(path)
    return load_calibration(path)
