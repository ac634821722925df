"""Health checks on an address of their own, answered by a process that does nothing else."""

import logging
import os
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Self

from lightpage.errors import InvalidInputError, WorkerError, raised_as
from lightpage.helper_process import HelperProcess
from lightpage.runtime.client.wire.address import check_address, check_free, is_local, target_of
from lightpage.runtime.client.wire.channel import TlsFiles

_PROCESS = "lightpage.runtime.service.server.health_process:HealthAnswers"
_BEAT_S = 0.5
_START_S = 20.0
"""Longest time in which the process starts."""
_TOLD_S = 5.0
"""A process that has not taken in for so long how the service fares is started again."""
_AGAIN_S = 5.0
"""Between two attempts to start the process again."""

_log = logging.getLogger(__name__)


def next_port(address: str) -> str:
    """Return where health checks are answered for a service at `address`: the next port, a free one for port 0.

    Of a service that others reach, the next port of this machine alone.
    """
    if address.startswith("unix:"):
        return f"{address}.health"
    host, _, port = address.rpartition(":")
    host = host if is_local(address) else "127.0.0.1"
    return f"{host}:{int(port) + 1 if 0 < int(port) < 65535 else 0}"


class HealthServer:
    """Runs the process and tells it how the service fares; use it in a `with` statement.

    Args:
        address: HOST:PORT; port 0 takes a free one.
        states: called twice a second: each service by name, and whether it serves. Where it hangs, nothing does.
        tls: certificate with which it answers, whoever asks; None for no TLS.
    """

    def __init__(self, address: str, states: Callable[[], Mapping[str, bool]], tls: TlsFiles | None = None) -> None:
        check_address("health address", address, least_port=0)
        self._address, self._states, self._tls = address, states, tls
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="lightpage-heartbeat", daemon=True)
        self._process: HelperProcess | None = None
        self.port = 0

    @property
    def target(self) -> str:
        """Return where it is asked on this machine."""
        return target_of(self._address, self.port)

    @property
    def pid(self) -> int | None:
        """Number of the process, None before there is one."""
        return None if self._process is None else self._process.pid

    def __enter__(self) -> Self:
        """Answer health checks.

        Raises:
            InvalidInputError: the address cannot be listened on.
        """
        check_free("health address", self._address)
        self._process, self.port = self._started()
        if not self._address.startswith("unix:"):
            self._address = f"{self._address.rpartition(':')[0]}:{self.port}"  # where another process follows it
        self._thread.start()
        return self

    def _started(self) -> tuple[HelperProcess, int]:
        """A process that answers, and its port."""
        with raised_as(InvalidInputError, WorkerError):
            process = HelperProcess(_PROCESS, subject="health checks")
            try:
                return process, process.ask("listen", self._address, self._tls, timeout_s=_START_S)
            except BaseException:
                process.end()
                raise

    def __exit__(self, *_: object) -> None:
        """Answer no more."""
        self._stop.set()
        if self._process is not None:
            self._process.end()  # which wakes the thread where it waits for an answer
        self._thread.join(2 * _BEAT_S)
        if self._address.startswith("unix:"):
            with suppress(OSError):
                os.unlink(self._address.removeprefix("unix:"))

    def _beat(self) -> None:
        while True:
            try:
                states = dict(self._states())
            except Exception:
                _log.exception("health checks: the service does not say how it fares")
            else:
                self._tell(states)
            if self._stop.wait(_BEAT_S):
                break
        assert self._process is not None  # it was started
        self._process.end()  # it may be one that was started since

    def _tell(self, states: dict[str, bool]) -> None:
        """Tell the process how the service fares; one that has ended is started again at the same port."""
        assert self._process is not None  # it was started
        try:
            self._process.ask("tell", states, timeout_s=_TOLD_S)
            return
        except WorkerError as error:
            if self._stop.is_set():
                return
            _log.error("health checks: %s; their process is started again", error)
        self._process.end()
        try:
            self._process, _ = self._started()
        except InvalidInputError as error:
            _log.error("health checks: %s", error)
            self._stop.wait(_AGAIN_S)
