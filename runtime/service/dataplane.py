"""What the service does, without a word of gRPC: decode, read pages, hand over to recalibration, change models."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.clock import SYSTEM, Clock
from lightpage.codec.page_bytes import Header, Loss, PageBytes
from lightpage.errors import (
    FrameError,
    InvalidInputError,
    LostPageError,
    NoSourceError,
    SourceError,
    UnconfirmedPageError,
)
from lightpage.page.levels import MAX_LEVELS
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.device.acquisition.source import FrameSource, Shot, own_fault
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import unconfirmed_page
from lightpage.runtime.service.caller import NOBODY, Actor, Caller
from lightpage.runtime.service.display.display import Display
from lightpage.runtime.service.frames.receiver import PairReceiver, ReceiveBudget
from lightpage.runtime.service.frames.shared_memory import SharedMemory
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.models.audit import AuditLog
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.registry import Model, ModelRegistry
from lightpage.runtime.service.models.store import ModelStore
from lightpage.runtime.service.models.store_health import StoreHealth
from lightpage.runtime.service.monitoring.heart import Heart
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import Monitor, SessionMonitors
from lightpage.runtime.service.monitoring.observation import Observer, Seen, observed
from lightpage.runtime.service.monitoring.stages import Stage, Stages
from lightpage.runtime.service.pages.replays import Replays
from lightpage.runtime.service.slots import Slots


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
        """Whether the device has changed since it was calibrated, as this page or many together show."""
        return self.page.check.recalibration_due or bool(self.monitor_signs)


@dataclass(frozen=True)
class ReadAnswer:
    """An answer for a page of the source, with what the source knows of it."""

    answer: Answer
    shot: Shot
    pilot_mask: NDArray[np.bool_]


class DataPlane:
    """The service's logic. Every method may be called from many threads.

    Args:
        registry: the models.
        source: where `read_page` reads from, or None.
        store: remembers which model is in service, or None.
        limits: what is accepted.
        metrics: what is counted.
        observers: are told of every page.
        monitor: says by all pages of the service's own device whether a recalibration is due: those of the source, and
            those of `device_sessions`. Other sessions of callers get monitors of their own with the same settings.
        audit: where changes of models are written down, None for the log alone.
        device_sessions: sessions of callers whose frames are of the device, by their names in `Caller.session`.
        clock: by which callers wait for slots and answers, and what hangs is known.

    Raises:
        InvalidInputError: the source is not for this device.
    """

    def __init__(
        self,
        registry: ModelRegistry,
        source: FrameSource | None = None,
        store: ModelStore | None = None,
        limits: Limits | None = None,
        metrics: ServiceMetrics | None = None,
        observers: Sequence[Observer] = (),
        monitor: Monitor | None = None,
        audit: AuditLog | None = None,
        device_sessions: Collection[str] = (),
        clock: Clock = SYSTEM,
    ) -> None:
        self.registry, self.store = registry, store
        self.limits = limits or Limits()
        self.metrics = metrics or ServiceMetrics()
        self.monitor, self.audit = monitor, audit or AuditLog()
        self._changing = threading.Lock()
        """Held from before a change of models until it is written down, so that the record has them in their order."""
        self.observers, self._device_sessions = tuple(observers), frozenset(("", *device_sessions))
        self._session_monitors = None if monitor is None else SessionMonitors(monitor.settings)
        if self._session_monitors is not None:
            self.metrics.sessions_due.set_function(self._session_monitors.due)
        self._source = source
        if source is not None:
            _check_source(source, registry.current.decoder)
        self.received = ReceiveBudget(self.limits.receive_bytes)
        self.shared: SharedMemory | None = None
        """Memory that clients share with the service."""
        self.heart = Heart(self.limits.decode_s, clock.now)
        self.replays = Replays(self.limits.replay_s, self.limits.replay_bytes, clock)
        self.decodes = Slots(self.limits.concurrent_decodes, "decodes", self.limits.deadline_s, clock)
        self.ranges = Slots(self.limits.concurrent_ranges, "ranges of pages", self.limits.deadline_s, clock)
        self.watches = Slots(self.limits.concurrent_watches, "watches of the display", self.limits.deadline_s, clock)
        self.uploads = Slots(1, "uploads of models", self.limits.deadline_s, clock)
        self.models = Models(registry, store, self.limits.model_bytes, self._in_service, self.audit)
        self.store_health = StoreHealth(self.models.trouble, clock=clock)
        """Tells of the store without waiting for its disk."""
        self._in_service(registry.current)
        self.metrics.watch_load(self.decodes, self.received)
        if store is not None:
            self.metrics.watch_store(self.store_health, store.known_trouble)
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
    def display(self) -> Display:
        """The controller's side of the source.

        Raises:
            SourceError: this service has none.
        """
        return Display(self.source)

    @property
    def has_source(self) -> bool:
        """Whether `read_page` can work."""
        return self._source is not None

    @property
    def default_levels(self) -> int:
        """The level count where a caller names none: that of the source's pages, or 256."""
        return MAX_LEVELS if self._source is None else self._source.levels

    def check_format(self, shape: tuple[int, int], dtype: str, bit_depth: int) -> None:
        """Check what a caller says of frames against the camera, before a byte is allocated for them.

        Raises:
            LimitError: the pair is larger than the service accepts.
            FrameError: not this device's size, type or bit depth.
        """
        # Size first: a header may claim anything, and a limit is the service's, not the camera's.
        if 2 * shape[0] * shape[1] * np.dtype(dtype).itemsize > self.limits.pair_bytes:
            PairReceiver(shape, dtype, self.limits.pair_bytes)
        bundle = self.registry.current.decoder.bundle
        expected = (bundle.profile.frame_shape, bundle.manifest.frame_dtype, bundle.manifest.camera_bit_depth)
        if (shape, dtype, bit_depth) != expected:
            raise FrameError(
                "frame pair",
                f"{shape[0]}x{shape[1]} pixels, {dtype}, {bit_depth} bits",
                f"{expected[0][0]}x{expected[0][1]} pixels, {expected[1]}, {expected[2]} bits",
            )

    def receiver(self, shape: tuple[int, int], dtype: str, bit_depth: int, caller: Caller) -> PairReceiver:
        """A receiver for one pair, to be closed; see `check_format`.

        Raises:
            LimitError, FrameError: see `check_format`.
            OverloadedError: there is so much to decode that the caller's deadline would pass.
        """
        self.check_format(shape, dtype, bit_depth)
        self.decodes.check(caller)
        return PairReceiver(shape, dtype, self.limits.pair_bytes, self.received)

    def check_user_data(self) -> None:
        """Check that the source's pages can be read for their bytes.

        Raises:
            BundleError: the model in service has no code.
            SourceError: there is no source.
        """
        _ = self.source, self.registry.current.decoder.page_codec

    def decode(
        self,
        pair: FramePair,
        levels: int | None,
        caller: Caller,
        pilots: Pilots | None = None,
        *,
        user_data: bool = False,
        version: str = "",
        stages: Stages | None = None,
    ) -> Answer:
        """Decode a pair with the model in service.

        Args:
            pair: both frames.
            levels: M; None stands for `default_levels`, or for that of the code where user bytes are asked for.
            caller: who waits; nothing is computed for one who has gone.
            pilots: known symbols where they differ from the device's pattern.
            user_data: whether to read the page's bytes too.
            version: of the model that must be in service; empty for any.
            stages: times the page.

        Raises:
            BundleError: user bytes are asked for, and the model has no code.
            InvalidInputError: they are, and `levels` are not the code's.
            OtherModelError: another model is in service.
            SlotsTakenError: no slot until the caller's time is up.
            CallerLeft: the caller has gone.
            UnconfirmedPageError, FrameError, PageError: see `Tracker.decode`.
        """
        stages = stages or Stages()
        stages.begin(Stage.QUEUE)
        with self.decodes.held(caller):
            began = time.perf_counter()
            # Taken once: a swap in the meantime changes the next request, not this one.
            model = self.registry.expect(version)
            sure = pilots is None
            levels = levels_for(model.decoder, levels, self.default_levels, user_data)
            if user_data:
                pilots = pilots or model.decoder.written_pilots(levels)
            subject, monitor = "frame pair", self._monitor_of(caller)
            seen = Seen(subject, None, model.version)
            seen.note(tells=sure, pair=pair, of_device=monitor is not None and monitor is self.monitor)
            with observed(self._observers(monitor), seen):
                with self._optics(user_data):
                    page = self._decode(model, caller, pair, levels, pilots, subject, stages, monitor, sure=sure)
                found = self._user_data(model, page, stages, monitor) if user_data else None
                seen.note(page=page, user_data=found)
            self.decodes.took(time.perf_counter() - began)
        return self._answer(page, model, stages, found, monitor)

    def read_page(
        self,
        page: int | None,
        levels: int | None,
        caller: Caller,
        *,
        user_data: bool = False,
        expected: Header | None = None,
        stages: Stages | None = None,
    ) -> ReadAnswer:
        """Read a page from the source and decode it; `levels` None stands for the source's own, or the code's.

        Args:
            page: which; the next one if None.
            levels: M.
            caller: who waits.
            user_data: whether to read the page's bytes too.
            expected: the page of its volume that should be there, where that is known.
            stages: times the page.

        Raises:
            BundleError, InvalidInputError: see `decode`.
            SourceError: no source, or one that is damaged or dark.
            PageError: no such page, or an impossible level count; else as `decode`.
        """
        source, stages = self.source, stages or Stages()
        stages.begin(Stage.QUEUE)
        # The slot first: pages that wait for one shall not be read yet, nor lie in memory.
        with self.decodes.held(caller):
            model, begun = self.registry.current, time.perf_counter()
            seen = Seen(f"{'next page' if page is None else f'page {page}'} of {source.name}", page, model.version)
            with observed(self._observers(self.monitor), seen):
                stages.begin(Stage.RECEIVE)
                found = self._shot(source, page, caller, user_data)
                subject = f"page {found.page_index} of {source.name}"
                seen.note(subject=subject, page_index=found.page_index, levels=source.levels)
                seen.note(pair=found.pair, infos=found.infos, symbols=found.symbols, pilot_mask=found.pilot_mask)
                mask = self._mask(found, model.decoder)
                levels = levels_for(model.decoder, levels, source.levels, user_data)
                if user_data and not np.array_equal(mask, model.decoder.bundle.pilot_mask):
                    raise SourceError(f"{source.name}: pilots", "other places", "those of the model in service")
                # Pilots are what was written, whatever level count the caller wants to see.
                if found.symbols is not None:
                    pilots = Pilots.of_symbols(mask, found.symbols, source.levels)
                else:
                    own = model.decoder
                    pilots = own.written_pilots(levels) if user_data else own.pilots(source.levels, mask)
                with own_fault(f"{subject}: "), self._optics(user_data):
                    decoded = self._decode(model, caller, found.pair, levels, pilots, subject, stages, self.monitor)
                data = self._user_data(model, decoded, stages, self.monitor, expected) if user_data else None
                seen.note(page=decoded, user_data=data)
            self.decodes.took(time.perf_counter() - begun)
        return ReadAnswer(self._answer(decoded, model, stages, data, self.monitor), found, mask)

    def _monitor_of(self, caller: Caller) -> Monitor | None:
        """What follows the frames that a caller sends; None where each is decoded as if it were the first."""
        if caller.stateless or self._session_monitors is None:
            return None
        return self.monitor if caller.session in self._device_sessions else self._session_monitors.of(caller.session)

    def _shows(self, monitor: Monitor | None) -> bool:
        """Whether the figures of the last page are to show one that `monitor` follows: with a source, the device's."""
        return monitor is self.monitor or not self.has_source

    def _observers(self, monitor: Monitor | None) -> Sequence[Observer]:
        """Who is told of a page, its monitor first."""
        return self.observers if monitor is None else (monitor, *self.observers)

    def _answer(
        self, page: DecodedPage, model: Model, stages: Stages, found: PageBytes | None, monitor: Monitor | None
    ) -> Answer:
        stages.begin(Stage.RESPOND)
        receive_s = stages.seconds().get(Stage.RECEIVE, 0.0)
        return Answer(page, model.version, receive_s, stages.elapsed_s, found, _signs(monitor))

    def _shot(self, source: FrameSource, page: int | None, caller: Caller, user_data: bool) -> Shot:
        """A page of the source; a lost shot is counted."""
        try:
            with own_fault(), self._optics(user_data):
                return source.shot(min(source.shot_s, caller.seconds_left()), page)
        except LostPageError as error:
            self.metrics.lost(error)
            raise

    @contextmanager
    def _optics(self, user_data: bool) -> Iterator[None]:
        """Count a page whose bytes were asked for and that is not decoded."""
        try:
            yield
        except (LostPageError, FrameError):
            if user_data:
                self.metrics.no_user_data(Loss.OPTICS)
            raise

    def _user_data(
        self,
        model: Model,
        page: DecodedPage,
        stages: Stages,
        monitor: Monitor | None,
        expected: Header | None = None,
    ) -> PageBytes:
        """The bytes of a page that was decoded, counted."""
        stages.begin(Stage.CODE)
        found = model.decoder.page_codec.decode(page.phase, page.concentration, expected)
        stages.begin(Stage.POST_PROCESSING)
        self.metrics.user_data(found, shown=self._shows(monitor))
        return found

    def adopt(self, decoder: Decoder, expected: Model | None = None, *, actor: Actor = NOBODY) -> Model:
        """Put a recalibrated decoder in service; see `Models.adopt`."""
        return self.models.adopt(decoder, expected, actor)

    def rollback(self, expected_version: str = "", *, actor: Actor = NOBODY) -> tuple[Model, Model]:
        """Go back to the model before; see `Models.rollback`."""
        return self.models.rollback(expected_version, actor)

    def trouble(self) -> str:
        """Why the service cannot be said to serve, empty where it can: a decode hangs, or its source cannot be read."""
        return self.heart.trouble() or (self._source.trouble() if self._source is not None else "")

    def store_trouble(self) -> str:
        """What is wrong with the store, empty where nothing is, or where there is none; see `Models.trouble`."""
        trouble = self.models.trouble()
        return "" if trouble is None else trouble.text

    def _in_service(self, model: Model) -> None:
        self.metrics.in_service(model.version)
        if self.monitor is not None:
            self.monitor.begin(model.version)
        if self._session_monitors is not None:
            self._session_monitors.begin(model.version)

    @staticmethod
    def _mask(found: Shot, decoder: Decoder) -> NDArray[np.bool_]:
        return decoder.bundle.pilot_mask if found.pilot_mask is None else found.pilot_mask

    def _decode(
        self,
        model: Model,
        caller: Caller,
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
                page = model.tracker_for(caller).decode(pair, levels, pilots)
        except LostPageError as error:
            if isinstance(error, UnconfirmedPageError):
                _inferred(unconfirmed_page(error), stages)
            self.metrics.lost(error, tells=sure and self._shows(monitor))
            error.recalibration_due = (error.recalibration_due and sure) or (monitor is not None and monitor.due)
            raise error.about(subject) from None
        _inferred(page, stages)
        self.metrics.page(page, model.version, shown=self._shows(monitor))
        return page


def _signs(monitor: Monitor | None) -> tuple[str, ...]:
    """Signs of a monitor by which a recalibration is due; empty where it is not."""
    if monitor is None or not monitor.due:
        return ()
    raised = tuple(sign.name for sign in monitor.state().signs if sign.raised and sign.decides)
    return raised or ("other",)


def _inferred(page: DecodedPage, stages: Stages) -> None:
    """Tell what of a decode, which has run as inference until now, was inference.

    The graph may run more than once, with post-processing between: all its runs count as if they were the first part.
    """
    stages.begin(Stage.POST_PROCESSING, page.timings.check_s + page.timings.inference_s)


def levels_for(decoder: Decoder, asked: int | None, usual: int, user_data: bool) -> int:
    """The level count to decode a page at.

    Args:
        decoder: of the model.
        asked: by the caller; None leaves the choice.
        usual: that None stands for where only symbols are asked for.
        user_data: whether its bytes are asked for: then it must be that of the code.

    Raises:
        BundleError: user bytes are asked for, and the model has no code.
        InvalidInputError: they are, and another level count.
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
