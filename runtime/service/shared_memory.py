"""Memory that the service shares with clients on its machine: made here, known by handles, read within bounds."""

from __future__ import annotations

import fcntl
import logging
import mmap
import os
import secrets
import selectors
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from lightpage.errors import InvalidInputError, LightpageError, LimitError, OverloadedError
from lightpage.runtime.client.shared_memory import GRANTED, HANDLE_BYTES, REFUSED, SIZE, WHY_BYTES
from lightpage.runtime.client.wire.address import check_free

_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
"""Nobody changes the size of a region any more: reading beyond the end of a shrunken one would end the service."""
_LOOK_S = 0.1
_PAUSE_S = 0.01
"""After trouble, so that one that lasts takes no core."""
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
            fcntl.fcntl(self.descriptor, fcntl.F_ADD_SEALS, _SEALS)
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


@dataclass
class _Client:
    """A connection: what has come of a size, its region once it has one, and when it began."""

    begun: float
    received: bytearray = field(default_factory=bytearray)
    region: Region | None = None


class SharedMemory:
    """Gives out regions at a socket, to whoever may open it; use it in a `with` statement.

    Args:
        path: of the socket.
        most_bytes: of all regions together.
        most_regions: at once.
        silence_s: a client that does not say how much it wants is hung up on after so long.
    """

    def __init__(self, path: str, most_bytes: int, most_regions: int, silence_s: float) -> None:
        self._path, self._most_regions, self._silence_s = Path(path), most_regions, silence_s
        self.most_bytes = most_bytes
        self._clients: dict[socket.socket, _Client] = {}
        self._selector = selectors.DefaultSelector()
        self._regions: dict[bytes, Region] = {}
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="lightpage-shared-memory", daemon=True)

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
            InvalidInputError: the socket cannot be made, or this system has no memory to share.
        """
        if not hasattr(os, "memfd_create"):
            raise InvalidInputError("service.shared_memory", "a system without memfd_create", "Linux")
        check_free("socket", f"unix:{self._path}")
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            with suppress(FileNotFoundError):
                self._path.unlink()  # left behind by a process that was killed
            self._socket.bind(str(self._path))
            self._socket.listen()
        except OSError as error:
            self._socket.close()
            raise InvalidInputError(f"socket {self._path}", error, "a path where a socket can be made") from None
        self._socket.setblocking(False)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()
        self._socket.close()
        with suppress(OSError):
            self._path.unlink()

    def _run(self) -> None:
        with self._selector:
            self._selector.register(self._socket, selectors.EVENT_READ)
            while not self._stopping.is_set():
                for key, _ in self._selector.select(_LOOK_S):
                    try:
                        self._serve(key.fileobj)
                    except Exception:  # one client's trouble is nobody else's
                        _log.exception("shared memory: a client could not be served")
                        self._stopping.wait(_PAUSE_S)
                late, clients = time.monotonic() - self._silence_s, list(self._clients.items())
                for connection in [one for one, client in clients if not client.region and client.begun < late]:
                    self._hang_up(connection)
            for connection in list(self._clients):
                self._hang_up(connection)

    def _serve(self, source: Any) -> None:
        if source is self._socket:
            self._accept()
        elif not self._hear(source, self._clients[source]):
            self._hang_up(source)

    def _accept(self) -> None:
        try:
            connection, _ = self._socket.accept()
        except OSError as error:  # the client has gone, or there are too many files
            _log.warning("shared memory: a client is not taken: %s", error.strerror or error)
            self._stopping.wait(_PAUSE_S)
            return
        connection.setblocking(False)
        if len(self._clients) >= 2 * self._most_regions:
            connection.close()
            return
        self._clients[connection] = _Client(time.monotonic())
        self._selector.register(connection, selectors.EVENT_READ)

    def _hang_up(self, connection: socket.socket) -> None:
        region = self._clients.pop(connection).region
        self._selector.unregister(connection)
        connection.close()
        if region is not None:
            with self._lock:
                del self._regions[region.handle]
            region.drop()

    def _hear(self, connection: socket.socket, client: _Client) -> bool:
        """Take what a client sends; whether its connection goes on."""
        try:
            data = connection.recv(SIZE.size + 1 - len(client.received))
        except BlockingIOError:
            return True
        except OSError:
            return False
        client.received += data
        if not data or len(client.received) > SIZE.size or client.region is not None:
            return False
        if len(client.received) < SIZE.size:
            return True
        try:
            client.region = self._made(SIZE.unpack(client.received)[0])
        except LightpageError as error:
            with suppress(OSError):
                connection.send(REFUSED + str(error).encode()[:WHY_BYTES])
            return False
        try:
            socket.send_fds(connection, [GRANTED + client.region.handle], [client.region.descriptor])
        except OSError:
            return False
        return True

    def _made(self, size: int) -> Region:
        """A new region."""
        subject = "shared memory"
        if not 0 < size <= self.most_bytes:
            raise LimitError(subject, f"{size} bytes", f"1 to {self.most_bytes}")
        with self._lock:
            used = sum(region.size for region in self._regions.values())
            if len(self._regions) >= self._most_regions or used + size > self.most_bytes:
                got = f"{len(self._regions)} regions of {used} bytes, and {size} more"
                expected = f"at most {self._most_regions} of {self.most_bytes} bytes together; try again later"
                raise OverloadedError(subject, got, expected, retry_s=_RETRY_S)
            try:
                region = Region(size)
            except OSError as error:
                raise OverloadedError(subject, error, "memory that is free", retry_s=_RETRY_S) from None
            self._regions[region.handle] = region
        return region
