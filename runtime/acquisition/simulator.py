"""A simulated device as a source."""

from __future__ import annotations

import threading
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np

from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device, load_device
from lightpage.errors import InvalidInputError, PageError
from lightpage.page.symbols import pilot_mask, random_symbols
from lightpage.recording.pages import Pages
from lightpage.recording.reader import FramePair
from runtime.acquisition.source import SHOT_S, FrameSource, Shot


class SimulatorSource(FrameSource):
    """A simulated device that writes a page whenever one is read.

    Args:
        profile: nominal device.
        device: true state.
        levels: M of random pages.
        seed: it and the number fix a random page's symbols.
        name: for people.
        written: pages that the modulator shows in place of random ones; their level count holds.

    Raises:
        RecordingError: pages for another profile.
    """

    def __init__(
        self,
        profile: Profile,
        device: Device,
        levels: int = 16,
        seed: int = 0,
        name: str = "",
        written: Pages | None = None,
    ) -> None:
        from lightpage.simulator.simulator import Simulator

        if written is not None:
            written.check_against(profile)
        levels = levels if written is None else written.levels
        self._written = written
        self._simulator = Simulator(profile, device, levels, seed)
        self._lock = threading.Lock()
        """Guards the simulator and the position; held while one page is simulated."""
        self._next, self._seed = 0, seed
        self.profile, self.levels, self.bit_depth = profile, levels, device.sensor.bit_depth
        self.frame_shape, self.page_shape = profile.frame_shape, profile.page_shape
        self.name = name or f"simulator:{profile.name}"

    def set_device(self, device: Device) -> None:
        """Let the device drift to another true state; the next page shows it."""
        with self._lock:
            self._simulator.set_device(device)

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        """Write and record page number `page`, or the next one; after the last page to write the next is the first.

        Raises:
            PageError: no such page.
            RecordingError: it cannot be read from the pages to write.
        """
        with self._lock:
            if page is None:
                page, self._next = self._next, self._next + 1
                page = page if self._written is None else page % len(self._written)
            if page < 0 or (self._written is not None and page >= len(self._written)):
                expected = "a number of at least 0" if self._written is None else f"0..{len(self._written) - 1}"
                raise PageError(f"page of {self.name}", page, expected)
            if self._written is not None:
                symbols = self._written[page]
            else:
                rng = np.random.default_rng([self._seed, page])
                symbols = random_symbols(self.profile, self.levels, 1, rng)[0]
            return Shot(self._simulator.page(symbols), page, symbols, pilot_mask(self.profile))

    def references(self) -> FramePair:
        """Reference-only frames of the device as it is now."""
        with self._lock:
            return self._simulator.references()

    def close(self) -> None:
        """Close the pages to write."""
        if self._written is not None:
            self._written.close()


def open_simulator(rest: str) -> SimulatorSource:
    """The source `simulator:REST`, REST being `PROFILE?KEY=VALUE&...` (levels, seed, device, symbols).

    Raises:
        InvalidInputError: an unknown profile, or settings that no device can have.
    """
    spec = f"simulator:{rest}"
    profile, _, query = rest.partition("?")
    settings = dict(parse_qsl(query, keep_blank_values=True))
    device = load_device(path) if (path := settings.pop("device", None)) else Device()
    try:
        symbols = settings.pop("symbols", None)
        levels, seed = int(settings.pop("levels", "16")), int(settings.pop("seed", "0"))
    except ValueError as error:
        raise InvalidInputError(f"source {spec}", error, "whole numbers for levels and seed") from None
    if settings or seed < 0:
        raise InvalidInputError(
            f"source {spec}", sorted(settings) or seed, "levels, seed (at least 0), device and symbols only"
        )
    written = None if symbols is None else Pages.open(Path(symbols))
    return SimulatorSource(load_profile(profile), device, levels, seed, spec, written)
