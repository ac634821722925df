"""The pages of a range on their way: decoded, measured or read for their user bytes; each is a finding, or lost."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TypeVar

from lightpage.codec.page_bytes import PageBytes
from lightpage.codec.volume import Volume
from lightpage.errors import InvalidInputError, LightpageError, LostPageError, StorageError
from lightpage.metrics.accumulator import Accumulator
from lightpage.metrics.measures import PageMeasures, measure
from lightpage.page.pilots import Pilots
from lightpage.recording.decoded_file import DecodedWriter
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.decoding_ahead import Shown, Symbols, decoded_ahead
from lightpage.runtime.archives.recordings.evaluation import check_symbols, decode_unseen, pilots_of
from lightpage.runtime.archives.recordings.page_reader import Healings, PageReader, RecoveredPage
from lightpage.runtime.archives.recordings.recovery import code_of
from lightpage.runtime.archives.run.shard import SYMBOLS, Findings, PageRecord, PageState, with_end, write_user_bytes
from lightpage.runtime.archives.run.task import Operation, Task
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import Tracker

T = TypeVar("T")


@dataclass(frozen=True)
class PageRange:
    """A range of pages for a worker to read.

    Attributes:
        task: pages, and operation on them.
        recording: recording of the pages.
        decoder: decoder of the task's bundle.
        tracker: tracker of that decoder, at its start.
        healings: healings of earlier ranges of the device.
    """

    task: Task
    recording: Recording
    decoder: Decoder
    tracker: Tracker
    healings: Healings

    def findings(self) -> Findings:
        """Return what becomes of the pages; what they give beside it is written.

        Raises:
            LightpageError: something that says nothing of a page.
        """
        return {
            Operation.DECODE: self._decoded,
            Operation.EVALUATE: self._evaluated,
            Operation.RECOVER: self._recovered,
        }[self.task.choices.operation]()

    def _decoded(self) -> Findings:
        """Symbols, confidences, and figures where the symbols are known."""
        levels, mask = self.recording.levels, pilots_of(self.decoder, self.recording)
        shown = self.decoder.bundle.levels(levels)
        records: list[PageRecord] = []

        def decode(page: Shown, frames: FramePair, symbols: Symbols) -> DecodedPage:
            pilots = self.decoder.pilots(levels, mask) if symbols is None else Pilots.of_symbols(mask, symbols, shown)
            return self.tracker.decode(narrow(frames, self.recording.bit_depth), levels, pilots, page.turn)

        with ExitStack() as stack:
            writer = None
            if self.task.choices.symbols:
                writer = stack.enter_context(DecodedWriter(with_end(self.task.shard, SYMBOLS), levels))
            for page, found, symbols in self._read(decode, records):
                if writer is not None:
                    writer.append(found.symbols, found.confidence, self.decoder.version, page)
                measures = None
                if symbols is not None and not mask.all():
                    measures = measure(found.phase[~mask], found.concentration[~mask], symbols[~mask], shown)
                records.append(_read_record(page, found, measures))
        return Findings(pages=tuple(records))

    def _evaluated(self) -> Findings:
        """Figures of the pages that the bundle has not seen.

        Raises:
            RecordingError: the recording has no symbols.
        """
        check_symbols(self.recording)
        mask = pilots_of(self.decoder, self.recording)
        accumulator = Accumulator(self.decoder.bundle.levels(self.recording.levels), ~mask, len(self.task.pages))
        records: list[PageRecord] = []

        def decode(page: Shown, frames: FramePair, symbols: Symbols) -> DecodedPage | None:
            return decode_unseen(self.decoder, self.recording, self.tracker, mask, frames, symbols, page.turn)

        for page, found, symbols in self._read(decode, records):
            if found is None or symbols is None:
                records.append(PageRecord(page=page, state=PageState.LEFT_OUT))
                continue
            accumulator.add(found.phase[~mask], found.concentration[~mask], symbols[~mask])
            records.append(_read_record(page, found, accumulator.pages[-1]))
        return Findings(pages=tuple(records), confidence_bins=tuple(accumulator.confidence_bins()))

    def _recovered(self) -> Findings:
        """User bytes."""
        code = self.task.choices.code or code_of(self.recording, self.decoder.bundle)
        give_up, healings = self.task.give_up, self.healings
        reader = PageReader(self.decoder, self.recording, self.tracker, code, give_up=give_up, healings=healings)
        kept: list[tuple[int, PageBytes]] = []

        def take(page: int, found: PageBytes) -> Volume | None:
            if (volume := Volume.of_page(found)) is not None:
                kept.append((page, found))
            return volume

        records = [*map(_recovered_record, reader.read(self.task.pages, take, heals=self.task.choices.heals))]
        write_user_bytes(self.task.shard, sorted(kept, key=lambda one: one[0]))
        return Findings(pages=tuple(sorted(records, key=lambda record: record.page)))

    def _read(
        self, decode: Callable[[Shown, FramePair, Symbols], T], records: list[PageRecord]
    ) -> Iterator[tuple[int, T, Symbols]]:
        """Yield number, what was decoded, and symbols of each page; those that are lost go into `records`."""
        findings: tuple[type[LightpageError], ...] = (InvalidInputError, LostPageError)
        if self.task.give_up:
            findings += (StorageError,)
        together = self.decoder.batches.largest
        pages = decoded_ahead(self.recording, self.task.pages, lambda: self.tracker, together, decode)
        for page, result in pages:
            try:
                found, symbols = result()
            except findings as error:
                records.append(lost_page(page, error))
                continue
            yield page, found, symbols


def lost_page(page: int, error: LightpageError) -> PageRecord:
    """The page that an error is about."""
    due, loss = False, type(error).__name__
    if isinstance(error, LostPageError):
        due, loss = error.recalibration_due, error.reason.value
    return PageRecord(page=page, state=PageState.LOST, loss=loss, reason=str(error), recalibration_due=due)


def _read_record(page: int, found: DecodedPage, measures: PageMeasures | None) -> PageRecord:
    due, confirmed, claimed = found.check.recalibration_due, found.check.confirmed_bits, found.check.claimed_bits
    own = {"mean_confidence": float(found.confidence.mean()), "pilot_trust": found.pilot_trust, "claimed_bits": claimed}
    figures = own | ({} if measures is None else vars(measures))
    read = PageState.READ
    return PageRecord(page=page, state=read, recalibration_due=due, confirmed_bits=confirmed, figures=figures)


_RECOVERED = "number", "volume", "margin_bits", "corrected", "failed_blocks", "healed_rounds"
"""Figures of a `RecoveredPage` that are kept under its names."""


def _recovered_record(page: RecoveredPage) -> PageRecord:
    state = PageState.READ if page.loss is None else PageState.LOST
    figures = {name: getattr(page, name) for name in _RECOVERED}
    figures["air_bits_per_symbol"] = page.air_bits
    return PageRecord(page=page.page, state=state, loss=page.loss, reason=page.reason, figures=figures)
