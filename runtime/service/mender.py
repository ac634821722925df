"""Ends the trouble of a source, e.g. a beam that stayed blocked, by trying again and again."""

from __future__ import annotations

import logging
import threading
from types import TracebackType
from typing import Self

from runtime.acquisition.source import FrameSource

PAUSES_S = (1.0, 2.0, 5.0, 10.0, 30.0)
"""Before each try; the last one before all that follow."""

_log = logging.getLogger(__name__)


class Mender:
    """Tries to mend a source that has trouble, as long as the `with` statement lasts.

    Args:
        source: of the service.
        pauses_s: see `PAUSES_S`.
    """

    def __init__(self, source: FrameSource, pauses_s: tuple[float, ...] = PAUSES_S) -> None:
        self._source, self._pauses_s = source, pauses_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._mend, name="lightpage-mender", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(self._pauses_s[0])

    def _mend(self) -> None:
        tries = 0
        while not self._stop.wait(self._pauses_s[min(tries, len(self._pauses_s) - 1)]):
            trouble = self._source.trouble()
            if not trouble:
                tries = 0
                continue
            tries += 1
            try:
                self._source.mend()
            except Exception as error:  # whatever it is, it is tried again
                _log.error("%s: %s; tried %d times", trouble, error, tries)
            else:
                _log.warning("%s: %s is well again", trouble, self._source.name)
