"""The state of a service as the console shows it."""

import time
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from lightpage.runtime.console.actions import ROLE, Actions
from lightpage.runtime.console.last_pages import LastPages, PageRow
from lightpage.runtime.console.pictures import air_png, frame_png
from lightpage.runtime.service.caller import Identity
from lightpage.runtime.service.models.loader import Model
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.monitor import AIR, Monitor

POINTS = 600
"""Most points of a series."""
RECENT = 50
"""Pages in the table."""
_IDLE_S = 30.0
_SERIES = [figure.name for figure in fields(PageRow) if figure.type == float | None]


class ConsoleState:
    """The state that the console shows.

    Args:
        last_pages: what is known of them.
        models: the models.
        monitor: says whether a recalibration is due.
        source: source of the pages, for people.
        actions: what callers may do who prove that they may; None for nothing.
        clock: seconds since 1970.
    """

    def __init__(
        self,
        last_pages: LastPages,
        models: Models,
        monitor: Monitor,
        source: str,
        actions: Actions | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._last_pages, self._models, self._monitor, self._source = last_pages, models, monitor, source
        self.actions, self.clock = actions, clock
        self._begun = clock()

    def to_json(self, identity: Identity | None = None) -> dict[str, Any]:
        """Return all that the page shows to a caller, as JSON has it."""
        actions = self.actions if identity is not None and identity.may(ROLE) else None
        rows, now = self._last_pages.rows(), self.clock()
        thinned = rows[:: max(1, -(-len(rows) // POINTS))]
        if rows and thinned[-1] is not rows[-1]:
            thinned.append(rows[-1])
        told = [row.to_json() for row in thinned]
        number, pair, concentration = self._last_pages.pictures()
        monitor = self._monitor.state()
        return {
            "time_s": now,
            "source": self._source,
            "uptime_s": now - self._begun,
            "condition": _condition(rows, monitor.due, now),
            "reasons": list(monitor.reasons),
            "pages": self._last_pages.pages,
            "picture": {"number": number, "frames": pair is not None, "air": concentration is not None},
            "series": {name: [row[name] for row in told] for name in ("time_s", "lost", "unread", *_SERIES)},
            "signs": {sign.name: vars(sign) for sign in monitor.signs},
            "losses": [vars(loss) for loss in self._last_pages.losses()],
            "models": [_model(model, model is self._models.current) for model in self._models.loaded],
            "caller": "" if identity is None else identity.name,
            "actions": [] if actions is None else actions.available(),
            "job": None if actions is None else actions.job(),
            "recent": [row.to_json() for row in rows[-RECENT:]][::-1],
        }

    def picture(self, path: str) -> bytes | None:
        """Return a picture of the last page, as PNG; None where there is none of this path."""
        _, pair, concentration = self._last_pages.pictures()
        if path == "/air.png" and concentration is not None:
            return air_png(concentration, next(s.baseline for s in self._monitor.state().signs if s.name == AIR.name))
        if path not in ("/frames/in_phase.png", "/frames/quadrature.png") or pair is None:
            return None
        depth = self._models.current.decoder.bundle.manifest.camera_bit_depth
        return frame_png(pair.in_phase if "in_phase" in path else pair.quadrature, depth)


def _condition(rows: list[PageRow], due: bool, now: float) -> str:
    """Return how the service fares, in a word."""
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
        "air": metrics.get("recalibration_air_bits_per_symbol", metrics.get("validation_air_bits_per_symbol")),
    }
