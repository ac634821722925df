"""Callers that decode pages at the same time, and how many they get once all is warm."""

from __future__ import annotations

import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

Pages = Callable[[str], Iterator[object]]
"""Decodes pages for ever, for a caller of that name, and yields after each."""
_WARM_S = 3.0
"""Seconds before those that count: sizes of batches are met for the first time."""


def metrics_of(address: str) -> dict[str, float]:
    """The figures of a service, by name and labels; empty without an address."""
    if not address:
        return {}
    with urllib.request.urlopen(address, timeout=20) as answer:
        lines = (line.rpartition(" ") for line in answer.read().decode().splitlines() if not line.startswith("#"))
        return {name: float(value) for name, _, value in lines}


@dataclass
class _Window:
    """The time in which pages count."""

    pages: int = 0
    is_open: bool = False
    over: threading.Event = field(default_factory=threading.Event)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def count(self, pages: Iterator[object]) -> None:
        """Count the pages that are decoded while the window is open."""
        for _ in pages:
            if self.over.is_set():
                return
            with self.lock:
                self.pages += self.is_open


def rate(pages: Pages, callers: int, seconds: float, address: str = "") -> tuple[float, dict[str, float]]:
    """Pages a second of so many callers once all is warm, and by how much a service's figures grew in that time.

    Args:
        pages: decodes pages for each caller.
        callers: how many there are.
        seconds: time that count.
        address: address of the service's metrics; none without.

    Raises:
        Exception: what ended a caller.
    """
    window = _Window()
    with ThreadPoolExecutor(callers) as pool:
        begun = [pool.submit(window.count, pages(f"caller {number}")) for number in range(callers)]
        try:
            window.over.wait(_WARM_S)
            before, start, window.is_open = metrics_of(address), time.monotonic(), True
            window.over.wait(seconds)
            window.is_open, taken, after = False, time.monotonic() - start, metrics_of(address)
        finally:
            window.over.set()
        for each in begun:
            each.result()
    return window.pages / taken, {name: value - before.get(name, 0.0) for name, value in after.items()}
