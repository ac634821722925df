"""Heal a bundle's model by pages of user data of a drifted device, and compare with a re-fit by a known page.

    python -m analysis.calibration.healing --bundle bench --json F
    python -m analysis.calibration.healing --bundle B --set geometry.pipe_angle_deg=-0.3 --pages 2 --json F

Pages are encoded with the bundle's code and simulated on its device, changed as the case says. Up to six are healed by;
the AIR is that of others, by both models. An interrupted run goes on: cases that are in the JSON file are not measured
again.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import click
import numpy as np

from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.codec.page_bytes import FileFacts, Header
from lightpage.device.state import Device
from lightpage.errors import CalibrationError, FramesDisagreeError, RecalibrationRefusedError, UnconfirmedPageError
from lightpage.metrics.measures import measure
from lightpage.metrics.provenance import write_figures
from lightpage.page.pilots import Pilots
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import Tracker, unconfirmed_page
from lightpage.runtime.recalibration.healing import TOGETHER, LostPages, heal
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import refitted_bundle
from lightpage.runtime.recalibration.refit import refit
from lightpage.simulator.simulator import Simulator

_AXIAL = [f"{plane}axial_rad=0.3" for plane in ("geometry.modulator_", "in_phase_camera.", "quadrature_camera.")]
_MOVED_PX = 20.0
"""By how much the image is moved on both cameras."""
_DOWN = ["in_phase_camera.shift_y_px=17", "quadrature_camera.shift_y_px=22"]
_RIGHT = ["in_phase_camera.shift_x_px=24", "quadrature_camera.shift_x_px=16"]
CASES: dict[str, list[str]] = {
    "angle off by 0.03 degree": ["geometry.pipe_angle_deg=-0.57"],
    "angle off by 0.1 degree": ["geometry.pipe_angle_deg=-0.5"],
    "angle off by 0.3 degree": ["geometry.pipe_angle_deg=-0.3"],
    "image 20 px further down": _DOWN,
    "image 20 px to the right": _RIGHT,
    "one camera moved by 1 px": ["quadrature_camera.shift_x_px=-3"],
    "focus 0.3 rad": _AXIAL,
    "stroke 2%": ["slm.stroke_relative_error=-0.02"],
    "all at once, 0.03 degree": [
        "geometry.pipe_angle_deg=-0.57",
        *_AXIAL,
        "in_phase_camera.shift_y_px=17",
        "quadrature_camera.shift_y_px=22",
        "quadrature_camera.shift_x_px=-3",
        "slm.stroke_relative_error=-0.02",
    ],
}
"""Changes of the default device, which the shipped bundle was trained for. To the right, the image of the bench device
leaves the cameras with some symbols of its first column: no model reads those."""
_JUDGED = 4
_SEED = 31


@dataclass(frozen=True)
class Outcome:
    """Figures of a case: AIRs of pages that nothing was fitted to, bits a symbol; `healed` is why not where it is text.

    `read` counts the pages whose bytes come out, of those that were healed by and the others.
    """

    case: str
    settings: list[str]
    before: float
    healed: float | str
    known: float | str
    read_before: int
    read: int
    pages: int
    rounds: int
    seconds: float

    def line(self) -> str:
        """A row of the table."""
        healed, known = (f"{air:7.3f}" if isinstance(air, float) else f"{'-':>7}" for air in (self.healed, self.known))
        ratio = self.healed / self.known if isinstance(self.healed, float) and isinstance(self.known, float) else None
        told = (
            f"{self.case:<26} {self.before:>7.3f} {healed} {known} {'-' if ratio is None else format(ratio, '.3f'):>6}"
        )
        counts = f"{self.read_before:>3} {self.read:>3} of {self.pages:<3} {self.rounds:>6} {self.seconds:>8.0f}"
        return f"{told} {counts}{'' if ratio else f' {self.healed}'}"


HEADER = (
    f"{'case':<26} {'before':>7} {'healed':>7} {'known':>7} {'ratio':>6} {'read, before and after':>15} rounds  seconds"
)


@dataclass(frozen=True)
class _Bench:
    """A model, and pages of user data as its device writes them."""

    decoder: Decoder
    pages: int

    @cached_property
    def tracker(self) -> Tracker:
        """Tracker of the model as it was calibrated: its golden page shows what a shift does."""
        return tracker_for(self.decoder)

    @cached_property
    def symbols(self) -> np.ndarray:
        """Symbols that are written, uint8 [pages, ny, nx]; the last pages are not healed by."""
        codec, count, code = self.decoder.page_codec, self.pages + _JUDGED, self.decoder.page_codec.code
        data = np.random.default_rng(_SEED).integers(0, 256, (count, codec.user_bytes), dtype=np.uint8)
        headers = [Header(code.id, _SEED, page, count * codec.user_bytes) for page in range(count)]
        return codec.encode(headers, data, FileFacts(count, 0, 0), self.decoder.bundle.written_pilots(code.levels))

    def measured(self, case: str, settings: list[str]) -> Outcome:
        """Heal, and compare."""
        bundle, code = self.decoder.bundle, self.decoder.page_codec.code
        device = Device().of_profile(bundle.profile).with_settings(settings)
        simulator = Simulator(bundle.profile, device, code.levels, _SEED)
        pairs = [simulator.page(page) for page in self.symbols]
        lost = LostPages(tuple(pairs[: self.pages]), code, references=simulator.references())
        before, read_before = self.read(self.decoder, pairs)
        healed: float | str
        known: float | str
        read = rounds = 0
        seconds, image_px = 0.0, (_MOVED_PX * (_RIGHT[0] in settings), _MOVED_PX * (_DOWN[0] in settings))
        try:
            found = heal(self.decoder, lost)
        except RecalibrationRefusedError as error:
            healed = str(error)
        else:
            healed, read = self.read(found.decoder, pairs)
            rounds, seconds = found.rounds, found.seconds
        first = KnownPages((pairs[0],), (self.symbols[0],), code.levels, lost.references, image_px=image_px)
        try:
            result = refit(bundle, first, lambda what, share: None, self.decoder)
        except CalibrationError as error:
            known = str(error)
        else:
            known, _ = self.read(self.decoder.of_bundle(refitted_bundle(bundle, result)), pairs)
        return Outcome(case, settings, before, healed, known, read_before, read, len(pairs), rounds, seconds)

    def read(self, decoder: Decoder, pairs: Sequence[FramePair]) -> tuple[float, int]:
        """AIR of the pages that are not healed by, and how many of all give their bytes."""
        mask, levels = decoder.bundle.pilot_mask, decoder.bundle.levels(self.decoder.page_codec.code.levels)
        airs, read = list[float](), 0
        tracker = self.tracker.refitted(decoder)  # the image walks from page to page
        for number, (pair, symbols) in enumerate(zip(pairs, self.symbols, strict=True)):
            pilots = Pilots.of_symbols(mask, symbols, levels)
            page = _decoded(tracker, decoder, pair, pilots)
            read += decoder.page_codec.decode(page.phase, page.concentration).loss is None
            if number >= self.pages:
                data = ~mask
                found = measure(page.phase[data], page.concentration[data], symbols[data], levels)
                airs.append(found.air_bits_per_symbol)
        return float(np.mean(airs)), read


def _decoded(tracker: Tracker, decoder: Decoder, pair: FramePair, pilots: Pilots) -> DecodedPage:
    """A page, whatever its pilots and its frames say of it."""
    count = decoder.page_codec.code.levels
    try:
        return tracker.decode(pair, count, pilots)
    except UnconfirmedPageError as error:
        return unconfirmed_page(error)
    except FramesDisagreeError:
        return decoder.post_process(decoder.infer(pair, doubtful=True), count, pilots)


@click.command()
@click.option("--bundle", default="bench", show_default=True, help="A bundle's path, or the name of a shipped one.")
@click.option("--case", "names", type=click.Choice(list(CASES)), multiple=True, help="All of them if left out.")
@click.option("--set", "settings", multiple=True, metavar="TABLE.KEY=VALUE", help="A case of your own.")
@click.option("--pages", default=TOGETHER, show_default=True, type=click.IntRange(1, TOGETHER))
@click.option("--json", "json_path", required=True, type=OutputFile())
def main(bundle: str, names: tuple[str, ...], settings: tuple[str, ...], pages: int, json_path: Path) -> None:
    """Heal a model by pages of user data, and compare with a re-fit by a known page."""
    asked = {"bundle": bundle, "pages": pages}
    kept = json.loads(json_path.read_text("utf-8")) if json_path.exists() else {}
    done = {one["case"]: Outcome(**one) for one in kept.get("outcomes", ()) if kept.get("asked") == asked}
    own = {" ".join(settings): list(settings)} if settings else {}
    chosen = {name: CASES[name] for name in names} | own or CASES
    bench = _Bench(Decoder.load(bundle_path(bundle)), pages)
    click.echo(HEADER)
    for name, changes in track(list(chosen.items()), "heal", unit="case"):
        if name not in done:
            done[name] = bench.measured(name, changes)
            write_figures(json_path, {"asked": asked, "outcomes": [asdict(each) for each in done.values()]})
        click.echo(done[name].line())


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.calibration.healing"))
