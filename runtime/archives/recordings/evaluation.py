"""Measures a decoder on a recording with known symbols, on pages that it has not seen."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError, LightpageError, LostPageError, RecordingError, StorageError
from lightpage.metrics.accumulator import Accumulator
from lightpage.metrics.information import achievable_rate, page_kilobytes
from lightpage.metrics.measures import PageMeasures, SymbolMaps
from lightpage.metrics.reliability import ConcentrationBin, ConfidenceBin
from lightpage.page.levels import Levels
from lightpage.page.pilots import Pilots, estimate_piston
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow, page_hashes
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.decoding_ahead import Shown, Symbols, decoded_ahead
from lightpage.runtime.archives.recordings.drift import Drift, PageState, drift_of
from lightpage.runtime.archives.recordings.refused import RefusedPage, refusal, refused_json
from lightpage.runtime.model.bundle.manifest import GOLDEN
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage, Timings
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.runtime.model.decoding.turns import Turn
from lightpage.words import brief, counted

_MAP_DECIMALS = 4
"""Of maps in JSON: finer than the noise of any number of pages, and short enough to write."""


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Figures over the data symbols of held-out pages.

    Attributes:
        bundle_version: what was measured.
        figures: over all pages together.
        pages: how many were measured.
        pages_left_out: how many the bundle was calibrated or trained on.
        symbols_per_page: data symbols, pilots not counted.
        seconds_per_page: median of the whole decode, without waiting for other pages.
        inference_seconds_per_page: median of the inference alone.
        steps_per_page: median number of Gauss-Newton steps; 0 for a network's bundle.
        air_per_page: AIR of each page, bits per symbol.
        concentration_bins: what concentrations promise against what happened.
        maps: means over the pages at every place of the page.
        confidence_bins: what confidences claim against what was right.
        bundle: what made the bundle and where it lay, as JSON can keep it.
        pages_recalibration_due: pages whose pilots show that the device is no longer as it was calibrated.
        refused: pages that could not be decoded, or were not confirmed; no figure counts them.
        air_before_refit_bits_per_symbol: AIR with the smooth phase errors that decoding takes off still in.
        drift: drift of the device over these pages, by the fields of `PageState`.
    """

    bundle_version: str
    figures: PageMeasures
    pages: int
    pages_left_out: int
    symbols_per_page: int
    seconds_per_page: float
    inference_seconds_per_page: float
    air_per_page: tuple[float, ...]
    concentration_bins: tuple[ConcentrationBin, ...]
    maps: SymbolMaps
    confidence_bins: tuple[ConfidenceBin, ...]
    bundle: dict[str, Any]
    pages_recalibration_due: int = 0
    refused: tuple[RefusedPage, ...] = ()
    air_before_refit_bits_per_symbol: float = float("nan")
    steps_per_page: float = 0.0
    drift: dict[str, Drift] = field(default_factory=dict)

    def __repr__(self) -> str:
        air = f"AIR {self.figures.air_bits_per_symbol:.3f} bits a symbol"
        page = f"{self.page_kb:.2f} kB a page"
        return brief(self, f"of {self.bundle_version}", air, page, f"by {counted(self.pages, 'page')}")

    @property
    def page_kb(self) -> float:
        """Return what a page carries, by its AIR."""
        return page_kilobytes(self.figures.air_bits_per_symbol, self.symbols_per_page)

    def to_json(self) -> dict[str, Any]:
        """The figures under the names that other programs read."""
        told = asdict(self)
        figures = told.pop("figures")
        del figures["count"], told["refused"]
        return {
            **told,
            **figures,
            "over_claim_bits_per_symbol": self.figures.over_claim_bits_per_symbol,
            "page_kB": self.page_kb,
            "maps": {name: page.round(_MAP_DECIMALS).tolist() for name, page in vars(self.maps).items()},
            **refused_json(self.refused),
        }


class NothingReadError(LightpageError):
    """No page of a recording was read.

    Args:
        refusal: why, see `lightpage.runtime.archives.recordings.refused.refusal`.
        figures: what there is to tell all the same, under the names of `Evaluation.to_json`.
    """

    def __init__(self, refusal: LightpageError, figures: dict[str, Any]) -> None:
        super().__init__(refusal.subject, refusal.got, refusal.expected)
        self.refusal, self.figures = refusal, figures


def was_seen(decoder: Decoder, frames: FramePair) -> bool:
    """Return whether the bundle was calibrated or trained on a page, whichever type its counts were stored in then."""
    manifest = decoder.bundle.manifest
    seen = {*manifest.calibrated_pages, *manifest.trained_pages}
    return bool(seen) and not seen.isdisjoint(page_hashes(frames))


def check_recording(decoder: Decoder, recording: Recording) -> None:
    """Check that a recording is of this decoder's kind of device.

    Raises:
        RecordingError: other shapes or another bit depth.
    """
    recording.header.check_against(decoder.bundle.profile)
    depth = decoder.bundle.manifest.camera_bit_depth
    if recording.bit_depth != depth:
        raise RecordingError(f"recording {recording.path}", f"{recording.bit_depth} bits", f"{depth}, as the bundle")


def check_symbols(recording: Recording, purpose: str = "measure against") -> None:
    """Check that the symbols of a recording are known.

    Raises:
        RecordingError: they are not.
    """
    if not recording.has_symbols:
        raise RecordingError(f"recording {recording.path}", "no symbols", f"known symbols to {purpose}")


def pilots_of(decoder: Decoder, recording: Recording) -> NDArray[np.bool_]:
    """Return where the pilots of a recording's pages are, [ny, nx]: as it says itself, or else the bundle's."""
    own = recording.pilots()
    return decoder.bundle.pilot_mask if own is None else own


def decode_unseen(
    decoder: Decoder,
    recording: Recording,
    tracker: Tracker,
    mask: NDArray[np.bool_],
    frames: FramePair,
    symbols: NDArray[np.uint8] | None,
    turn: Turn | None = None,
    *,
    in_sample: bool = False,
) -> DecodedPage | None:
    """A page of a recording, decoded by its own pilots; None where its symbols are unknown, or the bundle has seen it.

    Args:
        decoder, recording, tracker: see `evaluate`.
        mask: places of the pilots, see `pilots_of`.
        frames, symbols: frames and symbols of the page.
        turn: turn of the page.
        in_sample: whether pages that the bundle has seen are wanted instead.

    Raises:
        InvalidInputError, LostPageError: see `Tracker.decode`.
    """
    if symbols is None or was_seen(decoder, frames) is not in_sample:
        return None
    pilots = Pilots.of_symbols(mask, symbols, decoder.bundle.levels(recording.levels))
    return tracker.decode(narrow(frames, recording.bit_depth), recording.levels, pilots, turn)


def unseen_pages(
    decoder: Decoder,
    recording: Recording,
    tracker: Tracker,
    what: str,
    refused: list[RefusedPage],
    *more: type[LightpageError],
    in_sample: bool = False,
) -> Iterator[tuple[DecodedPage, NDArray[np.uint8]]]:
    """Decode all pages of a recording in their order and yield those that the bundle has not seen, with their symbols.

    Args:
        decoder, recording, tracker: see `evaluate`.
        what: is being done, for whoever watches.
        refused: takes the pages that could not be decoded, or were not confirmed.
        more: errors that it takes pages for, too.
        in_sample: whether the pages that the bundle has seen are yielded instead.
    """
    losses: tuple[type[LightpageError], ...] = (InvalidInputError, LostPageError, *more)
    mask = pilots_of(decoder, recording)

    def decode(page: Shown, frames: FramePair, symbols: Symbols) -> DecodedPage | None:
        return decode_unseen(decoder, recording, tracker, mask, frames, symbols, page.turn, in_sample=in_sample)

    pages = decoded_ahead(recording, range(recording.pages), lambda: tracker, decoder.batches.largest, decode)
    for index, result in track(pages, what, total=recording.pages):
        try:
            page, symbols = result()
        except losses as error:
            refused.append(RefusedPage.of(index, error))
            continue
        if page is not None and symbols is not None:
            yield page, symbols


def evaluate(decoder: Decoder, recording: Recording, tracker: Tracker) -> Evaluation:
    """Decode all unseen pages in their order and measure them against their symbols; a bad page is left out and told.

    Args:
        decoder: what to measure.
        recording: pages with known symbols.
        tracker: follows the device from page to page.

    Raises:
        RecordingError: another device's recording, or one without symbols.
        InvalidInputError: the bundle has seen every page.
        NothingReadError: no page could be decoded, or none was confirmed.
    """
    check_recording(decoder, recording)
    check_symbols(recording)
    levels = decoder.bundle.levels(recording.levels)
    data = ~pilots_of(decoder, recording)
    accumulator = Accumulator(levels, data, recording.pages)
    timings: list[Timings] = []
    states: list[PageState] = []
    refused: list[RefusedPage] = []
    due = 0
    before: list[float] = []
    for page, symbols in unseen_pages(decoder, recording, tracker, "evaluate", refused, StorageError):
        accumulator.add(page.phase[data], page.concentration[data], symbols[data])
        unfitted = (page.phase + page.phase_error)[data]
        before.append(float(achievable_rate(unfitted, page.concentration[data], symbols[data], levels).mean()))
        timings.append(page.timings)
        states.append(PageState.of(page))
        due += page.check.recalibration_due
    if not timings and refused:
        told = refusal(f"recording {recording.path}", refused, recording.pages)
        figures = {
            "bundle_version": decoder.version,
            "pages": 0,
            "pages_left_out": recording.pages - len(refused),
            "bundle": _describe(decoder, levels),
            **refused_json(refused),
        }
        raise NothingReadError(told, figures)
    if not timings:
        got = f"{recording.pages} pages, all of them used to make {decoder.version}"
        raise InvalidInputError(f"recording {recording.path}", got, "pages that the bundle has not seen")
    return Evaluation(
        bundle_version=decoder.version,
        figures=accumulator.figures(),
        pages=len(timings),
        pages_left_out=recording.pages - len(timings) - len(refused),
        symbols_per_page=int(np.count_nonzero(data)),
        seconds_per_page=float(np.median([t.worked_s for t in timings])),
        inference_seconds_per_page=float(np.median([t.inference_s for t in timings])),
        air_per_page=tuple(page.air_bits_per_symbol for page in accumulator.pages),
        concentration_bins=tuple(accumulator.concentration_bins()),
        maps=accumulator.maps(),
        confidence_bins=tuple(accumulator.confidence_bins()),
        bundle=_describe(decoder, levels),
        pages_recalibration_due=due,
        refused=tuple(refused),
        air_before_refit_bits_per_symbol=float(np.mean(before)),
        steps_per_page=float(np.median([t.steps for t in timings])),
        drift=drift_of(states),
    )


def _describe(decoder: Decoder, levels: Levels) -> dict[str, Any]:
    """The bundle's device and origin, the hash of its golden page, and the piston in the answer to that, radians."""
    bundle, manifest = decoder.bundle, decoder.bundle.manifest
    return {
        "path": str(bundle.path.resolve()),
        "provider": str(decoder.graph.provider),
        **manifest.model_dump(include={"name", "precision", "profile", "calibration", "metrics", "provenance"}),
        "golden_sha256": manifest.files[GOLDEN],
        "golden_piston_rad": estimate_piston(bundle.golden.p, decoder.pilots(levels.count)).angle_rad,
    }
