"""Looks for the image of a page with what a bundle holds: its field graph, its twin and its calibration."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from optics.pilots import Pilots
from optics.recording import FramePair
from optics.registration.image_search import FoundImage, ImageSearch
from runtime.calibrated import calibration_of
from runtime.decoder import Decoder
from runtime.twin import OnnxTwin

Real = NDArray[np.float64]

_TWIN_THREADS = 1
"""The twin traces the pilots only; a second thread would only spin."""


class PageSearch(Protocol):
    """Finds the image of a page; calls come from many threads."""

    def find(self, pair: FramePair, pilots: Pilots, around_px: Real) -> FoundImage:
        """Look within reach of all of `around_px` [K, 2], shifts (x, y) in camera pixels against calibration."""


class BundleSearch:
    """The search of one bundle's device.

    Args:
        decoder: of the bundle; its field graph, references and angle between the arms are used.

    Raises:
        BundleError: the twin cannot be traced.
        CalibrationError: the bundle holds no calibration.
    """

    def __init__(self, decoder: Decoder) -> None:
        bundle = decoder.bundle
        self._decoder, self._registration = decoder, decoder.table_value("registration")
        self._search = ImageSearch(OnnxTwin(bundle, _TWIN_THREADS), calibration_of(bundle).vector, bundle.profile)

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
        decoder = self._decoder
        homodyne = np.asarray(decoder.table_value("homodyne"), np.float32)
        field, _ = decoder.recover_field(pair, references or decoder.references, self._registration, homodyne)
        return self._search.find(field, pilots, around_px)
