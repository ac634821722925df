"""The last pages on the console: their figures, the losses, and the last frames."""

import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.service.monitoring.observation import Observation

PAGES = 5000
"""Pages whose figures are kept."""


@dataclass(frozen=True)
class PageRow:
    """The figures of one page; None where it does not show one.

    Attributes:
        time_s: seconds since 1970.
        subject: subject for people.
        page_index: its number in the source.
        model_version: what decoded it.
        seconds: time that it took.
        lost: why it was not given out, None where it was.
        unread: why its bytes could not be read, None where they were, or nobody asked.
        margin_bits: beyond what its code needs, a symbol.
        air_bits: information that a symbol is claimed to carry, as far as the pilots bear it out.
        trust, share: what the pilots bear out of the concentration, and of the information.
        shift_x_px, shift_y_px: shift of the image since calibration, camera pixels.
        piston_rad: piston of the page.
        residual_rad: smooth phase error that was taken off.
        stroke_relative: change of the stroke of the modulator since calibration, as the page's pilots show it.
        recalibration_due: whether the page by itself says so.
    """

    time_s: float
    subject: str
    page_index: int | None
    model_version: str
    seconds: float
    lost: str | None
    unread: str | None
    margin_bits: float | None
    air_bits: float | None
    trust: float | None
    share: float | None
    shift_x_px: float | None
    shift_y_px: float | None
    piston_rad: float | None
    residual_rad: float | None
    stroke_relative: float | None
    recalibration_due: bool

    def to_json(self) -> dict[str, Any]:
        """Return the figures by name; None for what is not a number."""
        return {name: None if isinstance(v, float) and not np.isfinite(v) else v for name, v in vars(self).items()}


@dataclass(frozen=True)
class Losses:
    """Pages lost for one reason: how many, and the last of them."""

    reason: str
    count: int
    detail: str
    time_s: float


class LastPages:
    """Takes note of pages, an `Observer`. Its methods may be called from many threads."""

    def __init__(self, pages: int = PAGES) -> None:
        self._lock = threading.Lock()
        self._rows: deque[PageRow] = deque(maxlen=pages)
        self._losses: dict[str, Losses] = {}
        self._pages = 0
        self._pair: FramePair | None = None
        self._concentration: NDArray[np.float32] | None = None
        self._shown = 0
        """Raised with each page whose pictures are new."""

    def observe(self, observation: Observation) -> None:
        """See `Observer`."""
        row = _row(observation)
        reason = row.lost or row.unread
        with self._lock:
            self._rows.append(row)
            self._pages += 1
            if reason is not None:
                before = self._losses.get(reason)
                count = 1 if before is None else before.count + 1
                self._losses[reason] = Losses(reason, count, observation.detail or row.subject, row.time_s)
            if observation.pair is not None:
                self._pair, self._shown = observation.pair, self._shown + 1
                self._concentration = None if observation.page is None else observation.page.concentration

    @property
    def pages(self) -> int:
        """Pages so far."""
        with self._lock:
            return self._pages

    def rows(self) -> list[PageRow]:
        """Return the last pages, the oldest first."""
        with self._lock:
            return list(self._rows)

    def losses(self) -> list[Losses]:
        """Lost and unread pages by reason, the most frequent first."""
        with self._lock:
            return sorted(self._losses.values(), key=lambda one: -one.count)

    def pictures(self) -> tuple[int, FramePair | None, NDArray[np.float32] | None]:
        """Return the number of the last page with frames, these, and its concentration [ny, nx] if it was decoded."""
        with self._lock:
            return self._shown, self._pair, self._concentration


def _row(observation: Observation) -> PageRow:
    page, data = observation.page, observation.user_data
    image = None if page is None else page.image
    return PageRow(
        time_s=observation.time_s,
        subject=observation.subject,
        page_index=observation.page_index,
        model_version=observation.model_version,
        seconds=observation.seconds,
        lost=None if observation.lost is None else observation.lost.value,
        unread=None if data is None or data.loss is None else data.loss.value,
        margin_bits=None if data is None else data.margin_bits,
        air_bits=None if page is None else page.information_bits,
        trust=None if page is None else page.pilot_trust,
        share=None if page is None else page.check.share,
        shift_x_px=None if image is None else image.shift_x_px,
        shift_y_px=None if image is None else image.shift_y_px,
        piston_rad=None if page is None else page.piston_rad,
        residual_rad=None if page is None else page.residual_rad,
        stroke_relative=None if page is None else page.stroke_relative,
        recalibration_due=page is not None and bool(page.check.recalibration_due),
    )
