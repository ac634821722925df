"""Finding the image again: offsets, walks, pages that are not this device's, and what it all costs.

    python -m analysis.tracking.image_search --out F

Every part is kept in F/figures.json as soon as it is measured, and not measured again. The pages come from the
project's own simulator; `--bundle B --recording R.h5` measures any other device's walking recording too. Two operating
points: the shipped decoder's device (full well 15,000 e-), and one with strong shot noise (32 e-), read by the kept
single pass of the comparison.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from statistics import fmean, median
from typing import Any

import click
import numpy as np
import torch
from numpy.typing import NDArray

from analysis.comparison.data_set import data_set_of
from analysis.comparison.kept_bundle import export_kept
from analysis.comparison.weight_store import TRAINED
from analysis.tracking.figure import POINTS, draw
from analysis.tracking.tables import (
    tell_apart,
    tell_full_size,
    tell_gaps,
    tell_offsets,
    tell_sound,
    tell_speed,
    tell_walk,
    tell_wrong,
)
from lightpage.calibration.image_search import ImageSearch
from lightpage.calibration.sampling_table import registration_coefficients
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFolder
from lightpage.device.profile import load_profile
from lightpage.device.state import Device, draw_device
from lightpage.errors import FrameError, InvalidInputError, UnconfirmedPageError
from lightpage.files import write_json
from lightpage.metrics.measures import measure
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import evaluate, was_seen
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.frames import narrow
from lightpage.runtime.model.decoding.image_search import BundleSearch
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.tracking import Tracker, unconfirmed_page
from lightpage.runtime.model.execution.twin import TWIN_THREADS, OnnxTwin
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.twin import RayTwin, TorchTwin

Figures = dict[str, Any]

LEVELS = 256
OFFSETS_PX = (0.5, 1.0, 2.0, 4.0, 8.0, 12.0)
APART_PX = (0.1, 0.25, 0.5, 1.0, 2.0)
WANTED_SHARE = 0.98
WALK_PX = 0.12
"""Length of a step from page to page, camera pixels."""
WALKED = 200
WRONG_PAGES = 100
"""Of each kind."""
DEVICES = 50
"""Others, over whose pages they are shared out."""
WAYS = ("random walk", "straight walk, reference stays")
FULL_SIZE_PAGES = 3
BRIGHT, DIM = POINTS
NOISY = "-0.6deg-32e-4px"
REPEATS = 15
SETTLE_S = 0.2
_STILL = ["drift.shift_px=0.0"]
_OFFSETS, _WRONG, _WALKS = 10, 20, 30
"""Random streams."""


@dataclass(frozen=True)
class Point:
    """An operating point: a decoder with the device that it was made for."""

    name: str
    decoder: Decoder
    device: Device

    @cached_property
    def tracker(self) -> Tracker:
        """One that has seen no page."""
        return tracker_for(self.decoder)

    @cached_property
    def search(self) -> BundleSearch:
        """The decoder's search."""
        return BundleSearch(self.decoder, OnnxTwin(self.decoder.bundle, TWIN_THREADS))

    @cached_property
    def pilots(self) -> Pilots:
        """The device's pilots."""
        return self.decoder.pilots(LEVELS)

    def simulator(self, seed: int, device: Device | None = None, *, reference_stays: bool = False) -> Simulator:
        """Of the device, or of one that has changed; the image stays where it is put."""
        still = (device or self.device).with_settings(_STILL)
        profile = self.decoder.bundle.profile
        return Simulator(profile, still, LEVELS, seed, reference_stays=reference_stays)

    def symbols(self, *seed: int) -> NDArray[np.uint8]:
        """A page."""
        pages = random_symbols(self.decoder.bundle.profile, LEVELS, 1, np.random.default_rng(seed))
        return np.asarray(pages[0], np.uint8)

    def air(self, tracker: Tracker, pair: FramePair, symbols: NDArray[np.uint8]) -> tuple[float, Figures]:
        """AIR of a page, 0 where it is not given out, and what was seen of it."""
        begun = time.perf_counter()
        try:
            page = tracker.decode(pair, LEVELS)
        except (UnconfirmedPageError, FrameError) as error:
            return 0.0, {"lost": type(error).__name__, "seconds": time.perf_counter() - begun}
        data = ~self.pilots.mask
        figures = measure(page.phase[data], page.concentration[data], symbols[data], LEVELS)
        assert page.image is not None
        told = {
            "shift_px": [page.image.shift_x_px, page.image.shift_y_px],
            "tilt_rad": [page.image.tilt_x_rad, page.image.tilt_y_rad],
            "found": page.image.found,
            "share": page.check.share,
            "seconds": page.timings.total_s,
            "search_seconds": page.timings.search_s,
        }
        return figures.air_bits_per_symbol, told


def share_of(air: float, reference: float) -> float:
    """Of a reference page's AIR; 0 where that was not read."""
    return air / reference if reference > 0 else 0.0


def offsets(point: Point, seeds: int) -> Figures:
    """The first page of a decoder that was just started, its image off by so much in any direction."""
    rows = []
    for seed in track(range(seeds), f"{point.name}: offsets", unit="seed"):
        rng = np.random.default_rng([_OFFSETS, seed])
        written = [point.symbols(_OFFSETS, seed, page) for page in range(2)]
        settled, simulators = (
            point.tracker.fork(),
            {stays: point.simulator(seed, reference_stays=stays) for stays in (False, True)},
        )
        point.air(settled, simulators[False].page(written[0]), written[0])
        tracked, told = point.air(settled, simulators[False].page(written[1]), written[1])
        for offset in OFFSETS_PX:
            for stays in (False, True):
                way = rng.uniform(0, 2 * np.pi)
                by = offset * np.cos(way), offset * np.sin(way)
                started = point.tracker.fork()
                first, second = knocked(simulators[stays], by, written[1])
                air, found = point.air(started, first, written[1])
                then, _ = point.air(started, second, written[1])
                row = {"seed": seed, "offset_px": offset, "by_px": by, "reference_stays": stays, "air": air}
                row |= {"share_of_tracked": share_of(air, tracked), "next_share": share_of(then, tracked)}
                rows.append(row | {"extra_seconds": found["seconds"] - told["seconds"], **found})
    return {"rows": rows}


def knocked(
    simulator: Simulator, by_px: tuple[float, float], symbols: NDArray[np.uint8]
) -> tuple[FramePair, FramePair]:
    """A page twice, whose image lies off; the next one lies where it was."""
    simulator.knock(by_px)
    pairs = simulator.page(symbols), simulator.page(symbols)
    simulator.knock((-by_px[0], -by_px[1]))
    return pairs


def apart(point: Point, seeds: int) -> Figures:
    """The same where the quadrature camera alone has moved."""
    rows, pose = [], point.device.quadrature_camera
    for seed in track(range(seeds), f"{point.name}: cameras apart", unit="seed"):
        rng = np.random.default_rng([_OFFSETS, 1, seed])
        written = point.symbols(_OFFSETS, seed, 1)
        tracked, _ = point.air(point.tracker.fork(), point.simulator(seed).page(written), written)
        for offset in APART_PX:
            way = rng.uniform(0, 2 * np.pi)
            moved = pose.model_copy(
                update={
                    "shift_x_px": pose.shift_x_px + offset * np.cos(way),
                    "shift_y_px": pose.shift_y_px + offset * np.sin(way),
                }
            )
            device = point.device.model_copy(update={"quadrature_camera": moved})
            air, told = point.air(point.tracker.fork(), point.simulator(seed, device).page(written), written)
            rows.append({"seed": seed, "offset_px": offset, "share_of_tracked": share_of(air, tracked), **told})
    return {"rows": rows}


def wrong_pages(point: Point, pages: int) -> Iterator[tuple[str, FramePair]]:
    """Pages that must not be given out, with their kind."""
    devices = max(1, min(DEVICES, pages // 2))
    for number in range(devices):
        drawn = draw_device(np.random.default_rng([_WRONG, number]))
        sensor = point.device.sensor
        simulator = point.simulator(number, drawn.model_copy(update={"sensor": sensor}))
        for page in range(pages // devices):
            yield "another device", simulator.page(point.symbols(_WRONG, number, page))
    simulator, rng = point.simulator(_WRONG), np.random.default_rng(_WRONG)
    for page in range(pages):
        simulator.knock((float(rng.uniform(-1, 1)), float(rng.uniform(-1, 1))))
        pair = simulator.page(point.symbols(_WRONG, page))
        yield "swapped frames", FramePair(pair.quadrature, pair.in_phase)
    references = simulator.references()
    for page in range(pages // 2):
        noisy = [
            np.clip(rng.normal(frame, 0.5 * frame.mean()), 0, 254).astype(frame.dtype)
            for frame in (references.in_phase, references.quadrature)
        ]
        yield "white noise", FramePair(*noisy)
        other = np.random.default_rng([_WRONG, 1, page]).integers(0, LEVELS, point.pilots.mask.shape, np.uint8)
        yield "pages without these pilots", point.simulator(page).page(other)


def false_acquisitions(point: Point, pages: int) -> Figures:
    """Pages of other devices, swapped frames and noise, each read by a decoder that was just started."""
    kinds: dict[str, dict[str, int]] = {}
    shares = []
    for kind, pair in track(wrong_pages(point, pages), f"{point.name}: wrong", unit="page", total=3 * pages):
        row = kinds.setdefault(kind, dict.fromkeys(("pages", "found", "given_out", "frames_refused", "unconfirmed"), 0))
        row["pages"] += 1
        row["found"] += point.search.find(pair, point.pilots).found
        try:
            shares.append(point.tracker.fork().decode(pair, LEVELS).check.share)
            row["given_out"] += 1
        except FrameError:
            row["frames_refused"] += 1
        except UnconfirmedPageError as error:
            shares += [unconfirmed_page(error).check.share]
            row["unconfirmed"] += 1
    return {"kinds": kinds, "shares": shares}


def walk(point: Point, pages: int, way: str) -> Figures:
    """A walk without a gap, read page by page."""
    tracker, simulator = point.tracker.fork(), point.simulator(_WALKS, reference_stays=way.endswith("reference stays"))
    rng, rows, place = np.random.default_rng(_WALKS), [], np.zeros(2)
    for page in track(range(pages), f"{point.name}: {way}", unit="page"):
        step = np.array([0.0, WALK_PX]) if way.startswith("straight") else rng.normal(0, WALK_PX, 2)
        simulator.knock((float(step[0]), float(step[1])))
        place = place + step
        written = point.symbols(_WALKS, page)
        air, told = point.air(tracker, simulator.page(written), written)
        rows.append({"place_px": place.tolist(), "air": air, **told})
    rates = [row["air"] for row in rows]
    worst, last = (share_of(air, rates[0]) for air in (min(rates), fmean(rates[-10:])))
    return {"rows": rows, "first": rates[0], "worst_share": worst, "last_share": last}


def sound_pages(point: Point, pages: int) -> Figures:
    """Pages of the device as it is, read one after the other: how often one is not given out, or a re-fit is asked."""
    simulator = Simulator(point.decoder.bundle.profile, point.device, LEVELS, _WALKS + 1)
    tracker, shares, lost, due = point.tracker.fork(), [], 0, 0
    for page in track(range(pages), f"{point.name}: sound pages", unit="page"):
        try:
            found = tracker.decode(simulator.page(point.symbols(_WALKS, 1, page)), LEVELS)
        except UnconfirmedPageError:
            lost += 1
        else:
            shares.append(found.check.share)
            due += found.check.recalibration_due
    return {"pages": pages, "unconfirmed": lost, "recalibration_due": due, "shares": shares}


def speed(point: Point, repeats: int) -> Figures:
    """A page that needs no search beside the bare decoder, and one that does, taking turns."""
    written = point.symbols(1)
    pair = point.simulator(1).page(written)
    settled = point.tracker.fork()
    settled.decode(pair, LEVELS)
    ways: dict[str, Callable[[], object]] = {
        "decoder alone": partial(point.decoder.decode, pair, LEVELS),
        "tracked": partial(settled.decode, pair, LEVELS),
        "searched": lambda: point.tracker.fork().decode(pair, LEVELS),
    }
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for repeat in range(repeats + 1):
        for name, call in ways.items():
            time.sleep(SETTLE_S)
            begun = time.perf_counter()
            call()
            if repeat:
                taken[name].append(time.perf_counter() - begun)
    return {name: median(seconds) for name, seconds in taken.items()}


def full_size(seeds: int) -> Figures:
    """The search at full size: a square pipe, whose pages are simulated in seconds; geometry known, no decoder."""
    profile = load_profile("paper")
    device = Device().with_settings([*_STILL, "geometry.pipe_angle_deg=0.0"])
    parameters, twin = true_parameters(profile, device), TorchTwin(RayTwin(profile))
    solve, search = TorchFieldSolver(FieldRecovery(profile)), ImageSearch(twin, parameters, profile)
    registration = registration_coefficients(twin, parameters, profile)
    quadrature_phase = device.homodyne.turn_rad
    homodyne = np.array([np.cos(quadrature_phase), np.sin(quadrature_phase)], np.float32)
    pilots, rows = Pilots.of_profile(profile, LEVELS), []
    for seed in track(range(seeds), "full size", unit="page"):
        simulator = Simulator(profile, device, LEVELS, seed)
        by = np.random.default_rng([_OFFSETS, 2, seed]).uniform(-12, 12, 2)
        simulator.knock((float(by[0]), float(by[1])))
        page = random_symbols(profile, LEVELS, 1, np.random.default_rng([_OFFSETS, 2, seed]))[0]
        pair, references = simulator.page(page), simulator.references()
        begun = time.perf_counter()
        with torch.no_grad():
            field, _ = solve(pair, references, registration, homodyne)
        recovered = time.perf_counter()
        found = search.find(field, pilots)
        rows.append(
            {
                "found": found.found,
                "error_px": float(np.abs(found.shift_px - by).max()),
                "field_seconds": recovered - begun,
                "search_seconds": time.perf_counter() - recovered,
                "significance": found.significance,
                "needed": found.needed,
            }
        )
    return {"rows": rows, "pilots": len(pilots.phases)}


def gaps(bundle: Path, recording: Path) -> Figures:
    """Another device's recording, every page read by a decoder that was just started, and all in their order."""
    decoder = Decoder.load(bundle)
    tracker, rows = tracker_for(decoder), []
    with Recording.open(recording) as pages:
        in_order = evaluate(decoder, pages, tracker.fork()).air_per_page
        mask = decoder.bundle.pilot_mask if (own := pages.pilots()) is None else own
        for page in track(range(pages.pages), str(recording), unit="page"):
            frames, symbols = pages.frames(page), pages.symbols(page)
            if symbols is None or was_seen(decoder, frames):
                continue
            known = Pilots.of_symbols(mask, symbols, pages.levels)
            air, told = 0.0, Figures()
            with suppress(UnconfirmedPageError):
                decoded = tracker.fork().decode(narrow(frames, pages.bit_depth), pages.levels, known)
                figures = measure(decoded.phase[~mask], decoded.concentration[~mask], symbols[~mask], pages.levels)
                assert decoded.image is not None
                air = figures.air_bits_per_symbol
                told = {"shift_px": [decoded.image.shift_x_px, decoded.image.shift_y_px]}
            rows.append({"page": page, "air": air, **told})
    return {"in_order": list(in_order), "after_a_gap": rows}


class WeightStore:
    """Figures that are kept as soon as they are measured."""

    def __init__(self, out: Path, options: Figures) -> None:
        self.path = out / "figures.json"
        self.figures: Figures = {"options": options}
        if self.path.exists():
            self.figures = json.loads(self.path.read_text())
            if self.figures.get("options") != options:
                raise InvalidInputError(f"--out {out}", "figures of other options", "the same ones, or another folder")

    def get(self, name: str, make: Callable[[], Figures]) -> Figures:
        """The figures of a part, measured if they are not there."""
        if name not in self.figures:
            self.figures[name] = make()
            write_json(self.path, self.figures)
        part: Figures = self.figures[name]
        return part


def points(out: Path, names: tuple[str, ...]) -> Iterator[Point]:
    """The operating points of these names."""
    if BRIGHT in names:
        yield Point(BRIGHT, Decoder.load(bundle_path(DEFAULT)), Device())
    if DIM not in names:
        return
    kept, bundle = TRAINED / "bench" / NOISY, out / "noisy.zip"
    if not bundle.exists():
        export_kept(kept, out / "noisy", bundle, refinements=0)
    yield Point(DIM, Decoder.load(bundle), data_set_of(kept)[1])


@click.command()
@click.option("--seeds", default=10, show_default=True, type=click.IntRange(1), help="Of every offset.")
@click.option("--pages", default=WALKED, show_default=True, type=click.IntRange(10), help="Of a walk.")
@click.option("--wrong", default=WRONG_PAGES, show_default=True, type=click.IntRange(2), help="Pages of each kind.")
@click.option("--point", "names", multiple=True, type=click.Choice(POINTS), default=POINTS, help="Only these.")
@click.option("--bundle", type=click.Path(path_type=Path, exists=True), help="Of another device.")
@click.option("--recording", type=click.Path(path_type=Path, exists=True), help="Of that device, walking.")
@click.option("--out", required=True, type=OutputFolder())
def main(
    seeds: int, pages: int, wrong: int, names: tuple[str, ...], bundle: Path | None, recording: Path | None, out: Path
) -> None:
    """Measure how the image is found, followed and confirmed."""
    out.mkdir(parents=True, exist_ok=True)
    kept = WeightStore(out, {"seeds": seeds, "pages": pages, "wrong": wrong})
    for point in points(out, names):
        name = point.name
        rows = kept.get(f"{name}: offsets", partial(offsets, point, seeds))["rows"]
        click.echo(tell_offsets(name, rows, OFFSETS_PX, WANTED_SHARE))
        click.echo(tell_apart(name, kept.get(f"{name}: apart", partial(apart, point, seeds))["rows"], APART_PX))
        for way in WAYS:
            click.echo(tell_walk(f"{name}: {way}", kept.get(f"{name}: {way}", partial(walk, point, pages, way))))
        wrongs = kept.get(f"{name}: wrong pages", partial(false_acquisitions, point, wrong))
        click.echo(tell_wrong(name, wrongs["kinds"]))
        click.echo(tell_sound(name, kept.get(f"{name}: sound pages", partial(sound_pages, point, wrong))))
        click.echo(tell_speed(name, kept.get(f"{name}: speed", partial(speed, point, REPEATS))))
    click.echo(tell_full_size(kept.get("full size", partial(full_size, FULL_SIZE_PAGES))["rows"]))
    if bundle is not None and recording is not None:
        part = f"{recording.name} by {bundle.name}"
        click.echo(tell_gaps(part, kept.get(part, partial(gaps, bundle, recording))))
    if set(names) == set(POINTS):
        draw(kept.figures, out / "image_search.png")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.tracking.image_search"))
