"""The monitors of a service: its own device's, and one for each session whose frames are of another device."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial

from lightpage.runtime.service.caller import MOST_SESSIONS, Caller, Sessions
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.monitoring.observation import Observer


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
        """Start anew with a model that is put in service; without a version, those of sessions alone."""
        if self.device is not None and version:
            self.device.begin(version)
        self._sessions = Sessions(partial(self._begun, version), self._most)

    def of(self, caller: Caller) -> Monitor | None:
        """The monitor of the frames that a caller sends; None where each is decoded as if it were the first."""
        if caller.stateless or self.device is None:
            return None
        return self.device if caller.session in self._device_sessions else self._sessions.of(caller.session)

    def shows(self, monitor: Monitor | None) -> bool:
        """Whether a page that `monitor` follows is shown by the figures of the last page."""
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
