"""An object in a process of its own, whose methods this process calls; that process ends with this one.

Both ends speak one protocol, whatever the object does, over a socket that is the child's standard input. A request is
the name of a method and its arguments. It is answered by what the method returns, or by the `LightpageError` that it
raises; words of progress may come before. Messages are pickles: both ends are the same program of the same user. Arrays
of a request follow it one by one, so that neither end has all of them twice.
"""

from __future__ import annotations

import os
import pickle
import platform
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Any, ClassVar

from lightpage.errors import LightpageError, WorkerError
from lightpage.failures import short_resource
from lightpage.systems import INHERITS_SOCKETS, NEEDS_LINUX

_PROGRESS, _ANSWER, _ERROR, _END = "progress", "answer", "error", "end"
_END_S = 5.0
"""Time that a process gets to end after its socket has."""
_PARENT_GONE = 3
_PICKLE = 5
"""The first one that leaves arrays to the caller."""


class Helper:
    """Does the work of a helper process: each of its public methods can be asked for."""

    idle_s: ClassVar[float | None] = None
    """`idle` is called where no request has come for so long; None never calls it."""
    farewell_s: ClassVar[float] = 0.0
    """Time for the request at hand and `close` once the parent has gone; 0 ends the process at once."""

    def idle(self) -> None:
        """Do what is to be done without being asked."""

    def close(self) -> None:
        """Let go of everything, as the parent wants no more."""


class HelperProcess:
    """A process that makes a `Helper` and does what it is asked for, one request at a time.

    One thread at a time uses it, and any may `end` it: whoever waits for an answer then hears so. Another thread sends
    requests and takes in what comes back, so that no wait is longer than its limit.

    Args:
        target: the helper, as ``package.module:Class``; it takes no arguments, and only that process imports it.
        subject: work of the process, for errors, e.g. ``recalibration``.
        files: file descriptors that it inherits under the same numbers.
        environment: environment of the process; that of this process if left out.
        log: takes what it prints on its standard error; that of this process if left out.

    Raises:
        WorkerError: it cannot be started.
    """

    def __init__(
        self,
        target: str,
        *,
        subject: str,
        files: Sequence[int] = (),
        environment: Mapping[str, str] | None = None,
        log: IO[bytes] | None = None,
    ) -> None:
        if not INHERITS_SOCKETS:
            raise WorkerError(subject, platform.system(), NEEDS_LINUX)
        self._subject = subject
        self._requests = SimpleQueue[list[Any]]()
        self._told = SimpleQueue[tuple[str, Any]]()
        self._progress: Callable[..., None] | None = None
        self._answer: tuple[str, Any] | None = _ANSWER, None  # None where a request is under way
        self._thread = threading.Thread(target=self._converse, name="lightpage-helper", daemon=True)
        self._ending = threading.Lock()
        self._socket, other = socket.socketpair()
        with other:
            try:
                # In a session of its own: Ctrl-C is for the service, which then ends its helpers.
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "lightpage.helper_process", target],
                    stdin=other.fileno(),
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    start_new_session=True,
                    pass_fds=files,
                    env=environment,
                )
                self._thread.start()
            except (OSError, RuntimeError) as error:  # the latter where there is no room for a thread
                self._socket.close()
                short = short_resource(subject, error)
                raise WorkerError(subject, error, short.expected if short else "one that can be started") from error

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def status(self) -> int | None:
        """Exit status of the process, that of a signal negative; None while it runs."""
        return self._process.poll()

    def ask(self, method: str, *arguments: Any, timeout_s: float, progress: Callable[..., None] | None = None) -> Any:
        """Call a method of the helper, and return what it returns; see `send`.

        Raises:
            WorkerError: no answer within `timeout_s`, or the process has ended; it is of no more use.
            LightpageError: what the method raised.
        """
        self.send(method, *arguments, progress=progress)
        if not self.poll(timeout_s):
            raise WorkerError(self._subject, f"no answer within {timeout_s:g} s", "one in time")
        return self.answer()

    def send(self, method: str, *arguments: Any, progress: Callable[..., None] | None = None) -> None:
        """Ask the helper to call a method; `poll` returns whether there is an answer.

        Args:
            method: method of the helper.
            arguments: arguments of the method; arrays among them stay as they are until then.
            progress: function that `poll` calls with each report of progress; the method gets one to report by.

        Raises:
            WorkerError: the request before has no answer yet.
        """
        if self._answer is None:  # which would pass for this one's
            raise WorkerError(self._subject, "a request before the last one's answer", "one at a time")
        arrays: list[pickle.PickleBuffer] = []
        request = pickle.dumps((method, arguments, progress is not None), _PICKLE, buffer_callback=arrays.append)
        self._answer, self._progress = None, progress
        parts = [request, *(array.raw() for array in arrays)]
        self._requests.put([len(parts).to_bytes(4), *parts])

    def poll(self, timeout_s: float) -> bool:
        """Wait so long for the answer, and hand on what comes of progress; return whether `answer` has something."""
        until = time.monotonic() + timeout_s
        while self._answer is None:
            try:
                kind, value = self._told.get(timeout=max(0.0, until - time.monotonic()))
            except Empty:
                return False
            if kind == _PROGRESS and self._progress is not None:
                self._progress(*value)
                if time.monotonic() >= until:  # there may be ever more of it
                    return False
                continue
            if kind == _END:
                self._told.put((kind, value))  # for the next request
                kind, value = _ERROR, WorkerError(self._subject, value, "an answer")
            self._answer, self._progress = (kind, value), None
        return True

    def answer(self) -> Any:
        """Return what the method has returned, once `poll` says that it has.

        Raises:
            WorkerError: the process has ended before.
            LightpageError: what the method raised.
        """
        assert self._answer is not None  # as `poll` says
        kind, value = self._answer
        if kind == _ERROR:
            raise value
        return value

    def ended(self) -> bool:
        """Return whether it runs no more."""
        return self._process.poll() is not None

    def end(self, grace_s: float = 0.0) -> None:
        """End it; it has `grace_s` to do so by itself once the socket is shut down."""
        with self._ending, self._socket:
            with suppress(OSError):  # it was ended before
                self._socket.shutdown(socket.SHUT_RDWR)  # which wakes the thread, as to close it does not
            self._requests.put([b""])  # and this where it waits for a request
            try:
                self._process.wait(grace_s)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._thread.join()

    def _converse(self) -> None:
        """Send requests and take in what comes back, until the socket is shut down at either end."""
        try:
            with Connection(os.dup(self._socket.fileno())) as messages, suppress(OSError, EOFError):
                while True:
                    _send_all(messages, self._requests.get())
                    message: tuple[str, Any] = _PROGRESS, None
                    while message[0] == _PROGRESS:
                        message = messages.recv()
                        self._told.put(message)
                    del message  # the answer may be large
        finally:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_END_S)
            status = self._process.poll()
            how = f"by signal {-status}" if status is not None and status < 0 else f"with status {status}"
            self._told.put((_END, f"the end of its process {how}"))


def _send_all(messages: Connection, parts: Sequence[Any]) -> None:
    """Send messages, none of which is held on to: a request may be large."""
    for part in parts:
        messages.send_bytes(part)


def _received(messages: Connection) -> list[bytearray]:
    return [bytearray(messages.recv_bytes()) for _ in range(int.from_bytes(messages.recv_bytes()))]


def same_packages(threads: int) -> dict[str, str]:
    """Environment of a process that finds the same packages as this one.

    Args:
        threads: number of threads of its numerical libraries.
    """
    own = str(Path(__file__).resolve().parents[1])
    paths = [own, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    return {**os.environ, **limits, "PYTHONPATH": os.pathsep.join(paths)}


def serve(target: str) -> None:
    """Run a helper in this process: make it, and do what the parent asks until the parent has gone or asks to end.

    The kernel's own signal for that (PR_SET_PDEATHSIG) comes when the thread ends that has started the process. An
    error that nobody foresaw ends the process.
    """
    messages = Connection(os.dup(sys.stdin.fileno()))
    requests = SimpleQueue[list[bytearray]]()
    made: list[Helper] = []

    def listen() -> None:
        status = _PARENT_GONE
        try:
            with suppress(OSError, EOFError):
                while True:
                    requests.put(_received(messages))
            if made and made[0].farewell_s:
                requests.put([])
                time.sleep(made[0].farewell_s)
        except BaseException:
            status = 1
            sys.excepthook(*sys.exc_info())
        finally:
            os._exit(status)

    def tell(kind: str, value: Any) -> None:
        with suppress(ConnectionError):  # `listen` ends the process
            messages.send((kind, value))

    threading.Thread(target=listen, name="lightpage-parent", daemon=True).start()
    module, _, name = target.partition(":")
    helper: Helper = getattr(import_module(module), name)()
    made.append(helper)
    while True:
        try:
            request = requests.get(timeout=helper.idle_s)
        except Empty:
            helper.idle()
            continue
        if not request:
            break
        method, arguments, tells = pickle.loads(request[0], buffers=request[1:])
        del request  # what it holds may be large
        options = {"progress": lambda *words: tell(_PROGRESS, words)} if tells else {}
        try:
            tell(_ANSWER, getattr(helper, method)(*arguments, **options))
        except LightpageError as error:
            tell(_ERROR, error)
        del arguments
    helper.close()


if __name__ == "__main__":
    serve(sys.argv[1])
