"""A report's contents from the folder of a finished training run: its validation pages, decoded again."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import nn
from torch.utils.data import Dataset

from lightpage.errors import InvalidInputError, RecordingError
from lightpage.metrics.accumulator import Accumulator
from lightpage.metrics.information import decide
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording, page_hashes
from lightpage.report.contents.data import Golden, Rays, ReportData
from lightpage.report.words import how_long
from lightpage.train.data.feature_store import FeatureStore
from lightpage.train.data.features import PageState
from lightpage.train.data.pages import Page
from lightpage.train.fitting.concentration_scale import decode_pages
from lightpage.train.fitting.curves import Curve, curves_of
from lightpage.train.fitting.fitted import fitted_curves
from lightpage.train.fitting.modules import DecoderTraining, SymbolTraining
from lightpage.train.fitting.validation import without_piston
from lightpage.train.models.network import Refiner, SymbolUNet
from lightpage.train.published.localizers import RayLocalizer
from lightpage.train.published.trainer import published_decoder
from lightpage.train.published.training import FramePages, PublishedChoices, PublishedTraining
from lightpage.train.runs import GOLDEN, REFERENCES, Run, load_arrays, load_decoder, load_run, load_weights

_PHASE_TOLERANCE = 1e-2
"""Of a level: phases are kept in float32, which knows 2 pi to 1e-5 of 256 levels."""


class _Decodable(NamedTuple):
    """What decodes the validation pages as it takes them, and how many parameters the whole decoder has."""

    module: DecoderTraining[Any]
    pages: Dataset[Page]
    parameters: int


def report_of_run(folder: Path, recording_path: Path | None = None) -> ReportData:
    """Decode the validation pages of a run and measure them.

    Args:
        folder: of the run.
        recording_path: that it was trained on; needed for a published decoder, which reads its frames.

    Raises:
        InvalidInputError: no finished run, or one that lacks a part; a recording that is missing or not the run's.
    """
    run, kept = load_run(folder), load_arrays(folder / REFERENCES)
    mask = kept["pilots"]
    with _decodable(folder, run, kept, recording_path) as decodable:
        module = decodable.module
        outputs, phases = decode_pages(module.eval(), decodable.pages)
    levels = levels_of(phases)
    p = np.stack([without_piston(run.kappa_scale * o, t, mask) for o, t in zip(outputs, phases, strict=True)])
    symbols = decide(phases[:, ~mask], levels)
    phase, kappa = np.arctan2(p[:, 1], p[:, 0]), np.hypot(p[:, 0], p[:, 1])[:, ~mask]
    accumulator = Accumulator(levels, ~mask, len(p))
    for page in zip(phase[:, ~mask], kappa, symbols, strict=True):
        accumulator.add(*page)
    golden = load_arrays(folder / GOLDEN)
    return ReportData(
        title=f"Training run on {run.profile.name}",
        pages=f"All figures are of the validation pages of this run ({len(p)}). No weights were fitted to them, but "
        "which weights were kept and how their concentrations are scaled was chosen by them: they are no held-out "
        "test. For that, make the report of an evaluation.",
        facts=_facts(run, decodable.parameters),
        profile=run.profile,
        calibration=run.calibration,
        rays=_rays(run, module),
        measures=accumulator.figures(),
        maps=accumulator.maps(),
        confidence_bins=accumulator.confidence_bins(),
        concentration_bins=accumulator.concentration_bins(),
        curves=_curves(folder, run) or "There are no curves: the run did not keep them for every pass.",
        golden=Golden(FramePair(golden["in_phase"], golden["quadrature"]), phase[0]),
    )


@contextmanager
def _decodable(
    folder: Path, run: Run, kept: dict[str, NDArray[Any]], recording_path: Path | None
) -> Iterator[_Decodable]:
    """The trained decoder and the validation pages, as long as the recording is open."""
    choices = run.hyperparameters
    if recording_path is None:
        if isinstance(choices, PublishedChoices):
            expected = f"the recording of the run: its decoder, {run.localizer}, reads camera frames"
            raise InvalidInputError("--recording", "none", expected)
        yield _at_symbol_pitch(folder, run, kept)
        return
    with Recording.open(recording_path) as recording:
        validation = validation_pages(run, recording)
        if not isinstance(choices, PublishedChoices):
            yield _at_symbol_pitch(folder, run, kept)
            return
        references = FramePair(kept["in_phase"], kept["quadrature"])
        decoder = published_decoder(run.localizer, choices, run.profile, references, run.calibration.turn_rad)
        module = PublishedTraining(load_weights(folder, decoder), choices, kept["pilots"], recording.levels)
        yield _Decodable(module, FramePages(recording, validation, _states(folder, run)), _size(decoder))


def _at_symbol_pitch(folder: Path, run: Run, kept: dict[str, NDArray[Any]]) -> _Decodable:
    first, validated, _ = run.pages
    choices = run.hyperparameters
    assert not isinstance(choices, PublishedChoices)
    try:
        store = FeatureStore(_passes(folder, run)[-1] / "features", range(first, first + validated))
        _ = store[0]
    except (OSError, ValueError, IndexError) as error:
        raise InvalidInputError(f"run {folder}: features", error, "the features that training left there") from None
    decoder = load_decoder(folder, run)
    network = decoder.refiners[-1] if choices.refinements else decoder.network
    assert isinstance(network, SymbolUNet | Refiner)
    size = _size(decoder.network) + _size(decoder.refiners)
    return _Decodable(SymbolTraining(network, choices, kept["pilots"], MAX_LEVELS), store, size)


def _passes(folder: Path, run: Run) -> list[Path]:
    """Folders of all that was trained, one pass behind the other."""
    choices = run.hyperparameters
    again = 0 if isinstance(choices, PublishedChoices) else choices.refinements
    return [folder, *(folder / f"refinement-{number}" for number in range(1, again + 1))]


def _curves(folder: Path, run: Run) -> list[dict[str, Curve]]:
    """Those of each pass; none unless they were kept for all."""
    found = [curves_of(at) or fitted_curves(at) for at in _passes(folder, run)]
    return found if all(found) else []


def _size(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def validation_pages(run: Run, recording: Recording) -> list[int]:
    """Where the validation pages of a run lie in its recording.

    Raises:
        RecordingError: it is not that recording.
    """
    recording.check_against(run.profile)
    subject = f"recording {recording.path}"
    if not recording.has_symbols:
        raise RecordingError(subject, "no symbols", "the recording that the run was trained on")
    expected = run.trained_pages[run.pages[0] :]
    found: dict[str, int] = {}
    for page in range(recording.pages):
        for page_hash in page_hashes(recording.frames(page)):
            found.setdefault(page_hash, page)
        if all(page_hash in found for page_hash in expected):
            return [found[page_hash] for page_hash in expected]
    there = f"{sum(page_hash in found for page_hash in expected)} of {len(expected)} validation pages"
    raise RecordingError(subject, there, "the recording that the run was trained on")


def _states(folder: Path, run: Run) -> list[PageState]:
    path = folder / "states.json"
    try:
        kept = json.loads(path.read_text())["states"][run.pages[0] :]
        return [PageState((s["shift_px"][0], s["shift_px"][1]), s["piston_rad"]) for s in kept]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(f"states {path}", error, "the states of the pages that training left there") from None


def levels_of(phases: NDArray[np.floating]) -> int:
    """The fewest levels that hold all of these phases, radians: M where thousands of symbols were drawn from M.

    Raises:
        InvalidInputError: no level count up to 256 does.
    """
    turns = np.unique(phases).astype(np.float64) / (2 * np.pi)
    for levels in range(MIN_LEVELS, MAX_LEVELS + 1):
        if np.abs(turns * levels - np.rint(turns * levels)).max() < _PHASE_TOLERANCE:
            return levels
    raise InvalidInputError("phases of the validation pages", "no equal steps", f"at most {MAX_LEVELS} levels")


def _rays(run: Run, module: DecoderTraining[Any]) -> Rays:
    localizer = getattr(module.network, "localizer", None)
    if isinstance(localizer, RayLocalizer):
        angle = math.degrees(localizer.angle.item())
        return Rays(angle, "the angle that the decoder was trained to", localizer.tracer.lens, own=True)
    return Rays(run.calibration.angle_deg(run.profile), "the calibrated angle")


def _facts(run: Run, size: int) -> list[tuple[str, str]]:
    choices, (trained, validated, left) = run.hyperparameters, run.pages
    steps = f"{choices.steps:,} steps of {choices.batch} pages"
    if isinstance(choices, PublishedChoices):
        network = "published U-Net of {} and {} channels".format(*choices.channels)
    else:
        network = f"{choices.channels} channels, {choices.blocks} blocks, depth {choices.depth}"
        if choices.refinements:
            again = choices.of_refinement()
            network += f"; {choices.refinements} more with {again.channels} channels, {again.blocks} block"
            steps += f", {again.steps:,} for each further pass,"
    provenance = run.provenance
    return [
        ("Localizer", run.localizer),
        ("Network", f"{network}; {size:,} parameters in all"),
        ("Training pages", f"{trained} recorded, {run.synthetic_pages} synthetic"),
        ("Other pages", f"{validated} for validation, {left} left for an evaluation"),
        ("Training", f"{steps} in {how_long(run.seconds)}"),
        ("Validation AIR in training", f"{run.validation_air:.3f} bit/symbol, before concentrations were scaled"),
        ("Scale of the concentrations", f"{run.kappa_scale:.3f}"),
        ("Trained by", str(provenance.get("command", "")) or "not noted"),
        ("Seed", str(provenance.get("seed", "not noted"))),
        ("Commit", str(provenance.get("commit", "")) or "not noted"),
    ]
