"""Callers of the service and their calls: identity, rights, patience, and whether they have left."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Generic, TypeVar

from lightpage.errors import CallerLeft, NotAllowedError
from lightpage.runtime.service.stages import CallTimes

T = TypeVar("T")


class Role(StrEnum):
    """The rights of a caller. Every role may look; none but `ADMIN` includes another."""

    READ = "read"
    """See what the service is and does."""
    DECODE = "decode"
    """Have pages decoded and read, and show pages."""
    RECALIBRATE = "recalibrate"
    """Start and cancel recalibrations."""
    ADMIN = "admin"
    """All of it, and change models."""


ROLE_URI = "urn:lightpage:role:"
"""A certificate's subject alternative names of this kind, with a role behind, say what its owner may do."""


@dataclass(frozen=True)
class Identity:
    """A caller.

    Attributes:
        name: common name of its certificate; empty on a connection that needs none.
        roles: roles that the certificate names.
        until: end of the certificate, seconds since 1970.
    """

    name: str
    roles: frozenset[Role]
    until: float = math.inf

    def may(self, role: Role) -> bool:
        """Return whether it has a role, or one that includes it."""
        return role in self.roles or Role.ADMIN in self.roles or (role is Role.READ and bool(self.roles))

    def check(self, role: Role, what: str, now: float) -> None:
        """Check that it may do something.

        Args:
            role: role that this needs.
            what: it does, e.g. ``call Rollback``.
            now: seconds since 1970.

        Raises:
            NotAllowedError: it may not, or its certificate has ended while it was connected.
        """
        if now >= self.until:
            raise NotAllowedError(what, f"a certificate of {self.name} that has expired", "one that is valid")
        if not self.may(role):
            roles = ", ".join(f"role {role}" for role in sorted(self.roles)) or "no role"
            got = f"{self.name} with {roles}"
            raise NotAllowedError(what, got, f"a certificate with {ROLE_URI}{role}")


LOCAL = Identity("", frozenset(Role))
"""Whoever reaches a service that asks for no certificates: a process of this machine."""
STRANGER = Identity("nobody", frozenset())
"""Whoever has no certificate where one is asked for."""


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


MOST_SESSIONS = 256
"""Sessions that are remembered."""


class Sessions(Generic[T]):
    """State of each session: the pages of different callers are kept apart.

    Args:
        make: makes what belongs to a new one.
        most: that are remembered; of more, the one that was silent for longest is forgotten, and begins anew.
    """

    def __init__(self, make: Callable[[str], T], most: int = MOST_SESSIONS) -> None:
        self._make, self._most, self._lock = make, most, threading.Lock()
        self._known: OrderedDict[str, T] = OrderedDict()

    def of(self, session: str) -> T:
        """Return what belongs to a session."""
        with self._lock:
            if (found := self._known.pop(session, None)) is None:
                found = self._make(session)
            self._known[session] = found
            if len(self._known) > self._most:
                self._known.popitem(last=False)
            return found

    def all(self) -> list[T]:
        """Return what belongs to those that are remembered."""
        with self._lock:
            return list(self._known.values())


@dataclass(frozen=True)
class Actor:
    """The author of a change to the service, for its records.

    Attributes:
        name: address of a caller, or what in the service acts by itself.
        correlation_id: the caller's own text, empty where it gave none.
    """

    name: str
    correlation_id: str = ""


NOBODY = Actor("the service")
"""Where nobody is known."""


class Caller:
    """A caller that waits for an answer. The default waits for ever and never leaves.

    Args:
        seconds_left: how long the caller still waits, infinite without a deadline.
        session: session whose pages are followed together, see `Sessions`; empty for the device's own.
        stateless: whether every page is decoded as if it were the first.
        actor: who it is, for records.
        least_steps: fewest Gauss-Newton steps of a page that it takes where its time is short; 0 for all of them.
    """

    def __init__(
        self,
        seconds_left: Callable[[], float] = lambda: math.inf,
        session: str = "",
        stateless: bool = False,
        actor: Actor = NOBODY,
        least_steps: int = 0,
    ) -> None:
        self.seconds_left, self.session, self.stateless = seconds_left, session, stateless
        self.actor = actor
        self.least_steps = least_steps
        self._lock = threading.Lock()
        self._left = threading.Event()
        self._listeners: list[Callable[[], None]] = []

    def in_session(self, session: str, stateless: bool, least_steps: int = 0) -> Caller:
        """The same caller, whose pages are followed so; when one of both leaves, the other has left too."""
        other = copy(self)
        other.session, other.stateless = session, stateless
        other.least_steps = least_steps
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


@dataclass
class Call:
    """Facts of a call beside its request, for its handler.

    Attributes:
        method: name of the RPC.
        caller: who waits for the answer.
        pool: threads for what blocks.
        peer: address and connection that it came from.
        correlation_id: the caller's own text for the log, empty where it gave none.
        begun: when its first byte came, by `time.perf_counter`.
        times: times of its pages.
        identity: who calls.
    """

    method: str
    caller: Caller
    pool: Executor
    peer: str = ""
    correlation_id: str = ""
    begun: float = field(default_factory=time.perf_counter)
    times: CallTimes = field(default_factory=CallTimes)
    identity: Identity = LOCAL

    @property
    def actor(self) -> Actor:
        """Return the caller's name, for records."""
        return Actor(f"{self.identity.name} at {self.peer}" if self.identity.name else self.peer, self.correlation_id)

    def own(self, name: str) -> str:
        """A name that the caller gave to a session or a request, where other callers' are others; empty for none."""
        return name and own_name(name, self.identity.name)

    def session(self, name: str) -> str:
        """Return where the pages of a session that the caller named are followed; empty for none."""
        return name and named_session(name, self.identity.name)

    @property
    def connection_session(self) -> str:
        """Return where the pages of its connection are followed; empty where gRPC has one name for all connections."""
        return "" if self.peer.startswith("unix:") else f"connection {self.own(self.peer)}"

    async def in_thread(self, work: Callable[[], T], otherwise: Callable[[], None] | None = None) -> T:
        """Do in a thread what blocks or computes; when the call ends before, the work goes on by itself.

        Args:
            work: what is done.
            otherwise: runs instead of `work` if the call is cancelled while `work` is queued.
        """
        future = self.pool.submit(work)
        if otherwise is not None:
            future.add_done_callback(lambda done: otherwise() if done.cancelled() else None)
        return await asyncio.wrap_future(future)
