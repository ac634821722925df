"""Presets trained on the light that published decoders of a study are trained on, and judged as in service."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lightpage.calibration.document import Calibration, load_calibration
from lightpage.codec.choose import FEWEST_PAGES
from lightpage.errors import InvalidInputError
from lightpage.export.from_run import export_run
from lightpage.metrics.information import page_kilobytes
from lightpage.progress import Progress, reporting
from lightpage.recording.reader import Recording
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.archives.recordings.coded_pages import choose_code
from lightpage.runtime.archives.recordings.evaluation import evaluate
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.study.lights import DataSet
from lightpage.study.study import Result, Settings
from lightpage.study.trained import curves_in, split
from lightpage.train.models.presets import PRESETS
from lightpage.train.processes import Processes
from lightpage.train.published.held_pages import MadePages
from lightpage.train.trainers.calibration import calibrate_recording
from lightpage.train.trainers.symbols import SymbolTrainer
from lightpage.train.trainers.whole_run import Split, make_run, usable_pages

TRAINING_PAGES = 148
"""Pages to train on: as many as the shipped decoders learnt from, a third of what the published ones have."""
_CALIBRATED = 2


def preset_trained(
    settings: Settings, data_set: DataSet, preset: str, pages: int, work: Path, progress: Progress
) -> Result:
    """Calibrate, train, export and evaluate a preset on a data set, with the pages that published decoders hold out.

    Args:
        settings: settings of the study.
        data_set: device to train on.
        preset: name out of `PRESETS`.
        pages: number of pages to train on.
        work: folder of the case.
        progress: told of the steps.

    Returns:
        See `lightpage.study.trained.trained`; the angle is the calibration's, and user bytes those of `lightpage code`.
    """
    lights, (training, validation, unseen) = settings.lights, split_for(settings, pages)
    end = max(*training, unseen[-1]) + 1
    path, run, bundle = work / "recording.h5", work / "run", work / "bundle.zip"
    choices = PRESETS[preset].choices
    choices = replace(choices, seed=settings.seed, steps=max(2, round(settings.share * choices.steps)))
    if settings.quick:
        choices = replace(choices, channels=8, blocks=1, steps=12)
    run.mkdir(exist_ok=True)
    with reporting(None):  # the case's own progress is shown
        progress("record", 0.0)
        if not path.exists():
            made = lights.of(data_set, end, settings.seed, progress)
            _record(path, data_set, made, [*training, *validation, *unseen])
            if end > unseen[-1] + 1:
                del made
                lights.release()  # published decoders have no use for so many
        with Recording.open(path) as recording:
            progress("calibrate and train", 0.2)
            usable = usable_pages(recording)
            trained, validated = len(training), len(training) + len(validation)
            numbers = list(usable)
            shares = len(validation) / recording.pages, len(unseen) / recording.pages
            chosen = Split(numbers[:trained], numbers[trained:validated], numbers[validated:], *shares)
            trainer = SymbolTrainer(PRESETS[preset].localizer, choices, 0, None)
            processes = Processes(1, compute=lights.compute)
            calibration = _calibrated(work / "calibration.toml", recording, data_set, processes)
            make_run(run, recording, data_set.profile, trainer, usable, chosen, lambda: calibration, processes)
            progress("export", 0.8)
            if not bundle.exists():
                export_run(run, bundle)
            progress("evaluate", 0.9)
            decoder = Decoder.load(bundle)
            found = evaluate(decoder, recording, tracker_for(decoder))
            user_bytes = _user_bytes(decoder, recording, len(unseen) - len(found.refused))
    air, own = found.figures.air_bits_per_symbol, found.figures.own_mi_bits_per_symbol
    air_kb, own_kb = (page_kilobytes(bits, found.symbols_per_page) for bits in (air, own))
    path.unlink()
    return {
        "air": air,
        "own_mi": own,
        "own_mi_claimed": own,
        "air_kB": air_kb,
        "own_mi_kB": own_kb,
        "own_mi_claimed_kB": own_kb,
        "user_bytes": user_bytes,
        "ece": found.figures.ece,
        "refused": len(found.refused),
        "steps": choices.steps,
        "angle_deg": calibration.angle_deg(data_set.profile),
        "air_map": found.maps.air,
        "own_mi_map": found.maps.own_mi,
        "error_map": found.maps.error_rad,
        **curves_in(run),
    }


def split_for(settings: Settings, pages: int) -> tuple[list[int], range, range]:
    """Numbers of so many pages to train on, and of those to validate with and to judge by, as published ones have them.

    Where those before the held-out ones are not enough, others behind follow.
    """
    first, validation, unseen = split(settings)
    more = range(unseen.stop, unseen.stop + max(0, pages - len(first)))
    return list(first if settings.quick else [*first, *more][:pages]), validation, unseen


def _record(path: Path, data_set: DataSet, made: MadePages, pages: list[int]) -> None:
    bits = data_set.device.sensor.bit_depth
    with RecordingWriter(path, data_set.profile, data_set.levels, bits, made.references) as writer:
        for page in pages:
            writer.append(made.symbols[page], made.pair(page))


def _calibrated(path: Path, recording: Recording, data_set: DataSet, processes: Processes) -> Calibration:
    """Return the calibration that is kept there, made if it is not: made again, it would differ in a last digit."""
    if not path.exists():
        pages, quiet = range(_CALIBRATED), lambda *_: None
        calibrate_recording(recording, data_set.profile, pages, quiet, compute=processes.device).save(path)
    return load_calibration(path)


def _user_bytes(decoder: Decoder, recording: Recording, unseen: int) -> float:
    """Return 0 where no code carries the pages, and no number where they are too few to say."""
    if unseen < FEWEST_PAGES:
        return float("nan")
    try:
        return float(choose_code(decoder, recording, tracker_for(decoder))[0].user_bytes)
    except InvalidInputError:
        return 0.0
