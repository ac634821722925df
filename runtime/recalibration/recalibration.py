"""Recalibration: re-fit the geometry on known pages, judge it on held-back ones, write a new bundle or refuse."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import CalibrationError, FrameError, RecalibrationRefusedError
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import hash_frames
from lightpage.runtime.model.bundle.bundle import Bundle, npz, write_bundle
from lightpage.runtime.model.bundle.golden import in_few_counts, shows_page
from lightpage.runtime.model.bundle.manifest import GOLDEN, TABLE, Manifest, Provenance, check_version
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.runtime.recalibration.judgement import Verdict, judge, judged_pages
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.outcome import RecalibrationOutcome, Refit, RefitResult

_RECALIBRATED = re.compile(r"(.*)\+r(\d+)")

FIT_WORTH, WRITING_WORTH = 20, 1
"""Pages that are decoded in the time of a fit, and of writing the bundle: of a bench device, 0.4 s for a page, 8 s and
0.5 s for these."""

FIT_PAGES = 1
"""Pages that are fitted on: one has thousands of symbols, and another adds less than what drifts between pages."""


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
    fitted_count = min(FIT_PAGES, len(pages.pairs) - 1)
    fitted, held_back = pages.part(slice(fitted_count)), pages.part(slice(fitted_count, None))
    tracker = tracker_for(decoder) if tracker is None else tracker.fork()
    shares = _Shares.of(len(held_back.pairs))
    measuring = partial(_within, progress, "measure the model in service", 0.0, shares.measured)
    before = judged_pages(tracker, decoder.bundle, held_back, measuring)
    fitted = replace(fitted, image_px=tracker.image_px)

    def fitting(step: str, share: float) -> None:
        _within(progress, step, shares.measured, shares.fitted, share)

    try:
        result = fit(decoder.bundle, fitted, fitting, decoder)
        judging = partial(_within, progress, "judge by the held-back pages", shares.fitted, shares.judged)
        judging(0.0)
        refitted = decoder.of_bundle(_refitted(decoder.bundle, result))
        after = judged_pages(tracker.refitted(refitted), decoder.bundle, held_back, judging)
    except (CalibrationError, FrameError) as error:
        raise RecalibrationRefusedError(error.subject, error.got, error.expected) from error
    verdict = judge(before, after, pages.levels)
    progress("write the new bundle", shares.judged)
    bundle = refitted.bundle
    golden, p = _golden(refitted, held_back.pairs[0])
    files = {**bundle.files, GOLDEN: npz(in_phase=golden.in_phase, quadrature=golden.quadrature, p=p)}
    write_bundle(out, _new_manifest(bundle.manifest, pages, version, verdict), files)
    return RecalibrationOutcome(
        path=out,
        version=version,
        previous_version=decoder.version,
        report=result.report,
        air_before=verdict.before,
        air_after=verdict.after,
        pages_lost_before=sum(page.lost is not None for page in before),
        pages_used=len(pages.pairs),
        pages_held_back=len(held_back.pairs),
        seconds=time.perf_counter() - start,
        air_limit=verdict.limit,
        air_standard_error=verdict.error,
    )


def _golden(decoder: Decoder, pair: FramePair) -> tuple[FramePair, NDArray[np.float32]]:
    """The golden page's frames, in few counts where they still show a page, and the answer to them."""
    manifest = decoder.bundle.manifest
    coarse, answer, limit = in_few_counts(pair, manifest.camera_bit_depth), decoder.infer(pair), manifest.residual_limit
    try:
        to_coarse = decoder.infer(coarse)
    except FrameError:
        return pair, answer.p
    if limit is not None and not shows_page(to_coarse.residual, answer.residual, limit):
        return pair, answer.p
    return coarse, to_coarse.p


def next_version(version: str, taken: Sequence[str] = ()) -> str:
    """The version after this one and all `taken`: ``bench-1`` gives ``bench-1+r1``, and that gives ``bench-1+r2``."""
    parts = [_RECALIBRATED.fullmatch(name) for name in (version, *taken)]
    base = parts[0][1] if parts[0] else version
    last = max((int(part[2]) for part in parts if part and part[1] == base), default=0)
    return f"{base}+r{last + 1}"


@dataclass(frozen=True)
class _Shares:
    """Shares of the work that are behind after its steps, in proportion to the time that these take."""

    measured: float
    fitted: float
    judged: float

    @classmethod
    def of(cls, pages: int) -> Self:
        """The shares where so many pages are judged by, twice each."""
        whole = 2 * pages + FIT_WORTH + WRITING_WORTH
        return cls(pages / whole, (pages + FIT_WORTH) / whole, (2 * pages + FIT_WORTH) / whole)


def reading_share(pages: int) -> float:
    """Share of a recalibration that is behind once so many pages have been read for it; 0 where none need be."""
    return pages / (pages + 2 * (pages - FIT_PAGES) + FIT_WORTH + WRITING_WORTH) if pages else 0.0


def _within(progress: Progress, step: str, start: float, end: float, share: float) -> None:
    """Tell of a share of a step that lies between two shares of the work."""
    progress(step, start + (end - start) * share)


def _refitted(bundle: Bundle, result: RefitResult) -> Bundle:
    """The bundle with the re-fitted table and calibration, in memory; its golden page is still the earlier one's."""
    files = {**bundle.files, TABLE: npz(**{**bundle.table, **result.table})}
    manifest = bundle.manifest.model_copy(update={"calibration": result.calibration_toml})
    return replace(bundle, manifest=manifest, files=files)


def _new_manifest(manifest: Manifest, pages: KnownPages, version: str, verdict: Verdict) -> Manifest:
    """The manifest of a re-fitted bundle."""
    figures = {"recalibration_air_bits_per_symbol": verdict.after, "recalibration_pages": len(pages.pairs)}
    if math.isfinite(verdict.before):
        figures["recalibration_air_bits_per_symbol_before"] = verdict.before
    return manifest.model_copy(
        update={
            "version": version,
            "created": datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
            "metrics": {**manifest.metrics, **figures},
            "calibrated_pages": (*manifest.calibrated_pages, *map(hash_frames, pages.pairs)),
            "provenance": Provenance(command=f"recalibrate from {manifest.version}"),
        }
    )
