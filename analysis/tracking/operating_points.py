"""Operating points of the image's search: the decoders and devices that it is measured with."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.comparison.data_set import data_set_of
from analysis.comparison.kept_bundle import export_kept
from analysis.comparison.weight_store import TRAINED
from analysis.tracking.figure import POINTS
from lightpage.device.state import Device
from lightpage.errors import FrameError, UnconfirmedPageError
from lightpage.metrics.measures import measure
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_drift import BundleSearch
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.simulator.simulator import Simulator

Figures = dict[str, Any]

LEVELS = 256
BRIGHT, DIM = POINTS
NOISY = "-0.6deg-32e-4px"
STILL = ["drift.shift_px=0.0"]
OFFSETS_STREAM, WRONG_STREAM, WALKS_STREAM = 10, 20, 30
"""Random streams."""


@dataclass(frozen=True)
class Point:
    """An operating point: a decoder with the device that it was made for."""

    name: str
    decoder: Decoder
    device: Device

    @cached_property
    def tracker(self) -> Tracker:
        """Tracker that has seen no page."""
        return tracker_for(self.decoder)

    @cached_property
    def search(self) -> BundleSearch:
        """The decoder's search."""
        return BundleSearch(self.decoder, OnnxTwin(self.decoder.bundle))

    @cached_property
    def pilots(self) -> Pilots:
        """The device's pilots."""
        return self.decoder.pilots(LEVELS)

    def simulator(self, seed: int, device: Device | None = None, *, reference_stays: bool = False) -> Simulator:
        """Return a simulator of the device, or of a changed one; the image stays where it is put."""
        still = (device or self.device).with_settings(STILL)
        profile = self.decoder.bundle.profile
        return Simulator(profile, still, LEVELS, seed, reference_stays=reference_stays)

    def symbols(self, *seed: int) -> NDArray[np.uint8]:
        """A page."""
        pages = random_symbols(self.decoder.bundle.profile, LEVELS, 1, np.random.default_rng(seed))
        return np.asarray(pages[0], np.uint8)

    def air(self, tracker: Tracker, pair: FramePair, symbols: NDArray[np.uint8]) -> tuple[float, Figures]:
        """AIR of a page, 0 where it is not given out, and what was seen of it."""
        begun = time.perf_counter()
        try:
            page = tracker.decode(pair, LEVELS)
        except (UnconfirmedPageError, FrameError) as error:
            return 0.0, {"lost": type(error).__name__, "seconds": time.perf_counter() - begun}
        data = ~self.pilots.mask
        figures = measure(page.phase[data], page.concentration[data], symbols[data], LEVELS)
        assert page.image is not None
        told = {
            "shift_px": [page.image.shift_x_px, page.image.shift_y_px],
            "tilt_rad": [page.image.tilt_x_rad, page.image.tilt_y_rad],
            "found": page.image.found,
            "share": page.check.share,
            "seconds": page.timings.total_s,
            "search_seconds": page.timings.search_s,
        }
        return figures.air_bits_per_symbol, told


def share_of(air: float, reference: float) -> float:
    """Return AIR as a share of a reference page's, 0 where that page was not read."""
    return air / reference if reference > 0 else 0.0


def points(out: Path, names: tuple[str, ...]) -> Iterator[Point]:
    """The operating points of these names."""
    if BRIGHT in names:
        yield Point(BRIGHT, Decoder.load(bundle_path(DEFAULT)), Device())
    if DIM not in names:
        return
    kept, bundle = TRAINED / "bench" / NOISY, out / "noisy.zip"
    if not bundle.exists():
        export_kept(kept, out / "noisy", bundle, refinements=0)
    yield Point(DIM, Decoder.load(bundle), data_set_of(kept)[1])
