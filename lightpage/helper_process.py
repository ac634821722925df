"""A process that does one thing for this one, and answers it in lines over a socket."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

_RECEIVE_BYTES = 65536


class HelperProcess:
    """``python -m MODULE ARGUMENTS``, with a socket as its standard input; it ends with this process.

    Args:
        module: what it runs. It is to end once the socket's other end is closed.
        arguments: of the module.
        files: file descriptors that it inherits under the same numbers.
        subject: for errors, e.g. ``the process of its window``.
        environment: its variables; those of this process if left out.
        log: takes what it prints on its standard error; that of this process if left out.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(
        self,
        module: str,
        *arguments: str,
        files: Sequence[int] = (),
        subject: str,
        environment: Mapping[str, str] | None = None,
        log: IO[bytes] | None = None,
    ) -> None:
        self._subject = subject
        self._received = b""
        self._link, other = socket.socketpair()
        with other:
            try:
                # In a session of its own: Ctrl-C is for the service, which then ends its helpers.
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", module, *arguments],
                    stdin=other.fileno(),
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    start_new_session=True,
                    pass_fds=files,
                    env=environment,
                )
            except OSError:
                self._link.close()
                raise

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def send(self, data: bytes, deadline: float) -> None:
        """Send it until then, a `time.monotonic` moment.

        Raises:
            TimeoutError: not all of it could be sent; the process is of no more use.
            ConnectionError: it has ended.
        """
        self._link.settimeout(_left(deadline))
        self._link.sendall(data)

    def line(self, deadline: float) -> bytes:
        """The next line of its answer, without the line's end.

        Raises:
            TimeoutError: it has not come by then, and may yet.
            ConnectionError: the process has ended.
        """
        while b"\n" not in self._received:
            self._link.settimeout(_left(deadline))
            if not (more := self._link.recv(_RECEIVE_BYTES)):
                raise ConnectionError(f"{self._subject} has ended")
            self._received += more
        line, _, self._received = self._received.partition(b"\n")
        return line

    def has_line(self) -> bool:
        """Whether a line has come already, of which the socket says nothing any more."""
        return b"\n" in self._received

    def fileno(self) -> int:
        """Of the socket, for `select`: there is something to read of it once the process has answered or ended."""
        return self._link.fileno()

    def ended(self) -> bool:
        """Whether it runs no more."""
        return self._process.poll() is not None

    @property
    def status(self) -> int | None:
        """Its exit status, negative where a signal has ended it; None while it runs."""
        return self._process.poll()

    def end(self, grace_s: float = 0.0) -> None:
        """End it; it has `grace_s` to do so by itself once the socket is closed."""
        self._link.close()
        try:
            self._process.wait(grace_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def same_packages(threads: int) -> dict[str, str]:
    """Environment of a process that finds the same packages as this one.

    Args:
        threads: of its numerical libraries.
    """
    own = str(Path(__file__).resolve().parents[1])
    paths = [own, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    return {**os.environ, **limits, "PYTHONPATH": os.pathsep.join(paths)}


def parent_link() -> socket.socket:
    """In such a process: the socket to the one that started it."""
    return socket.socket(fileno=os.dup(sys.stdin.fileno()))


def _left(deadline: float) -> float:
    """Seconds until then.

    Raises:
        TimeoutError: it has passed.
    """
    if (left := deadline - time.monotonic()) <= 0:
        raise TimeoutError
    return left
