"""A recalibrator that says when it runs and how it ended."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import PagesToUse, Recalibrator, Step
from lightpage.runtime.service.monitoring.monitor import Monitor


class WatchedRecalibrator(Recalibrator):
    """A recalibrator that says when it runs and how it ended.

    Args:
        plane: data plane of the service.
    """

    def __init__(self, plane: DataPlane) -> None:
        super().__init__(plane)
        self._ends = list[str]()
        self._lock = threading.Lock()
        self.running, self._pages = False, 0

    def follow(
        self, pages: PagesToUse, caller: Caller, expected_version: str = "", correlation_id: str = ""
    ) -> Iterator[Step | RecalibrationOutcome]:
        """See `Recalibrator`."""
        self.running, self._pages, end = True, 0, "done"
        try:
            yield from super().follow(pages, caller, expected_version, correlation_id)
        except Exception as error:
            end = type(error).__name__
            raise
        finally:
            self.running = False
            with self._lock:
                self._ends.append(end)

    def ended(self) -> list[str]:
        """Return how recalibrations ended since the last call."""
        with self._lock:
            ends, self._ends = self._ends, []
        return ends

    def settle(self, monitor: Monitor, pages: int) -> None:
        """Give a recalibration that is due time to begin, and wait for its end once it has run for `pages` pages."""
        if monitor.due and not self.running:
            _wait(lambda: self.running or not monitor.due, 0.5)
        if self.running:
            self._pages += 1
            if self._pages > pages:
                _wait(lambda: not self.running, 600.0)


def _wait(until: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not until() and time.monotonic() < end:
        time.sleep(0.02)
