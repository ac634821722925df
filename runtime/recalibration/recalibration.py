"""Recalibration: re-fit the geometry on known pages, judge it on held-back ones, write a new bundle or refuse."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import CalibrationError, FrameError, InvalidInputError, RecalibrationRefusedError
from lightpage.metrics.information import measure
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import check_symbols
from lightpage.progress import Progress
from lightpage.recording.reader import FramePair, hash_frames
from runtime.bundle.bundle import Bundle, Table, npz, write_bundle
from runtime.bundle.manifest import GOLDEN, TABLE, Manifest, Provenance, check_version
from runtime.decoding.decoder import Decoder
from runtime.decoding.frames import named
from runtime.decoding.image_tracker import tracker_for
from runtime.decoding.page import ImagePosition
from runtime.decoding.tracking import Tracker, unconfirmed_page
from runtime.errors import LostPageError, UnconfirmedPageError

_RECALIBRATED = re.compile(r"(.*)\+r(\d+)")

FIT_PAGES = 1
"""Pages that are fitted on: one has thousands of symbols, and another adds less than what drifts between pages."""

MIN_PAGES = 2
"""One to fit on, one to judge by."""

MIN_AIR_SHARE = 0.02
"""Share of log2 M below which a held-back page does not match its symbols at all: wrong pilots, wrong device."""

TOLERATED_LOSS_BITS = 0.01
"""AIR that a re-fit may lose to the noise of a few held-back pages and still replace an equally good model."""


@dataclass(frozen=True)
class KnownPages:
    """Pages whose symbols are known.

    Attributes:
        pairs: frame pairs, one a page.
        symbols: what was written, uint8 [ny, nx], one a page.
        levels: M of those symbols.
        references: reference-only frames taken with them, or None: then those of the last recalibration hold.
        pilot_mask: where the pilots are, bool [ny, nx], or None for the device's usual positions.
        image_px: where the image was last seen against the model's calibration, (x, y), camera pixels.
    """

    pairs: tuple[FramePair, ...]
    symbols: tuple[NDArray[np.uint8], ...]
    levels: int
    references: FramePair | None = None
    pilot_mask: NDArray[np.bool_] | None = None
    image_px: tuple[float, float] = (0.0, 0.0)

    def check(self, decoder: Decoder) -> None:
        """Check everything against the device of `decoder`.

        Raises:
            InvalidInputError: too few pages, not as many symbols as frames, or the same page twice.
            FrameError: a bad frame.
            PageError: symbols of the wrong shape or range.
        """
        if len(self.pairs) < MIN_PAGES or len(self.pairs) != len(self.symbols):
            got = f"{len(self.pairs)} frame pairs and {len(self.symbols)} pages of symbols"
            raise InvalidInputError("pages to recalibrate with", got, f"at least {MIN_PAGES} of both")
        for number, (pair, symbols) in enumerate(zip(self.pairs, self.symbols, strict=True)):
            with named(f"known page {number}: "):
                decoder.check(pair)
            check_symbols(symbols, decoder.bundle.profile.page_shape, self.levels, f"known page {number}: symbols")
        if self.references is not None:
            with named("reference: "):
                decoder.check(self.references)
        self._check_different()

    def _check_different(self) -> None:
        """A re-fit judged by a page that it was fitted on would praise itself."""
        first: dict[str, int] = {}
        for number, pair in enumerate(self.pairs):
            earlier = first.setdefault(hash_frames(pair), number)
            if earlier != number:
                raise InvalidInputError(
                    f"known page {number}", f"the frames of known page {earlier}", "pages that differ: one is judged by"
                )

    def part(self, pages: slice) -> KnownPages:
        """Some of the pages, the rest as it is."""
        return replace(self, pairs=self.pairs[pages], symbols=self.symbols[pages])


@dataclass(frozen=True)
class FitReport:
    """What a fit says of itself; None where it does not know.

    Attributes:
        angle_deg: fitted pipe angle.
        coherence_before: of the pages with the old geometry, 0..1.
        coherence_after: with the new one.
        details: further numbers for people.
        image: where the image was found before the fit, against the earlier calibration.
    """

    angle_deg: float | None = None
    coherence_before: float | None = None
    coherence_after: float | None = None
    details: dict[str, float] = field(default_factory=dict)
    image: ImagePosition | None = None


@dataclass(frozen=True)
class FitResult:
    """A re-fitted device.

    Attributes:
        table: re-traced tensors to feed to the decoder, by input name; those left out stay as they are.
        calibration_toml: the new calibration document.
        report: the fit's own figures.
    """

    table: Table
    calibration_toml: str
    report: FitReport


class Fit(Protocol):
    """Re-fits the geometry with the exported twin and re-traces the table."""

    def __call__(self, bundle: Bundle, pages: KnownPages, progress: Progress, decoder: Decoder) -> FitResult:
        """Fit on all `pages`.

        Raises:
            CalibrationError: the pages fit no geometry within the capture range.
        """


@dataclass(frozen=True)
class RecalibrationOutcome:
    """A new bundle and why it is better: AIR in bits per symbol on held-back pages, decoded as the service does it.

    `pages_lost_before` of these pages the earlier model would not have given out; they count with no bits.
    """

    path: Path
    version: str
    previous_version: str
    report: FitReport
    air_before: float
    air_after: float
    pages_lost_before: int
    pages_used: int
    pages_held_back: int
    seconds: float


def recalibrate(
    decoder: Decoder,
    pages: KnownPages,
    out: Path,
    version: str,
    fit: Fit,
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
    measuring = partial(_within, progress, "measure the model in service", 0.0)
    judged = _judged(tracker, decoder.bundle, held_back, measuring)
    before, lost_before = (
        fmean(0.0 if page.lost else page.air for page in judged),
        sum(page.lost is not None for page in judged),
    )
    fitted = replace(fitted, image_px=tracker.image_px)
    try:
        result = fit(decoder.bundle, fitted, lambda step, share: progress(step, 0.05 + 0.85 * share), decoder)
        judging = partial(_within, progress, "judge by the held-back pages", 0.9)
        judging(0.0)
        refitted = decoder.of_bundle(_refitted(decoder.bundle, result))
        judged = _judged(tracker.refitted(refitted), decoder.bundle, held_back, judging)
    except (CalibrationError, FrameError) as error:
        raise RecalibrationRefusedError(error.thing, error.got, error.wanted) from error
    after = fmean(page.air for page in judged)
    _judge(before, judged, pages.levels)
    progress("write the new bundle", 0.95)
    golden, bundle = held_back.pairs[0], refitted.bundle
    files = {
        **bundle.files,
        GOLDEN: npz(in_phase=golden.in_phase, quadrature=golden.quadrature, p=refitted.infer(golden).p),
    }
    write_bundle(out, _new_manifest(bundle.manifest, pages, version, before, after), files)
    return RecalibrationOutcome(
        path=out,
        version=version,
        previous_version=decoder.version,
        report=result.report,
        air_before=before,
        air_after=after,
        pages_lost_before=lost_before,
        pages_used=len(pages.pairs),
        pages_held_back=len(held_back.pairs),
        seconds=time.perf_counter() - start,
    )


def next_version(version: str, taken: Sequence[str] = ()) -> str:
    """The version after this one and all `taken`: ``bench-1`` gives ``bench-1+r1``, and that gives ``bench-1+r2``."""
    parts = [_RECALIBRATED.fullmatch(name) for name in (version, *taken)]
    base = parts[0][1] if parts[0] else version
    last = max((int(part[2]) for part in parts if part and part[1] == base), default=0)
    return f"{base}+r{last + 1}"


def _within(progress: Progress, step: str, start: float, share: float) -> None:
    """Tell of a share of a step that takes a twentieth of the work."""
    progress(step, start + 0.05 * share)


@dataclass(frozen=True)
class _Judged:
    """A held-back page: its AIR over the data symbols, bits per symbol, and why it would not have been given out."""

    air: float
    lost: LostPageError | FrameError | None = None


def _judged(tracker: Tracker, bundle: Bundle, pages: KnownPages, progress: Callable[[float], None]) -> list[_Judged]:
    """The pages, as a service reads them with this tracker."""
    mask = bundle.pilot_mask if pages.pilot_mask is None else pages.pilot_mask
    data, judged = ~mask, list[_Judged]()
    for pair, symbols in zip(pages.pairs, pages.symbols, strict=True):
        progress(len(judged) / len(pages.pairs))
        lost = None
        try:
            page = tracker.decode(pair, pages.levels, Pilots.of_symbols(mask, symbols, pages.levels))
        except FrameError as error:
            judged.append(_Judged(0.0, error))
            continue
        except UnconfirmedPageError as error:
            page, lost = unconfirmed_page(error), error
        figures = measure(page.phase[data], page.concentration[data], symbols[data], pages.levels)
        judged.append(_Judged(figures.air_bits_per_symbol, lost))
    return judged


def _judge(before: float, judged: list[_Judged], levels: int) -> None:
    """Each page must show its symbols, whatever the others do, and all together more of them than before.

    Raises:
        RecalibrationRefusedError: they do not.
    """
    for page in judged:
        if isinstance(page.lost, FrameError):
            raise RecalibrationRefusedError(page.lost.thing, page.lost.got, page.lost.wanted)
    least, worst, after = (
        MIN_AIR_SHARE * math.log2(levels),
        min(page.air for page in judged),
        fmean(p.air for p in judged),
    )
    if not worst >= least:
        raise RecalibrationRefusedError(
            "re-fitted geometry",
            f"an AIR of {worst:.3f} bit/symbol on one of the held-back pages",
            f"at least {least:.3f}: the page does not match its symbols",
        )
    if lost := sum(page.lost is not None for page in judged):
        raise RecalibrationRefusedError(
            "re-fitted geometry",
            f"{lost} of {len(judged)} held-back pages whose pilots do not confirm what is claimed",
            "pages of this device, as its decoder was trained: else calibrate and train anew",
        )
    if after < before - TOLERATED_LOSS_BITS:
        raise RecalibrationRefusedError(
            "re-fitted geometry",
            f"an AIR of {after:.3f} bit/symbol on held-back pages",
            f"at least the {before:.3f} of the model in service",
        )


def _refitted(bundle: Bundle, result: FitResult) -> Bundle:
    """The bundle with the re-fitted table and calibration, in memory; its golden page is still the earlier one's."""
    files = {**bundle.files, TABLE: npz(**{**bundle.table, **result.table})}
    manifest = bundle.manifest.model_copy(update={"calibration": result.calibration_toml})
    return replace(bundle, manifest=manifest, files=files)


def _new_manifest(manifest: Manifest, pages: KnownPages, version: str, before: float, after: float) -> Manifest:
    """The manifest of a re-fitted bundle."""
    figures = {"recalibration_air_bits_per_symbol": after, "recalibration_pages": len(pages.pairs)}
    if math.isfinite(before):
        figures["recalibration_air_bits_per_symbol_before"] = before
    return manifest.model_copy(
        update={
            "version": version,
            "created": datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
            "metrics": {**manifest.metrics, **figures},
            "calibrated_pages": (*manifest.calibrated_pages, *map(hash_frames, pages.pairs)),
            "provenance": Provenance(command=f"recalibrate from {manifest.version}"),
        }
    )
