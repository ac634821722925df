"""Pages with known symbols, as a recalibration takes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.errors import FrameError, InvalidInputError, PageError
from lightpage.page.symbols import check_symbols
from lightpage.progress import warn
from lightpage.recording.exposure import check_pair_light
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import hash_frames, narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.model.decoding.decoder import Decoder

MIN_PAGES = 2
"""One to fit on, one to judge by."""


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
        near: a device that is known to be near the one that shows them: a fit begins there, and looks for no image.
        fitted: SHA-256 (`hash_frames`) of the pages that `near` was fitted to. Those that are among these come first.
    """

    pairs: tuple[FramePair, ...]
    symbols: tuple[NDArray[np.uint8], ...]
    levels: int
    references: FramePair | None = None
    pilot_mask: NDArray[np.bool_] | None = None
    image_px: tuple[float, float] = (0.0, 0.0)
    near: CalibratedDevice | None = None
    fitted: tuple[str, ...] = ()

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
            decoder.check(pair, f"known page {number}: ")
            check_symbols(symbols, decoder.bundle.profile.page_shape, self.levels, f"known page {number}: symbols")
        if self.references is not None:
            decoder.check(self.references, "reference: ")
        # A re-fit judged by a page that it was fitted on would praise itself.
        first: dict[str, int] = {}
        for number, pair in enumerate(self.pairs):
            earlier = first.setdefault(hash_frames(pair), number)
            if earlier != number:
                raise InvalidInputError(
                    f"known page {number}", f"the frames of known page {earlier}", "pages that differ: one is judged by"
                )

    def lit(self, bit_depth: int) -> KnownPages:
        """The pages whose frames show light; of each other one is warned.

        Args:
            bit_depth: bits of the counts.

        Raises:
            FrameError: too few show light.
        """
        kept, dark = [], None
        for number, pair in enumerate(self.pairs):
            try:
                check_pair_light(f"known page {number}: ", pair, bit_depth)
            except FrameError as error:
                dark = error
                warn(f"left out: {error}")
            else:
                kept.append(number)
        if dark is not None and len(kept) < MIN_PAGES:
            raise dark
        pairs, symbols = tuple(self.pairs[n] for n in kept), tuple(self.symbols[n] for n in kept)
        return replace(self, pairs=pairs, symbols=symbols)

    @property
    def fitted_count(self) -> int:
        """Return how many of these pages `near` was fitted to."""
        return sum(hash_frames(pair) in self.fitted for pair in self.pairs)

    def part(self, pages: slice) -> KnownPages:
        """Some of the pages, the rest as it is."""
        return replace(self, pairs=self.pairs[pages], symbols=self.symbols[pages])


def read_recorded(recording: Recording, pages: Sequence[int], heard: Callable[[], None] = lambda: None) -> KnownPages:
    """Pages of a recording with their symbols.

    Args:
        recording: where they are.
        pages: their numbers.
        heard: called before each page; it may raise to stop.

    Raises:
        RecordingError: unreadable.
        PageError: the recording holds no symbols.
    """
    symbols = [found for index in pages if (found := recording.symbols(index)) is not None]
    if len(symbols) != len(pages):
        raise PageError(f"recording {recording.path}", "no symbols", "a recording with known symbols")
    bits, pairs = recording.bit_depth, []
    for index in pages:
        heard()
        pairs.append(narrow(recording.frames(index), bits))
    references = narrow(recording.references(), bits)
    return KnownPages(tuple(pairs), tuple(symbols), recording.levels, references, recording.pilots())
