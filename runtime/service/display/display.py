"""What a controller does for the source: it uploads pages, shows them, moves shutters, and says so."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import NoSourceError
from lightpage.runtime.device.acquisition.source import FrameSource
from lightpage.runtime.device.modulator.beam_state import BeamState
from lightpage.runtime.device.modulator.external import ExternalBeams, ExternalModulator


@dataclass(frozen=True)
class Wanted:
    """What the service waits for: a page on display, beams; None for nothing of the kind."""

    page: int | None = None
    beams: BeamState | None = None


class Display:
    """The controller's side of a source.

    Args:
        source: whose pages, modulator and beams.
    """

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        modulator, beams = source.modulator, source.beams
        self._modulator = modulator if isinstance(modulator, ExternalModulator) else None
        self._beams = beams if isinstance(beams, ExternalBeams) else None

    def upload(self, symbols: NDArray[np.uint8], levels: int) -> int:
        """Take in pages [page, ny, nx] of M levels; returns the first one's number.

        Raises:
            NoSourceError: the source shows no pages that it is given.
            PageError, InvalidInputError, LimitError: see `PageStore.append`.
        """
        pages = self._source.pages
        if pages is None:
            expected = "a source with a modulator, or one that was started with pages"
            raise NoSourceError(f"source {self._source.name}", "uploaded pages", expected)
        return pages.append(symbols, levels)

    def wanted(self) -> Wanted:
        """What is waited for now.

        Raises:
            NoSourceError: the source does all by itself.
        """
        if self._modulator is None and self._beams is None:
            raise self._alone()
        return Wanted(
            None if self._modulator is None else self._modulator.wanted(),
            None if self._beams is None else self._beams.wanted(),
        )

    def shown(self, page: int | None) -> None:
        """A page is on display; None: none is.

        Raises:
            NoSourceError: the source shows its pages by itself.
        """
        if self._modulator is None:
            raise self._alone()
        self._modulator.announce(page)

    def beams_set(self, state: BeamState) -> None:
        """The beams are so now.

        Raises:
            NoSourceError: the source moves its shutters by itself.
        """
        if self._beams is None:
            raise self._alone()
        self._beams.announce(state)

    def _alone(self) -> NoSourceError:
        expected = 'a source whose modulator or beams have kind = "external"'
        return NoSourceError(f"source {self._source.name}", "word from a controller", expected)
