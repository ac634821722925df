"""Recalibrates the model in service by itself when the monitor says that it is due."""

import logging
import threading
from collections.abc import Iterator, Sequence
from typing import Annotated, Self

from pydantic import Field

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import (
    BusyError,
    CallerLeft,
    InvalidInputError,
    LightpageError,
    RecalibrationRefusedError,
    StoppingError,
)
from lightpage.runtime.recalibration.known_pages import MIN_PAGES
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome
from lightpage.runtime.service.caller import Actor, Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.kept_pages import KeptPages
from lightpage.runtime.service.jobs.recalibrator import PagesToUse, Recalibrator
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.table import Rule, Seconds, SettingsTable, Text

_log = logging.getLogger(__name__)

_TO_ANSWER_S = 1.0
"""Part of a caller's time that is left to it when waiting for a recalibration ends."""

WORTH_BITS = 0.02
"""Information a symbol that a recalibration must bring for the next one to come as soon. Those of a simulated week of a
bench device bring 0.03 and more. One that brings less cures nothing that the monitor complains of."""


class SelfCalibrationSettings(SettingsTable):
    """Occasions and pages of automatic recalibrations: the table [self_calibration] of the service's settings."""

    enabled: bool | None = Field(
        None, description="Recalibrate when the monitor says so; by default where calibration pages are named."
    )
    device_sessions: Annotated[tuple[Text, ...], Field(strict=False)] = ()
    """Sessions whose frames, which callers send, are of the device: the monitor counts them as it does the pages of the
    source. With TLS each is CALLER/SESSION, CALLER being the name in the caller's certificate."""
    pages: tuple[Annotated[int, Field(ge=0, le=2**32 - 1)], ...] = Field(
        (),
        strict=False,
        description="Pages of the source whose symbols are known, by number. Without, the last pages that were read "
        "serve, or those that were lost, or the next two.",
    )
    least_s: Seconds = 60.0
    """Shortest time between two recalibrations: a device that drifts faster needs a mechanic."""
    longest_s: Seconds = 3600.0
    """Longest time between two recalibrations. Each refusal or failure, and each recalibration that brings next to
    nothing, doubles the time up to it. What was refused once will hardly be better a minute later, and each try costs
    reads a few pages' time."""
    most_share: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 0.1
    """Largest share of all time that recalibrations take, whatever a sender of noise sends."""
    busy_s: Seconds = 5.0
    """Time after which the service looks again whether a caller's recalibration has ended."""

    @property
    def is_on(self) -> bool:
        """Return whether the service recalibrates itself."""
        return bool(self.pages) if self.enabled is None else self.enabled

    def rules(self) -> Iterator[Rule]:
        """Yield the rules among times, and those of pages."""
        least = f"at least self_calibration.least_s, which is {self.least_s:g}"
        yield self.longest_s >= self.least_s, "longest_s", least
        differ = len(self.pages) >= MIN_PAGES and len({*self.pages}) == len(self.pages)
        yield not self.pages or differ, "pages", f"at least {MIN_PAGES} that differ: one to fit, one to judge by"


class SelfCalibration:
    """A thread that recalibrates when the monitor says so; to be used in a `with` statement.

    A recalibration that is refused or fails changes nothing, and no request fails because of one. Its pages are
    photographed between those that are read.

    Args:
        plane: plane of the service.
        monitor: says when it is due.
        recalibrator: recalibrator of the service.
        settings: when and with what.
        clock: clock by which it waits.
        kept: the last pages of the device; None where none are kept.
    """

    def __init__(
        self,
        plane: DataPlane,
        monitor: Monitor,
        recalibrator: Recalibrator,
        settings: SelfCalibrationSettings | None = None,
        clock: Clock = SYSTEM,
        kept: KeptPages | None = None,
    ) -> None:
        self._plane, self._monitor, self._recalibrator, self._kept = plane, monitor, recalibrator, kept
        self._settings, self._clock = settings or SelfCalibrationSettings(), clock
        _check_pages(plane, self._settings.pages)
        self._interval_s, self._not_before, self._begun = self._settings.least_s, -float("inf"), 0.0
        self._wake, self._stopping = threading.Event(), threading.Event()
        self._lock, self._asked = threading.Lock(), list[threading.Event]()
        """Events of callers that wait for the end of the next try."""
        self._thread = threading.Thread(target=self._run, name="lightpage-self-calibration", daemon=True)
        self._caller = Caller(actor=Actor("self-calibration"))
        self._pinned = False
        """Whether it was said that the model in service is pinned."""
        monitor.listen(self._wake.set)

    def __enter__(self) -> Self:
        self._thread.start()
        self._plane.heal = self.heal
        return self

    def __exit__(self, *_: object) -> None:
        """Drop a recalibration that runs, and end the thread, which is waited for as calls are."""
        wait_s = self._plane.limits.grace_s
        self._plane.heal = None
        with self._lock:
            self._stopping.set()
            asked, self._asked = self._asked, []
        for done in asked:
            done.set()
        self._caller.leave()
        self._wake.set()
        self._thread.join(wait_s)
        if self._thread.is_alive():
            _log.warning("self-calibration: not stopped after %.1f s, left to itself", wait_s)

    def _run(self) -> None:
        while True:
            self._clock.wait(self._wake, self._pause_s())
            self._wake.clear()
            with self._lock:
                asked, self._asked = self._asked, []
            try:
                if self._stopping.is_set():
                    return
                self.look(asked=bool(asked))
            except Exception:
                _log.exception("self-calibration: goes on")
                self._wait(self._settings.busy_s)
            finally:
                for done in asked:
                    done.set()

    def look(self, *, asked: bool = False) -> None:
        """Recalibrate if that was asked for or the monitor says that it is due, and the last time was long ago."""
        if (asked or self._monitor.due) and self._clock.now() >= self._not_before:
            self._try_once()

    def heal(self, caller: Caller, version: str, lost: int) -> bool:
        """Recalibrate for a caller whose pages are lost, as soon as that may be, and wait for the end.

        Where the last recalibration is not long enough ago, none begins and nobody waits; as many callers wait as
        ranges are read at once. One lost page that nothing else is kept with is not enough: a model fitted by it could
        not be judged. After a knock the first lost page is tried by pages of before it, which brings nothing.

        Args:
            caller: waits for as long as it has time. Where it leaves, the work goes on.
            version: version of the model that has lost the pages.
            lost: how many it has lost.

        Returns:
            Whether another model is in service.

        Raises:
            CallerLeft: the caller has gone.
        """
        model, done = self._plane.models.current, threading.Event()
        if model.version != version:
            return True
        if self._settings.pages:
            enough = lost >= MIN_PAGES
        else:
            enough = self._kept is not None and self._kept.enough_for_lost(model.decoder)
        with self._lock:
            if not enough or self._stopping.is_set() or len(self._asked) >= self._plane.ranges.count:
                return False
            self._asked.append(done)
        self._wake.set()
        most_s = min(caller.seconds_left() - _TO_ANSWER_S, self._plane.limits.recalibration_s)
        with caller.telling(done.set):
            self._clock.wait(done, max(0.0, most_s))
        caller.check()
        return self._plane.models.current.version != version

    def _pause_s(self) -> float:
        """Return how long to sleep where nobody wakes: until it is looked again where a try is due, else for ever."""
        left = max(0.0, self._not_before - self._clock.now())
        return min(left, self._settings.busy_s) if self._monitor.due else threading.TIMEOUT_MAX

    def _try_once(self) -> None:
        """Recalibrate, and decide when the next time may be; not while the model in service is pinned."""
        now, self._begun = self._plane.models.now, self._clock.now()
        if now.state.known(now.current.version).pinned:
            if not self._pinned:
                _log.info("self-calibration: put off, since the model in service is pinned")
            self._pinned = True
            self._wait(self._settings.busy_s)
            return
        self._pinned = False
        reasons = "; ".join(self._monitor.state().reasons) or "pages were lost"
        _log.info("self-calibration: begins, since %s", reasons)
        try:
            *_, outcome = self._recalibrator.follow(self._pages(), self._caller)
        except (CallerLeft, StoppingError):
            _log.info("self-calibration: dropped, the service stops")
            self._wait(self._settings.busy_s)
        except BusyError as error:
            self._begun = self._clock.now()  # it waited, and took nothing
            _log.info("self-calibration: put off by %.0f s: %s", self._wait(self._settings.busy_s), error)
        except Exception as error:
            self._back_off(error)
        else:
            assert isinstance(outcome, RecalibrationOutcome)  # the last thing that it tells
            if self._kept is not None:
                self._kept.clear()
            cured = outcome.air_after - outcome.air_before >= WORTH_BITS
            least_s, longest_s = self._settings.least_s, self._settings.longest_s
            self._interval_s = least_s if cured else min(2 * self._interval_s, longest_s)
            self._wait(self._interval_s)
            _log.info(
                "self-calibration: %s in service after %.1f s, %.3f instead of %.3f bit a symbol",
                outcome.version,
                outcome.seconds,
                outcome.air_after,
                outcome.air_before,
            )

    def _pages(self) -> PagesToUse:
        """Return the pages to recalibrate by: named ones, or else kept ones, or else the source's next ones.

        Raises:
            SourceError: there is none of them.
        """
        named = self._settings.pages
        kept = self._recalibrator.kept_pages(self._kept) if self._kept is not None and not named else None
        return kept or self._recalibrator.source_pages(len(named) or MIN_PAGES, named)

    def _back_off(self, error: Exception) -> None:
        self._interval_s = min(2 * self._interval_s, self._settings.longest_s)
        wait_s = self._wait(self._interval_s)
        end = "refused" if isinstance(error, RecalibrationRefusedError) else "failed"
        unforeseen = None if isinstance(error, LightpageError) else error
        _log.warning("self-calibration: %s, next in %.0f s: %s", end, wait_s, error, exc_info=unforeseen)

    def _wait(self, seconds: float) -> float:
        """Begin no other one for so long, nor before this one has taken no more than its share; returns the seconds."""
        now = self._clock.now()
        took_s = max(0.0, now - self._begun)
        self._not_before = max(now + seconds, self._begun + took_s / self._settings.most_share)
        return self._not_before - now


def _check_pages(plane: DataPlane, pages: Sequence[int]) -> None:
    """See that a source that is given no more pages has these.

    Raises:
        InvalidInputError: it has not.
    """
    count = plane.source.page_count() if pages and plane.has_source and plane.source.pages is None else None
    if count is not None and max(pages) >= count:
        expected = f"pages of {plane.source.name}, which has 0..{count - 1}"
        raise InvalidInputError("calibration pages", max(pages), expected)
