"""Pages of user data that nobody knows, as models read and decide them that come nearer to their device."""

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.common_error import common_error
from lightpage.calibration.interfaces import Twin
from lightpage.codec.code import Code
from lightpage.codec.page_bytes import Header, PageBytes
from lightpage.codec.page_codec import PageCodec
from lightpage.errors import FramesDisagreeError, UnconfirmedPageError
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_drift import BundleTables, DriftModel, drift_slopes
from lightpage.runtime.model.decoding.image_tracker import ImageTracker
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import Tracker, unconfirmed_page
from lightpage.runtime.model.execution.estimator_graph import EstimatorGraph


class Look(NamedTuple):
    """Pages as one model decodes them, and their bytes."""

    pages: tuple[DecodedPage, ...]
    read: tuple[PageBytes, ...]


class UnknownPages:
    """Reads some pages with one model after the other; what a model says of them is kept.

    Args:
        pairs: frame pairs, one a page.
        expected: the page of its volume that each should be, None where that is unknown.
        code: code of the pages.
        pilots: levels of the pilots that all of them carry.
        twin: twin of their profile.
    """

    def __init__(
        self,
        pairs: Sequence[FramePair],
        expected: Sequence[Header | None],
        code: Code,
        pilots: NDArray[np.uint8],
        twin: Twin,
    ) -> None:
        self.pairs, self._expected, self._code, self.pilots, self._twin = pairs, expected, code, pilots, twin
        self._seen: dict[Decoder, Look] = {}
        self._drift: DriftModel | None = None

    def pilots_of(self, decoder: Decoder) -> Pilots:
        """The pilots, with the phases that a decoder expects of them."""
        phases = decoder.bundle.modulation.phase(symbol_phases(self.pilots, self._code.levels))
        return Pilots(decoder.bundle.pilot_mask, phases)

    def codec(self, decoder: Decoder) -> PageCodec:
        """Takes bytes off the pages as a decoder reads them."""
        return decoder.codec_of(self._code)

    def look(self, decoder: Decoder, fitted: FramePair | None = None) -> Look:
        """Decode the pages, and read their bytes.

        Args:
            decoder: decoder of a model.
            fitted: the page that it was fitted to, from which the image is followed to the others as a service follows
                it; None for a model that was fitted to none of them.

        Raises:
            FrameError: frames that show no page.
        """
        if decoder not in self._seen:
            tracker, codec, known = self._tracker(decoder, fitted), self.codec(decoder), self.pilots_of(decoder)
            pages = tuple(self._decoded(decoder, tracker, pair, known) for pair in self.pairs)
            read = (
                codec.decode(page.phase, page.concentration, expected)
                for page, expected in zip(pages, self._expected, strict=True)
            )
            self._seen[decoder] = Look(pages, tuple(read))
        return self._seen[decoder]

    def _tracker(self, decoder: Decoder, fitted: FramePair | None) -> Tracker | None:
        """Return what follows the image. A shift does the same in all models, so the first one is measured."""
        if fitted is None:
            return None
        if self._drift is None:
            parameters = decoder.bundle.calibration.vector
            self._drift = (
                DriftModel.of_decoder(decoder, self._twin)
                if isinstance(decoder.graph, EstimatorGraph)
                else DriftModel(drift_slopes(decoder, self._twin, parameters, fitted))
            )
        return ImageTracker(decoder, self._drift, BundleTables(decoder, self._twin), None)

    def _decoded(self, decoder: Decoder, tracker: Tracker | None, pair: FramePair, known: Pilots) -> DecodedPage:
        """A page, whatever its pilots and its frames say of it."""
        levels = self._code.levels
        with suppress(FramesDisagreeError):
            if tracker is not None:
                try:
                    return tracker.decode(pair, levels, known)
                except UnconfirmedPageError as error:
                    return unconfirmed_page(error)
        return decoder.post_process(decoder.infer(pair, pilots=known, doubtful=True), levels, known)

    def decided(self, decoder: Decoder, fitted: FramePair | None = None) -> tuple[int, NDArray[np.uint8]]:
        """The page that a model decides best, and its symbols, uint8 [ny, nx].

        Symbols are decided without the smooth error that the pilots of all pages share. LDPC blocks that converge
        decide theirs.

        Args:
            decoder, fitted: as for `look`.

        Raises:
            CalibrationError: phases or claims that are not finite.
            FrameError: as `look` raises.
        """
        bundle, pages, count = decoder.bundle, self.look(decoder, fitted).pages, self._code.levels
        phases = np.stack([page.phase + page.phase_error for page in pages]).astype(np.float64)
        claimed = np.stack([page.concentration / page.pilot_trust for page in pages]).astype(np.float64)
        written = symbol_phases(self.pilots, count)
        error = common_error(phases, claimed, bundle.pilot_mask, written, bundle.modulation)
        freed = phases - error.phase - error.pistons[:, None, None]
        codec = PageCodec(self._code, bundle.pilot_mask, error.modulation.page_levels(count))
        decided = [codec.decide(*page) for page in zip(freed, claimed / error.scale**2, strict=True)]

        def sure(number: int) -> tuple[int, float]:
            return int(np.count_nonzero(decided[number][1])), float(np.median(pages[number].concentration))

        best = max(range(len(pages)), key=sure)
        symbols = decided[best][0]
        symbols[bundle.pilot_mask] = self.pilots
        return best, symbols
