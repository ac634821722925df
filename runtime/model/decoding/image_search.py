"""Looks for the image of a page with what a bundle holds: its field graph, its twin and its calibration."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.image_search import FoundImage, ImageSearch
from lightpage.calibration.interfaces import Twin
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.calibrated import calibration_of
from lightpage.runtime.model.decoding.decoder import Decoder

Real = NDArray[np.float64]


class PageSearch(Protocol):
    """Finds the image of a page; calls come from many threads."""

    def find(self, pair: FramePair, pilots: Pilots, around_px: Real) -> FoundImage:
        """Look within reach of all of `around_px` [K, 2], shifts (x, y) in camera pixels against calibration."""


class BundleSearch:
    """The search of one bundle's device.

    Args:
        decoder: of the bundle; its field graph, references and angle between the arms are used.
        twin: of the bundle.

    Raises:
        CalibrationError: the bundle holds no calibration.
    """

    def __init__(self, decoder: Decoder, twin: Twin) -> None:
        self._decoder, self._references = decoder, decoder.references
        self._registration, self._homodyne = (decoder.graph.value(name) for name in ("registration", "homodyne"))
        self._search = ImageSearch(twin, calibration_of(decoder.bundle).vector, decoder.bundle.profile)

    def find(
        self, pair: FramePair, pilots: Pilots, around_px: Real | None = None, references: FramePair | None = None
    ) -> FoundImage:
        """See `PageSearch`.

        Args:
            pair, pilots: of the page.
            around_px: by default where the calibration saw the image.
            references: reference-only frames taken with the page, if not those that the decoder decodes with.

        Raises:
            BundleError: no graph of the bundle shows the field.
        """
        references = references or self._references
        field, _ = self._decoder.field_solver(pair, references, self._registration, self._homodyne)
        return self._search.find(field, pilots, around_px)
