"""The light in a simulated device: what its two cameras would see of the page on display, and of the open beams."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.page.levels import MAX_LEVELS, check_levels
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import frame_type
from lightpage.simulator.simulator import Simulator

Counts = NDArray[np.unsignedinteger[Any]]


class Light:
    """Light of the page on display. Its methods may be called from many threads.

    Args:
        profile: nominal device.
        device: true state.
        seed: seed of noise and drift.
        black_level: counts that both cameras add.
    """

    def __init__(self, profile: Profile, device: Device, seed: int = 0, black_level: int = 0) -> None:
        self.bit_depth = device.sensor.bit_depth
        self._simulator = Simulator(profile, device, MAX_LEVELS, seed)
        self._black_level = black_level
        self._working = threading.Lock()
        """Held while the simulator works, which may take minutes."""
        self._lock = threading.Lock()
        """Guards what the cameras see; never held while anything is simulated."""
        self._page: FramePair | None = None
        self._reference, self._dark = self._simulator.references(), self._simulator.dark()
        self._signal = self._reference_beam = True
        self.page_index = -1

    def show(self, symbols: NDArray[np.uint8], levels: int, page: int) -> None:
        """Put a page of M levels on display; returns once its light is known, and until then the last one stands.

        Raises:
            PageError: symbols of the wrong shape or range.
        """
        check_levels(levels)
        with self._working:
            self._simulator.levels = levels
            pair = self._simulator.page(symbols)
            with self._lock:
                self._page, self.page_index = pair, page

    def let_through(self, *, signal: bool, reference: bool) -> None:
        """Open and close the shutters."""
        with self._lock:
            self._signal, self._reference_beam = signal, reference

    def set_device(self, device: Device) -> None:
        """Let the device drift; the next page that is shown shows it."""
        with self._working:
            self._simulator.set_device(device)
            references, dark = self._simulator.references(), self._simulator.dark()
            with self._lock:
                self._reference, self._dark = references, dark

    def pair(self) -> FramePair:
        """Return what both cameras see now, black level included."""
        with self._lock:
            if not self._reference_beam:
                pair = self._dark
            elif self._page is None or not self._signal:
                pair = self._reference
            else:
                pair = self._page
        return FramePair(self._seen(pair.in_phase), self._seen(pair.quadrature))

    def _seen(self, frame: NDArray[np.integer[Any]]) -> Counts:
        if self._black_level:
            frame = np.minimum(frame.astype(np.int64) + self._black_level, 2**self.bit_depth - 1)
        return frame.astype(frame_type(self.bit_depth))
