"""The HTTP server of a service, by Tornado: whom it answers, how many at once, and for how long."""

import asyncio
import errno
import logging
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream, SSLIOStream
from tornado.netutil import bind_sockets
from tornado.web import Application

from lightpage.errors import InvalidInputError
from lightpage.runtime.client.wire.address import host_and_port
from lightpage.runtime.console.application import MOST_BODY_BYTES, Route
from lightpage.runtime.service.server.certificates import Certificates

_log = logging.getLogger(__name__)
logging.getLogger("tornado.general").setLevel(logging.ERROR)  # it warns of each caller that breaks off

MOST_CONNECTIONS = 64
"""Connections that are answered at once: browsers, Prometheus, and those who say nothing."""
LONGEST_S = 60.0
"""For one connection: more than any answer takes, and too little to hold one for hours by a byte now and then."""
SILENCE_S = 20.0
"""A caller that has not said what it wants after so long is hung up on."""
PAUSE_S = 0.1
"""Between two tries to take a connection that there is no descriptor for."""
_THREADS = 8
"""They make the answers."""


@contextmanager
def serving(
    routes: list[Route],
    port: int,
    host: str = "127.0.0.1",
    certificates: Certificates | None = None,
    names: Iterable[str] = (),
) -> Iterator[int]:
    """Serve routes, from a thread, within the `with` statement; yields the port.

    Args:
        routes: what to serve.
        port: 0 takes a free one.
        host: host to listen on, IPv6 with or without brackets; ``::`` stands for all addresses, of IPv4 too.
        certificates: certificates with which callers are met, who must have some too; None for no TLS.
        names: further names of this machine by which it may be asked, see `names_machine`.

    Raises:
        InvalidInputError: the port is taken, or there is no such host.
    """
    own = frozenset(name.lower() for name in (host, socket.gethostname(), *names))
    try:
        listeners = bind_sockets(port, None if host.strip("[]") == "::" else host.strip("[]"))
    except (OSError, UnicodeError) as error:
        expected = "an address of this machine and a free port"
        raise InvalidInputError(f"metrics at {host_and_port(host, port)}", error, expected) from None
    threads = ThreadPoolExecutor(_THREADS, "lightpage-console")
    application = Application(
        [*routes],
        threads=threads,
        names=lambda: own if certificates is None else own | certificates.names(),
        silence_s=SILENCE_S,
        cross_origin_protection=True,
        log_function=lambda _: None,  # there is a request a second for each browser
    )
    # Each request has a connection of its own: `LONGEST_S` cuts nobody off who asks again and again.
    limits = {"no_keep_alive": True, "idle_connection_timeout": SILENCE_S, "max_body_size": MOST_BODY_BYTES}
    server = _Server(application, certificates=certificates, **limits)
    ended = Future[None]()

    async def serve() -> None:
        asyncio.get_running_loop().set_exception_handler(_pause)
        server.add_sockets(listeners)
        await asyncio.wrap_future(ended)
        server.stop()
        await server.close_all_connections()

    thread = threading.Thread(target=asyncio.run, args=[serve()], name="lightpage-console", daemon=True)
    thread.start()
    try:
        yield int(listeners[0].getsockname()[1])
    finally:
        ended.set_result(None)
        thread.join()
        threads.shutdown(wait=False, cancel_futures=True)  # what hangs holds up no stop


class _Server(HTTPServer):
    """Takes at most `MOST_CONNECTIONS` at once, each for `LONGEST_S` and with the certificates that count then."""

    ssl_options: Any = property(lambda self: self._certificates and self._certificates.context(), lambda *_: None)

    def initialize(self, *arguments: Any, **options: Any) -> None:
        """Take `certificates` beside what `HTTPServer` takes."""
        self._certificates: Certificates | None = options.pop("certificates")
        self._ends: dict[IOStream, asyncio.TimerHandle] = {}
        super().initialize(*arguments, **options)

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Answer a connection, if there is room for one more."""
        if len(self._ends) >= MOST_CONNECTIONS:
            stream.close()
            return
        self._ends[stream] = asyncio.get_running_loop().call_later(LONGEST_S, stream.close)
        if isinstance(stream, SSLIOStream):
            stream.wait_for_handshake().add_done_callback(partial(_report, address[0]))
        super().handle_stream(stream, address)

    def on_close(self, server_conn: Any) -> None:
        """Give the room of a connection back."""
        super().on_close(server_conn)
        self._ends.pop(server_conn.stream).cancel()


def _report(caller: str, handshake: asyncio.Future[SSLIOStream]) -> None:
    if (error := handshake.exception()) is not None:
        _log.info("console: no TLS with %s: %s", caller, getattr(error, "reason", None) or error)


def _pause(_loop: object, failed: dict[str, Any]) -> None:
    """Wait where there is no descriptor for a connection: there is none for the next try either."""
    _log.debug("console: %s", failed["message"], exc_info=failed.get("exception"))
    if getattr(failed.get("exception"), "errno", None) in (errno.EMFILE, errno.ENFILE):
        time.sleep(PAUSE_S)
