"""The command `lightpage train`: a recording and a calibration to a trained decoder."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.document import Calibration, load_calibration
from lightpage.calibration.known_pages import known_pages, lit_pages
from lightpage.cli.options import FiniteRange
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.cli.progress_bar import percent_bar
from lightpage.device.profile import Profile, load_profile
from lightpage.errors import InvalidInputError, RecordingError
from lightpage.files import write_json
from lightpage.page.symbols import pilot_mask, pilot_symbols, symbol_phases
from lightpage.progress import warn
from lightpage.recording.reader import Recording, hash_frames
from train.commands.calibrate import DEFAULT_PAGES, calibrate_recording
from train.commands.options import chosen_localizer, chosen_trainer, given_choices, with_choices
from train.data.features import FeatureExtractor
from train.data.training_inputs import TrainingInputs
from train.fitting.memory import keep_freed_memory
from train.fitting.provenance import provenance
from train.models.decoder import LOCALIZERS
from train.models.hyperparameters import Hyperparameters
from train.processes import is_first_process
from train.published.localizers import NAMES as PUBLISHED
from train.runs import (
    DESCRIPTION,
    GOLDEN,
    REFERENCES,
    Run,
    begin,
    check_begun,
    load_run,
    save_arrays,
    save_weights,
    sole_writer,
)
from train.trainers.symbols import MATCHED_PAGES, SymbolTrainer

_FEWEST_PAGES = 6
_RECORDED = "--recording (SHA-256 of its frames and symbols)"


@click.command()
@click.option("--profile", "profile_name", required=True, help="Shipped profile or TOML file.")
@click.option("--recording", "recording_path", required=True, type=click.Path(path_type=Path), help="Known pages.")
@click.option(
    "--localizer",
    type=click.Choice([*PUBLISHED, *LOCALIZERS]),
    help="coherent follows rays, wave follows waves; none, mode and ray are the published decoders, with their network "
    "and way of training. [default: the preset's]",
)
@click.option("--out", required=True, type=OutputFolder(), help="Folder of the run; resumed if it is there.")
@click.option("--calibration", "calibration_path", type=click.Path(path_type=Path), help="Made here if left out.")
@click.option(
    "--validation-share",
    type=FiniteRange(0.01, 0.5),
    default=0.08,
    show_default=True,
    help="Share of the pages that training is judged by.",
)
@click.option("--test-share", type=FiniteRange(0, 0.5), default=0.08, show_default=True, help="Left for evaluate.")
@with_choices
@click.option(
    "--devices",
    type=click.IntRange(min=1),
    help="GPUs, or processes without one; all GPUs, or one process, by default.",
)
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def train(
    profile_name: str,
    recording_path: Path,
    localizer: str | None,
    out: Path,
    calibration_path: Path | None,
    validation_share: float,
    test_share: float,
    devices: int | None,
    json_path: Path | None,
    **chosen: Any,
) -> None:
    """Train a decoder on known pages; the last pages of the recording stay unseen for `lightpage evaluate`."""
    keep_freed_memory()
    localizer = chosen_localizer(localizer, chosen["preset"])
    given = given_choices(localizer, chosen)
    context = click.get_current_context()
    context.meta["lightpage.resume"] = "run the same command again; it goes on where it was"
    profile = load_profile(profile_name)
    with Recording.open(recording_path) as recording:
        recording.check_against(profile)
        if not recording.has_symbols:
            raise RecordingError(f"recording {recording_path}", "no dataset 'symbols'", "known symbols to train on")
        context.with_resource(sole_writer(out))
        hashes = _usable(recording)
        groups = _split(recording, list(hashes), validation_share, test_share)
        trainer = chosen_trainer(localizer, profile, len(groups[0]), given)
        references = recording.references()
        options = {
            "--profile": profile.to_toml(),
            _RECORDED: _digest([*hashes.values(), hash_frames(references), _symbols_digest(recording, list(hashes))]),
            "--validation-share": validation_share,
            "--test-share": test_share,
            **trainer.options(),
        }
        check_begun(out, options)
        calibration = _calibration(recording, profile, list(hashes)[:DEFAULT_PAGES], calibration_path, out)
        calibration.check_profile(profile)
        options["calibration"] = calibration.to_toml()
        features = localizer if localizer in LOCALIZERS else LOCALIZERS[0]
        choices = trainer.choices if isinstance(trainer, SymbolTrainer) else Hyperparameters()
        extractor = FeatureExtractor(CalibratedDevice.of(profile, calibration, references), features, choices)
        extractor.check(known_pages(recording, profile, groups[0][:1])[0], calibration.coherence_after)
        begin(out, options)
        if (out / DESCRIPTION).exists():
            _tell(load_run(out), out, json_path)
            return
        mask = recording.pilots()
        mask = pilot_mask(profile) if mask is None else mask
        trained = trainer.train(
            TrainingInputs(
                out=out,
                recording=recording,
                profile=profile,
                calibration=calibration,
                extractor=extractor,
                training=groups[0],
                validation=groups[1],
                pilot_mask=mask,
                key=_digest([options[name] for name in ("--profile", _RECORDED, "calibration")]),
                devices=devices or "auto",
            )
        )
        if not is_first_process():
            return
        known = [*groups[0], *groups[1]]
        save_weights(trained.weights, out)
        own = _own_pilots(recording, profile, mask, known)
        kept = {"in_phase": references.in_phase, "quadrature": references.quadrature, "pilots": mask}
        save_arrays(out / REFERENCES, kept if own is None else kept | {"pilot_phases": own})
        golden = recording.frames(groups[1][0])
        save_arrays(out / GOLDEN, {"in_phase": golden.in_phase, "quadrature": golden.quadrature})
        run = Run(
            localizer=localizer,
            profile_toml=profile.to_toml(),
            calibration_toml=calibration.to_toml(),
            hyperparameters=trainer.choices,
            camera_bit_depth=recording.bit_depth,
            trained_pages=tuple(hashes[page] for page in known),
            validation_air=trained.validation_air,
            kappa_scale=trained.kappa_scale,
            seconds=trained.seconds,
            pages=(len(groups[0]), len(groups[1]), len(groups[2])),
            synthetic_pages=trained.synthetic_pages,
            provenance=provenance() | {"seed": trainer.choices.seed},
        )
        run.save(out)
    _tell(run, out, json_path)


def _tell(run: Run, folder: Path, json_path: Path | None) -> None:
    """The figures of a finished run, for people and, if wanted, for machines."""
    trained, validated, left = run.pages
    if json_path is not None:
        write_json(
            json_path,
            {
                "validation_air_bits_per_symbol": run.validation_air,
                "kappa_scale": run.kappa_scale,
                "training_seconds": run.seconds,
                "pages": {"training": trained, "validation": validated, "left_for_evaluate": left},
                "synthetic_pages": run.synthetic_pages,
                "run": str(folder),
            },
        )
    click.echo(
        f"validation AIR {run.validation_air:.3f} bits/symbol, {trained} recorded and {run.synthetic_pages} synthetic "
        f"pages trained on, {validated} validation pages, {left} left for evaluate, kappa scaled by "
        f"{run.kappa_scale:.3f}, {run.seconds / 60:.1f} min; run in {folder}"
    )


def _usable(recording: Recording) -> dict[int, str]:
    """Hashes of the pages that show light, by page; the others are named and left out."""
    return {page: hash_frames(pair) for page, pair in lit_pages(recording, warn)}


def _symbols_digest(recording: Recording, pages: list[int]) -> str:
    """Of what was written on these pages, of its levels, and of the recording's own pilots if it has any."""
    digest = hashlib.sha256(str(recording.levels).encode())
    for values in (*(recording.symbols(page) for page in pages), recording.pilots()):
        digest.update(b"" if values is None else np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _calibration(recording: Recording, profile: Profile, pages: list[int], path: Path | None, out: Path) -> Calibration:
    """The calibration that was named, or was made of these pages for this run before, or is made of them now."""
    if path is not None:
        return load_calibration(path)
    kept = out / "calibration.toml"
    if kept.exists():
        calibration = load_calibration(kept)
        if calibration.calibrated_pages == tuple(recording.page_hash(page) for page in pages):
            return calibration
    with percent_bar() as progress:
        calibration = calibrate_recording(recording, profile, pages, progress)
    calibration.save(kept)
    return calibration


def _split(
    recording: Recording, usable: list[int], validation_share: float, test_share: float
) -> tuple[list[int], list[int], list[int]]:
    """Usable pages for training, validation and, last, for nobody here."""
    pages = len(usable)
    if pages < _FEWEST_PAGES:
        raise RecordingError(
            f"recording {recording.path}",
            f"{pages} usable pages",
            f"at least {_FEWEST_PAGES} to train, validate and evaluate",
        )
    test = round(pages * test_share) if test_share == 0 else max(1, round(pages * test_share))
    validation = max(1, round(pages * validation_share))
    first = pages - test - validation
    if first < MATCHED_PAGES:
        got = f"{validation} validation and {test} test pages of {pages}"
        raise InvalidInputError("--validation-share and --test-share", got, f"{MATCHED_PAGES} pages left to train on")
    return usable[:first], usable[first : first + validation], usable[first + validation :]


def _own_pilots(
    recording: Recording, profile: Profile, mask: NDArray[np.bool_], pages: list[int]
) -> NDArray[np.float32] | None:
    """Phases of the device's own fixed pilots, [pilots], radians; None where they are those of the profile.

    Says so where there are none: on pages whose symbols are unknown, nothing then shows the piston.
    """
    seen = np.stack([symbols[mask] for page in pages if (symbols := recording.symbols(page)) is not None])
    if np.any(seen != seen[0]):
        click.echo(
            "the symbols at the pilots differ from page to page: without symbols, such pages have no piston", err=True
        )
        return None
    if np.array_equal(seen[0], pilot_symbols(profile, recording.levels)[mask]):
        return None
    return symbol_phases(seen[0], recording.levels).astype(np.float32)


def _digest(parts: list[object]) -> str:
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()
