"""Dynamic batching: pages that are inferred at the same time are computed in one run of a graph for batches."""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from weakref import finalize, ref

import numpy as np
from numpy.typing import NDArray

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import LightpageError
from lightpage.failures import lacks_memory
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import BATCH
from lightpage.runtime.model.decoding.batch_graph import (
    BatchGraph,
    Constants,
    FrameBuffer,
    fewer,
    holds_batches,
)
from lightpage.runtime.model.decoding.page import Inference
from lightpage.runtime.model.decoding.under_way import Phase, UnderWay
from lightpage.runtime.model.execution.estimator_graph import EstimatorGraph
from lightpage.runtime.model.execution.page_graph import REGISTRATION, PageGraph
from lightpage.runtime.model.execution.providers import ON_CPU

_log = logging.getLogger(__name__)

KEPT = 4
"""Tables whose constants are held: 640 MB each, of a full-size page by waves."""
_STALE = 64
"""Constants that were not asked for by so many pages make room for those of another table."""
_ALONE = 2
"""Pages that are computed alone at a time, where batches were wanted: many more are on their way then."""
_LOOK_S = 1.0
"""How often a page that waits for others says so."""
_BUFFERS = 2
"""One is filled while the graph runs from the other."""


@dataclass(frozen=True)
class Batching:
    """Choices of how pages are gathered.

    Attributes:
        largest: pages of a run, at most; 1 for none together.
        longest_wait_s: longest time for which a run waits while others are known to come.
        pages: pages that are under way, of all models that gather them so.
    """

    largest: int = 1
    longest_wait_s: float = 0.005
    pages: UnderWay = field(default_factory=UnderWay)


NO_BATCHES = Batching()


@dataclass(eq=False)
class _Run:
    """Pages that are computed together."""

    constants: Constants
    buffer: FrameBuffer
    since: float
    begun: float = 0.0
    threads: list[int] = field(default_factory=list)
    written: int = 0
    is_patient: bool = True
    inferences: list[Inference] | None = None
    error: BaseException | None = None

    @property
    def is_done(self) -> bool:
        return self.inferences is not None or self.error is not None


@dataclass(eq=False)
class _Ticket:
    """A page in the queue for a place in a run with these constants."""

    constants: Constants


@dataclass(eq=False)
class _Held:
    """Constants with the table that they follow from, and when they were last asked for."""

    graph: ref[PageGraph]
    own: NDArray[np.float32]
    constants: Constants
    asked: int = 0


def _beside(work: Callable[[], None]) -> None:
    """Have something done on a thread of its own."""
    threading.Thread(target=work, name="lightpage-constants").start()


class HeldConstants:
    """Constants of the tables in use, a few of them; those of a table that nothing decodes with any more are let go.

    Args:
        graph: graph that runs with them.
        table: table whose constants it has already.
        beside: has constants made, which takes as long as some pages do, while pages go on.
    """

    def __init__(
        self, graph: BatchGraph, table: PageGraph, beside: Callable[[Callable[[], None]], None] = _beside
    ) -> None:
        self._graph, self._beside, self._lock, self._asked = graph, beside, threading.Lock(), 0
        first = graph.constants_of_bundle
        self._held = [_Held(ref(table), first.registration, first)]
        self._making: set[PageGraph] = set()

    def of(
        self, table: PageGraph, registration: NDArray[np.float32] | None
    ) -> tuple[Constants, NDArray[np.float32]] | None:
        """Constants of a table, and by how much an image lies elsewhere than they have it, [2, 2] pixels.

        None where there is no room for them, or they are being made from now on.

        Args:
            table: which.
            registration: registration of the page; None for the table's.
        """
        with self._lock:
            self._asked += 1
            self._held = [held for held in self._held if held.graph() is not None]
            if (found := self._found(table, registration)) or table in self._making or not self._has_room():
                return found
            self._making.add(table)
        self._beside(partial(self._make, table, registration))
        with self._lock:
            return self._found(table, registration)

    def _found(
        self, table: PageGraph, registration: NDArray[np.float32] | None
    ) -> tuple[Constants, NDArray[np.float32]] | None:
        """See `of`: what is held."""
        for held in self._held:
            shift = held.constants.shift_of(held.own if registration is None else registration)
            if held.graph() is table and shift is not None:
                held.asked = self._asked
                return held.constants, shift
        return None

    def _make(self, table: PageGraph, registration: NDArray[np.float32] | None) -> None:
        """Make constants, and hold them in place of those that were not asked for the longest."""
        made = list[_Held]()
        try:
            own = table.value(REGISTRATION)
            made.append(_Held(ref(table), own, self._graph.constants(table, registration), self._asked))
        except Exception:  # its pages go one by one until it works
            _log.exception("%s: no constants of a table", self._graph.subject)
        finally:
            with self._lock:
                self._making.discard(table)
                self._held = [*sorted(self._held, key=lambda held: held.asked), *made][-KEPT:]

    def _has_room(self) -> bool:
        """Return whether there is room for one more, beside those that are being made."""
        stale = sum(self._asked - held.asked >= _STALE for held in self._held)
        return len(self._held) - stale + len(self._making) < KEPT


class OneByOne:
    """Gathers nothing: each page is computed alone.

    Args:
        at_once: pages that are computed at a time, at most; None for as many as come.
    """

    largest = 1

    def __init__(self, at_once: int | None = None) -> None:
        self.alone: AbstractContextManager[Any] = nullcontext() if at_once is None else threading.Semaphore(at_once)
        """Held while a page is computed alone."""

    def under_way(self) -> AbstractContextManager[None]:
        """A page is decoded within the `with` statement; until it is inferred, a batch may wait for it."""
        return nullcontext()

    def put_off(self) -> None:
        """Have no batch wait for the caller's page until it is inferred: that waits for something else."""

    def infer(
        self, table: PageGraph, pair: FramePair, registration: NDArray[np.float32] | None = None
    ) -> Inference | None:
        """The graph's answer to a page that is computed with others; None where it must be computed alone.

        Args:
            table: table that it is decoded with.
            pair: its frames, checked.
            registration: registration of the page; None for the table's.

        Raises:
            BundleError, ProviderError, SurroundingsError: see `BatchGraph.run`; each page of the run hears of it.
        """
        return None


class Batches(OneByOne):
    """Gathers pages of one bundle's graph for batches, and runs it. For many threads; the callers' own compute.

    A page that comes while nothing runs is computed at once, alone, unless frames of others are being checked. Pages
    that come while a run is on wait for its end, and are computed together then.

    Args:
        graph: graph that is run.
        table: table of the bundle.
        batching: how pages are gathered.
        clock: clock by which runs wait.
    """

    def __init__(self, graph: BatchGraph, table: PageGraph, batching: Batching, clock: Clock = SYSTEM) -> None:
        super().__init__(_ALONE)
        self._clock = clock
        self._graph, self._batching, self._constants = graph, batching, HeldConstants(graph, table)
        self.largest = min(batching.largest, graph.pages)
        """Pages of a run, at most; fewer once memory was short, until another model is gone."""
        self._pages, self._gone = batching.pages, batching.pages.gone
        finalize(self, batching.pages.let_go).atexit = False
        self._changed = threading.Condition()
        """Held while runs are looked at or changed, and never while anything is copied or computed."""
        self._free = [graph.buffer() for _ in range(_BUFFERS)]
        self._gathering: list[_Run] = []
        self._queue: deque[_Ticket] = deque()
        self._is_running = False

    @classmethod
    def opened(cls, bundle: Bundle, table: PageGraph, batching: Batching, threads: int | None) -> OneByOne:
        """Open a bundle's graph for batches; pages go one by one where it has none, which is logged, or none is wanted.

        Raises:
            BundleError, ProviderError: see `BatchGraph`.
        """
        if batching.largest == 1:
            return OneByOne()
        if not holds_batches(bundle):
            cure = (
                "as of every calibration alone" if isinstance(table, EstimatorGraph) else "lightpage export --batches"
            )
            _log.warning("%s: no %s, so pages are computed one by one (%s)", bundle.subject, BATCH, cure)
            return OneByOne(_ALONE)
        if table.provider == ON_CPU:
            _log.warning("%s: batches on a CPU take longer than pages one by one", bundle.subject)
        return cls(BatchGraph(bundle, table, batching.largest, threads), table, batching)

    @contextmanager
    def under_way(self) -> Iterator[None]:
        """See `OneByOne`."""
        self._pages.move(Phase.COMING, thread := threading.get_ident())
        try:
            yield
        finally:
            self._pages.move(None, thread)
            with self._changed:
                self._changed.notify_all()

    def infer(
        self, table: PageGraph, pair: FramePair, registration: NDArray[np.float32] | None = None
    ) -> Inference | None:
        """See `OneByOne`."""
        if (found := self._constants.of(table, registration)) is None:
            self._pages.went_alone()
            self.put_off()
            return None
        came, thread = self._clock.now(), threading.get_ident()
        behind = self._behind(thread)
        self._pages.move(Phase.WAITING, thread)
        try:
            run, place = self._joined(found[0], thread)
            try:
                run.buffer.put(place, pair, found[1])
            finally:  # if that is cut short, the others are computed all the same
                self._see_to(run)
        finally:
            self._pages.move(behind, thread)
        if run.inferences is None:
            assert run.error is not None
            raise copy(run.error) from run.error  # each caller's own: callers add to errors
        return replace(run.inferences[place], waited_s=run.begun - came)

    def put_off(self) -> None:
        """See `OneByOne`."""
        self._pages.move(self._behind(thread := threading.get_ident()), thread)
        with self._changed:
            self._changed.notify_all()

    def _behind(self, thread: int) -> Phase | None:
        return Phase.BEHIND if self._pages.knows(thread) else None

    def _joined(self, constants: Constants, thread: int) -> tuple[_Run, int]:
        """A run that is gathered with these constants, and the page's place in it."""
        ticket = _Ticket(constants)
        with self._changed:
            self._queue.append(ticket)
            try:
                self._wait_for(lambda: bool(self._open(constants) or (self._free and self._queue[0] is ticket)))
                if (run := self._open(constants)) is None:
                    run = _Run(constants, self._buffer(), self._clock.now())
                    self._gathering.append(run)
                run.threads.append(thread)
                return run, len(run.threads) - 1
            finally:
                self._queue.remove(ticket)
                self._changed.notify_all()

    def _open(self, constants: Constants) -> _Run | None:
        """A run that takes one more page with these constants."""
        same = (run for run in self._gathering if run.constants is constants and not self._is_full(run))
        return next(same, None)

    def _is_full(self, run: _Run) -> bool:
        return len(run.threads) >= min(self.largest, run.buffer.pages)

    def _buffer(self) -> FrameBuffer:
        """Memory that is free; there is more of it where runs are larger now."""
        buffer = self._free.pop()
        return buffer if buffer.pages >= self._graph.pages else self._graph.buffer()

    def _see_to(self, run: _Run) -> None:
        """Wait until a run is done, in which one more page is there; run it if nobody else does once it may begin."""
        with self._changed:
            run.written += 1
            self._changed.notify_all()
            self._wait(run)
            if run.is_done:
                return
            self._gathering.remove(run)
            self._is_running, run.begun = True, self._clock.now()
        inferences, failure = None, None
        try:
            self._grow()
            self._pages.move(Phase.RUNNING, *run.threads)
            inferences = self._computed(run)
        except BaseException as error:  # an interrupt too: others wait
            failure = error
        finally:
            self._pages.move(Phase.BEHIND, *run.threads)  # before their callers go on
            with self._changed:
                run.inferences, run.error = inferences, failure
                self._is_running = False
                self._free.append(run.buffer)
                self._changed.notify_all()

    def _wait(self, run: _Run) -> None:
        """Wait until a run is done, or may begin."""

        def over() -> bool:
            return run.is_done or self._may_begin(run)

        left_s = run.since + self._batching.longest_wait_s - self._clock.now()
        if not self._clock.wait_for(self._changed, over, left_s):
            run.is_patient = False
            self._wait_for(over)

    def _wait_for(self, over: Callable[[], bool]) -> None:
        while not self._changed.wait_for(over, _LOOK_S):
            self._pages.waits()

    def _may_begin(self, run: _Run) -> bool:
        """Return whether it is a run's turn, and nothing is to be waited for."""
        if self._is_running or [run] != self._gathering[:1] or run.written < len(run.threads):
            return False
        if self._is_full(run):
            return True
        if any(ticket.constants is run.constants for ticket in self._queue):  # which has been told that there is room
            return False
        return not run.is_patient or not self._pages.count(Phase.COMING)

    def _grow(self) -> None:
        """Have runs of as many pages as are wanted once more, where a model is gone since memory was short."""
        if self.largest == self._batching.largest or self._gone == self._pages.gone:
            return
        self._gone, before = self._pages.gone, self._graph.pages
        try:
            self._graph.fit(self._batching.largest)
        except LightpageError as error:
            self._graph.pages = before
            _log.warning("batches stay as they are: %s", error)
        self.largest = self._graph.pages

    def _computed(self, run: _Run) -> list[Inference]:
        """The graph's answers to a run's pages; in smaller runs from now on where there was no memory for so many."""
        pages, found = len(run.threads), list[Inference]()
        size = min(pages, self.largest)
        while (first := len(found)) < pages:
            part = slice(first, min(first + size, pages))
            try:
                found += self._graph.run(run.constants, run.buffer, part)
            except Exception as error:
                if (ran := part.stop - first) == 1 or not lacks_memory(error):
                    raise
                self.largest, self._gone = (size := fewer(ran)), self._pages.gone
                told = "%s: batches of %d pages from now on, since memory was short: %s"
                _log.warning(told, self._graph.subject, size, error)
            else:
                self._pages.ran(part.stop - first)
        return found
