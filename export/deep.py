"""Deep recalibration of a device: its geometry in torch, its network trained on, a new bundle that proves itself."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import islice
from pathlib import Path

import torch

from lightpage.errors import InvalidInputError
from lightpage.export.device_geometry import device_geometry
from lightpage.export.from_run import export_run
from lightpage.progress import Progress
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.run.task import FineTuning
from lightpage.runtime.archives.workers.fine_tuning import DeepRecalibration
from lightpage.runtime.model.bundle.bundle import Bundle, write_bundle
from lightpage.runtime.model.bundle.manifest import BATCH, Manifest, Provenance
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.recalibration.judgement import JudgedPage, Verdict, judge, judged_pages
from lightpage.runtime.recalibration.known_pages import KnownPages, read_recorded
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome, RefitReport, next_version
from lightpage.train.fitting.memory import keep_freed_memory
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.processes import ONE
from lightpage.train.runs import WEIGHTS, load_run, sole_writer
from lightpage.train.trainers.symbols import SymbolTrainer
from lightpage.train.trainers.whole_run import Split, make_run, usable_pages

VALIDATION_SHARE, TEST_SHARE = 0.1, 0.2
"""Of the known pages: those that say which weights are best, and those that the old and the new model are judged by."""

FEWEST_PAGES = 8
"""Of which two are judged by."""

_CALIBRATED_PAGES = 2
_CALIBRATION, _RUN = "calibration.toml", "run"
_WANTED = "the folder of the training run that the device's bundle was made from, `run` in the fleet's file"


class TorchRecalibration:
    """See `lightpage.runtime.archives.workers.fine_tuning.DeepRecalibration`."""

    def check(self, bundle: Path, run: Path | None, pages: int) -> None:
        """See there."""
        if run is None:
            raise InvalidInputError("run", "none", _WANTED)
        if pages < FEWEST_PAGES:
            raise InvalidInputError("known pages", pages, f"at least {FEWEST_PAGES} to train, validate and judge by")
        _choices_of(Bundle.open(bundle), run)

    def recalibrate(
        self,
        decoder: Decoder,
        recording: Recording,
        run: Path,
        folder: Path,
        out: Path,
        choices: FineTuning,
        pages: int,
        progress: Progress,
    ) -> RecalibrationOutcome:
        """See there. The last pages are judged by: neither the fit nor the training has seen them."""
        begun, bundle = time.perf_counter(), decoder.bundle
        _use_threads(decoder.threads)
        localizer, before_it = _choices_of(bundle, run)
        usable = dict(islice(usable_pages(recording).items(), pages))
        if len(usable) < FEWEST_PAGES:
            got, expected = f"{len(usable)} pages that show light", f"at least {FEWEST_PAGES}"
            raise InvalidInputError(f"recording {recording.path}", got, expected)
        split = Split.of(recording, list(usable), VALIDATION_SHARE, TEST_SHARE)
        held_back = read_recorded(recording, split.left)
        held_back.check(decoder)
        progress("measure the model in service", 0.0)
        before = _judged(decoder, held_back)
        folder.mkdir(parents=True, exist_ok=True)
        fitted = split.training[:_CALIBRATED_PAGES]
        calibration = device_geometry(decoder, recording, fitted, folder / _CALIBRATION, progress)
        tuned = replace(before_it, steps=choices.steps, learning_rate=choices.learning_rate, seed=choices.seed)
        trainer = SymbolTrainer(localizer, tuned, choices.synthetic_pages, run)
        with sole_writer(folder / _RUN):
            make_run(folder / _RUN, recording, bundle.profile, trainer, usable, split, lambda: calibration, ONE)
        version, precision = next_version(decoder.version), bundle.manifest.precision
        unproven = out.with_name(f".{out.stem}-tuned{out.suffix}")
        unproven.unlink(missing_ok=True)
        try:
            batches = BATCH in bundle.files
            made, _ = export_run(folder / _RUN, unproven, None, version, progress, precision=precision, batches=batches)
            progress("judge by the held-back pages", 0.0)
            after = _judged(Decoder(made, decoder.threads), held_back)
        finally:
            unproven.unlink(missing_ok=True)
        verdict = judge(before, after, recording.levels, "fine-tuned model")
        hashes = tuple(usable[page] for page in split.left)
        write_bundle(out, _manifest(bundle.manifest, made.manifest, hashes, verdict, choices.seed), made.files)
        return RecalibrationOutcome(
            path=out,
            version=version,
            previous_version=decoder.version,
            report=RefitReport(
                calibration.angle_deg(bundle.profile),
                calibration.coherence_before,
                calibration.coherence_after,
                goodness=calibration.goodness,
            ),
            air_before=verdict.before,
            air_after=verdict.after,
            pages_lost_before=sum(page.lost is not None for page in before),
            pages_used=len(usable),
            pages_held_back=len(split.left),
            seconds=time.perf_counter() - begun,
            air_limit=verdict.limit,
            air_standard_error=verdict.error,
        )


DEEP: DeepRecalibration = TorchRecalibration()
"""What the entry point names."""


def _use_threads(threads: int | None) -> None:
    keep_freed_memory()
    if threads is not None:
        torch.set_num_threads(threads)


def _choices_of(bundle: Bundle, run: Path) -> tuple[str, Hyperparameters]:
    """Localizer and choices of the run that a bundle was made from.

    Raises:
        InvalidInputError: it is no finished run, or was not what the bundle was made from.
    """
    found = load_run(run)
    choices, subject = found.hyperparameters, f"run {run}"
    if not isinstance(choices, Hyperparameters):
        raise InvalidInputError(subject, f"the published decoder {found.localizer}", "a decoder at symbol pitch")
    if not (run / WEIGHTS).is_file():
        raise InvalidInputError(subject, f"no {WEIGHTS}", "a finished run with its weights")
    if found.profile != bundle.profile:
        raise InvalidInputError(subject, f"devices of profile {found.profile.name}", f"those of {bundle.subject}")
    if not set(found.trained_pages) <= set(bundle.manifest.trained_pages):
        raise InvalidInputError(subject, f"pages that {bundle.subject} was not trained on", _WANTED)
    return found.localizer, choices


def _judged(decoder: Decoder, pages: KnownPages) -> list[JudgedPage]:
    """The pages as a service reads them that has just been started."""
    return judged_pages(tracker_for(decoder), decoder.bundle, pages, lambda share: None)


def _manifest(before: Manifest, made: Manifest, judged_by: tuple[str, ...], verdict: Verdict, seed: int) -> Manifest:
    """The manifest of the new bundle, which remembers what the one in service was made of, and its code."""
    figures = {
        "recalibration_air_bits_per_symbol": verdict.after,
        "recalibration_air_bits_per_symbol_before": verdict.before,
        "recalibration_pages": len(made.trained_pages) + len(judged_by),
    }
    calibrated = dict.fromkeys((*before.calibrated_pages, *made.calibrated_pages, *judged_by))
    return made.model_copy(
        update={
            "name": before.name,
            "metrics": {**made.metrics, **figures},
            "code": before.code,
            "calibrated_pages": tuple(calibrated),
            "trained_pages": tuple(dict.fromkeys((*before.trained_pages, *made.trained_pages))),
            "provenance": Provenance(
                command=f"recalibrate --deep from {before.version}", seed=seed, commit=made.provenance.commit
            ),
        }
    )
