"""Memory that the service shares with clients on its machine: made here, known by handles, read within bounds."""

from __future__ import annotations

import fcntl
import logging
import mmap
import os
import secrets
import socket
import socketserver
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from lightpage.errors import InvalidInputError, LightpageError, LimitError, OverloadedError
from lightpage.runtime.client.shared_memory import GRANTED, HANDLE_BYTES, REFUSED, SIZE, WHY_BYTES
from lightpage.runtime.client.wire.address import check_free

_LOOK_S = 0.1
_PAUSE_S = 0.01
"""After trouble, so that one that lasts takes no core."""
_LEAVES_S = 0.2
"""A client that wants more than there is waits so long for one that leaves."""
_RETRY_S = 1.0

_log = logging.getLogger(__name__)


class Region:
    """Memory that is shared with one client. It is let go of when it is dropped and nobody reads it any more.

    Args:
        size: bytes.

    Raises:
        OSError: the system has no memory.
    """

    def __init__(self, size: int) -> None:
        self.handle, self.size = secrets.token_bytes(HANDLE_BYTES), size
        self.descriptor = os.memfd_create("lightpage", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(self.descriptor, size)
            # Nobody changes its size any more: reading beyond the end of a shrunken one would end the service.
            seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
            fcntl.fcntl(self.descriptor, fcntl.F_ADD_SEALS, seals)
            self._memory = mmap.mmap(self.descriptor, size, mmap.MAP_SHARED, mmap.PROT_READ)
        except BaseException:
            os.close(self.descriptor)
            raise
        self._lock = threading.Lock()
        self._readers, self._dropped = 0, False

    @contextmanager
    def reading(self, offset: int, size: int) -> Iterator[memoryview]:
        """A view of some of its bytes, which stay while the `with` statement lasts. The client may change them.

        Raises:
            InvalidInputError: they are not all in it, or it is dropped.
        """
        if offset + size > self.size:
            expected = f"at most {self.size - size}: {size} of its {self.size} bytes are read"
            raise InvalidInputError("header.shared.offset", offset, expected)
        with self._lock:
            if self._dropped:
                raise unknown_region()
            self._readers += 1
        view = memoryview(self._memory)
        part = view[offset : offset + size]
        try:
            yield part
        finally:
            part.release()
            view.release()
            with self._lock:
                self._readers -= 1
                self._let_go()

    def drop(self) -> None:
        """Let go of it, once nobody reads it."""
        with self._lock:
            if not self._dropped:
                self._dropped = True
                os.close(self.descriptor)
                self._let_go()

    def _let_go(self) -> None:
        if self._dropped and not self._readers:
            self._memory.close()


def unknown_region() -> InvalidInputError:
    """The error of a handle that is not known, whatever the reason: a stranger shall learn nothing by asking."""
    expected = "the handle of a region whose connection is open"
    return InvalidInputError("header.shared.region", "an unknown handle", expected)


if TYPE_CHECKING:
    _UnixServer = socketserver.UnixStreamServer
else:
    _UnixServer = getattr(socketserver, "UnixStreamServer", object)  # Windows has none, and shows help all the same


class _Server(socketserver.ThreadingMixIn, _UnixServer):
    """Listens for clients, each of which has a thread for as long as it is connected."""

    daemon_threads, block_on_close = True, False
    request_queue_size = 128  # of five, which is the default, the sixth of those that come at once is refused
    memory: SharedMemory

    def get_request(self) -> tuple[Any, Any]:
        """See `socketserver.BaseServer`."""
        try:
            return super().get_request()
        except OSError as error:  # the client has gone, or there are too many files
            _log.warning("shared memory: a client is not taken: %s", error.strerror or error)
            time.sleep(_PAUSE_S)
            raise

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """See `socketserver.BaseServer`."""
        return self.memory.takes(request)

    def shutdown_request(self, request: Any) -> None:
        """See `socketserver.BaseServer`."""
        self.memory.forget(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """See `socketserver.BaseServer`: one client's trouble is nobody else's."""
        _log.exception("shared memory: a client could not be served")


class _Client(socketserver.BaseRequestHandler):
    """Gives a client its region, and takes that back when the client leaves."""

    def handle(self) -> None:
        """See `socketserver.BaseRequestHandler`."""
        server: Any = self.server
        memory: SharedMemory = server.memory
        self.request.settimeout(memory.silence_s)
        with suppress(OSError), self.request.makefile("rb", buffering=0) as told, ExitStack() as stack:
            asked = told.read(SIZE.size)
            while told and asked and len(asked) < SIZE.size and (more := told.read(SIZE.size - len(asked))):
                asked += more
            if len(asked) < SIZE.size:
                return
            try:
                region = stack.enter_context(memory.region(*SIZE.unpack(asked)))
            except LightpageError as error:
                self.request.send(REFUSED + str(error).encode()[:WHY_BYTES])
                return
            socket.send_fds(self.request, [GRANTED + region.handle], [region.descriptor])
            self.request.settimeout(None)
            told.read(1)  # nothing until the end


class SharedMemory:
    """Gives out regions at a socket, to whoever may open it; use it in a `with` statement.

    Args:
        path: path of the socket.
        most_bytes: largest size of all regions together.
        most_regions: largest number at once.
        silence_s: a client that does not say how much it wants is hung up on after so long.
    """

    def __init__(self, path: str, most_bytes: int, most_regions: int, silence_s: float) -> None:
        self._path, self._most_regions, self.silence_s = Path(path), most_regions, silence_s
        self.most_bytes = most_bytes
        self._clients: set[socket.socket] = set()
        self._regions: dict[bytes, Region] = {}
        self._lock = threading.Condition()
        """Guards the two above; told when a region ends."""

    @contextmanager
    def reading(self, handle: bytes, offset: int, size: int) -> Iterator[memoryview]:
        """A view of a region's bytes; see `Region.reading`.

        Raises:
            InvalidInputError: no such region, or bytes that are not all in it.
        """
        with self._lock:
            region = self._regions.get(handle)
        if region is None:
            raise unknown_region()
        with region.reading(offset, size) as part:
            yield part

    def __enter__(self) -> Self:
        """Listen.

        Raises:
            InvalidInputError: the socket cannot be made.
        """
        check_free("socket", f"unix:{self._path}")
        try:
            self._path.unlink(missing_ok=True)  # left behind by a process that was killed
            self._server = _Server(str(self._path), _Client)
        except OSError as error:
            raise InvalidInputError(f"socket {self._path}", error, "a path where a socket can be made") from None
        self._server.memory = self
        run, name = partial(self._server.serve_forever, _LOOK_S), "lightpage-shared-memory"
        threading.Thread(target=run, name=name, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        with self._lock:
            clients, regions = list(self._clients), list(self._regions.values())
        for client in clients:
            with suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
        for region in regions:
            region.drop()
        with suppress(OSError):
            self._path.unlink()

    def takes(self, client: socket.socket) -> bool:
        """Note a client; False where there are too many."""
        with self._lock:
            if len(self._clients) >= 2 * self._most_regions:
                return False
            self._clients.add(client)
            return True

    def forget(self, client: socket.socket) -> None:
        """Forget a client, which has gone."""
        with self._lock:
            self._clients.discard(client)

    @contextmanager
    def region(self, size: int) -> Iterator[Region]:
        """Yield a new region, which ends with the `with` statement.

        Raises:
            LimitError, OverloadedError: there is not so much memory, or not now.
        """
        region = self._made(size)
        try:
            yield region
        finally:
            with self._lock:
                del self._regions[region.handle]
                self._lock.notify_all()
            region.drop()

    def _made(self, size: int) -> Region:
        """A new region."""
        subject = "shared memory"
        if not 0 < size <= self.most_bytes:
            raise LimitError(subject, f"{size} bytes", f"1 to {self.most_bytes}")
        with self._lock:

            def has_room() -> bool:
                used = sum(region.size for region in self._regions.values())
                return len(self._regions) < self._most_regions and used + size <= self.most_bytes

            # A client that has just let go of a region may ask before the thread of that region has heard of its end.
            if not self._lock.wait_for(has_room, _LEAVES_S):
                used = sum(region.size for region in self._regions.values())
                got = f"{len(self._regions)} regions of {used} bytes, and {size} more"
                expected = f"at most {self._most_regions} of {self.most_bytes} bytes together; try again later"
                raise OverloadedError(subject, got, expected, retry_s=_RETRY_S)
            try:
                region = Region(size)
            except OSError as error:
                raise OverloadedError(subject, error, "memory that is free", retry_s=_RETRY_S) from None
            self._regions[region.handle] = region
        return region
