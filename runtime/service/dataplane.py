"""The data plane that all calls share, without a word of gRPC: models, source, decoding, and observers of pages."""

import logging
import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lightpage.clock import SYSTEM, Clock
from lightpage.codec.page_bytes import Header, Loss, PageBytes
from lightpage.errors import (
    FrameError,
    FramesDisagreeError,
    InvalidInputError,
    LostPageError,
    NoSourceError,
    Reason,
    SlotsTakenError,
    SourceError,
    UnconfirmedPageError,
)
from lightpage.page.levels import MAX_LEVELS
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.device.acquisition.source import FrameSource
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage, StepLimit, Timings
from lightpage.runtime.model.decoding.tracking import Tracker, unconfirmed_page
from lightpage.runtime.model.decoding.turns import Turn
from lightpage.runtime.service.admission import Heart, ReceiveBudget, Slots
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.models.loader import Model
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import Monitor, Monitors
from lightpage.runtime.service.monitoring.observation import Observation, Observer
from lightpage.runtime.service.shared_memory import SharedMemory
from lightpage.runtime.service.stages import Stage, Stages

_log = logging.getLogger(__name__)

_LEAST_WAIT_S = 1e-3
"""A page that waited for its batch, or its turn, for less is not told to have queued."""


class Seen:
    """Facts of a page that become known while it is read and decoded.

    Args:
        subject, page_index, model_version: see `Observation`.
        clock: seconds since 1970.
        lap: seconds that never go back, by which the page is timed.
    """

    def __init__(
        self,
        subject: str,
        page_index: int | None,
        model_version: str,
        clock: Callable[[], float] = time.time,
        lap: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._clock, self._lap = clock, lap
        self.observation = Observation(subject, page_index, model_version, clock(), 0.0)
        self._begun = lap()

    def note(self, **known: Any) -> None:
        """Take in fields of `Observation`."""
        self.observation = replace(self.observation, **known)

    def ended(self, lost: Reason | None, detail: str) -> Observation:
        """The observation of the page, which was given out or lost now."""
        seconds = self._lap() - self._begun
        return replace(self.observation, time_s=self._clock(), seconds=seconds, lost=lost, detail=detail)


@contextmanager
def observed(observers: Sequence[Observer], seen: Seen) -> Iterator[Seen]:
    """Tell the observers of a page that is read and decoded inside the block, given out or lost.

    A page of the source whose frames contradict each other is told of as lost, with an unspecified reason. Other errors
    say nothing of a page. What an observer raises is logged: it costs nobody a page.
    """
    try:
        yield seen
    except LostPageError as error:
        if isinstance(error, UnconfirmedPageError):
            seen.note(page=unconfirmed_page(error))
        _tell(observers, seen, error.reason, str(error))
        raise
    except SourceError as error:
        if isinstance(error.__cause__, FramesDisagreeError):
            _tell(observers, seen, Reason.UNSPECIFIED, str(error))
        raise
    _tell(observers, seen, None, "")


def _tell(observers: Sequence[Observer], seen: Seen, lost: Reason | None, detail: str) -> None:
    if not observers:
        return
    observation = seen.ended(lost, detail)
    for observer in observers:
        try:
            observer.observe(observation)
        except Exception:
            _log.exception("%s could not take note of %s", type(observer).__name__, observation.subject)


@dataclass(frozen=True)
class Answer:
    """A decoded page with the model that decoded it, the seconds that it took, and user bytes if asked for.

    `monitor_signs` names the signs by which many pages of its device or session say that a recalibration is due.
    """

    page: DecodedPage
    model_version: str
    receive_s: float
    total_s: float
    user_data: PageBytes | None = None
    monitor_signs: tuple[str, ...] = ()

    @property
    def recalibration_due(self) -> bool:
        """Return whether the device has changed since it was calibrated, as this page or many together show."""
        return self.page.check.recalibration_due or bool(self.monitor_signs)


@dataclass(frozen=True)
class Place:
    """A page's place among those of its device or session.

    Attributes:
        tracker: follows them.
        turn: turn of the page.
        limit: limit on the time of its steps, None where all are taken.
    """

    tracker: Tracker
    turn: Turn
    limit: StepLimit | None


class DataPlane:
    """The service's logic. Every method may be called from many threads.

    Args:
        models: it decodes with them, and hears of what comes into service.
        source: where `read_page` reads from, or None.
        limits: what is accepted.
        metrics: what is counted.
        observers: are told of every page.
        monitor: says by all pages of the service's own device whether a recalibration is due: those of the source, and
            those of `device_sessions`. Other sessions of callers get monitors of their own with the same settings.
        device_sessions: sessions of callers whose frames are of the device, by their names in `Caller.session`.
        clock: clock by which callers wait for slots and answers, and what hangs is known.

    Raises:
        InvalidInputError: the source is not for this device.
    """

    def __init__(
        self,
        models: Models,
        source: FrameSource | None = None,
        limits: Limits | None = None,
        metrics: ServiceMetrics | None = None,
        observers: Sequence[Observer] = (),
        monitor: Monitor | None = None,
        device_sessions: Collection[str] = (),
        clock: Clock = SYSTEM,
    ) -> None:
        self.models, self.clock = models, clock
        self.limits = limits or Limits()
        self.metrics = metrics or ServiceMetrics()
        self.monitors = Monitors(monitor, device_sessions, observers, shows_device=source is not None)
        self.metrics.sessions_due.set_function(self.monitors.sessions_due)
        self._source = source
        if source is not None:
            _check_source(source, models.current.decoder)
        self.shared: SharedMemory | None = None
        """Memory that clients share with the service."""
        self.heal: Callable[[Caller, str, int], bool] | None = None
        """Makes the model fit the device again and waits for that, see `SelfCalibration.heal`; None where none does."""
        self.heart = Heart(self.limits.decode_s, clock.now)
        self.received = ReceiveBudget(self.limits.receive_bytes)
        self.decodes = Slots(self.limits.concurrent_decodes, "decodes", self.limits.deadline_s, clock)
        self.ranges = Slots(self.limits.concurrent_ranges, "ranges of pages", self.limits.deadline_s, clock)
        self.watches = Slots(self.limits.concurrent_watches, "watches of the display", self.limits.deadline_s, clock)
        self.uploads = Slots(1, "uploads of models", self.limits.deadline_s, clock)
        models.in_service = self._in_service
        self._in_service(models.current)
        self.metrics.watch_load(self.decodes, self.received)
        self.metrics.watch_steps(self.steps_s)
        if models.store.folder.is_kept:
            self.metrics.watch_store(models.store.health, models.store.known_trouble)
        if source is not None:
            self.metrics.watch(source)
            if source.pages is not None:
                source.pages.most_bytes = self.limits.uploaded_bytes

    @property
    def source(self) -> FrameSource:
        """The source of pages.

        Raises:
            SourceError: this service has none.
        """
        if self._source is None:
            raise NoSourceError("source", "none", "a service started with --source")
        return self._source

    @property
    def has_source(self) -> bool:
        """Return whether `read_page` can work."""
        return self._source is not None

    @property
    def together(self) -> int:
        """Pages that the model in service may compute together, 1 for none."""
        return self.models.current.decoder.batches.largest

    def steps_s(self) -> list[float]:
        """Usual inference with 1, 2, ... steps of the model in service, seconds; none for a network."""
        graph = self.models.current.decoder.graph
        return [graph.times.seconds(steps) for steps in range(1, graph.steps + 1)]

    def ahead(self, alone: int = 1) -> int:
        """Pages of one call that are on their way at a time: so many `alone`, or else a batch and the next one.

        As many at most as their frames fill half of the memory for what is received.
        """
        if (together := self.together) == 1:
            return alone
        frames = self.models.current.decoder.bundle
        pair = 2 * math.prod(frames.profile.frame_shape) * np.dtype(frames.manifest.frame_dtype).itemsize
        return max(alone, min(2 * together, self.received.size // (2 * pair)))

    @property
    def default_levels(self) -> int:
        """The level count where a caller names none: that of the source's pages, or 256."""
        return MAX_LEVELS if self._source is None else self._source.levels

    def answer(
        self, page: DecodedPage, model: Model, stages: Stages, found: PageBytes | None, monitor: Monitor | None
    ) -> Answer:
        """Return what was decoded, with the times so far and the signs of the page's monitor."""
        stages.begin(Stage.RESPOND)
        receive_s = stages.seconds().get(Stage.RECEIVE, 0.0)
        return Answer(
            page, model.version, receive_s, stages.elapsed_s, found, () if monitor is None else monitor.raised
        )

    @contextmanager
    def optics(self, user_data: bool) -> Iterator[None]:
        """Count a page whose bytes were asked for and that is not decoded."""
        try:
            yield
        except (LostPageError, FrameError):
            if user_data:
                self.metrics.data_pages.labels(Loss.OPTICS.value).inc()
            raise

    def user_data(
        self, model: Model, page: DecodedPage, stages: Stages, monitor: Monitor | None, expected: Header | None = None
    ) -> PageBytes:
        """The bytes of a page that was decoded, counted."""
        stages.begin(Stage.CODE)
        found = model.decoder.page_codec.decode(page.phase, page.concentration, expected)
        stages.begin(Stage.POST_PROCESSING)
        self.metrics.user_data(found, shown=self.monitors.shows(monitor))
        return found

    def trouble(self) -> str:
        """Why the service cannot be said to serve, empty where it can: a decode hangs, or its source cannot be read."""
        return self.heart.trouble() or (self._source.trouble() if self._source is not None else "")

    def _in_service(self, model: Model) -> None:
        together = model.decoder.batches.largest
        both = 2 * together if together > 1 else 1  # a batch runs while the next one is gathered
        self.decodes.resize(max(self.limits.concurrent_decodes, both))
        self.received.keep(both)
        self.metrics.in_service(model.version)
        self.monitors.begin(model.version)

    def waiting(self, caller: Caller) -> Callable[[], None]:
        """Return what to call again and again while a caller's page waits for others: no decode hangs for that.

        It raises `CallerLeft` once the caller has gone, and `SlotsTakenError` once its time is up.
        """

        def still() -> None:
            self.heart.waits()
            caller.check()
            if caller.seconds_left() <= 0:
                expected = "its turn within the deadline; try again later"
                raise SlotsTakenError("page", "others before it still decoded", expected, retry_s=1.0)

        return still

    def check_time(self, caller: Caller) -> None:
        """Turn a caller away for whom a page would come too late; see `Slots.check`."""
        self.decodes.check(caller, self._optional_s(caller))

    def slot(self, caller: Caller) -> AbstractContextManager[None]:
        """Hold a slot for a page in a `with` statement; see `Slots.take`."""
        return self.decodes.held(caller, self._optional_s(caller))

    def took(self, model: Model, seconds: float, timings: Timings) -> None:
        """Learn from a page how long pages take, without what it waited for its turn."""
        skipped_s = timings.skipped_steps * model.decoder.graph.times.step_s
        self.decodes.took(seconds - timings.turn_s, skipped_s)

    def _optional_s(self, caller: Caller) -> float:
        """Time of the steps that may be left out for a caller, seconds."""
        graph = self.models.current.decoder.graph
        if not caller.least_steps:
            return 0.0
        return graph.times.seconds(graph.steps) - graph.times.seconds(min(caller.least_steps, graph.steps))

    def _limit(self, model: Model, caller: Caller) -> StepLimit | None:
        """Limit on the time of a page's steps, where its caller takes fewer than all."""
        if not caller.least_steps:
            return None
        graph = model.decoder.graph
        behind_s = max(0.0, self.decodes.needed_s - graph.times.seconds(graph.steps))
        return StepLimit(caller.least_steps, lambda: caller.seconds_left() - behind_s)

    @contextmanager
    def place(self, model: Model, caller: Caller) -> Iterator[Place]:
        """The place of a caller's page behind all that have one; it is left at the end of the `with` statement."""
        tracker = model.tracker_for(caller)
        with closing(tracker.turn(self.waiting(caller))) as turn:
            yield Place(tracker, turn, self._limit(model, caller))

    def decode(
        self,
        model: Model,
        place: Place,
        pair: FramePair,
        levels: int,
        pilots: Pilots | None,
        subject: str,
        stages: Stages,
        monitor: Monitor | None,
        *,
        sure: bool = True,
    ) -> DecodedPage:
        """Decode with a model that was taken once, and count the page, which an error calls `subject`.

        Of a page that its pilots do not confirm, only pilots that are `sure` say anything of the device: a caller's may
        be wrong.
        """
        stages.begin(Stage.INFERENCE)
        try:
            with self.heart.at_work():
                page = place.tracker.decode(pair, levels, pilots, place.turn, place.limit)
        except LostPageError as error:
            if isinstance(error, UnconfirmedPageError):
                _inferred(unconfirmed_page(error), stages)
            self.metrics.lost(error, tells=sure and self.monitors.shows(monitor))
            error.recalibration_due = (error.recalibration_due and sure) or (monitor is not None and monitor.due)
            raise error.about(subject) from None
        _inferred(page, stages)
        self.metrics.page(page, model.version, shown=self.monitors.shows(monitor))
        return page


def _inferred(page: DecodedPage, stages: Stages) -> None:
    """Split a finished decode's time between the stages inference, queue and post-processing.

    The graph may run more than once, with post-processing between: all its runs count as if they were the first part.
    """
    inferred_s, waited_s = page.timings.check_s + page.timings.inference_s, page.timings.waited_s
    if waited_s >= _LEAST_WAIT_S:
        stages.begin(Stage.QUEUE, inferred_s)
        inferred_s = waited_s
    stages.begin(Stage.POST_PROCESSING, inferred_s)


def levels_for(decoder: Decoder, asked: int | None, usual: int, user_data: bool) -> int:
    """Return the level count to decode a page at.

    Args:
        decoder: decoder of the model.
        asked: level count that the caller asks for; None leaves the choice.
        usual: level count if `asked` is None and no user bytes are wanted.
        user_data: whether user bytes are wanted: then the level count must be that of the code.

    Raises:
        BundleError: user bytes are wanted, and the model has no code.
        InvalidInputError: user bytes are wanted, and `asked` is not the code's level count.
    """
    if not user_data:
        return usual if asked is None else asked
    expected = decoder.page_codec.code.levels
    if asked not in (None, expected):
        raise InvalidInputError("levels", asked, f"{expected}, as the code of {decoder.version} has, or 0")
    return expected


def _check_source(source: FrameSource, decoder: Decoder) -> None:
    source.check_against(decoder.bundle.profile)
    depth = decoder.bundle.manifest.camera_bit_depth
    if source.bit_depth != depth:
        raise InvalidInputError(f"source {source.name}", f"{source.bit_depth} bits", f"{depth} bits, as the bundle")
