"""A report's contents from the folder of a finished training run: its validation pages, decoded again."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError
from lightpage.metrics.accumulator import Accumulator
from lightpage.metrics.information import decide
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS, Levels
from lightpage.page.modulation import NOMINAL, Modulation
from lightpage.recording.frame_pair import FramePair
from lightpage.report.contents.data import Golden, Rays, ReportData
from lightpage.report.contents.run_pages import decodable, passes_of
from lightpage.report.words import how_long
from lightpage.train.fitting.concentration_scale import decode_pages
from lightpage.train.fitting.curves import Curve, curves_of
from lightpage.train.fitting.fitted import fitted_curves
from lightpage.train.fitting.modules import DecoderTraining
from lightpage.train.fitting.validation import without_piston
from lightpage.train.published.localizers import RayLocalizer
from lightpage.train.published.training import PublishedChoices
from lightpage.train.runs import GOLDEN, REFERENCES, Run, load_arrays, load_run

_PHASE_TOLERANCE = 1e-2
"""Tolerance of a level's phase: phases are kept in float32, which knows 2 pi to 1e-5 of 256 levels."""


def report_of_run(folder: Path, recording_path: Path | None = None) -> ReportData:
    """Decode the validation pages of a run and measure them.

    Args:
        folder: folder of the run.
        recording_path: recording that it was trained on; needed for a published decoder, which reads its frames.

    Raises:
        InvalidInputError: no finished run, or one that lacks a part; a recording that is missing or not the run's.
    """
    run, kept = load_run(folder), load_arrays(folder / REFERENCES)
    mask = kept["pilots"]
    with decodable(folder, run, kept, recording_path) as decoded:
        module = decoded.module
        outputs, phases = decode_pages(module.eval(), decoded.pages)
    levels = levels_of(phases, run.calibration.modulator)
    pages = zip(run.kappa_scale * outputs, phases, strict=True)
    p = np.stack([without_piston(page, truth, mask, levels) for page, truth in pages])
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
        facts=_facts(run, decoded.parameters),
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


def _curves(folder: Path, run: Run) -> list[dict[str, Curve]]:
    """Return the curves of each pass; none unless they were kept for all."""
    found = [curves_of(at) or fitted_curves(at) for at in passes_of(folder, run)]
    return found if all(found) else []


def levels_of(phases: NDArray[np.floating], modulation: Modulation = NOMINAL) -> Levels:
    """The fewest levels that hold all of these phases, radians: M where thousands of symbols were drawn from M.

    Args:
        phases: phases of light.
        modulation: modulation of the modulator that showed them.

    Raises:
        InvalidInputError: no level count up to 256 does.
    """
    seen = np.unique(phases).astype(np.float64)
    for count in range(MIN_LEVELS, MAX_LEVELS + 1):
        levels = modulation.page_levels(count)
        if np.abs(levels.nearest_phases(seen) - seen).max() < _PHASE_TOLERANCE * 2 * np.pi / count:
            return levels
    raise InvalidInputError("phases of the validation pages", "no levels", f"at most {MAX_LEVELS} levels")


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
