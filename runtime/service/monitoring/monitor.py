"""Says whether the device has changed so far that a recalibration pays, from many pages and not from one."""

import logging
import math
import statistics
import threading
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from lightpage.codec.page_bytes import Loss
from lightpage.errors import Reason
from lightpage.runtime.recalibration.judgement import DRIFTED_STROKE
from lightpage.runtime.service.caller import MOST_SESSIONS, Caller, Sessions
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.observation import Observation, Observer

_log = logging.getLogger(__name__)

Figures = Mapping[str, float]
"""What one page shows, by the names of signs."""

_MAD_DEVIATIONS = 1.4826
"""Standard deviations of a normal distribution in a median absolute deviation."""

_MEDIAN_ERROR = 1.25
"""Standard error of a median of many normal values over that of their mean."""

SHOWS_DEVICE = (Reason.PILOTS_DISAGREE, Reason.IMAGE_NOT_FOUND, Reason.TOO_FEW_PILOTS, Reason.UNSPECIFIED)
"""Losses that say something of the device's calibration, frames that contradict each other among them; a lost shot does
not."""

_UNREADABLE = (Loss.BODY, Loss.CHECKSUM)
"""Losses of user bytes that do too; a page without a header of this code may hold no user bytes."""


@dataclass(frozen=True)
class Sign:
    """A figure of pages, and when it says that a recalibration is due.

    The baseline is the best median among the first pages of a model, or the middle one where rise and fall count. The
    sign is raised when the median of the last pages differs from the baseline by more than `raise_by`, and by at least
    `deviations` of their noise. It is cleared when the difference falls below `clear_by`.

    Attributes:
        name: name of the figure.
        window: number of pages whose median counts.
        raise_by, clear_by: distances from the baseline, in the figure's unit.
        rises: whether a rise raises the sign, and not a fall.
        either: whether both do.
        relative: whether `raise_by` and `clear_by` are shares of the baseline.
        absolute: whether the baseline is 0 whatever the first pages show.
        mean: whether the mean counts and not the median, as for shares of pages.
        decides: whether it makes a recalibration due; otherwise it is shown alone.
        deviations: standard errors of the median; the best of many medians lies up to two of them above the mean.
    """

    name: str
    window: int
    raise_by: float
    clear_by: float
    rises: bool = False
    either: bool = False
    relative: bool = False
    absolute: bool = False
    mean: bool = False
    decides: bool = True
    deviations: float = 6.5


MARGIN = Sign("margin_bits", window=7, raise_by=0.5, clear_by=0.3, relative=True)
"""Information beyond what the page's code needs, by its corrected bits: what users lose when it is gone. It is the AIR
by the page's own symbols but for a constant; of eleven quiet bench pages both were correlated by 0.98. Pages of a quiet
bench device show 0.117 +- 0.019 bit. Half of it is six standard errors of the median away, and leaves the other half of
the way to recalibrate in."""

AIR = Sign("air_bits", window=35, raise_by=0.006, clear_by=0.003, relative=True)
"""Information that a phase is claimed to carry, as far as the pilots bear it out: all that is known where bytes are not
read. A quiet bench page shows 6.57 +- 0.05 bit, and 0.13 bit less where its margin is gone. Its 54 pilots tell that
only together with those of many pages, hence the long window, and not always in time: read bytes where you can."""

TRUST = Sign("trust", window=35, raise_by=0.05, clear_by=0.025)
"""Share of the claimed concentration that the pilots bear out. Of a quiet bench device it is 0.97 +- 0.06, its median
over 35 pages never below 0.97; where its margin is gone it is 0.88."""

SHARE = Sign("share", window=15, raise_by=0.045, clear_by=0.025)
"""Share of the claimed information that the pilots confirm: 1.01 +- 0.02 on a quiet bench device, 0.98 where its margin
is gone. It tells a large change sooner than the signs above; at 0.85 a page by itself says that a recalibration is due.
"""

UNREAD = Sign("unread", window=8, raise_by=0.45, clear_by=0.2, rises=True, absolute=True, mean=True)
"""Share of pages that were lost to their optics, or whose bytes were. Four of eight are no accident: after a knock the
alarm comes with the fourth page."""

CHANGED = Sign("page_due", window=8, raise_by=0.45, clear_by=0.2, rises=True, absolute=True, mean=True)
"""Share of pages whose pilots confirm so little that each by itself says that a recalibration is due. It needs no
baseline: it tells of a device that had changed before its model came into service."""

RESIDUAL = Sign("residual_rad", window=7, raise_by=0.03, clear_by=0.015, rises=True)
"""Smooth phase error that was taken off each page. A quiet bench device shows 0.002 +- 0.001 rad; ten times that is a
wavefront that the calibration does not know."""

SHIFT = Sign("shift_px", window=5, raise_by=4.0, clear_by=3.0, rises=True, absolute=True)
"""Distance of the image from where calibration saw it. It is followed, yet a search reaches 12 px: a third of that is
left to a device's walk (0.9 px in a quiet week), the rest to a knock."""

STROKE = Sign("stroke_relative", window=15, raise_by=DRIFTED_STROKE, clear_by=0.001, either=True)
"""Change of the modulator's stroke since calibration, as the pilots show it. A quiet bench page
shows 0.0000 +- 0.0012, so 0.002 is five standard errors of the median; twice that costs a tenth of a bit."""

PISTON_WALK = Sign("piston_walk_rad", window=15, raise_by=0.6, clear_by=0.3, rises=True, decides=False)
"""Step of the piston from page to page. It shows a restless interferometer, which no recalibration cures."""


@dataclass(frozen=True)
class MonitorSettings:
    """When a recalibration is due.

    Attributes:
        baseline_pages: first pages of a model that say what is usual: few, since the device goes on drifting meanwhile,
            yet as many as the longest window and some more.
        signs: what is followed.
    """

    baseline_pages: int = 20
    signs: tuple[Sign, ...] = (MARGIN, AIR, TRUST, SHARE, CHANGED, UNREAD, RESIDUAL, SHIFT, STROKE, PISTON_WALK)


@dataclass(frozen=True)
class SignState:
    """State of a sign of drift.

    Attributes:
        name: name of the sign.
        value: what counts of the last pages, None before there are enough.
        baseline: what is usual, None before it is known.
        raise_at: where the sign is raised, None before the baseline is known.
        raised: whether it is.
        decides: whether it makes a recalibration due.
    """

    name: str
    value: float | None
    baseline: float | None
    raise_at: float | None
    raised: bool
    decides: bool

    def reason(self) -> str:
        """Why it is raised, for people."""
        value, baseline, limit = self.value or 0.0, self.baseline or 0.0, self.raise_at or 0.0
        return f"{self.name} {value:.4g}, beyond {limit:.4g} (usual {baseline:.4g})"


@dataclass(frozen=True)
class MonitorState:
    """State of a device as the monitor sees it.

    Attributes:
        due: whether a recalibration is.
        model_version: version that the pages were decoded with.
        pages: pages that were seen since it is in service.
        signs: each sign.
    """

    due: bool
    model_version: str
    pages: int
    signs: tuple[SignState, ...]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is due; empty where it is not."""
        return tuple(sign.reason() for sign in self.signs if sign.raised and sign.decides)


@dataclass
class _Followed:
    """History of one figure since a model is in service."""

    sign: Sign
    baseline_pages: int
    first: list[float] = field(default_factory=list)
    last: deque[float] = field(default_factory=deque)
    raised: bool = False
    baseline: float | None = None
    noise: float = 0.0

    def __post_init__(self) -> None:
        self.last = deque(maxlen=self.sign.window)
        if self.sign.absolute:
            self.baseline = 0.0

    def add(self, value: float) -> None:
        self.last.append(value)
        if self.baseline is None:
            self.first.append(value)
            if len(self.first) == max(self.baseline_pages, self.sign.window):
                self._settle()
            return
        now, sign = self.value, 1 if self.sign.rises else -1
        if now is not None:
            distance = abs(now - self.baseline) if self.sign.either else sign * (now - self.baseline)
            self.raised = distance > self._distance(self.sign.clear_by if self.raised else self.sign.raise_by)

    def _settle(self) -> None:
        """Take the best window as usual, and the scatter from page to page as noise: both bear a drift meanwhile."""
        window = self.sign.window
        best = statistics.median if self.sign.either else min if self.sign.rises else max
        self.baseline = best(self._smoothed(self.first[n : n + window]) for n in range(len(self.first) - window + 1))
        steps = np.abs(np.diff(self.first))
        self.noise = _MEDIAN_ERROR * _MAD_DEVIATIONS * float(np.median(steps)) / math.sqrt(2 * window)

    def _distance(self, by: float) -> float:
        """Return how far from the baseline a threshold lies; `by` of the settings, and no nearer than noise allows."""
        assert self.baseline is not None  # asked for behind it alone
        least = self.sign.deviations * self.noise * by / self.sign.raise_by
        return max(by * abs(self.baseline) if self.sign.relative else by, least)

    @property
    def value(self) -> float | None:
        """Return what counts of the last pages."""
        return self._smoothed(self.last) if len(self.last) == self.sign.window else None

    def _smoothed(self, values: Sequence[float]) -> float:
        return statistics.fmean(values) if self.sign.mean else statistics.median(values)

    def state(self) -> SignState:
        sign, usual, now = self.sign, self.baseline, self.value
        side = 1 if sign.rises or (sign.either and (now or 0.0) >= (usual or 0.0)) else -1
        raise_at = None if usual is None else usual + side * self._distance(sign.raise_by)
        return SignState(sign.name, now, usual, raise_at, self.raised, sign.decides)


class PageFigures:
    """Figures of pages, one after the other."""

    def __init__(self) -> None:
        self._piston: float | None = None

    def of(self, observation: Observation) -> dict[str, float]:
        """Return what a page says of the device; empty where it says nothing."""
        if observation.lost is not None and not (observation.tells and observation.lost in SHOWS_DEVICE):
            return {}
        data, page = observation.user_data, observation.page
        unreadable = data is not None and data.loss in _UNREADABLE
        figures = {UNREAD.name: float(observation.lost is not None or unreadable)}
        if data is not None and (data.loss is None or unreadable):
            # of a page whose bytes are lost the margin is only claimed
            figures[MARGIN.name] = min(0.0, data.margin_bits) if unreadable else data.margin_bits
        if page is None or observation.lost is not None:
            return figures
        figures |= {
            AIR.name: page.information_bits,
            TRUST.name: page.pilot_trust,
            SHARE.name: page.check.share,
            RESIDUAL.name: page.residual_rad,
            STROKE.name: page.stroke_relative,
        }
        if observation.tells:
            figures[CHANGED.name] = float(page.check.recalibration_due)
        if page.image is not None:
            figures[SHIFT.name] = math.hypot(page.image.shift_x_px, page.image.shift_y_px)
        if self._piston is not None:
            figures[PISTON_WALK.name] = abs(math.remainder(page.piston_rad - self._piston, 2 * math.pi))
        self._piston = page.piston_rad
        return figures


class Monitor:
    """Follows the pages of the model in service, an `Observer`.

    Args:
        settings: when a recalibration is due.
        metrics: where the signs are shown, None for nowhere.
        whose: goes before what is logged, e.g. ``"session a: "``; empty for the service's own device.
    """

    def __init__(
        self, settings: MonitorSettings | None = None, metrics: ServiceMetrics | None = None, whose: str = ""
    ) -> None:
        self.settings, self._metrics, self._whose = settings or MonitorSettings(), metrics, whose
        self._showing = threading.Lock()
        """Held from a look at the state until it is shown, so that no thread shows an earlier one last."""
        self._lock = threading.Lock()
        """Guards all that follows; never held while listeners are told. Taken after the lock above."""
        self._listeners: list[Callable[[], None]] = []
        self._begin("")

    def _begin(self, version: str) -> None:
        self._version, self._pages, self._due = version, 0, False
        self._figures = PageFigures()
        self._signs = [_Followed(sign, self.settings.baseline_pages) for sign in self.settings.signs]

    def begin(self, version: str) -> None:
        """Start anew with a model that is put in service; pages of others say nothing from now on."""
        with self._lock:
            self._begin(version)
        self._show()

    def listen(self, listener: Callable[[], None]) -> None:
        """Call `listener`, from the thread of the page, whenever a recalibration has become due."""
        with self._lock:
            self._listeners.append(listener)

    @property
    def due(self) -> bool:
        """Return whether a recalibration is due."""
        with self._lock:
            return self._due

    @property
    def raised(self) -> tuple[str, ...]:
        """Names of the signs by which a recalibration is due; empty where it is not."""
        with self._lock:
            raised = tuple(each.sign.name for each in self._signs if each.raised and each.sign.decides)
            return (raised or ("other",)) if self._due else ()

    def state(self) -> MonitorState:
        """Return how the device stands, with the reasons."""
        with self._lock:
            return MonitorState(self._due, self._version, self._pages, tuple(each.state() for each in self._signs))

    def observe(self, observation: Observation) -> None:
        """See `Observer`."""
        with self._lock:
            version = self._version or observation.model_version
            if observation.model_version != version:
                return
            figures = self._figures.of(observation)
        self.follow(version, figures)

    def follow(self, version: str, figures: Figures) -> None:
        """Take note of a page by its figures; an empty page says nothing.

        Args:
            version: version of the model that decoded it; other pages than those of the model in service say nothing.
            figures: figures by the names of signs.
        """
        with self._lock:
            if not figures or (self._version and version != self._version):
                return
            self._version = version
            self._pages += 1
            for each in self._signs:
                if (value := figures.get(each.sign.name)) is not None and math.isfinite(value):
                    each.add(value)
            before, self._due = self._due, any(each.raised and each.sign.decides for each in self._signs)
            now, listeners = self._due, list(self._listeners)
        self._show()
        if now and not before:
            _log.warning("%srecalibration due: %s", self._whose, "; ".join(self.state().reasons))
            for listener in listeners:
                listener()
        elif before and not now:
            _log.info("%srecalibration no longer due", self._whose)

    def _show(self) -> None:
        """Show how the device stands now."""
        if self._metrics is None:
            return
        with self._showing:
            state = self.state()
            self._metrics.monitor_due.set(state.due)
            for sign in state.signs:
                self._metrics.monitor_signs.labels(sign.name).set(math.nan if sign.value is None else sign.value)
                self._metrics.monitor_raised.labels(sign.name).set(sign.raised)


class Monitors:
    """Says which monitor follows a page, and who else is told of it. Its methods may be called from many threads.

    What the pages of a caller's session show says nothing of the service's own device: such a session has a monitor of
    its own, with the settings of the device's.

    Args:
        device: the monitor of the service's own device; None for no monitors at all.
        device_sessions: sessions whose frames are of the device, by their names in `Caller.session`.
        observers: are told of every page.
        shows_device: whether the figures of the last page are those of the device alone.
        most: see `Sessions`.
    """

    def __init__(
        self,
        device: Monitor | None,
        device_sessions: Collection[str] = (),
        observers: Sequence[Observer] = (),
        *,
        shows_device: bool = False,
        most: int = MOST_SESSIONS,
    ) -> None:
        self.device, self.observers, self._most = device, tuple(observers), most
        self._device_sessions, self._shows_device = frozenset(("", *device_sessions)), shows_device
        self.begin("")

    def begin(self, version: str) -> None:
        """Reset all monitors for a new model; with an empty version only those of sessions."""
        if self.device is not None and version:
            self.device.begin(version)
        self._sessions = Sessions(partial(self._begun, version), self._most)

    def of(self, caller: Caller) -> Monitor | None:
        """The monitor of the frames that a caller sends; None where each is decoded as if it were the first."""
        if caller.stateless or self.device is None:
            return None
        return self.device if caller.session in self._device_sessions else self._sessions.of(caller.session)

    def shows(self, monitor: Monitor | None) -> bool:
        """Return whether a page that `monitor` follows is shown by the figures of the last page."""
        return monitor is self.device or not self._shows_device

    def told_by(self, monitor: Monitor | None) -> Sequence[Observer]:
        """Observers of a page that `monitor` follows, the monitor first."""
        return self.observers if monitor is None else (monitor, *self.observers)

    def sessions_due(self) -> int:
        """Number of sessions whose pages say that a recalibration is due."""
        return sum(monitor.due for monitor in self._sessions.all())

    def _begun(self, version: str, session: str) -> Monitor:
        assert self.device is not None  # else there are no sessions
        monitor = Monitor(self.device.settings, whose=f"{session}: ")
        monitor.begin(version)
        return monitor
