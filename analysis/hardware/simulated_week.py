"""A service and its drifting device through a simulated week."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from analysis.hardware.drifting import DriftingSource, TrueTable, Untold, direction, light_of, moved, true_light
from analysis.hardware.rows import Rows, append_row, kept_rows
from analysis.hardware.watched_recalibrator import WatchedRecalibrator
from lightpage.clock import Clock
from lightpage.device.state import Device
from lightpage.errors import FramesDisagreeError, LightpageError, LostPageError
from lightpage.page.levels import Levels
from lightpage.progress import track
from lightpage.runtime.archives.recordings.coded_pages import air_bits
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.kept_pages import KeptPages
from lightpage.runtime.service.jobs.self_calibration import SelfCalibration, SelfCalibrationSettings
from lightpage.runtime.service.models.loader import Loader
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.store import Store
from lightpage.runtime.service.monitoring.flight_recorder import FlightRecorder
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.monitoring.observation import Observer
from lightpage.runtime.service.pages.reading import read_page

PAGE_S = 300.0
"""Simulated time from one page to the next."""

DAY_PAGES = 288.0
DAILY_UNITS = 0.7
"""Amplitude of the daily cycle: 0.7 units cost 0.05 bit a symbol, and from evening to morning 0.2 bit, where a page has
0.13 to spare."""

WARM_UP_UNITS, WARM_UP_PAGES = 3.0, 144.0
"""Size of the warm-up, 0.9 bit in all, and the pages (twelve hours) in which it falls to 1/e."""

KNOCK_SHARE = 0.5
"""Share of the week after which somebody knocks against the table."""
KNOCK_PX, KNOCK_DEG = (2.0, -2.0), 0.02
"""Shift of the image on both cameras, and turn of the pipe."""

CALIBRATION_PAGES = (1_000_000, 1_000_001)
"""Numbers of the fully known pages, which nobody else reads."""
_KEPT_BYTES = 1 << 29

RANGE_PAGES = 12
"""Pages of a range, an hour's; its lost ones are read once more where the service has recalibrated itself for them."""


@dataclass(frozen=True)
class LightDrift:
    """Changes that go on evenly through a week, beside the geometry.

    Attributes:
        stroke_relative: change of the modulator's stroke.
        axial_rad: places of modulator and cameras along the axis, as phases at the middle of the facet's wall.
    """

    stroke_relative: float = 0.0
    axial_rad: float = 0.0

    def of(self, device: Device, share: float) -> Device:
        """A device after a share of the week."""
        axial = ("geometry.modulator_axial_rad", "in_phase_camera.axial_rad", "quadrature_camera.axial_rad")
        changes = {"slm.stroke_relative_error": self.stroke_relative, **dict.fromkeys(axial, self.axial_rad)}
        known = device.model_dump()
        paths = {name: name.split(".") for name in changes}
        values = {name: known[table][key] + share * changes[name] for name, (table, key) in paths.items()}
        return device.with_values(values)


def state(begun: Device, moment: float, pages: int, light: LightDrift) -> Device:
    """The true device at a time of a week of `pages`, in pages, that was `begun` when it was calibrated, cold."""
    day = np.sin(2 * np.pi * moment / DAY_PAGES)
    warm_up = 1 - np.exp(-moment / WARM_UP_PAGES)
    device = moved(begun, WARM_UP_UNITS * warm_up * direction(1) + DAILY_UNITS * day * direction(2))
    device = light.of(device, moment / pages)
    if moment < KNOCK_SHARE * pages:
        return device
    angle = device.geometry.pipe_angle_deg + KNOCK_DEG
    return device.model_copy(update={"geometry": device.geometry.model_copy(update={"pipe_angle_deg": angle})})


class SimulatedClock(Clock):
    """The seconds of a week that is simulated; what waits by it waits real ones."""

    def __init__(self, week: Week) -> None:
        self._week = week

    def now(self) -> float:
        """Return the simulated seconds."""
        return self._week.moment * PAGE_S


@dataclass
class Week:
    """A service and its device through a week.

    Args:
        out: folder where models, frames and rows are kept.
        pages: number of pages of the week.
        pages_during: largest number of pages that are read while a recalibration runs.
        threads: threads of an inference.
        bundle: bundle that the service begins with.
        device: true state at the beginning.
        light: changes beside the geometry.
        true_every: pages from one that is read with the true table, too, to the next.
        shown: whether fully known pages are shown to recalibrate by; else pages of user data serve.
    """

    out: Path
    pages: int
    pages_during: int
    threads: int | None
    bundle: Path
    device: Device
    light: LightDrift
    true_every: int = 1
    shown: bool = True
    rows: Rows = field(default_factory=list)
    moment: int = 0

    def read_until(self, end: int) -> None:
        """Read the pages before number `end` that are not kept yet."""
        path = self.out / "rows.jsonl"
        self.rows = kept_rows(path)
        base = Decoder.load(self.bundle, self.threads)
        source = DriftingSource(base, lambda moment: state(self.device, moment, self.pages, self.light), seed=7)
        knock = int(KNOCK_SHARE * self.pages)
        if self.rows:
            source.skip(int(self.rows[-1]["shots"]))
            if self.rows[-1]["page"] >= knock:
                source.knock(KNOCK_PX)
        true_table, monitor = TrueTable(base), Monitor()
        with ExitStack() as stack:
            store = stack.enter_context(Store(self.out / "models", base.bundle))
            models = Models(base, store, Loader(tracker_for))
            recorder = stack.enter_context(FlightRecorder(self.out / "flight", models, monitor=monitor))
            kept = None if self.shown else KeptPages(_KEPT_BYTES)
            observers: list[Observer] = [recorder] if kept is None else [recorder, Untold(kept)]
            plane = DataPlane(models, source, observers=observers, monitor=monitor)
            watched = WatchedRecalibrator(plane)
            stack.callback(watched.close)
            pages = CALIBRATION_PAGES if self.shown else ()
            settings = SelfCalibrationSettings(enabled=True, pages=pages, busy_s=0.05)
            stack.enter_context(SelfCalibration(plane, monitor, watched, settings, SimulatedClock(self), kept))
            begun = len(self.rows)
            numbers = track(range(begun, end), "week", total=end, done=begun)
            for number in numbers:
                self.moment = number
                source.moment = float(number)
                if number == knock:
                    source.knock(KNOCK_PX)
                row = self._read(number, plane, monitor, source, true_table)
                row |= {"restarted": number == begun > 0, "during": watched.running, "ended": watched.ended()}
                ends = (number + 1) % RANGE_PAGES == 0 or number + 1 == self.pages
                row["again"] = self._again([*self.rows, row], plane) if ends and not self.shown else []
                self.rows.append(row)
                append_row(path, row)
                watched.settle(monitor, self.pages_during)

    def _again(self, rows: Rows, plane: DataPlane) -> list[int]:
        """Read lost pages of the last range once more, as ReadData does; returns those that are read now."""
        lost = [row for row in rows[-1 - rows[-1]["page"] % RANGE_PAGES :] if row["lost"]]
        if not lost or plane.heal is None or not plane.heal(Caller(), lost[-1]["version"], len(lost)):
            return []
        read = list[int]()
        for row in lost:
            try:
                data = read_page(plane, row["page"], None, Caller(), user_data=True).answer.user_data
            except LightpageError:
                continue
            if data is not None and data.loss is None:
                read.append(row["page"])
        return read

    def _read(
        self, number: int, plane: DataPlane, monitor: Monitor, source: DriftingSource, true_table: TrueTable
    ) -> dict[str, Any]:
        """Read a page; what it was like, and what it would have been like with the true table."""
        row: dict[str, Any] = {"page": number, "air": 0.0, "margin": None, "shift_px": None, "failed": False}
        before = plane.models.current
        try:
            found = read_page(plane, number, None, Caller(), user_data=True)
        except LightpageError as error:
            disagree = isinstance(error.__cause__, FramesDisagreeError)
            failed = not (isinstance(error, LostPageError) or disagree)
            row |= {"lost": type(error).__name__, "failed": failed, "version": before.version}
        else:
            answer, symbols = found.answer, source.truth(number).symbols
            data, page = answer.user_data, answer.page
            assert data is not None  # asked for
            row |= {
                "air": air_bits(page, symbols, true_table.data, Levels(page.levels, page.level_phases)),
                "margin": data.margin_bits,
                "lost": "" if data.loss is None else data.loss.value,
                "version": answer.model_version,
                "shift_px": None if page.image is None else [page.image.shift_x_px, page.image.shift_y_px],
            }
        looked = not self.rows or number % self.true_every == 0
        truth, bundle = source.truth(number), before.decoder.bundle
        device = truth.device
        row |= {
            "true_air": true_table.air(truth, source.levels) if looked else self.rows[-1]["true_air"],
            "due": monitor.due,
            "reasons": list(monitor.state().reasons),
            "shots": source.shots,
            "true": true_light(bundle.profile, device),
            "fitted": light_of(bundle.calibration.vector, bundle.modulation),
        }
        return row
