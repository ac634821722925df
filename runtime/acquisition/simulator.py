"""A simulated device as a source."""

from __future__ import annotations

import threading
from urllib.parse import parse_qsl

import numpy as np

from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device, load_device
from lightpage.errors import InvalidInputError, PageError
from lightpage.page.symbols import pilot_mask, random_symbols
from lightpage.recording.reader import FramePair
from runtime.acquisition.source import SourcePage


class SimulatorSource:
    """A simulated device that writes a random page whenever one is read; the seed and the number fix its symbols."""

    def __init__(self, profile: Profile, device: Device, levels: int = 16, seed: int = 0, name: str = "") -> None:
        from lightpage.simulator.simulator import Simulator

        self._simulator = Simulator(profile, device, levels, seed)
        self._lock = threading.Lock()
        """Guards the simulator and the position; held while one page is simulated."""
        self._next, self._seed = 0, seed
        self.profile, self.levels, self.bit_depth = profile, levels, device.sensor.bit_depth
        self.name = name or f"simulator:{profile.name}"

    def check_against(self, profile: Profile) -> None:
        """Raise `InvalidInputError` unless the simulated device's shapes are those of `profile`."""
        own = (self.profile.frame_shape, self.profile.page_shape)
        if own != (expected := (profile.frame_shape, profile.page_shape)):
            raise InvalidInputError(f"source {self.name}", f"frames and pages of {own}", f"{expected}")

    def set_device(self, device: Device) -> None:
        """Let the device drift to another true state; the next page shows it."""
        with self._lock:
            self._simulator.set_device(device)

    def read(self, page: int | None = None) -> SourcePage:
        """Write and record page number `page`, or the next one.

        Raises:
            PageError: a negative page number.
        """
        with self._lock:
            if page is None:
                page, self._next = self._next, self._next + 1
            if page < 0:
                raise PageError(f"page of {self.name}", page, "a number of at least 0")
            rng = np.random.default_rng([self._seed, page])
            symbols = random_symbols(self.profile, self.levels, 1, rng)[0]
            return SourcePage(self._simulator.page(symbols), page, symbols, pilot_mask(self.profile))

    def references(self) -> FramePair:
        """Reference-only frames of the device as it is now."""
        with self._lock:
            return self._simulator.references()

    def close(self) -> None:
        """Nothing to let go of."""


def open_simulator(rest: str) -> SimulatorSource:
    """The source `simulator:REST`, REST being `PROFILE?KEY=VALUE&...`.

    Raises:
        InvalidInputError: an unknown profile, or settings that no device can have.
    """
    spec = f"simulator:{rest}"
    profile, _, query = rest.partition("?")
    settings = dict(parse_qsl(query, keep_blank_values=True))
    device = load_device(path) if (path := settings.pop("device", None)) else Device()
    try:
        levels, seed = int(settings.pop("levels", "16")), int(settings.pop("seed", "0"))
    except ValueError as error:
        raise InvalidInputError(f"source {spec}", error, "whole numbers for levels and seed") from None
    if settings or seed < 0:
        raise InvalidInputError(f"source {spec}", sorted(settings) or seed, "levels, seed (at least 0) and device only")
    return SimulatorSource(load_profile(profile), device, levels, seed, spec)
