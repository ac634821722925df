"""Reads recorded pages for their user bytes, and heals the model where it no longer reads them."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lightpage.codec.code import Code
from lightpage.codec.page_bytes import LOSSES, Header, Loss, PageBytes
from lightpage.codec.volume import Successor, Volume
from lightpage.errors import (
    BundleError,
    InvalidInputError,
    LostPageError,
    RecalibrationRefusedError,
    RecordingError,
    StorageError,
)
from lightpage.progress import note
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import air_bits
from lightpage.runtime.archives.recordings.decoding_ahead import Shown, Symbols, decoded_ahead
from lightpage.runtime.archives.recordings.evaluation import check_recording, pilots_of
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.runtime.recalibration.healing import TOGETHER, LostPages, heal
from lightpage.words import counted

Decoded = tuple[tuple[DecodedPage, float], Symbols]
"""A page with the seconds that it took, and its symbols where they are known."""
Take = Callable[[int, PageBytes], Volume | None]
Model = tuple[Decoder, Tracker]

_CURABLE = frozenset({Loss.OPTICS, Loss.HEADER, Loss.BODY, Loss.CHECKSUM})
"""Losses that a model which fits the device may mend."""


@dataclass(frozen=True)
class RecoveredPage:
    """Outcome of one recorded page.

    Attributes:
        page: its number in the recording.
        number: its number in its volume: as read, or of a lost page as its header claims it; None where unknown.
        volume: the same of the volume.
        loss: why it gave no bytes; None where it did.
        reason: the same for people; empty where it did.
        margin_bits: information of a symbol's coded bits beyond what the code needs; None where there was no light.
        corrected: Reed-Solomon symbols that were mended.
        failed_blocks: LDPC blocks that did not converge.
        iterations: mean number of iterations of the LDPC blocks.
        air_bits: AIR of the page as delivered, bits a data symbol; None where its symbols are not known.
        seconds: time of the optical decode, without waiting for other pages.
        code_seconds: time of the code.
        healed_rounds: rounds of the healing that made it readable; None where it needed none.
    """

    page: int
    number: int | None
    volume: int | None
    loss: Loss | None
    reason: str
    margin_bits: float | None = None
    corrected: int = 0
    failed_blocks: int = 0
    iterations: float = 0.0
    air_bits: float | None = None
    seconds: float = 0.0
    code_seconds: float = 0.0
    healed_rounds: int | None = None


@dataclass
class Healings:
    """Outcome of healings, for pages of the same device that are read later.

    Attributes:
        model: decoder of the last healed model and its tracker; None for the bundle's own.
        together: number of lost pages at which the next healing starts; each failure doubles it.
        passed: number of lost pages of earlier readings that no healing has tried.
    """

    model: Model | None = None
    together: int = TOGETHER
    passed: int = 0

    def healed(self, decoder: Decoder, tracker: Tracker) -> None:
        """Take note of a model that reads pages."""
        self.model, self.together, self.passed = (decoder, tracker), TOGETHER, 0

    def failed(self) -> None:
        """Take note of a healing that brought no page."""
        self.together, self.passed = 2 * self.together, 0


Unread = tuple[RecoveredPage, Header | None]
"""A page that was not read, and the page of its volume that it should be."""
Waiting = Sequence[Unread]


class PageReader:
    """Reads pages of a recording, mostly one after the other; knows which page of its volume should come next.

    Args:
        decoder, recording, tracker, code: see `lightpage.runtime.archives.recordings.recovery.recover`.
        give_up: whether pages that storage does not give are unread, as those that are lost.
        healings: outcome of healings of this device, for earlier and later readings; with None the last pages are
            tried whatever was tried before.

    Attributes:
        codec: codec of the pages.

    Raises:
        RecordingError: another device's recording, or one of other levels or pilots.
    """

    def __init__(
        self,
        decoder: Decoder,
        recording: Recording,
        tracker: Tracker,
        code: Code,
        *,
        give_up: bool = True,
        healings: Healings | None = None,
    ) -> None:
        check_recording(decoder, recording)
        subject, mask = f"recording {recording.path}", decoder.bundle.pilot_mask
        if recording.header.declared_levels not in (None, code.levels):
            raise RecordingError(f"{subject}: levels", recording.levels, f"{code.levels}, as the code has")
        if not np.array_equal(pilots_of(decoder, recording), mask):
            raise RecordingError(f"{subject}: pilots", "other places", "those of the bundle")
        self._recording, self._code, self._give_up = recording, code, give_up
        self._next = Successor()
        self._healings, self._ends = healings or Healings(), healings is None
        self._own: Model | None = None
        """The bundle's own model, while an earlier healed model is in use and has read nothing."""
        if self._healings.model is None:
            self._use(decoder, tracker)
        else:
            self._own, (healed, following) = (decoder, tracker), self._healings.model
            self._use(healed, following.anew())

    def _use(self, decoder: Decoder, tracker: Tracker) -> None:
        """Read with this model from now on."""
        self._decoder, self._tracker, code = decoder, tracker, self._code
        self._levels, self._pilots = decoder.bundle.levels(code.levels), decoder.written_pilots(code.levels)
        self.codec = decoder.codec_of(code)

    def read(self, pages: Sequence[int], take: Take, *, heals: bool = True) -> Iterator[RecoveredPage]:
        """Read pages, and heal the model by those that it does not read.

        A page that is not read waits until `TOGETHER` of them do, or all others are read; then the model is re-fitted
        by them, and by the last page that was read among them, and they are read again. The re-fitted model reads the
        pages behind them. Where it reads no more than before, the next pages wait for twice as many, in later
        readings too.

        Args:
            pages: numbers of the pages in the recording.
            take: takes a page's number in the recording and its bytes, and says which volume they belong to.
            heals: whether models are healed.

        Yields:
            Every page once, those that were read again behind their neighbours.

        Raises:
            StorageError: frames could not be read, which says nothing of the page, and it is not given up.
        """
        waiting, right, healings = list[Unread](), None, self._healings
        for index, result in self._decoded(pages):
            expected = self._next.header
            page = self._read(index, result, expected, take)
            if page.loss is None:
                self._own = None
                if waiting:  # one from before may be from before a knock
                    right = index
            if heals and page.loss in _CURABLE:
                waiting.append((page, expected))
            else:
                yield page
            if waiting and len(waiting) + healings.passed >= healings.together:
                yield from self._tried(waiting, right, take)
                waiting.clear()
                right = None
        if not waiting:
            return
        if self._ends or healings.together == TOGETHER:
            yield from self._tried(waiting, right, take)
        else:
            healings.passed += len(waiting)
            yield from self._by_own(waiting, take) or [page for page, _ in waiting]

    def _tried(self, waiting: Waiting, right: int | None, take: Take) -> list[RecoveredPage]:
        """Read lost pages again by the bundle's own or a healed model; unchanged if neither reads any."""
        found = self._by_own(waiting, take) or self._healed(waiting, right, take)
        if not found:
            self._healings.failed()
        return found or [page for page, _ in waiting]

    def _by_own(self, waiting: Waiting, take: Take) -> list[RecoveredPage] | None:
        """Read pages that an earlier healed model lost with the bundle's own model; None if that reads none."""
        own, self._own = self._own, None
        found = None if own is None else self._again(waiting, own, None, take)
        if found is not None:
            self._healings.model = None
        return found

    def _healed(self, waiting: Waiting, right: int | None, take: Take) -> list[RecoveredPage] | None:
        """Heal the model by lost pages and read them again; None if that reads none."""
        note(f"{counted(len(waiting), 'page')} not read: the model is fitted to the device by them")
        try:
            healed = heal(self._decoder, self._lost(waiting, right))
        except (RecalibrationRefusedError, BundleError, RecordingError, InvalidInputError, StorageError) as error:
            if isinstance(error, StorageError) and not self._give_up:
                raise
            note(f"not healed: {error}")
            return None
        model = healed.decoder, self._tracker.refitted(healed.decoder)
        found = self._again(waiting, model, healed.rounds, take)
        if found is not None:
            self._healings.healed(*model)
        read = sum(page.loss is None for page in found or ())
        note(f"{read} of them are read after {counted(healed.rounds, 'round')}, {healed.seconds:.0f} s")
        return found

    def _again(self, waiting: Waiting, model: Model, rounds: int | None, take: Take) -> list[RecoveredPage] | None:
        """Read lost pages with a model of so many rounds, and keep it in use; None if it reads none."""
        following, before, found = self._next, (self._decoder, self._tracker), list[RecoveredPage]()
        self._use(*model)
        decoded = self._decoded([page.page for page, _ in waiting])
        for (page, expected), (index, result) in zip(waiting, decoded, strict=True):
            again = self._read(index, result, expected, take)
            found.append(page if again.loss else replace(again, healed_rounds=rounds))
        self._next = following
        if all(page.loss for page in found):
            self._use(*before)
            return None
        return found

    def _lost(self, waiting: Waiting, right: int | None) -> LostPages:
        """Frames of pages that were not read, and of one among them that was.

        Raises:
            RecordingError, StorageError: unreadable.
        """
        some = [(page.page, expected) for page, expected in waiting[:TOGETHER]]
        if right is not None:
            some = [(right, None), *some[: TOGETHER - 1]]
        bits, recording = self._recording.bit_depth, self._recording
        return LostPages(
            tuple(narrow(recording.frames(index), bits) for index, _ in some),
            self._code,
            tuple(expected for _, expected in some),
            narrow(recording.references(), bits),
            self._tracker.image_px,
        )

    def _decoded(self, pages: Sequence[int]) -> Iterator[tuple[int, Callable[[], Decoded]]]:
        """Pages on their way through the optics, by the model that is in use when they are asked for."""

        def decode(page: Shown, frames: FramePair, symbols: Symbols) -> tuple[DecodedPage, float]:
            start = time.perf_counter()
            pair = narrow(frames, self._recording.bit_depth)
            found = page.tracker.decode(pair, self._levels.count, self._pilots, page.turn)
            return found, time.perf_counter() - start - found.timings.waited_s

        return decoded_ahead(self._recording, pages, lambda: self._tracker, self._decoder.batches.largest, decode)

    def _read(self, index: int, result: Callable[[], Decoded], expected: Header | None, take: Take) -> RecoveredPage:
        """Read a page.

        Args:
            index: index of it in the recording.
            result: gives it decoded, with its symbols where they are known.
            expected: the page of its volume that it should be.
            take: see `read`.

        Raises:
            StorageError: see `read`.
        """
        try:
            (page, seconds), symbols = result()
            decoded = time.perf_counter()
            found = self.codec.decode(page.phase, page.concentration, expected)
            code_seconds = time.perf_counter() - decoded
        except (InvalidInputError, LostPageError, StorageError) as error:
            of_storage = isinstance(error, StorageError)
            if of_storage and not self._give_up:
                raise
            self._next = self._next.after()
            loss = Loss.STORAGE if of_storage else Loss.OPTICS
            return RecoveredPage(index, *_place(expected), loss, str(error))
        own = take(index, found)
        if own is not None and found.header is not None:
            self._next = Successor(own, found.header)
        self._next = self._next.after()
        return RecoveredPage(
            index,
            *_place(found.header or expected),
            found.loss,
            "" if found.loss is None else LOSSES[found.loss],
            found.margin_bits,
            found.corrected,
            found.failed_blocks,
            found.iterations,
            None if symbols is None else air_bits(page, symbols, ~self.codec.pilots, self._levels),
            seconds,
            code_seconds,
        )


def _place(header: Header | None) -> tuple[int | None, int | None]:
    """Number and volume of a page."""
    return (None, None) if header is None else (header.page, header.volume)
