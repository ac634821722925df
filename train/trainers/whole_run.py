"""A whole run: from known pages of a device to the folder that a decoder is exported from."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.document import Calibration
from lightpage.calibration.known_pages import known_pages, lit_pages
from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError, RecordingError
from lightpage.metrics.provenance import command, commit
from lightpage.page.symbols import pilot_mask, pilot_symbols, symbol_phases
from lightpage.progress import note, warn
from lightpage.recording.layout import hash_frames
from lightpage.recording.reader import Recording
from lightpage.run_files import DESCRIPTION
from lightpage.train.data.features import FeatureExtractor
from lightpage.train.data.training_inputs import TrainingInputs
from lightpage.train.models.decoder import LOCALIZERS
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.processes import AS_IT_IS, Processes, is_first_process
from lightpage.train.published.trainer import PublishedTrainer
from lightpage.train.runs import (
    GOLDEN,
    REFERENCES,
    Run,
    begin,
    check_begun,
    load_run,
    save_arrays,
    save_weights,
)
from lightpage.train.trainers.symbols import MATCHED_PAGES, SymbolTrainer

FEWEST_PAGES = 6
"""Fewest pages to train, validate and evaluate with."""

_RECORDED = "--recording (SHA-256 of its frames and symbols)"


@dataclass(frozen=True)
class Split:
    """Numbers of pages for training, for validation, and for nobody here.

    Attributes:
        training, validation, left: page numbers.
        validation_share, test_share: shares of all pages.
    """

    training: list[int]
    validation: list[int]
    left: list[int]
    validation_share: float
    test_share: float

    @classmethod
    def of(cls, recording: Recording, usable: list[int], validation_share: float, test_share: float) -> Self:
        """Split usable pages; those that are left are the last.

        Raises:
            RecordingError: there are too few.
            InvalidInputError: shares that leave too few to train on.
        """
        pages = len(usable)
        if pages < FEWEST_PAGES:
            raise RecordingError(
                f"recording {recording.path}",
                f"{pages} usable pages",
                f"at least {FEWEST_PAGES} to train, validate and evaluate",
            )
        test = round(pages * test_share) if test_share == 0 else max(1, round(pages * test_share))
        validation = max(1, round(pages * validation_share))
        first = pages - test - validation
        if first < MATCHED_PAGES:
            got = f"{validation} validation and {test} test pages of {pages}"
            raise InvalidInputError(
                "--validation-share and --test-share", got, f"{MATCHED_PAGES} pages left to train on"
            )
        last = first + validation
        return cls(usable[:first], usable[first:last], usable[last:], validation_share, test_share)


def usable_pages(recording: Recording) -> dict[int, str]:
    """Hashes of the pages that show light, by page; the others are named and left out."""
    return {page: hash_frames(pair) for page, pair in lit_pages(recording, warn)}


def make_run(
    out: Path,
    recording: Recording,
    profile: Profile,
    trainer: SymbolTrainer | PublishedTrainer,
    usable: dict[int, str],
    split: Split,
    calibrate: Callable[[], Calibration],
    processes: Processes = AS_IT_IS,
) -> Run | None:
    """Train, or go on with, a run whose folder belongs to this command; a finished one is told again.

    Args:
        out: folder of the run.
        recording: open recording with symbols.
        profile: the nominal device.
        trainer: the way of training.
        usable: see `usable_pages`.
        split: split of these pages.
        calibrate: gives the device's calibration; it is called once the options are known to be those of before.
        processes: see `lightpage.train.fitting.fit.fit`.

    Returns:
        The run; None in the processes of further devices.

    Raises:
        InvalidInputError: the folder holds a run that was begun with something else.
        CalibrationError: the calibration is not that of the recording's device.
        KeyboardInterrupt: after Ctrl-C, with nothing lost.
    """
    references = recording.references()
    options = {
        "--profile": profile.to_toml(),
        _RECORDED: _digest([*usable.values(), hash_frames(references), _symbols_digest(recording, list(usable))]),
        "--validation-share": split.validation_share,
        "--test-share": split.test_share,
        **trainer.options(),
    }
    check_begun(out, options)
    calibration = calibrate()
    calibration.check_profile(profile)
    options["calibration"] = calibration.to_toml()
    features = trainer.localizer if trainer.localizer in LOCALIZERS else LOCALIZERS[0]
    choices = trainer.choices if isinstance(trainer, SymbolTrainer) else Hyperparameters()
    extractor = FeatureExtractor(calibration.device(profile, references), features, choices, compute=processes.device)
    extractor.check(known_pages(recording, profile, split.training[:1])[0], calibration.coherence_after)
    begin(out, options) if is_first_process() else check_begun(out, options)
    if (out / DESCRIPTION).exists():
        return load_run(out) if is_first_process() else None
    mask = recording.pilots()
    mask = pilot_mask(profile) if mask is None else mask
    trained = trainer.train(
        TrainingInputs(
            out=out,
            recording=recording,
            profile=profile,
            calibration=calibration,
            extractor=extractor,
            training=split.training,
            validation=split.validation,
            pilot_mask=mask,
            key=_digest([options[name] for name in ("--profile", _RECORDED, "calibration")]),
            processes=processes,
        )
    )
    if not is_first_process():
        return None
    known = [*split.training, *split.validation]
    save_weights(trained.weights, out)
    own = own_pilots(recording, profile, mask, known)
    kept = {"in_phase": references.in_phase, "quadrature": references.quadrature, "pilots": mask}
    save_arrays(out / REFERENCES, kept if own is None else kept | {"pilot_phases": own})
    golden = recording.frames(split.validation[0])
    save_arrays(out / GOLDEN, {"in_phase": golden.in_phase, "quadrature": golden.quadrature})
    run = Run(
        localizer=trainer.localizer,
        profile_toml=profile.to_toml(),
        calibration_toml=calibration.to_toml(),
        hyperparameters=trainer.choices,
        camera_bit_depth=recording.bit_depth,
        trained_pages=tuple(usable[page] for page in known),
        validation_air=trained.validation_air,
        kappa_scale=trained.kappa_scale,
        seconds=trained.seconds,
        pages=(len(split.training), len(split.validation), len(split.left)),
        synthetic_pages=trained.synthetic_pages,
        provenance={"command": command(), "commit": commit(), "seed": trainer.choices.seed},
    )
    run.save(out)
    return run


def _symbols_digest(recording: Recording, pages: list[int]) -> str:
    """Return a digest of the symbols written on these pages, their levels, and the recording's own pilots if any."""
    digest = hashlib.sha256(str(recording.levels).encode())
    for values in (*(recording.symbols(page) for page in pages), recording.pilots()):
        digest.update(b"" if values is None else np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def own_pilots(
    recording: Recording, profile: Profile, mask: NDArray[np.bool_], pages: list[int]
) -> NDArray[np.float32] | None:
    """Phases of the device's own fixed pilots, [pilots], radians; None where they are those of the profile.

    Says so where there are none: on pages whose symbols are unknown, nothing then shows the piston.
    """
    seen = np.stack([symbols[mask] for page in pages if (symbols := recording.symbols(page)) is not None])
    if np.any(seen != seen[0]):
        note("the symbols at the pilots differ from page to page: without symbols, such pages have no piston")
        return None
    if np.array_equal(seen[0], pilot_symbols(profile, recording.levels)[mask]):
        return None
    return symbol_phases(seen[0], recording.levels).astype(np.float32)


def _digest(parts: list[object]) -> str:
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()
