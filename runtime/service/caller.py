"""What the service needs to know of whoever called: how long they wait, and whether they are still there."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass

from lightpage.errors import CallerLeft


@dataclass(frozen=True)
class Actor:
    """Who does something to the service, for its records.

    Attributes:
        name: address of a caller, or what in the service acts by itself.
        correlation_id: the caller's own text, empty where it gave none.
    """

    name: str
    correlation_id: str = ""


NOBODY = Actor("the service")
"""Where nobody is known."""


class Caller:
    """Whoever waits for an answer. The default waits for ever and never leaves.

    Args:
        seconds_left: how long the caller still waits, infinite without a deadline.
        session: whose pages are followed together, see `Sessions`; empty for the device's own.
        stateless: whether every page is decoded as if it were the first.
        actor: who it is, for records.
    """

    def __init__(
        self,
        seconds_left: Callable[[], float] = lambda: math.inf,
        session: str = "",
        stateless: bool = False,
        actor: Actor = NOBODY,
    ) -> None:
        self.seconds_left, self.session, self.stateless = seconds_left, session, stateless
        self.actor = actor
        self._lock = threading.Lock()
        self._left = threading.Event()
        self._listeners: list[Callable[[], None]] = []

    def in_session(self, session: str, stateless: bool) -> Caller:
        """The same caller, whose pages are followed so; when one of both leaves, the other has left too."""
        other = copy(self)
        other.session, other.stateless = session, stateless
        return other

    @property
    def is_here(self) -> bool:
        """False once the caller has gone."""
        return not self._left.is_set()

    def leave(self) -> None:
        """The caller has gone; whoever waits on its behalf is told at once."""
        with self._lock:
            self._left.set()
            listeners = list(self._listeners)
        for tell in listeners:
            tell()

    @contextmanager
    def telling(self, tell: Callable[[], None]) -> Iterator[None]:
        """Call `tell` when the caller leaves, within the `with` statement; at once for one who has left before."""
        with self._lock:
            self._listeners.append(tell)
        if not self.is_here:
            tell()
        try:
            yield
        finally:
            with self._lock:
                self._listeners.remove(tell)

    def check(self) -> None:
        """Raise `CallerLeft` if the caller has gone."""
        if not self.is_here:
            raise CallerLeft
