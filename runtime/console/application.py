"""The HTTP application of a service: console, actions, and metrics for Prometheus."""

import asyncio
import gzip
import json
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from importlib import resources
from typing import Any, TypeVar

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder, gzip_accepted
from tornado.web import Finish, HTTPError, RequestHandler, stream_request_body

from lightpage.errors import InvalidInputError, LightpageError, NotAllowedError
from lightpage.runtime.client.wire.address import names_machine
from lightpage.runtime.client.wire.status import without_folders
from lightpage.runtime.console.actions import ROLE
from lightpage.runtime.console.state import ConsoleState
from lightpage.runtime.service.caller import Actor, Identity, Role
from lightpage.runtime.service.server.certificates import identity_of

T = TypeVar("T")
_log = logging.getLogger(__name__)

MOST_BODY_BYTES = 1 << 16
"""Of a request. So much is taken in from who hears a refusal: nobody does who is still sending."""
_ACTION_BYTES = 1000
_STATIC = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/console.js": ("console.js", "text/javascript; charset=utf-8"),
    "/console.css": ("console.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
_HEADERS = {
    "Server": "lightpage",
    "Content-Type": "text/plain; charset=utf-8",
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
_REFUSALS = {
    404: "not found",
    405: "GET and HEAD only; actions by POST",
    408: "the rest did not come",
    413: f"1 to {_ACTION_BYTES} bytes only",
    415: "application/json only",
    421: "this host name is none of this service's: ask by IP address, or name it in metrics.names",
}
_STATUSES = {NotAllowedError: 403, InvalidInputError: 400, LightpageError: 409}
"""Of an error: that of the first kind which it is of."""

Content = Callable[[Any], bytes]
"""Makes the content of a page for a handler."""
Route = tuple[str, type[RequestHandler], dict[str, Any]]
"""A path, its handler, and what this is given."""


@contextmanager
def _refusing() -> Iterator[None]:
    """Make errors refusals, which have a status."""
    try:
        yield
    except LightpageError as error:
        status = next(status for kind, status in _STATUSES.items() if isinstance(error, kind))
        raise HTTPError(status, without_folders(str(error))) from None


@stream_request_body
class _Handler(RequestHandler):
    """Answers callers who ask for this machine; says in a line of text why it does not.

    The settings of its application are `names`, which gives the names of this machine by which it may be asked,
    `silence_s`, how long content may take to come, and `threads` for what takes time.
    """

    identity: Identity | None = None
    """Of the caller; None without TLS."""
    _content = b""

    def __init__(self, *arguments: Any, **given: Any) -> None:
        super().__init__(*arguments, **given)
        self._late = asyncio.get_running_loop().call_later(self.settings["silence_s"], self.send_error, 408)

    def set_default_headers(self) -> None:
        """See `RequestHandler`."""
        for name, value in _HEADERS.items():
            self.set_header(name, value)

    def prepare(self) -> None:
        """Find out who asks for whom; refuse what is far too large before it comes."""
        if not names_machine(self.request.host, self.settings["names"]()):
            raise HTTPError(421)
        if self.request.protocol == "https":
            try:
                certificate: Any = self.request.get_ssl_certificate(binary_form=True)
            except AttributeError:  # the connection has broken, and its socket is gone
                raise Finish from None
            with _refusing():
                self.identity = identity_of(certificate)
        with suppress(ValueError):  # Tornado refuses it
            if int(self.request.headers.get("Content-Length", "0")) > MOST_BODY_BYTES:
                raise HTTPError(413)

    def data_received(self, chunk: bytes) -> None:
        """Take a part of the content."""
        self._content += chunk

    def on_finish(self) -> None:
        """Wait no longer."""
        self._late.cancel()

    def in_thread(self, work: Callable[..., T], *arguments: Any) -> asyncio.Future[T]:
        """Do in a thread what would hold up other callers."""
        return asyncio.get_running_loop().run_in_executor(self.settings["threads"], work, *arguments)

    def write_error(self, status_code: int, **told: Any) -> None:
        """Say why, whatever a caller has put into it; nothing of the inside."""
        error = told["exc_info"][1] if "exc_info" in told else None
        why = error.get_message() if isinstance(error, HTTPError) else None
        self.finish(f"{why or _REFUSALS.get(status_code, 'see the log')}\n".encode("utf-8", "backslashreplace"))


class _Page(_Handler):
    """Shows those who may look what `content` makes, which knows the request and sets headers of its own."""

    def initialize(self, content: Content, clock: Callable[[], float] = time.time) -> None:
        """Take what the route gives."""
        self._page, self._clock = content, clock

    async def get(self) -> None:
        """Show what `content` makes of the request."""
        self._late.cancel()
        if self.identity is not None:  # whose certificate was checked when the connection began, and not since
            with _refusing():
                self.identity.check(Role.READ, "a page of the console", self._clock())
        self.finish(await self.in_thread(self._page, self))

    head = get


class _Action(_Handler):
    """Does what an administrator asks for."""

    def initialize(self, state: ConsoleState) -> None:
        """Take what the route gives."""
        self._state = state

    async def post(self) -> None:
        """Do what the content asks for, and say what came of it."""
        self._late.cancel()
        if self.identity is None or (actions := self._state.actions) is None:
            raise HTTPError(403, "actions need TLS, and a certificate with role admin")
        if self.request.headers.get("Content-Type", "").partition(";")[0].strip().lower() != "application/json":
            raise HTTPError(415)  # which a browser sends nowhere in the name of another page
        if not 0 < len(self._content) <= _ACTION_BYTES:
            raise HTTPError(413)
        name = f"{self.identity.name} at {self.request.remote_ip}"
        with _refusing():
            try:
                self.identity.check(ROLE, "an action of the console", self._state.clock())
                outcome = await self.in_thread(actions.do, self._content, Actor(name, "console"))
            except NotAllowedError as error:
                _log.warning("console: an action of %s is refused: %s", name, error)
                raise
        self.finish(f"{outcome}\n")


def _metrics(registry: CollectorRegistry, asked: RequestHandler) -> bytes:
    headers, names = asked.request.headers, asked.get_query_arguments("name[]")
    encode, kind = choose_encoder(headers.get("Accept", ""))
    asked.set_header("Content-Type", kind)
    content = encode(registry.restricted_registry(names) if names else registry)
    if not gzip_accepted(headers.get("Accept-Encoding", "")):
        return content
    asked.set_header("Content-Encoding", "gzip")
    return gzip.compress(content)


def _page(state: ConsoleState, asked: _Handler) -> bytes:
    path = asked.request.path
    if path in _STATIC:
        name, kind = _STATIC[path]
        content = resources.files("lightpage.runtime.console").joinpath("static", name).read_bytes()
    elif path == "/state.json":
        content, kind = json.dumps(state.to_json(asked.identity), allow_nan=False).encode(), "application/json"
    elif (picture := state.picture(path)) is not None:
        content, kind = picture, "image/png"
    else:
        raise HTTPError(404)
    asked.set_header("Content-Type", kind)
    return content


def metrics_routes(registry: CollectorRegistry) -> list[Route]:
    """Make the routes that show metrics, whatever the path."""
    return [(".*", _Page, {"content": partial(_metrics, registry)})]


def console_routes(state: ConsoleState, registry: CollectorRegistry) -> list[Route]:
    """Make the routes of a console, with the metrics beside it."""
    return [
        ("/metrics", _Page, {"content": partial(_metrics, registry), "clock": state.clock}),
        ("/actions", _Action, {"state": state}),
        (".*", _Page, {"content": partial(_page, state), "clock": state.clock}),
    ]
