"""The end of a service: signals that ask for it, and the end of its process whatever still computes."""

import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_log = logging.getLogger(__name__)

REST_S = 3.0
"""For what still computes once all calls have ended."""


@contextmanager
def stop_signals() -> Iterator[Callable[[], None]]:
    """Yields what waits for SIGTERM, SIGINT or SIGHUP; a second SIGTERM or SIGINT ends the process as usual.

    SIGHUP comes when a terminal is closed. Where it was to be ignored, as under nohup, it is.
    It waits for the byte that the interpreter's own handler writes. Waiting for a lock that a Python handler releases
    would miss a signal that comes between the last look for one and the sleep.
    """
    before: dict[int, Any] = {}
    receiver, sender = socket.socketpair()
    sender.setblocking(False)

    def no_more(number: int, _: object) -> None:
        for kind in before:  # a hangup may come with the first signal, and is not impatience
            signal.signal(kind, signal.SIG_IGN if kind == signal.SIGHUP else signal.SIG_DFL)

    def wait() -> None:
        while receiver.recv(1)[0] not in before:
            pass

    with receiver, sender:
        waking = signal.set_wakeup_fd(sender.fileno())
        try:
            for kind in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
                if kind != signal.SIGHUP or signal.getsignal(kind) != signal.SIG_IGN:
                    before[kind] = signal.signal(kind, no_more)
            yield wait
        finally:
            signal.set_wakeup_fd(waking)
            for number, handler in before.items():
                signal.signal(number, handler)


def leave_the_rest(rest_s: float = REST_S, leave: Callable[[int], object] = os._exit) -> None:
    """End the process if its threads do not: a decode that has hung would keep it for ever.

    Args:
        rest_s: time that they have.
        leave: ends the process with a status.
    """
    until = time.monotonic() + rest_s
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join(max(0.0, until - time.monotonic()))
            if thread.is_alive():
                _log.warning("ended while %s was still at work", thread.name)
                for stream in (sys.stdout, sys.stderr):
                    stream.flush()
                leave(0)
