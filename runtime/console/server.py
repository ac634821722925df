"""The HTTP server of a service: metrics for Prometheus, and the console for people."""

from __future__ import annotations

import io
import json
import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from importlib import resources
from typing import TYPE_CHECKING, Any, Self
from wsgiref.headers import Headers
from wsgiref.simple_server import WSGIRequestHandler, make_server

from prometheus_client import make_wsgi_app
from prometheus_client.exposition import ThreadingWSGIServer

from lightpage.errors import InvalidInputError, LightpageError, NotAllowedError
from lightpage.runtime.client.wire.address import names_machine
from lightpage.runtime.client.wire.status import without_folders
from lightpage.runtime.console.actions import ROLE, Actions
from lightpage.runtime.console.history import History, PageRow
from lightpage.runtime.console.pictures import confidence_png, frame_png
from lightpage.runtime.service.caller import Actor, Identity, Role
from lightpage.runtime.service.models.loader import Model
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.server.certificates import Certificates
from lightpage.runtime.service.server.roles import identity_of

if TYPE_CHECKING:
    from _typeshed.wsgi import StartResponse, WSGIApplication, WSGIEnvironment

_log = logging.getLogger(__name__)

IDENTITY = "lightpage.identity"
"""Key of a request's caller, an `Identity`, in its environment; it is not there without TLS."""
_NAME = "lightpage"
"""As which the server names itself to callers."""
_ACTION_BYTES = 1000
_DRAINED_BYTES = 1 << 16
MOST_CONNECTIONS = 64
"""Connections that are answered at once: browsers, Prometheus, and those who say nothing."""
LONGEST_S = 60.0
"""For one connection: more than any answer takes, and too little to hold one for hours by a byte now and then."""
SILENCE_S = 20.0
"""A caller that says nothing for so long is hung up on."""
_HANDSHAKE_S = 5.0
POINTS = 600
"""Most points of a series."""
RECENT = 50
"""Pages in the table."""
_IDLE_S = 30.0
_SERIES = ("margin_bits", "air_bits", "trust", "share", "shift_x_px", "shift_y_px", "piston_rad", "residual_rad")
_MISDIRECTED = "this host name is none of this service's: ask by IP address, or name it in metrics.names"
_STATIC = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/console.js": ("console.js", "text/javascript; charset=utf-8"),
    "/console.css": ("console.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
_HEADERS = [
    ("Cache-Control", "no-store"),
    ("Content-Security-Policy", "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"),
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"),
]


class Console:
    """What the console says, as a WSGI application.

    Args:
        metrics: shown at ``/metrics``.
        history: of the pages.
        models: the models.
        monitor: says whether a recalibration is due.
        source: of the pages, for people.
        actions: what callers may do who prove that they may; None for nothing.
        clock: seconds since 1970.
    """

    def __init__(
        self,
        metrics: ServiceMetrics,
        history: History,
        models: Models,
        monitor: Monitor,
        source: str,
        actions: Actions | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._actions, self._clock = actions, clock
        self._metrics = make_wsgi_app(metrics.registry)
        self._history, self._models, self._monitor, self._source = history, models, monitor, source
        self._begun = clock()

    def __call__(self, environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        """Answer a request; see PEP 3333."""
        path, method = environ.get("PATH_INFO", "/"), environ.get("REQUEST_METHOD", "")
        identity: Identity | None = environ.get(IDENTITY)
        if method == "POST" and path == "/actions":
            return self._act(environ, start_response, identity)
        try:
            if identity is not None:  # whose certificate was checked when its TLS session began, and not since
                identity.check(Role.READ, "a page of the console", self._clock())
        except NotAllowedError as error:
            return _refused(start_response, "403 Forbidden", str(error))
        if method != "GET":
            return _refused(start_response, "405 Method Not Allowed", "GET and HEAD only")
        if path == "/metrics":
            answer: Iterable[bytes] = self._metrics(environ, start_response)
            return answer
        found = self._content(path, identity)
        if found is None:
            return _refused(start_response, "404 Not Found", "not found")
        return _answer(start_response, "200 OK", found[1], found[0])

    def _act(
        self, environ: WSGIEnvironment, start_response: StartResponse, identity: Identity | None
    ) -> Iterable[bytes]:
        """Do what an administrator asks for.

        A page of somebody else's cannot ask for it in the administrator's name: a browser sends no JSON across origins
        without asking first, which is refused, and says where a request comes from.
        """
        told = environ.get("CONTENT_LENGTH") or "0"
        size = int(told) if told.isdecimal() and len(told) < 10 else 0
        try:
            content = environ["wsgi.input"].read(min(size, _DRAINED_BYTES))  # whoever is still sending hears no refusal
        except OSError:
            return _refused(start_response, "408 Request Timeout", "the rest did not come")
        if identity is None or self._actions is None:
            return _refused(start_response, "403 Forbidden", "actions need TLS, and a certificate with role admin")
        if environ.get("HTTP_ORIGIN", own := f"https://{environ.get('HTTP_HOST', '')}") != own:
            return _refused(start_response, "403 Forbidden", "actions are asked for from the console's own page")
        if environ.get("CONTENT_TYPE", "").partition(";")[0].strip().lower() != "application/json":
            return _refused(start_response, "415 Unsupported Media Type", "application/json only")
        if not 0 < size <= _ACTION_BYTES:
            return _refused(start_response, "413 Content Too Large", f"1 to {_ACTION_BYTES} bytes only")
        name = f"{identity.name} at {environ.get('REMOTE_ADDR', '')}"
        try:
            identity.check(ROLE, "an action of the console", self._clock())
            outcome = self._actions.do(content, Actor(name, "console"))
        except NotAllowedError as error:
            _log.warning("console: an action of %s is refused: %s", name, error)
            return _refused(start_response, "403 Forbidden", str(error))
        except InvalidInputError as error:
            return _refused(start_response, "400 Bad Request", str(error))
        except LightpageError as error:
            return _refused(start_response, "409 Conflict", without_folders(str(error)))
        except Exception:
            _log.exception("console: action of %s", name)
            return _refused(start_response, "500 Internal Server Error", "see the log")
        return _answer(start_response, "200 OK", "text/plain; charset=utf-8", _encoded(outcome))

    def _content(self, path: str, identity: Identity | None) -> tuple[bytes, str] | None:
        if path in _STATIC:
            name, kind = _STATIC[path]
            return resources.files("lightpage.runtime.console").joinpath("static", name).read_bytes(), kind
        if path == "/state.json":
            return json.dumps(self.state(identity), allow_nan=False).encode(), "application/json"
        _, pair, confidence = self._history.pictures()
        depth = self._models.current.decoder.bundle.manifest.camera_bit_depth
        pictures: dict[str, Callable[[], bytes] | None] = {
            "/frames/in_phase.png": None if pair is None else lambda: frame_png(pair.in_phase, depth),
            "/frames/quadrature.png": None if pair is None else lambda: frame_png(pair.quadrature, depth),
            "/confidence.png": None if confidence is None else lambda: confidence_png(confidence),
        }
        picture = pictures.get(path)
        return None if picture is None else (picture(), "image/png")

    def state(self, identity: Identity | None = None) -> dict[str, Any]:
        """All that the page shows to a caller, as JSON has it."""
        acts = self._actions if identity is not None and identity.may(ROLE) else None
        rows, now = self._history.rows(), self._clock()
        thinned = rows[:: max(1, -(-len(rows) // POINTS))]
        if rows and thinned[-1] is not rows[-1]:
            thinned.append(rows[-1])
        told = [row.to_json() for row in thinned]
        number, pair, confidence = self._history.pictures()
        monitor = self._monitor.state()
        return {
            "time_s": now,
            "source": self._source,
            "uptime_s": now - self._begun,
            "condition": _condition(rows, monitor.due, now),
            "reasons": list(monitor.reasons),
            "pages": self._history.pages,
            "picture": {"number": number, "frames": pair is not None, "confidence": confidence is not None},
            "series": {name: [row[name] for row in told] for name in ("time_s", *_SERIES)},
            "losses": [vars(loss) for loss in self._history.losses()],
            "models": [_model(model, model is self._models.current) for model in self._models.loaded],
            "caller": "" if identity is None else identity.name,
            "actions": [] if acts is None else acts.available(),
            "job": None if acts is None else acts.job(),
            "recent": [row.to_json() for row in rows[-RECENT:]][::-1],
        }


class ConsoleServer:
    """Serves a console until it is closed; use it in a `with` statement.

    Args:
        console: what to serve, a `Console` or any other application.
        port: 0 takes a free one.
        host: to listen on, IPv6 with or without brackets.
        certificates: with which it meets its callers, who must have some too; None for no TLS.
        names: further names of this machine by which it may be asked, see `names_machine`.

    Raises:
        OSError: the port is taken, or there is no such host.
    """

    def __init__(
        self,
        console: WSGIApplication,
        port: int,
        host: str = "127.0.0.1",
        certificates: Certificates | None = None,
        names: Iterable[str] = (),
    ) -> None:
        known = frozenset(name.lower() for name in (host, socket.gethostname(), *names))

        def known_now() -> frozenset[str]:
            return known if certificates is None else known | certificates.names()

        host = host.strip("[]")
        kind = _Server6 if _is_ipv6(host, port) else _Server
        self._server = make_server(host, port, _served(console, known_now), kind, handler_class=_Handler)
        self._server.certificates = certificates
        self._thread = threading.Thread(target=self._server.serve_forever, name="lightpage-console", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self._server.server_port)

    def close(self) -> None:
        """Stop listening and wait for the thread."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Server(ThreadingWSGIServer):
    """Takes each connection in a thread of its own, TLS included: a caller that says nothing holds up nobody.

    Beyond `MOST_CONNECTIONS` a connection is closed at once, and each is closed after `LONGEST_S`.
    """

    certificates: Certificates | None = None
    """With which callers are met; None for no TLS."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._room = threading.BoundedSemaphore(MOST_CONNECTIONS)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Begin to answer a connection, if there is room for one more."""
        if not self._room.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._room.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer a connection, for a limited time; give its room back however that ends."""
        try:
            with request.dup() as same:
                ending = threading.Timer(LONGEST_S, _cut_off, [same])
                ending.daemon = True
                ending.start()
                try:
                    super().process_request_thread(request, client_address)
                finally:
                    ending.cancel()
        except (OSError, RuntimeError):  # there are no descriptors or threads left
            self.handle_error(request, client_address)
            self.shutdown_request(request)
        finally:
            self._room.release()

    def finish_request(self, request: Any, client_address: Any) -> None:
        """Answer the requests of a connection."""
        if self.certificates is None:
            super().finish_request(request, client_address)
            return
        request.settimeout(_HANDSHAKE_S)
        try:
            secured = self.certificates.context().wrap_socket(request, server_side=True)
        except (OSError, ValueError) as error:  # an SSLError is an OSError
            _log.info("console: no TLS with %s: %s", client_address[0], getattr(error, "reason", None) or error)
            return
        with secured:
            super().finish_request(secured, client_address)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection broke."""
        _log.debug("console: connection of %s", client_address[0], exc_info=True)


class _Server6(_Server):
    """Listens on IPv6; on all of its addresses, also on those of IPv4."""

    address_family = socket.AF_INET6

    def server_bind(self) -> None:
        """See `socketserver.TCPServer`."""
        self.socket.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        super().server_bind()


class _Handler(WSGIRequestHandler):
    """Says who calls. Logs no requests: there is one a second for each browser."""

    def setup(self) -> None:
        """See `socketserver.StreamRequestHandler`."""
        super().setup()
        self.connection.settimeout(SILENCE_S)

    def get_stderr(self) -> Any:
        """Nowhere: a caller that hangs up is no fault, and what the console does not foresee it logs itself."""
        return io.StringIO()

    def version_string(self) -> str:
        """What its own refusals say that it is."""
        return _NAME

    def get_environ(self) -> WSGIEnvironment:
        """See `WSGIRequestHandler`."""
        environ = super().get_environ()
        if isinstance(self.connection, ssl.SSLSocket):
            certificate = self.connection.getpeercert(binary_form=True)
            assert certificate is not None  # without one there is no connection
            environ[IDENTITY] = identity_of(certificate)
        return environ

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


def _condition(rows: list[PageRow], due: bool, now: float) -> str:
    """How the service fares, in a word."""
    if not rows:
        return "no page yet"
    if any(row.lost or row.unread for row in rows[-5:]):
        return "pages are being lost"
    if due:
        return "recalibration is due"
    return "idle" if now - rows[-1].time_s > _IDLE_S else "reading"


def _model(model: Model, current: bool) -> dict[str, Any]:
    manifest = model.decoder.bundle.manifest
    metrics = manifest.metrics
    return {
        "version": manifest.version,
        "created": manifest.created,
        "current": current,
        "air_before": metrics.get("recalibration_air_bits_per_symbol_before"),
        "air_after": metrics.get("recalibration_air_bits_per_symbol"),
    }


def _cut_off(connection: socket.socket) -> None:
    """End a connection that another thread reads from."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


def _is_ipv6(host: str, port: int) -> bool:
    """Whether a host has addresses of IPv6 alone.

    Raises:
        OSError: there is no such host.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except UnicodeError as error:
        raise OSError(f"no host: {error}") from None
    return all(family == socket.AF_INET6 for family, *_ in found)


def _served(application: WSGIApplication, known: Callable[[], Collection[str]]) -> WSGIApplication:
    """An application as it is served: HEAD is GET without the content, failures are logged, nothing names versions.

    A request for a host that is not among the `known` names of this machine is refused, see `names_machine`.
    """

    def answer(environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        begun: list[tuple[str, list[tuple[str, str]]]] = []

        def begin(status: str, headers: list[tuple[str, str]], error: Any = None, /) -> Callable[[bytes], object]:
            begun.append((status, headers))
            return _no_write

        is_head = environ["REQUEST_METHOD"] == "HEAD"
        try:
            host = environ.get("HTTP_HOST")
            if host is None or names_machine(host, known()):
                content = b"".join(application(environ | {"REQUEST_METHOD": "GET"} if is_head else environ, begin))
            else:
                content = b"".join(_refused(begin, "421 Misdirected Request", _MISDIRECTED))
        except Exception:
            _log.exception("console: %s", environ.get("PATH_INFO"))
            content = b"".join(_refused(begin, "500 Internal Server Error", "see the log"))
        status, told = begun[-1][0], Headers(begun[-1][1])
        told["Content-Length"], told["Server"] = str(len(content)), _NAME
        start_response(status, told.items())
        return [] if is_head else [content]

    return answer


def _no_write(content: bytes) -> object:
    """What PEP 3333 has for applications of old; none here uses it."""
    raise NotImplementedError


def _refused(start: StartResponse, status: str, why: str) -> Iterable[bytes]:
    return _answer(start, status, "text/plain; charset=utf-8", _encoded(why))


def _encoded(text: str) -> bytes:
    """A line, whatever a caller has put into it."""
    return f"{text}\n".encode("utf-8", "backslashreplace")


def _answer(start: StartResponse, status: str, kind: str, content: bytes) -> Iterable[bytes]:
    start(status, [("Content-Type", kind), *_HEADERS])
    return [content]
