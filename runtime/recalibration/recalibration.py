"""Recalibration: re-fit the geometry on known pages, judge it on held-back ones, write a new bundle or refuse."""

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.goodness.verdict import Goodness
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.errors import CalibrationError, FrameError, RecalibrationRefusedError, raised_as
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import hash_frames
from lightpage.runtime.model.bundle.bundle import COARSE, Bundle, npz, shows_page, write_bundle
from lightpage.runtime.model.bundle.manifest import GOLDEN, TABLE, Manifest, Provenance, check_version
from lightpage.runtime.model.decoding.batch_graph import with_proven_batches
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_position import ImagePosition
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.runtime.recalibration.judgement import Verdict, judge, judged_pages
from lightpage.runtime.recalibration.known_pages import KnownPages

_RECALIBRATED = re.compile(r"(.*)\+r(\d+)")

FIT_WORTH, WRITING_WORTH = 20, 1
"""Pages that are decoded in the time of a fit, and of writing the bundle: of a bench device, 0.4 s for a page, 8 s and
0.5 s for these."""

FIT_PAGES = 1
"""Pages that are fitted on: one has thousands of symbols, and another adds less than what drifts between pages."""


@dataclass(frozen=True)
class RefitReport:
    """Figures of a fit; None where the fit does not know them.

    Attributes:
        angle_deg: fitted pipe angle.
        coherence_before: coherence of the pages with the old geometry, 0..1.
        coherence_after: coherence with the new one.
        image: where the image was found before the fit, against the earlier calibration.
        goodness: how well the new geometry explains the light.
    """

    angle_deg: float | None = None
    coherence_before: float | None = None
    coherence_after: float | None = None
    image: ImagePosition | None = None
    goodness: Goodness | None = None


@dataclass(frozen=True)
class RefitResult:
    """A re-fitted device.

    Attributes:
        table: re-traced tensors to feed to the decoder, by input name; those left out stay as they are.
        calibration_toml: the new calibration document.
        report: the fit's own figures.
    """

    table: SamplingTable
    calibration_toml: str
    report: RefitReport


class Refit(Protocol):
    """Re-fits the geometry with the exported twin and re-traces the table."""

    def __call__(self, bundle: Bundle, pages: KnownPages, progress: Progress, decoder: Decoder) -> RefitResult:
        """Fit on all `pages`.

        Raises:
            CalibrationError: the pages fit no geometry within the capture range.
        """


@dataclass(frozen=True)
class RecalibrationOutcome:
    """A new bundle and why it is better: AIR in bits per symbol on held-back pages, decoded as the service does it.

    `pages_lost_before` of these pages the earlier model would not have given out; they count with no bits. `air_limit`
    is the least `air_after` that would have been accepted, see `lightpage.runtime.recalibration.judgement.judge`, and
    `air_standard_error` that of the difference. `rounds` are those of the healing; None where pages were known.
    """

    path: Path
    version: str
    previous_version: str
    report: RefitReport
    air_before: float
    air_after: float
    pages_lost_before: int
    pages_used: int
    pages_held_back: int
    seconds: float
    air_limit: float
    air_standard_error: float
    rounds: int | None = None


def recalibrate(
    decoder: Decoder,
    pages: KnownPages,
    out: Path,
    version: str,
    fit: Refit,
    progress: Progress,
    tracker: Tracker | None = None,
) -> RecalibrationOutcome:
    """Fit on the first pages, judge on the others, and write a new bundle to `out` if it is not worse.

    Args:
        decoder: the model in service; it is not touched.
        pages: pages with known symbols, at least two.
        out: a new path, a zip where it ends in .zip.
        version: version of the new bundle.
        fit: how to fit.
        progress: told of every step, and within it of every page.
        tracker: follows the image for the model in service. It is forked, so learns nothing here. By default one that
            has seen no page yet.

    Raises:
        RecalibrationRefusedError: the pages do not fit, or the new model would decode the held-back pages worse.
        InvalidInputError, FrameError, PageError: unusable pages.
        BundleError: `version` is none, or `out` cannot be written.
    """
    start = time.perf_counter()
    check_version(version, "version of the new bundle")
    pages.check(decoder)
    fitted_count = min(max(FIT_PAGES, pages.fitted_count), len(pages.pairs) - 1)
    fitted, held_back = pages.part(slice(fitted_count)), pages.part(slice(fitted_count, None))
    tracker = tracker_for(decoder) if tracker is None else tracker.fork()
    judged_count = len(held_back.pairs)
    whole = 2 * judged_count + FIT_WORTH + WRITING_WORTH
    """Work of all steps, in pages that are decoded."""

    def within(start: int, end: int, step: str, share: float) -> None:
        progress(step, (start + (end - start) * share) / whole)

    measuring = partial(within, 0, judged_count, "measure the model in service")
    before = judged_pages(tracker, decoder.bundle, held_back, measuring)
    fitted = replace(fitted, image_px=tracker.image_px)
    with raised_as(RecalibrationRefusedError, CalibrationError, FrameError):
        result = fit(decoder.bundle, fitted, partial(within, judged_count, judged_count + FIT_WORTH), decoder)
        judging = partial(within, judged_count + FIT_WORTH, whole - WRITING_WORTH, "judge by the held-back pages")
        judging(0.0)
        refitted = decoder.of_bundle(refitted_bundle(decoder.bundle, result))
        after = judged_pages(tracker.refitted(refitted), refitted.bundle, held_back, judging)
    verdict = judge(before, after, pages.levels)
    within(whole - WRITING_WORTH, whole, "write the new bundle", 0.0)
    bundle = refitted.bundle
    golden, p = golden_page(refitted, held_back.pairs[0])
    files = {**bundle.files, GOLDEN: npz(in_phase=golden.in_phase, quadrature=golden.quadrature, p=p)}
    bundle = with_proven_batches(replace(bundle, files=files), refitted.graph)
    write_bundle(out, _new_manifest(bundle.manifest, pages, version, verdict), bundle.files)
    return RecalibrationOutcome(
        path=out,
        version=version,
        previous_version=decoder.version,
        report=result.report,
        air_before=verdict.before,
        air_after=verdict.after,
        pages_lost_before=sum(page.lost is not None for page in before),
        pages_used=len(pages.pairs),
        pages_held_back=judged_count,
        seconds=time.perf_counter() - start,
        air_limit=verdict.limit,
        air_standard_error=verdict.error,
    )


def golden_page(decoder: Decoder, pair: FramePair) -> tuple[FramePair, NDArray[np.float32]]:
    """The golden page's frames, in few counts where they still show a page, and the answer to them."""
    manifest = decoder.bundle.manifest
    answer = decoder.infer(pair, alone=True)
    limit = manifest.residual_limit
    for rounded in COARSE:
        coarse = rounded(pair, manifest.camera_bit_depth)
        try:
            to_coarse = decoder.infer(coarse, alone=True)
        except FrameError:
            continue
        if limit is None or shows_page(to_coarse.residual, limit):
            return coarse, to_coarse.p
    return pair, answer.p


def next_version(version: str, taken: Sequence[str] = ()) -> str:
    """The version after this one and all `taken`: ``bench-1`` gives ``bench-1+r1``, and that gives ``bench-1+r2``."""
    parts = [_RECALIBRATED.fullmatch(name) for name in (version, *taken)]
    base = parts[0][1] if parts[0] else version
    last = max((int(part[2]) for part in parts if part and part[1] == base), default=0)
    return f"{base}+r{last + 1}"


def reading_share(pages: int) -> float:
    """Share of a recalibration that is behind once so many pages have been read for it; 0 where none need be."""
    return pages / (pages + 2 * (pages - FIT_PAGES) + FIT_WORTH + WRITING_WORTH) if pages else 0.0


def refitted_bundle(bundle: Bundle, result: RefitResult) -> Bundle:
    """The bundle with the re-fitted table and calibration, in memory; its golden page is still the earlier one's."""
    files = {**bundle.files, TABLE: npz(**{**bundle.table, **result.table})}
    manifest = bundle.manifest.model_copy(update={"calibration": result.calibration_toml})
    return replace(bundle, manifest=manifest, files=files)


def _new_manifest(manifest: Manifest, pages: KnownPages, version: str, verdict: Verdict) -> Manifest:
    """The manifest of a re-fitted bundle."""
    figures = {
        "recalibration_air_bits_per_symbol": verdict.after,
        "recalibration_air_bits_per_symbol_before": verdict.before,
        "recalibration_pages": len(pages.pairs),
    }
    return manifest.model_copy(
        update={
            "version": version,
            "created": datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
            "metrics": {**manifest.metrics, **figures},
            "calibrated_pages": (*manifest.calibrated_pages, *map(hash_frames, pages.pairs)),
            "provenance": Provenance(command=f"recalibrate from {manifest.version}"),
        }
    )
