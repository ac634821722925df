"""A simulated device as a source."""

import threading
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np

from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device, load_device
from lightpage.errors import InvalidInputError, NoSuchPageError
from lightpage.page.levels import MAX_LEVELS
from lightpage.page.symbols import pilot_mask, random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.pages import Pages
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.source import SHOT_S, FrameSource, Shot


class SimulatorSource(FrameSource):
    """A simulated device that writes a page whenever one is read.

    Args:
        profile: nominal device.
        device: true state.
        levels: M of random pages.
        seed: it and the number fix a random page's symbols.
        name: name for people.
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

        levels = levels if written is None else written.levels
        self.pages = None if written is None else PageStore(profile, written)
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
                page = page if self.pages is None else page % max(1, len(self.pages))
            if self.pages is not None:
                symbols = self.pages[page]
            elif page < 0:
                raise NoSuchPageError(f"page of {self.name}", page, "a number of at least 0")
            else:
                rng = np.random.default_rng([self._seed, page])
                symbols = random_symbols(self._simulator.profile, self.levels, 1, rng)[0]
            return Shot(self._simulator.page(symbols), page, symbols, pilot_mask(self._simulator.profile))

    def references(self) -> FramePair:
        """Reference-only frames of the device as it is now."""
        with self._lock:
            return self._simulator.references()

    def show_pages(self, pages: PageStore) -> None:
        """See `FrameSource.show_pages`."""
        with self._lock:
            if self.pages is not None:
                self.pages.close()
            self.pages, self.levels = pages, pages.levels or MAX_LEVELS
            self._simulator.levels = self.levels

    def close(self) -> None:
        """Close the pages to write."""
        if self.pages is not None:
            self.pages.close()


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
        got = sorted(settings) or seed
        raise InvalidInputError(f"source {spec}", got, "levels, seed (at least 0), device and symbols only")
    written = None if symbols is None else Pages.open(Path(symbols))
    nominal = load_profile(profile)
    return SimulatorSource(nominal, device.of_profile(nominal), levels, seed, spec, written)
