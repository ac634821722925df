"""The HTTP server of a service: metrics for Prometheus, and the console for people. It changes nothing."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Iterable
from importlib import resources
from typing import TYPE_CHECKING, Any, Self
from wsgiref.simple_server import WSGIRequestHandler, make_server

from prometheus_client import make_wsgi_app
from prometheus_client.exposition import ThreadingWSGIServer

from runtime.console.history import History, PageRow
from runtime.console.pictures import confidence_png, frame_png
from runtime.service.metrics import ServiceMetrics
from runtime.service.monitor import Monitor
from runtime.service.registry import Model, ModelRegistry

if TYPE_CHECKING:
    from _typeshed.wsgi import StartResponse, WSGIEnvironment

_log = logging.getLogger(__name__)

POINTS = 600
"""Most points of a series."""
RECENT = 50
"""Pages in the table."""
_IDLE_S = 30.0
_SERIES = (
    "margin_bits",
    "air_bits",
    "trust",
    "share",
    "shift_x_px",
    "shift_y_px",
    "piston_rad",
    "residual_rad",
)
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
        registry: the models.
        monitor: says whether a recalibration is due.
        source: of the pages, for people.
    """

    def __init__(
        self, metrics: ServiceMetrics, history: History, registry: ModelRegistry, monitor: Monitor, source: str
    ) -> None:
        self._metrics = make_wsgi_app(metrics.registry)
        self._history, self._registry, self._monitor, self._source = history, registry, monitor, source
        self._begun = time.time()

    def __call__(self, environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        """Answer a request; see PEP 3333."""
        path, method = environ.get("PATH_INFO", "/"), environ.get("REQUEST_METHOD", "")
        if method not in ("GET", "HEAD"):
            return _answer(start_response, "405 Method Not Allowed", "text/plain", b"GET and HEAD only\n", method)
        if path == "/metrics":
            answer: Iterable[bytes] = self._metrics(environ, start_response)
            return answer
        try:
            found = self._content(path)
        except Exception:
            _log.exception("console: %s", path)
            return _answer(start_response, "500 Internal Server Error", "text/plain", b"see the log\n", method)
        if found is None:
            return _answer(start_response, "404 Not Found", "text/plain", b"not found\n", method)
        return _answer(start_response, "200 OK", found[1], found[0], method)

    def _content(self, path: str) -> tuple[bytes, str] | None:
        if path in _STATIC:
            name, kind = _STATIC[path]
            return resources.files("runtime.console").joinpath("static", name).read_bytes(), kind
        if path == "/state.json":
            return json.dumps(self.state(), allow_nan=False).encode(), "application/json"
        _, pair, confidence = self._history.pictures()
        depth = self._registry.current.decoder.bundle.manifest.camera_bit_depth
        pictures: dict[str, Callable[[], bytes] | None] = {
            "/frames/in_phase.png": None if pair is None else lambda: frame_png(pair.in_phase, depth),
            "/frames/quadrature.png": None if pair is None else lambda: frame_png(pair.quadrature, depth),
            "/confidence.png": None if confidence is None else lambda: confidence_png(confidence),
        }
        picture = pictures.get(path)
        return None if picture is None else (picture(), "image/png")

    def state(self) -> dict[str, Any]:
        """All that the page shows, as JSON has it."""
        rows, now = self._history.rows(), time.time()
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
            "models": [_model(model, model is self._registry.current) for model in self._registry.models],
            "recent": [row.to_json() for row in rows[-RECENT:]][::-1],
        }


class ConsoleServer:
    """Serves a console until it is closed; use it in a `with` statement.

    Args:
        console: what to serve.
        port: 0 takes a free one.
        host: to listen on.

    Raises:
        OSError: the port is taken.
    """

    def __init__(self, console: Console, port: int, host: str = "127.0.0.1") -> None:
        self._server = make_server(host, port, console, ThreadingWSGIServer, handler_class=_QuietHandler)
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


class _QuietHandler(WSGIRequestHandler):
    """Logs no requests: there is one a second for each browser."""

    timeout = 20
    """A caller that says nothing is hung up on, seconds."""

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


def _answer(start: StartResponse, status: str, kind: str, content: bytes, method: str) -> Iterable[bytes]:
    start(status, [("Content-Type", kind), ("Content-Length", str(len(content))), *_HEADERS])
    return [] if method == "HEAD" else [content]
