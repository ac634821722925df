"""Where frame pairs come from when the service reads a page itself: a recording, a simulated device, later cameras."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device, load_device
from lightpage.errors import FrameError, InvalidInputError, PageError, RecordingError
from lightpage.page.symbols import pilot_mask, random_symbols
from lightpage.recording.reader import FramePair, Recording
from runtime.decoding.frames import narrow
from runtime.errors import SourceError


@dataclass(frozen=True)
class SourcePage:
    """One page as a source delivers it.

    Attributes:
        pair: both frames.
        page_index: which page.
        symbols: what was written, uint8 [ny, nx], or None where nobody knows.
        pilot_mask: where the pilots are, bool [ny, nx], or None for the device's usual positions.
    """

    pair: FramePair
    page_index: int
    symbols: NDArray[np.uint8] | None = None
    pilot_mask: NDArray[np.bool_] | None = None


class FrameSource(Protocol):
    """A thing to read pages from; its methods may be called from many threads."""

    @property
    def name(self) -> str:
        """For people, e.g. ``recording:R.h5``."""

    @property
    def levels(self) -> int:
        """Level count of its pages."""

    @property
    def bit_depth(self) -> int:
        """Bits of a camera count."""

    def check_against(self, profile: Profile) -> None:
        """Raise `InvalidInputError` unless its frames and pages have the shapes of `profile`."""

    def read(self, page: int | None = None) -> SourcePage:
        """Read page number `page`, or the next one; raises `PageError` where there is no such page."""

    def references(self) -> FramePair | None:
        """Reference-only frames as they are now, where the source has them."""

    def close(self) -> None:
        """Let go of files and devices."""


@contextmanager
def own_fault(thing: str = "") -> Iterator[None]:
    """Turn what is wrong with a source's file or frames into the service's fault; a page that is not there stays.

    Raises:
        SourceError: in place of a `RecordingError` or `FrameError`; `thing` goes before what it names.
    """
    try:
        yield
    except (RecordingError, FrameError) as error:
        raise SourceError(thing + error.thing, error.got, error.wanted) from error


class RecordingSource:
    """Pages of a recording, over and over again: after the last page the next one is the first.

    Raises:
        RecordingError: not a sound recording.
    """

    def __init__(self, path: str | Path) -> None:
        self._recording = Recording.open(path)
        self._lock = threading.Lock()
        """Guards the file and the position; held while one page is read."""
        self._next = 0
        self.name = f"recording:{path}"
        self.levels, self.bit_depth = self._recording.levels, self._recording.bit_depth

    def check_against(self, profile: Profile) -> None:
        """Raise `RecordingError` unless the recording's shapes are those of `profile`."""
        self._recording.check_against(profile)

    def read(self, page: int | None = None) -> SourcePage:
        """Read page `page` of the file, or the next one.

        Raises:
            PageError: no such page.
            RecordingError: it cannot be read.
        """
        recording = self._recording
        with self._lock:
            if page is None:
                page, self._next = self._next, (self._next + 1) % max(1, recording.pages)
            if not 0 <= page < recording.pages:
                raise PageError(f"page of {self.name}", page, f"0..{recording.pages - 1}")
            try:
                pair, symbols = narrow(recording.frames(page), self.bit_depth), recording.symbols(page)
                return SourcePage(pair, page, symbols, recording.pilots())
            except RecordingError as error:
                raise RecordingError(f"page {page}, {error.thing}", error.got, error.wanted) from None

    def references(self) -> FramePair:
        """The recording's reference frames."""
        with self._lock:
            return narrow(self._recording.references(), self.bit_depth)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._recording.close()


class SimulatorSource:
    """A simulated device that writes a random page whenever one is read; the seed and the number fix its symbols."""

    def __init__(self, profile: Profile, device: Device, levels: int = 16, seed: int = 0, name: str = "") -> None:
        from lightpage.simulator.simulator import (
            Simulator,  # its parts take long to import, and most services read no simulator
        )

        self._simulator = Simulator(profile, device, levels, seed)
        self._lock = threading.Lock()
        """Guards the simulator and the position; held while one page is simulated."""
        self._next, self._seed = 0, seed
        self.profile, self.levels, self.bit_depth = profile, levels, device.sensor.bit_depth
        self.name = name or f"simulator:{profile.name}"

    def check_against(self, profile: Profile) -> None:
        """Raise `InvalidInputError` unless the simulated device's shapes are those of `profile`."""
        own = (self.profile.frame_shape, self.profile.page_shape)
        if own != (wanted := (profile.frame_shape, profile.page_shape)):
            raise InvalidInputError(f"source {self.name}", f"frames and pages of {own}", f"{wanted}")

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


class CameraSource:
    """Real cameras, which this version cannot drive.

    Raises:
        InvalidInputError: always.
    """

    def __init__(self, address: str) -> None:
        raise InvalidInputError(
            f"source camera:{address}",
            "a camera, for which this installation has no driver",
            "the camera extra (pip install 'lightpage[camera]') in a version that drives cameras, "
            "or recording:FILE or simulator:PROFILE",
        )


def open_source(spec: str) -> FrameSource:
    """Open a source by its name.

    Args:
        spec: ``recording:FILE``, ``simulator:PROFILE`` (a shipped name or a file), optionally followed by
            ``?levels=16&seed=0&device=FILE``, or ``camera:ADDRESS``.

    Raises:
        InvalidInputError: another name, or one whose recording, profile or device does not validate.
    """
    kind, colon, rest = spec.partition(":")
    if colon and rest and kind == "recording":
        return RecordingSource(rest)
    if colon and rest and kind == "simulator":
        return _open_simulator(spec, rest)
    if colon and kind == "camera":
        # A constructor that only raises cannot be typed as the protocol.
        CameraSource(rest)
    raise InvalidInputError("source", repr(spec), "recording:FILE, simulator:PROFILE or camera:ADDRESS")


def _open_simulator(spec: str, rest: str) -> SimulatorSource:
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
