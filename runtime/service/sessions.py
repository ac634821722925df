"""Keeps apart what the pages of different callers show: each session follows the image by itself."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable

from lightpage.runtime.model.decoding.tracking import Tracker

MOST_SESSIONS = 256
"""Sessions that a model remembers; of more, the one that was silent for longest is forgotten, and begins anew."""


def own_name(name: str, caller: str) -> str:
    """A name that a caller gave to something, where other callers' are others.

    Args:
        name: not empty.
        caller: the name in its certificate; empty without one, and then the name is shared.
    """
    return f"{len(caller)}:{caller}/{name}" if caller else name


def named_session(name: str, caller: str) -> str:
    """The session that a caller has named, as `Caller.session` has it; see `own_name`."""
    return f"session {own_name(name, caller)}"


class Sessions:
    """A tracker for each session.

    Args:
        make: makes the tracker of a new one.
        most: that are remembered.
    """

    def __init__(self, make: Callable[[], Tracker], most: int = MOST_SESSIONS) -> None:
        self._make, self._most = make, most
        self._lock = threading.Lock()
        self._trackers: OrderedDict[str, Tracker] = OrderedDict()

    def tracker(self, session: str) -> Tracker:
        """That of a session."""
        with self._lock:
            found = self._trackers.pop(session, None) or self._make()
            self._trackers[session] = found
            while len(self._trackers) > self._most:
                self._trackers.popitem(last=False)
            return found
