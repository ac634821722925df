"""Follows the slow shift of the cameras from page to page, so that small drift needs no recalibration."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from optics.pilots import Pilots
from optics.recording import FramePair
from runtime.bundle import Table
from runtime.decoder import DecodedPage, Decoder
from runtime.phase_shift import PhaseShift

JUMP_PX = 0.1
"""Shift from one page to the next that noise (0.03 px on a bench page's pilots) and slow drift do not explain."""

ATTEMPTS = 3
"""Most decodes of one page: a jump is read to a tenth of itself, so two corrections settle any."""

GAIN = 0.5
"""Share of a measured shift that is believed at once. The image walks 0.02 px a page and a page shows it to 0.03 px by
its pilots, to 0.005 px with safe decisions; the page after then lies 0.029 or 0.023 px (root mean square) off the
estimate, against 0.029 and 0.021 at the best gain of either, 0.5 and 1."""


@dataclass(frozen=True)
class Shift:
    """Movement of the image on both cameras since calibration, camera pixels; y grows with the row index."""

    x_px: float = 0.0
    y_px: float = 0.0


class MeasureShift(Protocol):
    """Measures from one decoded page how far the image lies from where the table in use looks for it."""

    def __call__(self, pair: FramePair, page: DecodedPage, table: Table, pilots: Pilots | None) -> Shift | None:
        """The remaining shift, or None where the page does not show it reliably."""


class MoveTable(Protocol):
    """Turns a total shift into the tensors that are fed instead of the bundle's."""

    def __call__(self, shift: Shift) -> Table:
        """Tensors by input name; empty for no change."""


class Tracker(Protocol):
    """What the service asks of a tracker; calls come from many threads."""

    def table(self) -> Table:
        """Tensors for the next page, empty for the bundle's own."""

    def update(self, pair: FramePair, page: DecodedPage, table: Table, pilots: Pilots | None = None) -> bool:
        """Learn from a decoded page and the table that it was decoded with; whether decoding it again would pay.

        `pilots` are the page's known symbols where they differ from the device's.
        """


class NoTracker:
    """Tracks nothing: the bundle's own table for every page."""

    def table(self) -> Table:
        """Always empty."""
        return {}

    def update(self, pair: FramePair, page: DecodedPage, table: Table, pilots: Pilots | None = None) -> bool:
        """Learns nothing."""
        return False


class ShiftTracker:
    """Exponential average of the measured shift, applied to the table of the next page.

    Args:
        measure: how one page shows the remaining shift.
        move: how a shift changes the table.
        gain: share of a measured remainder that is believed at once, 0..1.
        limit_px: the average is held within this distance per axis; drift beyond it needs a recalibration.
    """

    def __init__(self, measure: MeasureShift, move: MoveTable, gain: float = 0.3, limit_px: float = 3.0) -> None:
        self._measure, self._move = measure, move
        self._gain, self._limit = gain, limit_px
        self._lock = threading.Lock()
        """Guards the two below; taken by table() and update(), never held while measuring or moving."""
        self._shift = Shift()
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

    def update(self, pair: FramePair, page: DecodedPage, table: Table, pilots: Pilots | None = None) -> bool:
        """Take in the shift that `page`, decoded with `table`, still shows; whether it was a jump.

        A jump is believed at once. From a page decoded with a table that has been replaced since nothing is learnt: its
        remainder is already accounted for, and decoding it again with the new table pays if it was a jump.
        """
        rest = self._measure(pair, page, table, pilots)
        if rest is None:
            return False
        jumped = max(abs(rest.x_px), abs(rest.y_px)) > JUMP_PX
        with self._lock:
            if table is not self._table:
                return jumped
            before = self._shift
        gain = 1.0 if jumped else self._gain
        after = Shift(self._step(before.x_px, gain * rest.x_px), self._step(before.y_px, gain * rest.y_px))
        moved = self._move(after)
        with self._lock:
            if self._shift == before:
                self._shift, self._table = after, moved
        return jumped and after != before

    def _step(self, old: float, by: float) -> float:
        return min(self._limit, max(-self._limit, old + by))


def decode_tracked(
    decoder: Decoder, tracker: Tracker, pair: FramePair, levels: int, pilots: Pilots | None = None
) -> DecodedPage:
    """Decode a pair with the tracker's table, again where it shows that the image has jumped; the last answer counts.

    Args:
        decoder, tracker: of one model.
        pair, levels, pilots: as for `Decoder.decode`.
    """
    for _ in range(ATTEMPTS - 1):
        table = tracker.table()
        page = decoder.decode(pair, levels, table, pilots)
        if not tracker.update(pair, page, table, pilots):
            return page
    return decoder.decode(pair, levels, tracker.table(), pilots)


def tracker_for(decoder: Decoder) -> Tracker:
    """The tracker that a bundle's decoder is run with, in service and in evaluation.

    Raises:
        BundleError, CalibrationError: see `PhaseShift.of_decoder`.
    """
    if "places" not in decoder.table_shapes:
        return NoTracker()
    reader = PhaseShift.of_decoder(decoder)

    def measure(pair: FramePair, page: DecodedPage, table: Table, pilots: Pilots | None) -> Shift | None:
        found = reader.measure(page, pilots)
        return None if found is None else Shift(float(found[0]), float(found[1]))

    def move(shift: Shift) -> Table:
        return reader.move(np.array([shift.x_px, shift.y_px]))

    return ShiftTracker(measure, move, GAIN)
