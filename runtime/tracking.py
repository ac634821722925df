"""Follows the slow shift of the cameras from page to page, so that small drift needs no recalibration."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from optics.pilots import Pilots
from optics.recording import FramePair
from runtime.bundle import Table
from runtime.decoder import DecodedPage, Decoder
from runtime.phase_shift import PhaseShift

JUMP_PX = 0.1
"""Shift from one page to the next that noise (0.03 px on a bench page's pilots) and slow drift do not explain."""

ATTEMPTS = 3
"""Most decodes of one page: a jump is read to a tenth of itself, so two corrections settle any."""

WALK_PX = 0.02
"""Standard deviation of the image's movement from one page to the next, per axis."""


@dataclass(frozen=True)
class Shift:
    """Movement of the image on both cameras since calibration, camera pixels; y grows with the row index."""

    x_px: float = 0.0
    y_px: float = 0.0


@dataclass(frozen=True)
class Measured:
    """A remaining shift with its standard deviation per axis, camera pixels."""

    shift: Shift
    error_px: tuple[float, float]


@dataclass(frozen=True)
class Lesson:
    """What a page taught.

    Attributes:
        rest: what is believed of how far the image lay from where the page's table looked for it.
        again: whether that is a jump, so that decoding the page again with the new table pays.
    """

    rest: Shift = field(default_factory=Shift)
    again: bool = False


class ShiftReader(Protocol):
    """Reads shift from decoded pages, and says what it does to tables and to phases."""

    def measure(self, page: DecodedPage, pilots: Pilots | None) -> Measured | None:
        """How far the image still lies from where the page's table looked for it; None where it does not show."""

    def move(self, shift: Shift) -> Table:
        """The tensors that are fed instead of the bundle's under a total shift; empty for no change."""

    def bend(self, shift: Shift) -> NDArray[np.float64]:
        """What to add to the phases [ny, nx] of a page whose table was `shift` off, radians."""


class Tracker(Protocol):
    """What the service asks of a tracker; calls come from many threads."""

    def table(self) -> Table:
        """Tensors for the next page, empty for the bundle's own."""

    def update(self, page: DecodedPage, table: Table, pilots: Pilots | None = None) -> Lesson:
        """Learn from a decoded page and the table that it was decoded with.

        `pilots` are the page's known symbols where they differ from the device's.
        """

    def bend(self, rest: Shift) -> NDArray[np.float64] | None:
        """What to add to the phases of a page whose table was `rest` off, None for nothing."""


class NoTracker:
    """Tracks nothing: the bundle's own table for every page."""

    def table(self) -> Table:
        """Always empty."""
        return {}

    def update(self, page: DecodedPage, table: Table, pilots: Pilots | None = None) -> Lesson:
        """Learns nothing."""
        return Lesson()

    def bend(self, rest: Shift) -> None:
        """Nothing."""


class ShiftTracker:
    """Kalman filter of the image's shift, one an axis, which walks from page to page.

    Args:
        reader: reads and applies shift.
        walk_px: standard deviation of the walk from page to page.
        limit_px: the estimate is held within this distance per axis; drift beyond it needs a recalibration.
    """

    def __init__(self, reader: ShiftReader, walk_px: float = WALK_PX, limit_px: float = 3.0) -> None:
        self._reader, self._walk, self._limit = reader, walk_px, limit_px
        self._lock = threading.Lock()
        """Guards the three below; never held while measuring or moving."""
        self._shift = Shift()
        self._variance = (walk_px**2, walk_px**2)
        """Of the shift before the next page is measured, per axis."""
        self._table: Table = {}

    @property
    def shift(self) -> Shift:
        """The present estimate."""
        with self._lock:
            return self._shift

    def table(self) -> Table:
        """Tensors for the next page."""
        with self._lock:
            return self._table

    def bend(self, rest: Shift) -> NDArray[np.float64] | None:
        """What to add to the phases of a page whose table was `rest` off, None for nothing."""
        return self._reader.bend(rest) if rest != Shift() else None

    def update(self, page: DecodedPage, table: Table, pilots: Pilots | None = None) -> Lesson:
        """Take in the shift that `page`, decoded with `table`, still shows.

        A jump is believed at once. A page decoded with a table that has been replaced since teaches the filter nothing:
        its remainder is already accounted for.
        """
        measured = self._reader.measure(page, pilots)
        if measured is None:
            with self._lock:  # it walks on unseen
                self._variance = (self._variance[0] + self._walk**2, self._variance[1] + self._walk**2)
            return Lesson()
        rest = measured.shift
        jumped = max(abs(rest.x_px), abs(rest.y_px)) > JUMP_PX
        with self._lock:
            before, variance = self._shift, self._variance
            late = table is not self._table
        gains = [1.0 if jumped else v / (v + e**2) for v, e in zip(variance, measured.error_px, strict=True)]
        believed = Shift(gains[0] * rest.x_px, gains[1] * rest.y_px)
        if late:
            return Lesson(believed, jumped)
        after = Shift(self._held(before.x_px + believed.x_px), self._held(before.y_px + believed.y_px))
        moved = self._reader.move(after)
        left = [g * e**2 + self._walk**2 for g, e in zip(gains, measured.error_px, strict=True)]
        with self._lock:
            if self._table is table:
                self._shift, self._variance, self._table = after, (left[0], left[1]), moved
        return Lesson(believed, jumped and after != before)

    def _held(self, value: float) -> float:
        return min(self._limit, max(-self._limit, value))


def decode_tracked(
    decoder: Decoder, tracker: Tracker, pair: FramePair, levels: int, pilots: Pilots | None = None
) -> DecodedPage:
    """Decode a pair with the tracker's table, its phases freed from what the page itself shows of further shift.

    Where it shows that the image has jumped, it is decoded again. The last answer counts, its timings too: they say
    nothing of the attempts before it.

    Args:
        decoder, tracker: of one model.
        pair, levels, pilots: as for `Decoder.decode`.
    """
    for attempt in range(1, ATTEMPTS + 1):
        table = tracker.table()
        page = decoder.decode(pair, levels, table, pilots)
        lesson = tracker.update(page, table, pilots)
        if not lesson.again or attempt == ATTEMPTS:
            break
    bend = tracker.bend(lesson.rest)
    return page if bend is None else decoder.settle_again(page, bend, pilots)


def tracker_for(decoder: Decoder) -> Tracker:
    """The tracker that a bundle's decoder is run with, in service and in evaluation.

    Raises:
        BundleError, CalibrationError: see `PhaseShift.of_decoder`.
    """
    return ShiftTracker(_PhaseReader(decoder)) if "registration" in decoder.table_shapes else NoTracker()


class _PhaseReader:
    """`PhaseShift` as the tracker asks for it."""

    def __init__(self, decoder: Decoder) -> None:
        self._reader = PhaseShift.of_decoder(decoder)

    def measure(self, page: DecodedPage, pilots: Pilots | None) -> Measured | None:
        found = self._reader.measure(page, pilots)
        if found is None:
            return None
        x, y = map(float, found.shift_px)
        return Measured(Shift(x, y), (float(found.error_px[0]), float(found.error_px[1])))

    def move(self, shift: Shift) -> Table:
        return self._reader.move(_array(shift))

    def bend(self, shift: Shift) -> NDArray[np.float64]:
        return self._reader.bend(_array(shift))


def _array(shift: Shift) -> NDArray[np.float64]:
    return np.array([shift.x_px, shift.y_px])
