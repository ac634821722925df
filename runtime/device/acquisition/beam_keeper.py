"""Blocks the beams for a while, and sees to it that both are open again, however that ends."""

import logging
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import LightpageError, LostShotError, Reason
from lightpage.runtime.device.modulator.modulator import Beams, OperatorBeams

_log = logging.getLogger(__name__)

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0
"""Between two attempts to open the beams; each pause is twice the one before."""


class BeamKeeper:
    """Moves the beams of one source. Its methods may be called from many threads.

    Beams that could not be opened are tried again by a thread until they are open, except those that a person moves.

    Args:
        beams: beams of the source.
        lock: held while they are moved or in use; its owner may take it again.
        name: name of the source, for the log.
        clock: clock by which it waits between two attempts.
    """

    def __init__(self, beams: Beams, lock: AbstractContextManager[object], name: str, clock: Clock = SYSTEM) -> None:
        self._beams, self._lock, self._name, self._clock = beams, lock, name, clock
        self.trouble = ""
        """Why the beams are not known to be open, empty where they are, or are blocked for a purpose."""
        self._moved = False
        """Whether they were let through once: an earlier process may have ended while it blocked them."""
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @contextmanager
    def blocked(self, *, signal: bool, reference: bool) -> Iterator[None]:
        """Let through what is said within the `with` statement, and both beams behind it, whatever happens.

        Raises:
            LostShotError: `Reason.BEAM_CONTROL_FAILED`.
            SourceError: this device cannot block its beams.
        """
        with self._lock:
            try:
                self._beams.let_through(signal=signal, reference=reference)
                yield
            except BaseException:
                with suppress(LightpageError):
                    self.open()
                raise
            self.open()

    def ensure_open(self) -> None:
        """Open the beams before they are used for the first time, and where the last attempt failed.

        Raises:
            LostShotError: see `open`.
        """
        if self.trouble or not self._moved:
            self.open()

    def open(self) -> None:
        """Let both beams through.

        Raises:
            LostShotError: `Reason.BEAM_CONTROL_FAILED`: they are not known to be open; a thread tries on.
        """
        with self._lock:
            before = self.trouble
            try:
                self._beams.let_through(signal=True, reference=True)
            except BaseException as error:
                self.trouble = f"a beam may be blocked: {str(error) or type(error).__name__}"
                if not before:
                    _log.error("%s: no page is read until both beams are open: %s", self._name, self.trouble)
                    self._start()
                if isinstance(error, LightpageError):
                    told = error.subject, error.got, error.expected
                    raise LostShotError(*told, Reason.BEAM_CONTROL_FAILED) from None
                raise
            self.trouble, self._moved = "", True
            if before:
                _log.warning("%s: both beams are open again", self._name)

    def close(self) -> None:
        """Try no more; closing the beams opens them, where that can be done."""
        self._stop.set()
        self._thread = None

    def _start(self) -> None:
        """Begin to try again, unless that has begun; the lock is held."""
        if self._thread is None and not isinstance(self._beams, OperatorBeams):
            self._stop = threading.Event()
            self._thread = threading.Thread(target=self._run, args=(self._stop,), name="lightpage-beams", daemon=True)
            self._thread.start()

    def _run(self, stop: threading.Event) -> None:
        pause_s = _FIRST_PAUSE_S
        while True:
            self._clock.wait(stop, pause_s)
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
            with self._lock:
                if stop.is_set():
                    return
                try:
                    if self.trouble:
                        self.open()
                except Exception as error:
                    _log.debug("%s: beams still not open: %s", self._name, error)
                if not self.trouble:
                    self._thread = None
                    return
