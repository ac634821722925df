"""What the service needs to know of whoever called: how long they wait, and whether they are still there."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from runtime.errors import CallerLeft


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
        self._left = False
        self._listeners: list[Callable[[], None]] = []

    @property
    def is_here(self) -> bool:
        """False once the caller has gone."""
        return not self._left

    def leave(self) -> None:
        """The caller has gone; whoever waits on its behalf is told at once."""
        with self._lock:
            self._left, listeners = True, list(self._listeners)
        for tell in listeners:
            tell()

    @contextmanager
    def telling(self, tell: Callable[[], None]) -> Iterator[None]:
        """Call `tell` when the caller leaves, within the `with` statement; at once for one who has left before."""
        with self._lock:
            self._listeners.append(tell)
            left = self._left
        if left:
            tell()
        try:
            yield
        finally:
            with self._lock:
                self._listeners.remove(tell)

    def check(self) -> None:
        """Raise `CallerLeft` if the caller has gone."""
        if self._left:
            raise CallerLeft
