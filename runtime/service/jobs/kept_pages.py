"""Keeps the last pages of the device, to recalibrate by: no page need be shown for that whose symbols are known."""

import threading
from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.page_bytes import Loss, PageBytes
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.healing import TOGETHER, LostPages
from lightpage.runtime.recalibration.known_pages import MIN_PAGES, KnownPages
from lightpage.runtime.service.monitoring.monitor import SHOWS_DEVICE
from lightpage.runtime.service.monitoring.observation import Observation

_KEPT = TOGETHER + 2
"""Pages at most, the last ones."""

_USED = 3
"""Pages that were read of which a recalibration takes the last ones: one to fit, two to judge by."""


class KeptPages:
    """The frames of the last pages of the service's own device that say something of it, an `Observer`.

    Frames that come again count once, as they were decoded last: a re-fit judged by its own page would praise itself.
    Pages that were read are known: encoded again, their bytes give their symbols. What is kept of a page is its frames
    and what was decoded, some 2 MB of a bench device and 50 MB of a full-size one.

    Args:
        most_bytes: largest size of all frames; older ones go first.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes, self._lock = most_bytes, threading.Lock()
        self._pages: deque[Observation] = deque(maxlen=_KEPT)

    def observe(self, observation: Observation) -> None:
        """See `Observer`."""
        pair, lost = observation.pair, observation.lost
        says_nothing = lost is not None and not (observation.tells and lost in SHOWS_DEVICE)
        if not observation.of_device or pair is None or says_nothing:
            return
        own = FramePair(pair.in_phase.copy(), pair.quadrature.copy())  # the caller's memory may be used again
        kept = replace(observation, pair=own)
        with self._lock:
            others = [one for one in self._pages if not _shows(one, own)]
            self._pages = deque([*others, kept], _KEPT)
            while len(self._pages) > 1 and sum(map(_bytes, self._pages)) > self._most_bytes:
                self._pages.popleft()

    def clear(self) -> None:
        """Forget all of them: another model has been fitted by them."""
        with self._lock:
            self._pages.clear()

    def enough_for_lost(self, decoder: Decoder) -> bool:
        """Return whether pages are lost, and enough kept to fit by and to judge by: a single lost page shows neither.

        Pages count that the model in service has decoded, at the levels of its code. A page whose symbols the
        source knows counts as lost where it gave no bytes.
        """
        found = (_found(one, decoder) for one in self._of(decoder))
        if not any(page is None or page.loss not in (None, Loss.CODE) for page in found):
            return False
        known, lost, _ = self._sorted(decoder)
        return max(len(known), len(lost)) >= MIN_PAGES

    def pages(self, decoder: Decoder, image_px: tuple[float, float]) -> KnownPages | LostPages | None:
        """Return the pages to recalibrate by: the last ones that were read, or else lost ones; None if there are none.

        Pages count that the model in service has decoded, at the levels of its code. Where the last ones were lost,
        those that were read before show a device that has changed since.

        Args:
            decoder: decoder in service.
            image_px: where its image was last seen.
        """
        if (code := decoder.bundle.code) is None:
            return None
        known, lost, lost_since = self._sorted(decoder)
        if len(known) >= MIN_PAGES and lost_since < MIN_PAGES:
            pairs, symbols = zip(*known[:_USED], strict=True)
            return KnownPages(pairs, symbols, code.levels, None, decoder.bundle.pilot_mask, image_px)
        if not lost:
            return None
        return LostPages(tuple(lost[:TOGETHER]), code, image_px=image_px)

    def _of(self, decoder: Decoder) -> list[Observation]:
        """The pages that the model in service has decoded, at the levels of its code."""
        if (code := decoder.bundle.code) is None:
            return []
        with self._lock:
            return [o for o in self._pages if o.model_version == decoder.version and o.levels in (None, code.levels)]

    def _sorted(self, decoder: Decoder) -> tuple[list[tuple[FramePair, NDArray[np.uint8]]], list[FramePair], int]:
        """Pages that are known, with their symbols, those that were lost, and how many of these came last."""
        known, lost, lost_since = list[tuple[FramePair, NDArray[np.uint8]]](), list[FramePair](), 0
        codec = decoder.page_codec
        pilots = decoder.bundle.written_pilots(codec.code.levels)
        for one in reversed(self._of(decoder)):
            pair = one.pair
            assert pair is not None  # else it is not kept
            if one.symbols is not None:
                known.append((pair, one.symbols))
                continue
            found = _found(one, decoder)
            if found is not None and found.loss is None:
                known.append((pair, codec.encode_again(found, pilots)))
            elif found is None or found.loss is not Loss.CODE:
                lost.append(pair)
                lost_since += not known
        return known, lost, lost_since


def _found(kept: Observation, decoder: Decoder) -> PageBytes | None:
    """The bytes of a page, read now where nobody asked for them; None of one that its pilots did not confirm."""
    if kept.user_data is not None or kept.lost is not None or kept.page is None:
        return kept.user_data
    return decoder.page_codec.decode(kept.page.phase, kept.page.concentration)


def _shows(kept: Observation, pair: FramePair) -> bool:
    """Return whether a kept page has these frames. The noise of a few rows nearly always tells two pages apart."""
    if kept.pair is None:
        return False
    both = ((kept.pair.in_phase, pair.in_phase), (kept.pair.quadrature, pair.quadrature))
    return all(np.array_equal(a[::64], b[::64]) for a, b in both) and all(np.array_equal(a, b) for a, b in both)


def _bytes(kept: Observation) -> int:
    return 0 if kept.pair is None else kept.pair.in_phase.nbytes + kept.pair.quadrature.nbytes
