"""A modulator, and beams, that a controller outside works by itself: it is asked, and says when it has done so."""

from threading import Condition
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import LostShotError, Reason
from lightpage.runtime.device.modulator.modulator import BOTH, BeamState

T = TypeVar("T")


class Announcement(Generic[T]):
    """An order to a controller, and its answer. Its methods may be called from many threads.

    Args:
        clock: clock by which it is waited.
    """

    def __init__(self, clock: Clock = SYSTEM) -> None:
        self._clock = clock
        self._changed = Condition()
        self._wanted: T | None = None
        self._announced: T | None = None
        self._changes = 0
        self._asked = False

    def wanted(self) -> T | None:
        """Return what is being waited for, or None where nothing is."""
        with self._changed:
            self._asked = self._asked or self._wanted is not None
            return self._wanted

    @property
    def heard_of(self) -> bool:
        """Return whether anybody has ever heard what was wanted, or said what there is."""
        with self._changed:
            return self._asked or self._changes > 0

    def announce(self, what: T | None) -> None:
        """Say what there is now, None for nothing."""
        with self._changed:
            if what == self._wanted:
                self._wanted = None
            if what != self._announced:
                self._announced = what
                self._changes += 1
                self._changed.notify_all()

    def want(self, what: T) -> None:
        """Ask for something, until it is there, and do not wait for it."""
        with self._changed:
            self._wanted = what

    def wait(self, what: T, timeout_s: float) -> tuple[T | None, int]:
        """Ask for something until it is there or the time is up.

        Returns:
            What there is then, and how often it has changed by then: as long as that stays, so does what there is.
        """
        with self._changed:
            self.want(what)
            try:
                self._clock.wait_for(self._changed, lambda: self._announced == what, timeout_s)
                return self._announced, self._changes
            finally:
                self._wanted = None


class ExternalModulator(Announcement[int]):
    """A modulator whose controller shows pages by itself.

    One thread uses `show`, `shows` and `close`; others look at `wanted` and `announce` the page that is on display, its
    liquid crystal settled, or None. A page may be announced before it is asked for.

    Args:
        clock: clock by which it waits.
    """

    name = "the controller's modulator"

    def __init__(self, clock: Clock = SYSTEM) -> None:
        super().__init__(clock)
        self._at_last_show = -1

    def open(self, timeout_s: float, levels: int | None = None) -> None:
        """See `Modulator`: the controller may come at any time."""

    def show(self, symbols: NDArray[np.uint8], levels: int, page: int, timeout_s: float) -> None:
        """Wait until the controller says that page number `page` is on display; see `Modulator`."""
        self._at_last_show = -1
        there, changes = self.wait(page, timeout_s)
        if there != page:
            got = f"{'no page' if there is None else f'page {there}'} announced after {timeout_s:g} s"
            raise LostShotError(f"page {page} on {self.name}", got, "word that it is on display", Reason.NOT_ON_DISPLAY)
        self._at_last_show = changes

    def shows(self) -> bool:
        """See `Modulator`: no other page was announced, and none withdrawn, since `show`."""
        return self._changes == self._at_last_show

    def close(self) -> None:
        """Forget what was announced."""
        self._at_last_show = -1
        self.announce(None)


class ExternalBeams(Announcement[BeamState]):
    """Beams that a controller blocks and lets through by itself, and announces how they are once they have settled.

    Args:
        timeout_s: longest wait for it.
        clock: clock by which it waits.
    """

    name = "the controller's beams"

    def __init__(self, timeout_s: float = 10.0, clock: Clock = SYSTEM) -> None:
        super().__init__(clock)
        self._timeout_s = timeout_s

    def let_through(self, *, signal: bool, reference: bool) -> None:
        """Wait until the controller says that the beams are so; see `Beams`.

        Beams that nobody has heard an order for are open.
        """
        wanted = BeamState(signal, reference)
        if wanted == BOTH and not self.heard_of:
            return
        there, _ = self.wait(wanted, self._timeout_s)
        if there != wanted:
            if self.heard_of:
                self.want(BOTH)
            got = f"{there or 'nothing'} announced after {self._timeout_s:g} s"
            raise LostShotError(self.name, got, str(wanted), Reason.BEAM_CONTROL_FAILED)

    def close(self) -> None:
        """Ask for both beams if the controller has blocked one; nobody waits for it."""
        if self.heard_of and self._announced != BOTH:
            self.want(BOTH)
